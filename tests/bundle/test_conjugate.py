"""Large networks: conjugate gradients without the matrix, and the entries of the inverse inside a band."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reseau.bundle import Network, Options, adjust_network
from reseau.bundle.document import ResultDocument
from reseau.bundle.solver.arrow import Arrow, full
from reseau.bundle.solver.problem import BundleFit, BundleProblem
from reseau.core.data import Array
from reseau.core.failure import Code, Failure

from . import networks
from .test_problem import mixed, required

NEVER, ALWAYS = 1e12, 0.0
"""Memory with which conjugate gradients are never used, and always."""


def banded_world() -> tuple[networks.World, Network]:
    """Twenty images on a ring, each with a camera of its own, that see points of their neighbours alone."""
    cams = tuple(replace(networks.camera(free=("c", "K1")), id=f"cam{k}") for k in range(20))
    world = networks.world(images=20, points=200, cameras=cams, control=0, datum="free")
    network = world.noisy(2)
    away = np.abs(network.image_of - network.point_of / 10)
    return world, network.select(np.minimum(away, 20 - away) < 2.5)


def with_shared_camera(datum: str) -> BundleProblem:
    world = networks.world(images=8, points=40, control=0 if datum == "free" else 5, datum=datum)
    return world.problem(world.noisy(1))


def with_cameras_of_their_own() -> BundleProblem:
    world, network = banded_world()
    return world.problem(network)


def with_distances_and_observed_parameters() -> BundleProblem:
    world = mixed()
    return world.problem(world.noisy(3))


@pytest.mark.parametrize(
    ("bands", "width", "rows"), [(37, 5, 0), (37, 5, 4), (40, 8, 3), (12, 11, 2), (5, 0, 2), (0, 0, 9)]
)
def test_the_inverse_inside_a_band_is_that_of_the_whole_matrix(bands: int, width: int, rows: int) -> None:
    rng = np.random.default_rng(bands)
    band, border = rng.normal(size=(bands, width + 1)), rng.normal(size=(rows, bands + rows))
    for k in range(1, width + 1):
        band[max(bands - k, 0) :, k] = 0.0
    band[:, 0] = 2.0 * (width + rows + 1) + np.arange(bands)
    border[:, bands:] = np.diag(np.full(rows, 5.0 * (bands + rows)))
    whole = np.linalg.inv(full(band, border))
    inside, across = Arrow.factorise(band.copy(), border.copy()).inverse()
    np.testing.assert_allclose(across, whole[bands:], rtol=0, atol=1e-14)
    for c in range(bands):
        count = min(width + 1, bands - c)
        np.testing.assert_allclose(inside[c, :count], whole[c : c + count, c], rtol=0, atol=1e-14)


def test_cofactors_of_a_band_are_those_of_the_whole_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stored ones inside the band, and those of images without a point in common, which are solved for."""
    world, network = banded_world()
    whole = required(world.problem(network, tolerance=1e-10, memory=NEVER))
    monkeypatch.setattr("reseau.bundle.solver.unknowns._BANDS", ((0, 2.0),))
    banded = required(world.problem(network, tolerance=1e-10, memory=NEVER))
    assert (whole.unknowns.bands, banded.unknowns.bands) == (0, banded.unknowns.size)
    assert banded.unknowns.bandwidth < banded.unknowns.size - 1
    at = whole.unknowns.pose[:, None] + np.arange(6)
    size = np.sqrt(np.diagonal(whole.cofactors.reduced.blocks(at), axis1=1, axis2=2))
    there = banded.unknowns.pose[:, None] + np.arange(6)
    one = whole.cofactors.reduced.block(at.ravel(), at.ravel())
    other = banded.cofactors.reduced.block(there.ravel(), there.ravel())
    np.testing.assert_allclose((one - other) / np.outer(size, size), 0.0, rtol=0, atol=1e-6)
    blocks = banded.cofactors.reduced.blocks(there)
    np.testing.assert_allclose(
        blocks, other.reshape(20, 6, 20, 6)[np.arange(20), :, np.arange(20)], rtol=1e-9, atol=1e-15
    )
    np.testing.assert_allclose(banded.cofactors.points, whole.cofactors.points, rtol=1e-5, atol=1e-10)
    np.testing.assert_allclose(banded.redundancy_numbers, whole.redundancy_numbers, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    "made",
    [
        lambda: with_shared_camera("control"),
        lambda: with_shared_camera("free"),
        lambda: with_shared_camera("minimal"),
        with_cameras_of_their_own,
        with_distances_and_observed_parameters,
    ],
    ids=["control", "free", "minimal", "own cameras", "distances"],
)
def test_conjugate_gradients_end_in_the_minimum_of_the_direct_solution(
    made: Callable[[], BundleProblem],
) -> None:
    """Within 1e-6 standard deviations in every unknown, with the same sigma0 and cofactors."""
    problem = made()
    direct = required(replace(problem, memory=NEVER, tolerance=1e-10))
    found = required(replace(problem, memory=ALWAYS))
    assert (direct.linear.system.iterative, found.linear.system.iterative) == (False, True)
    assert found.redundancy == direct.redundancy
    assert found.sigma0 == pytest.approx(direct.sigma0, rel=1e-12)
    np.testing.assert_allclose(found.residuals, direct.residuals, rtol=0, atol=1e-6)
    at = direct.unknowns.pose[:, None] + np.arange(6)
    of_poses = np.sqrt(np.diagonal(direct.cofactors.reduced.blocks(at), axis1=1, axis2=2)) * direct.sigma0
    off = np.abs(found.values.x0 - direct.values.x0)
    assert (off <= 1e-6 * of_poses[:, 3:] + 1e-14).all()
    turned = np.abs(found.values.rotation @ np.swapaxes(direct.values.rotation, 1, 2) - np.eye(3))
    assert (turned.max(axis=(1, 2)) <= 1e-6 * of_poses[:, :3].max(axis=1) + 1e-14).all()
    of_points = np.sqrt(np.diagonal(direct.cofactors.points, axis1=1, axis2=2)) * direct.sigma0
    assert (np.abs(found.values.xyz - direct.values.xyz) <= 1e-6 * of_points + 1e-14).all()
    for columns in (at[2], np.concatenate([at[0], at[-1]]), np.flatnonzero(direct.unknowns.kept >= 0)[:3]):
        one, other = (fit.cofactors.reduced.block(columns, columns) for fit in (direct, found))
        size = np.sqrt(np.where(np.diag(one) > 0, np.diag(one), 1.0))
        np.testing.assert_allclose(
            one / np.outer(size, size), other / np.outer(size, size), rtol=0, atol=1e-6
        )


