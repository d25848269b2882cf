"""The lattice of a testfield, grown from its targets.

In a frame reduced so far that targets have a few pixels they are local extremes of the smoothed image,
whatever their shape; lines are too thin to be any. Targets form an almost regular lattice: within a square
they are equally spaced, and a little farther apart beside a line. The lattice is grown from a seed, as that
of the corners of a chessboard; the wider gaps then tell where the lines are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, product

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Rows
from ...io import TestfieldDesign
from ...optics.composition import Chain
from ..plane.lattice_mapping import images_of, slope_of, started
from ..plane.plane_mapping import plane_through, projectivity_behind

_SMOOTH_PX, _AROUND_PX = 0.4, 2.0
"""Widths of the Gaussians of which the difference shows targets of a few pixels."""
_SIGNIFICANT = 5.0
"""Minimum height of an extreme in noise sigmas."""
_SOME, _NEIGHBOURS, _SEEDS = 100, 12, 6
"""Number of spots that are compared with their neighbours, of these, and of seeds that are tried."""
_GATE = 0.3
"""Largest distance of a target from its node, in steps."""
_BESIDE = np.array(list(product((-1, 0, 1), repeat=2)))
"""Where others are searched from the nodes found, in steps."""
_BASES = np.array(
    [[[1, 0], [0, 1]], [[1, 0], [1, 1]], [[1, 0], [-1, 1]], [[1, 1], [0, 1]], [[1, -1], [0, 1]]]
)
"""Bases of a lattice: seen at a flat angle, a diagonal is as short as an axis."""
_LEGIBLE_PX = 4.0
"""Distance of targets, along the axis where it is larger, below which they are sought at a finer scale."""
_MUCH = 0.1
"""Share of the spots on a lattice from which others are searched among the rest."""
_LEAST = 12
"""Minimum number of targets on a lattice."""
_OFF_STEP = 0.1
"""Largest median distance of targets from their places, in steps. It is about 0.02 in the right arrangement
of the lines, and more than 0.2 where targets are so large that their corners, too, are extremes."""


@dataclass(frozen=True, eq=False)
class LatticeFit:
    """The lattice of the lines of a testfield.

    Parameters
    ----------
    mapping : Chain
        From lattice coordinates to the image; y runs upwards if x runs to the right, unless mirrored. The
        first coordinate is i on line i of the first family, the second is j on line j of the other.
    across, along : ndarray of int (a,), (b,)
        Numbers of the lines beside and between the targets.
    """

    mapping: Chain
    across: Rows
    along: Rows


def lattices(xy: Array, design: TestfieldDesign, shape: tuple[int, ...]) -> Iterator[LatticeFit]:
    """Lattices of lines between the targets of a frame, the likeliest first.

    Parameters
    ----------
    xy : ndarray (n, 2)
        Places of targets, and of other spots.
    design : TestfieldDesign
        The testfield; its targets are on a grid of as many rows as columns in every square.
    shape : tuple of int
        Height and width of the frame.

    Examples
    --------
    The places of targets of four squares, 24 px wide:

    >>> from reseau.designs import coded_testfield
    >>> design = coded_testfield(2, 2)
    >>> xy = 40 + 24 / design.pitch * (design.xy - design.xy.min(axis=0)) * [1, -1] + [0, 60]
    >>> fit = next(lattices(xy, design, (140, 140)))
    >>> centre = images_of(fit.mapping, np.array([[fit.across[1], fit.along[1]]], dtype=float))[0]
    >>> bool(np.abs(centre - xy.mean(axis=0)).max() < 0.1)
    True
    """
    first = np.array(design.targets.square) == 1
    places = np.unique((design.xy[first, 0] - design.centres[0, 0]).round(3)) / design.pitch + 0.5
    while len(xy) >= _LEAST:
        # Of targets that are legible, and of others.
        largest = [np.zeros(0, dtype=np.intp)] * 2
        for seed, steps in _seeds(xy):
            if any(seed in rows for rows in largest):
                continue
            nodes, rows = _grown(xy, seed, steps, shape)
            fine = int(np.linalg.norm(steps, axis=0).max() < _LEGIBLE_PX)
            if len(nodes) >= max(_LEAST, 1.2 * len(largest[fine])):
                largest[fine] = rows
                if not fine:
                    yield from _between_lines(nodes, xy[rows], places, shape)
        taken = np.union1d(*largest)
        if len(taken) < _MUCH * len(xy):
            return
        # Another testfield, of which the targets may be larger, may be beside it.
        xy = np.delete(xy, taken, axis=0)


def extremes(dark: NDArray[np.float32], noise: float) -> Array:
    """Places (n, 2) of dark spots of a few pixels, from a parabola through each and its neighbours.

    Parameters
    ----------
    dark : ndarray (h, w), float32
        Grey values with dark targets on a bright background.
    noise : float
        Standard deviation of the grey values.

    Examples
    --------
    >>> x, y = np.meshgrid(np.arange(20.0), np.arange(20.0))
    >>> extremes(np.float32(200 - 100 * np.exp(-((x - 8.2) ** 2 + (y - 11) ** 2) / 3)), 1.0).round(1).tolist()
    [[8.2, 11.0]]
    """
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
    """Some of the targets with neighbours on a lattice around them, and its steps (2, 2) in columns."""
    some = np.arange(len(xy))[:: max(1, len(xy) // _SOME)]
    distance, near = scipy.spatial.KDTree(xy).query(xy[some], k=min(_NEIGHBOURS, len(xy)))
    away = xy[near[:, 1:]] - xy[some, None]
    turns = np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]])
    support = np.zeros(len(some), np.intp)
    steps = np.zeros((len(some), 2, 2))
    area = np.full(len(some), np.inf)
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
    # Lattices of texture are small: begin where most seeds are.
    reach = 6 * float(np.median(distance[:, 1])) * np.sqrt(len(xy) / len(some))
    crowd = scipy.spatial.KDTree(xy[some]).query_ball_point(xy[some[well]], reach, return_length=True)
    for k in well[np.argsort(-crowd, kind="stable")[:_SEEDS]]:
        yield int(some[k]), steps[k]


def _grown(xy: Array, seed: int, steps: Array, shape: tuple[int, ...]) -> tuple[Rows, Rows]:
    """Nodes (m, 2) of the lattice grown from a seed, and the rows of the targets on them.

    With the first coordinate to the right, the second runs upwards.
    """
    if np.linalg.det(steps) > 0:
        steps = steps * [1.0, -1.0]
    tree, extent = scipy.spatial.KDTree(xy), int(np.ceil(np.sqrt(len(xy)))) + 4
    wide, nodes, rows = 2 * extent + 3, np.zeros((1, 2), np.intp), np.array([seed])
    matrix = np.column_stack([np.vstack([steps, np.zeros(2)]), np.append(xy[seed], 1.0)])
    mapping, off = started(matrix, 1, shape), np.zeros((1, 2))
    for _ in range(3 * extent):
        # Nodes as single numbers, which are sorted faster.
        number = (nodes @ [wide, 1])[:, None] + _BESIDE @ [wide, 1] + (extent + 1) * (wide + 1)
        beside = np.stack(np.divmod(np.unique(number), wide), axis=1) - extent - 1
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
        straight = projectivity_behind(at, xy[rows], (shape[0], shape[1]), 0.0)[0]
        if straight is None or not np.isfinite(straight).all() or abs(straight[2, 2]) < 1e-9:
            break
        mapping = started(straight, 1, shape)
        off = xy[rows] - images_of(mapping, at)
    return nodes, rows


def _between_lines(nodes: Rows, xy: Array, places: Array, shape: tuple[int, ...]) -> Iterator[LatticeFit]:
    """Lattices of the lines, which are in the wider of the gaps between targets, the likeliest first.

    Parameters
    ----------
    nodes, xy : ndarray of int (n, 2), ndarray (n, 2)
        Lattice of the targets, and their images.
    places : ndarray (m,)
        Places of the targets between two lines, as shares of their distance.
    """
    count, expected = len(places), np.log((1 + places[0] - places[-1]) / (places[1] - places[0]))
    for basis in _BASES:
        turned = nodes @ basis
        wider = _wider_gaps(turned, xy, count)
        told = np.isfinite(wider).all(axis=1)
        if (wider[told].max(axis=1) > expected / 4).all():
            break
    else:
        return  # equal gaps, of another target
    nodes, wider = turned, np.nan_to_num(wider)
    phases = sorted(product(range(count), repeat=2), key=lambda pair: -wider[0, pair[0]] - wider[1, pair[1]])
    # Half of what a wrong arrangement along one axis takes.
    least = wider[0, phases[0][0]] + wider[1, phases[0][1]] - expected / 2
    for phase in phases:
        if wider[0, phase[0]] + wider[1, phase[1]] < least:
            break
        line, of = np.divmod(nodes + phase, count)
        at = line + places[of]
        mapping = plane_through(at, xy, (shape[0], shape[1]))
        off = np.hypot(*(xy - images_of(mapping, at)).T)
        step = float(np.median(np.linalg.norm(slope_of(mapping, at), axis=1))) / count
        if np.median(off) < _OFF_STEP * step:
            yield LatticeFit(mapping, *(np.arange(axis.min(), axis.max() + 2) for axis in line.T))


def _wider_gaps(nodes: Rows, xy: Array, count: int) -> Array:
    """How much wider (2, m) the gaps are, along each axis, that lines would divide beside every m-th target.

    Compared with the gaps before and after them, as logarithms: perspective changes all of them gradually.
    NaN where there are no such gaps.
    """
    low = nodes.min(axis=0)
    places = np.full((*(np.ptp(nodes, axis=0) + 1), 2), np.nan)
    places[tuple((nodes - low).T)] = xy
    found = np.full((2, count), np.nan)
    for axis in range(2):
        gap = np.log(np.linalg.norm(np.diff(np.moveaxis(places, axis, 0), axis=0), axis=2))
        bend = gap[1:-1] - (gap[:-2] + gap[2:]) / 2
        for phase in range(count):
            # Gaps are beyond the targets with their numbers; the first has no gap before it.
            own = bend[(np.arange(len(bend)) + 1 + low[axis] + phase) % count == count - 1]
            if np.isfinite(own).any():
                found[axis, phase] = np.nanmean(own)
    return found
