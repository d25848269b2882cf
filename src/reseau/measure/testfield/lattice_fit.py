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
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...adjust import BatchOptions, adjust_batch, weight_function
from ...core.data import Array, Mask, Rows
from ...optics import Chain, PlaneMapping, RationalPolynomial
from ...optics.field import trend_degree
from ...optics.newton import solve_2x2
from .lattice import BETWEEN_SIDES, Lattice, Ridges, quantile, rms
from .line_profiles import crossings, located

__all__ = [
    "LatticeFit",
    "common_part",
    "fit_lattice",
    "lattices",
    "reduced",
    "refit",
    "second_order",
    "slope_of",
    "straightened",
]

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
_LONGEST = 0.5
"""Longest step, in lattice coordinates, of the inversion of a mapping."""
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
_LEAST_POINTS, _ENOUGH, _SOME = 40, 800, 3000
"""Minimum number of ridge points of a lattice, number that is sufficient at first, and number of ridge points
of the frame (most not on lines) among which they are selected."""
"""Central part of the frame, relative to half its size, that determines the projectivity."""
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
    return float(np.abs(after.mapping(at) - before.mapping(at)).max())


def _parts(ridges: Ridges, found: Lattice, axis: int) -> int:
    """The greatest number of parts into which lines divide the distance between those found."""
    numbers = (found.across, found.along)
    mapping = _start(found, ridges.darkness.shape)
    dark, inside = _darkness_along(mapping, ridges, axis, numbers[axis].astype(float), numbers[1 - axis])
    if not inside.any():
        return 1
    level = 0.5 * np.median(quantile(dark, inside, 0.5)[inside.any(axis=1)])
    for parts in sorted(_PARTS[1:], reverse=True):
        steps = np.arange(numbers[axis].min() * parts, numbers[axis].max() * parts + 1)
        between = steps[steps % parts != 0] / parts
        dark, inside = _darkness_along(mapping, ridges, axis, between, numbers[1 - axis])
        share = ((dark > level) & inside).sum(axis=1) / np.maximum(inside.sum(axis=1), 1)
        if np.median(share) > _BETWEEN:
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
    mapping = _start(lattice, ridges.darkness.shape)
    each = max(1, len(ridges.xy) // _SOME)
    all_xy, all_normal = ridges.xy[::each], ridges.normal[::each]
    numbers = [lattice.across, lattice.along]
    for turn in range(_MOST_TURNS):
        gate, degrees = _GATES[min(turn, len(_GATES) - 1)]
        at = _coordinates(mapping, all_xy)
        row, axis = _assigned(mapping, all_normal, at, gate, degrees, numbers)
        if len(row) < _LEAST_POINTS:
            return None
        mapping = _radially(mapping, all_xy[row], all_normal[row], at[row], axis)
        if turn + 1 < len(_GATES):
            continue
        wider = [np.arange(lines.min() - 1, lines.max() + 2) for lines in numbers]
        at = _coordinates(mapping, all_xy)
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
    at = _coordinates(mapping, all_xy)
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
    assert isinstance(mapping.second, RationalPolynomial)
    offset, scale = np.array(mapping.second.offset), mapping.second.scale
    on, each = at.copy(), np.arange(len(at))
    on[each, axis] = np.rint(on[each, axis])
    matrix = np.append(mapping.first.values, 1.0)
    k = float(mapping.second.value_of("X_30")) / scale if "X_30" in mapping.second.names else 0.0
    place = np.column_stack([on, np.ones(len(on))])
    lines = min(len(np.unique(on[axis == i, i])) for i in (0, 1))
    prior = np.zeros(9)
    # Two lines in each direction do not determine the distortion.
    prior[8] = (_POINT_PX / scale / (_DISTORTED if lines > 2 else 1e-9)) ** 2
    for _ in range(_RADIAL_TIMES):
        seen = place @ matrix.reshape(3, 3).T
        u = (seen[:, :2] / seen[:, 2:] - offset) / scale
        r2 = (u**2).sum(axis=1)
        off = (normal * (xy - offset - scale * u * (1 + k * r2)[:, None])).sum(axis=1)
        # nᵀ dF/du, and du/dH.
        by_u = scale * ((1 + k * r2)[:, None] * normal + 2 * k * (normal * u).sum(axis=1)[:, None] * u)
        by_seen = by_u / (scale * seen[:, 2:])
        third = -(by_seen * (seen[:, :2] / seen[:, 2:])).sum(axis=1, keepdims=True)
        by_matrix = (np.concatenate([by_seen, third], axis=1)[:, :, None] * place[:, None]).reshape(-1, 9)
        design = np.column_stack([by_matrix[:, :8], scale * (normal * u).sum(axis=1) * r2])
        limit = max(4.0 * 1.4826 * float(np.median(np.abs(off))), 3 * _POINT_PX)
        weight = np.clip(1 - (off / limit) ** 2, 0, None) ** 2
        size = np.sqrt((design**2).sum(axis=0)) + 1e-12
        scaled = design / size
        cofactor = (scaled * weight[:, None]).T @ scaled + np.diag(prior / size**2 + 1e-9)
        pull = (scaled * weight[:, None]).T @ off - np.append(np.zeros(8), prior[8] * k / size[8])
        step = np.linalg.solve(cofactor, pull) / size
        matrix[:8] += step[:8]
        k = float(np.clip(k + step[8], -_MOST_DISTORTED, _MOST_DISTORTED))
        if np.abs(design @ step).max() < 0.1 * _POINT_PX:
            break
    curved = RationalPolynomial.polynomial(3, offset=mapping.second.offset, scale=scale)
    terms = dict.fromkeys(("X_30", "X_12", "Y_21", "Y_03"), k * scale)
    return Chain(mapping.first.with_values(matrix[:8]), curved.with_values(terms))


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
    degree = _degree_of([fit.across, fit.along])
    mapping, residuals = _adjusted(fit.mapping, degree, *points)
    return replace(fit, mapping=mapping, rms_px=rms(residuals), points=len(residuals))


def reduced(mapping: Chain, factor: float, shift: Array) -> Chain:
    """A mapping to an enlarged image as one to the original; the point x is at factor · x + shift there."""
    assert isinstance(mapping.second, RationalPolynomial)
    matrix = np.append(mapping.first.values, 1.0).reshape(3, 3)
    matrix[:2] = (matrix[:2] - np.outer(shift, matrix[2])) / factor
    curved = mapping.second
    values = dict(zip(curved.names, curved.values.tolist(), strict=True))
    values |= {name: values[name] - float(by) for name, by in zip(("X_00", "Y_00"), shift, strict=True)}
    offset = (np.array(curved.offset) - shift) / factor
    moved = replace(
        curved, offset=(float(offset[0]), float(offset[1])), scale=curved.scale / factor
    ).with_values({name: value / factor for name, value in values.items()})
    return Chain(mapping.first.with_values(matrix.ravel()[:8]), moved)


def _start(lattice: Lattice, shape: tuple[int, ...]) -> Chain:
    """The projectivity of a lattice, followed by a polynomial that is still zero."""
    h, w = shape
    straight = RationalPolynomial.projective()
    matrix = lattice.homography / lattice.homography[2, 2]
    curved = RationalPolynomial.polynomial(_DEGREE, offset=((w - 1) / 2, (h - 1) / 2), scale=max(h, w) / 2)
    return Chain(straight.with_values(dict(zip(straight.names, matrix.ravel(), strict=False))), curved)


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
    for _ in range(6):
        step = solve_2x2(slope, xy - mapping(at))
        at = at + step.clip(-_LONGEST, _LONGEST)
        if np.abs(step).max(initial=0.0) < 1e-3:
            break
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


def _assigned(
    mapping: Chain, normal: Array, at: Array, gate: float, degrees: float, numbers: list[Rows]
) -> tuple[Rows, Rows]:
    """Ridge points on a lattice line and parallel to it: their indices, and the axis numbering the line.

    Only the lines of these numbers count, and points between the outermost of them and half a step beyond.
    """
    rows, axes = [], []
    low, high = (np.array([pick(number) for number in numbers]) for pick in (np.min, np.max))
    within = ((at > low - 0.5) & (at < high + 0.5)).all(axis=1)
    for axis in (0, 1):
        whole = np.rint(at[:, axis])
        near = np.flatnonzero(within & (np.abs(at[:, axis] - whole) < gate) & np.isin(whole, numbers[axis]))
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
    monomials, observed = _monomials(mapping, at), (xy - mapping.first(at)).T
    fit, residuals = _solved(mapping, monomials, observed, sigma_px)
    common = common_part(at, residuals.T)
    if common is None:
        return fit
    # A robust adjustment has rejected all points of a region. Points that agree with their neighbours count.
    own = np.hypot(*(residuals.T - common).T)
    agree = own < _ALONE * np.median(own)
    if agree.sum() <= 2 * monomials.shape[1]:
        return fit
    size = np.maximum(np.linalg.norm(monomials, axis=0), 1e-12)
    values: Array = np.linalg.lstsq((monomials / size)[agree], observed.T[agree], rcond=1e-10)[0]
    names = mapping.second.names
    curved = mapping.second.with_values(
        dict(zip(names, mapping.second.values + (values / size[:, None]).T.ravel(), strict=True))
    )
    return Chain(mapping.first, curved)


def common_part(at: Array, residuals: Array) -> Array | None:
    """Medians (n, 2) of the residuals (n, 2) of points (n, 2) and their nearest neighbours.

    None if neighbours deviate together nowhere, by more than a tenth of a pixel.
    """
    far = (np.abs(residuals) > _TOGETHER_PX).any(axis=1)
    if len(at) < _NEIGHBOURS or np.count_nonzero(far) <= _NEIGHBOURS // 2:
        return None
    near = KDTree(at).query(at, k=_NEIGHBOURS)[1]
    common: Array = np.median(residuals[near], axis=1)
    size, scatter = np.abs(common), np.median(np.abs(residuals[near] - common[:, None]), axis=1)
    return common if ((size > _TOGETHER_PX) & (scatter < _SCATTER * size)).any() else None


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


def _darkness_along(
    mapping: Chain, ridges: Ridges, axis: int, lines: Array, others: Rows
) -> tuple[NDArray[np.float32], Mask]:
    """Darkness (l, n) along lattice lines between the outermost crossing lines; which are in the frame."""
    h, w = ridges.darkness.shape
    along = np.linspace(others.min(), others.max(), max(_LEAST_SAMPLES, max(h, w) // _EACH_PX))
    at = np.empty((len(lines), len(along), 2))
    at[..., 1 - axis], at[..., axis] = along, lines[:, None]
    xy = mapping(at.reshape(-1, 2)).reshape(at.shape)
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
    first, last = mapping(ends.reshape(-1, 2)).reshape(ends.shape)
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
