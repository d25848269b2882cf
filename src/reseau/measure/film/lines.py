"""Adjustment of the four edges of a frame: corners, indicated principal point and axes with covariance.

Each edge is a chord between its two corners with a bow that vanishes at both (film unflatness, the scanner's
lens). Its profiles are observations. The frame's shape (right angles, proportions of the format) is observed,
too, with the accuracy of camera gates: well measured edges are hardly affected, and a missing edge is still
determined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ...adjust import Adjustment, GaussMarkov, Options, Parameters, adjust
from ...adjust.outliers import robust
from ...core.data import Array, Mask, Rows
from ...core.failure import Code, Failure
from ...io import EDGES
from .adjacent_lines import normalised
from .search import frame_axes, moved

_BOW_PX = 3.0
"""Prior standard deviation of the bow of an edge in pixels, before bows are compared."""
_LEAST_SCALE = 0.3
"""Scatter of residuals over sigmas below which sigmas as given decide which profiles agree."""
_BINS, _NEAREST_PX = 48, 0.05
"""Sections in which profiles are averaged; unit of the departures of an edge from its line, pixels."""
_PHASE_PX = 0.04
"""Standard deviation of the harmonics by which a step is displaced with its phase on the pixels."""
_LENGTHS, _TIMES = np.array([0.04, 0.1, 0.25, 0.6]), np.geomspace(0.05, 25.6, 10)
"""Lengths over which departures are alike, in halves of the edge, and sizes of them, in their units: evenly
distributed in their logarithms."""
_WAVES = np.array([0.1, 0.2, 0.4])
"""Lengths of waves of film and gate, which are smooth and do not depend on the picture, likewise."""
_FROM, _CONTOUR, _AWAY_PX, _DARK = np.linspace(-0.2, 0.7, 6), 0.25, np.array([1.0, 3.0, 9.0]), 0.1
"""Places from which an end may be hidden by a dark picture; length over which the contour that is seen there
is alike, and its distances from the edge; and the probability of it."""
_BOWS = np.geomspace(0.1, 10.0, 5)
_ODD = 0.05
"""Sizes of the bows of edges, pixels, evenly distributed in their logarithm; and the probability that an edge
is not bowed like the others."""


@dataclass(frozen=True)
class Rival:
    """Another explanation of an edge: what it is, its probability, and what it moves inwards, pixels."""

    what: str
    probability: float
    moved_px: float

    def __str__(self) -> str:
        way = "inwards" if self.moved_px > 0 else "outwards"
        moved = f"{'moves' if self.probability > 0.5 else 'would move'} it {abs(self.moved_px):.2g} px {way}"
        return f"{self.what} (probability {self.probability:.2f}) {moved}"


@dataclass(frozen=True, eq=False)
class EdgeData:
    """One edge as measured.

    Parameters
    ----------
    line, covariance : ndarray (3,), (3, 3)
        Offsets of its ends inwards from the approximate edge, and its bow, positive outwards, pixels.
    xy, residuals : ndarray (n, 2), (n,)
        Positions of the profiles used, and their distances from the line; none if it was adjusted as a whole.
    departs : float
        Standard deviation by which the edge departs from a bowed line, and neighbouring profiles alike.
    doubt : float
        Standard deviation of its ends by other explanations of the edge, which the covariance contains.
    rival : Rival, optional
        The second best explanation of what is seen.
    curves : ndarray (k, 2)
        For each curve of the grey values the logarithm of its likelihood, over that with which the edge was
        measured, and how far inwards it puts the edge.
    """

    line: Array
    covariance: Array
    xy: Array
    residuals: Array
    departs: float = 0.0
    doubt: float = 0.0
    rival: Rival | None = None
    curves: Array = field(default_factory=lambda: np.zeros((1, 2)))

    def curved(self, share: Array) -> EdgeData:
        """The edge in the mean of the curves of the grey values, with these probabilities (k,)."""
        moves = self.curves[:, 1]
        mean = float(share @ moves)
        doubt = float(np.sqrt(self.doubt**2 + share @ (moves - mean) ** 2))
        return replace(self, line=self.line + mean * np.array([1.0, 1.0, 0.0])).doubted(doubt)

    def doubted(self, doubt: float) -> EdgeData:
        """The edge with the doubt of another channel, if it is larger."""
        if doubt <= self.doubt:
            return self
        more = np.diag([1.0, 1.0, 0.0]) * (doubt**2 - self.doubt**2)
        return replace(self, covariance=self.covariance + more, doubt=doubt)


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
    corners : ndarray (4, 2)
        Ends of the approximate edges.
    edges : sequence of EdgeData or None
        Upper, right, lower, left; None for a missing edge, which is then determined by the shape.
    shape : FrameShape or None
        Prior knowledge of the shape.
    rejected : sequence of int
        Number of profiles of each edge that were rejected.
    """
    if sum(edge is None for edge in edges) > (shape is not None):
        return Failure(
            "fewer than three edges of a known format, or than four of an unknown one", Code.NOT_FOUND
        )
    fit = adjust(_problem(corners, edges, shape), _APRIORI)
    return fit if isinstance(fit, Failure) else _lines(fit, corners, edges, rejected)


