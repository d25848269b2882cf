"""The lattice of straight lines of a testfield: detection of lines, numbering, and adjustment as one mapping.

A line about one pixel wide is a ridge in the curvature of the grey values. Ridge points with their directions
vote for straight lines (Hough 1962; Ballard 1981). Rows of targets also get votes, but only a line is dark
along its whole length. The lines of a testfield are equally spaced; this spacing, in perspective, gives their
numbers.

All lines are then adjusted together: on line i of the first family the first lattice coordinate is i, on line
j of the second family the second is j. The mapping F from lattice to image is a projectivity followed by a
polynomial of third degree for lens distortion and bending of the board. Observed is the distance
:math:`n^T(F(s) - p)` of a ridge point p with normal n, where s is the nearest point of its line.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ...adjust import BatchOptions, adjust_batch, weight_function
from ...core.data import Array, Rows
from ...core.failure import Code, Failure
from ...optics import Chain, PlaneMapping, RationalPolynomial
from ...optics.field import trend_degree
from ...optics.newton import solve_2x2
from .line_profiles import crossings, located

__all__ = [
    "Lattice",
    "LatticeFit",
    "Ridges",
    "find_lattice",
    "fit_lattice",
    "lattices",
    "refit",
    "ridge_points",
    "second_order",
    "slope_of",
    "straightened",
]

_TURN = np.deg2rad(1.5)
"""Step of the Hough transform in angle; the step in distance is one pixel."""
_SPREAD = 4
"""A ridge point votes for this many steps in angle on either side of its own direction."""
_SIGNIFICANT = 4.0
"""Minimum curvature in noise sigmas."""
_LEAST_SHARE = 0.85
"""Minimum dark share of the length of a line; rows of targets reach three quarters."""
_SECTION = 90
"""Length in pixels of the sections in which a line is tested; short enough for distorted lines."""
_OFF_STEP = 0.2
"""Largest deviation of a gap between lines from an integer number of steps, as a share of the gap."""


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
    offset = np.arange(-int(np.ceil(4 * sigma)), int(np.ceil(4 * sigma)) + 1)
    bell = np.exp(-0.5 * (offset / sigma) ** 2)
    bell /= bell.sum()
    slope, bend = offset / sigma**2 * bell, (offset**2 / sigma**4 - 1 / sigma**2) * bell

    def filtered(x: Array, y: Array) -> NDArray[np.float32]:
        smooth: Any = cv2.sepFilter2D(grey, cv2.CV_32F, x.astype(np.float32), y.astype(np.float32))
        return np.asarray(smooth, dtype=np.float32)

    xx, yy, xy = filtered(bend, bell), filtered(bell, bend), filtered(slope, slope)
    half, mean = (xx - yy) / 2, (xx + yy) / 2
    root = cv2.magnitude(half, xy)
    across = mean + root
    least = _SIGNIFICANT * noise * float(np.sqrt((bend**2).sum() * (bell**2).sum()))
    row, column = np.nonzero((across > least) & (np.abs(mean - root) < 0.5 * across))
    at = row, column
    angle = 0.5 * np.arctan2(xy[at], half[at])
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    gradient = np.stack([filtered(slope, bell)[at], filtered(bell, slope)[at]], axis=1)
    step = -(gradient * normal).sum(axis=1) / across[at]
    on = np.abs(step) < 0.7
    points = np.stack([column, row], axis=1)[on] + step[on, None] * normal[on]
    return Ridges(points.astype(np.float64), normal[on].astype(np.float64), _darkness(grey))


def _darkness(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    """Difference between the brightest value around each pixel and its own."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    size = max(grey.shape) // 14 | 1
    bright = cv2.blur(cv2.dilate(smooth, np.ones((size, size), np.uint8)), (size, size))
    lack: NDArray[np.float32] = bright - grey
    return lack


