"""Assignment of echoes to wires: fit a pattern of points and segments to detections.

A rod parallel to the normal of the scanner is cut by every image plane at the same point of the pattern; an
oblique rod (the diagonal of an N) is cut somewhere on a segment. The points determine the position of the
pattern: two points and two detections give a similarity; the one with most support is refined to an affinity,
which allows for different scales in depth and across. Segments are assigned last. The pattern may appear
mirrored or upside down.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Failure

_BASES = 30
"""Number of distant pairs of wires that are tried as a base."""
_FOLLOWED = 40
"""Number of best similarities that are refined."""
_LEAST = 4
"""Minimum number of points that test an affinity; three define one."""
_ANISOTROPY = 1.4
"""Largest ratio of the scales in two directions."""
_ALIKE = 0.1
"""Minimum difference in score (wires found, minus half the relative rms) between two positions."""
_BY_CHANCE = 0.01
"""Largest number of positions, as good as the one found, that may be expected by chance."""
_EXACT_PX = 0.5
"""Residuals below this are as good as any: no rods are straighter."""
_BEYOND = 0.15
"""A wire may be seen beyond the ends of its segment by this share of its length."""


@dataclass(frozen=True, eq=False)
class Wires:
    """Intersections of wires with the plane of the pattern, in columns.

    Parameters
    ----------
    ids : tuple of str (n,)
        Names of the wires.
    start, end : ndarray (n, 2)
        Ends of the segment on which each wire may be cut; identical for a wire normal to the plane.

    Examples
    --------
    >>> import numpy as np
    >>> grid = np.stack(np.meshgrid([0.0, 10, 20], [0.0, 10]), axis=-1).reshape(-1, 2)
    >>> Wires(tuple("abcdef"), grid, grid).spacing
    10.0
    """

    ids: tuple[str, ...]
    start: Array
    end: Array

    @property
    def fixed(self) -> Mask:
        """Mask (n,) of the wires normal to the plane."""
        return np.asarray((self.start == self.end).all(axis=1))

    @property
    def spacing(self) -> float:
        """Median distance of a point to its nearest neighbour."""
        points = self.start[self.fixed]
        return float(np.median(scipy.spatial.KDTree(points).query(points, k=2)[0][:, 1]))


@dataclass(frozen=True)
class LayoutOptions:
    """What is known about a pattern in the image.

    Parameters
    ----------
    gate : float
        Largest distance of a wire from its predicted position, relative to the spacing of the pattern.
    max_rotation : float
        Largest rotation (rad) of the pattern against `direction`, upright or upside down.
    mirrored : bool, optional
        Whether the image has the opposite handedness; None to determine it.
    direction : float
        Angle (rad) in the image of what is along x in the pattern.

    Examples
    --------
    >>> LayoutOptions(mirrored=False).gate
    0.15
    """

    gate: float = 0.15
    max_rotation: float = np.deg2rad(12.0)
    mirrored: bool | None = None
    direction: float = 0.0


@dataclass(frozen=True, eq=False)
class Layout:
    """Position of a pattern in the image, and the assigned detections.

    Parameters
    ----------
    row : ndarray of int (n,)
        Index of the detection of each wire, -1 where there is none.
    matrix : ndarray (2, 2)
        Linear part of the affinity from the pattern to the image.
    shift : ndarray (2,)
        Image of the pattern's origin.
    gate_px : float
        Largest accepted distance of a point from its prediction.
    rms_px : float
        Root mean square of the points' distances from the affinity.
    ambiguous : bool
        Whether the pattern fits in another way as well, because it is symmetric.

    Examples
    --------
    >>> import numpy as np
    >>> layout = Layout(np.arange(4), 2 * np.eye(2), np.array([5.0, 5.0]), gate_px=3.0, rms_px=0.1)
    >>> layout(np.array([[1.0, 2.0]]))
    array([[7., 9.]])
    """

    row: Rows
    matrix: Array
    shift: Array
    gate_px: float
    rms_px: float
    ambiguous: bool = False

    def __call__(self, xy: Array) -> Array:
        """Image of points (n, 2) of the pattern."""
        return xy @ self.matrix.T + self.shift

    def inverse(self, xy: Array) -> Array:
        """Points of the pattern (n, 2) with the images `xy`."""
        return np.asarray(np.linalg.solve(self.matrix, (xy - self.shift).T).T)


def lay_wires(
    wires: Wires, seen: Array, options: LayoutOptions | None = None, start: Array | None = None
) -> Layout | Failure:
    """Find the pattern among detections.

    Parameters
    ----------
    wires : Wires
        The pattern, with at least four points.
    seen : ndarray (m, 2)
        Detections in pixels, which may include false ones.
    options : LayoutOptions, optional
        What is known about the pattern in the image.
    start : ndarray (n, 2), optional
        Approximate positions of all wires in pixels, to half their spacing; no other positions are tried.

    Returns
    -------
    Layout or Failure
        A failure if fewer than four points agree with the pattern, or if as many would agree by chance.

    Examples
    --------
    >>> import numpy as np
    >>> points = np.array([[0.0, 0], [10, 0], [20, 0], [0, 10], [10, 10], [0, 25]])
    >>> wires = Wires(tuple("abcdef"), points, points)
    >>> seen = points[::-1] * [4.0, -4.0] + [50, 120]
    >>> lay_wires(wires, seen).row
    array([5, 4, 3, 2, 1, 0])
    """
    o = options or LayoutOptions()
    points = wires.start[wires.fixed]
    if len(points) < _LEAST:
        return Failure(
            f"the pattern has {len(points)} points; {_LEAST} are needed to find it", Code.TOO_FEW_POINTS
        )
    if len(seen) < _LEAST:
        return Failure(
            f"{len(seen)} echoes of {len(wires.ids)} wires; {_LEAST} are needed to identify them",
            Code.TOO_FEW_POINTS,
        )
    if start is not None:
        near = _refined(wires, seen, *_affinity(points, start[wires.fixed]), o)
        if near is None:
            return Failure("fewer than four echoes lie near the nominal positions", Code.TOO_FEW_POINTS)
        return _supported(wires, seen, near, 1.0)
    tried: list[tuple[float, bool, Layout]] = []
    upright = np.exp(1j * o.direction)
    for factor, shift, mirror in _hypotheses(points, seen, wires.spacing, o):
        linear = np.array([[factor.real, -factor.imag], [factor.imag, factor.real]])
        layout = _refined(wires, seen, linear @ np.diag([1.0, -1.0 if mirror else 1.0]), shift, o)
        if layout is None:
            continue
        found = int((layout.row >= 0).sum())
        score = found - 0.5 * layout.rms_px / layout.gate_px
        # If the pattern is ambiguous, the upright one with y up is preferred.
        tried.append((score, not mirror or (factor / upright).real < 0, layout))
    if not tried:
        return Failure(
            f"no position of the {len(wires.ids)} wires fits the {len(seen)} echoes", Code.NOT_FOUND
        )
    highest = max(score for score, _, _ in tried)
    alike = sorted((one for one in tried if one[0] > highest - _ALIKE), key=lambda one: (one[1], -one[0]))
    chosen = alike[0][2]
    there = chosen(points)
    rivals = any(np.abs(one[2](points) - there).max() > chosen.gate_px for one in alike[1:])
    # Every pair of echoes, for every pair of points, that is not turned too far.
    pairs = len(seen) * (len(seen) - 1) * min(2 * o.max_rotation / np.pi, 1.0)
    return _supported(
        wires, seen, replace(chosen, ambiguous=rivals), pairs * (2 if o.mirrored is None else 1)
    )


def _supported(wires: Wires, seen: Array, layout: Layout, positions: float) -> Layout | Failure:
    """The layout, or a failure if as good a one is to be expected by chance.

    Of `positions` that each pair of points can take, C(n, m) p^(m − 2) have m of n points near one of the
    share (m ρ²/g²)^(r/2)/Γ(r/2 + 1) has residuals as small as ρ in the r = 2 m − 6
    dimensions that an affinity leaves: a ball, over the gates. A segment is met with probability M 2 g L/A.

    leaves: a ball in as many dimensions, over the gates. A segment is met with probability M 2 g L/A.
    """
    fixed = wires.fixed
    n, m = int(fixed.sum()), int((layout.row[fixed] >= 0).sum())
    gate, echoes = layout.gate_px, len(seen)
    width, height = np.ptp(np.concatenate([seen, layout(wires.start[fixed])]), axis=0) + 2 * gate
    area = float(width * height)
    near = min(echoes * np.pi * gate**2 / area, 1.0)
    chance = np.log(positions) + _log_choose(n, m) + (m - 2) * np.log(near)
    half = m - 3.0
    ball = m * (max(layout.rms_px, _EXACT_PX) / gate) ** 2
    chance += min(half * np.log(ball) - float(scipy.special.gammaln(half + 1)), 0.0)
    askew = np.flatnonzero(~fixed)
    met = askew[layout.row[askew] >= 0]
    if len(askew):
        long = np.hypot(*(layout(wires.end[askew]) - layout(wires.start[askew])).T)
        hit = min(max(echoes - m, 1) * 2 * gate * float(long.mean()) / area, 1.0)
        chance += min(_log_choose(len(askew), len(met)) + len(met) * np.log(hit), 0.0)
    if chance < np.log(_BY_CHANCE):
        return layout
    expected = float(np.exp(min(chance, 20.0)))
    return Failure(
        f"{m} of {n} wires fit {m} of {echoes} echoes to {layout.rms_px:.2g} px, which proves nothing:"
        f" {expected:.2g} such positions are to be expected by chance;"
        " give nominal positions, more wires, or a smaller rotation",
        Code.AMBIGUOUS,
    )


def _log_choose(n: int, m: int) -> float:
    return float(
        scipy.special.gammaln(n + 1) - scipy.special.gammaln(m + 1) - scipy.special.gammaln(n - m + 1)
    )


def _hypotheses(
    points: Array, seen: Array, spacing: float, o: LayoutOptions
) -> list[tuple[complex, Array, bool]]:
    """Similarities supported by most points, as complex factor, shift and handedness."""
    first, second = np.triu_indices(len(points), 1)
    far = np.argsort(-np.hypot(*(points[first] - points[second]).T), kind="stable")[:_BASES]
    first, second = first[far], second[far]
    i, j = np.nonzero(~np.eye(len(seen), dtype=bool))
    z, tree = seen[:, 0] + 1j * seen[:, 1], scipy.spatial.KDTree(seen)
    found: list[tuple[float, complex, Array, bool]] = []
    for mirror in (True, False) if o.mirrored is None else (o.mirrored,):
        p = points[:, 0] + (-1j if mirror else 1j) * points[:, 1]
        factor = (z[j] - z[i])[:, None] / (p[second] - p[first])
        turn = np.abs(np.angle((factor * np.exp(-1j * o.direction)) ** 2)) / 2  # upright or upside down
        pair, base = np.nonzero(turn <= o.max_rotation)
        a = factor[pair, base]
        b = z[i[pair]] - a * p[first[base]]
        placed = a[:, None] * p + b[:, None]
        distance, _ = tree.query(np.stack([placed.real, placed.imag], axis=-1))
        off = distance / (np.abs(a)[:, None] * spacing)
        votes = np.clip(1 - (off / (2 * o.gate)) ** 2, 0, None).sum(axis=1)
        for k in np.argsort(-votes, kind="stable")[:_FOLLOWED]:
            found.append((float(votes[k]), complex(a[k]), np.array([b[k].real, b[k].imag]), mirror))
    found.sort(key=lambda item: -item[0])
    return [item[1:] for item in found[:_FOLLOWED]]


def _refined(wires: Wires, seen: Array, matrix: Array, shift: Array, o: LayoutOptions) -> Layout | None:
    """Affinity through points and their detections, with decreasing search radius; then the segments."""
    points, fixed = wires.start[wires.fixed], np.flatnonzero(wires.fixed)
    for factor in (2.0, 1.5, 1.0, 1.0):
        scale = np.sqrt(abs(np.linalg.det(matrix)))
        gate = factor * o.gate * scale * wires.spacing
        mine, theirs = nearest_pairs(points @ matrix.T + shift, seen, gate)
        if len(mine) < _LEAST:
            return None
        design = np.column_stack([points[mine], np.ones(len(mine))])
        if np.linalg.matrix_rank(design, tol=1e-6 * np.abs(design).max()) < 3:
            return None
        matrix, shift = _affinity(points[mine], seen[theirs])
        large, small = np.linalg.svd(matrix, compute_uv=False)
        if large > _ANISOTROPY * small:
            return None
    rest = points[mine] @ matrix.T + shift - seen[theirs]
    row = np.full(len(wires.ids), -1)
    row[fixed[mine]] = theirs
    rms = float(np.sqrt((rest**2).sum(axis=1).mean()))
    layout = Layout(row, matrix, shift, float(gate), rms)
    _read_segments(wires, seen, layout)
    return layout


def _affinity(points: Array, seen: Array) -> tuple[Array, Array]:
    """Linear part and shift of the best affinity."""
    design = np.column_stack([points, np.ones(len(points))])
    solved = np.asarray(np.linalg.lstsq(design, seen, rcond=None)[0], dtype=np.float64)
    return solved[:2].T, solved[2]


def nearest_pairs(predicted: Array, seen: Array, gate: float) -> tuple[Rows, Rows]:
    """Pair points and detections one to one within a distance, with the least sum of squared distances.

    Parameters
    ----------
    predicted, seen : ndarray (n, 2), (m, 2)
        Predicted and detected positions.
    gate : float
        Largest distance.

    Returns
    -------
    mine, theirs : ndarray of int (k,)
        Indices of the paired points and detections.
    """
    distance = np.hypot(*np.moveaxis(predicted[:, None] - seen[None], -1, 0))
    cost = np.minimum(distance / gate, 1.0) ** 2
    mine, theirs = scipy.optimize.linear_sum_assignment(cost)
    near = distance[mine, theirs] < gate
    return mine[near], theirs[near]


def _read_segments(wires: Wires, seen: Array, layout: Layout) -> None:
    """Assign to the segments detections that lie on them and belong to no point."""
    askew = np.flatnonzero(~wires.fixed)
    free = np.setdiff1d(np.arange(len(seen)), layout.row)
    if not len(askew) or not len(free):
        return
    start, end = layout(wires.start[askew]), layout(wires.end[askew])
    along = end - start
    offset = seen[free][None] - start[:, None]
    share = (offset * along[:, None]).sum(axis=-1) / (along**2).sum(axis=-1)[:, None]
    foot = np.clip(share, 0, 1)[..., None] * along[:, None]
    distance = np.hypot(*np.moveaxis(offset - foot, -1, 0))
    beyond = np.abs(share - np.clip(share, 0, 1)) > _BEYOND
    cost = np.where(beyond, 2.0, np.minimum(distance / layout.gate_px, 2.0))
    mine, theirs = scipy.optimize.linear_sum_assignment(cost)
    good = cost[mine, theirs] < 1
    layout.row[askew[mine[good]]] = free[theirs[good]]