@dataclass(frozen=True)
class Contender:
    """An edge that may be another line.

    Parameters
    ----------
    edge : int
        0 to 3: upper, right, lower, left.
    probability : float
        Probability that it is another line, and not an edge of the frame.
    inwards : float
        Mean distance inwards from where the other edges and the format put it, and its standard deviation.
    sigma : float
        Standard deviation of this distance, pixels.
    """

    edge: int
    probability: float
    inwards: float
    sigma: float

    def __str__(self) -> str:
        way = "inside" if self.inwards > 0 else "outside"
        return (
            f"{EDGES[self.edge]} one (probability {self.probability:.2f}), {abs(self.inwards):.0f} ± "
            f"{self.sigma:.0f} px {way} of where the others put it"
        )


def explained_shape(
    corners: Array, edges: Sequence[EdgeData | None], shape: FrameShape, px_per_mm: float | None
) -> tuple[list[Contender], float]:
    """Explain the shape of four edges: a frame, one seen at an angle, or one of the edges is another line.

    An edge of the frame lies where the other three and the format put it, within the tolerances of gates, and
    the frame has the size of its format or, in a mount, a smaller one; another line may lie anywhere near. A
    tilted copying camera makes opposite edges converge and preserves the sums of opposite angles.

    Parameters
    ----------
    corners, edges, shape
        As in :func:`adjust_lines`.
    px_per_mm : float, optional
        Resolution of the scan.

    Returns
    -------
    (list of Contender, float)
        The edges that may be other lines, the most probable first, and the probability of a tilted camera.
    """
    free = adjust_lines(corners, edges, None, [0] * 4)
    if isinstance(free, Failure):
        return [], 0.0

    def size(of: Array) -> float:
        """Density of the size of a frame at the known resolution."""
        if px_per_mm is None:
            return 1.0
        side = np.log(np.hypot(*(np.roll(of, -1, axis=0) - of).T).sum() / (shape.width + shape.height) / 2)
        away = (float(side) - np.log(px_per_mm)) / _SIZE
        return float((1 - _MOUNTED) * np.exp(-0.5 * away**2) / np.sqrt(2 * np.pi) + _MOUNTED * _SIZE / _RANGE)

    def density(of: Array, covariance: Array) -> float:
        """Logarithm of that of a normal distribution."""
        return -0.5 * float(
            of @ np.linalg.solve(covariance, of) + np.linalg.slogdet(2 * np.pi * covariance)[1]
        )

    slope = np.array([shape_of(free.corners + e, shape) for e in 0.01 * np.eye(8).reshape(8, 4, 2)])
    off = shape_of(free.corners, shape)
    slope = (slope - off).T / 0.01
    gate = np.diag([shape.angle_sigma**2] * 3 + [shape.aspect_sigma**2]) + slope @ free.covariance @ slope.T
    converging = _SLANT**2 / 2 * np.array([[1, 0, -1], [0, 1, 0], [-1, 0, 1]])
    seen = gate + np.pad(converging, (0, 1)) + np.diag([0.0, 0.0, 0.0, 8 * shape.aspect_sigma**2])
    off = off - np.array(shape.deviation)
    tilted = _TILTED * float(np.exp(min(density(off, seen) - density(off, gate), 600.0)))
    a, b, normal = frame_axes(corners)
    length = np.hypot(*(b - a).T)
    odds, found = [], []
    for k, own in enumerate(edges):
        lines = adjust_lines(corners, [None if i == k else e for i, e in enumerate(edges)], shape, [0] * 4)
        if own is None or isinstance(lines, Failure):
            continue
        part = np.zeros((2, 8))
        for i, end in enumerate((k, (k + 1) % 4)):
            part[i, 2 * end : 2 * end + 2] = normal[k]
        away = own.line[:2] - part @ (lines.corners - a[k]).ravel()
        covariance = part @ lines.covariance @ part.T + own.covariance[:2, :2]
        anywhere = _ANOTHER / (2 * _BESIDE * length[k - 1] * 4 * _TURNED * length[k])
        anywhere *= size(lines.corners) / size(free.corners)
        odds.append(anywhere * np.exp(min(-density(away, covariance), 600.0)))
        found.append(Contender(k, 0.0, float(away.mean()), float(np.sqrt(covariance.sum() / 4))))
    total = 1 + tilted + sum(odds)
    found = [replace(each, probability=float(one / total)) for each, one in zip(found, odds, strict=True)]
    return sorted(found, key=lambda each: -each.probability), tilted / total


