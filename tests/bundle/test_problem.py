"""The sparse adjustment against the dense engine, against published results, and against simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.stats

from reseau.adjust import GaussMarkov, Parameters, adjust
from reseau.adjust import Options as AdjustOptions
from reseau.adjust.parameters import Prior
from reseau.bundle import Network, Options, Result, adjust_network
from reseau.bundle.diagnostics.checks import checks
from reseau.bundle.solver.orthogonal import cofactors_from_rows
from reseau.bundle.solver.problem import BundleFit, BundleProblem, _Run
from reseau.bundle.solver.system import residuals
from reseau.core.data import Array
from reseau.core.errors import UsageError
from reseau.core.failure import Code, Failure
from reseau.optics.poses import Pose, matrix_to_vector, project, rotation_matrix

from . import networks

TOLERANCE = {"tolerance": 1e-10}


def required(problem: BundleProblem) -> BundleFit:
    fit = problem.adjusted()
    assert isinstance(fit, BundleFit), fit
    return fit


def dense_twin(world: networks.World, network: Network) -> Any:
    """The same network given to the dense engine, with optics' projection and numeric derivatives."""
    cam = network.cameras[0]
    names = [*cam.free]
    start = [cam.parameters[name] for name in cam.free]
    for i, name in enumerate(network.images):
        names += [f"{name}.{k}" for k in range(6)]
        start += [*matrix_to_vector(world.rotation[i]), *world.x0[i]]
    unknown = ~network.held
    at = np.argwhere(unknown)
    names += [f"{network.points[j]}.{axis}" for j, axis in at]
    start += [world.xyz[j, axis] for j, axis in at]

    def computed(x: Array) -> Array:
        f, m = len(cam.free), len(network.images)
        mapping = networks.mapping_of(cam).with_values(dict(zip(cam.free, x[:f], strict=True)))
        pose = x[f : f + 6 * m].reshape(m, 6)
        xyz = world.xyz.copy()
        xyz[unknown] = x[f + 6 * m :]
        rows = network.image_of
        xy = project(mapping, Pose(pose[rows, :3], pose[rows, 3:]), xyz[network.point_of]).xy
        ends = network.distance_of
        length = np.linalg.norm(xyz[ends[:, 0]] - xyz[ends[:, 1]], axis=1)
        return np.concatenate([xy.ravel(), length])

    prior_names, prior_values, prior_sigma = [], [], []
    for j, axis in np.argwhere(network.observed):
        prior_names.append(f"{network.points[j]}.{axis}")
        prior_values.append(network.xyz[j, axis])
        prior_sigma.append(network.sigma[j, axis])
    for name, sigma in cam.sigma.items():
        prior_names.append(name)
        prior_values.append(cam.parameters[name])
        prior_sigma.append(sigma)
    observed = np.concatenate([network.xy.ravel(), network.distance[:, 0]])
    prior = Prior(prior_names, prior_values, prior_sigma) if prior_names else None
    return adjust(
        GaussMarkov(
            computed, observed, [network.cov, network.distance[:, 1]], Parameters(names, start, prior=prior)
        ),
        AdjustOptions(tolerance=1e-7),
    ).required()


def mixed() -> networks.World:
    """Held, partly observed and free coordinates, an observed camera parameter, two distances."""
    cam = networks.camera(free=("c", "x0", "y0", "K1"), sigma={"x0": 0.01})
    world = networks.world(images=4, points=12, cameras=(cam,), control=4, sigma_px=0.2)
    network = world.network
    sigma = network.sigma.copy()
    sigma[1] = [0.002, 0.002, np.nan]
    sigma[2] = [np.nan, np.nan, 0.003]
    sigma[3] = [0.0, 0.001, np.nan]
    xyz = network.xyz.copy()
    xyz[:4] = world.xyz[:4]
    ends = np.array([[0, 8], [9, 10]])
    length = np.linalg.norm(world.xyz[ends[:, 0]] - world.xyz[ends[:, 1]], axis=1)
    distance = np.column_stack([length, [0.003, 0.001]])
    return replace(world, network=replace(network, sigma=sigma, xyz=xyz, distance_of=ends, distance=distance))


