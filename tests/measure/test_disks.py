"""Ellipses of a frame: the components that they are found as, beside those of OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from reseau.core.data import Mask
from reseau.measure.reseau.disks import part_sums


def masks() -> list[Mask]:
    """Noise of several densities, blots, lines and frames of one row or column."""
    rng, found = np.random.default_rng(1), []
    for density in (0.02, 0.3, 0.5, 0.6, 0.8, 1.0):
        found += [rng.random(shape) < density for shape in ((50, 70), (37, 1), (1, 40), (200, 301))]
        found.append(cv2.blur(rng.random((90, 120)).astype(np.float32), (5, 5)) < density)
    comb = np.ones((40, 60), dtype=bool)
    comb[:-1, ::2] = False  # teeth that only the last row joins
    return [*found, comb, comb[::-1], comb.T.copy()]


@pytest.mark.parametrize("mask", masks(), ids=lambda mask: "x".join(map(str, mask.shape)))
def test_components_have_the_moments_and_extents_of_those_of_opencv(mask: Mask) -> None:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    y, x = (axis.astype(np.float64) for axis in np.indices(mask.shape))
    powers = np.ones_like(x), x, y, x * x, x * y, y * y
    theirs = [np.bincount(labels.ravel(), power.ravel(), count)[1:] for power in powers]
    left, top, wide, high = stats[1:, :4].T
    sums, extent = part_sums(mask)
    own = np.concatenate([sums, extent]).T
    other = np.array([*theirs, left, left + wide - 1, top, top + high - 1]).T
    order, same = (np.lexsort(rows[:, :3].round(3).T) for rows in (own, other))
    np.testing.assert_allclose(own[order], other[same], rtol=0, atol=1e-3)