_ANOTHER = 0.01
"""Prior probability that a line found as an edge of a frame is another one: one frame of 25 has one."""
_BESIDE, _TURNED = 0.05, float(np.deg2rad(1.0))
"""Range of the distances of such lines from the edge, as a share of the frame, and of their directions, for
which the search takes them for an edge."""
_TILTED, _SLANT = 0.02, float(np.deg2rad(0.7))
"""Prior probability of a tilted copying camera, and standard deviation of its rotation angle, radians."""
_SIZE, _MOUNTED, _RANGE = 0.007, 0.05, 0.12
"""Relative standard deviation of the size of a frame at the resolution of its scan, probability that it has
another one, as in a mount, and range of these."""
_APRIORI = Options(scale="a-priori")
_NAMES = tuple(f"{edge}.{what}" for edge in ("upper", "right", "lower", "left") for what in ("a", "b", "bow"))


def _corners(values: Array, corners: Array) -> Array:
    """Corners of the adjusted chords."""
    return moved(corners, values[:12].reshape(4, 3)[:, :2])


def shape_of(corners: Array, shape: FrameShape) -> Array:
    """Shape of corners (4, 2): three angles minus right angles, log of proportions over the format's."""
    side = corners[[1, 2, 3, 0]] - corners
    before = side[[3, 0, 1, 2]]
    turn = np.arctan2(before[:, 0] * side[:, 1] - before[:, 1] * side[:, 0], (before * side).sum(axis=1))
    length = np.hypot(*side.T)
    aspect = np.log((length[0] + length[2]) / (length[1] + length[3]) * shape.height / shape.width)
    return np.array([*(turn[1:] - np.pi / 2), aspect])


def _problem(corners: Array, edges: Sequence[EdgeData | None], shape: FrameShape | None) -> GaussMarkov:
    """Observations of the edges, three for each, followed by those of the shape."""
    rows, observed = [], []
    for k, edge in enumerate(edges):
        if edge is not None:
            part = np.zeros((3, 12))
            part[:, 3 * k : 3 * k + 3] = np.linalg.inv(np.linalg.cholesky(edge.covariance))
            rows.append(part)
            observed.append(part[:, 3 * k : 3 * k + 3] @ edge.line)
    design = np.concatenate(rows)
    sigma = [np.ones(len(design))]
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

    prior = {name: _BOW_PX for name in _NAMES if name.endswith("bow")}
    parameters = Parameters(_NAMES, np.zeros(len(_NAMES)), prior_sigma=prior)
    return GaussMarkov(function, np.concatenate(observed), np.concatenate(sigma), parameters, jacobian)


