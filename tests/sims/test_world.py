"""The simulated bench: deterministic, true to its own truth, and with the faults it was asked for."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.data import Array, Frame
from reseau.core.errors import UsageError
from reseau.designs import regular_reseau, standard_reseau
from reseau.io import Mark, ReseauDesign
from reseau.optics.formation import coverage, mark_outline
from reseau_sims import Faults, World, film
from reseau_sims.plate import uneven_wires

from ..montecarlo import slowly


@pytest.fixture(scope="module")
def world() -> World:
    return World.standard(3)


@pytest.fixture(scope="module")
def frame(world: World) -> Frame:
    return world.photo_i()


@pytest.mark.slow
def test_the_same_seed_gives_the_same_frame_in_any_order(world: World, frame: Frame) -> None:
    again = World.standard(3)
    again.photograph("something else")
    assert again.photo_i().sha256 == frame.sha256
    np.testing.assert_array_equal(again.photo_i().pixels, frame.pixels)
    assert World.standard(4).photo_i().sha256 != frame.sha256


@pytest.mark.slow
def test_two_photographs_differ_only_by_noise(world: World, frame: Frame) -> None:
    other = world.photograph("PHOTO I again")
    difference = other.pixels.astype(float) - frame.pixels
    light = frame.pixels.astype(float)
    # Shot noise of 12 electrons a grey value, 1 of reading, 1/12 of rounding, of both frames.
    expected = np.sqrt(2 * (light / 12 + 1 + 1 / 12).mean())
    assert difference.std() == pytest.approx(expected, rel=0.02)
    assert abs(difference.mean()) < 0.02


@pytest.mark.slow
def test_a_frame_is_eight_bit_and_not_saturated(frame: Frame) -> None:
    assert frame.pixels.dtype == np.uint8
    assert frame.pixels.shape == (1200, 1600)
    assert 150 < np.median(frame.pixels) < 220
    assert (frame.pixels == 255).mean() < 1e-4


@pytest.mark.parametrize("seed", range(5))
def test_truth_is_invertible_and_all_marks_are_in_the_frame(seed: int) -> None:
    truth = World.standard(seed).truth()
    np.testing.assert_allclose(truth.view.inverse(truth.xy), truth.object_xy, rtol=0, atol=1e-9)
    assert (truth.xy > 20).all()
    assert (truth.xy < np.array([1600, 1200]) - 20).all()
    # y up in the plane is up in the image, where y grows downwards.
    assert truth.xy[0, 1] < truth.xy[-1, 1]


def noise_free(world: World) -> Array:
    return world.plate.over(world.screen.seen(world.view(), world.camera.shape), world.camera)


def test_wires_are_drawn_at_their_true_positions(world: World) -> None:
    light, truth = noise_free(world), world.truth()
    background = world.screen.seen(world.view(), world.camera.shape)
    share = (1 - light / background) / world.plate.opacity
    for name in ("F8", "A1", "K15", "C4"):
        at = truth.xy[truth.names.index(name)]
        column, row = np.rint(at).astype(int)
        slope = truth.view.derivatives(truth.object_xy[[truth.names.index(name)]]).d_xy[0]
        cross = mark_outline("line-grid", 0.0, 0.3, 0.05, 4.0).affine(slope, at).oriented()
        columns, rows = np.arange(column - 5.0, column + 6), np.arange(row - 5.0, row + 6)
        expected = coverage(cross, columns, rows, world.camera.psf_px)
        # Over 1 mm the mapping bends by less than 1/1000 px.
        found = share[row - 5 : row + 6, column - 5 : column + 6]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("turn_deg", "slope"), [(-8.0, 0.1), *slowly((2.0, 0.003), (90.0, 0.02))])
def test_uneven_wires_cross_at_the_marks_of_their_design(turn_deg: float, slope: float) -> None:
    rng = np.random.default_rng(5)
    wires = uneven_wires(rng, 9, 7, 14.0, turn_deg=turn_deg, slope=slope, offset=0.3, bend=2e-5)
    uneven = World.standard(3, wires=wires)
    share = 1 - noise_free(uneven) / uneven.screen.seen(uneven.view(), uneven.camera.shape)
    truth = uneven.truth()
    assert len(truth.names) == 63
    offset = np.arange(-16.0, 17.0)
    for at in truth.xy[::8]:
        column, row = np.rint(at).astype(int)
        if not (16 <= column < 1583 and 16 <= row < 1183):
            continue
        window = share[row - 16 : row + 17, column - 16 : column + 17]
        # A crossing is symmetric about its point: seen through a round window there, so is its light.
        shift = at - [column, row]
        distance = (offset - shift[0]) ** 2 + (offset[:, None] - shift[1]) ** 2
        weighed = window * np.exp(-0.5 * distance / 4.0**2)
        mean = np.array([(weighed * offset).sum(), (weighed * offset[:, None]).sum()]) / weighed.sum()
        np.testing.assert_allclose(mean, shift, rtol=0, atol=3e-3)
        assert window[16, 16] > 0.7 * uneven.plate.opacity


@pytest.mark.slow
def test_a_broken_crossing_of_uneven_wires_leaves_a_gap() -> None:
    wires = uneven_wires(np.random.default_rng(5), 9, 7, 14.0, turn_deg=5.0)
    uneven = World.standard(3, wires=wires, faults=Faults(missing=2))
    share = 1 - noise_free(uneven) / uneven.screen.seen(uneven.view(), uneven.camera.shape)
    truth = uneven.truth()
    for name, at in zip(truth.names, truth.xy, strict=True):
        column, row = np.rint(at).astype(int)
        if 0 <= column < 1600 and 0 <= row < 1200:
            assert (share[row, column] < 0.05) == (name in uneven.plate.missing)


def test_marks_that_are_no_crossings_are_refused() -> None:
    wires = uneven_wires(np.random.default_rng(5), 15, 11)
    with pytest.raises(UsageError, match="no crossings"):
        World.standard(3, design=standard_reseau(), wires=wires).photo_i()


def design_of(mark: Mark, polarity: str) -> ReseauDesign:
    return regular_reseau(5, 4, 25.0, mark, polarity=polarity)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize("polarity", ["dark", "bright"])
@pytest.mark.parametrize(
    "mark",
    [
        Mark(shape="disk", size=1.2),
        Mark(shape="square", size=1.0),
        Mark(shape="cross", size=2.0, line_width=0.4),
    ],
    ids=lambda mark: mark.shape,
)
def test_marks_of_every_shape_are_centred_on_their_truth(mark: Mark, polarity: str) -> None:
    world = World.standard(2, design=design_of(mark, polarity))
    background = world.screen.seen(world.view(), world.camera.shape)
    change = np.abs(noise_free(world) - background) / (background if polarity == "dark" else 1.0)
    truth = world.truth()
    for at in truth.xy[[0, 7, 19]]:
        column, row = np.rint(at).astype(int)
        window = change[row - 24 : row + 25, column - 24 : column + 25]
        offset = np.arange(-24.0, 25.0)
        centroid = np.array([(window * offset).sum(), (window * offset[:, None]).sum()]) / window.sum()
        # The centre of gravity of a bent mark is off its middle: 0.0035 px for 3 mm, 4/9 of it here.
        np.testing.assert_allclose(centroid + np.array([column, row]), at, rtol=0, atol=2e-3)


@pytest.mark.slow
def test_faults_have_the_specified_effect() -> None:
    faults = Faults(missing=3, false_marks=4, bit_errors=500, lost_rows=6, scene=40.0)
    with_faults, without = World.standard(5, faults=faults), World.standard(5)
    assert len(with_faults.plate.missing) == 3
    assert with_faults.plate.false_marks.shape == (4, 2)
    bad, good = with_faults.photo_i().pixels, without.photo_i().pixels
    assert (bad.max(axis=1) == 0).sum() == 6
    assert (good.max(axis=1) == 0).sum() == 0
    truth = with_faults.truth()
    for name in with_faults.plate.missing:
        column, row = np.rint(truth.xy[truth.names.index(name)]).astype(int)
        around = np.s_[row - 3 : row + 4, column - 3 : column + 4]
        assert np.median(bad[around].astype(float)) > np.median(good[around].astype(float)) + 20
    distance = np.hypot(*(with_faults.plate.false_marks[:, None] - truth.object_xy[None]).transpose(2, 0, 1))
    assert distance.min() > 3.0  # no false mark can be taken for a true one


def test_bit_errors_flip_one_bit_each() -> None:
    pixels = np.full((50, 60), 0b10101010, dtype=np.uint8)
    arrived = Faults(bit_errors=40).transmit(pixels, 8, np.random.default_rng(1))
    changed = (arrived ^ pixels)[arrived != pixels]
    assert len(changed) == 40
    assert all(bin(int(flip)).count("1") == 1 for flip in changed)


def test_check_marks_are_marks_and_neither_origin_nor_axis(world: World) -> None:
    check, design = world.check_marks(), standard_reseau()
    assert len(check) == 20
    assert set(check) < set(design.ids)
    assert not {design.origin, design.axis} & set(check)


def test_a_film_is_the_identity_until_it_is_deformed() -> None:
    points = np.array([[10.0, -20.0], [45.0, 30.0]])
    np.testing.assert_array_equal(film()(points), points)
    bent = film(ax=1e-3, bx=2e-3, d2=1e-5, h1=1e-8)(points)
    x, y = points.T
    np.testing.assert_allclose(bent[:, 0], x + 1e-3 * x + 2e-3 * y + 1e-8 * x**4, rtol=1e-14)
    np.testing.assert_allclose(bent[:, 1], y + 1e-5 * x * y, rtol=1e-14)


def test_designs_that_cannot_be_drawn_as_wires_are_refused() -> None:
    grid = standard_reseau()
    with_gap = grid.model_copy(update={"points": grid.points[1:]})
    with pytest.raises(UsageError, match="is no grid of wires"):
        World.standard(1, design=with_gap).photo_i()