@pytest.mark.slow
def test_the_dense_engine_gives_the_same_estimates_and_statistics() -> None:
    world = mixed()
    network = world.noisy(3)
    fit, twin = required(world.problem(network, **TOLERANCE)), dense_twin(world, network)
    assert fit.redundancy == twin.redundancy
    assert fit.sigma0 == pytest.approx(twin.sigma0, rel=1e-9)
    cam = network.cameras[0]
    ours = fit.values.cameras[0, [cam.names.index(name) for name in cam.free]]
    np.testing.assert_allclose(ours, [twin[name] for name in cam.free], rtol=1e-7, atol=1e-9)
    free = ~network.held
    points = [f"{network.points[j]}.{axis}" for j, axis in np.argwhere(free)]
    np.testing.assert_allclose(fit.values.xyz[free], [twin[name] for name in points], rtol=0, atol=1e-9)
    for i, name in enumerate(network.images):
        rotation = rotation_matrix([twin[f"{name}.{k}"] for k in range(3)])
        np.testing.assert_allclose(fit.values.rotation[i], rotation, rtol=0, atol=1e-9)
    at = fit.unknowns.camera[0]
    mine = np.diag(fit.cofactors.reduced.full)[at : at + len(cam.free)]
    theirs = [twin.cofactor[twin.index(name), twin.index(name)] for name in cam.free]
    np.testing.assert_allclose(mine, theirs, rtol=1e-6)
    j = 7
    block = twin.covariance_of(*[f"p{j}.{axis}" for axis in range(3)], scaled=False)
    np.testing.assert_allclose(fit.cofactors.points[j], block, rtol=0, atol=1e-6 * np.abs(block).max())


@pytest.mark.slow
def test_the_dense_engine_gives_the_same_reliability_of_every_observation() -> None:
    world = mixed()
    network = world.noisy(3)
    fit, twin = required(world.problem(network, **TOLERANCE)), dense_twin(world, network)
    n = 2 * len(network.xy) + len(network.distance)
    np.testing.assert_allclose(fit.redundancy_numbers[:n], twin.redundancy_numbers, rtol=0, atol=1e-7)
    np.testing.assert_allclose(fit.w[:n], twin.w, rtol=0, atol=1e-5)
    mine, theirs = fit.minimal_detectable_errors()[:n], twin.minimal_detectable_errors()
    np.testing.assert_allclose(mine, theirs, rtol=1e-5)
    np.testing.assert_allclose(fit.external_lengths()[:n], twin.external_lengths(), rtol=1e-4)
    # Observed coordinates first, then the observed camera parameter, as the twin's prior has them.
    np.testing.assert_allclose(
        fit.redundancy_numbers, twin.standardised.redundancy_numbers, rtol=0, atol=1e-7
    )
    np.testing.assert_allclose(fit.w, twin.standardised.w, rtol=0, atol=1e-5)


@pytest.mark.slow
def test_the_joint_covariance_of_any_unknowns_is_that_of_the_dense_engine() -> None:
    world = mixed()
    network = world.noisy(3)
    result = adjust_network(network, Options(tolerance=1e-10))
    assert isinstance(result, Result)
    twin = dense_twin(world, network)
    # Point p8 takes part in a distance and is not eliminated, p5 and p6 are; p3 is held in X.
    names = [
        "c of camera cam", "X of point p5", "Z of point p6", "Y of point p8", "Y0 of image i2",
        "X of point p3"
    ]  # fmt: skip
    theirs = twin.covariance_of("c", "p5.0", "p6.2", "p8.1", "i2.4")
    mine = result.covariance_of(*names)
    size = np.sqrt(np.diag(theirs))
    np.testing.assert_allclose(mine[:5, :5] / np.outer(size, size), theirs / np.outer(size, size), atol=1e-6)
    assert not mine[5].any()
    with pytest.raises(UsageError, match="c of camera none"):
        result.covariance_of("c of camera none")


def test_the_joint_covariance_of_a_free_network_agrees_with_that_of_its_points() -> None:
    world = networks.world(datum="free", control=0)
    result = adjust_network(world.noisy(2))
    assert isinstance(result, Result)
    names = [f"{axis} of point p{j}" for j in (3, 9) for axis in "XYZ"]
    joint = result.covariance_of(*names)
    np.testing.assert_allclose(joint[:3, :3], result.point_covariance[3], rtol=0, atol=1e-12)
    np.testing.assert_allclose(joint[3:, 3:], result.point_covariance[9], rtol=0, atol=1e-12)
    # Inner constraints over all points: the mean of the corrections is nothing, so its variance is nothing.
    every = [f"X of point p{j}" for j in range(25)]
    assert abs(result.covariance_of(*every).sum()) < 1e-12


