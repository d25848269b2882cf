"""Adjustment of the four edges of a frame: corners, indicated principal point and axes with covariance.

Each edge is a chord between its two corners with a bow that vanishes at both (film unflatness, the scanner's
lens). Its profiles are observations. The frame's shape (right angles, proportions of the format) is observed,
too, with the accuracy of camera gates: well measured edges are hardly affected, and a missing edge is still
determined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...adjust import Adjustment, GaussMarkov, Options, Parameters, adjust, robust
from ...core.data import Array, Mask
from ...core.failure import Code, Failure
from .search import crossings_of

__all__ = [
    "EdgeData",
    "FrameShape",
    "Lines",
    "adjust_lines",
    "derived",
    "robust_line",
    "shape_of",
    "shared_error",
    "waviness",
]

_BOW_PX, _LEAST_BOW_PX = 3.0, 0.2
"""Prior standard deviation of the bow of an edge in pixels, and its minimum once bows are measured."""
_SECTIONS = 24, 12
"""Numbers of sections of an edge whose means show the errors common to neighbouring profiles: structures of
the picture and phases of the pixels are longer than some of them."""
_REWEIGHTED = 8
"""Number of adjustments of these polynomials with weights that decrease with the residuals."""
_LEAST_SCALE = 0.3
"""Scatter of residuals over sigmas below which sigmas as given decide which profiles agree."""
_WAVES, _LEAST_WAVED, _SIGNIFICANT, _LEAST_WAVE_PX = 5, 40, 25.0, 0.05
"""Degree of the polynomials that show that an edge is no bowed line, minimum number of profiles, and least
significance (χ² of three coefficients) and size."""
_MODEL_PX = 0.012
"""Standard deviation of the error of either end of an edge by the model of the step, which profiles share."""


@dataclass(frozen=True)
class Rival:
    """Another explanation of an edge: what it is, its probability, and what it moves inwards, pixels."""

    what: str
    probability: float
    moved_px: float

    def __str__(self) -> str:
        way = "inwards" if self.moved_px > 0 else "outwards"
        moved = f"would move it {abs(self.moved_px):.2g} px {way}"
        return f"{self.what} (probability {self.probability:.2f}) {moved}"


@dataclass(frozen=True, eq=False)
class EdgeData:
    """Profiles of one edge as observations, in columns.

    Parameters
    ----------
    xy : ndarray (n, 2)
        Positions of the steps, pixels.
    sigma : ndarray (n,)
        Standard deviations across the edge.
    common : float
        Standard deviation of an error common to all profiles, pixels.
    ends : float
        Standard deviation of an independent error of either end of the edge, pixels.
    wave : float
        The part of it by which the edge is neither straight nor evenly bowed.
    rival : Rival, optional
        The second best explanation of what is seen.
    """

    xy: Array
    sigma: Array
    common: float = 0.0
    ends: float = 0.0
    wave: float = 0.0
    rival: Rival | None = None


@dataclass(frozen=True)
class FrameShape:
    """Prior knowledge of a frame's shape.

    Parameters
    ----------
    width, height : float
        Width and height of the format as it lies in the scan, mm.
    aspect_sigma : float
        Relative standard deviation of the proportions, from the gate and the scanner's two scales.
    angle_sigma : float
        Standard deviation of the right angles, radians.
    deviation : tuple of float (4,)
        Known deviations: of the angles at ur, lr, ll from right angles, and of the logarithm of the
        proportions from the format's; zero, or as shown by other frames of the camera.
    """

    width: float
    height: float
    aspect_sigma: float = 0.007
    angle_sigma: float = 0.004
    deviation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Lines:
    """The adjusted edges of a frame.

    Parameters
    ----------
    corners : ndarray (4, 2)
        Corners ul, ur, lr, ll, pixels.
    covariance : ndarray (8, 8)
        Covariance of their coordinates.
    bow, bow_sigma : ndarray (4,)
        Sagittas of the edges, positive outwards, pixels.
    used, rejected : ndarray of int (4,)
        Number of profiles.
    rms : ndarray (4,)
        Rms of the residuals of the profiles used, pixels; NaN if there are none.
    coverage : ndarray (4,)
        Share of each edge's length that is controlled by profiles.
    shape_w : ndarray (4,)
        Test values of the shape: three angles (at ur, lr, ll) and the proportions, N(0, 1).
    sigma0 : float
        Standard deviation of unit weight.
    redundancy : int
        Redundancy of the adjustment.
    """

    corners: Array
    covariance: Array
    bow: Array
    bow_sigma: Array
    used: Array
    rejected: Array
    rms: Array
    coverage: Array
    shape_w: Array
    sigma0: float
    redundancy: int


def robust_line(
    place: Array, offset: Array, sigma: Array, unit: float, bow: float = _BOW_PX
) -> tuple[Array, Mask] | None:
    """Chord and bow of one edge as [at −1, at 1, bow], and a mask of the profiles that agree.

    Parameters
    ----------
    place, offset, sigma : ndarray (n,)
        Positions along the edge (−1 to 1), offsets inwards, and standard deviations.
    unit : float
        Minimum contribution of a profile's neighbourhood to its standard deviation.
    bow : float
        Prior standard deviation of the bow.
    """
    if len(place) < 12:
        return None
    design = np.stack([(1 - place) / 2, (1 + place) / 2, -(1 - place**2)], axis=1)
    total = np.hypot(sigma, unit)
    prior = {"bow": bow}
    start = [float(np.median(offset))] * 2 + [0.0]
    problem = GaussMarkov(
        lambda x: design @ x,
        offset,
        total,
        Parameters(["start", "stop", "bow"], start, prior_sigma=prior),
        jacobian=lambda x: design,
    )
    fit = robust(problem, "tukey", tolerance=1e-3)
    if isinstance(fit, Failure) or fit.scale < _LEAST_SCALE:
        # The sigmas of many profiles are far too large: those they could be displaced by are not there.
        fit = robust(problem, "tukey", scale="a-priori", tolerance=1e-3)
    if isinstance(fit, Failure):
        return None
    values = fit.adjustment.values
    away = np.abs(offset - design @ values) / total
    return values, np.asarray(away < 3.5 * max(fit.scale, 1.0))


def adjust_lines(
    corners: Array, edges: Sequence[EdgeData | None], shape: FrameShape | None, rejected: Sequence[int]
) -> Lines | Failure:
    """Adjust four edges and the frame's shape together.

    Parameters
    ----------
        Approximate corners, accurate to a few pixels.
        Approximate corners, good to some pixels.
    edges : sequence of EdgeData or None
        Upper, right, lower, left; None for a missing edge, which is then determined by the shape.
    shape : FrameShape or None
        Prior knowledge of the shape.
    rejected : sequence of int
        Profiles of each edge that were rejected before; included in the reported numbers.
    """
    if sum(edge is None for edge in edges) > (shape is not None):
        return Failure(
            "fewer than three edges of a known format, or than four of an unknown one", Code.NOT_FOUND
        )
    bow, keep = _BOW_PX, np.zeros(0, dtype=bool)
    for _ in range(2):
        problem, bounds = _problem(corners, edges, shape, bow)
        found = robust(problem, "huber", tuning=2.5, scale="a-priori", tolerance=1e-2, options=_APRIORI)
        if isinstance(found, Failure):
            return found
        corners = _corners(found.adjustment.values, corners)
        bow = _bow_of(found.adjustment.values[2:12:3], found.adjustment.sigma[2:12:3])
        # Profiles far from the adjusted lines are rejected permanently.
        keep = (np.abs(found.adjustment.w) < 4.0) | ~np.isfinite(found.adjustment.w)
    keep[bounds[-1] :] = True
    problem, bounds = _problem(corners, edges, shape, bow)
    fit = adjust(problem.with_weights(keep.astype(np.float64)), _APRIORI)
    if isinstance(fit, Failure):
        return fit
    return _lines(fit, corners, edges, bounds, keep, rejected)


_APRIORI = Options(scale="a-priori")
_NAMES = tuple(f"{edge}.{what}" for edge in ("upper", "right", "lower", "left") for what in ("a", "b", "bow"))


def _bow_of(bow: Array, sigma: Array) -> float:
    """Prior standard deviation of the bows, from the estimated bows.

    A partly visible edge is assumed to be bowed about as much as the others, which are determined well.
    """
    known = sigma < 0.5 * _BOW_PX
    if not known.any():
        return _BOW_PX
    weight = 1 / (sigma[known] ** 2 + _LEAST_BOW_PX**2)
    variance = float((weight * (bow[known] ** 2 - sigma[known] ** 2)).sum() / weight.sum())
    return float(np.clip(1.5 * np.sqrt(max(variance, 0.0)), _LEAST_BOW_PX, _BOW_PX))


def _frame_axes(corners: Array) -> tuple[Array, Array, Array]:
    """Start and end of the approximate edges and their inward normals, each (4, 2)."""
    following = np.roll(corners, -1, axis=0)
    along = (following - corners) / np.hypot(*(following - corners).T)[:, None]
    return corners, following, np.stack([-along[:, 1], along[:, 0]], axis=1)


def _corners(values: Array, corners: Array) -> Array:
    """Corners of the adjusted chords."""
    a, b, normal = _frame_axes(corners)
    ends = values[:12].reshape(4, 3)
    return crossings_of(a + ends[:, :1] * normal, b + ends[:, 1:2] * normal)


def shape_of(corners: Array, shape: FrameShape) -> Array:
    """Shape of corners (4, 2): three angles minus right angles, log of proportions over the format's."""
    side = np.roll(corners, -1, axis=0) - corners
    before = np.roll(side, 1, axis=0)
    turn = np.arctan2(before[:, 0] * side[:, 1] - before[:, 1] * side[:, 0], (before * side).sum(axis=1))
    length = np.hypot(*side.T)
    aspect = np.log((length[0] + length[2]) / (length[1] + length[3]) * shape.height / shape.width)
    return np.array([*(turn[1:] - np.pi / 2), aspect])


