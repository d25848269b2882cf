"""The lattice of a testfield: all its lines adjusted together, as one mapping.

On line i of the first family the first lattice coordinate is i, on line j of the second family the second is
j. The mapping F from lattice to image is a projectivity followed by a polynomial of third degree for lens
distortion and bending of the board. Observed is the distance :math:`n^T(F(s) - p)` of a ridge point p with
normal n, where s is the nearest point of its line.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice, product

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from ...adjust import BatchOptions, adjust_batch, weight_function
from ...core.data import Array, Mask, Rows
from ...core.threads import one_thread
from ...optics import Chain
from ...optics.field import trend_degree
from .compiled_lattice import monomials, profiles
from .lattice import BETWEEN_SIDES, Lattice, Ridges, median, quantile, rms
from .lattice_mapping import (
    degree_of,
    images_of,
    lattice_coordinates,
    matrix_of,
    numbers_of,
    of_degree,
    projective_slope,
    started,
    with_coefficients,
)
from .line_profiles import line_nodes

__all__ = ["LatticeFit", "common_part", "fit_lattice", "lattices", "monomials_of", "refit"]

_DEGREE = 3
"""Degree of the polynomial determined by lines alone."""
_MOST_PX = 20.0
"""Prior standard deviation of the coefficients of the polynomial, pixels."""
_POINT_PX = 0.1
"""Typical distance of a ridge point from its line."""
_GATES = ((0.12, 25.0), (0.08, 20.0), (0.05, 20.0))
"""Largest distance of a ridge point from its line, in lattice steps and in degrees, for each round."""
_MOST_TURNS = 16
"""Maximum number of rounds of adjusting the lattice and adding lines."""
_RADIAL_TIMES = 4
_DISTORTED, _MOST_DISTORTED = 0.1, 0.3
"""Prior standard deviation and largest value of the radial distortion at the edge of the frame."""
_ABOUT = 0.02
"""Distance from its predicted place, in steps, within which a line is looked for."""
_BESIDE = 0.07
"""Distance from a line, in steps, at which both sides are compared with it; no targets are so near."""
_SUPPORT = 0.25
"""Minimum number of ridge points per sample along a line."""
_LEAST_DARK = 0.7
"""Minimum dark share of the length of a line, part of which may be hidden."""
_PARTS = (1, 2, 3)
"""Numbers of parts into which lines that were not found may divide the distance between those found."""
_BETWEEN = 0.85
"""Minimum dark share of the length of lines between those found."""
_BENT_PX = 0.13
"""Rms distance of ridge points from which strong lens distortion is assumed."""
_TIMES, _STILL_PX = 4, 0.1
"""Maximum rounds of adjusting lines to their profiles, and the movement in pixels that ends them."""
_NEIGHBOURS, _TOGETHER_PX, _SCATTER, _ALONE = 9, 0.1, 0.5, 6.0
"""Number of neighbouring points, themselves included, of which the median residual is compared; median from
which they deviate together from a mapping, and its multiple by which they may scatter; multiple of the usual
deviation from it that a point may have."""
_LEAST_POINTS, _ENOUGH, _SOME, _MANY = 40, 800, 3000, 5000
"""Minimum number of ridge points of a lattice, number that is sufficient at first, and number of ridge points
of the frame (most not on lines) among which they are selected; number of places on profiles of lines that is
sufficient in the end."""
_SHORTEST = 20
"""Minimum part of a line within the frame, relative to its length; times the size of the frame."""
_EACH_PX, _LEAST_SAMPLES = 3, 120
"""Distance of samples along a line that extends over the frame; least number of samples."""


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


def lattices(
    grey: NDArray[np.float32],
    ridges: Ridges,
    found: Iterable[Lattice],
    width: float,
    blur: float,
    most: int = 100,
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
    found : iterable of Lattice
        Possible numberings of the lines found, the likeliest first; at least one.
    width : float
        Width of the lines, in lattice steps.
    blur : float
        Approximate width (one sigma) of a blurred edge in pixels.
    most : int
        Maximum number of lattices that are tried.
    """
    for one, pair in islice(_divided(ridges, found), most):
        scale = np.array([1 / pair[0], 1 / pair[1], 1.0])
        lattice = Lattice(one.homography * scale, one.across * pair[0], one.along * pair[1])
        fit = fit_lattice(ridges, lattice)
        if fit is not None:
            # With strong distortion every round finds the line on more of its length.
            for _ in range(_TIMES if fit.rms_px > _BENT_PX else 2):
                before, fit = fit, _sharpened(fit, grey, width, blur)
                if fit.points < 1.02 * before.points or _moved(before, fit) < _STILL_PX:
                    break
            yield fit