def find_lattice(ridges: Ridges) -> Lattice | Failure:
    """Find two families of straight lines and number them.

    Returns
    -------
    Lattice or Failure
        A failure if either family has fewer than two lines.
    """
    candidates = _candidates(ridges)
    if len(candidates) < 4:
        return Failure("no straight lines were found", Code.NOT_FOUND)
    families = _families(candidates)
    numbered = [_numbered(family, ridges.darkness.shape) for family in families]
    if min(len(number) for _, number in numbered) < 2:
        found = " and ".join(str(len(number)) for _, number in numbered)
        return Failure(
            f"{found} equally spaced straight lines were found; two and two are needed", Code.NOT_FOUND
        )
    (first, i), (second, j) = numbered
    homography = _homography(first, i, second, j)
    middle = np.array([i.mean(), j.mean(), 1.0])
    # The derivative of a projectivity has the sign of its determinant times that of the denominator cubed.
    if np.linalg.det(homography) * (homography[2] @ middle) > 0:
        homography, j = homography * [1.0, -1.0, 1.0], -j
    return Lattice(homography, i, j)


def _candidates(ridges: Ridges) -> Array:
    """Straight lines (n, 4): angle of the normal, distance from the frame's centre, votes, dark share."""
    votes, reach = _hough(ridges)
    peak = votes == cv2.dilate(votes, np.ones((3, 3), np.uint8))
    least = max(20.0, 0.12 * min(ridges.darkness.shape))
    turn, distance = np.nonzero(peak & (votes > least))
    if not len(turn):
        return np.zeros((0, 4))
    strongest = np.argsort(-votes[turn, distance], kind="stable")[:250]
    turn, distance = turn[strongest], distance[strongest]
    angle, rho = turn * _TURN, (distance - reach).astype(np.float64)
    share = _dark_share(ridges.darkness, angle, rho)
    lines = np.stack([angle, rho, votes[turn, distance], share], axis=1)[share > _LEAST_SHARE]
    # Strongest first; a line that is nearly the same as a stronger one is skipped.
    kept: list[Array] = []
    for line in lines[np.argsort(-lines[:, 2] * lines[:, 3], kind="stable")]:
        if all(_apart(line, other) for other in kept):
            kept.append(line)
    return np.array(kept).reshape(-1, 4)


def _apart(line: Array, other: Array) -> bool:
    turn = line[0] - other[0]
    rho = other[1] * (1 if np.cos(turn) > 0 else -1)
    return bool(abs(np.sin(turn)) > np.sin(np.deg2rad(12)) or abs(line[1] - rho) > 6)


def _centre(shape: tuple[int, ...]) -> Array:
    return np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])


def _hough(ridges: Ridges) -> tuple[NDArray[np.float32], int]:
    """Votes of the ridge points for lines (angles, distances), and the index of distance 0."""
    at = ridges.xy - _centre(ridges.darkness.shape)
    reach = int(np.hypot(*ridges.darkness.shape) / 2) + 2
    turns, width = round(np.pi / _TURN), 2 * reach + 1
    own = np.rint(np.arctan2(ridges.normal[:, 1], ridges.normal[:, 0]) / _TURN).astype(np.intp)
    votes = np.zeros(turns * width)
    for turn in range(-_SPREAD, _SPREAD + 1):
        k = (own + turn) % turns
        cosine, sine = np.cos(np.arange(turns) * _TURN)[k], np.sin(np.arange(turns) * _TURN)[k]
        rho = at[:, 0] * cosine + at[:, 1] * sine + reach
        low = np.floor(rho).astype(np.intp)
        part = rho - low
        votes += np.bincount(k * width + low, 1 - part, minlength=votes.size)
        votes += np.bincount(k * width + low + 1, part, minlength=votes.size)
    return votes.reshape(turns, width).astype(np.float32), reach


def _dark_share(darkness: NDArray[np.float32], angle: Array, rho: Array) -> Array:
    """Share of the best sections of straight lines (n,) with at least half of the usual darkness."""
    h, w = darkness.shape
    along = np.arange(-max(h, w) * 0.7, max(h, w) * 0.7)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    x = _centre(darkness.shape)[0] + rho[:, None] * normal[:, :1] - along * normal[:, 1:]
    y = _centre(darkness.shape)[1] + rho[:, None] * normal[:, 1:] + along * normal[:, :1]
    inside = (x > 0) & (x < w - 1) & (y > 0) & (y < h - 1)
    # Search two pixels on either side: the position of the line is approximate.
    across = [
        cv2.remap(darkness, (x + d * c).astype(np.float32), (y + d * s).astype(np.float32), cv2.INTER_LINEAR)
        for d in (-1.0, 0.0, 1.0)
        for c, s in ((normal[:, :1], normal[:, 1:]),)
    ]
    dark = np.max(across, axis=0)
    inside[:, 0] |= ~inside.any(axis=1)  # a median needs at least one value
    middle = np.nanmedian(np.where(inside, dark, np.nan), axis=1, keepdims=True)
    section = (min(_SECTION, int(0.6 * min(h, w))), 1)
    seen, dark_part = (
        cv2.blur(mask.astype(np.float32), section) for mask in (inside, (dark > 0.5 * middle) & inside)
    )
    # A small part of a section is not sufficient.
    return np.asarray(
        np.where(seen > 0.8, dark_part / np.maximum(seen, 0.1), 0).max(axis=1), dtype=np.float64
    )