@pytest.mark.parametrize("datum", ["control", "minimal", "free"])
@pytest.mark.parametrize("model", networks.BATTERY)
def test_redundancy_numbers_sum_to_the_redundancy(datum: str, model: str) -> None:
    cam = networks.BATTERY[model]
    world = networks.world(images=8, datum=datum, cameras=(cam,), control=5 if datum == "control" else 0)
    fit = required(world.problem(world.noisy(1)))
    assert fit.redundancy_numbers.sum() == pytest.approx(fit.redundancy, abs=1e-6)
    assert fit.counts[2] == (0 if datum == "control" else 7)
    assert 0.7 < fit.sigma0 < 1.3


@pytest.mark.parametrize("model", networks.BATTERY)
def test_estimates_are_within_their_covariances_of_the_truth(model: str) -> None:
    """Parameters of every camera, one network: χ² of the errors within its bounds of 1e-4."""
    cam = networks.BATTERY[model]
    world = networks.world(images=8, points=40, cameras=(cam,))
    fit = required(world.problem(world.noisy(2)))
    result = Result(world.network, fit, np.zeros(len(world.network.xy), dtype=bool))
    names, _, values = result.camera_columns(0)
    true = np.array([cam.parameters.get(name, 0.0) for name in names])
    off = values - true
    covariance = result.formal_camera_covariance(0) / fit.variance
    square = float(off @ np.linalg.solve(covariance, off))
    assert scipy.stats.chi2.sf(square, len(off)) > 1e-4
    assert scipy.stats.chi2.cdf(square, len(off)) > 1e-4


def test_parameters_per_image_are_estimated_for_their_image() -> None:
    """Image-variant: every image with twelve parameters of its own, bent by another of them."""
    cam = networks.with_ebner("image")
    world = networks.world(images=6, points=60, cameras=(cam,), control=30)
    problem = world.problem()
    true = np.random.default_rng(4).normal(0, 2e-3, (6, 12))
    system = _Run(problem, AdjustOptions()).system
    start = replace(problem.start, extra=true)
    seen = residuals(world.network, system.unknowns, np.arange(len(world.network.xy)), start)
    bent = replace(world, network=replace(world.network, xy=world.network.xy + seen))
    fit = required(bent.problem(bent.noisy(5)))
    assert 0.9 < fit.sigma0 < 1.1
    result = Result(bent.network, fit, np.zeros(len(bent.network.xy), dtype=bool))
    names, _, values = result.camera_columns(0)
    assert len(names) == 72
    assert names[12] == "b1 of image i1"
    off = values - true.ravel()
    square = float(off @ np.linalg.solve(result.formal_camera_covariance(0) / fit.variance, off))
    assert 1e-3 < scipy.stats.chi2.sf(square, 72) < 1 - 1e-3


def test_an_observed_interior_orientation_is_pulled_towards_the_observation() -> None:
    """With a sigma far below what the images tell the estimate is the observation; far above, theirs."""
    world = networks.world()
    network, cam = world.noisy(1), world.network.cameras[0]
    shifted = replace(cam, values=cam.values + np.eye(10)[1] * 0.02)
    alone = required(world.problem(network, **TOLERANCE))
    found = {}
    for sigma in (1e-7, 1e3):
        observed = replace(network, cameras=(replace(shifted, sigma={"x0": sigma}),))
        fit = required(world.problem(observed, **TOLERANCE))
        assert fit.counts[0] == alone.counts[0] + 1
        assert fit.redundancy_numbers.sum() == pytest.approx(fit.redundancy, abs=1e-6)
        found[sigma] = fit.values.cameras[0, 1]
    assert found[1e-7] == pytest.approx(shifted.values[1], abs=1e-6)
    assert found[1e3] == pytest.approx(alone.values.cameras[0, 1], abs=1e-6)


