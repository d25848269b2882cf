"""Photographs of one view are found by what their points have in common; others are views of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.bundle import Network, adjust_network
from reseau.bundle.diagnostics.views import views_of
from reseau.core.data import Rows

from . import networks

WORLD = networks.world(images=6, points=40, datum="free", control=0)
COPIES = 3


def copied(network: Network, errors: float, seed: int) -> Network:
    """Every image several times, with noise, and with errors that the copies of an image have in common."""
    rng = np.random.default_rng(seed)
    n, m = len(network.xy), len(network.images)
    s = (network.xy - [319.5, 239.5]) / 320
    bend = rng.normal(size=(m, 3, 2))[network.image_of]
    common = np.einsum("nk,nkx->nx", np.stack([s[:, 0] ** 2, s.prod(axis=1), s[:, 1] ** 2], axis=1), bend)
    sigma = np.sqrt(network.cov[:, 0, 0])[:, None]
    moved = np.tile(network.xy + errors * sigma * common, (COPIES, 1))
    names = tuple(f"{name} {k}" for k in range(COPIES) for name in network.images)
    return replace(
        network, images=names, files=names, groups=(None,) * len(names),
        camera_of=np.tile(network.camera_of, COPIES), x0=np.tile(network.x0, (COPIES, 1)),
        rotation=np.tile(network.rotation, (COPIES, 1)),
        image_of=np.concatenate([network.image_of + k * m for k in range(COPIES)]),
        point_of=np.tile(network.point_of, COPIES),
        xy=moved + np.tile(sigma, (COPIES, 1)) * rng.normal(size=(COPIES * n, 2)),
        cov=np.tile(network.cov, (COPIES, 1, 1)),
    )  # fmt: skip


def views(network: Network) -> Rows:
    return views_of(adjust_network(network).required().fit)


@pytest.mark.slow
def test_copies_that_repeat_their_errors_are_one_view() -> None:
    for seed in range(3):
        found = views(copied(WORLD.network, 5.0, seed)).reshape(COPIES, -1)
        assert (found == found[0]).all()
        assert len(set(found[0].tolist())) == len(WORLD.network.images)


@pytest.mark.slow
def test_copies_that_have_only_noise_are_views_of_their_own() -> None:
    for seed in range(3):
        network = copied(WORLD.network, 0.0, seed)
        assert len(set(views(network).tolist())) == len(network.images)


def test_images_from_other_places_are_views_of_their_own() -> None:
    world = networks.world(images=12, points=40, datum="free", control=0)
    for seed in range(3):
        assert len(set(views(world.noisy(seed)).tolist())) == 12
