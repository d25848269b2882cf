"""First mappings of a plane, with OpenCV's cameras as the truth."""

import cv2
import numpy as np
import pytest

from reseau.core.data import Array
from reseau.measure.plane.plane_mapping import (
    STRENGTHS,
    fisheye_of,
    plane_through,
    polynomial_through,
    projectivity_behind,
)

SHAPE, MIDDLE = (720, 960), (479.5, 359.5)
TURN, PLACE = np.array([[0.5, 0.2, 0.1]]), np.array([[-5.0, -4.0, 5.0]])


def board() -> Array:
    return np.stack(np.unravel_index(np.arange(88), (11, 8)), axis=1).astype(float)


def seen(at: Array, focal: float, *, fisheye: bool) -> Array:
    """Images (n, 2) of a board that reaches to the margin of the frame."""
    xyz = np.column_stack([at, np.zeros(len(at))])[:, None]
    matrix = np.array([[focal, 0, MIDDLE[0]], [0, focal, MIDDLE[1]], [0, 0, 1]])
    if fisheye:
        return np.asarray(cv2.fisheye.projectPoints(xyz, TURN, PLACE, matrix, np.zeros(4))[0][:, 0])
    return np.asarray(cv2.projectPoints(xyz, TURN, PLACE, matrix, np.zeros(4))[0][:, 0])


@pytest.mark.parametrize("focal", [320.0, 400.0, 700.0])
def test_the_strength_of_a_fisheye_is_the_square_of_half_the_longer_side_over_its_focal_length(
    focal: float,
) -> None:
    at = board()
    strength = fisheye_of(at, seen(at, focal, fisheye=True), SHAPE)
    assert strength == pytest.approx((480 / focal) ** 2, abs=0.02)


def test_a_lens_without_distortion_is_no_fisheye() -> None:
    at = board()
    noise = np.random.default_rng(1).normal(0, 0.3, at.shape)
    assert fisheye_of(at, seen(at, 500.0, fisheye=False) + noise, SHAPE) == 0


def test_a_plane_behind_a_fisheye_is_described_behind_one() -> None:
    """A polynomial alone leaves more than a pixel of a board to 50° off the axis."""
    at = board()
    xy = seen(at, 300.0, fisheye=True)
    alone = polynomial_through(at, xy, SHAPE)(at) - xy
    assert np.hypot(*alone.T).max() > 1
    assert np.hypot(*(plane_through(at, xy, SHAPE)(at) - xy).T).max() < 0.1


def test_points_at_wrong_places_do_not_agree_with_the_projectivity_of_the_others() -> None:
    at = board()
    xy, wrong = seen(at, 480 / np.sqrt(2), fisheye=True), np.arange(len(at)) % 5 == 0
    xy[wrong] += 25
    agree = {strength: projectivity_behind(at, xy, SHAPE, strength, 3.0)[1] for strength in STRENGTHS}
    best = max(agree, key=lambda strength: int(agree[strength].sum()))
    assert best == 2.0
    np.testing.assert_array_equal(agree[best], ~wrong)


def test_points_outside_of_what_a_fisheye_shows_have_no_projectivity_behind_it() -> None:
    at = board()
    xy = seen(at, 300.0, fisheye=True)
    assert projectivity_behind(at, xy * 4 - np.array(MIDDLE) * 3, SHAPE, 3.0)[0] is None