@pytest.mark.parametrize("model", ["brown-object", "opencv"])
def test_a_mapping_gives_what_the_compiled_camera_gives(model: str) -> None:
    cam = networks.camera(model)
    world = networks.world(cameras=(cam,))
    network = world.noisy(1)
    compiled = required(world.problem(network, **TOLERANCE))
    plain = required(world.problem(replace(network, cameras=(networks.mapped(cam),)), **TOLERANCE))
    assert plain.sigma0 == pytest.approx(compiled.sigma0, rel=1e-9)
    np.testing.assert_allclose(plain.values.xyz, compiled.values.xyz, rtol=0, atol=1e-8)
    np.testing.assert_allclose(plain.redundancy_numbers, compiled.redundancy_numbers, rtol=0, atol=1e-8)


def test_the_mapping_gives_the_measured_point_of_an_image_side_camera() -> None:
    """Residuals of the measured and of the corrected point differ by the stretch of the correction."""
    cam = networks.camera("brown-image")
    world = networks.world(cameras=(cam,))
    network = world.noisy(1)
    corrected = required(world.problem(network, **TOLERANCE))
    measured = required(world.problem(replace(network, cameras=(networks.mapped(cam),)), **TOLERANCE))
    assert measured.redundancy == corrected.redundancy
    assert measured.sigma0 == pytest.approx(corrected.sigma0, rel=0.1)
    assert abs(measured.sigma0 - corrected.sigma0) > 1e-4


def test_the_inverse_from_rows_is_that_of_the_normal_equations() -> None:
    """From the rows of the observations of all kinds, never multiplied out."""
    world = mixed()
    fit = required(world.problem(world.noisy(3), **TOLERANCE))
    held = np.diag(fit.cofactors.reduced.full) == 0
    from_rows = cofactors_from_rows(fit.linear, held).border
    size = np.sqrt(np.diag(from_rows))
    size[held] = 1.0
    np.testing.assert_allclose(
        from_rows / np.outer(size, size), fit.cofactors.reduced.full / np.outer(size, size), rtol=0, atol=1e-8
    )


