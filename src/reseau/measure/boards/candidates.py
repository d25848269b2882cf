"""Places of a frame that look like corners of a chessboard, and the lattice that grows through them.

Where two edges cross, the smoothed image has a saddle point: the determinant of its second derivatives is
negative, and along the edges the second derivative is zero. This gives the directions of the edges and which
of the sectors between them are bright, so that a neighbour along an edge is recognised by its sectors being
exchanged.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ...optics.composition import Chain
from ..plane.growth import grown_through
from ..plane.levels import levels_around

_SMOOTH_PX = 1.5
"""Width of the smoothing, pixels."""
_BESIDE = 5
"""Side of the square in which a saddle is the strongest, pixels."""
_WEAK = 0.015
"""Least strength of a saddle, as a share of the strong ones."""
_LEAST_T = 5.0
"""Least curvature of a saddle over that of noise."""
_MOST = 3000
_TURNED = np.deg2rad(20)
"""Largest angle between the edges of neighbours."""
_OPEN = 0.2
"""Least sine of the angle between the steps of a lattice."""
_NEAR = 24
"""Number of neighbours examined for a seed."""
_SEEDS = 12
"""Most seeds of saddles of one strength."""
_STRONG = (0.3, 0.1, 0.0)
"""Strengths, as shares of the strongest, of the saddles among which seeds are looked for."""
_WELL = 5
"""Neighbours of a seed from which others are preferred for their strength alone, of 6."""
_GATE = 0.22
"""Largest distance of a corner from its node, in steps of the lattice."""
_DIAGONAL = 0.3
"""Where the sectors around a node are looked at, in steps along both axes."""
_CROSSED = 0.3
"""Least difference between the darker of two bright sectors and the brighter of two dark ones."""
_AROUND, _ACROSS, _ALONG = np.arange(-1, 2), np.array([-1.0, 0.0, 1.0]) / 2, np.array([1.0, 2.0, 1.0]) / 4
"""Pixels around a saddle, and Sobel's derivative by their columns and mean over their rows."""
_LARGE_PX = 2_500_000
"""Size of a frame from which it is searched at half its size."""


@dataclass(frozen=True, eq=False)
class Saddles:
    """Saddle points of a frame, in columns.

    Parameters
    ----------
    xy : ndarray (m, 2)
        Positions in pixels, good to a fraction of a pixel.
    edges : ndarray (m, 2)
        Directions of the two edges, radians, x into y: the sector from the first to the second is bright.
    strength : ndarray (m,)
        Square root of minus the determinant of the second derivatives, in descending order.
    """

    xy: Array
    edges: Array
    strength: Array

    def __len__(self) -> int:
        return len(self.xy)

    def select(self, keep: Mask | Rows) -> Saddles:
        """Selected saddles."""
        return Saddles(self.xy[keep], self.edges[keep], self.strength[keep])

    def mirrored(self, width: int) -> Saddles:
        """The saddles of the frame of this width with its columns reversed."""
        xy = self.xy * [-1, 1] + [width - 1, 0]
        return Saddles(xy, np.pi - self.edges[:, ::-1], self.strength)


