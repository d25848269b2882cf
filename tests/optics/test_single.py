"""Images formed in single precision, beside those in double."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.optics.formation import Outline, PixelResponse, coverage_derivatives
from reseau.optics.single import formed
from reseau.optics.targets import target_outline


@pytest.mark.parametrize("fill", [1.0, 0.8])
@pytest.mark.parametrize("shape", ["square", "triangle", "cross", "circle"])
def test_images_and_derivatives_are_those_in_double_precision(shape, fill):
    rng = np.random.default_rng(5)
    outline = target_outline(shape, 9.0, 20.0, 0.6)
    count, columns, rows = 20, np.arange(17.0), np.arange(19.0)
    matrices = np.eye(2) + 0.2 * rng.normal(size=(count, 2, 2))
    placed = outline.affine(matrices, rng.uniform(7, 10, (count, 2))).oriented()
    sigma, motion = rng.uniform(0.5, 1.5, count), rng.normal(size=placed.xy.shape)
    share, slopes = coverage_derivatives(placed, columns, rows, sigma, PixelResponse(fill), motion[:, None])
    pixels = np.tile(columns, (count, 1)), np.tile(rows, (count, 1))
    given = [a.astype(np.float32) for a in (placed.xy, placed.dxy, motion, *pixels, sigma)]
    parts, alone = (np.empty((count, n, 19, 17), np.float32) for n in (5, 1))
    formed(*given, fill, parts)
    formed(*given, fill, alone)
    # Of a signal of 200 grey values 5e-6 are a thousandth.
    np.testing.assert_allclose(parts[:, 0], share, rtol=0, atol=5e-6)
    np.testing.assert_allclose(alone[:, 0], share, rtol=0, atol=5e-6)
    np.testing.assert_allclose(parts[:, 1:], slopes, rtol=0, atol=3e-5)


def test_nodes_of_no_weight_and_light_that_falls_elsewhere_count_for_nothing():
    circle = Outline.circle(2.0, 0.5)
    xy, dxy = np.zeros((2, 2, len(circle.xy) + 7, 2), np.float32)
    xy[:, : len(circle.xy)], dxy[:, : len(circle.xy)] = circle.xy, circle.dxy
    xy[0] += 6.0
    xy[1] -= 60.0
    pixels, parts = np.tile(np.arange(13.0, dtype=np.float32), (2, 1)), np.empty((2, 1, 13, 13), np.float32)
    formed(xy, dxy, np.zeros_like(xy), pixels, pixels, np.full(2, 0.7, np.float32), 1.0, parts)
    assert parts[0].sum() == pytest.approx(np.pi * 4, abs=1e-4)
    assert np.abs(parts[1]).max() < 1e-6