def test_what_conjugate_gradients_do_not_compute_is_nan() -> None:
    problem = with_cameras_of_their_own()
    found = required(replace(problem, memory=ALWAYS))
    assert not found.cofactors.reduced.known
    assert np.isnan(found.cofactors.points).all()
    assert np.isnan(found.redundancy_numbers).all()
    assert np.isnan(found.w).all()
    at = found.unknowns.pose[:, None] + np.arange(6)
    assert np.isnan(found.cofactors.reduced.blocks(at)).all()


def test_a_result_without_statistics_says_so(tmp_path: Path) -> None:
    network = with_shared_camera("free").network
    network = replace(network, x0=networks.world(images=8).x0)
    result = adjust_network(network, Options(memory_gb=0.0))
    assert result, result
    said = [remark for remark in result.warnings if remark.code is Code.TOO_LARGE]
    assert len(said) == 1
    assert "conjugate gradients" in said[0].text
    whole = adjust_network(network, Options(memory_gb=1.0))
    assert whole, whole
    assert Code.TOO_LARGE not in [remark.code for remark in whole.warnings]
    one, other = result.formal_camera_covariance(0), whole.formal_camera_covariance(0)
    size = np.sqrt(np.diag(other))
    np.testing.assert_allclose((one - other) / np.outer(size, size), 0.0, rtol=0, atol=1e-6)
    document = ResultDocument.of(result)
    document.write(tmp_path / "result.json")
    assert "NaN" not in document.to_json()
    assert ResultDocument.read(tmp_path / "result.json").to_json() == document.to_json()


def test_gross_errors_are_not_looked_for_without_statistics() -> None:
    network = with_shared_camera("free").network
    result = adjust_network(network, Options(outliers="reject", memory_gb=0.0))
    assert isinstance(result, Failure)
    assert result.code is Code.TOO_LARGE


def test_images_that_nothing_connects_are_not_adjusted() -> None:
    """The direct solution names them, conjugate gradients do not converge for a random right-hand side."""
    world = networks.world(images=8, points=40, control=0, datum="free")
    network = world.noisy(1)
    apart = network.select((network.image_of < 4) == (network.point_of < 20))
    cams = tuple(replace(networks.camera(free=()), id=f"cam{k}") for k in range(8))
    apart = replace(apart, cameras=cams, camera_of=np.arange(8))
    for memory in (NEVER, ALWAYS):
        fit = world.problem(apart, memory=memory).adjusted()
        assert isinstance(fit, Failure)
        assert fit.code in (Code.SINGULAR, Code.RANK_DEFECT)


@pytest.mark.slow
def test_the_memory_of_the_factors_is_predicted() -> None:
    """With room, before it is taken: 60 images with a camera of their own each."""
    cams = tuple(replace(networks.camera(free=("c", "K1")), id=f"cam{k}") for k in range(60))
    world = networks.world(images=60, points=300, cameras=cams, control=0, datum="free")
    problem = world.problem(world.noisy(2), memory=ALWAYS)

    def peak(memory: float) -> int:
        required(replace(problem, memory=memory))
        tracemalloc.start()
        fit = required(replace(problem, memory=memory))
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert isinstance(fit, BundleFit)
        return most

    factors = required(problem).unknowns.bytes_of_factors
    assert peak(NEVER) - peak(ALWAYS) < factors


def test_steps_are_the_same_in_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = replace(with_cameras_of_their_own(), memory=ALWAYS)
    seen = list[Array]()
    for count in (1, 2):
        monkeypatch.setattr("reseau.bundle.solver.threads.processors", lambda count=count: count)
        seen.append(required(problem).values.xyz)
    np.testing.assert_array_equal(seen[0], seen[1])