def find_saddles(grey: NDArray[np.float32], noise: float) -> Saddles:
    """Find the saddle points of a frame that noise does not explain.

    Parameters
    ----------
    grey : ndarray (h, w), float32
        Grey values.
    noise : float
        Their standard deviation.
    """
    if grey.size > _LARGE_PX:
        h, w = (n // 2 * 2 for n in grey.shape)
        half: Any = cv2.resize(grey[:h, :w], (w // 2, h // 2), interpolation=cv2.INTER_AREA)
        found = find_saddles(half, noise / 2)
        # Pixel 0 at half the size covers pixels 0 and 1.
        return Saddles(2 * found.xy + 0.5, found.edges, found.strength)
    smooth = cv2.GaussianBlur(grey, (0, 0), _SMOOTH_PX)
    xx, yy, xy = (
        cv2.Sobel(smooth, cv2.CV_32F, i, j, ksize=3, scale=1 / 4) for i, j in ((2, 0), (0, 2), (1, 1))
    )
    power = cv2.subtract(cv2.multiply(xy, xy), cv2.multiply(xx, yy))
    beside = np.ones((_BESIDE, _BESIDE), np.uint8)
    peak = power >= cv2.dilate(power, beside)
    # White noise after a Gaussian of width s has second derivatives of sqrt(3/16/pi) / s³ times its own.
    floor = _LEAST_T * noise * np.sqrt(3 / (16 * np.pi)) / _SMOOTH_PX**3
    peak &= power > floor**2
    peak[:2], peak[-2:], peak[:, :2], peak[:, -2:] = False, False, False, False
    v, u = np.nonzero(peak)
    if not len(u):
        return Saddles(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    strength = power[v, u]
    strong = float(np.sort(strength)[-min(30, len(strength)) :].mean())
    order = np.argsort(-strength, kind="stable")
    order = order[strength[order] > _WEAK**2 * strong][:_MOST]
    v, u = v[order], u[order]
    a, b, c = (field[v, u].astype(np.float64) for field in (xx, xy, yy))
    near = smooth[v[:, None, None] + _AROUND[:, None], u[:, None, None] + _AROUND].astype(np.float64)
    gx, gy = ((near @ one) @ other for one, other in ((_ACROSS, _ALONG), (_ALONG, _ACROSS)))
    det = b * b - a * c
    # The saddle point of the parabola: H d = −g.
    dx, dy = (c * gx - b * gy) / det, (a * gy - b * gx) / det
    keep = np.hypot(dx, dy) < 2.0
    at = np.stack([u + dx, v + dy], axis=1)[keep]
    a, b, c, det = a[keep], b[keep], c[keep], det[keep]
    mean, apart = (a + c) / 2, np.hypot((a - c) / 2, b)
    axis = 0.5 * np.arctan2(2 * b, a - c)  # in which the image is most hollow: the middle of a bright sector
    opening = np.arctan(np.sqrt(np.maximum((apart + mean) / np.maximum(apart - mean, 1e-12), 0)))
    edges = np.stack([axis - opening, axis + opening], axis=1)
    return Saddles(at, edges, np.sqrt(det))


def _between(a: Array, b: Array) -> Array:
    """Angles between undirected lines, 0 to π/2."""
    off = np.abs(np.mod(a - b + np.pi / 2, np.pi) - np.pi / 2)
    return np.asarray(off)


def seeds(saddles: Saddles) -> list[tuple[int, Array]]:
    """Saddles with neighbours on all sides, and the steps (2, 2) of the lattice there, in columns.

    Strong saddles among themselves come first: texture and compression have weaker ones, also along edges.
    """
    found = []
    for share in _STRONG:
        level = share * float(saddles.strength[:30].mean()) if len(saddles) else 0.0
        rows = np.flatnonzero(saddles.strength >= level)
        found += [(int(rows[i]), step) for i, step in _seeds_among(saddles.select(rows))]
    return found


def _seeds_among(saddles: Saddles) -> list[tuple[int, Array]]:
    """Seeds of a part of the saddles, see :func:`seeds`."""
    if len(saddles) < 6:
        return []
    tree = scipy.spatial.KDTree(saddles.xy)
    most = min(_NEAR + 1, len(saddles))
    near = tree.query(saddles.xy, k=most)[1][:, 1:]
    away = saddles.xy[near] - saddles.xy[:, None]
    angle, length = np.arctan2(away[..., 1], away[..., 0]), np.hypot(*np.moveaxis(away, 2, 0))
    e = saddles.edges
    exchanged = (_between(e[near][..., 0], e[:, None, 1]) < _TURNED) & (
        _between(e[near][..., 1], e[:, None, 0]) < _TURNED
    )
    steps = np.full((len(saddles), 2, 2, 2), np.nan)  # edge, sign, xy
    for k in range(2):
        along = exchanged & (_between(angle, e[:, None, k]) < np.deg2rad(8))
        forward = np.cos(angle - e[:, None, k]) > 0
        for sign, side in ((0, forward), (1, ~forward)):
            there = np.where(along & side, length, np.inf)
            at = there.argmin(axis=1)
            some = np.isfinite(there[np.arange(len(at)), at])
            steps[some, k, sign] = away[np.flatnonzero(some), at[some]]
    # Steps to both sides are alike; where one is missing, the other serves.
    both = steps[:, :, 0], -steps[:, :, 1]
    ratio = np.linalg.norm(both[0], axis=2) / np.linalg.norm(both[1], axis=2)
    alike = (np.abs(np.log(ratio)) < 0.5).sum(axis=1)
    step = np.where(np.isfinite(both[0]), both[0], both[1])
    step = np.where(np.isfinite(both[0]) & np.isfinite(both[1]), (both[0] + both[1]) / 2, step)
    usable = np.isfinite(step).all(axis=(1, 2))
    # Saddles along one edge are no lattice.
    across = step[:, 0, 0] * step[:, 1, 1] - step[:, 0, 1] * step[:, 1, 0]
    usable &= np.abs(across) > _OPEN * np.linalg.norm(step, axis=2).prod(axis=1)
    # How many of the diagonal neighbours are there.
    support = np.zeros(len(saddles))
    for i, j in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        at = saddles.xy + i * step[:, 0] + j * step[:, 1]
        gap = np.full(len(at), np.inf)
        gap[usable] = tree.query(at[usable])[0]
        shorter = np.linalg.norm(step, axis=2).min(axis=1)
        support += gap < _GATE * shorter
    score = np.where(usable, support + alike, -1.0)
    # The strongest with most neighbours: compression and texture have weak lattices of their own.
    order = np.argsort(-(score >= _WELL).astype(int), kind="stable")
    return [(int(i), step[i].T) for i in order[:_SEEDS] if score[i] >= 3]


def grown(
    grey: NDArray[np.float32], saddles: Saddles, mapping: Chain, extent: int, odd: bool | None = None
) -> tuple[Array, Rows, Chain]:
    """Grow a lattice through saddles.

    Parameters
    ----------
    grey : ndarray (h, w), float32
        Grey values.
    saddles : Saddles
        The saddles.
    mapping : Chain
        First mapping of the lattice to the image, true around its node (0, 0).
    extent : int
        Largest number of nodes along an axis.
    odd : bool, optional
        Whether the sector between the steps of the lattice at node (0, 0) is bright; by default what the
        saddle there shows.

    Returns
    -------
    nodes : ndarray (m, 2)
        Nodes of the lattice that were found.
    rows : ndarray of int (m,)
        Their saddles.
    mapping : Chain
        Mapping through them.
    """
    shape, bright_at_first = (grey.shape[0], grey.shape[1]), odd

    def accepted(mapping: Chain, beside: Array, row: Rows, slopes: Array) -> Mask:
        nonlocal bright_at_first
        bright = bright_between(saddles.edges[row], slopes)
        if bright_at_first is None:
            bright_at_first = bool(bright[(beside == 0).all(axis=1)][0])
        expected = (beside.sum(axis=1) % 2 == 0) == bright_at_first
        taken = (bright == expected) & along(saddles.edges[row], slopes)
        return np.asarray(taken & crossed(sector_levels(grey, mapping, beside), bright))

    return grown_through(saddles.xy, mapping, extent, shape, accepted, strongest=True)


def sector_levels(grey: NDArray[np.float32], mapping: Chain, nodes: Array, share: float = _DIAGONAL) -> Array:
    """Grey values (n, 4) in the sectors around nodes of a lattice: after, before, and beside both steps."""
    around = share * np.array([[1, 1], [-1, -1], [1, -1], [-1, 1]])
    return levels_around(grey, mapping, nodes, around)


def crossed(levels: Array, bright: Mask) -> Mask:
    """Whether both bright sectors (n, 4) are brighter than both dark ones by a share of the contrast."""
    lit, unlit = _lit_and_unlit(levels, bright)
    contrast = lit.mean(axis=1) - unlit.mean(axis=1)
    return np.asarray(lit.min(axis=1) - unlit.max(axis=1) > _CROSSED * np.maximum(contrast, 1e-9))


def ended(levels: Array, bright: Mask) -> Mask:
    """Whether one of the dark sectors of (n, 4) is paper: corners of single squares, where a pattern ends."""
    lit, unlit = _lit_and_unlit(levels, bright)
    contrast = lit.mean(axis=1) - unlit.min(axis=1)
    # Each level is that of paper or of ink, whichever is nearer.
    return np.asarray((np.ptp(unlit, axis=1) > contrast / 2) & (np.ptp(lit, axis=1) < contrast / 2))


def _lit_and_unlit(levels: Array, bright: Mask) -> tuple[Array, Array]:
    """Levels (n, 2) of the sectors that should be bright, and of those that should be dark."""
    first, second = levels[:, :2], levels[:, 2:]
    return np.where(bright[:, None], first, second), np.where(bright[:, None], second, first)


def bright_between(edges: Array, slopes: Array) -> Mask:
    """Whether the sector between the steps (n, 2, 2) of a lattice is bright at saddles."""
    middle = edges.mean(axis=1)
    unit = slopes / np.maximum(np.linalg.norm(slopes, axis=1, keepdims=True), 1e-12)
    sector = unit.sum(axis=2)
    other = unit[..., 0] - unit[..., 1]
    off, across = (_between(np.arctan2(v[:, 1], v[:, 0]), middle) for v in (sector, other))
    return np.asarray(off < across)


def along(edges: Array, slopes: Array) -> Mask:
    """Whether the edges of saddles have the directions of the lattice."""
    lines = np.arctan2(slopes[:, 1], slopes[:, 0])  # (n, 2)
    one = np.maximum(_between(edges[:, 0], lines[:, 0]), _between(edges[:, 1], lines[:, 1]))
    two = np.maximum(_between(edges[:, 0], lines[:, 1]), _between(edges[:, 1], lines[:, 0]))
    return np.asarray(np.minimum(one, two) < 1.5 * _TURNED)
