"""Networks with several solutions: the best is delivered, what others contradict has no sigma."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.bundle import Network, Result, adjust_network
from reseau.core.data import Array
from reseau.core.failure import Code
from reseau.optics.poses import matrix_to_vector

from . import networks


def from_two_places(xyz: Array, seed: int, base: float = 0.4, depart: float = 0.0) -> Network:
    """Two images of points from places on the x axis that look along z; known camera, free network."""
    rng = np.random.default_rng(seed)
    xyz = xyz * (1 + depart * rng.normal(size=(len(xyz), 1)))
    centres = np.array([[-base / 2, 0.0, 0.0], [base / 2, 0.0, 0.0]])
    own = networks.camera(free=())
    return networks.seen_from(centres, centres + np.array([0, 0, 1.0]), xyz, 0, own, seed)


def cylinder(seed: int) -> Array:
    """Sixty points on a cylinder about a line beside the x axis, which is on it."""
    rng = np.random.default_rng(seed)
    x, angle = rng.uniform(-0.35, 0.35, 60), rng.uniform(-0.6, 0.6, 60)
    return np.column_stack([x, 0.5 * np.sin(angle), 0.5 * (1 + np.cos(angle))])


def plane(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.35, 0.35, 40), rng.uniform(-0.25, 0.25, 40), np.ones(40)])


def adjusted(network: Network) -> Result:
    return adjust_network(network).required()


def frontal(tilt: float) -> Network:
    """One image of twelve known points in a plane of 28 px, tilted by `tilt` (rad)."""
    rng = np.random.default_rng(3)
    xyz = np.column_stack([rng.uniform(-0.05, 0.05, (12, 2)), np.zeros(12)])
    place = 3 * np.array([[0, np.sin(tilt), -np.cos(tilt)]])
    return networks.seen_from(place, np.zeros((1, 3)), xyz, 12, networks.camera(free=()), 1)


def turn_deg(result: Result) -> Array:
    """Rotation between both images; zero is true."""
    one, other = result.fit.values.rotation
    return np.degrees(matrix_to_vector((other @ one.T)[None])[0])


def is_ambiguous(result: Result) -> bool:
    return any(remark.code is Code.AMBIGUOUS for remark in result.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2])
def test_rotations_have_no_sigma_where_points_are_on_a_cylinder_through_the_stations(seed: int) -> None:
    result = adjusted(from_two_places(cylinder(seed), seed))
    assert is_ambiguous(result)
    assert np.isnan(result.angle_sigma).any()
    assert np.isnan(result.covariance_of("dx of image i0", "dx of image i1")).any()
    # Errors of more than a degree, where first order says ± 0.3.
    assert abs(turn_deg(result)[0]) > 1


@pytest.mark.parametrize("depart", [0.02, 0.2])
def test_rotations_have_sigmas_that_hold_where_points_are_beside_the_cylinder(depart: float) -> None:
    result = adjusted(from_two_places(cylinder(1), 1, depart=depart))
    assert not result.others
    assert np.isfinite(result.angle_sigma).all()
    assert np.abs(turn_deg(result)).max() < 0.2


def test_of_two_relative_orientations_that_a_plane_leaves_the_better_is_delivered() -> None:
    # The first start leads to the other one, turned by 23 degrees, with points at infinity.
    result = adjusted(from_two_places(plane(0), 0))
    assert np.abs(turn_deg(result)).max() < 0.5


def test_both_are_said_where_a_plane_is_seen_frontally_by_two_images() -> None:
    result = adjusted(from_two_places(plane(2), 2))
    assert is_ambiguous(result)
    assert np.isnan(result.angle_sigma).all()
    off = [
        np.degrees(matrix_to_vector(np.swapaxes(o.values.rotation[:1], 1, 2) @ o.values.rotation[1:]))
        for o in result.others
    ]
    assert min(np.abs(turn_deg(result)).max(), *(np.abs(each).max() for each in off)) < 0.5


@pytest.mark.parametrize(("tilt", "unclear"), [(0.05, True), (0.8, False)])
def test_a_small_plane_seen_frontally_leaves_two_poses_of_an_image(tilt: float, unclear: bool) -> None:
    result = adjusted(frontal(tilt))
    assert is_ambiguous(result) == unclear
    assert np.isnan(result.angle_sigma).any() == unclear


def test_other_solutions_are_found_in_each_datum() -> None:
    assert is_ambiguous(adjusted(replace(from_two_places(cylinder(0), 0), datum="minimal")))
