"""Uncertainty of the projection over the image, and differences of calibrations: covered by Monte Carlo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.bundle import Result, adjust_network, calibration_of
from reseau.bundle.diagnostics.fields import camera_mapping, projection_field_at
from reseau.calibration import CameraMapping, FieldDifference, calibration_difference, projection_field
from reseau.calibration.camera import Rival
from reseau.core.errors import UsageError

from ..montecarlo import draws, slowly, tolerance
from . import networks


def lens_of(world: networks.World, seed: int, *, formal: bool = False) -> CameraMapping:
    fit = world.problem(world.noisy(seed)).adjusted().required()
    result = Result(world.network, fit, np.zeros(len(world.network.xy), dtype=bool))
    return camera_mapping(result, 0, formal=formal)


def true_lens(world: networks.World) -> CameraMapping:
    mapping = networks.mapping_of(world.network.cameras[0])
    return CameraMapping(mapping, 640, 480, np.zeros(0, dtype=np.intp), np.zeros((0, 0)))


def differences(count: int, *, formal: bool) -> list[FieldDifference]:
    world = networks.world(points=40, datum="free", control=0)
    truth = true_lens(world)
    return [calibration_difference(lens_of(world, seed, formal=formal), truth, 5) for seed in range(count)]


@pytest.fixture(scope="module", params=[75, pytest.param(400, marks=pytest.mark.slow)])
def against_truth(request: pytest.FixtureRequest) -> list[FieldDifference]:
    return differences(request.param, formal=False)


def squares(found: list[FieldDifference]) -> np.ndarray:
    return np.array([-np.log(d.p_at) for d in found])


@pytest.mark.slow
def test_normalised_errors_of_the_projection_have_mean_square_one_everywhere() -> None:
    found = differences(400, formal=True)
    mean = squares(found).mean(axis=0)
    assert mean.shape == (4, 5)
    # Two coordinates of each place; the worst of twenty stays within 3.5 standard deviations.
    np.testing.assert_allclose(mean, 1.0, atol=tolerance(2 * len(found)))
    # The mean over places varies as that of six squares.
    assert mean.mean() == pytest.approx(1.0, abs=tolerance(6 * len(found)))


@pytest.mark.slow
def test_errors_that_images_share_by_chance_hardly_widen_the_intervals_of_independent_ones(
    against_truth: list[FieldDifference],
) -> None:
    """The uncertainty is never below the formal one, and above it where residuals look alike."""
    outside = np.mean([(d.p_at < 0.05).mean() for d in against_truth])
    # As many as about three independent places in each.
    chance = 3.5 * np.sqrt(0.05 * 0.95 / (3 * len(against_truth)))
    assert 0.03 - chance < outside < 0.05 + chance


@pytest.mark.slow
@draws(40, 200)
def test_two_independent_calibrations_differ_as_their_covariances_predict(runs: int) -> None:
    world = networks.world(points=40, datum="free", control=0)
    lenses = [lens_of(world, 1000 + seed, formal=True) for seed in range(2 * runs)]
    found = [calibration_difference(a, b, 5) for a, b in zip(lenses[::2], lenses[1::2], strict=True)]
    assert squares(found).mean() == pytest.approx(1.0, abs=tolerance(6 * runs))
    # Only all draws show a factor of 1.3 of the statistic, which has two degrees of freedom.
    assert np.mean([d.statistic / d.degrees for d in found]) == pytest.approx(
        1.0, abs=3.5 * np.sqrt(2 / min(d.degrees for d in found) / runs)
    )


def test_a_lens_that_changed_is_found_significant() -> None:
    world = networks.world(points=40, datum="free", control=0)
    before = lens_of(world, 5)
    other = networks.camera()
    values = other.values.copy()
    values[3] += 1e-3
    changed = networks.world(points=40, datum="free", control=0, cameras=(replace(other, values=values),))
    found = calibration_difference(before, lens_of(changed, 6))
    assert found.p < 1e-6
    assert np.nanmin(found.p_at) < 1e-6
    cov = found.cov.copy()
    cov[0, 0] = np.nan  # no ray is imaged there
    assert np.flatnonzero(np.isnan(replace(found, cov=cov).p_at)).tolist() == [0]


def test_where_the_model_is_open_a_difference_is_as_probable_as_the_pairs_of_models_make_it() -> None:
    world = networks.world(points=40, datum="free", control=0)
    lens, other = lens_of(world, 5), lens_of(world, 7)
    off = replace(lens, mapping=lens.mapping.with_values({"c": 8.1}))
    assert calibration_difference(off, other).p < 1e-6
    # The right model had a probability of 0.2.
    found = calibration_difference(replace(off, rivals=(Rival(0.2, lens),)), other)
    alike = calibration_difference(lens, other)
    assert found.p == pytest.approx(0.2 * alike.p, abs=1e-6)
    assert (found.p_at >= 0.2 * alike.p_at).all()
    assert found.p_alone < 1e-6
    # One that is hardly probable does not make a difference more probable than it is.
    assert calibration_difference(replace(lens, rivals=(Rival(0.2, off),)), other).p == alike.p


def test_a_rotation_compensated_by_the_principal_point_is_no_difference() -> None:
    """Of a lens without distortion a small shift of the image is a tilt but for the squares of directions."""
    plain = networks.camera()
    values = np.array([8.0] + 9 * [0.0])
    lens = true_lens(networks.world(cameras=(replace(plain, values=values),)))
    shifted = replace(lens, mapping=lens.mapping.with_values({"x0": 0.008, "y0": -0.008}))
    found = calibration_difference(lens, shifted)
    # The shift is 1.13 px; its second-order part at u = 0.4, v = 0.3 is a quarter of it at most.
    assert 0.01 < np.hypot(*found.difference.reshape(-1, 2).T).max() < 0.25 * 1.13
    assert abs(found.rotation[0]) == pytest.approx(abs(found.rotation[1]), rel=0.1)
    assert abs(found.rotation[1]) == pytest.approx(0.001, abs=2e-4)


def test_uncertainty_is_larger_where_there_are_no_points() -> None:
    world = networks.world(points=40)
    network = world.network
    left = network.select(network.xy[:, 0] < 400)
    result = adjust_network(left)
    assert isinstance(result, Result)
    sigma = projection_field(camera_mapping(result, 0), 9).sigma
    assert sigma[:, -1].max() > 2 * sigma[:, 2].max()


@pytest.mark.parametrize("per", ["camera", "group"])
def test_the_field_of_additional_parameters_has_derivatives_of_its_mapping(per: str) -> None:
    world = networks.world(points=40, cameras=(networks.with_ebner(per),), images=8)
    result = adjust_network(world.noisy(0))
    assert isinstance(result, Result)
    lens = camera_mapping(result, 0, None if per == "camera" else "group g1")
    mapping, uv, step = lens.mapping, np.array([[0.1, -0.2], [-0.25, 0.15]]), 1e-6
    given = mapping.derivatives(uv)
    for k, value in enumerate(mapping.values):
        up, down = mapping.values.copy(), mapping.values.copy()
        up[k], down[k] = value + step, value - step
        numeric = (mapping.with_values(up)(uv) - mapping.with_values(down)(uv)) / (2 * step)
        np.testing.assert_allclose(given.d_parameters[:, :, k], numeric, atol=1e-4)
    np.testing.assert_allclose(mapping.inverse(mapping(uv)), uv, atol=1e-10)
    assert np.isfinite(projection_field(lens, 5).sigma).all()


def test_one_of_several_sets_must_be_named() -> None:
    world = networks.world(points=40, cameras=(networks.with_ebner("group"),), images=8)
    result = adjust_network(world.noisy(0))
    assert isinstance(result, Result)
    with pytest.raises(UsageError, match="not a set of additional parameters"):
        camera_mapping(result, 0)


def test_a_calibration_file_gives_the_field_of_the_adjustment() -> None:
    result = adjust_network(networks.world(points=40).noisy(1))
    assert isinstance(result, Result)
    direct = camera_mapping(result, 0)
    read = CameraMapping.from_calibration(calibration_of(result, "cam", name="cam"))
    np.testing.assert_allclose(
        projection_field(read).sigma, projection_field(direct).sigma, atol=1e-12, rtol=1e-9
    )


@pytest.mark.slow
@pytest.mark.parametrize("datum", [*slowly("control"), "free"])
@pytest.mark.parametrize("distance", [3.0, 40.0])
def test_normalised_errors_at_a_distance_have_mean_square_one(datum: str, distance: float) -> None:
    """Points before the camera, carried into object space by the true poses and back by the estimates."""
    world = networks.world(points=40, datum=datum, control=0 if datum == "free" else 6)
    network, n = world.network, 4
    mapping = networks.mapping_of(network.cameras[0])
    xy = np.stack(np.meshgrid(np.linspace(0, 639, n), np.linspace(0, 479, 3)), axis=-1).reshape(-1, 2)
    ray = np.column_stack([mapping.inverse(xy), np.ones(len(xy))])
    p = distance * ray / np.linalg.norm(ray, axis=1, keepdims=True)
    found = []
    for seed in range(60):
        fit = world.problem(world.noisy(seed)).adjusted().required()
        values = fit.values
        back = [
            (p @ world.rotation[i] + world.x0[i] - values.x0[i]) @ values.rotation[i].T
            for i in range(len(network.images))
        ]
        there = np.mean(back, axis=0)
        estimate = mapping.with_values(values.cameras[0, : len(mapping.names)])
        off = estimate(there[:, :2] / there[:, 2:]) - xy
        result = Result(network, fit, np.zeros(len(network.xy), dtype=bool))
        field = projection_field_at(result, 0, distance, across=n, down=3)
        cov = field.cov.reshape(-1, 2, 2) / fit.variance
        found.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(cov), off) / 2)
    mean = np.mean(found, axis=0)
    # Of 60 normalised errors of two coordinates: 1/√60 = 0.13; the places know of each other.
    np.testing.assert_allclose(mean, 1.0, atol=3.5 * 0.13)
    assert mean.mean() == pytest.approx(1.0, abs=3 * 0.13 / 2)


def test_a_distance_that_is_not_positive_is_refused() -> None:
    world = networks.world(points=20, datum="free", control=0)
    fit = world.problem(world.noisy(0)).adjusted().required()
    result = Result(world.network, fit, np.zeros(len(world.network.xy), dtype=bool))
    with pytest.raises(UsageError, match="not positive"):
        projection_field_at(result, 0, 0.0)
