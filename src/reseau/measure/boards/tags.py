"""Tags whose corners touch other squares, as those of Kalibr's AprilGrid: found by their corners, and read.

A reader that looks for the outlines of separate tags fails where tags touch. Here a tag is a cycle of four
saddle points (:mod:`reseau.measure.boards.candidates`): from each of them an edge leads to the next, dark on
the same side all along. Its cells are then sampled through the projectivity of the four corners, and compared
with all words in all four rotations.

Source: E. Olson, AprilTag: A robust and flexible visual fiducial system, ICRA 2011, for the words and the
correction of wrong bits by the Hamming distance.
"""

from __future__ import annotations

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ..plane.levels import levels_at
from .candidates import Saddles

_NEIGHBOURS = 160
"""Saddles around a corner among which the next corner is looked for."""
_AIMED = np.deg2rad(7)
"""Largest angle between an edge and the direction to the next corner."""
_PARALLEL = np.deg2rad(15)
"""Largest angle between the edges of a tag at its two ends: lenses bend it."""
SEARCHES = ((0.08, 4.0), (0.25, 4.0), (0.25, 12.0))
"""How tags are looked for, one way after the other while few are found. Least strength of a corner, a share
of the strong ones of the frame: between corners of a large tag, noise and texture have many that are weak.
Radius of the circle on which edges are seen, pixels: motion turns them near a corner."""
_NEAR_PX, _PLACES = 4.0, 48
"""This radius where corners are not those of tags; number of places on the circle."""
_STRONG = 0.25
"""Least strength of the next corner as a share of that of a corner: noise has saddles on straight edges."""
_ALONG = 9
"""Places along an edge at which its sides are compared."""
_BESIDE = 0.055
"""Their distance from the edge, as a share of its length."""
_EDGE = 0.35
"""Least contrast along an edge, as a share of its median."""


def with_seen_edges(grey: NDArray[np.float32], saddles: Saddles, radius: float = _NEAR_PX) -> Saddles:
    """Saddles with the directions in which their edges are seen, which second derivatives do not show."""
    edges = _seen_edges(grey, saddles, radius)
    return Saddles(saddles.xy, edges, saddles.strength)


def _seen_edges(grey: NDArray[np.float32], saddles: Saddles, radius: float) -> Array:
    """Directions of the edges (n, 2) of saddles by where a circle around them crosses their own grey value.

    Second derivatives of a blurred corner are those of a right angle, whatever its angle is. Where the circle
    does not cross four times, the given directions remain.
    """
    angle, found = 2 * np.pi * np.arange(_PLACES + 1) / _PLACES, saddles.edges.copy()
    circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    level = levels_at(grey, saddles.xy[:, None] + circle) - levels_at(grey, saddles.xy[:, None])
    crossed = (level[:, 1:] > 0) != (level[:, :-1] > 0)
    rows = np.flatnonzero(crossed.sum(axis=1) == 4)
    place = np.nonzero(crossed[rows])[1].reshape(-1, 4)
    before, after = (np.take_along_axis(level[rows], place + k, axis=1) for k in (0, 1))
    at = 2 * np.pi * (place + before / (before - after)) / _PLACES
    # Both crossings of one line, half a turn apart; the first line is where bright begins.
    one, other = at[:, :2], at[:, 2:] - np.pi
    line = one + ((other - one + np.pi) % (2 * np.pi) - np.pi) / 2
    # The bright sector extends from the first to the second, less than half a turn.
    found[rows] = np.where(after[:, :1] > 0, line, line[:, ::-1] - [np.pi, 0.0])
    return found


def _are_edges(grey: NDArray[np.float32], start: Array, end: Array) -> Mask:
    """Whether lines (m) are dark on the right, seen in the image, and bright on the left, all along."""
    step, share = (end - start)[:, None], np.linspace(0.12, 0.88, _ALONG)[:, None]
    off = np.maximum(_BESIDE, 1.5 / np.linalg.norm(step, axis=2, keepdims=True))
    at = start[:, None] + share * step
    # A quarter turn of x into y: to the right in the image.
    beside = off * step[..., ::-1] * [1, -1]
    contrast = levels_at(grey, at + beside) - levels_at(grey, at - beside)
    least = contrast.min(axis=1)
    return np.asarray((least > 0) & (least > _EDGE * np.median(contrast, axis=1)))


def _next_corners(
    grey: NDArray[np.float32], saddles: Saddles, leaves: Array, arrives: Array, near: Rows
) -> Rows:
    """The corner (2 n,) to which the edge of each sector leads, -1 for none.

    Parameters
    ----------
    grey, saddles
        As of :func:`tag_outlines`; each saddle is a corner twice, with one dark sector and the other.
    leaves, arrives : ndarray (2 n,)
        Directions of the edges of the sectors, x into y.
    near : ndarray of int (n, k)
        Saddles around each, the nearest first.
    """
    n, after, xy = len(saddles), np.full(len(leaves), -1, np.intp), saddles.xy
    x, y = np.moveaxis(xy[near] - xy[:, None], 2, 0)
    along = np.cos(leaves).reshape(2, n, 1) * x + np.sin(leaves).reshape(2, n, 1) * y
    aimed = (along >= np.cos(_AIMED) * np.hypot(x, y)) & (
        saddles.strength[near] >= _STRONG * saddles.strength[:, None]
    )
    sector, corner, place = np.nonzero(aimed)
    own, other = sector * n + corner, near[corner, place]
    to = np.stack([other, other + n], axis=1)
    back = np.arctan2(y[corner, place], x[corner, place])[:, None] + np.pi
    fits = _apart(back, arrives[to]) < _AIMED
    fits &= _apart(leaves[own][:, None] + np.pi, arrives[to]) < _PARALLEL
    some = np.flatnonzero(fits.any(axis=1))
    some = some[_are_edges(grey, xy[corner[some]], xy[other[some]])]
    rows, nearest = np.unique(own[some], return_index=True)
    some = some[nearest]
    after[rows] = np.where(fits[some, 0], to[some, 0], to[some, 1])
    return after