def _families(lines: Array) -> tuple[Array, Array]:
    """Lines nearly parallel to the strongest one, and those that cross it."""
    turn = np.abs(np.sin(lines[:, 0] - lines[0, 0]))
    first, others = lines[turn < np.sin(np.deg2rad(25))], lines[turn > np.sin(np.deg2rad(35))]
    if not len(others):
        return first, others
    turn = np.abs(np.sin(others[:, 0] - others[0, 0]))
    return first, others[turn < np.sin(np.deg2rad(25))]


def _numbered(lines: Array, shape: tuple[int, ...]) -> tuple[Array, Rows]:
    """Equally spaced lines (n, 3) of a family, as a·x + b·y + c = 0, and their numbers."""
    if len(lines) < 2:
        return lines[:, :3], np.arange(len(lines))
    main = lines[0, 0]
    sign = np.where(np.cos(lines[:, 0] - main) < 0, -1.0, 1.0)
    normal = sign[:, None] * np.stack([np.cos(lines[:, 0]), np.sin(lines[:, 0])], axis=1)
    rho, weight = sign * lines[:, 1], lines[:, 2] * lines[:, 3]
    # Their crossings with the perpendicular line through the centre of the frame.
    at = rho / (normal @ [np.cos(main), np.sin(main)])
    order = np.argsort(at, kind="stable")
    at, weight = at[order], weight[order]
    best, number, keep = -1.0, np.zeros(0, dtype=np.intp), order[:0]
    for start in range(len(at) - 1):
        for next_one in range(start + 1, min(start + 3, len(at))):
            steps, kept = _walk(at, start, next_one)
            # With a sufficiently small step any lines fit; therefore gaps are penalized.
            worth = float(weight[kept].sum() * len(kept) / (np.ptp(steps) + 1))
            if worth > best:
                best, number, keep = worth, steps, kept
    chosen = order[keep]
    constant = -rho[chosen] - normal[chosen] @ _centre(shape)
    return np.column_stack([normal[chosen], constant]), number


def _walk(at: Array, start: int, next_one: int) -> tuple[Rows, Rows]:
    """Number lines outwards from two of them; lines that do not fit are left out."""
    number = {start: 0, next_one: 1}
    for way, first in ((1, next_one), (-1, start)):
        step, last = at[next_one] - at[start], first
        for k in range(first + way, len(at) if way > 0 else -1, way):
            gap = abs(at[k] - at[last])
            whole = round(gap / step)
            if whole < 1 or abs(gap / step - whole) > _OFF_STEP * whole:
                continue
            number[k] = number[last] + way * whole
            step, last = gap / whole, k
    rows = np.array(sorted(number), dtype=np.intp)
    return np.array([number[int(k)] for k in rows], dtype=np.intp), rows


