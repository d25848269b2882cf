"""Real film: wavy edges and a soundtrack beside the frame give no unflagged errors; perforations do."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.failure import Code
from reseau.io.images import open_scan
from reseau.measure.film import film_plane, orient_frames
from reseau.measure.film.orientation import FrameOptions
from reseau.measure.film.perforations import PITCH_MM, edge_of

STILLS = {
    "fac_neg.jpg": ((24.0, 36.0), [[106, 80], [2795, 88], [2800, 4185], [108, 4180]]),
    "strw_in1.jpg": ((36.0, 24.0), [[611, 348], [2482, 261], [2534, 1526], [663, 1578]]),
    "strw_in3.jpg": ((36.0, 24.0), [[285, 400], [2166, 306], [2256, 1544], [350, 1660]]),
}
"""Formats and corners as read off by eye where half of the contrast is reached, good to some pixels: these
edges are blurred over ten."""
CINE = {
    "kino_1264.jpg": [[893, 1676], [2874, 1676], [2874, 3145], [893, 3145]],
    "kino_1265.jpg": [[885, 1615], [2870, 1615], [2870, 3085], [885, 3085]],
}
PERFORATIONS = {
    "kino_1264.jpg": ((357, 1245, 621, 1421, 431), (2904, 1246, 3157, 1425, 431)),
    "kino_1265.jpg": ((351, 1184, 613, 1360, 431), (2896, 1187, 3150, 1365, 431)),
}
"""The first of either row: left, top, right, bottom, and the pitch, pixels; as read off by eye."""
EDGES = {"kino_1264.jpg": (1421, 1673, 3142, 3393), "kino_1265.jpg": (1362, 1614, 3082, 3335)}
"""Rows of the lower edge of the frame before, of the frame's two, of the upper edge of the next."""


def options(size, **known):
    """Copied by tilted cameras: shapes are known to 2 % and 1° only."""
    return FrameOptions((size,), aspect_sigma=0.02, angle_sigma_deg=1.0, **known)


@pytest.mark.slow
@pytest.mark.parametrize("how", ["known shape", "as it comes"])
@pytest.mark.parametrize("name", STILLS)
def test_a_still_frame_with_wavy_edges_gives_no_unflagged_error(name, how, reference_data):
    """Copies by tilted cameras, blurred over ten pixels, whose edges deviate from lines by several."""
    size, corners = STILLS[name]
    scan = open_scan(reference_data("film_frames") / name)
    (result,) = orient_frames(scan, options(size) if how == "known shape" else FrameOptions((size,)))
    if not result:
        assert result.code is Code.UNCERTAIN, result.why
        assert "edge is no straight or evenly bowed line" in result.why
        return
    sigma = np.sqrt(np.diag(result.lines.covariance)).reshape(4, 2)
    assert (np.abs(result.lines.corners - corners) < 3 * np.hypot(sigma, 5)).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", CINE)
def test_a_cine_frame_with_a_border_of_a_few_pixels_gives_no_unflagged_error(name, reference_data):
    near = np.array(CINE[name], dtype=float)
    scan = open_scan(reference_data("film_frames") / name)
    (result,) = orient_frames(scan, options((22.0, 16.0), near=near))
    if not result:
        assert "edge" in result.why
        return
    sigma = np.sqrt(np.diag(result.lines.covariance)).reshape(4, 2)
    assert (np.abs(result.lines.corners - near) < 3 * np.hypot(sigma, 8)).all()


@pytest.mark.slow
def test_two_cine_frames_of_one_strip_agree_in_size_and_angle(reference_data):
    found = []
    for name, near in CINE.items():
        scan = open_scan(reference_data("film_frames") / name)
        (result,) = orient_frames(scan, options((22.0, 16.0), near=np.array(near, dtype=float)))
        assert result.status == "three-edges", result.why
        assert result.why.startswith("left edge")
        # The right edge, which is seen between upper and lower one: its length and its direction.
        (ur, lr), cov = result.lines.corners[1:3], result.lines.covariance[2:6, 2:6]
        way = (lr - ur) / np.hypot(*(lr - ur))
        for unit in (way, np.array([way[1], -way[0]])):
            slope = np.concatenate([-unit, unit])
            found.append(
                (np.hypot(*(lr - ur)) if unit is way else np.arctan2(way[0], way[1]), slope @ cov @ slope)
            )
    length = found[0][0]
    (size, size_variance), (angle, angle_variance) = (
        (found[k][0] - found[k + 2][0], found[k][1] + found[k + 2][1]) for k in (0, 1)
    )
    # The upper edge is a line to some pixels only, and so are the corners on it.
    assert abs(size) < 3 * np.sqrt(size_variance) < 30.0
    assert abs(angle) * length < 3 * np.sqrt(angle_variance) < 9.0


@pytest.mark.slow
@pytest.mark.parametrize("name", CINE)
def test_four_perforations_make_a_cine_frame(name, reference_data):
    scan = open_scan(reference_data("film_frames") / name)
    plane = film_plane(scan, [np.array(row, dtype=float) for row in PERFORATIONS[name]], 7)
    edges = []
    for k, y in enumerate(EDGES[name]):
        ends = np.array([1000.0, y]), np.array([2800.0, y - 8.0])
        edges.append(edge_of(scan, *(ends if k % 2 else ends[::-1]), channel=1))
    before, upper, lower, after = edges
    for first, second in ((before, lower), (upper, after)):
        pitch, sigma = plane.apart(first, second)
        assert pitch == pytest.approx(4 * PITCH_MM, rel=0.005)
        assert sigma < 0.002 * pitch
    # The gate is 16 mm high, to a per cent.
    assert plane.apart(upper, lower)[0] == pytest.approx(16.0, rel=0.0125)