def _lines(
    fit: Adjustment, corners: Array, edges: Sequence[EdgeData | None], rejected: Sequence[int]
) -> Lines:
    """Results derived from the adjusted chords and bows."""
    values, step = fit.values, 1e-3
    slope = np.stack(
        [
            (_corners(values + step * e, corners) - _corners(values - step * e, corners)).ravel() / (2 * step)
            for e in np.eye(12)
        ],
        axis=1,
    )
    used, rms, coverage = (np.zeros(4) for _ in range(3))
    a, b, _ = frame_axes(corners)
    for k, edge in enumerate(edges):
        rms[k] = np.nan
        if edge is not None:
            used[k] = len(edge.xy)
            if len(edge.residuals):
                rms[k] = np.sqrt(np.mean(edge.residuals**2))
            along = b[k] - a[k]
            place = ((edge.xy - a[k]) @ along) / (along @ along)
            # Share of thirty sections that contain a profile in use.
            coverage[k] = len(np.unique(np.floor(place * 30))) / 28
    return Lines(
        _corners(values, corners),
        slope @ fit.covariance @ slope.T,
        values[2::3],
        fit.sigma[2::3],
        used.astype(np.intp),
        np.array(rejected, dtype=np.intp),
        rms,
        np.minimum(coverage, 1.0),
        fit.w[3 * sum(edge is not None for edge in edges) :],
        fit.sigma0,
        fit.redundancy,
    )


class Departing(NamedTuple):
    """An edge with each of k displacements of its steps, for each of b sizes of bows.

    Parameters
    ----------
    values, covariance : ndarray (b, k, 3), (b, k, 3, 3)
        Start, stop and bow.
    log : ndarray (b, k)
        Logarithm of the likelihood.
    """

    values: Array
    covariance: Array
    log: Array


def departing_line(
    place: Array,
    offset: Array,
    sigma: Array,
    harmonics: Array,
    moved: Array,
    displaced: Array,
    *,
    hidden: bool = False,
) -> Departing:
    """Chord and bow of an edge from which profiles depart, and neighbours alike.

    What the picture shows beside an edge displaces its steps over some length along it; film and gate are
    neither straight nor evenly bowed. The departures are a random process along the edge of which size and
    length are unknown: the mean over them, weighted by their likelihoods (Patterson and Thompson 1971), for
    each of the sizes that bows may have.

    Parameters
    ----------
    place, offset, sigma : ndarray (n,)
        Positions along the edge (−1 to 1), offsets inwards, and standard deviations by noise.
    harmonics : ndarray (n, m)
        Functions of the phase of the edge on the pixels, with which its steps are displaced alike.
    moved : ndarray (n,)
        Sizes of the departures relative to each other.
    displaced : ndarray (n, k)
        Displacements of the steps by each of k explanations.
    hidden : bool
        Whether one end may be hidden: the picture is as dark as film there, and what is seen lies in it.
    """
    order = np.argsort(place, kind="stable")
    place, offset, sigma, moved, harmonics, displaced = (
        each[order] for each in (place, offset, sigma, moved, harmonics, displaced)
    )
    change = np.abs(np.diff(offset)) / np.hypot(sigma[1:], sigma[:-1])
    weight = (max(1.0, 1.4826 * float(np.median(change))) * sigma) ** -2
    part = _sections(place)
    total = np.bincount(part, weight, minlength=_BINS)
    seen = total > 0
    columns = (place, np.hypot(moved, _NEAREST_PX), *harmonics.T, *(offset[:, None] - displaced).T)
    t, size, *each = (np.bincount(part, weight * c, minlength=_BINS)[seen] / total[seen] for c in columns)
    phase, last = each[: harmonics.shape[1]], 3 + harmonics.shape[1]
    design = np.stack([(1 - t) / 2, (1 + t) / 2, -(1 - t**2), *each], axis=1)
    prior = np.diag([1e-6, 1e-6, 0.0] + [_PHASE_PX**-2] * len(phase)) + np.zeros((len(_BOWS), 1, 1, 1))
    prior[:, 0, 2, 2] = _BOWS**-2
    covariance, likely = _departures(t, size, hidden)
    covariance += np.diag(1 / total[seen])
    root = np.linalg.cholesky(covariance)
    white = np.linalg.solve(root, np.broadcast_to(design, (len(root), *design.shape)))
    white, own = white[..., :last], white[..., last:]
    normal = white.transpose(0, 2, 1) @ white + prior
    cofactor = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    every = cofactor @ (white.transpose(0, 2, 1) @ own)
    rest = (own**2).sum(axis=1) - (every * (normal @ every)).sum(axis=2)
    log = -np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1) - np.linalg.slogdet(normal)[1] / 2
    log = (log + likely - np.log(_BOWS)[:, None])[..., None] - rest / 2
    likelihood, share = normalised(log.swapaxes(0, 1))
    found = every[:, :, :3].transpose(1, 0, 3, 2)
    mean, spread = mixed(share, found, cofactor[..., :3, :3].swapaxes(0, 1)[:, :, None])
    return Departing(mean, spread, likelihood)


