"""The lattice of a testfield from its targets, where its lines are too thin to be found.

Targets of a few pixels are local extremes of a smoothed frame. They form an almost regular lattice: within a
square they are equally spaced, and a little farther apart beside a line. The lattice is grown from a seed, as
corners of a chessboard are connected to a grid; the wider gaps then tell where the lines are.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, product
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Rows
from ...io import TestfieldDesign
from .lattice import rms
from .lattice_fit import LatticeFit, refit
from .lattice_mapping import images_of, slope_of, started

__all__ = ["lattices_of_targets"]

_SMOOTH_PX, _AROUND_PX = 0.4, 2.0
"""Widths of the Gaussians of which the difference shows targets of a few pixels."""
_SIGNIFICANT = 5.0
"""Minimum height of an extreme in noise sigmas."""
_NEIGHBOURS, _SEEDS = 12, 6
"""Number of neighbours among which the steps of the lattice are searched, and of seeds that are tried."""
_GATE = 0.3
"""Largest distance of a target from its node, in steps."""
_BESIDE = np.array(list(product((-1, 0, 1), repeat=2)))
"""Where others are searched from the nodes found, in steps."""
_LEAST = 40
"""Minimum number of targets on a lattice."""
_PLACED_PX = 0.3
"""Typical error of the place of a target."""
_PHASES, _OFF_STEP = 3, 0.1
"""Number of arrangements of the lines that are tried; largest rms distance of targets from their places, in
steps. It is about 0.02 in the right arrangement, 0.06 in a wrong one, and more than 0.2 where targets are so
large that their corners, too, are extremes."""


def lattices_of_targets(
    dark: NDArray[np.float32], noise: float, design: TestfieldDesign
) -> Iterator[LatticeFit]:
    """Lattices of lines between the targets of a frame, the likeliest first.

    Parameters
    ----------
    dark : ndarray (h, w), float32
        Grey values with dark targets on a bright background.
    noise : float
        Standard deviation of the grey values.
    design : TestfieldDesign
        The testfield; its targets are on a grid of as many rows as columns in every square.

    Examples
    --------
    The places of targets of four squares, 24 px wide, drawn as spots:

    >>> from reseau.designs import coded_testfield
    >>> design = coded_testfield(2, 2)
    >>> xy = 40 + 24 / design.pitch * (design.xy - design.xy.min(axis=0)) * [1, -1] + [0, 60]
    >>> x, y = np.meshgrid(np.arange(140.0), np.arange(140.0))
    >>> spots = sum(np.exp(-((x - u) ** 2 + (y - v) ** 2) / 3) for u, v in xy)
    >>> fit = next(lattices_of_targets(np.float32(200 - 100 * spots), 1.0, design))
    >>> centre = images_of(fit.mapping, np.array([[fit.across[1], fit.along[1]]], dtype=float))[0]
    >>> bool(np.abs(centre - xy.mean(axis=0)).max() < 0.1), fit.points
    (True, 64)
    """
    xy = _extremes(dark, noise)
    if len(xy) < _LEAST:
        return
    first = np.array(design.targets.square) == 1
    places = np.unique((design.xy[first, 0] - design.centres[0, 0]).round(3)) / design.pitch + 0.5
    best = 0
    for seed, steps in _seeds(xy):
        nodes, rows = _grown(xy, seed, steps, dark.shape)
        if len(nodes) < max(_LEAST, 1.2 * best):
            continue
        best = len(nodes)
        yield from _between_lines(nodes, xy[rows], places, dark.shape)


def _extremes(dark: NDArray[np.float32], noise: float) -> Array:
    """Places (n, 2) of dark spots, from a parabola through each and its neighbours."""
    spots = cv2.GaussianBlur(dark, (0, 0), _AROUND_PX) - cv2.GaussianBlur(dark, (0, 0), _SMOOTH_PX)
    peak = (spots == cv2.dilate(spots, np.ones((3, 3), np.uint8))) & (spots > _SIGNIFICANT * noise)
    peak[[0, -1]] = peak[:, [0, -1]] = False
    row, column = np.nonzero(peak)
    place = []
    for before, after in (
        (spots[row, column - 1], spots[row, column + 1]),
        (spots[row - 1, column], spots[row + 1, column]),
    ):
        bend = before - 2 * spots[row, column] + after
        place.append(0.5 * (before - after) / np.where(bend < 0, bend, -np.inf))
    return np.asarray(np.stack([column, row], axis=1) + np.stack(place, axis=1).clip(-0.5, 0.5))


def _seeds(xy: Array) -> Iterator[tuple[int, Array]]:
    """Targets with neighbours on a lattice around them, and its steps (2, 2) in columns."""
    distance, near = scipy.spatial.KDTree(xy).query(xy, k=min(_NEIGHBOURS, len(xy)))
    away = xy[near[:, 1:]] - xy[:, None]
    turns = np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]])
    support = np.zeros(len(xy), np.intp)
    steps = np.zeros((len(xy), 2, 2))
    area = np.full(len(xy), np.inf)
    for p, q in combinations(range(min(6, away.shape[1])), 2):
        pair = np.stack([away[:, p], away[:, q]], axis=2)
        size = np.abs(np.linalg.det(pair))
        length = np.linalg.norm(pair, axis=1)
        upright = size > 0.5 * length.prod(axis=1)
        expected = np.einsum("kij,nj->kni", pair, turns)
        gap = np.linalg.norm(expected[:, :, None] - away[:, None], axis=3).min(axis=2)
        found = (gap < _GATE * length.min(axis=1)[:, None]).sum(axis=1)
        better = upright & ((found > support) | ((found == support) & (size < 0.9 * area)))
        support[better], area[better] = found[better], size[better]
        steps[better] = pair[better]
    well = np.flatnonzero(support >= max(6, support.max()))
    if not len(well):
        return
    # Lattices of texture are small: begin where most seeds are.
    crowd = scipy.spatial.KDTree(xy[well]).query_ball_point(
        xy[well], 6 * float(np.median(distance[:, 1])), return_length=True
    )
    for k in well[np.argsort(-crowd, kind="stable")[:_SEEDS]]:
        yield int(k), steps[k]


def _grown(xy: Array, seed: int, steps: Array, shape: tuple[int, ...]) -> tuple[Rows, Rows]:
    """Nodes (m, 2) of the lattice grown from a seed, and the rows of the targets on them.

    With the first coordinate to the right, the second runs upwards.
    """
    if np.linalg.det(steps) > 0:
        steps = steps * [1.0, -1.0]
    tree, extent = scipy.spatial.KDTree(xy), int(np.ceil(np.sqrt(len(xy)))) + 4
    nodes, rows = np.zeros((1, 2), np.intp), np.array([seed])
    matrix = np.column_stack([np.vstack([steps, np.zeros(2)]), np.append(xy[seed], 1.0)])
    mapping, off = started(matrix, 1, shape), np.zeros((1, 2))
    for _ in range(3 * extent):
        beside = np.unique((nodes[:, None] + _BESIDE).reshape(-1, 2), axis=0)
        beside = beside[(np.abs(beside) <= extent).all(axis=1)]
        nearest = scipy.spatial.KDTree(nodes).query(beside)[1]
        at = beside.astype(np.float64)
        # Distortion, and the wider gaps beside lines, displace a node as they do the nearest one.
        predicted = images_of(mapping, at) + off[nearest]
        length = np.linalg.norm(slope_of(mapping, at), axis=1).min(axis=1)
        gap, row = tree.query(predicted)
        relative = gap / np.maximum(length, 1e-6)
        order = np.argsort(relative, kind="stable")
        order = order[relative[order] < _GATE]
        _, once = np.unique(row[order], return_index=True)
        keep = np.sort(order[once])
        same = len(keep) == len(rows) and np.array_equal(row[keep], rows)
        nodes, rows, at = beside[keep], row[keep], at[keep]
        if same or len(rows) < 6 or np.ptp(nodes, axis=0).min() < 1:
            break
        straight = cv2.findHomography(at, xy[rows])[0]
        if straight is None or not np.isfinite(straight).all() or abs(straight[2, 2]) < 1e-9:
            break
        mapping = started(np.asarray(straight, dtype=np.float64), 1, shape)
        off = xy[rows] - images_of(mapping, at)
    return nodes, rows


def _between_lines(nodes: Rows, xy: Array, places: Array, shape: tuple[int, ...]) -> Iterator[LatticeFit]:
    """Lattices of the lines, which may be beside every fourth target, the best first.

    Parameters
    ----------
    nodes, xy : ndarray of int (n, 2), ndarray (n, 2)
        Lattice of the targets, and their images.
    places : ndarray (m,)
        Places of the targets between two lines, as shares of their distance.
    """
    found = []
    for phases in product(range(len(places)), repeat=2):
        line, of = np.divmod(nodes + phases, len(places))
        at = line + places[of]
        straight: Any = cv2.findHomography(at, xy, cv2.RANSAC, 1.0)[0]
        if straight is None or not np.isfinite(straight).all() or abs(straight[2, 2]) < 1e-9:
            continue
        mapping = refit(started(straight, 1, shape), at, xy, _PLACED_PX)
        off = xy - images_of(mapping, at)
        usual = float(np.median(np.hypot(*off.T)))
        numbers = [np.arange(axis.min(), axis.max() + 2) for axis in line.T]
        step = float(np.median(np.linalg.norm(slope_of(mapping, at), axis=1))) / len(places)
        if rms(off) < _OFF_STEP * step:
            found.append((usual, phases, LatticeFit(mapping, numbers[0], numbers[1], rms(off), len(at))))
    for _, _, fit in sorted(found, key=lambda entry: entry[:2])[:_PHASES]:
        yield fit