def _problem(
    corners: Array, edges: Sequence[EdgeData | None], shape: FrameShape | None, bow: float
) -> tuple[GaussMarkov, list[int]]:
    """Observations of the profiles, followed by those of the shape; and the first index of each edge."""
    a, b, normal = _frame_axes(corners)
    rows, observed, sigma, bounds = [], [], [], [0]
    # Independent errors of an edge's ends are unknowns, so that the shape helps to determine them.
    drawn = [k for k, edge in enumerate(edges) if edge is not None and edge.ends > 0]
    names = [*_NAMES, *(f"{k}.{end}" for k in drawn for end in ("start", "stop"))]
    for k, edge in enumerate(edges):
        if edge is not None:
            along = b[k] - a[k]
            place = 2 * ((edge.xy - a[k]) @ along) / (along @ along) - 1
            part = np.zeros((len(place), len(names)))
            part[:, 3 * k : 3 * k + 3] = np.stack([(1 - place) / 2, (1 + place) / 2, -(1 - place**2)], 1)
            if k in drawn:
                own = 12 + 2 * drawn.index(k)
                part[:, own : own + 2] = part[:, 3 * k : 3 * k + 2]
            rows.append(part)
            observed.append((edge.xy - a[k]) @ normal[k])
            sigma.append(edge.sigma)
        bounds.append(bounds[-1] + (0 if edge is None else len(edge.sigma)))
    design = np.concatenate(rows)
    if shape is not None:
        observed.append(np.array(shape.deviation))
        sigma.append(np.array([shape.angle_sigma] * 3 + [shape.aspect_sigma]))

    def of_shape(x: Array) -> Array:
        assert shape is not None
        return shape_of(_corners(x, corners), shape)

    def function(x: Array) -> Array:
        return np.concatenate([design @ x, of_shape(x)]) if shape is not None else design @ x

    def jacobian(x: Array) -> Array:
        if shape is None:
            return design
        step = 0.01
        slope = [(of_shape(x + step * e) - of_shape(x - step * e)) / (2 * step) for e in np.eye(len(x))]
        return np.concatenate([design, np.stack(slope, axis=1)])

    prior = {name: bow for name in _NAMES if name.endswith("bow")}
    for name, k in zip(names[12:], np.repeat(drawn, 2), strict=True):
        prior[name] = edges[k].ends
    parameters = Parameters(names, np.zeros(len(names)), prior_sigma=prior)
    return GaussMarkov(
        function, np.concatenate(observed), np.concatenate(sigma), parameters, jacobian
    ), bounds


