"""Outlines of targets: their areas, centroids and directions."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.optics.targets import target_corners, target_outline

AREAS = {"square": 1.0, "triangle": np.sqrt(3) / 4, "cross": 5 / 9, "circle": np.pi / 4}


@pytest.mark.parametrize("shape", AREAS)
@pytest.mark.parametrize("angle", [0.0, 37.0, 215.0])
def test_targets_have_their_area_and_their_centroid_at_the_origin(shape: str, angle: float) -> None:
    outline = target_outline(shape, 6.0, angle, 0.5)
    (x, y), (dx, dy) = outline.xy.T, outline.dxy.T
    area = ((x * dy - y * dx) / 2).sum()
    assert area == pytest.approx(36 * AREAS[shape], abs=1e-9)
    # Green: the moments are integrals along the outline of x²/2 dy and −y²/2 dx.
    np.testing.assert_allclose([(x**2 * dy).sum(), (y**2 * dx).sum()], 0, rtol=0, atol=1e-9)


def test_the_triangle_has_its_apex_up_and_is_turned_from_x_into_y() -> None:
    upright, turned = target_corners("triangle", 9.0), target_corners("triangle", 9.0, 90.0)
    assert upright is not None
    assert turned is not None
    np.testing.assert_allclose(upright[0], [0, 9 / np.sqrt(3)], rtol=0, atol=1e-12)
    np.testing.assert_allclose(turned[0], [-9 / np.sqrt(3), 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.hypot(*(upright[0] - upright[1])), 9.0, rtol=0, atol=1e-12)


def test_the_arms_of_a_cross_are_a_third_of_its_length_by_default() -> None:
    for arm, width in ((None, 4.0), (1.5, 1.5)):
        corners = target_corners("cross", 12.0, arm=arm)
        assert corners is not None
        np.testing.assert_allclose(np.unique(corners[:, 0]), [-6, -width / 2, width / 2, 6], atol=1e-12)


def test_a_star_is_not_a_target() -> None:
    with pytest.raises(UsageError, match="no target of shape 'star'"):
        target_corners("star", 3.0)
