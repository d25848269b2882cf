"""The mapping of a plane through a lens, from points of others' lenses."""

import cv2
import numpy as np
import pytest

from reseau.core.data import Array
from reseau.measure.reseau.lens_mapping import lens_through
from reseau.measure.reseau.sheet_placement import through

SHAPE, FOCAL, NOISE_PX = (1024, 1024), 380.0, 0.3


def seen_through_a_fisheye(seed: int) -> tuple[Array, Array]:
    """Corners of 14 of 36 tags, and their images 35° to 58° off the axis of an equidistant lens."""
    rng = np.random.default_rng(seed)
    tags = np.stack(np.unravel_index(rng.permutation(36)[:14], (6, 6)), axis=1)
    at = (tags[:, None] + 0.77 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])).reshape(-1, 2)
    turn = np.asarray(cv2.Rodrigues(rng.normal(0, 0.25, 3))[0])
    around, off_axis = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(35, 58))
    middle = 12 * np.array(
        [np.cos(around) * np.sin(off_axis), np.sin(around) * np.sin(off_axis), np.cos(off_axis)]
    )
    x, y, z = (np.column_stack([at - 3, np.zeros(len(at))]) @ turn.T + middle).T
    radius, angle = FOCAL * np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    xy = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]) + 511.5
    return at, xy + rng.normal(0, NOISE_PX, xy.shape)


@pytest.mark.parametrize("seed", range(20))
def test_tags_in_the_corner_of_a_fisheye_picture_lie_in_one_plane(seed: int) -> None:
    at, xy = seen_through_a_fisheye(seed)
    found = lens_through(at, xy, np.full(len(at), NOISE_PX), SHAPE, through(at, xy, SHAPE))
    assert found is not None
    assert np.hypot(*(found.mapping(at) - xy).T).max() < 6 * NOISE_PX