def _homography(first: Array, i: Rows, second: Array, j: Rows) -> Array:
    """Homography from line numbers to the image, from the crossings of all lines."""
    crossing = np.cross(first[:, None], second[None])
    xy = (crossing[..., :2] / crossing[..., 2:]).reshape(-1, 2)
    number = np.stack(np.meshgrid(i, j, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.float64)
    found: Any = cv2.findHomography(number, xy)[0]
    return np.asarray(found if found is not None else np.eye(3), dtype=np.float64)


_DEGREE = 3
"""Degree of the polynomial determined by lines alone."""
_MOST_PX = 20.0
"""Prior standard deviation of the coefficients of the polynomial, pixels."""
_POINT_PX = 0.1
"""Typical distance of a ridge point from its line."""
_NEAR = (0.2, 25.0)
_GATES = ((0.08, 15.0), (0.04, 12.0))
"""Largest distance of a ridge point from its line, in lattice steps and in degrees, for each round."""
_SUPPORT = 0.25
"""Minimum number of ridge points per sample along a line."""
_LEAST_DARK = 0.7
"""Minimum dark share of the length of a line, part of which may be hidden."""
_BETWEEN = 0.85
"""Minimum dark share of the length of lines between those found."""
_BENT_PX = 0.13
"""Rms distance of ridge points from which strong lens distortion is assumed."""
_TIMES, _STILL_PX = 4, 0.1
"""Maximum rounds of adjusting lines to their profiles, and the movement in pixels that ends them."""
_LEAST_POINTS, _ENOUGH, _SOME = 40, 800, 3000
"""Minimum number of ridge points of a lattice, number that is sufficient at first, and number of ridge points
of the frame (most not on lines) among which they are selected."""
_MIDDLE = 0.5
"""Central part of the frame, relative to half its size, that determines the projectivity."""
_SHORTEST = 20
"""Minimum number of samples of a line within the frame."""


@dataclass(frozen=True, eq=False)
class LatticeFit:
    """An adjusted lattice.

    Parameters
    ----------
    mapping : Chain
        From lattice coordinates to the image; y runs upwards if x runs to the right, unless mirrored.
    across, along : ndarray of int (a,), (b,)
        Numbers of the existing lines.
    rms_px : float
        Rms distance of points, measured in single rows and columns, from their lines.
    points : int
        Number of these points.
    """

    mapping: Chain
    across: Rows
    along: Rows
    rms_px: float
    points: int


def second_order(mapping: PlaneMapping, at: Array) -> tuple[Array, Array, Array]:
    """A mapping at points (n, 2) with its first (n, 2, 2) and second derivatives (n, 2, 2, 2).

    Numerical differences, accurate to 1e-6 for lattice coordinates.
    """
    step = 0.01
    offset = step * np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    around = mapping((at[:, None] + offset).reshape(-1, 2)).reshape(-1, 3, 3, 2)
    middle = around[:, 1, 1]
    slope = np.stack([around[:, 2, 1] - around[:, 0, 1], around[:, 1, 2] - around[:, 1, 0]], axis=-1) / (
        2 * step
    )
    mixed = (around[:, 2, 2] - around[:, 2, 0] - around[:, 0, 2] + around[:, 0, 0]) / 4
    bend = np.stack(
        [
            np.stack([around[:, 2, 1] - 2 * middle + around[:, 0, 1], mixed], axis=-1),
            np.stack([mixed, around[:, 1, 2] - 2 * middle + around[:, 1, 0]], axis=-1),
        ],
        axis=-2,
    )
    return middle, slope, bend / step**2


def lattices(
    grey: NDArray[np.float32], ridges: Ridges, found: Lattice, width: float, blur: float
) -> Iterator[LatticeFit]:
    """Lattices adjusted to the lines of a frame, the likeliest first.

    If only every second or third line was found, because others are hidden or faint, there are lines between
    those found, or the squares do not match the numbering.

    Parameters
    ----------
    grey : ndarray (h, w)
        Grey values with dark lines.
    ridges : Ridges
        Ridge points of the frame.
    found : Lattice
        The lines found.
    width : float
        Width of the lines, in lattice steps.
    blur : float
        Approximate width (one sigma) of a blurred edge in pixels.
    """
    parts = (1, 2, 3)
    likely = [max(parts, key=lambda n: n * _between(ridges, found, axis, n)) for axis in (0, 1)]
    others = [pair for pair in product(parts, parts) if pair != tuple(likely)]
    for pair in [tuple(likely), *sorted(others, key=sum)]:
        scale = np.array([1 / pair[0], 1 / pair[1], 1.0])
        lattice = Lattice(found.homography * scale, found.across * pair[0], found.along * pair[1])
        fit = fit_lattice(ridges, lattice)
        if fit is not None:
            # With strong distortion every round finds the line on more of its length.
            for _ in range(_TIMES if fit.rms_px > _BENT_PX else 2):
                before, fit = fit, _sharpened(fit, grey, width, blur)
                if fit.points < 1.02 * before.points or _moved(before, fit) < _STILL_PX:
                    break
            yield fit


def _moved(before: LatticeFit, after: LatticeFit) -> float:
    """Largest movement of the crossings of the lines, in pixels."""
    at = np.stack(np.meshgrid(before.across, before.along), axis=-1).reshape(-1, 2).astype(np.float64)
    return float(np.abs(after.mapping(at) - before.mapping(at)).max())


def _between(ridges: Ridges, found: Lattice, axis: int, parts: int) -> bool:
    """Whether there are lines at these fractions of the distance between those found."""
    if parts == 1:
        return True
    numbers = (found.across, found.along)
    mapping = _start(found, ridges.darkness.shape)
    dark = _darkness_along(mapping, ridges, axis, numbers[axis].astype(float), numbers[1 - axis])
    level = 0.5 * np.median([np.median(each) for each in dark if each.size])
    steps = np.arange(numbers[axis].min() * parts, numbers[axis].max() * parts + 1)
    dark = _darkness_along(mapping, ridges, axis, steps[steps % parts != 0] / parts, numbers[1 - axis])
    return bool(np.median([(each > level).mean() if each.size else 0.0 for each in dark]) > _BETWEEN)


def fit_lattice(ridges: Ridges, lattice: Lattice) -> LatticeFit | None:
    """Adjust a lattice to the ridge points, add lines beyond those found, and drop false lines.

    Returns
    -------
    LatticeFit or None
        None if the lines do not form one lattice, or enclose no square.
    """
    mapping = _start(lattice, ridges.darkness.shape)
    each = max(1, len(ridges.xy) // _SOME)
    xy, normal = ridges.xy[::each], ridges.normal[::each]
    near = _assigned(mapping, normal, _coordinates(mapping, xy), *_NEAR)[0]
    xy, normal = xy[near], normal[near]
    for gate, degrees in _GATES:
        at = _coordinates(mapping, xy)
        row, axis = _assigned(mapping, normal, at, gate, degrees)
        if len(row) < _LEAST_POINTS:
            return None
        at = at[row]
        at[np.arange(len(at)), axis] = np.rint(at[np.arange(len(at)), axis])
        # Two lines do not determine a bend, three no change of it.
        lines = min(len(np.unique(at[axis == k, k])) for k in (0, 1))
        degree = min(max(lines - 1, 1), _DEGREE)
        thin = slice(None, None, max(1, len(at) // _ENOUGH))
        given = xy[row][thin], normal[row][thin], at[thin]
        mapping, residuals = _adjusted(mapping, degree, *given)
        if _rms(residuals) > _BENT_PX:
            other = _adjusted(_middled(mapping, at), degree, *given)
            if _rms(other[1]) < _rms(residuals):
                mapping, residuals = other
    numbers = [lattice.across, lattice.along]
    for k in (0, 1):
        numbers[k] = _lines(mapping, ridges, np.repeat(at[axis == k][:, k], each), k, numbers[1 - k])
        if len(numbers[k]) < 2:
            return None
    return LatticeFit(mapping, numbers[0], numbers[1], _rms(residuals), 0)


def _sharpened(fit: LatticeFit, grey: NDArray[np.float32], width: float, blur: float) -> LatticeFit:
    """The lattice adjusted to the profiles of its lines, which are ten times as accurate as ridge points."""
    xy, normal, at = [], [], []
    for axis, (numbers, others) in enumerate(((fit.across, fit.along), (fit.along, fit.across))):
        along = np.linspace(others.min(), others.max(), max(grey.shape) // 4)
        on = np.empty((len(numbers), 2, len(along), 2))
        on[..., 1 - axis] = along
        on[..., axis] = numbers[:, None, None] + np.array([0.0, width])[:, None]
        images = fit.mapping(on.reshape(-1, 2)).reshape(on.shape)
        for number, (middle, beside) in zip(numbers, images, strict=True):
            line = crossings(middle, np.arange(float(len(along))), grey.shape)
            if line is None:
                continue
            side = (beside - middle)[np.rint(line.along).astype(np.intp)]
            shift, measured = located(grey, line, 0.5 * np.abs((side * line.normal).sum(axis=1)), blur)
            place = np.full((len(measured), 2), float(number))
            place[:, 1 - axis] = np.interp(line.along, np.arange(len(along)), along)
            xy.append(line.xy(shift)[measured])
            normal.append(line.normal[measured])
            at.append(place[measured])
    points = [np.concatenate(column) for column in (xy, normal, at)]
    if len(points[0]) < _LEAST_POINTS:
        return fit
    degree = min(max(min(len(fit.across), len(fit.along)) - 1, 1), _DEGREE)
    mapping, residuals = _adjusted(fit.mapping, degree, *points)
    return replace(fit, mapping=mapping, rms_px=_rms(residuals), points=len(residuals))


def _rms(residuals: Array) -> float:
    return float(np.sqrt((residuals**2).mean()))


def _start(lattice: Lattice, shape: tuple[int, ...]) -> Chain:
    """The projectivity of a lattice, followed by a polynomial that is still zero."""
    h, w = shape
    straight = RationalPolynomial.projective()
    matrix = lattice.homography / lattice.homography[2, 2]
    curved = RationalPolynomial.polynomial(_DEGREE, offset=((w - 1) / 2, (h - 1) / 2), scale=max(h, w) / 2)
    return Chain(straight.with_values(dict(zip(straight.names, matrix.ravel(), strict=False))), curved)


def _middled(mapping: Chain, at: Array) -> Chain:
    """The mapping with its projectivity fitted near the centre of the frame, where distortion is smallest.

    A projectivity through straight lines fitted to curved ones cannot be corrected by the polynomial.
    """
    assert isinstance(mapping.second, RationalPolynomial)
    xy = mapping(at)
    near = np.hypot(*(xy - mapping.second.offset).T) < _MIDDLE * mapping.second.scale
    if near.sum() < _LEAST_POINTS or min(np.ptp(at[near], axis=0)) < 1:
        return mapping
    found: Any = cv2.findHomography(at[near], xy[near])[0]
    if found is None:
        return mapping
    straight = mapping.first.with_values((found / found[2, 2]).ravel()[:8])
    return Chain(straight, mapping.second)


def straightened(mapping: Chain, xy: Array) -> Array:
    """Lattice coordinates (n, 2) of image points by the projectivity alone."""
    h = np.append(mapping.first.values, 1.0).reshape(3, 3)
    back = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(h).T
    at: Array = back[:, :2] / back[:, 2:]
    return at


def _coordinates(mapping: Chain, xy: Array) -> Array:
    """Lattice coordinates (n, 2) of image points; a few Newton steps are accurate enough here."""
    at = straightened(mapping, xy)
    if np.array_equal(mapping(at[:1]), mapping.first(at[:1])):
        return at  # the polynomial is still zero
    slope = _straight_slope(mapping, at)
    for _ in range(3):
        at = at + solve_2x2(slope, xy - mapping(at))
    return at


def _straight_slope(mapping: Chain, at: Array) -> Array:
    """Derivatives (n, 2, 2) of the projectivity alone, accurate enough for directions."""
    h = np.append(mapping.first.values, 1.0).reshape(3, 3)
    image = np.column_stack([at, np.ones(len(at))]) @ h.T
    xy, depth = image[:, :2] / image[:, 2:], image[:, 2, None, None]
    slope: Array = (h[:2, :2] - xy[:, :, None] * h[2, :2]) / depth
    return slope


def slope_of(mapping: PlaneMapping, at: Array) -> Array:
    """Derivatives (n, 2, 2) of a mapping at points (n, 2), by differences."""
    step = 1e-4
    return np.stack([(mapping(at + d) - mapping(at - d)) / (2 * step) for d in step * np.eye(2)], axis=-1)


def _assigned(mapping: Chain, normal: Array, at: Array, gate: float, degrees: float) -> tuple[Rows, Rows]:
    """Ridge points on a lattice line and parallel to it: their indices, and the axis numbering the line."""
    rows, axes = [], []
    for axis in (0, 1):
        near = np.flatnonzero(np.abs(at[:, axis] - np.rint(at[:, axis])) < gate)
        # Along a line the other coordinate changes.
        along = _straight_slope(mapping, at[near])[:, :, 1 - axis]
        sine = (along * normal[near]).sum(axis=1) / np.maximum(np.hypot(*along.T), 1e-12)
        found = near[np.abs(sine) < np.sin(np.deg2rad(degrees))]
        rows.append(found)
        axes.append(np.full(len(found), axis))
    return np.concatenate(rows), np.concatenate(axes)


def _adjusted(mapping: Chain, degree: int, xy: Array, normal: Array, at: Array) -> tuple[Chain, Array]:
    """The mapping that minimizes the distances of ridge points from their lines, and the distances (n,)."""
    mapping = _of_degree(mapping, degree)
    monomials = _monomials(mapping, at)
    design = np.concatenate([normal[:, :1] * monomials, normal[:, 1:] * monomials], axis=1)
    observed = (normal * (xy - mapping.first(at))).sum(axis=1)
    mapping, residuals = _solved(mapping, design, observed[None], _POINT_PX)
    return mapping, residuals[0]


def refit(mapping: Chain, at: Array, xy: Array, sigma_px: float) -> Chain:
    """The mapping with its polynomial adjusted to measured points.

    Parameters
    ----------
    at, xy : ndarray (n, 2)
        Lattice coordinates and images; the degree grows with their number, up to the fifth.
    sigma_px : float
        Standard deviation of the images.
    """
    # At least the degree already determined by the lines.
    powers = _powers(mapping)
    before = max(i + j for i, j in powers) if len(at) > len(powers) else 1
    mapping = _of_degree(mapping, max(before, trend_degree(len(at))))
    return _solved(mapping, _monomials(mapping, at), (xy - mapping.first(at)).T, sigma_px)[0]


def _monomials(mapping: Chain, at: Array) -> Array:
    """Monomials (n, m) of the polynomial at lattice coordinates (n, 2)."""
    assert isinstance(mapping.second, RationalPolynomial)
    u, v = ((mapping.first(at) - mapping.second.offset) / mapping.second.scale).T
    return np.stack([u**i * v**j for i, j in _powers(mapping)], axis=1)


def _powers(mapping: Chain) -> list[tuple[int, int]]:
    """Exponents of the monomials of the polynomial."""
    return [(int(name[2]), int(name[3])) for name in mapping.second.names if name[0] == "X"]


def _of_degree(mapping: Chain, degree: int) -> Chain:
    """The mapping with a zero polynomial of a given degree."""
    assert isinstance(mapping.second, RationalPolynomial)
    offset, scale = mapping.second.offset, mapping.second.scale
    return Chain(mapping.first, RationalPolynomial.polynomial(degree, offset=offset, scale=scale))


def _solved(mapping: Chain, design: Array, observed: Array, sigma_px: float) -> tuple[Chain, Array]:
    """The mapping with its polynomial adjusted robustly, and the residuals (b, n).

    The projectivity is kept. The coefficients of the polynomial are linear: all of them in one problem, or
    those of x and those of y, which share a design matrix (n, u), in two.
    """
    none = np.zeros((len(observed), design.shape[1]))
    fit = adjust_batch(
        lambda x, rows: (x @ design.T, np.broadcast_to(design, (len(rows), *design.shape))),
        none,
        observed,
        prior=(none, np.full(design.shape[1], _MOST_PX / sigma_px)),
        options=BatchOptions(reweight=weight_function("tukey"), max_iterations=5, tolerance=0.1 * sigma_px),
    )
    names = mapping.second.names
    curved = mapping.second.with_values(
        dict(zip(names, mapping.second.values + fit.estimates.ravel(), strict=True))
    )
    return Chain(mapping.first, curved), fit.residuals


def _darkness_along(mapping: Chain, ridges: Ridges, axis: int, lines: Array, others: Rows) -> list[Array]:
    """Darkness along lattice lines, sampled between the outermost crossing lines."""
    h, w = ridges.darkness.shape
    along = np.linspace(others.min(), others.max(), max(h, w))
    at = np.empty((len(lines), len(along), 2))
    at[..., 1 - axis], at[..., axis] = along, lines[:, None]
    xy = mapping(at.reshape(-1, 2)).reshape(at.shape)
    inside = np.asarray(((xy >= 0) & (xy <= [w - 1, h - 1])).all(axis=2))
    x, y = np.moveaxis(xy.astype(np.float32), 2, 0)
    seen = cv2.remap(ridges.darkness, x, y, cv2.INTER_LINEAR) if x.size else x
    return [np.asarray(dark[keep], dtype=np.float64) for dark, keep in zip(seen, inside, strict=True)]


def _lines(mapping: Chain, ridges: Ridges, number: Array, axis: int, others: Rows) -> Rows:
    """Numbers of the lines that exist: dark, and with ridge points."""
    found = []
    lines = np.arange(number.min(), number.max() + 1)
    for line, dark in zip(lines, _darkness_along(mapping, ridges, axis, lines, others), strict=True):
        enough = (number == line).sum() > _SUPPORT * len(dark)
        if len(dark) > _SHORTEST and enough and (dark > 0.5 * np.median(dark)).mean() > _LEAST_DARK:
            found.append(int(line))
    return np.array(found, dtype=np.intp)
