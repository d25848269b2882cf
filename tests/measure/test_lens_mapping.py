"""The mapping of a plane through a lens, from points of others' lenses."""

import cv2
import numpy as np
import pytest

from reseau.core.data import Array
from reseau.measure.plane.lattice_mapping import second_order, slope_of
from reseau.measure.plane.lens_mapping import distorted, lens_through, mapping_through, moving, projected
from reseau.measure.plane.plane_mapping import plane_through

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


def test_derivatives_of_the_images_through_a_lens_are_those_of_differences() -> None:
    rng = np.random.default_rng(2)
    source = np.column_stack([rng.uniform(-1, 1, (9, 2)), np.ones(9)])
    first = [1.1, 0.02, 0.03, -0.01, 0.9, 0.05, 0.02, -0.03]
    motion, rows = rng.normal(0, 0.05, 8), rng.uniform(-1, 1, 9)
    x = np.array([*first, 0.1, -0.05, 0.01, 0.02, -0.03, 0.004, 0.002, -0.001, *motion])

    def images(x: Array) -> tuple[Array, Array]:
        u, by_u, by_motion = moving(*projected(source, x[:8])[:1], rows, x[16:])
        by_all = np.concatenate([by_u @ projected(source, x[:8])[1], by_motion], axis=2)
        image, slopes = distorted(u, by_all, x[8:16])
        return image, np.concatenate([slopes[..., :8], slopes[..., 16:], slopes[..., 8:16]], axis=2)

    slopes = images(x)[1]
    for k, step in enumerate(1e-6 * np.eye(len(x))):
        difference = (images(x + step)[0] - images(x - step)[0]) / 2e-6
        np.testing.assert_allclose(slopes[..., k], difference, rtol=0, atol=1e-8)


@pytest.mark.parametrize("seed", range(20))
def test_tags_in_the_corner_of_a_fisheye_picture_lie_in_one_plane(seed: int) -> None:
    at, xy = seen_through_a_fisheye(seed)
    found = lens_through(at, xy, np.full(len(at), NOISE_PX), SHAPE, plane_through(at, xy, SHAPE))
    assert found is not None
    assert np.hypot(*(found.mapping(at) - xy).T).max() < 6 * NOISE_PX


def test_a_board_from_the_axis_of_a_fisheye_to_the_horizon_has_a_mapping() -> None:
    """Far from the axis a projectivity alone leads out of the frame; OpenCV's fisheye camera with k1, k2."""
    at = np.stack(np.unravel_index(np.arange(88), (8, 11)), axis=1).astype(float)
    matrix = np.array([[400.0, 0, 470.0], [0, 402.0, 330.0], [0, 0, 1]])
    turn, place = np.array([[0.5, 0.2, 0.3]]), np.array([[-2.0, -5.0, 3.2]])
    xyz = np.column_stack([at, np.zeros(len(at))])[:, None]
    xy = cv2.fisheye.projectPoints(xyz, turn, place, matrix, np.array([0.02, -0.01, 0.0, 0.0]))[0][:, 0]
    deep = (xyz[:, 0] @ np.asarray(cv2.Rodrigues(turn)[0]).T + place)[:, 2] > 0.3
    at, xy = at[deep], xy[deep]
    off_axis = np.hypot(*(xy - matrix[:2, 2]).T) / 400
    assert len(at) > 60
    assert off_axis.max() > np.deg2rad(65)
    found = mapping_through(at, xy, np.full(len(at), 0.005), (720, 960)).mapping
    assert np.hypot(*(found(at) - xy).T).max() < 0.05
    step, (_, slope, bend) = 1e-4, second_order(found, at)
    for k, d in enumerate(step * np.eye(2)):
        np.testing.assert_allclose((found(at + d) - found(at - d)) / (2 * step), slope[:, :, k], atol=1e-4)
        numeric = (slope_of(found, at + d) - slope_of(found, at - d)) / (2 * step)
        np.testing.assert_allclose(numeric, bend[..., k], atol=1e-2)


def moving_plane(at: Array, seed: int, share: float) -> Array:
    """Images of a plane that turns and shifts while rows are read, through OpenCV's lens with k1, k2, k3."""
    rng = np.random.default_rng(seed)
    matrix = np.array([[753.0, 0, 474.0], [0, 754.0, 363.0], [0, 0, 1]])
    turn, place = rng.uniform(-0.6, 0.6, 3), np.array([-3.5, -2.5, 11.0])
    spin, speed = share * rng.normal(0, 0.002, 3), share * rng.normal(0, 0.05, 3)
    xyz = np.column_stack([at, np.zeros(len(at))])
    lens, xy = np.array([0.082, -0.163, 4e-4, -7e-4, 0.061]), np.full((len(at), 2), 360.0)
    for _ in range(12):
        for k, t in enumerate((xy[:, 1] - 359.5) / 360):
            xy[k] = cv2.projectPoints(xyz[k : k + 1], turn + t * spin, place + t * speed, matrix, lens)[0][
                0, 0
            ]
    return xy


@pytest.mark.parametrize("seed", range(4))
def test_a_plane_that_moves_while_rows_are_read_has_the_derivatives_of_its_images(seed: int) -> None:
    at = np.stack(np.unravel_index(np.arange(54), (9, 6)), axis=1).astype(float)
    beside = np.concatenate([at + np.array([step, 0.0]) for step in (0.05, -0.05)])
    xy = moving_plane(at, seed, 1.0)
    assert np.abs(xy - moving_plane(at, seed, 0.0)).max() > 2
    noisy = xy + np.random.default_rng(seed).normal(0, 0.003, xy.shape)
    found = mapping_through(at, noisy, np.full(len(at), 0.003), (720, 960)).mapping
    assert np.abs(found(at) - xy).max() < 0.04
    ahead, behind = np.split(moving_plane(beside, seed, 1.0), 2)
    # What displaces the images of circles: how the scale changes over a tenth of the pitch.
    seen = np.subtract(*np.split(found(beside), 2))
    assert np.abs(seen - (ahead - behind)).max() < 0.012
