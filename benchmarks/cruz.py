"""The method of Cruz, Cardenal and Delgado, section 2.2 of their paper: baseline of `frames.py`.

Search areas are given, as selected by a user; each is rotated so that its edge is an upper one. Steps:
Prewitt template, threshold 80, line with the most white pixels within a tilt of 1°, window of 30 pixels
around it, profiles, the three largest gradients of each, regression line without points beyond 3σ.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau.core.data import Array

__all__ = ["cruz_corners"]

THRESHOLD, WINDOW, PROFILES, TILT_DEG = 80.0, 30, 200, 1.0
_PREWITT = np.array([[-1, -1, -1], [0, 0, 0], [1, 1, 1]], dtype=np.float32)


def cruz_corners(grey: NDArray[np.uint8], areas: Array, bright_film: bool = False) -> Array | None:
    """Corners ul, ur, lr, ll (4, 2) of a frame; None where an edge has no pixel above the threshold.

    Parameters
    ----------
    grey : ndarray (h, w)
        The scan, 8 bits.
    areas : ndarray (4, 4)
        Search areas of the upper, right, lower and left edge: x0, y0, x1, y1.
    bright_film : bool
        Whether the film is a negative; it is inverted first.
    """
    image = 255 - grey if bright_film else grey
    lines = []
    for k, (x0, y0, x1, y1) in enumerate(np.rint(areas).astype(int)):
        x0, y0 = max(x0, 0), max(y0, 0)
        part = image[y0:y1, x0:x1]
        # The upper edge, and the others rotated or flipped to upper ones.
        upper = [part, np.rot90(part), part[::-1], np.rot90(part, -1)][k]
        fit = _edge(np.ascontiguousarray(upper).astype(np.float32))
        if fit is None:
            return None
        h, w = part.shape
        x = np.array([0.0, upper.shape[1] - 1.0])
        y = fit[0] + fit[1] * x
        back = [(x, y), (w - 1 - y, x), (x, h - 1 - y), (y, h - 1 - x)][k]
        lines.append(np.stack(back, axis=1) + np.array([x0, y0]))
    ends = np.array(lines)
    line = np.cross(
        np.concatenate([ends[:, 0], np.ones((4, 1))], axis=1),
        np.concatenate([ends[:, 1], np.ones((4, 1))], axis=1),
    )
    corner = np.cross(np.roll(line, 1, axis=0), line)
    return np.asarray(corner[:, :2] / corner[:, 2:])


def _edge(part: NDArray[np.float32]) -> tuple[float, float] | None:
    """Regression line y = a + b·x of an upper edge."""
    gradient = cv2.filter2D(part, cv2.CV_32F, _PREWITT, borderType=cv2.BORDER_REPLICATE)
    white = gradient > THRESHOLD
    h, w = part.shape
    column = np.arange(w)
    best, found = -1, (0.0, 0.0)
    most = np.tan(np.deg2rad(TILT_DEG)) * w / 2
    for rise in np.arange(-np.ceil(most), np.ceil(most) + 1):
        shift = np.rint(rise * (2 * column / (w - 1) - 1)).astype(int)
        for row in range(h):
            at = row + shift
            inside = (at >= 0) & (at < h)
            count = int(white[at[inside], column[inside]].sum())
            if count > best:
                best, found = count, (float(row), float(rise))
    if best <= 0:
        return None
    middle = found[0] + found[1] * (2 * column / (w - 1) - 1)
    x, y = [], []
    for c in np.unique(np.linspace(0, w - 1, PROFILES).astype(int)):
        low = max(int(middle[c]) - WINDOW // 2, 0)
        profile = gradient[low : low + WINDOW, c]
        if len(profile) < 3:
            continue
        top = np.argsort(-profile, kind="stable")[:3]
        x += [float(c)] * 3
        y += (low + top).astype(float).tolist()
    px, py = np.array(x), np.array(y)
    keep = np.ones(len(px), dtype=bool)
    for _ in range(20):
        slope, level = np.polyfit(px[keep], py[keep], 1)
        left = py - level - slope * px
        fresh = np.abs(left) <= 3 * left[keep].std(ddof=2)
        if (fresh == keep).all() or fresh.sum() < 6:
            break
        keep = fresh
    return float(level), float(slope)
