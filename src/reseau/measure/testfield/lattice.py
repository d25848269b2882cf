"""Straight lines of a testfield: their detection and numbering.

A line about one pixel wide is a ridge in the curvature of the grey values. Ridge points with their directions
vote for straight lines (Hough 1962; Ballard 1981). Rows of targets also get votes, but only a line is dark
along its whole length. The lines of a testfield are equally spaced; this spacing, in perspective, gives their
numbers. :mod:`reseau.measure.testfield.lattice_fit` adjusts them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from heapq import heappop, heappush
from itertools import chain, islice, product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Failure
from .compiled import ridges as compiled_ridges
from .straight_lines import distinct_lines, numberings, supported, voted

__all__ = ["BETWEEN_SIDES", "Lattice", "Ridges", "find_lattices", "median", "quantile", "ridge_points", "rms"]

_TURN = np.deg2rad(1.5)
"""Step of the Hough transform in angle; the step in distance is one pixel."""
_SPREAD = 4
"""A ridge point votes for this many steps in angle on either side of its own direction."""
_SIGNIFICANT = 4.0
"""Minimum curvature in noise sigmas."""
_LEAST_SHARE = 0.85
"""Minimum dark share of the length of a line; rows of targets reach three quarters."""
_BESIDE_PX, BETWEEN_SIDES = 2.5, 0.8
"""Distance from a line at which either side is compared with it, and the quantile that must be brighter."""
_STEP_PX, _DENSE = 8.0, 0.5
"""Steps along a line, and number of ridge points per pixel from which it is supported."""
_SECTION = 90
"""Length in pixels of the sections in which a line is tested; short enough for distorted lines."""
_OFF_STEP = 0.15
"""Largest deviation of a line from its place in its family, in steps."""
_NEAREST = 0.15
"""Least distance from the vanishing line, relative to that of the lines that determine the numbering."""
_NEXT_GAP = 1.5
"""Largest ratio of neighbouring gaps between lines."""
_FAMILY, _CROSSING = np.deg2rad(40.0), np.deg2rad(30.0)
"""Largest angle between the strongest line of a family and the others in the image; smallest between the
strongest lines of both families."""
_MOST_PEAKS, _MOST_LINES = 250, 48
_SURROUNDED, _SAMPLED = 480, 500
"""Size of the frame, in pixels, from which not all are used to find the brightest surroundings; number of
samples along its longest side from which they are more than two pixels apart on a line."""
_STRIP_PX = 60_000
"""Number of pixels of the strips in which derivatives are formed."""
_APART_PX = 5.0
"""Distance below which two lines are the same."""
_OWN = 0.5
"""Minimum share of ridge points of a line that are not those of a stronger one."""
_PARALLEL = float(np.cos(np.deg2rad(12.0)))
_FEW_POINTS, _ENOUGH_FOR_LINES = 10, 15000
_BEYOND_ALL = np.float32(1e30)
"""Larger than all grey values."""
_WIDEST = 200
"""Most lines of a family, found or not; a step that asks for more fits any lines."""
_ALIKE = 0.7
"""Share of lines with the same numbers from which two numberings are the same."""
_STRONGEST = (12, 24)
"""Numbers of the strongest lines of a family that alone begin numberings, too: rows of targets whose images
blend pass as lines, up to seven between two lines, but have fewer votes."""
_MOST_TRIED, _NUMBERINGS, _MOST_PAIRS, _CONSISTENT = 300, 5, 6, 0.04
"""Numberings of a family that are compared, that are kept, and pairs of both families that are tried; rms
deviation of lines from a common lattice, in steps, that halves the worth of a pair."""


@dataclass(frozen=True, eq=False)
class _Numbering:
    """Rows of lines of one family, their numbers, and how much speaks for these."""

    rows: Rows
    number: Rows
    worth: float


@dataclass(frozen=True, eq=False)
class Ridges:
    """Points on the centre lines of thin dark structures, in columns.

    Parameters
    ----------
    xy : ndarray (n, 2)
        Positions with sub-pixel accuracy.
    normal : ndarray (n, 2)
        Unit vectors across the structure.
    darkness : ndarray (h, w), float32
        Difference between the brightest surroundings and each pixel, grey values.
    """

    xy: Array
    normal: Array
    darkness: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Lattice:
    """Numbered lines of two families and the homography of their crossings.

    Parameters
    ----------
    homography : ndarray (3, 3)
        From line numbers (i, j) to the image. With i to the right, j runs upwards.
    across, along : ndarray of int (a,), (b,)
        Numbers i and j of the lines found.
    """

    homography: Array
    across: Rows
    along: Rows


def ridge_points(grey: NDArray[np.float32], noise: float, sigma: float = 1.0) -> Ridges:
    """Ridge points of dark lines on a bright background.

    The curvature across the line must be significant and that along it small; the ridge point is where the
    slope across vanishes (Steger 1998, An unbiased detector of curvilinear structures, IEEE PAMI 20).

    Parameters
    ----------
    grey : ndarray (h, w)
        Grey values.
    noise : float
        Standard deviation of the grey values.
    sigma : float
        Width of the smoothing Gaussian in pixels.
    """
    reach = int(np.ceil(4 * sigma))
    offset = np.arange(-reach, reach + 1)
    bell = np.exp(-0.5 * (offset / sigma) ** 2)
    bell /= bell.sum()
    slope, bend = offset / sigma**2 * bell, (offset**2 / sigma**4 - 1 / sigma**2) * bell
    least = _SIGNIFICANT * noise * float(np.sqrt((bend**2).sum() * (bell**2).sum()))
    kernels = [
        (x.astype(np.float32), y.astype(np.float32))
        for x, y in ((bend, bell), (bell, bend), (slope, slope), (slope, bell), (bell, slope))
    ]
    found = []
    # Strips of rows whose derivatives fit into a cache: those of a large frame would take long to allocate.
    high = max(4 * reach, _STRIP_PX // grey.shape[1])
    for first in range(0, len(grey), high):
        begin = max(first - reach, 0)
        strip, inner = grey[begin : first + high + reach], slice(first - begin, first - begin + high)
        xx, yy, xy, along, down = (
            np.asarray(cv2.sepFilter2D(strip, cv2.CV_32F, x, y))[inner] for x, y in kernels
        )
        points, normal = compiled_ridges(xx, yy, xy, along, down, least)
        points[:, 1] += first
        found.append((points, normal))
    points, normal = (np.concatenate(columns) for columns in zip(*found, strict=True))
    return Ridges(points, normal, _darkness(grey))


def _darkness(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    """Difference between the brightest value around each pixel and its own."""
    (h, w), each = grey.shape, max(1, max(grey.shape) // _SURROUNDED)
    # Of a smooth image, and for surroundings much wider than a pixel, means of some pixels are enough.
    few = cv2.resize(grey, (w // each, h // each), interpolation=cv2.INTER_AREA) if each > 1 else grey
    few = cv2.GaussianBlur(few, (0, 0), max(1.0 / each, 0.5))
    size = max(grey.shape) // (14 * each) | 1
    bright: Any = cv2.blur(cv2.dilate(few, np.ones((size, size), np.uint8)), (size, size))
    if each > 1:
        bright = cv2.resize(bright, (w, h))
    lack: NDArray[np.float32] = np.subtract(bright, grey, out=bright)
    return lack


def find_lattices(ridges: Ridges) -> Iterator[Lattice] | Failure:
    """Find two families of straight lines and number them.

    Returns
    -------
    iterator of Lattice, or Failure
        Possible numberings, the likeliest first, computed as they are asked for; at least one. A failure if
        either family has fewer than two lines.
    """
    lines = _candidates(ridges)
    if len(lines) < 4:
        return Failure("no straight lines were found", Code.NOT_FOUND)
    first = _family(lines, np.ones(len(lines), dtype=bool), np.ones(len(lines)))
    numbered = [_numbered(lines, first)]
    of_first = np.isin(np.arange(len(lines)), numbered[0][0].rows)
    main = lines.turn_from(int(first[0]))
    # The second family crosses the first; its own lines may lie at all angles, too.
    second = _family(lines, ~of_first & (main > np.sin(_CROSSING)), main**2)
    numbered.append(_numbered(lines, second) if len(second) else [])
    most = [max((len(one.rows) for one in each), default=0) for each in numbered]
    if min(most) < 2:
        return Failure(
            f"{most[0]} and {most[1]} equally spaced straight lines were found; two and two are needed",
            Code.NOT_FOUND,
        )
    ranked = _ranked(lines, numbered[0], numbered[1], ridges.darkness.shape)
    likeliest = next(ranked, None)
    if likeliest is None:
        return Failure("the straight lines found do not form one lattice", Code.NOT_FOUND)
    return chain([likeliest], islice(ranked, _MOST_PAIRS - 1))


def _ranked(
    lines: _Lines, first: list[_Numbering], second: list[_Numbering], shape: tuple[int, ...]
) -> Iterator[Lattice]:
    """Lattices of pairs of numberings, in the order of their worth."""
    # The deviation from a common lattice only lowers the worth: what is less by the numberings alone waits.
    pairs = sorted(product(first, second), key=lambda pair: -pair[0].worth * pair[1].worth)
    ready: list[tuple[float, int, Lattice]] = []
    for k, (one, other) in enumerate(pairs):
        bound = one.worth * other.worth
        while ready and -ready[0][0] >= bound:
            yield heappop(ready)[2]
        lattice = _lattice(lines, one, other, shape)
        if lattice is not None:
            off = _off_lattice(lattice, lines, one, other)
            heappush(ready, (-bound / (1 + (off / _CONSISTENT) ** 2), k, lattice))
    while ready:
        yield heappop(ready)[2]


@dataclass(frozen=True, eq=False)
class _Lines:
    """Straight lines in columns: normal · x = distance, ends of the points on them, and their weights."""

    normal: Array
    distance: Array
    ends: Array
    weight: Array

    def __len__(self) -> int:
        return len(self.weight)

    def turn_from(self, one: int) -> Array:
        """Sine of the angle between each line and one of them."""
        (x, y), (u, v) = self.normal.T, self.normal[one]
        return np.asarray(np.abs(x * v - y * u))


def _candidates(ridges: Ridges) -> _Lines:
    """Straight lines that are dark along their length between bright surroundings, the strongest first."""
    votes, reach = _hough(ridges)
    peak = votes == cv2.dilate(votes, np.ones((3, 3), np.uint8))
    least = max(20.0, 0.05 * min(ridges.darkness.shape))
    turn, distance = np.nonzero(peak & (votes > least))
    strongest = np.argsort(-votes[turn, distance], kind="stable")[:_MOST_PEAKS]
    turn, distance = turn[strongest], distance[strongest]
    angle, rho = turn * _TURN, (distance - reach).astype(np.float64)
    each = max(1, len(ridges.xy) // _ENOUGH_FOR_LINES)
    xy, normal = (np.ascontiguousarray(columns[::each]) for columns in (ridges.xy, ridges.normal))
    centre = _centre(ridges.darkness.shape)
    share = _dark_share(ridges.darkness, xy - centre, normal, each, angle, rho) if len(turn) else rho
    weight = votes[turn, distance] * share
    order = np.argsort(-weight, kind="stable")
    order = order[share[order] > _LEAST_SHARE]
    across = np.stack([np.cos(angle), np.sin(angle)], axis=1)[order]
    place = rho[order] + across @ centre
    near = _APART_PX / 2, _PARALLEL, _FEW_POINTS
    kept, normals, distances, ends = distinct_lines(xy, normal, across, place, near, _OWN, _MOST_LINES)
    return _Lines(normals, distances, ends, weight[order[kept]])


def _centre(shape: tuple[int, ...]) -> Array:
    return np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])


def _hough(ridges: Ridges) -> tuple[NDArray[np.float32], int]:
    """Votes of the ridge points for lines (angles, distances), and the index of distance 0."""
    at = ridges.xy - _centre(ridges.darkness.shape)
    reach = int(np.hypot(*ridges.darkness.shape) / 2) + 2
    turns = round(np.pi / _TURN)
    own = np.rint(np.arctan2(ridges.normal[:, 1], ridges.normal[:, 0]) / _TURN).astype(np.intp)
    direction = np.exp(1j * np.arange(turns) * _TURN).view(np.float64).reshape(-1, 2)
    return voted(at, own, direction, _SPREAD, reach).astype(np.float32), reach


def _dark_share(
    darkness: NDArray[np.float32], points: Array, normals: Array, each: int, angle: Array, rho: Array
) -> Array:
    """Share of the best sections of straight lines (n,) with at least half of the usual darkness.

    Of the whole line, or of the part of it with dense ridge points, of which every `each`-th is given with
    its normal, from the centre of the frame: a testfield may be small in the frame.
    """
    h, w = darkness.shape
    apart = max(2, round(max(h, w) / _SAMPLED))
    along = np.arange(-max(h, w) * 0.7, max(h, w) * 0.7, apart)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    step = _STEP_PX * each
    ends = supported(points, normals, normal, rho, _APART_PX / 2, _PARALLEL, step, _DENSE * step / each)
    x = _centre(darkness.shape)[0] + rho[:, None] * normal[:, :1] - along * normal[:, 1:]
    y = _centre(darkness.shape)[1] + rho[:, None] * normal[:, 1:] + along * normal[:, :1]
    inside = (x > 0) & (x < w - 1) & (y > 0) & (y < h - 1)
    # Search a pixel on either side: the position of the line is approximate.
    across = [
        cv2.remap(darkness, (x + d * c).astype(np.float32), (y + d * s).astype(np.float32), cv2.INTER_LINEAR)
        for d in (-_BESIDE_PX, -1.0, 0.0, 1.0, _BESIDE_PX)
        for c, s in ((normal[:, :1], normal[:, 1:]),)
    ]
    dark = np.max(across[1:-1], axis=0)
    dense = inside & (along >= ends[:, :1]) & (along <= ends[:, 1:])
    rises = [dark - beside for beside in (across[0], across[-1])]
    section = min(_SECTION, int(0.6 * min(h, w))) // apart
    return np.maximum(_share(dark, rises, inside, section), _share(dark, rises, dense, section))


def _share(dark: NDArray[np.float32], rises: list[NDArray[np.float32]], inside: Mask, length: int) -> Array:
    """Share of the best sections (n,) with at least half of the usual darkness of the samples inside."""
    inside = inside.copy()
    inside[:, 0] |= ~inside.any(axis=1)  # a median needs at least one value
    middle = quantile(dark, inside, 0.5)[:, None]
    seen, dark_part = (
        cv2.blur(mask.astype(np.float32), (length, 1)) for mask in (inside, (dark > 0.5 * middle) & inside)
    )
    # The edge of the board is dark on one side only; a line is darker than both sides.
    least = np.min([quantile(rise, inside, BETWEEN_SIDES) for rise in rises], axis=0)
    between = least > 0.1 * middle[:, 0]
    # A small part of a section is not sufficient.
    return np.asarray(
        np.where(seen > 0.8, dark_part / np.maximum(seen, 0.1), 0).max(axis=1) * between, dtype=np.float64
    )


def quantile(values: NDArray[np.float32], inside: Mask, share: float) -> Array:
    """Quantile (n,) of the values inside in each row; very large where none is."""
    ordered = np.sort(np.where(inside, values, _BEYOND_ALL), axis=1)
    place = share * np.maximum(inside.sum(axis=1) - 1, 0)
    low = place.astype(np.intp)
    rows = np.arange(len(values))
    below, above = ordered[rows, low], ordered[rows, np.ceil(place).astype(np.intp)]
    return np.asarray((1 - place + low) * below + (place - low) * above, dtype=np.float64)


def _family(lines: _Lines, among: Mask, preference: Array) -> Rows:
    """Lines that may belong to one family: the strongest one, first, and those less than 40° from it."""
    rows = np.flatnonzero(among)
    if not len(rows):
        return rows
    main = int(rows[np.argmax((lines.weight * preference)[rows])])
    near = rows[lines.turn_from(main)[rows] < np.sin(_FAMILY)]
    return np.concatenate([[main], near[near != main]])


def _numbered(lines: _Lines, rows: Rows) -> list[_Numbering]:
    """Numberings of equally spaced lines among others: their rows and numbers, the likeliest first.

    On any straight line the crossings of lines that are equally spaced in the plane of the testfield are a
    projective function of their numbers, n = α t / (1 + β t), which three of them determine. Such triples are
    tried, and the lines are counted that agree (Fischler and Bolles 1981).
    """
    if len(rows) < 3:
        return [_Numbering(rows, np.arange(len(rows)), float(lines.weight[rows].sum()))]
    along = lines.normal[rows[0]]
    # The crossings with a line through the middle of the family, perpendicular to its strongest line.
    middle = np.average(lines.ends[rows].mean(axis=1), axis=0, weights=lines.weight[rows])
    at = (lines.distance[rows] - lines.normal[rows] @ middle) / (lines.normal[rows] @ along)
    order = np.argsort(at, kind="stable")
    rows, at, weight = rows[order], at[order], lines.weight[rows[order]]
    limits = _OFF_STEP, _NEAREST, 0.5 * float(np.log(_NEXT_GAP)), _WIDEST
    given = at, weight, limits, (_MOST_TRIED, _NUMBERINGS), _ALIKE, _STRONGEST
    found = []
    for there, numbers, worth in zip(*numberings(*given), strict=True):
        lines_found = np.flatnonzero(there)
        order = np.argsort(numbers[lines_found])
        lines_found = lines_found[order]
        found.append(_Numbering(rows[lines_found], numbers[lines_found], float(worth)))
    # The two strongest may be the only ones.
    pair = np.sort(np.argsort(-weight, kind="stable")[:2])
    found.append(_Numbering(rows[pair], np.arange(2), float(weight[pair].sum())))
    return found


def _lattice(lines: _Lines, first: _Numbering, second: _Numbering, shape: tuple[int, ...]) -> Lattice | None:
    """The lattice of two numbered families; None if they do not determine one."""
    i, j = first.number, second.number
    if min(len(i), len(j)) < 2:
        return None
    equations = [
        np.column_stack([lines.normal[one.rows], -lines.distance[one.rows]]) for one in (first, second)
    ]
    homography = _homography(equations[0], i, equations[1], j, shape)
    if homography is None:
        return None
    middle = np.array([i.mean(), j.mean(), 1.0])
    # The derivative of a projectivity has the sign of its determinant times that of the denominator cubed.
    if np.linalg.det(homography) * (homography[2] @ middle) > 0:
        homography, j = homography * [1.0, -1.0, 1.0], -j
    return Lattice(homography, np.sort(i), np.sort(j))


def _off_lattice(lattice: Lattice, lines: _Lines, first: _Numbering, second: _Numbering) -> float:
    """Rms deviation of the ends of lines from integer lattice coordinates."""
    back = np.linalg.inv(lattice.homography)
    off = []
    for axis, one in enumerate((first, second)):
        ends = lines.ends[one.rows].reshape(-1, 2)
        at = np.column_stack([ends, np.ones(len(ends))]) @ back.T
        number = at[:, axis] / at[:, 2]
        off.append(number - np.rint(number))
    return rms(np.concatenate(off))


def _homography(first: Array, i: Rows, second: Array, j: Rows, shape: tuple[int, ...]) -> Array | None:
    """Homography from line numbers to the image, from the crossings of lines in and around the frame."""
    crossing = np.cross(first[:, None], second[None]).reshape(-1, 3)
    number = np.stack(np.meshgrid(i, j, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        xy = crossing[:, :2] / crossing[:, 2:]
    size = np.array([shape[1], shape[0]])
    for margin in (0.2, 1.0, 10.0):
        # Crossings far outside are extrapolated.
        near = ((xy > -margin * size) & (xy < (1 + margin) * size)).all(axis=1)
        if near.sum() >= 4 and all(len(np.unique(n)) > 1 for n in number[near].T):
            found: Any = cv2.findHomography(number[near], xy[near])[0]
            if found is not None and abs(found[2, 2]) > 1e-12 and np.isfinite(found).all():
                return np.asarray(found, dtype=np.float64)
    return None


def median(values: NDArray[Any]) -> float:
    """Median of finite values (n,), n > 0; ten times as fast for a few hundred as that of NumPy."""
    half = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, half)[half])
    low, high = np.partition(values, (half - 1, half))[half - 1 : half + 1].tolist()
    return float((low + high) / 2)


def rms(residuals: Array) -> float:
    """Root mean square of residuals."""
    return float(np.sqrt((residuals**2).mean()))
