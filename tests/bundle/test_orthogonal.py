"""Cofactors from the rows of the observations, where normal equations have lost their digits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.bundle.solver.arrow import Singular
from reseau.bundle.solver.orthogonal import cofactors_from_rows
from reseau.bundle.solver.problem import BundleFit

from . import networks
from .test_conjugate import NEVER, banded_world, with_distances_and_observed_parameters
from .test_problem import required


def banded(monkeypatch: pytest.MonkeyPatch, *, shared: bool) -> BundleFit:
    """An adjustment inside a band of one camera for each image, or with full rows of one for all."""
    world, network = banded_world()
    if shared:
        network = replace(network, cameras=network.cameras[:1], camera_of=np.zeros(20, dtype=np.intp))
        world = replace(world, network=network)
    monkeypatch.setattr("reseau.bundle.solver.unknowns._BANDS", ((0, 2.0),))
    return required(world.problem(network, tolerance=1e-10, memory=NEVER))


@pytest.mark.parametrize("block", [7, 64, 1000])
@pytest.mark.parametrize("shared", [False, True])
def test_cofactors_from_rows_are_those_of_the_normal_equations(
    monkeypatch: pytest.MonkeyPatch, block: int, shared: bool
) -> None:
    fit = banded(monkeypatch, shared=shared)
    monkeypatch.setattr("reseau.bundle.solver.orthogonal._BLOCK", block)
    monkeypatch.setattr("reseau.bundle.solver.orthogonal._ROWS", 50)
    # Without inner constraints, to which the cofactors are transformed last.
    reduced = replace(fit.cofactors.reduced, referral=None)
    held = reduced.held
    found = cofactors_from_rows(fit.linear, held)
    assert (len(found.border) > 0) is shared
    size = np.sqrt(np.maximum(reduced.diagonal, 1e-300))
    rows = np.arange(len(held))
    whole = reduced.block(rows, rows)
    for c in range(len(found.band)):
        count = min(found.band.shape[1], len(found.band) - c)
        difference = found.band[c, :count] - whole[c : c + count, c]
        np.testing.assert_allclose(difference / size[c] / size[c : c + count], 0.0, rtol=0, atol=1e-7)
    if shared:
        assert reduced.border is not None
        across = np.outer(size[len(found.band) :], size)
        np.testing.assert_allclose((found.border - reduced.border) / across, 0.0, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.seen, fit.cofactors.seen, rtol=0, atol=1e-7)
    trace = np.trace(found.seen, axis1=1, axis2=2).sum()
    np.testing.assert_allclose(trace, fit.counts[1] - fit.counts[2], rtol=0, atol=1e-9)
    sides = np.random.default_rng(0).normal(size=(len(held), 2))
    sides[held] = 0.0
    solved = found.arrow.solve(sides)
    assert (np.diagonal(found.arrow.corner) > 0).all()
    solved[held] = 0.0
    expected = whole @ sides
    assert (np.abs(solved - expected) <= 1e-6 * np.abs(expected).max(axis=0)).all()


def test_observed_coordinates_and_distances_are_rows_as_well() -> None:
    fit = required(with_distances_and_observed_parameters())
    found = cofactors_from_rows(fit.linear, fit.cofactors.reduced.held)
    size = np.sqrt(np.maximum(np.diagonal(fit.cofactors.points, axis1=1, axis2=2), 1e-300))
    eliminated = fit.linear.system.pattern.eliminated == 1
    movable = fit.linear.system.movable[:, :, None] * fit.linear.system.movable[:, None, :]
    difference = (found.points * movable - fit.cofactors.points) / (size[:, :, None] * size[:, None, :])
    np.testing.assert_allclose(difference[eliminated], 0.0, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.seen, fit.cofactors.seen, rtol=0, atol=1e-8)


def test_a_datum_that_is_hardly_determined_leaves_the_redundancy_numbers_of_a_free_network(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Coordinates of three points with sigmas of ten million times those of the network.

    The redundancy numbers do not depend on the datum. Those by normal equations are off: these have lost the
    digits in which the datum is.
    """
    free = banded(monkeypatch, shared=False)
    world, network = banded_world()
    far = np.array([0, 60, 130])
    sigma, xyz = np.full_like(network.sigma, np.nan), network.xyz.copy()
    sigma[far], xyz[far] = 3e3, world.xyz[far]
    loose = replace(network, sigma=sigma, xyz=xyz, datum="control")
    monkeypatch.setattr("reseau.bundle.solver.posterior._ENTRIES", 0)
    monkeypatch.setattr("reseau.bundle.solver.posterior._PRODUCTS", 0)
    assert not world.problem(loose, memory=NEVER).adjusted()
    monkeypatch.undo()
    monkeypatch.setattr("reseau.bundle.solver.unknowns._BANDS", ((0, 2.0),))
    monkeypatch.setattr("reseau.bundle.solver.posterior._ENTRIES", 0)
    fit = required(world.problem(loose, memory=NEVER))
    n = 2 * len(network.xy)
    np.testing.assert_allclose(fit.redundancy_numbers[:n], free.redundancy_numbers[:n], rtol=0, atol=1e-5)


def test_rows_that_leave_an_unknown_open_are_singular(monkeypatch: pytest.MonkeyPatch) -> None:
    fit = banded(monkeypatch, shared=False)
    with pytest.raises(Singular):
        cofactors_from_rows(fit.linear, np.zeros(fit.unknowns.size, dtype=bool))


def test_points_without_image_points_that_are_adjusted_together_change_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = networks.world(images=6, points=30, control=6)
    network, lost = world.noisy(1), np.arange(24, 30)
    fit = required(world.problem(network.select(~np.isin(network.point_of, lost)), memory=NEVER))
    # Three rows of each of the six are adjusted together, before those of the others.
    monkeypatch.setattr("reseau.bundle.solver.orthogonal._ROWS", 9)
    found = cofactors_from_rows(fit.linear, fit.cofactors.reduced.held)
    seen = np.setdiff1d(np.arange(6, 30), lost)
    size = np.sqrt(np.diagonal(fit.cofactors.points[seen], axis1=1, axis2=2))
    difference = (found.points - fit.cofactors.points)[seen] / (size[:, :, None] * size[:, None, :])
    np.testing.assert_allclose(difference, 0.0, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.seen, fit.cofactors.seen, rtol=0, atol=1e-8)
