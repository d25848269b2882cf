"""PHOTO II and III of the simulated bench: arcs at their true positions, and the requested faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.core.data import Array, Frame
from reseau.core.errors import UsageError
from reseau.designs import test_object
from reseau.optics import RationalPolynomial
from reseau_sims import Display, Faults, Reflectors, Scanner, Truth, World, swapped

from .quiet import echoes, middle_of, quiet

ROWS = "ABCDE"
"""Rods of these rows are isolated: no other echo is near."""


@pytest.fixture(scope="module")
def world() -> World:
    return World.standard(3)


@pytest.fixture(scope="module")
def photo_ii(world: World) -> Frame:
    return world.photo_ii()


def errors(light: Array, truth: Truth, names: tuple[str, ...]) -> Array:
    """Middles of the drawn arcs minus the truth, (k, 2) px."""
    at = [truth.xy[truth.names.index(name)] for name in names]
    return np.array([middle_of(light, xy) - xy for xy in at])


def alone(world: World) -> tuple[str, ...]:
    return tuple(name for name in world.test_object.ids if name[0] in ROWS)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("display", ["wong", pytest.param("polynomial", marks=pytest.mark.slow)])
def test_middles_of_arcs_are_at_their_true_positions(seed: int, display: str) -> None:
    world = quiet(World.standard(seed, display=display))  # type: ignore[arg-type]
    found = errors(echoes(world, world.rods), world.truth_ii(), alone(world))
    assert np.abs(found[:, 0]).max() < 0.02
    assert np.abs(found[:, 1]).max() < 0.006


@pytest.mark.slow
def test_a_body_is_at_its_true_position_inside_the_rods() -> None:
    world = quiet(World.standard(4))
    body, truth = world.body(20), world.truth_iii(world.body(20))
    assert truth.names == body.names
    assert np.abs(errors(echoes(world, body, "PHOTO III"), truth, body.names)).max() < 0.02
    rods = test_object().xy
    assert (body.xy > rods.min(axis=0)).all()
    assert (body.xy < rods.max(axis=0)).all()
    apart = np.abs(body.xy[:, None] - body.xy[None]) > [14.0, 8.0]
    assert (apart.any(axis=-1) | np.eye(20, dtype=bool)).all()
    np.testing.assert_array_equal(world.body(20).xy, body.xy)


def test_the_true_mapping_and_its_inverse_agree(world: World) -> None:
    truth = world.truth_ii()
    np.testing.assert_allclose(truth.view.inverse(truth.xy), truth.object_xy, rtol=0, atol=1e-8)
    names = world.truth_iii().names
    assert len(names) == 24
    assert names[0] == "P1"


@pytest.mark.slow
def test_rods_deviate_from_the_design_by_their_tolerance() -> None:
    designed = test_object()
    deviation = np.concatenate([World.standard(seed).rods.xy - designed.xy for seed in range(12)])
    # 912 coordinates: the standard deviation of their standard deviation is 2.3 %.
    assert deviation.std() == pytest.approx(0.25, rel=0.08)
    assert abs(deviation.mean()) < 0.03
    assert deviation.reshape(12, -1).std(axis=0).min() > 0.05  # every seed has other rods


def test_the_test_object_determines_the_sixteen_coefficients() -> None:
    design = test_object()
    assert len(design.ids) >= 25
    _, _, columns = RationalPolynomial.ultrasonic().derivatives(design.xy + np.array([0.0, 55.0]))
    normal = columns.reshape(-1, 16)
    normal = normal / np.linalg.norm(normal, axis=0)
    assert np.linalg.cond(normal) < 50
    m, n = (design.ids.index(name or "") for name in (design.origin, design.axis))
    np.testing.assert_allclose(design.xy[n] - design.xy[m], [100.0, 0.0])


@pytest.mark.slow
def test_the_same_seed_gives_the_same_photographs_in_any_order(world: World, photo_ii: Frame) -> None:
    again = World.standard(3)
    iii = again.photo_iii()
    assert again.photo_ii().sha256 == photo_ii.sha256
    assert again.photo_iii().sha256 == iii.sha256
    assert world.photo_i().sha256 == World.standard(3).photo_i().sha256
    assert len({world.photo_i().sha256, photo_ii.sha256, iii.sha256}) == 3


@pytest.mark.slow
def test_photo_ii_is_dark_with_bright_arcs_and_visible_wires(world: World, photo_ii: Frame) -> None:
    grey = photo_ii.pixels.astype(float)
    assert photo_ii.pixels.dtype == np.uint8
    assert grey.max() < 250
    assert 30 < np.median(grey[200:1000, 300:1300]) < 60
    rods, marks = world.truth_ii(), world.truth("PHOTO II")
    for name in alone(world):
        column, row = np.rint(rods.xy[rods.names.index(name)]).astype(int)
        assert grey[row - 2 : row + 3, column - 12 : column + 13].max() > 110
    for name in ("C4", "H12", "J7"):
        column, row = np.rint(marks.xy[marks.names.index(name)]).astype(int)
        beside = grey[row - 12 : row + 13, column - 12 : column + 13]
        assert grey[row - 1 : row + 2, column - 1 : column + 2].mean() < 0.5 * np.median(beside)


def test_some_arcs_cross_wires_and_some_touch(world: World) -> None:
    truth, marks = world.truth_ii(), world.truth("PHOTO II")
    x = np.array([marks.xy[marks.names.index(f"F{k + 1}"), 0] for k in range(15)])
    distance = np.abs(truth.xy[:, :1] - x).min(axis=1)
    assert 5 < (distance < 15).sum() < len(distance) - 5
    xy = truth.xy
    gap = np.abs(xy[:, None] - xy[None])
    touching = (gap[..., 0] < 60) & (gap[..., 1] < 16) & ~np.eye(len(xy), dtype=bool)
    assert 2 <= touching.any(axis=1).sum() <= 12


def test_an_echo_has_the_length_of_the_beam_width_and_the_curvature_of_the_range() -> None:
    scanner = Scanner(noise=0.0, face=0.0)
    x, y = np.arange(-60.0, 60.05, 0.1), np.arange(58.0, -55.0, -0.05)
    rod = Reflectors(("only",), np.array([[3.0, -40.0]]), np.ones(1))
    video = scanner.sweep(rod, x, y, np.random.default_rng(0))
    ridge = video.signal.max(axis=0)
    width = float(scanner.beam_mm(np.array([40.0]))[0])
    sigma = np.sqrt((ridge * (x - 3.0) ** 2).sum() / ridge.sum())
    assert sigma == pytest.approx(width, rel=2e-3)
    brightest = video.y[video.signal.argmax(axis=0)]
    at = np.abs(x - 3.0) < 2 * width
    expected = scanner.top_mm - np.hypot(40.0, x[at] - 3.0)
    np.testing.assert_allclose(brightest[at], expected, rtol=0, atol=0.026)
    assert scanner.beam_mm(np.array([100.0]))[0] > 1.2 * width


def test_the_parameters_of_the_beam_change_the_image() -> None:
    display = Display(RationalPolynomial.affine())
    x = np.array([[40.0, -30.0], [0.0, 20.0]])
    video = Scanner().sweep(World.standard(0).rods, *display.raster(World.standard(0).screen), rng())
    with_beam = display.path(video, (4e-3, -2e-3))
    np.testing.assert_allclose(with_beam(x) - x, [[0.22, 0.0], [-0.04, 0.0]], rtol=0, atol=1e-12)
    with pytest.raises(UsageError, match="belong to the scanner"):
        Display(RationalPolynomial.from_terms({"m1": {"X": "x"}}, fixed={"X": "x", "Y": "y"})).path(video)


def rng() -> np.random.Generator:
    return np.random.default_rng(1)


@pytest.mark.slow
def test_a_parallax_shifts_the_echoes_but_not_the_reseau() -> None:
    near, far = (quiet(World.standard(2, faults=Faults(parallax_mm=gap))) for gap in (0.0, 2.0))
    np.testing.assert_array_equal(near.truth("PHOTO II").xy, far.truth("PHOTO II").xy)
    moved = far.truth_ii().xy - near.truth_ii().xy
    centre = near.camera.view(near.camera.pose.x0[None, :2])
    radius = near.truth_ii().xy - centre
    # 2 of 264 mm: what is behind is smaller by as much, about the foot of the perpendicular.
    np.testing.assert_allclose(moved, -radius * 2 / 266, rtol=0, atol=0.25)
    assert np.abs(moved).max() > 2.5
    assert np.abs(errors(echoes(far, far.rods), far.truth_ii(), alone(far))).max() < 0.02


@pytest.mark.slow
def test_a_displaced_camera_shifts_everything_after_photo_i() -> None:
    still, pushed = (World.standard(2, faults=Faults(camera_moved_mm=d)) for d in (0.0, 1.0))
    assert still.photo_i().sha256 == pushed.photo_i().sha256
    for photo in ("PHOTO II", "PHOTO III"):
        shift = pushed.truth(photo).xy - still.truth(photo).xy
        # 1 mm at a reproduction of 0.57 and 63 µm is 9 px.
        assert np.hypot(*shift.T).mean() == pytest.approx(9.0, rel=0.15)
    assert np.ptp(np.arctan2(*shift.T)) > 0.01
    pushed = quiet(pushed)
    assert np.abs(errors(echoes(pushed, pushed.rods), pushed.truth_ii(), alone(pushed))).max() < 0.02


@pytest.mark.slow
def test_a_rotated_test_object_is_imaged_rotated_but_the_body_is_not() -> None:
    straight, turned = (quiet(World.standard(2, faults=Faults(object_turned_deg=d))) for d in (0.0, 3.0))

    def direction(world: World) -> float:
        truth = world.truth_ii()
        m, n = (truth.xy[truth.names.index(name)] for name in ("C1", "C5"))
        return float(np.rad2deg(np.arctan2(*(n - m)[::-1])))

    # Upwards on the right is a negative angle where y grows downwards; λ1 and λ2 differ.
    assert direction(turned) - direction(straight) == pytest.approx(-3.0, abs=0.3)
    np.testing.assert_array_equal(straight.truth_iii().xy, turned.truth_iii().xy)
    truth = turned.truth_ii()
    assert np.abs(errors(echoes(turned, turned.rods), truth, alone(turned))).max() < 0.02
    np.testing.assert_array_equal(truth.object_xy, straight.truth_ii().object_xy)


@pytest.mark.slow
def test_a_missing_row_of_rods_is_not_drawn() -> None:
    world = quiet(World.standard(2, faults=Faults(missing_row="D")))
    light, truth = echoes(world, world.rods), world.truth_ii()
    for name, (x, y) in zip(truth.names, np.rint(truth.xy).astype(int), strict=True):
        peak = light[y - 3 : y + 4, x - 3 : x + 4].max()
        assert (peak < 1) == (name in ("D1", "D2", "D3")), name
    with pytest.raises(UsageError, match="is no row of the test object"):
        World.standard(2, faults=Faults(missing_row="Q")).photo_ii()


def test_swapped_marks_are_the_same_marks() -> None:
    design = test_object()
    other = swapped(design)
    assert (other.origin, other.axis) == (design.axis, design.origin)
    assert other.points == design.points


@pytest.mark.slow
def test_bright_areas_deflect_the_beam_and_the_truth_includes_it() -> None:
    straight = quiet(World.standard(6))
    disk = (-30.0, 0.0, 12.0)
    display = replace(straight.display, bright=(disk,))
    bent = quiet(World.standard(6))
    straight.display, bent.display = display, replace(display, bending_mm=0.5)
    moved = bent.truth_ii().xy - straight.truth_ii().xy
    size = np.hypot(*moved.T)
    centre = bent.camera.view(Inverse(bent)(np.array([disk[:2]])))
    away = straight.truth_ii().xy - centre
    near = np.hypot(*away.T) < 9 * 20
    assert size[near].max() > 1.0
    assert size[np.hypot(*away.T) > 9 * 45].max() < 0.15  # what arcs do to each other
    strong = near & (size > 0.5)
    cosine = (moved * away).sum(axis=1) / (size * np.hypot(*away.T))
    assert cosine[strong].min() > 0.9
    clear = tuple(
        name
        for name, distance in zip(bent.rods.names, np.hypot(*away.T), strict=True)
        if name[0] in ROWS and distance > 9 * 30
    )
    assert np.abs(errors(echoes(bent, bent.rods), bent.truth_ii(), clear)).max() < 0.02


class Inverse:
    """Displayed positions of points of an ideal screen."""

    def __init__(self, world: World) -> None:
        self.path = replace(world.display, bending_mm=0.0).path(
            world.scanner.sweep(world.rods, *world.display.raster(world.screen), rng()),
            (world.scanner.m1, world.scanner.m2),
        )

    def __call__(self, xy: Array) -> Array:
        return self.path.inverse(xy)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("impossible", "message"),
    [
        (lambda: Scanner(diameter_mm=0.0), "are positive"),
        (lambda: World.standard(0).body(400), "cannot have 400 points"),
        (lambda: Reflectors(("a",), np.array([[0.0, 5.0]]), np.ones(1)), "below the transducer"),
        (lambda: Reflectors(("a", "b"), np.array([[0.0, -5.0]]), np.ones(1)), "2 names"),
    ],
)
def test_impossible_worlds_are_refused(impossible: object, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        impossible()  # type: ignore[operator]


@pytest.mark.slow
def test_the_reseau_is_redrawn_after_a_change() -> None:
    world, fresh = World.standard(3), World.standard(3)
    light = np.ones(world.camera.shape)
    whole = world.plate.over(light, world.camera)
    np.testing.assert_array_equal(world.plate.over(light, world.camera), whole)
    world.plate.missing = fresh.plate.missing = frozenset({"F8"})
    broken = world.plate.over(light, world.camera)
    assert np.abs(broken - whole).max() > 0.5
    np.testing.assert_array_equal(broken, fresh.plate.over(light, fresh.camera))


def test_echoes_may_be_even_fading_or_tapering() -> None:
    x, y = np.arange(-20.0, 20.05, 0.1), np.arange(58.0, -55.0, -0.05)
    rod = Reflectors(("only",), np.array([[0.0, -40.0]]), np.ones(1))

    def signal(**form: float) -> Array:
        video = Scanner(noise=0.0, face=0.0, **form).sweep(rod, x, y, np.random.default_rng(0))
        return video.signal

    width = float(Scanner().beam_mm(np.array([40.0]))[0])
    inner, outer = np.abs(x) < 0.7 * width, np.abs(x) > 1.3 * width
    beam, even = (signal(**form).max(axis=0) for form in ({}, {"evenness": 0.9}))
    assert beam[inner].min() < 0.8 * beam.max()
    assert even[inner].min() > 0.98 * even.max()
    assert even[outer].max() < 0.01 * even.max()
    fading = signal(evenness=0.9, fading=0.3).max(axis=0)
    right, left = (
        fading[np.isclose(x, 0.5 * width, atol=0.05)],
        fading[np.isclose(x, -0.5 * width, atol=0.05)],
    )
    assert right.mean() / left.mean() == pytest.approx(1.15 / 0.85, abs=0.03)
    whole, tapering = (signal(evenness=0.9, **form) for form in ({}, {"tapering": 0.5}))
    column = int(np.abs(x - 0.9 * width).argmin())
    assert tapering[:, column].sum() / whole[:, column].sum() == pytest.approx(1 - 0.5 * 0.45**2, abs=0.02)
