"""Adjustment of networks whose rays pass windows and media."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reseau.adjust import Options
from reseau.bundle import Result, Stage, adjust_network, problem_of
from reseau.bundle.solver.problem import BundleFit
from reseau.core.errors import UsageError
from reseau.optics.refraction import Window
from reseau.optics.refraction.windows import Refraction, RefractiveIndex

from ..montecarlo import slowly
from . import cavity, networks

# Figures of README.txt of the data, and those of the fits of single cameras, px.
STORED = (43, 0.496), (42, 0.780), (71, 0.761), (71, 0.741)
SINGLE = 0.494, 0.299, 0.379, 0.292


@pytest.fixture
def folder(reference_data: Callable[[str], Path]) -> Path:
    return reference_data("multimedia_cavity")


@pytest.mark.slow
def test_the_stored_calibration_of_the_cavity_is_reproduced(folder: Path) -> None:
    network = cavity.cavity(folder)
    off = cavity.misfits(network)
    for k, (count, rms) in enumerate(STORED):
        rows = network.image_of == k
        assert int(rows.sum()) == count
        assert float(np.sqrt((off[rows] ** 2).mean())) == pytest.approx(rms, abs=5e-4)


@pytest.mark.slow
def test_cameras_of_the_cavity_adjusted_jointly_agree_with_each_by_itself(folder: Path) -> None:
    network = cavity.cavity(folder, cavity.INTERIOR + cavity.ADDITIONAL)
    joint = problem_of(network)[0].adjusted()
    assert isinstance(joint, BundleFit)
    v = joint.residuals[: 2 * len(network.xy)].reshape(-1, 2)
    for k, bound in enumerate(SINGLE):
        single = problem_of(cavity.of_camera(network, k))[0].adjusted()
        assert isinstance(single, BundleFit)
        assert single.sigma0 <= bound
        rows = network.image_of == k
        np.testing.assert_allclose(v[rows].ravel(), single.residuals, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_two_cameras_determine_the_window_before_them(folder: Path) -> None:
    """Their images reject the given distances of the windows: F-test of two more parameters."""
    found = []
    for free in ((), ("distance",)):
        fit = problem_of(cavity.cavity(folder, cavity.INTERIOR, free))[0].adjusted()
        assert isinstance(fit, BundleFit)
        found.append(fit)
    assert (found[0].cost - found[1].cost) / 2 / found[1].sigma0 ** 2 > 5.0
    back = found[1].values.refraction[found[1].unknowns.refracting][1]
    assert back == pytest.approx(-183.4, abs=0.1)


KINDS = tuple(networks.WINDOWS)
LENS = (networks.camera("opencv", ("fx", "fy", "cx", "cy", "k1")),)
# A camera that is calibrated in air but for one parameter: behind a port, the others are hardly determined.
CALIBRATED = (networks.camera("opencv", ("k1",)),)
# Parameters of each arrangement that its images determine well.
FREE = {
    "plane port": ("tilt_X of port", "tilt_Y of port", "index of water"),
    "dome": ("X of dome", "Y of dome", "Z of dome"),
    "surface of the water": ("tilt_X of surface", "tilt_Y of surface", "distance of surface"),
    "tank wall": ("distance of wall", "index of water"),
    "round tank": ("X of tank", "Y of tank", "radius of tank"),
    "port before a round tank": ("X of tank", "Y of tank", "index of water"),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("control", [8, 25])
def test_approximate_values_are_found_through_windows(kind: str, control: int) -> None:
    for seed in range(2):
        world = networks.refracted(networks.world(seed=seed, control=control, cameras=LENS), kind, free=())
        network = world.noisy(seed)
        problem = networks.by_itself(network)
        assert np.abs(problem.start.x0 - world.x0).max() < 0.03
        fit = problem.adjusted()
        assert isinstance(fit, BundleFit)
        assert fit.sigma0 < 1.2
        assert np.isfinite(fit.residuals).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_errors_of_all_unknowns_are_within_their_covariances(kind: str) -> None:
    cameras = CALIBRATED if networks.WINDOWS[kind][0].on == "camera" else LENS
    world = networks.refracted(networks.world(cameras=cameras, control=8), kind, FREE[kind])
    errors = []
    for seed in range(12):
        fit = world.problem(world.noisy(seed)).adjusted(Options(scale="a-priori"))
        assert isinstance(fit, BundleFit)
        refraction = world.network.refraction
        assert refraction is not None
        at = fit.unknowns.refraction_columns
        off = (fit.values.refraction - refraction.values)[fit.unknowns.refracting]
        assert len(off) == len(FREE[kind])
        errors.append(off @ np.linalg.solve(fit.cofactors.reduced.full[at, at], off) / len(off))
        for mean in networks.normalised_errors(world, fit).values():
            assert mean < 4.0
    # χ² of 24 or 36 degrees of freedom, between its quantiles 1e-4 and 1 − 1e-4.
    assert 0.3 < np.mean(errors) < 2.4


def with_bars(world: networks.World) -> networks.World:
    bar = np.array([[0, 1], [2, 3], [4, 5]])
    length = np.linalg.norm(world.xyz[bar[:, 0]] - world.xyz[bar[:, 1]], axis=1)
    distance = np.column_stack([length, np.full(3, 1e-4)])
    return replace(world, network=replace(world.network, distance_of=bar, distance=distance))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*slowly("plane port"), "dome"])
def test_a_free_network_behind_ports_takes_its_scale_from_a_distance(kind: str) -> None:
    world = networks.refracted(networks.world(datum="free", control=0, cameras=LENS), kind, free=())
    fit = networks.by_itself(with_bars(world).noisy(0)).adjusted()
    assert isinstance(fit, BundleFit)
    base = np.linalg.norm(fit.values.x0[1] - fit.values.x0[0])
    assert base == pytest.approx(np.linalg.norm(world.x0[1] - world.x0[0]), abs=0.01)
    # From seed 2 the dome leads to a small false network in which the scale seems good to 2 %.
    for seed in (0, 2):
        alone = networks.by_itself(world.noisy(seed)).adjusted()
        assert not alone
        assert "windows determine the scale" in str(alone)


def test_a_window_on_the_object_moves_with_a_free_network() -> None:
    """Nothing but the window is known: after the adjustment it lies before the points as in truth."""
    base = networks.world(datum="free", control=0, cameras=LENS)
    free = tuple(f"{name} of wall" for name in ("tilt_X", "tilt_Y", "distance"))
    world = with_bars(networks.refracted(base, "tank wall", free))
    fit = world.problem(world.noisy(0)).adjusted()
    assert isinstance(fit, BundleFit)
    assert fit.freedom.defect == 6
    refraction = world.network.refraction
    assert refraction is not None
    off = (fit.values.refraction - refraction.values)[fit.unknowns.refracting]
    at = fit.unknowns.refraction_columns
    sigma = np.sqrt(np.diag(fit.cofactors.reduced.full)[at])
    assert (np.abs(off) < 4.5 * sigma).all()
    assert (sigma < 0.05).all()


def test_an_observed_parameter_keeps_its_sigma_where_images_say_little() -> None:
    free, sigma = ("thickness of port",), {"thickness of port": 1e-5}
    world = networks.refracted(networks.world(cameras=LENS), "plane port", free, sigma)
    fit = world.problem(world.noisy(0)).adjusted(Options(scale="a-priori"))
    assert isinstance(fit, BundleFit)
    at = fit.unknowns.refraction
    assert np.sqrt(fit.cofactors.reduced.full[at, at]) == pytest.approx(1e-5, rel=0.01)
    assert len(fit.residuals) == 2 * len(world.network.xy) + 1


def test_what_images_cannot_determine_is_named() -> None:
    """The distance of a plate in one medium has no effect on any ray."""
    media = ("air", "glass", "air")
    plate = Window("plate", "plane", "camera", {"distance": 0.05, "thickness": 0.02}, media, ("distance",))
    world = networks.world(cameras=LENS)
    indices = (RefractiveIndex("air", 1.0), RefractiveIndex("glass", 1.5))
    network = replace(world.network, refraction=Refraction(indices, (plate,), ((0,),), np.zeros(6, np.intp)))
    failure = world.problem(network).adjusted()
    assert not failure
    assert str(failure) == (
        "rank defect 1: no ray depends on distance of plate; window plate has air on both sides, where rays "
        "are parallel: images from one side do not determine where along them it stands"
    )


def test_what_windows_leave_undetermined_is_reported_with_the_element_and_the_cause() -> None:
    free = ("index of air", "index of glass", "index of water")
    world = networks.refracted(networks.world(cameras=CALIBRATED, control=25), "plane port", free)
    failure = world.problem(world.noisy(0)).adjusted()
    assert not failure
    assert str(failure).startswith(
        "rank defect 1: rays depend on the ratios of the indices of air, glass and water"
    )


def test_a_window_that_noise_alone_determines_is_reported_with_the_element() -> None:
    """Distance, thickness and index together: seen from one side, a pane shifts rays as another one does."""
    free = ("thickness of port", "distance of port", "index of glass")
    world = networks.refracted(networks.world(cameras=CALIBRATED, control=25), "plane port", free)
    result = adjust_network(world.noisy(0))
    said = " ".join(remark.text for remark in result.warnings) if isinstance(result, Result) else str(result)
    assert re.search("images from one side (hardly|do not) determine .*thickness of (window )?port", said)
    assert "give it a sigma" in said


def test_windows_that_are_not_between_cameras_and_points_are_named() -> None:
    """A free network has its own coordinate system: the wall is given in another one."""
    base = networks.world(datum="free", control=0, cameras=LENS)
    world = with_bars(networks.refracted(base, "tank wall", ("distance of wall",)))
    network = world.noisy(0)
    refraction = network.refraction
    assert refraction is not None
    (wall,) = refraction.windows
    far = replace(refraction, windows=(replace(wall, values={**wall.values, "distance": 50.0}),))
    failure = adjust_network(replace(network, refraction=far))
    assert not failure
    assert "no ray depends on distance of wall" in str(failure)
    assert "must lie between cameras and points" in str(failure)


def test_a_point_before_the_window_is_computed_as_in_air_and_named() -> None:
    base = networks.world(cameras=LENS)
    base.xyz[24] = [0.1, 0.2, 1.5]
    world = networks.refracted(base, "surface of the water", ())
    result = adjust_network(world.noisy(0))
    assert isinstance(result, Result)
    assert result.sigma0 < 1.2
    remarks = [remark.text for remark in result.warnings]
    assert any("no ray through the windows leads to points p24 in image" in text for text in remarks)


def test_correlated_parameters_of_windows_are_reported_with_their_partners() -> None:
    free = ("distance of port", "index of water")
    world = networks.refracted(networks.world(cameras=CALIBRATED, control=25), "plane port", free)
    result = adjust_network(world.noisy(0))
    assert isinstance(result, Result)
    assert result.refraction is not None
    assert result.refraction.parameters == free
    for k, (partner, r) in enumerate(result.refraction.partners):
        pair = result.covariance_of(free[k], partner)
        assert r == pytest.approx(pair[0, 1] / np.sqrt(pair[0, 0] * pair[1, 1]), abs=1e-9)
    assert not any(test.significant and test.p < 1e-3 for test in result.refraction.tests)


def test_a_camera_by_its_mapping_gives_the_same_result_as_the_registered_one() -> None:
    world = networks.refracted(networks.world(cameras=LENS), "dome", FREE["dome"])
    network = world.noisy(0)
    mapped = replace(network, cameras=(replace(networks.mapped(network.cameras[0]), free=LENS[0].free),))
    fits = [world.problem(net).adjusted() for net in (network, mapped)]
    assert isinstance(fits[0], BundleFit)
    assert isinstance(fits[1], BundleFit)
    at = fits[0].unknowns.refraction_columns
    sigma = np.sqrt(np.diag(fits[0].cofactors.reduced.full)[at])
    off = (fits[0].values.refraction - fits[1].values.refraction)[fits[0].unknowns.refracting]
    # Both end at the minimum within the tolerance of the iteration, which is a part of the sigmas.
    np.testing.assert_allclose(off / sigma, 0.0, rtol=0, atol=1e-4)
    assert fits[0].sigma0 == pytest.approx(fits[1].sigma0, abs=1e-9)


def test_a_stage_does_not_move_a_window_on_the_object() -> None:
    world = networks.refracted(networks.world(images=2), "tank wall")
    stage = Stage(np.zeros(2, np.intp), np.array([0.0, 0.1]), 0.01, np.array([0.0, 0.0, 1.0]), 1e-3)
    with pytest.raises(UsageError, match="stage"):
        replace(world.network, stage=stage)
