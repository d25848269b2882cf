"""Real film: still frames are oriented, cine frames beside a soundtrack are never wrong silently."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.refine.frame import FrameOptions, orient_frames
from reseau.scans import open_scan

STILLS = {
    "fac_neg.jpg": ((24.0, 36.0), [[106, 80], [2795, 88], [2800, 4185], [108, 4180]]),
    "strw_in1.jpg": ((36.0, 24.0), [[611, 348], [2482, 261], [2534, 1526], [663, 1578]]),
}
"""Formats and corners as read off by eye where half of the contrast is reached, good to some pixels: these
edges are blurred over ten."""
CINE = {
    "kino_1264.jpg": [[893, 1676], [2874, 1676], [2874, 3145], [893, 3145]],
    "kino_1265.jpg": [[885, 1615], [2870, 1615], [2870, 3085], [885, 3085]],
}


def options(size, **known):
    """Copied by tilted cameras: shapes are known to 2 % and 1° only."""
    return FrameOptions((size,), aspect_sigma=0.02, angle_sigma_deg=1.0, **known)


@pytest.mark.slow
@pytest.mark.parametrize("name", STILLS)
def test_a_still_frame_is_oriented_at_its_edges(name, reference_data):
    size, corners = STILLS[name]
    (result,) = orient_frames(open_scan(reference_data("film_frames") / name), options(size))
    assert result.status == "oriented", result.why
    np.testing.assert_allclose(result.lines.corners, corners, rtol=0, atol=16)


@pytest.mark.slow
def test_a_still_frame_whose_edges_are_unevenly_sharp_is_declined_as_too_uncertain(reference_data):
    scan = open_scan(reference_data("film_frames") / "strw_in3.jpg")
    (result,) = orient_frames(scan, options((36.0, 24.0)))
    assert result.status == "declined"
    assert "standard deviation" in result.why


@pytest.mark.slow
@pytest.mark.parametrize("name", CINE)
def test_a_cine_frame_whose_film_is_a_few_pixels_wide_is_not_wrong_silently(name, reference_data):
    near = np.array(CINE[name], dtype=float)
    scan = open_scan(reference_data("film_frames") / name)
    (result,) = orient_frames(scan, options((22.0, 16.0), near=near))
    if not result:
        assert "edge" in result.why
        return
    sigma = np.sqrt(np.diag(result.lines.covariance)).reshape(4, 2)
    assert (np.abs(result.lines.corners - near) < 3 * np.hypot(sigma, 8)).all()