@pytest.mark.parametrize("seed", range(4))
def test_redundancy_numbers_sum_to_the_redundancy_with_poorly_determined_parameters(seed: int) -> None:
    """Three images and all parameters of the camera: correlations near one."""
    cam = networks.camera(free=("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "B1", "B2"))
    world = networks.world(images=3, points=14, cameras=(cam,), control=4, seed=seed)
    fit = required(world.problem(world.noisy(seed)))
    assert fit.redundancy_numbers.sum() == pytest.approx(fit.redundancy, abs=1e-6)


def test_inner_constraints_have_the_least_trace_over_the_chosen_points() -> None:
    """No other datum gives the chosen points a smaller sum of variances; the images are the same."""
    chosen = np.arange(25) < 10
    world = networks.world(datum="free", control=0)
    network = replace(world.noisy(2), datum_points=chosen)
    inner = required(world.problem(network, **TOLERANCE))
    minimal = required(world.problem(replace(network, datum="minimal"), **TOLERANCE))
    every = required(world.problem(replace(network, datum_points=np.ones(25, bool)), **TOLERANCE))

    def trace(fit: BundleFit) -> float:
        return float(np.trace(fit.cofactors.points[chosen], axis1=1, axis2=2).sum())

    assert trace(inner) < trace(every) < trace(minimal)
    np.testing.assert_allclose(inner.residuals, minimal.residuals, atol=1e-6)
    np.testing.assert_allclose(inner.w, minimal.w, atol=1e-5)
    # G^T (x − x0) = 0 over the chosen: no shift, no rotation, no change of scale.
    off = inner.values.xyz[chosen] - world.xyz[chosen]
    about = inner.values.xyz[chosen] - inner.values.xyz[chosen].mean(axis=0)
    assert np.abs(off.mean(axis=0)).max() < 1e-12
    assert abs(float((off * about).sum())) < 1e-9
    assert np.abs(np.cross(about, off).sum(axis=0)).max() < 1e-9


def test_weak_points_are_left_out_of_the_datum_unless_they_are_chosen() -> None:
    """Two points far behind the others spoil no one's covariance, and are named."""
    world = networks.world(datum="free", control=0, points=26, images=12)
    # Seen by two neighbouring images alone, from nearly the same place.
    x0, rotation, xyz = world.x0.copy(), world.rotation.copy(), world.xyz.copy()
    x0[1] = x0[0] + [0.0, 0.05, 0.0]
    rotation[1] = networks.looking_at(x0[1], np.zeros(3), 0.7)
    along = -x0[0] / np.linalg.norm(x0[0])
    xyz[24], xyz[25] = x0[0] + 30.0 * along + [0.5, 0.0, 1.0], x0[0] + 33.0 * along - [0.4, 0.5, 0.2]
    network = world.network
    cam, keep = network.cameras[0], (network.point_of < 24) | (network.image_of < 2)
    network = network.select(keep)
    xy = np.concatenate(
        [
            networks.image_points(cam, rotation[i], x0[i], xyz[network.point_of[network.image_of == i]])
            for i in range(12)
        ]
    )
    world = networks.World(replace(network, xy=xy), rotation, x0, xyz)
    fit = required(world.problem(world.noisy(3), **TOLERANCE))
    assert fit.datum is not None
    assert np.flatnonzero(~fit.datum).tolist() == [24, 25]
    every = np.ones(26, dtype=bool)
    every[5] = False
    chosen = required(world.problem(replace(world.noisy(3), datum_points=every), **TOLERANCE))
    near = np.arange(24)
    sigma, spoilt = (
        np.sqrt(np.trace(f.cofactors.points[near], axis1=1, axis2=2)).mean() for f in (fit, chosen)
    )
    assert sigma < 0.5 * spoilt
    np.testing.assert_allclose(fit.residuals, chosen.residuals, atol=1e-5)
    assert fit.redundancy_numbers.sum() == pytest.approx(fit.redundancy, abs=1e-6)
    result = Result(world.network, fit, np.zeros(len(xy), dtype=bool))
    assert any("2 weak points left out of the datum: p24, p25" in remark.text for remark in checks(result))


def seen_twice(apart: float) -> networks.World:
    """The last five points are seen from two places only, `apart` metres from each other."""
    whole = networks.world(images=7, datum="free", control=0)
    x0, rotation, network = whole.x0.copy(), whole.rotation.copy(), whole.network
    x0[6] = x0[5] + [0.0, 0.0, apart]
    rotation[6] = networks.looking_at(x0[6], np.zeros(3), 0.3)
    network = network.select((network.point_of < 20) | (network.image_of > 4))
    xy, cam = network.xy.copy(), network.cameras[0]
    rows = network.image_of > 4
    for i in (5, 6):
        own = network.image_of == i
        xy[own] = networks.image_points(cam, rotation[i], x0[i], whole.xyz[network.point_of[own]])
    inside = ~rows | ((xy > 0).all(axis=1) & (xy < [639, 479]).all(axis=1))
    return networks.World(replace(network, xy=xy).select(inside), rotation, x0, whole.xyz)


def test_points_seen_from_one_place_only_are_left_out_before_the_iteration() -> None:
    """An image repeated from the same place, and one from 4 cm beside: there the points are determined."""
    there = seen_twice(1e-5)
    fit = required(there.problem(there.noisy(4), **TOLERANCE))
    assert np.flatnonzero(~fit.usable.points).tolist() == [20, 21, 22, 23, 24]
    assert fit.iterations < 20
    known = there.noisy(4)
    less = required(replace(there, network=known.select(known.point_of < 20)).problem(**TOLERANCE))
    np.testing.assert_allclose(fit.values.cameras, less.values.cameras, rtol=1e-7)
    beside = seen_twice(0.04)
    assert required(beside.problem(beside.noisy(4), **TOLERANCE)).usable.points.all()


def test_large_coordinates_lose_no_precision() -> None:
    near, far = networks.world(), networks.world(shift=(4.5e6, 5.6e6, 300.0))
    one = required(near.problem(near.noisy(5), **TOLERANCE))
    network = replace(far.network, xy=near.noisy(5).xy)
    other = required(networks.by_itself(network, **TOLERANCE))
    # The control itself is rounded to 1e-9 m.
    assert other.sigma0 == pytest.approx(one.sigma0, rel=1e-7)
    np.testing.assert_allclose(other.values.xyz - [4.5e6, 5.6e6, 300.0], one.values.xyz, atol=5e-9)
    np.testing.assert_allclose(other.cofactors.points, one.cofactors.points, atol=1e-12)


def test_camcal_has_its_published_result_without_initial_poses(published: Callable[[str], Network]) -> None:
    fit = required(networks.by_itself(published("camcal")))
    assert fit.counts == (4148, 422, 0)
    assert fit.redundancy == 3726
    assert f"{fit.sigma0:.5f}" == "1.68901"
    assert f"{np.sqrt(fit.cost):.3f}" == "103.099"
    width, height = 2272 * 0.0031911032863849768, 1704 * 0.0031911032863849768
    c, x0, y0, k1, k2, k3, p1, p2 = fit.values.cameras[0, :8]
    printed = [f"{v:.6g}" for v in (c, x0 + width / 2, height / 2 - y0, k1, k2, k3, p1, p2)]
    assert printed == [
        "7.4574", "3.61589", "2.60842", "0.00457215", "-4.26222e-05", "-2.16112e-06", "-6.56706e-05",
        "-2.96421e-05",
    ]  # fmt: skip
    at = fit.unknowns.camera[0]
    sigma = fit.sigma0 * np.sqrt(np.diag(fit.cofactors.reduced.full)[at : at + 8])
    assert [f"{s:.3g}" for s in sigma] == [
        "0.00109", "0.000858", "0.000988", "2.31e-05", "2.76e-06", "1.05e-07", "3.67e-06", "4.05e-06",
    ]  # fmt: skip


@pytest.mark.slow
def test_roma_has_its_published_result(published: Callable[[str], Network]) -> None:
    fit = required(networks.by_itself(published("roma")))
    assert fit.redundancy == 101801
    assert fit.counts == (181122, 79328, 7)
    # The published one is 8641.39; of some points other rays are trusted at the start.
    assert np.sqrt(fit.costs[0]) == pytest.approx(8641.39, abs=1.0)
    assert f"{np.sqrt(fit.cost):.2f}" == "185.94"
    assert f"{fit.sigma0:.6f}" == "0.582769"
    c, _, _, k1, k2 = fit.values.cameras[0, :5]
    assert (f"{c:.4f}", f"{k1:.5e}", f"{k2:.5e}") == ("24.5425", "2.21523e-04", "-1.86985e-07")
    at = fit.unknowns.camera[0]
    sigma = fit.sigma0 * np.sqrt(np.diag(fit.cofactors.reduced.full)[at : at + 5])
    assert (f"{sigma[0]:.5f}", f"{sigma[3]:.2e}", f"{sigma[4]:.2e}") == ("0.00254", "2.54e-07", "5.85e-10")
    assert fit.redundancy_numbers.sum() == pytest.approx(101801, abs=1e-6)


def test_a_block_without_datum_fails_and_names_what_is_missing(published: Callable[[str], Network]) -> None:
    network = published("camcal")
    nothing = np.full_like(network.sigma, np.nan)
    fit = networks.by_itself(replace(network, xyz=nothing, sigma=nothing)).adjusted()
    assert not fit
    for word in ("rank defect 7", "position in X", "rotation about Z", "scale"):
        assert word in fit.reason


def test_held_coordinates_do_not_make_a_point_weak() -> None:
    """A free network some of whose coordinates are held all the same: none of its points leaves the datum."""
    world = networks.world(datum="free", control=0)
    sigma = world.network.sigma.copy()
    sigma[[0, 3, 7], 2] = 0.0
    xyz = np.where(sigma == 0, world.xyz, world.network.xyz)
    network = replace(world.network, sigma=sigma, xyz=xyz)
    fit = required(replace(world, network=network).problem())
    assert fit.datum is not None
    assert fit.datum.all()
    assert fit.counts[2] == 3 + 1
    assert fit.redundancy_numbers.sum() == pytest.approx(fit.redundancy, abs=1e-6)


def test_options_of_the_engine_take_effect() -> None:
    world = networks.world()
    network = world.noisy(3)
    fit = required(world.problem(network))
    none = networks.by_itself(network).adjusted(AdjustOptions(max_iterations=0))
    assert isinstance(none, Failure)
    assert none.code is Code.NOT_CONVERGED
    first = world.problem(network).adjusted(AdjustOptions(scale="a-priori", tolerance=1e-8))
    assert isinstance(first, BundleFit)
    assert (first.scale, first.variance) == ("a-priori", 1.0)
    assert fit.scale == "a-posteriori"
    assert fit.variance == pytest.approx(first.sigma0**2, rel=1e-6)
    damped = world.problem(network).adjusted(AdjustOptions(damping=10.0))
    assert isinstance(damped, BundleFit)
    assert damped.iterations > fit.iterations
    np.testing.assert_allclose(damped.values.xyz, fit.values.xyz, rtol=0, atol=1e-9)


def test_an_option_that_the_sparse_solver_does_not_support_is_refused() -> None:
    with pytest.raises(UsageError, match=r"Options\.rank_tolerance"):
        networks.world().problem().adjusted(AdjustOptions(rank_tolerance=1e-9))


def test_a_joint_prior_of_a_camera_adds_its_inverse_to_the_normal_equations() -> None:
    world, cam = networks.world(images=8), networks.camera()
    root = np.random.default_rng(1).normal(size=(len(cam.names), len(cam.names))) * 1e-3
    covariance, rows = root @ root.T, [cam.names.index(name) for name in cam.free]
    network = world.network
    plain = required(world.problem(network, **TOLERANCE))
    observed = replace(network, cameras=(replace(cam, covariance=covariance),))
    prior = required(world.problem(observed, **TOLERANCE))
    at = plain.unknowns.camera[0] + np.arange(len(cam.free))
    q, p = plain.cofactors.reduced.full[np.ix_(at, at)], prior.cofactors.reduced.full[np.ix_(at, at)]
    both = np.linalg.inv(np.linalg.inv(q) + np.linalg.inv(covariance[np.ix_(rows, rows)]))
    size = np.sqrt(np.diag(both))
    np.testing.assert_allclose(p / np.outer(size, size), both / np.outer(size, size), rtol=0, atol=1e-4)
    assert prior.redundancy == plain.redundancy + len(cam.free)
    assert np.nansum(prior.redundancy_numbers) == pytest.approx(prior.redundancy, abs=1e-6)


@pytest.mark.parametrize("banded", [False, True])
def test_a_diagonal_prior_is_that_of_single_sigmas(banded: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if banded:
        monkeypatch.setattr("reseau.bundle.solver.unknowns._BANDS", ((0, 1 / 4),))
    cams = tuple(replace(networks.camera(), id=f"cam{k}") for k in range(20))
    world = networks.world(images=20, points=100, cameras=cams, control=100)
    network = world.noisy(2)
    # Each image sees the points of its neighbours alone: parameters of its camera stand in the band.
    near = np.abs(network.image_of - network.point_of / 5) < 2.5
    network = network.select(near) if banded else network
    sigma = {name: 1e-3 * (k + 1) for k, name in enumerate(cams[0].free)}
    diagonal = np.diag([sigma.get(name, 0.0) ** 2 for name in cams[0].names])
    priors: list[dict[str, Any]] = [{"sigma": sigma}, {"covariance": diagonal}]
    single, joint = (
        required(
            world.problem(replace(network, cameras=tuple(replace(c, **prior) for c in cams)), **TOLERANCE)
        )
        for prior in priors
    )
    assert (single.unknowns.bands > 0) == banded
    np.testing.assert_allclose(single.values.cameras, joint.values.cameras, rtol=1e-8, atol=1e-10)
    assert single.sigma0 == pytest.approx(joint.sigma0, rel=1e-9)
    assert single.redundancy == joint.redundancy
    np.testing.assert_allclose(single.redundancy_numbers, joint.redundancy_numbers, rtol=0, atol=1e-7)


@pytest.mark.parametrize("control", [0, 12])
def test_few_points_in_many_images_are_adjusted_alike_without_being_eliminated(
    control: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = networks.world(images=40, points=30, control=control, datum="control" if control else "free")
    network = world.noisy(3)
    if control:
        network = replace(network, sigma=np.where(np.isnan(network.sigma), np.nan, 1e-3))
    kept = required(world.problem(network, **TOLERANCE))
    monkeypatch.setattr("reseau.bundle.solver.unknowns._BANDS", ((1500, 1 / 4),))
    eliminated = required(world.problem(network, **TOLERANCE))
    assert (kept.unknowns.bands, eliminated.unknowns.bands) == (6 * 40, 0)
    assert (kept.unknowns.kept >= 0).all()
    assert (eliminated.unknowns.kept < 0).all()
    assert kept.sigma0 == pytest.approx(eliminated.sigma0, rel=1e-9)
    assert kept.counts == eliminated.counts
    np.testing.assert_allclose(kept.values.xyz, eliminated.values.xyz, rtol=0, atol=1e-7)
    np.testing.assert_allclose(kept.cofactors.points, eliminated.cofactors.points, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(kept.redundancy_numbers, eliminated.redundancy_numbers, rtol=0, atol=1e-7)
