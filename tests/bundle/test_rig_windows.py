"""A window fixed to a rig: one surface of water below cameras that are fixed to each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.bundle import Network, Options, Result, adjust_network, problem_of
from reseau.bundle.solver.implicit import normal_of
from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.io.refraction import RefractionEntry
from reseau.optics.poses import rotation_matrix
from reseau.optics.refraction import RefractedRays, Window
from reseau.optics.refraction.windows import Refraction, RefractiveIndex

from .rigs import PLACES, SIGMA, drawn

AIR, WATER = RefractiveIndex("air", 1.0), RefractiveIndex("water", 1.333)
TILTS, DISTANCE = (0.03, -0.02), 320.0
FREE = ("tilt_X", "tilt_Y", "distance")


def surface(shape: str, free: tuple[str, ...] = (), **wrong: float) -> Window:
    """Surface of the water in the axes of the first camera; spherical: a large ball around the cameras."""
    if shape == "sphere":
        values = {"X": 12.0, "Y": -8.0, "Z": -20.0, "radius": 380.0} | wrong
    else:
        values = {"tilt_X": TILTS[0], "tilt_Y": TILTS[1], "distance": DISTANCE} | wrong
    return Window("surface", shape, "rig", values, ("air", "water"), free)  # type: ignore[arg-type]


def wet(
    seed: int = 0, window: Window | None = None, *, shape: str = "plane", noise: float = SIGMA
) -> Network:
    """The rig above water. Its images are drawn with the window on the object, one for each exposure."""
    network, rng = drawn(cameras=3, control=True), np.random.default_rng(seed)
    assert network.rig is not None
    true, xy = surface(shape), network.xy.copy()
    turns = rotation_matrix(network.rotation)
    image, point = network.image_of, network.point_of
    for i in range(len(network.images)):
        camera = int(network.camera_of[i])
        to_rig = rotation_matrix(PLACES[camera][0]).T @ turns[i]
        at = network.x0[i] - to_rig.T @ PLACES[camera][1]
        if shape == "plane":
            normal, _ = true.unit(true.start)
            along = to_rig.T @ normal
            placed = Window(
                "w", "plane", "object", {"distance": true.values["distance"] + float(along @ at)},
                ("air", "water"), direction=tuple(along.tolist()),
            )  # fmt: skip
        else:
            centre = at + to_rig.T @ true.start[:3]
            named = dict(zip("XYZ", centre.tolist(), strict=True))
            placed = replace(true, on="object", values=named | {"radius": true.start[3]})
        scene = Refraction((AIR, WATER), (placed,), ((0,),), np.zeros(len(turns), np.intp))
        rows = np.flatnonzero(image == i)
        rays = RefractedRays.of(
            scene.columns(scene.values),
            scene.path_of,
            turns,
            network.x0,
            network.xyz,
            image[rows],
            point[rows],
        )
        assert rays.reached.all()
        entry = network.cameras[camera]
        xy[rows] = entry.bare_mapping(entry.values)(rays.uv) + noise * rng.normal(size=(len(rows), 2))
    given = Refraction((AIR, WATER), (window or surface(shape),), ((0,),), np.zeros(len(turns), np.intp))
    return replace(network, xy=xy, refraction=given)


def held(network: Network) -> Network:
    """All points known."""
    return replace(
        network, sigma=np.zeros_like(network.sigma), role=("control",) * len(network.points),
        distance_of=np.zeros((0, 2), np.intp), distance=np.zeros((0, 2)),
    )  # fmt: skip


@pytest.mark.parametrize("shape", ["plane", "sphere"])
def test_the_window_before_each_camera_is_that_of_the_rig(shape: str) -> None:
    """Drawn with a window on the object for each exposure, and without noise, nothing is left."""
    network = wet(shape=shape, noise=0.0)
    result = adjust_network(network).required()
    assert np.abs(result.residuals).max() < 1e-6
    assert result.rig is not None
    assert np.abs(result.rig.base - [base for _, base in PLACES[1:]]).max() < 1e-4
    assert len(result.misses_windows) == 0


@pytest.mark.parametrize(
    "window", [surface("plane", FREE), surface("plane"), surface("sphere", ("X", "radius"))]
)
def test_the_gradient_by_places_and_window_is_that_of_the_cost(window: Window) -> None:
    network = held(wet(0, window, shape=window.shape))
    fit = problem_of(network)[0].adjusted()
    assert fit
    linear, constraints = fit.linear, fit.linear.system.constraints
    assert constraints is not None
    normal = normal_of(linear, 0.0)
    own = normal.constrained()
    rng = np.random.default_rng(1)
    scale = 1.0 / np.sqrt(np.diagonal(own.matrix))
    q = rng.normal(size=len(scale)) * scale

    def stepped(by: float) -> Array:
        """Weighted misfits after a part of the step."""
        from reseau.bundle.solver.values import Correction

        step = Correction(own.back @ (by * q), np.zeros_like(linear.values.xyz), 0.0, 0.0, by * q)
        moved = linear.values.moved(linear.system.unknowns, step, constraints)
        return linear.system.misfits(moved)[0]

    h = 1e-3
    slope = (stepped(h) - stepped(-h)) / (2 * h)
    # JᵀJ q by differences is the matrix of the normal equations times q: of every unknown.
    assert float((slope**2).sum()) == pytest.approx(float(q @ own.matrix @ q), rel=1e-5)
    assert float((slope * linear.misfits).sum()) == pytest.approx(float(own.gradient @ q), abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [12, pytest.param(100, marks=pytest.mark.slow)])
def test_errors_of_the_window_and_places_have_their_covariances(seeds: int) -> None:
    window, places, sigma0 = [], [], []
    for seed in range(seeds):
        start = surface("plane", FREE, distance=DISTANCE + 5.0, tilt_X=0.0, tilt_Y=0.0)
        result = adjust_network(wet(seed, start)).required()
        found, rig = result.refraction, result.rig
        assert found is not None
        assert rig is not None
        error = found.values - [*TILTS, DISTANCE]
        window.append(error @ np.linalg.solve(found.covariance, error) / 3)
        for k, (_, base) in enumerate(PLACES[1:]):
            error = rig.base[k] - base
            places.append(error @ np.linalg.solve(rig.cov[k, 3:, 3:], error) / 3)
        sigma0.append(result.sigma0)
    # A mean of N squares of three coordinates is 1 ± √(2/3N); four of these sigmas.
    bound = 4 * np.sqrt(2 / (3 * seeds))
    assert np.mean(window) == pytest.approx(1.0, abs=bound)
    assert np.mean(places) == pytest.approx(1.0, abs=bound)
    assert np.mean(sigma0) == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_the_same_without_poses() -> None:
    network = wet(0, surface("plane", FREE))
    cold = replace(
        network, x0=np.full_like(network.x0, np.nan), rotation=np.full_like(network.rotation, np.nan)
    )
    one, other = (adjust_network(each).required() for each in (network, cold))
    assert other.refraction is not None
    assert np.abs(one.refraction.values - other.refraction.values).max() < 1e-3  # type: ignore[union-attr]


@pytest.mark.slow
def test_images_not_taken_at_once_are_left_out_where_the_window_is_on_the_rig() -> None:
    """The window was somewhere else before them."""
    network = wet(0, surface("plane", FREE))
    x0 = network.x0.copy()
    rows = network.image_of == 4
    xy = network.xy.copy()
    xy[rows] += [60.0, -40.0]
    x0[4] = np.nan
    odd = replace(network, xy=xy, x0=x0, rotation=np.where(np.isfinite(x0), network.rotation, np.nan))
    result = adjust_network(odd, Options(outliers="reject")).required()
    assert any("were not taken at once" in note.text and "left out" in note.text for note in result.warnings)
    assert result.refraction is not None
    assert (np.abs(result.refraction.values - [*TILTS, DISTANCE]) < 5 * result.refraction.sigma).all()


def test_one_camera_of_the_rig_has_it_as_a_port() -> None:
    """With the first camera alone, the window of the rig is one of the camera."""
    network = wet(0, surface("plane", FREE))
    first = network.select(network.camera_of[network.image_of] == 0)
    assert first.refraction is not None
    port = replace(first.refraction.windows[0], on="camera")
    other = replace(first, refraction=replace(first.refraction, windows=(port,)), rig=None)
    one, two = (adjust_network(each).required() for each in (first, other))
    assert one.refraction is not None
    assert two.refraction is not None
    assert np.abs(one.refraction.values - two.refraction.values).max() < 1e-5
    assert np.abs(one.refraction.sigma / two.refraction.sigma - 1).max() < 1e-6


def test_a_free_network_keeps_the_scale_of_a_known_window() -> None:
    """The datum: a known distance of the water determines the scale; a free one does not."""
    network = replace(
        wet(0), datum="free", role=("tie",) * 42, sigma=np.full((42, 3), np.nan),
        distance_of=np.zeros((0, 2), np.intp), distance=np.zeros((0, 2)),
    )  # fmt: skip
    result: Result = adjust_network(network).required()
    assert "scale" not in result.fit.freedom.names
    bars = replace(
        network, distance_of=np.array([[0, 41]]),
        distance=np.array([[np.linalg.norm(network.xyz[0] - network.xyz[41]), 0.01]]),
    )  # fmt: skip
    assert bars.refraction is not None
    free = replace(bars, refraction=replace(bars.refraction, windows=(surface("plane", FREE),)))
    one = adjust_network(free).required()
    assert one.refraction is not None
    error = one.refraction.values - [*TILTS, DISTANCE]
    assert (np.abs(error) < 5 * one.refraction.sigma).all()


def test_a_window_on_a_rig_is_written_and_read() -> None:
    network = wet(0, surface("plane", FREE))
    assert network.refraction is not None
    entry = RefractionEntry.model_validate_json(
        RefractionEntry.of(network.refraction, network.images).model_dump_json()
    )
    cameras = tuple(network.cameras[c].id for c in network.camera_of)
    again = replace(network, refraction=entry.refraction(network.images, cameras))
    assert again.refraction is not None
    assert again.refraction.windows[0].on == "rig"
    one, other = (adjust_network(each).required().refraction for each in (network, again))
    assert np.abs(one.values - other.values).max() < 1e-8  # type: ignore[union-attr]


def test_the_axes_of_the_rig_must_be_those_of_its_first_camera() -> None:
    network = wet(0)
    without = network.select(network.camera_of[network.image_of] > 0)
    found = problem_of(without)[0].adjusted()
    assert not found
    assert found.code == "prerequisite-missing"  # type: ignore[union-attr]
    assert "window on the rig is given in its axes" in str(found)


def test_without_exposures_a_window_on_a_rig_is_refused() -> None:
    with pytest.raises(UsageError, match="no `exposure`"):
        replace(wet(), rig=None)


def test_a_window_of_the_camera_comes_before_that_of_the_rig() -> None:
    port = Window("port", "plane", "camera", {"distance": 5.0}, ("water", "air"))
    with pytest.raises(UsageError, match="is on the camera, but behind surface, which is on the rig"):
        Refraction((AIR, WATER), (surface("plane"), port), ((0, 1),), np.zeros(1, np.intp))