def _lines(
    fit: Adjustment,
    corners: Array,
    edges: Sequence[EdgeData | None],
    bounds: list[int],
    keep: Mask,
    rejected: Sequence[int],
) -> Lines:
    """Results derived from the adjusted chords and bows."""
    values = fit.values[:12]
    step = 1e-3
    slope = np.stack(
        [
            (_corners(values + step * e, corners) - _corners(values - step * e, corners)).ravel() / (2 * step)
            for e in np.eye(12)
        ],
        axis=1,
    )
    cofactor = fit.covariance[:12, :12].copy()
    for k, edge in enumerate(edges):
        if edge is not None:
            cofactor[3 * k : 3 * k + 2, 3 * k : 3 * k + 2] += edge.common**2 + _MODEL_PX**2 * np.eye(2)
    covariance = slope @ cofactor @ slope.T
    used, out, rms, coverage = (np.zeros(4) for _ in range(4))
    a, b, _ = _frame_axes(corners)
    for k, edge in enumerate(edges):
        own = slice(bounds[k], bounds[k + 1])
        kept = keep[own]
        used[k], out[k] = kept.sum(), rejected[k] + (~kept).sum()
        residuals = fit.residuals[own][kept]
        rms[k] = np.sqrt(np.mean(residuals**2)) if len(residuals) else np.nan
        if edge is not None and kept.any():
            along = b[k] - a[k]
            place = ((edge.xy[kept] - a[k]) @ along) / (along @ along)
            # Share of thirty sections that contain a profile in use.
            coverage[k] = len(np.unique(np.floor(place * 30))) / 28
    sigma = fit.sigma[:12]
    return Lines(
        _corners(values, corners),
        covariance,
        values[2::3],
        sigma[2::3],
        used.astype(np.intp),
        out.astype(np.intp),
        rms,
        np.minimum(coverage, 1.0),
        fit.w[bounds[-1] :],
        fit.sigma0,
        fit.redundancy,
    )