def _sections(place: Array) -> Rows:
    """Sections (n,) in which profiles are averaged."""
    return np.clip(((place + 1) / 2 * _BINS).astype(np.intp), 0, _BINS - 1)


def departures_of(place: Array, rest: Array, sigma: Array) -> float:
    """Root mean square of the distances of an edge from its line, without noise, pixels."""
    part = _sections(place)
    total = np.bincount(part, sigma**-2, minlength=_BINS)
    seen = total > 0
    mean = np.bincount(part, rest * sigma**-2, minlength=_BINS)[seen] / total[seen]
    return float(np.sqrt(np.maximum(np.mean(mean**2 - 1 / total[seen]), 0.0)))


def bows_alike(logs: Sequence[Array | None]) -> list[Array]:
    """Logarithms (b,) of the probabilities of the sizes of bows for each edge, by the other edges.

    The edges of a frame are bowed alike, by film, gate and lens; one of them may be odd. `logs` are the
    logarithms of their likelihoods.
    """
    shown = np.array([np.zeros(len(_BOWS)) if each is None else _odd(each) for each in logs])
    return [_odd(others) for others in shown.sum(axis=0) - shown]


def _odd(log: Array) -> Array:
    """Logarithms of probabilities, normalised, of which an edge may be odd."""
    share = normalised(log)[1]
    return np.asarray(np.log((1 - _ODD) * share + _ODD / len(share)))


def _departures(t: Array, size: Array, hidden: bool) -> tuple[Array, Array]:
    """Covariances (m, n, n) of the departures at places (n,), and logarithms (m,) of their probabilities."""
    apart, ends = np.abs(t[:, None] - t), np.zeros((0, len(t), len(t)))
    rough = np.exp(-apart / _LENGTHS[:, None, None]) * np.outer(size, size)
    smooth = np.exp(-((apart / _WAVES[:, None, None]) ** 2) / 2) * _NEAREST_PX**2
    every = _TIMES[:, None, None, None] ** 2 * np.concatenate([rough, smooth])
    likely = np.full(every.shape[0] * every.shape[1], -np.log(every.shape[0] * every.shape[1]))
    if hidden:
        inside = np.concatenate([t > _FROM[:, None], t < -_FROM[:, None]])
        # A contour that leaves the edge, and what else is as rough as everywhere.
        alike = np.exp(-((apart / _CONTOUR) ** 2) / 2) + 0.1 * np.exp(-apart / _LENGTHS[1])
        away = inside[:, :, None] * inside[:, None] * alike
        everywhere = every[1::3, 1]  # of one length, in a few sizes
        ends = _AWAY_PX[:, None, None, None, None] ** 2 * away + everywhere[:, None]
        ends = ends.reshape(-1, *apart.shape)
        likely = np.append(likely, np.full(len(ends), np.log(_DARK / len(ends))))
    return np.concatenate([every.reshape(-1, *apart.shape), ends]), likely


def mixed(share: Array, values: Array, covariance: Array) -> tuple[Array, Array]:
    """Means and covariances of mixtures over the first axis, of which the parts have the given ones."""
    weighted = share[..., None] * values
    mean = weighted.sum(axis=0)
    within = (share[..., None, None] * covariance).sum(axis=0)
    square = np.moveaxis(weighted, 0, -1) @ np.moveaxis(values - mean, 0, -2)
    return mean, within + square


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