def _divided(ridges: Ridges, found: Iterable[Lattice]) -> Iterator[tuple[Lattice, tuple[int, int]]]:
    """Lattices with the numbers of parts of their steps: the likeliest of each, then all of the first."""
    first: tuple[Lattice, tuple[int, int]] | None = None
    for one in found:
        likely = _parts(ridges, one, 0), _parts(ridges, one, 1)
        first = first or (one, likely)
        yield one, likely
    assert first is not None
    for pair in sorted(product(_PARTS, _PARTS), key=sum):
        if pair != first[1]:
            yield first[0], pair


def _moved(before: LatticeFit, after: LatticeFit) -> float:
    """Largest movement of the crossings of the lines, in pixels."""
    at = np.stack(np.meshgrid(before.across, before.along), axis=-1).reshape(-1, 2).astype(np.float64)
    return float(np.abs(images_of(after.mapping, at) - images_of(before.mapping, at)).max())


def _parts(ridges: Ridges, found: Lattice, axis: int) -> int:
    """The greatest number of parts into which lines divide the distance between those found."""
    numbers = (found.across, found.along)
    mapping = started(found.homography, _DEGREE, ridges.darkness.shape)
    dark, inside = _darkness_along(mapping, ridges, axis, numbers[axis].astype(float), numbers[1 - axis])
    if not inside.any():
        return 1
    level = 0.5 * median(quantile(dark, inside, 0.5)[inside.any(axis=1)])
    for parts in sorted(_PARTS[1:], reverse=True):
        steps = np.arange(numbers[axis].min() * parts, numbers[axis].max() * parts + 1)
        between = steps[steps % parts != 0] / parts
        dark, inside = _darkness_along(mapping, ridges, axis, between, numbers[1 - axis])
        share = ((dark > level) & inside).sum(axis=1) / np.maximum(inside.sum(axis=1), 1)
        if median(share) > _BETWEEN:
            return parts
    return 1


