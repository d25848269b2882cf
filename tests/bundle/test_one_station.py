"""A camera that only turned: rotations alone are adjusted, and preferred where they predict as well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.bundle import Network, adjust_network, problem_of, rotation_only
from reseau.bundle.modelling.one_station import RotationOnly
from reseau.core.failure import Code

from . import networks


def turning(base: float, seed: int) -> Network:
    """Six images of 80 points at 6 to 12 m, from places scattered by `base` metres; errors of 0.05 px."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-3, 3, (80, 3)) + np.array([0, 0, 9.0])
    targets = np.array([[x, y, 9.0] for x in (-1.5, 0, 1.5) for y in (-1.0, 1.0)])
    centres = base * rng.normal(size=(6, 3))
    own = networks.camera(free=("c", "x0", "y0", "K1"))
    network = networks.seen_from(centres, targets, xyz, 0, own, seed)
    start = replace(own, values=own.values * np.where(np.array(own.names) == "c", 1.02, 1.0))
    return replace(network, cameras=(start,))


@pytest.mark.slow
@pytest.mark.parametrize("base", [pytest.param(0.0, marks=pytest.mark.slow), 1e-4])
def test_a_camera_that_only_turned_has_no_points_and_says_what_rotations_give(base: float) -> None:
    found = adjust_network(turning(base, 1))
    assert not found
    assert found.code is Code.ONE_STATION
    assert "With rotations alone: c" in found.reason


@pytest.mark.parametrize("base", [0.05, 0.5])
def test_points_have_depth_where_the_base_shows_in_the_images(base: float) -> None:
    # Parallaxes of some 3 px and more, of which each is known to 0.05 px.
    assert adjust_network(turning(base, 2))


@pytest.mark.slow
def test_errors_of_rotations_alone_are_as_large_as_their_standard_deviations() -> None:
    squares = []
    for seed in range(20):
        network = turning(0.0, 100 + seed)
        true = networks.camera().parameters
        turned = rotation_only(problem_of(network)[0])
        assert isinstance(turned, RotationOnly)
        own = turned.cameras[network.cameras[0].id]
        off = own.values - [true[name] for name in own.parameters]
        squares.append(off @ np.linalg.solve(own.covariance, off) / len(off))
        assert abs(turned.sigma0 - 1) < 5 / np.sqrt(2 * turned.redundancy)
    # 80 degrees of freedom: the mean has a standard deviation of 0.16.
    assert 0.6 < np.mean(squares) < 1.6
