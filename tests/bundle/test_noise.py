"""Interior orientations that noise alone determines: the rank is that of the true configuration."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from reseau.bundle.solver.noise import determined_by_noise, part_by_noise
from reseau.bundle.solver.orthogonal import cofactors_from_rows
from reseau.bundle.solver.problem import BundleFit, expected_variance
from reseau.core.failure import Code, Failure

from ..montecarlo import slowly
from . import networks
from .test_problem import required

FREE = ("c", "x0", "y0", "K1")


def plane(images: int, sigma_px: float, relief: float = 0.0, aside: float = 1.0) -> networks.World:
    """49 points in a plane, or at depths of this standard deviation, from in front and from the sides."""
    camera = networks.camera(free=FREE)
    camera = replace(camera, values=np.where(np.arange(10) == 0, camera.values, 0.0))
    x, y = np.meshgrid(np.linspace(-1, 1, 7), np.linspace(-1, 1, 7))
    depth = relief * np.random.default_rng(1).normal(size=x.size)
    xyz = np.stack([x.ravel(), y.ravel(), depth], axis=1)
    sides = np.array([[0.0, 0.0, 1.73], [1, 0, 1.73], [0, 1, 1.73], [-1, 0, 1.73], [0, -1, 1.73]])[:images]
    sides[:, :2] *= aside
    x0 = 2.0 * sides + aside * np.arange(images)[:, None] * [0.05, -0.03, 0.1]
    rotation = np.stack([networks.looking_at(at, np.zeros(3), 0.0) for at in x0])
    image_of, point_of = (each.ravel() for each in np.indices((images, len(xyz))))
    xy = [networks.image_points(camera, *pose, xyz) for pose in zip(rotation, x0, strict=True)]
    base = networks.world(images=images, points=len(xyz), datum="free", cameras=(camera,), control=0)
    cov = np.tile(np.eye(2) * sigma_px**2, (len(image_of), 1, 1))
    network = replace(base.network, xy=np.concatenate(xy), image_of=image_of, point_of=point_of, cov=cov)
    return networks.World(network, rotation, x0, xyz)


def rank_and_size(world: networks.World) -> tuple[int, int]:
    """Rank of the derivatives of all image coordinates, by differences, at the truth; number of columns."""
    camera, images, p = world.network.cameras[0], len(world.x0), len(world.xyz)

    def computed(change: Any) -> Any:
        values = camera.values.copy()
        values[[0, 1, 2, 3]] += change[:4]
        moved, found = replace(camera, values=values), []
        xyz = world.xyz + change[4 + 6 * images :].reshape(p, 3)
        for i in range(images):
            turn, shift = change[4 + 6 * i : 10 + 6 * i].reshape(2, 3)
            skew = np.cross(np.eye(3), turn)
            whole = np.linalg.solve(np.eye(3) - skew / 2, np.eye(3) + skew / 2) @ world.rotation[i]
            found.append(networks.image_points(moved, whole, world.x0[i] + shift, xyz))
        return np.concatenate(found).ravel()

    size, step = 4 + 6 * images + 3 * p, 1e-4
    columns = [(computed(step * unit) - computed(-step * unit)) / (2 * step) for unit in np.eye(size)]
    design = np.stack(columns, axis=1)
    singular = np.linalg.svd(design / np.linalg.norm(design, axis=0), compute_uv=False)
    # The rank is where the singular values fall by a factor of a thousand or more.
    gaps = [a / max(b, 1e-300) for a, b in pairwise(singular)]
    return int(np.argmax(gaps)) + 1, size


@pytest.mark.slow
@pytest.mark.parametrize(("images", "relief", "defect"), [(3, 0.0, 1), (3, 0.3, 0), (4, 0.0, 0)])
def test_three_photographs_of_a_plane_have_a_rank_defect(images: int, relief: float, defect: int) -> None:
    """Besides the seven of the datum; by derivatives that share nothing with the adjustment."""
    rank, size = rank_and_size(plane(images, 0.05, relief))
    assert size - 7 - rank == defect


@pytest.mark.parametrize("sigma_px", [0.001, 0.01, 0.1])
@pytest.mark.parametrize("seed", [0, *slowly(1, 2)])
def test_three_photographs_of_a_plane_are_declined_whatever_their_noise(sigma_px: float, seed: int) -> None:
    """The adjusted points are not in a plane: it is their noise that gives the derivatives full rank."""
    world = plane(3, sigma_px)
    found = world.problem(world.noisy(seed), max_iterations=100).adjusted()
    assert isinstance(found, Failure)
    assert found.code in (Code.RANK_DEFECT, Code.NOT_CONVERGED, Code.SINGULAR)


@pytest.mark.parametrize(("images", "relief"), [(4, 0.0), (5, 0.0), (3, 0.3)])
def test_weak_networks_whose_rank_is_not_by_noise_are_adjusted(images: int, relief: float) -> None:
    found = []
    for sigma_px in (0.001, 0.01):
        world = plane(images, sigma_px, relief)
        fit = required(world.problem(world.noisy(1)))
        _, part = part_by_noise(*arguments(fit))
        assert (np.abs(part) < 0.02).all()
        assert determined_by_noise(*arguments(fit)) == []
        found.append(np.sqrt(fit.cofactors.reduced.diagonal[fit.unknowns.camera[0] + np.arange(3)]))
    # More precise image coordinates give more precise parameters.
    np.testing.assert_allclose(found[1] / found[0], 10.0, rtol=0, atol=0.5)


def arguments(fit: BundleFit) -> tuple[Any, ...]:
    """What the functions take."""
    return fit.linear, fit.cofactors, fit.usable.points, fit.sigma0


def test_a_weak_network_has_the_trace_that_its_normal_equations_have_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nearly frontal photographs of a plane; redundancy numbers sum to the redundancy all the same."""
    world = plane(5, 1e-5, aside=0.02)
    network = world.noisy(1)
    fit = required(world.problem(network))
    (c,) = [k for k, name in enumerate(fit.unknowns.names) if name.startswith("c of")]
    inflation = fit.cofactors.reduced.diagonal[c] * fit.cofactors.normal.sums.diagonal[c]
    assert inflation > 1e11
    assert fit.redundancy_numbers.sum() == pytest.approx(fit.redundancy, abs=1e-7)
    # The same rows, not decomposed.
    monkeypatch.setattr("reseau.bundle.solver.posterior._ENTRIES", 0)
    monkeypatch.setattr("reseau.bundle.solver.posterior._PRODUCTS", 0)
    poor = world.problem(network).adjusted()
    assert not poor or abs(poor.redundancy_numbers.sum() - fit.redundancy) > 1e-7
    np.testing.assert_allclose(
        np.trace(found_again(fit), axis1=1, axis2=2).sum(), number(fit), rtol=0, atol=1e-7
    )


def found_again(fit: BundleFit) -> Any:
    """Cofactors of the adjusted image coordinates in blocks of seven unknowns."""
    reduced = replace(fit.cofactors.reduced, referral=None)
    return cofactors_from_rows(fit.linear, reduced.held).seen


def number(fit: BundleFit) -> int:
    """Number of unknowns."""
    return fit.counts[1] - fit.counts[2]


@pytest.mark.parametrize("redundancy", [1, 2, 10, 40])
def test_intervals_hold_with_few_redundant_observations(redundancy: int) -> None:
    rng = np.random.default_rng(redundancy)
    square, error = rng.chisquare(redundancy, 2000), rng.normal(size=2000)
    variance = np.array([expected_variance(each, redundancy) for each in square])
    # 95 % of 2000 with a standard deviation of 0.5 %.
    assert np.mean(np.abs(error) < 1.96 * np.sqrt(variance)) == pytest.approx(0.95, abs=3.5 * 0.005)


def test_input_sigmas_far_from_the_truth_do_not_count_with_ten_redundant_observations() -> None:
    assert expected_variance(10 * 0.02**2, 10) == pytest.approx(0.02**2, rel=0.01)
