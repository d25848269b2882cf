"""Uncertainty by the scatter between images: that of noise for noise, and honest where a camera changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.bundle import Network, Result, sigma_between_images
from reseau.bundle.diagnostics.checks import checks
from reseau.core.data import Array
from reseau.core.failure import Code

from . import networks

RUNS = 50


def adjusted(world: networks.World, network: Network) -> Result:
    fit = world.problem(network).adjusted().required()
    return Result(network, fit, np.zeros(len(network.xy), dtype=bool))


def changed(network: Network, size: float, seed: int) -> Network:
    """Every image scaled about its middle by a factor of its own, as if its principal distance changed."""
    factor = 1 + size * np.random.default_rng(seed).normal(size=len(network.images))
    middle = np.array([319.5, 239.5])
    return replace(network, xy=(network.xy - middle) * factor[network.image_of, None] + middle)


def ratios(world: networks.World, size: float) -> tuple[Array, Array, Array]:
    """σ between images over σ, and errors over either, of all parameters of the camera (RUNS, 9)."""
    found = []
    cam = world.network.cameras[0]
    for seed in range(RUNS):
        result = adjusted(world, changed(world.noisy(seed), size, 1000 + seed))
        names, _, values = result.camera_columns(0)
        off = values - [cam.parameters[name] for name in names]
        sigma = np.sqrt(np.diag(result.camera_covariance(0)))
        between = sigma_between_images(result, 0)
        found.append((between / sigma, off / sigma, off / between))
    return tuple(np.array(column) for column in zip(*found, strict=True))  # type: ignore[return-value]


@pytest.mark.parametrize("datum", ["control", "free"])
def test_for_noise_it_is_the_sigma_of_the_adjustment(datum: str) -> None:
    world = networks.world(images=16, points=40, datum=datum, control=0 if datum == "free" else 6)
    ratio, off, covered = ratios(world, 0.0)
    mean = np.sqrt((ratio**2).mean(axis=0))
    assert (mean > 0.95).all()
    assert (mean < 1.25).all()
    assert (off**2).mean() == pytest.approx(1.0, abs=0.25)
    assert (covered**2).mean() == pytest.approx(1.0, abs=0.25)


def test_it_covers_a_camera_that_changes_where_independent_errors_do_not() -> None:
    world = networks.world(images=16, points=40, datum="free", control=0)
    _, off, covered = ratios(world, 2e-3)
    c = world.network.cameras[0].free.index("c")
    assert (off[:, c] ** 2).mean() > 2.5
    assert (covered[:, c] ** 2).mean() < 1.4


def test_only_a_camera_that_changes_between_images_gets_a_warning() -> None:
    world = networks.world(images=16, points=40, datum="free", control=0)
    code = Code.CAMERA_UNSTABLE
    remarks = [w.text for w in checks(adjusted(world, changed(world.noisy(1), 6e-3, 1))) if w.code is code]
    assert len(remarks) == 1
    assert "c " in remarks[0]
    assert not any(w.code is code for w in checks(adjusted(world, world.noisy(1))))


def test_few_images_give_no_estimate() -> None:
    world = networks.world(images=5, points=30)
    assert np.isnan(sigma_between_images(adjusted(world, world.noisy(1)), 0)).all()
