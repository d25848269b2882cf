r"""The lattice of a testfield's lines adjusted to the ridge points of a frame, as one mapping.

All lines are adjusted together: line i of the one family is where the first of two lattice coordinates is i,
line j of the other where the second is j. The mapping F from there to the image is a projectivity and, for
the lens and the bend of the board, a polynomial of third degree after it; of a ridge point p with the normal
n the distance :math:`n^T(F(s) - p)` is observed, s being the point of its line next to it.
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
from ...optics import Chain, PlaneMapping, RationalPolynomial
from ...optics.field import trend_degree
from ...optics.newton import solve_2x2
from .lines import Lattice, Ridges
from .profiles import crossings, located

__all__ = ["LatticeFit", "fit_lattice", "lattices", "refit", "second_order", "slope_of", "straightened"]

_DEGREE = 3
"""Of the polynomial, where lines alone tell it."""
_MOST_PX = 20.0
"""Standard deviation of the polynomials' coefficients, known beforehand."""
_POINT_PX = 0.1
"""What a ridge point is off its line on the average."""
_NEAR = (0.2, 25.0)
_GATES = ((0.08, 15.0), (0.04, 12.0))
"""How far, in steps of the lattice and in degrees, a ridge point may be off its line, round by round."""
_SUPPORT = 0.25
"""Ridge points per sample along it that a line must have."""
_LEAST_DARK = 0.7
"""Share of its length on which a line must be dark, some of it hidden."""
_BETWEEN = 0.85
"""Share of their length on which lines between those found must be dark."""
_BENT_PX = 0.13
"""Distances of ridge points, root mean square, from which on the lens distorts much."""
_TIMES, _STILL_PX = 4, 0.1
"""How often lines are adjusted to their profiles, unless they move by less."""
_LEAST_POINTS, _ENOUGH, _SOME = 40, 800, 3000
"""Ridge points without which there is no lattice, about how many tell it well enough to begin with, and among
how many of a frame, most of them no lines', these are looked for."""
_MIDDLE = 0.5
"""Part of the half frame around its middle that tells the projectivity."""
_SHORTEST = 20
"""Samples that a line must have within the frame."""


@dataclass(frozen=True, eq=False)
class LatticeFit:
    """The lattice as it was adjusted.

    Parameters
    ----------
    mapping : Chain
        From lattice coordinates to the image; y runs up when x runs right, unless the image is mirrored.
    across, along : ndarray of int (a,), (b,)
        Numbers of the lines there are.
    rms_px : float
        Of the distances of points, measured in single rows and columns, from their lines.
    points : int
        Their number.
    """

    mapping: Chain
    across: Rows
    along: Rows
    rms_px: float
    points: int


def second_order(mapping: PlaneMapping, at: Array) -> tuple[Array, Array, Array]:
    """A mapping at points (n, 2) with its first (n, 2, 2) and second derivatives (n, 2, 2, 2).

    By differences, good to a millionth for lattice coordinates and cheap.
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

    Every second or third line only may have been found, the others being hidden or faint: then there are
    lines between them, or the numbering does not fit what the squares are read as.

    Parameters
    ----------
    grey : ndarray (h, w)
        Grey values, the lines dark.
    ridges : Ridges
        Its ridge points.
    found : Lattice
        The lines found.
    width : float
        Of the lines, in steps of the lattice.
    blur : float
        Width (one sigma) of a blurred edge in pixels, about.
    """
    parts = (1, 2, 3)
    likely = [max(parts, key=lambda n: n * _between(ridges, found, axis, n)) for axis in (0, 1)]
    others = [pair for pair in product(parts, parts) if pair != tuple(likely)]
    for pair in [tuple(likely), *sorted(others, key=sum)]:
        scale = np.array([1 / pair[0], 1 / pair[1], 1.0])
        lattice = Lattice(found.homography * scale, found.across * pair[0], found.along * pair[1])
        fit = fit_lattice(ridges, lattice)
        if fit is not None:
            # Where the lens distorts much, a line is found on more of its length every time.
            for _ in range(_TIMES if fit.rms_px > _BENT_PX else 2):
                before, fit = fit, _sharpened(fit, grey, width, blur)
                if fit.points < 1.02 * before.points or _moved(before, fit) < _STILL_PX:
                    break
            yield fit


def _moved(before: LatticeFit, after: LatticeFit) -> float:
    """How far the crossings of the lines have moved at most, in pixels."""
    at = np.stack(np.meshgrid(before.across, before.along), axis=-1).reshape(-1, 2).astype(np.float64)
    return float(np.abs(after.mapping(at) - before.mapping(at)).max())