def _apart(a: Array, b: Array) -> Array:
    """Angles between directions, 0 to π."""
    return np.asarray(np.abs((a - b + np.pi) % (2 * np.pi) - np.pi))


def tag_outlines(grey: NDArray[np.float32], saddles: Saddles, weak: float, radius: float) -> Rows:
    """Saddles (m, 4) that are the corners of dark quadrilaterals, clockwise in the image.

    Parameters
    ----------
    grey : ndarray (h, w), float32
        Grey values.
    saddles : Saddles
        Their saddles.
    weak : float
        Least strength of a corner, as a share of the strong ones of the frame.
    radius : float
        Of the circle around a saddle on which its edges are seen, pixels.
    """
    if len(saddles) < 4:
        return np.zeros((0, 4), dtype=np.intp)
    strong = np.flatnonzero(saddles.strength > weak * saddles.strength[:30].mean())
    saddles, count = saddles.select(strong), len(strong)
    # The dark sectors of a saddle extend from its second edge to the first, turned by 180°, and opposite.
    first, second = with_seen_edges(grey, saddles, radius).edges.T
    turn = np.pi * np.arange(2)[:, None]
    # Seen from a corner, the interior of a tag is the sector from `leaves` to `arrives`, x into y: a cycle
    # that is clockwise in the image leaves along the former and arrives against the latter.
    leaves, arrives = (second + turn).ravel(), (first + np.pi + turn).ravel()
    near = scipy.spatial.KDTree(saddles.xy).query(saddles.xy, k=min(_NEIGHBOURS + 1, count))[1][:, 1:]
    after = _next_corners(grey, saddles, leaves, arrives, near)
    cycle = [np.arange(2 * count)]
    for _ in range(4):
        cycle.append(np.where(cycle[-1] < 0, -1, after[cycle[-1]]))
    ring = np.stack(cycle[:4], axis=1)
    closed = (ring >= 0).all(axis=1) & (cycle[4] == cycle[0]) & (ring.argmin(axis=1) == 0)
    return np.asarray(strong[ring[closed] % count])


def read_tags(
    grey: NDArray[np.float32], corners: Array, words: Mask, border_bits: int, most_wrong: int
) -> tuple[Rows, Array]:
    """Read tags.

    Parameters
    ----------
    grey : ndarray (h, w), float32
        Grey values.
    corners : ndarray (m, 4, 2)
        Their corners in the image, clockwise.
    words : ndarray of bool (k, n, n)
        Black cells of the tags that may be there, with their borders.
    border_bits : int
        Width of the border, cells.
    most_wrong : int
        Largest number of cells that differ.

    Returns
    -------
    index : ndarray of int (m,)
        Which of the words each tag shows, -1 for none.
    corners : ndarray (m, 4, 2)
        The corners, from the upper left of the word.
    """
    side = words.shape[1]
    if not len(corners):
        return np.zeros(0, dtype=np.intp), corners
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    cell = (np.arange(side) + 0.5) / side
    u, v = (part.ravel() for part in np.meshgrid(cell, cell))
    # Paper beside the tag, where no other square touches it.
    out = 0.5 / side
    around = np.array([[0.5, -out], [1 + out, 0.5], [0.5, 1 + out], [-out, 0.5]])
    places = np.concatenate([np.column_stack([u, v]), around])
    images = np.empty((len(corners), len(places), 2))
    for k, quad in enumerate(corners):
        matrix = cv2.getPerspectiveTransform(unit.astype(np.float32), quad.astype(np.float32))
        image = np.column_stack([places, np.ones(len(places))]) @ matrix.T
        images[k] = image[:, :2] / image[:, 2:]
    levels = levels_at(grey, images)
    cells, paper = levels[:, : side * side].reshape(-1, side, side), np.median(levels[:, -4:], axis=1)
    border = np.ones((side, side), dtype=bool)
    border[border_bits:-border_bits, border_bits:-border_bits] = False
    ink = np.median(cells[:, border], axis=1)
    black = cells < ((paper + ink) / 2)[:, None, None]
    wrong = np.full((len(corners), 4, len(words)), side * side)
    flat = words.reshape(len(words), -1).astype(np.float32)
    for turn in range(4):
        # Turned so that corner `turn` is the upper left one.
        seen = np.rot90(black, turn, axes=(1, 2)).reshape(len(black), -1).astype(np.float32)
        differ = seen.sum(axis=1)[:, None] + flat.sum(axis=1) - 2 * seen @ flat.T
        wrong[:, turn] = np.rint(differ)
    best = wrong.reshape(len(corners), -1).argmin(axis=1)
    turn, index = np.divmod(best, len(words))
    least = wrong[np.arange(len(corners)), turn, index]
    known = (least <= most_wrong) & (paper > ink)
    order = (np.arange(4) + turn[:, None]) % 4
    return np.where(known, index, -1), corners[np.arange(len(corners))[:, None], order]
