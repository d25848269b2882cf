"""Lattices that grow through points of a frame, from a first mapping outwards."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import scipy

from ...core.data import Array, Mask, Rows
from ...optics.composition import Chain
from .lattice_mapping import images_of, second_order, started
from .lens_mapping import lens_through
from .plane_mapping import plane_through

_GATE = 0.22
"""Largest distance of a corner from its node, in steps of the lattice."""
_CHOICE = 16
"""Number of points near a node among which its corner is looked for: sharpened edges have many saddles."""
_FROM = 1.1
"""Distance from a known node within which the next are searched, in steps."""
LENS_FROM, SADDLE_PX = 8, 0.5
"""Least number of nodes from which the distortion of a lens is used; their standard deviation."""


def grown_through(
    xy: Array,
    mapping: Chain,
    extent: int,
    shape: tuple[int, int],
    accepted: Callable[[Chain, Array, Rows, Array], Mask],
    *,
    strongest: bool = False,
    reach: float = _FROM,
) -> tuple[Array, Rows, Chain]:
    """Grow a lattice through points (m, 2) of a frame.

    Parameters
    ----------
    xy, mapping, extent, shape
        The points, the strongest first; see :func:`grown`; height and width of the frame.
    accepted : callable
        Which of some nodes (n, 2) belong to these points (n,), given the mapping and its slopes there
        (n, 2, 2).
    strongest : bool
        Whether the strongest of the points that are accepted is the corner of a node, by default the nearest.

    Returns
    -------
    nodes, rows, mapping
        As :func:`grown`.
    """
    grid = np.array(list(product(range(-extent, extent + 1), repeat=2)), dtype=np.float64)
    tree = scipy.spatial.KDTree(xy)
    nodes, rows, free = np.zeros((1, 2)), np.zeros(1, dtype=np.intp), mapping
    through_lens = led = False
    for _ in range(3 * extent):
        beside = grid[scipy.spatial.KDTree(nodes).query(grid)[0] < max(reach, 1.6 if len(nodes) < 4 else 0.0)]
        predicted, slopes, _ = second_order(mapping, beside)
        pixels = np.maximum(np.linalg.norm(slopes, axis=1).min(axis=1), 1e-6)
        if led:
            predicted = predicted + _led(nodes, xy[rows] - images_of(mapping, nodes), beside)
        gap, at, which = _within(tree, predicted, _GATE * pixels)
        good = accepted(mapping, beside[at], which, slopes[at]) if len(at) else np.zeros(0, dtype=bool)
        gap, row = _first(len(beside), gap[good], at[good], which[good], strongest=strongest)
        taken = np.isfinite(gap)
        order = np.argsort(gap / pixels, kind="stable")
        _, once = np.unique(row[order], return_index=True)
        keep = np.sort(order[once])
        keep = keep[taken[keep]]
        same = np.array_equal(row[keep], rows) and np.array_equal(beside[keep], nodes)
        nodes, rows = beside[keep], row[keep]
        if len(rows) < 4 or np.ptp(nodes, axis=0).min() < 1 or (same and led):
            break
        if same and through_lens:
            # Behind a fisheye what nodes have in excess of the mapping is continued to those beside them.
            led = True
            continue
        if same and len(rows) < LENS_FROM:
            break
        # A polynomial through few nodes does not predict the next ones through a wide lens.
        through_lens |= same
        free = free if same else plane_through(nodes, xy[rows], shape)
        lens = None
        if through_lens:
            lens = lens_through(nodes, xy[rows], np.full(len(rows), SADDLE_PX), shape, free)
        mapping = free if lens is None else lens.mapping
    return nodes, rows, mapping


def _within(tree: scipy.spatial.KDTree, places: Array, gate: Array) -> tuple[Array, Rows, Rows]:
    """Points within the distance `gate` of some places: their distances, and rows of places and of points."""
    # A lens does not image all nodes.
    seen = np.flatnonzero(np.isfinite(places).all(axis=1))
    gap, row = tree.query(places[seen], k=np.arange(1, min(_CHOICE, tree.n) + 1))
    at, k = np.nonzero(gap < gate[seen, None])
    return gap[at, k], seen[at], row[at, k]


def _first(count: int, gap: Array, at: Rows, which: Rows, *, strongest: bool) -> tuple[Array, Rows]:
    """The strongest or nearest point at each of `count` places: distance (infinite without one) and row."""
    distance, row = np.full(count, np.inf), np.zeros(count, dtype=np.intp)
    order = np.lexsort((which if strongest else gap, at))
    first = order[np.unique(at[order], return_index=True)[1]]
    distance[at[first]], row[at[first]] = gap[first], which[first]
    return distance, row


def _led(nodes: Array, excess: Array, beside: Array) -> Array:
    """What nodes have in excess (n, 2) of a mapping, continued to those beside them (m, 2)."""
    low = nodes.min(axis=0) - 3
    field = np.full((*(np.ptp(nodes, axis=0) + 7).astype(np.intp), 2), np.nan)
    field[tuple((nodes - low).astype(np.intp).T)] = excess
    at, found = (beside - low).astype(np.intp), []
    for step in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        near, far = (field[tuple((at + k * np.array(step)).T)] for k in (1, 2))
        found.append(np.where(np.isfinite(far), 2 * near - far, near))
    known = np.isfinite(found)
    return np.asarray(np.where(known, found, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1))


def first_mapping(slope: Array, at: Array, shape: tuple[int, int]) -> Chain:
    """The linear mapping of a lattice with steps (2, 2) in columns from an image point."""
    return started(np.vstack([np.column_stack([slope, at]), [0.0, 0.0, 1.0]]), 1, shape)