def _between(ridges: Ridges, found: Lattice, axis: int, parts: int) -> bool:
    """Whether there are lines at these parts of the way between those found."""
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
    """Adjust a lattice to the ridge points, look for lines beyond those found, and drop what is no line.

    Returns
    -------
    LatticeFit or None
        None where the lines found do not lie in one lattice, or bound no square.
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
        # Between two lines nothing tells a bend, between three no change of it.
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
    """The lattice adjusted to the profiles of its lines, which are an order better than ridge points."""
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
            shift, told = located(grey, line, 0.5 * np.abs((side * line.normal).sum(axis=1)), blur)
            place = np.full((len(told), 2), float(number))
            place[:, 1 - axis] = np.interp(line.along, np.arange(len(along)), along)
            xy.append(line.xy(shift)[told])
            normal.append(line.normal[told])
            at.append(place[told])
    points = [np.concatenate(column) for column in (xy, normal, at)]
    if len(points[0]) < _LEAST_POINTS:
        return fit
    degree = min(max(min(len(fit.across), len(fit.along)) - 1, 1), _DEGREE)
    mapping, residuals = _adjusted(fit.mapping, degree, *points)
    return replace(fit, mapping=mapping, rms_px=_rms(residuals), points=len(residuals))


def _rms(residuals: Array) -> float:
    return float(np.sqrt((residuals**2).mean()))


def _start(lattice: Lattice, shape: tuple[int, ...]) -> Chain:
    """The projectivity of a lattice, with a polynomial after it that changes nothing yet."""
    h, w = shape
    straight = RationalPolynomial.projective()
    matrix = lattice.homography / lattice.homography[2, 2]
    curved = RationalPolynomial.polynomial(_DEGREE, offset=((w - 1) / 2, (h - 1) / 2), scale=max(h, w) / 2)
    return Chain(straight.with_values(dict(zip(straight.names, matrix.ravel(), strict=False))), curved)


def _middled(mapping: Chain, at: Array) -> Chain:
    """The mapping with the projectivity that it is near the middle of the frame, where lenses distort least.

    Of straight lines laid through bent ones comes a projectivity that a polynomial after it cannot make good.
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
    """Lattice coordinates (n, 2) of image points; a few steps of Newton, which is near enough here."""
    at = straightened(mapping, xy)
    if np.array_equal(mapping(at[:1]), mapping.first(at[:1])):
        return at  # there is no polynomial yet
    slope = _straight_slope(mapping, at)
    for _ in range(3):
        at = at + solve_2x2(slope, xy - mapping(at))
    return at


def _straight_slope(mapping: Chain, at: Array) -> Array:
    """Derivatives (n, 2, 2) of the projectivity alone: near enough for directions."""
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
    """Ridge points that lie on a lattice line and run with it: their rows, and the axis that counts lines."""
    rows, axes = [], []
    for axis in (0, 1):
        near = np.flatnonzero(np.abs(at[:, axis] - np.rint(at[:, axis])) < gate)
        # Along the line the other coordinate changes.
        along = _straight_slope(mapping, at[near])[:, :, 1 - axis]
        sine = (along * normal[near]).sum(axis=1) / np.maximum(np.hypot(*along.T), 1e-12)
        found = near[np.abs(sine) < np.sin(np.deg2rad(degrees))]
        rows.append(found)
        axes.append(np.full(len(found), axis))
    return np.concatenate(rows), np.concatenate(axes)


def _adjusted(mapping: Chain, degree: int, xy: Array, normal: Array, at: Array) -> tuple[Chain, Array]:
    """The mapping with the distances of ridge points from their lines least, and these distances (n,)."""
    mapping = _of_degree(mapping, degree)
    monomials = _monomials(mapping, at)
    design = np.concatenate([normal[:, :1] * monomials, normal[:, 1:] * monomials], axis=1)
    observed = (normal * (xy - mapping.first(at))).sum(axis=1)
    mapping, residuals = _solved(mapping, design, observed[None], _POINT_PX)
    return mapping, residuals[0]


def refit(mapping: Chain, at: Array, xy: Array, sigma_px: float) -> Chain:
    """The mapping with the polynomial adjusted to points of which both coordinates were measured.

    Parameters
    ----------
    at, xy : ndarray (n, 2)
        Lattice coordinates and images; the more there are, the higher is the degree, up to the fifth.
    sigma_px : float
        Standard deviation of the latter.
    """
    # Not below what the lines have told already.
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
    """Powers of the polynomial's monomials."""
    return [(int(name[2]), int(name[3])) for name in mapping.second.names if name[0] == "X"]


def _of_degree(mapping: Chain, degree: int) -> Chain:
    """The mapping with a polynomial of some degree that changes nothing yet."""
    assert isinstance(mapping.second, RationalPolynomial)
    offset, scale = mapping.second.offset, mapping.second.scale
    return Chain(mapping.first, RationalPolynomial.polynomial(degree, offset=offset, scale=scale))


def _solved(mapping: Chain, design: Array, observed: Array, sigma_px: float) -> tuple[Chain, Array]:
    """The mapping with its polynomial adjusted, robustly, and the residuals (b, n).

    The projectivity is kept, and what it lacks is left to the polynomial, whose coefficients are linear: all
    of them in one problem, or those of x and those of y, which share a design (n, u), in two.
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
    """Darkness along lattice lines between the outermost of those that cross them, sample by sample."""
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
    """Numbers of the lines that are really there: dark, and with ridge points."""
    found = []
    lines = np.arange(number.min(), number.max() + 1)
    for line, dark in zip(lines, _darkness_along(mapping, ridges, axis, lines, others), strict=True):
        enough = (number == line).sum() > _SUPPORT * len(dark)
        if len(dark) > _SHORTEST and enough and (dark > 0.5 * np.median(dark)).mean() > _LEAST_DARK:
            found.append(int(line))
    return np.array(found, dtype=np.intp)