def fit_lattice(ridges: Ridges, lattice: Lattice) -> LatticeFit | None:
    """Adjust a lattice to the ridge points, add lines beyond those found, and drop false lines.

    Projectivity and radial distortion are adjusted first, to the lines found and then, line by line, to those
    next to them: few parameters can be extrapolated. The polynomial follows when all lines are known.

    Returns
    -------
    LatticeFit or None
        None if the lines do not form one lattice, or enclose no square.
    """
    mapping = started(lattice.homography, _DEGREE, ridges.darkness.shape)
    each = max(1, len(ridges.xy) // _SOME)
    all_xy, all_normal = ridges.xy[::each], ridges.normal[::each]
    numbers = [lattice.across, lattice.along]
    for turn in range(_MOST_TURNS):
        gate, degrees = _GATES[min(turn, len(_GATES) - 1)]
        at = lattice_coordinates(mapping, all_xy)
        row, axis = _assigned(mapping, all_normal, at, gate, degrees, numbers)
        if len(row) < _LEAST_POINTS:
            return None
        mapping = _radially(mapping, all_xy[row], all_normal[row], at[row], axis)
        if turn + 1 < len(_GATES):
            continue
        wider = [np.arange(lines.min() - 1, lines.max() + 2) for lines in numbers]
        at = lattice_coordinates(mapping, all_xy)
        row, axis = _assigned(mapping, all_normal, at, gate, degrees, wider)
        support = [np.repeat(at[row[axis == k], k], each) for k in (0, 1)]
        before, numbers = (
            numbers,
            [_lines(mapping, ridges, support[k], k, wider[k], numbers[1 - k]) for k in (0, 1)],
        )
        if min(map(len, numbers)) < 2:
            return None
        if all(map(np.array_equal, before, numbers)):
            break
    at = lattice_coordinates(mapping, all_xy)
    row, axis = _assigned(mapping, all_normal, at, *_GATES[-1], numbers)
    if len(row) < _LEAST_POINTS:
        return None
    at, rows = at[row], np.arange(len(row))
    at[rows, axis] = np.rint(at[rows, axis])
    thin = slice(None, None, max(1, len(at) // _ENOUGH))
    degree = _degree_of(numbers)
    mapping, residuals = _adjusted(mapping, degree, all_xy[row][thin], all_normal[row][thin], at[thin])
    return LatticeFit(mapping, numbers[0], numbers[1], rms(residuals), 0)


def _degree_of(numbers: list[Rows]) -> int:
    """Degree of the polynomial: two lines do not determine a bend, three no change of it."""
    return min(max(min(map(len, numbers)) - 1, 1), _DEGREE)


def _radially(mapping: Chain, xy: Array, normal: Array, at: Array, axis: Rows) -> Chain:
    """The mapping as projectivity and radial distortion, adjusted robustly to points on lines.

    With u the image of the projectivity from the middle of the frame, the image is u (1 + k u²).
    """
    on, each = at.copy(), np.arange(len(at))
    on[each, axis] = np.rint(on[each, axis])
    matrix, coefficients, middle = numbers_of(mapping)
    matrix = matrix.copy()
    scale = float(middle[2])
    curved = of_degree(mapping, _DEGREE)
    # x³ of the image is the seventh of the monomials.
    k = float(coefficients[0, 6]) / scale if coefficients.shape[1] > 6 else 0.0
    lines = min(len(np.unique(on[axis == i, i])) for i in (0, 1))
    # Two lines in each direction do not determine the distortion.
    prior = (_POINT_PX / scale / (_DISTORTED if lines > 2 else 1e-9)) ** 2
    with one_thread():
        for _ in range(_RADIAL_TIMES):
            step, moved = _radial_step(matrix, k, middle, xy, normal, on, prior)
            matrix.flat[:8] += step[:8]
            k = float(np.clip(k + step[8], -_MOST_DISTORTED, _MOST_DISTORTED))
            if moved < 0.1 * _POINT_PX:
                break
    added = np.zeros((2, 10))
    added[0, [6, 8]] = added[1, [7, 9]] = k * scale
    return with_coefficients(Chain(mapping.first.with_values(matrix.ravel()[:8]), curved.second), added)


def _radial_step(
    matrix: Array, k: float, middle: Array, xy: Array, across: Array, on: Array, prior: float
) -> tuple[Array, float]:
    """Robust correction (9,) of a projectivity and a radial distortion, and how far it moves a point.

    Parameters
    ----------
    middle : ndarray (3,)
        Middle of the frame, and scale of u.
    xy, across, on : ndarray (n, 2)
        Points, normals of their lines, and lattice coordinates on these.
    prior : float
        Weight of k = 0.
    """
    scale, flat = middle[2], np.column_stack([on, np.ones(len(on))])
    seen = flat @ matrix.T
    image = seen[:, :2] / seen[:, 2:]
    u = (image - middle[:2]) / scale
    r2, radial = (u * u).sum(axis=1), (across * u).sum(axis=1)
    grown = 1 + k * r2
    off = (across * (xy - middle[:2])).sum(axis=1) - scale * radial * grown
    # nᵀ dF/du, and du/dH.
    by_u = (grown[:, None] * across + (2 * k * radial)[:, None] * u) / seen[:, 2:]
    by_depth = -(by_u * image).sum(axis=1, keepdims=True)
    parts = by_u[:, :1] * flat, by_u[:, 1:] * flat, by_depth * on, (scale * radial * r2)[:, None]
    design = np.concatenate(parts, axis=1)
    size = np.sqrt((design * design).sum(axis=0)) + 1e-12
    limit = max(4.0 * 1.4826 * float(np.median(np.abs(off))), 3 * _POINT_PX)
    weighted = (design * (np.maximum(1 - (off / limit) ** 2, 0.0) ** 2)[:, None]).T
    right, equations = weighted @ off, weighted @ design
    right[8] -= prior * k
    equations[8, 8] += prior
    equations /= size[:, None] * size
    equations.flat[::10] += 1e-9
    step = np.linalg.solve(equations, right / size) / size
    return step, float(np.abs(design @ step).max())


def _sharpened(fit: LatticeFit, grey: NDArray[np.float32], width: float, blur: float) -> LatticeFit:
    """The lattice adjusted to the profiles of its lines, which are ten times as accurate as ridge points."""
    columns = []
    for axis, (numbers, others) in enumerate(((fit.across, fit.along), (fit.along, fit.across))):
        along = np.linspace(others.min(), others.max(), max(grey.shape) // 4)
        nodes, beside = line_nodes(fit.mapping, axis, numbers.astype(np.float64), width, along)
        line, node, xy, normal = profiles(grey, nodes, beside, blur)
        at = np.empty(xy.shape)
        at[:, axis], at[:, 1 - axis] = numbers[line], np.interp(node, np.arange(len(along)), along)
        columns.append((xy, normal, at))
    points = [np.concatenate(column) for column in zip(*columns, strict=True)]
    if len(points[0]) < _LEAST_POINTS:
        return fit
    degree, thin = _degree_of([fit.across, fit.along]), slice(None, None, max(1, len(points[0]) // _MANY))
    mapping, residuals = _adjusted(fit.mapping, degree, *(column[thin] for column in points))
    return replace(fit, mapping=mapping, rms_px=rms(residuals), points=len(points[0]))


def _assigned(
    mapping: Chain, normal: Array, at: Array, gate: float, degrees: float, numbers: list[Rows]
) -> tuple[Rows, Rows]:
    """Ridge points on a lattice line and parallel to it: their indices, and the axis numbering the line.

    Only the lines of these numbers count, and points between the outermost of them and half a step beyond.
    """
    first, last = (np.array([pick(number) for number in numbers]) for pick in (np.min, np.max))
    rows = np.flatnonzero(((at > first - 0.5) & (at < last + 0.5)).all(axis=1))
    at, normal = at[rows], normal[rows].T
    line, sine = np.rint(at), float(np.sin(np.deg2rad(degrees)))
    near, slope = np.abs(at - line) < gate, projective_slope(matrix_of(mapping), at)
    found = []
    for axis in (0, 1):
        # Along a line the other coordinate changes.
        along = slope[:, 1 - axis]
        parallel = np.abs((along * normal).sum(axis=0)) < sine * np.maximum(np.hypot(*along), 1e-12)
        found.append(rows[parallel & near[:, axis] & np.isin(line[:, axis], numbers[axis])])
    return np.concatenate(found), np.repeat([0, 1], [len(each) for each in found])


def _adjusted(mapping: Chain, degree: int, xy: Array, normal: Array, at: Array) -> tuple[Chain, Array]:
    """The mapping that minimizes the distances of ridge points from their lines, and the distances (n,)."""
    mapping = of_degree(mapping, degree)
    monomials, straight = monomials_of(mapping, at)
    design = np.concatenate([normal[:, :1] * monomials, normal[:, 1:] * monomials], axis=1)
    observed = (normal * (xy - straight)).sum(axis=1)
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
    before = degree_of(mapping) if len(at) > len(mapping.second.values) // 2 else 1
    mapping = of_degree(mapping, max(before, trend_degree(len(at))))
    monomials, straight = monomials_of(mapping, at)
    observed = (xy - straight).T
    fit, residuals = _solved(mapping, monomials, observed, sigma_px)
    common = common_part(at, residuals.T)
    if common is None:
        return fit
    # A robust adjustment has rejected all points of a region. Points that agree with their neighbours count.
    own = np.hypot(*(residuals.T - common).T)
    agree = own < _ALONE * median(own)
    if agree.sum() <= 2 * monomials.shape[1]:
        return fit
    size = np.maximum(np.linalg.norm(monomials, axis=0), 1e-12)
    values: Array = np.linalg.lstsq((monomials / size)[agree], observed.T[agree], rcond=1e-10)[0]
    return with_coefficients(mapping, (values / size[:, None]).T)


def common_part(at: Array, residuals: Array) -> Array | None:
    """Medians (n, 2) of the residuals (n, 2) of points (n, 2) and their nearest neighbours.

    None if neighbours deviate together nowhere, by more than a tenth of a pixel.
    """
    far = (np.abs(residuals) > _TOGETHER_PX).any(axis=1)
    if len(at) < _NEIGHBOURS or np.count_nonzero(far) <= _NEIGHBOURS // 2:
        return None
    near = scipy.spatial.KDTree(at).query(at, k=_NEIGHBOURS)[1]
    common: Array = np.median(residuals[near], axis=1)
    size, scatter = np.abs(common), np.median(np.abs(residuals[near] - common[:, None]), axis=1)
    return common if ((size > _TOGETHER_PX) & (scatter < _SCATTER * size)).any() else None


def monomials_of(mapping: Chain, at: Array) -> tuple[Array, Array]:
    """Monomials (n, m) of the polynomial at lattice coordinates (n, 2), and images by the projectivity."""
    found: tuple[Array, Array] = monomials(numbers_of(mapping), np.ascontiguousarray(at), degree_of(mapping))
    return found


def _solved(mapping: Chain, design: Array, observed: Array, sigma_px: float) -> tuple[Chain, Array]:
    """The mapping with its polynomial adjusted robustly, and the residuals (b, n).

    The projectivity is kept. The coefficients of the polynomial are linear: all of them in one problem, or
    those of x and those of y, which share a design matrix (n, u), in two.
    """
    none, most = np.zeros((len(observed), design.shape[1])), np.full(design.shape[1], _MOST_PX / sigma_px)

    def images(x: Array, rows: Rows) -> tuple[Array, Array]:
        return x @ design.T, np.broadcast_to(design, (len(rows), *design.shape))

    with one_thread():
        fit = adjust_batch(
            images, none, observed, prior=(none, most),
            options=BatchOptions(
                max_iterations=5, tolerance=0.1 * sigma_px, reweight=weight_function("tukey")
            ),
        )  # fmt: skip
    return with_coefficients(mapping, fit.estimates), fit.residuals


def _darkness_along(
    mapping: Chain, ridges: Ridges, axis: int, lines: Array, others: Rows
) -> tuple[NDArray[np.float32], Mask]:
    """Darkness (l, n) along lattice lines between the outermost crossing lines; which are in the frame."""
    h, w = ridges.darkness.shape
    along = np.linspace(others.min(), others.max(), max(_LEAST_SAMPLES, max(h, w) // _EACH_PX))
    at = np.empty((len(lines), len(along), 2))
    at[..., 1 - axis], at[..., axis] = along, lines[:, None]
    xy = images_of(mapping, at.reshape(-1, 2)).reshape(at.shape)
    inside: Mask = np.asarray(((xy >= 0) & (xy <= [w - 1, h - 1])).all(axis=2))
    x, y = np.moveaxis(xy.astype(np.float32), 2, 0)
    dark = cv2.remap(ridges.darkness, x, y, cv2.INTER_LINEAR) if x.size else x
    return np.asarray(dark), inside


def _lines(mapping: Chain, ridges: Ridges, number: Array, axis: int, lines: Rows, others: Rows) -> Rows:
    """Those of some lines that exist: dark between the other lines, and with ridge points at `number`."""
    shifts = np.array([-_BESIDE, _BESIDE, -_ABOUT, 0.0, _ABOUT])
    places = (shifts[:, None] + lines.astype(np.float64)).ravel()
    seen, inside = (
        values.reshape(len(shifts), len(lines), -1)
        for values in _darkness_along(mapping, ridges, axis, places, others)
    )
    # The mapping may still be a pixel or two wrong.
    dark, there = seen[2:].max(axis=0), np.asarray(inside[2:].all(axis=0))
    ends = np.empty((2, len(lines), 2))
    ends[..., axis], ends[..., 1 - axis] = lines, np.array([[others.min()], [others.max()]])
    first, last = images_of(mapping, ends.reshape(-1, 2)).reshape(ends.shape)
    size, count = max(ridges.darkness.shape), there.shape[1]
    # Samples are as many for all lines; ridge points are one for each pixel of their length.
    part = there.sum(axis=1) / count
    length = part * np.hypot(*(last - first).T).clip(0, size)
    support = (np.rint(number)[:, None] == lines).sum(axis=0)
    found = (part > _SHORTEST / size) & (support > _SUPPORT * length)
    if not found.any():
        return np.array([], dtype=np.intp)
    usual = quantile(dark, there, 0.5)
    along = ((dark > 0.5 * usual[:, None]) & there).sum(axis=1) / np.maximum(there.sum(axis=1), 1)
    # The edge of the board is dark on one side only.
    rises = [
        np.where(side.any(axis=1), quantile(usual[:, None] - values, side, BETWEEN_SIDES), np.inf)
        for values, side in zip(seen[:2], inside[:2], strict=True)
    ]
    rise = np.where(np.isinf(np.min(rises, axis=0)), 1.0, np.min(rises, axis=0))
    found &= (along > _LEAST_DARK) & (rise > 0.05 * usual)
    return np.asarray(lines[found])
