"""Slanted wires of a phantom: where the plane of the image cuts them, as a share of their length.

The parallel wires of an N-wire phantom determine an affinity from the plane of the design to the image; the
slanted ones are cut somewhere on their segments. The share at which one is cut tells where along the wires
the image plane passes (Chen et al. 2009, Ultrasound Med. Biol. 35(1), 79-93).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from ...core.data import Array, Rows
from ...core.failure import Code
from ..points import Reason

_BEYOND = 0.05
"""A wire may be seen beyond the ends of its segment by this share of its length: its design is not exact. Its
uncertainty may add as much again."""
_CLEARER = 3.0
"""Factor by which another echo must be farther from a segment than the one that is taken."""
_LEAST = 4
"""Minimum number of points that test an affinity; three define one."""


@dataclass(frozen=True, eq=False)
class Cuts:
    """Echoes on segments, in columns.

    Parameters
    ----------
    row : ndarray of int (k,)
        Index of the echo on each segment, -1 where there is none.
    share, sigma : ndarray (k,)
        Position of the echo on the segment, 0 at its start and 1 at its end, and its standard deviation; NaN
        where there is none.
    ends : ndarray (k, 2, 2)
        Ends of the segments in the image; NaN if their places are unknown.
    why : tuple of str (k,)
        Why a segment has no echo; empty where it has one.
    """

    row: Rows
    share: Array
    sigma: Array
    ends: Array
    why: tuple[str, ...]


def cut_segments(
    segments: Array, xy: Array, cov: Array, source: Array, target: Array, gate_px: float
) -> Cuts:
    """Assign echoes to segments, and determine the shares at which they are cut.

    Parameters
    ----------
    segments : ndarray (k, 2, 2)
        Ends of the segments in the plane of the design.
    xy, cov : ndarray (m, 2), (m, 2, 2)
        Echoes that belong to no point of the design (px, px²).
    source, target : ndarray (f, 2)
        Points of the design that were found, and their echoes (px).
    gate_px : float
        Largest distance of an echo from its segment.

    Examples
    --------
    >>> source = np.array([[0.0, 0.0], [30.0, 0.0], [0.0, 15.0], [30.0, 15.0]])
    >>> segment, echo = np.array([[[0.0, 0.0], [30.0, 0.0]]]), np.array([[36.0, 0.2]])
    >>> cuts = cut_segments(segment, echo, 1e-4 * np.eye(2)[None], source, 3 * source, 5.0)
    >>> cuts.row, cuts.share.round(3)
    (array([0]), array([0.4]))
    """
    count = len(segments)
    none = np.full(count, np.nan)
    row = np.full(count, -1)
    if len(source) < _LEAST:
        unknown = Reason(f"fewer than {_LEAST} parallel wires determine its place", Code.TOO_FEW_POINTS)
        return Cuts(row, none, none, np.full((count, 2, 2), np.nan), (unknown,) * count)
    design = np.column_stack([source, np.ones(len(source))])
    inverse = np.linalg.pinv(design)
    matrix = np.asarray(inverse @ target)
    rest = target - design @ matrix
    scatter = float((rest**2).sum() / (2 * (len(source) - 3)))
    ends = segments @ matrix[:2] + matrix[2]
    along = ends[:, 1] - ends[:, 0]
    length = np.hypot(*along.T)
    unit = along / length[:, None]
    offset = xy[None] - ends[:, :1]
    share = (offset * unit[:, None]).sum(axis=-1) / length[:, None]
    across = np.abs(offset[..., 0] * unit[:, None, 1] - offset[..., 1] * unit[:, None, 0])
    # The points tell how well an echo agrees with the affinity, in x and y alike; the point predicted on the
    # segment is that much less certain.
    at = segments[:, :1] + share[..., None] * (segments[:, 1] - segments[:, 0])[:, None]
    lever = np.concatenate([at, np.ones((*at.shape[:2], 1))], axis=-1) @ inverse
    own = np.einsum("ki,mij,kj->km", unit, cov, unit)
    sigma = np.sqrt(np.maximum(own, scatter) + scatter * (lever**2).sum(axis=-1)) / length[:, None]
    beyond = np.abs(share - np.clip(share, 0, 1)) > _BEYOND + np.minimum(3 * sigma, _BEYOND)
    cost = np.where(beyond | (across > gate_px), 2.0, across / gate_px)
    why = Reason("no echo on its segment", Code.NOT_FOUND).repeated(count)
    mine, theirs = scipy.optimize.linear_sum_assignment(cost) if xy.size else (row[:0], row[:0])
    for wire, echo in zip(mine, theirs, strict=True):
        if cost[wire, echo] > 1:
            continue
        others = np.setdiff1d(np.flatnonzero(cost[wire] <= 1), theirs)
        if len(others) and cost[wire, others].min() < _CLEARER * max(float(cost[wire, echo]), 0.1):
            why[wire] = Reason(f"{len(others) + 1} echoes lie on its segment", Code.AMBIGUOUS)
            continue
        row[wire], why[wire] = echo, ""
    found = row >= 0
    taken = (np.flatnonzero(found), row[found])
    picked, spread = none.copy(), none.copy()
    picked[found], spread[found] = share[taken], sigma[taken]
    return Cuts(row, picked, spread, ends, tuple(why))
