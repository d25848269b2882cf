"""What the points of an image have in common: nothing for noise, and honest where a camera refocuses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.special

from reseau.bundle import Network, Result
from reseau.bundle.modelling.board import held_as_designed
from reseau.core.data import Array

from . import networks

RUNS = 25
WORLD = networks.world(images=10, points=40, datum="free", control=0)
LARGER = networks.world(images=16, points=40, datum="free", control=0)


def adjusted(world: networks.World, network: Network) -> Result:
    problem = world.problem(network)
    if network.held.all():
        problem = replace(problem, start=replace(problem.start, xyz=network.xyz))
    fit = problem.adjusted().required()
    return Result(network, fit, np.zeros(len(network.xy), dtype=bool))


def refocused(network: Network, size: float, seed: int) -> Network:
    """Every image scaled about its middle by a factor of its own, as if its principal distance changed."""
    factor = 1 + size * np.random.default_rng(seed).normal(size=len(network.images))
    middle = np.array([319.5, 239.5])
    return replace(network, xy=(network.xy - middle) * factor[network.image_of, None] + middle)


def printed(network: Network, size: float, seed: int) -> Network:
    """The points held elsewhere than they are, as on a print of the larger world."""
    off = np.random.default_rng(seed).normal(size=network.xyz.shape)
    return held_as_designed(replace(network, xyz=LARGER.xyz + size * off))


def drawn(
    size: float, change: Callable[[Network, float, int], Network], world: networks.World = WORLD
) -> tuple[Array, Array, Array]:
    """σ over the formal σ, and errors of c over σ, and over the formal one, by Student's factor of 95 %."""
    camera = world.network.cameras[0]
    ratios, holding, formal = [], [], []
    for seed in range(RUNS):
        found = adjusted(world, change(world.noisy(seed), size, 1000 + seed)).camera(0)
        assert found.dof is not None
        ratios.append(found.sigma / found.sigma_formal)
        k = found.parameters.index("c")
        off = found.values[k] - camera.parameters["c"]
        factor = scipy.special.stdtrit(found.dof[k], 0.975) if np.isfinite(found.dof[k]) else 1.96
        holding.append(abs(off) / (found.sigma[k] * factor))
        formal.append(abs(off) / (found.sigma_formal[k] * 1.96))
    return np.array(ratios), np.array(holding), np.array(formal)


@pytest.mark.slow
def test_for_noise_it_is_the_formal_sigma() -> None:
    ratio, holding, _ = drawn(0.0, refocused)
    assert (np.median(ratio, axis=0) < 1.05).all()
    assert (ratio >= 1 - 1e-9).all()
    # Of 25 intervals of 95 %, five or more miss with a probability of 0.7 %.
    assert (holding > 1).sum() <= 4


@pytest.mark.slow
def test_it_covers_a_camera_that_refocuses_where_the_formal_one_does_not() -> None:
    _, holding, formal = drawn(2e-3, refocused)
    assert (holding > 1).sum() <= 4
    assert (formal > 1).sum() > 6


@pytest.mark.slow
def test_it_covers_a_print_that_is_held_where_the_formal_one_does_not() -> None:
    _, holding, formal = drawn(2e-3, printed, LARGER)
    assert (holding > 1).sum() <= 4
    assert (formal > 1).sum() > 6


def test_it_is_positive_definite_and_nowhere_below_the_formal_one() -> None:
    world = networks.world(images=6, points=30, datum="free", control=0)
    result = adjusted(world, refocused(world.noisy(1), 4e-3, 1))
    formal = result.formal_camera_covariance(0)
    size = np.sqrt(np.diag(formal))
    scaled = np.outer(size, size)
    formal, whole = formal / scaled, result.camera_covariance(0) / scaled
    assert np.linalg.eigvalsh(whole).min() > 0
    least = np.linalg.eigvalsh(whole - formal).min()
    assert least > -1e-6 * np.linalg.eigvalsh(whole).max()


def test_two_images_give_the_formal_one() -> None:
    world = networks.world(images=2, points=40)
    result = adjusted(world, world.noisy(1))
    assert result.shared is None
    found = result.camera(0)
    np.testing.assert_allclose(found.sigma, found.sigma_formal, rtol=1e-12)


def test_fields_of_twice_the_size_carry_four_times_the_variance_to_the_cameras() -> None:
    world = networks.world(images=6, points=30, datum="free", control=0)
    found = adjusted(world, refocused(world.noisy(1), 4e-3, 1)).shared
    assert found is not None
    columns, some = found._of_cameras[0], np.full_like(found.smooth, 0.3)
    once, twice = (
        replace(found, smooth=size * some, weights=some, distance=0.0)._carried(columns) for size in (1, 2)
    )
    assert np.trace(once) > 0
    np.testing.assert_allclose(twice, 4 * once, rtol=1e-12)