def shared_error(place: Array, residuals: Array, sigma: Array) -> float:
    """Factor on standard deviations so that they agree with the scatter of means over sections of an edge.

    Parameters
    ----------
    place : ndarray (n,)
        Positions of the profiles, −1 to 1.
    residuals, sigma : ndarray (n,)
        Residuals from the edge's own line, and their expected standard deviations.

    Returns
    -------
    float
        Factor, at least 1: the larger of that of single profiles and that of means over sections.
    """
    single = float(np.mean((residuals / sigma) ** 2))
    together = []
    for count in _SECTIONS:
        section = np.clip(((place + 1) / 2 * count).astype(np.intp), 0, count - 1)
        weight = np.bincount(section, 1 / sigma**2, minlength=count)
        mean = np.bincount(section, residuals / sigma**2, minlength=count)
        seen = weight > 0
        together.append(float((mean[seen] ** 2 / weight[seen]).sum()) / max(int(seen.sum()) - 3, 1))
    return float(np.sqrt(max(single, *together, 1.0)))


def waviness(place: Array, residuals: Array, sigma: Array) -> float:
    """Standard deviation of the ends of an edge that is neither straight nor evenly bowed, pixels.

    A line and a bow through a wave, or through an edge that is bent at one place, miss its ends by about as
    much as polynomials of higher degree depart there. Zero if they are not significant.

    Parameters
    ----------
    place : ndarray (n,)
        Positions of the profiles, −1 to 1.
    residuals, sigma : ndarray (n,)
        Residuals from the edge's own line, and their expected standard deviations.
    """
    if len(place) < _LEAST_WAVED:
        return 0.0
    design = np.polynomial.legendre.legvander(place, _WAVES) / sigma[:, None]
    observed, factor = residuals / sigma, np.ones(len(place))
    for _ in range(_REWEIGHTED):  # Cauchy's weights
        cofactor = np.linalg.pinv(design.T @ (factor[:, None] * design))
        found = cofactor @ design.T @ (factor * observed)
        rest = observed - design @ found
        unit = 2.5 * max(1.4826 * float(np.median(np.abs(rest))), 1e-3)
        factor = 1 / (1 + (rest / unit) ** 2)
    near = np.abs(rest) < 1.4 * unit
    scale = shared_error(place[near], (rest * sigma)[near], sigma[near])
    higher = found[3:]
    together = float(higher @ np.linalg.solve(cofactor[3:, 3:], higher)) / scale**2
    size = float(np.sqrt((higher**2).sum()))
    return size if together > _SIGNIFICANT and size > _LEAST_WAVE_PX else 0.0


def derived(corners: Array, covariance: Array) -> tuple[Array, Array, float, float]:
    """Indicated principal point and direction of the x-axis.

    Parameters
    ----------
    corners : ndarray (4, 2)
        Corners ul, ur, lr, ll, pixels.
    covariance : ndarray (8, 8)
        Covariance of their coordinates.

    Returns
    -------
    (ndarray (2,), ndarray (2, 2), float, float)
        The intersection of the diagonals with its covariance, and the angle from the scan's rows to the lower
        edge, counter-clockwise as seen, with its standard deviation, radians.
    """

    def function(flat: Array) -> Array:
        ul, ur, lr, ll = flat.reshape(4, 2)
        crossing = np.cross(np.cross([*ul, 1], [*lr, 1]), np.cross([*ur, 1], [*ll, 1]))
        way = lr - ll
        return np.array([*(crossing[:2] / crossing[2]), -np.arctan2(way[1], way[0])])

    flat, step = corners.ravel(), 1e-3
    slope = np.stack(
        [(function(flat + step * e) - function(flat - step * e)) / (2 * step) for e in np.eye(8)], 1
    )
    value, cov = function(flat), slope @ covariance @ slope.T
    return value[:2], cov[:2, :2], float(value[2]), float(np.sqrt(cov[2, 2]))
