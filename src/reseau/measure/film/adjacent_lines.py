r"""Lines of the picture beside an edge of the frame: detection, and adjustment together with the edge.

A line of the picture close behind an edge (Cruz et al., fig. 7B) cannot be separated from it in a single
profile. But it widens the visible step consistently over neighbouring profiles, whereas picture content does
so at random. The widths of the steps therefore show which edges are affected, and by how much.

If a bright line runs within a few pixels of an edge, the larger step from the dark background to the line
displaces the smaller one from film to background towards it. Both are smooth along the edge: sections of it,
i = 1 … s, at the positions t_i from −1 to 1, are averaged and fitted together,

.. math::
    g_i(d) = b_i + A_i\,\Phi\Bigl(\frac{d - p(t_i)}{w}\Bigr)
             + B_i\,\Phi\Bigl(\frac{d - q(t_i)}{w}\Bigr)
             + C_i\,\Phi\Bigl(\frac{d - q(t_i) - h}{w}\Bigr), \qquad
    p = p_0 + p_1 t + p_2 (t^2 - 1), \quad q = q_0 + q_1 t + q_2 t^2,

with the known width w of a blurred step. Where the line departs from the edge, the edge is visible by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from ...adjust import BatchOptions, adjust_batch
from ...core.data import Array, Rows
from .border import Band, binned
from .edges import NEIGHBOURS, EdgeProfiles
from .steps import StepForm

__all__ = [
    "FEW_DISPLACED",
    "AdjacentEdge",
    "SharpSteps",
    "common_forms",
    "displaced_by_lines",
    "edge_beside_line",
    "ends_with_line",
    "is_one_step",
    "sharp_steps",
]

_QUANTILES, _EVEN = (0.1, 0.3), 0.015
"""Quantiles of the widths of profiles: the larger is the width of a sharp step; their difference is the
scatter of its logarithm, with a minimum."""
_UNEVEN, _SCRATCHED = 0.2, 0.5
"""Differences of logarithmic widths: of three edges if the scan is sharper on one side, and of the sharpest
from the next if it is no edge."""
_PIXEL = float(np.sqrt(1 / 12))
"""Width that a pixel adds to that of a step, which is hardly determined if it is much smaller."""
_SMOOTH, _ANISOTROPIC, _END = 0.24, 0.5, 0.5
"""Largest rms deviation of logarithmic widths at the ends of edges from sharpness that changes smoothly over
the scan, largest such difference of the two directions, and share of half an edge that makes an end."""
_ALIKE, _OTHERWISE, _STEADY = 0.4, 0.25, 0.08
"""A scan is sharper in one direction where opposite edges are alike: largest difference of these as a share
of that of the directions, and of the directions (logarithms of widths), and largest scatter of an edge."""
_TOO_SHARP = 0.3
"""Difference of logarithmic width from which steps are too sharp for an edge."""
_LARGEST_DISPLACEMENT = 1.5
"""Largest displacement of a step by a line, in widths; a more distant line is visible by itself."""
_RATIO, FEW_DISPLACED = 4.0, 0.22
"""Ratio of the second step to the first where a line displaces an edge, and share of profiles that show this
by chance."""
_NEIGHBOURHOODS, _INDEPENDENT = 5, 2.5
"""Neighbourhoods of profiles that a line widens consistently; their effective number in picture content."""


class SharpSteps(NamedTuple):
    """Widths of sharp steps of an edge.

    Parameters
    ----------
    log_width : float
        Logarithm of the width.
    scatter, texture : float
        Scatter of the logarithm along the edge (minimum), and its random part from picture content.
    """

    log_width: float
    scatter: float
    texture: float

    @property
    def width(self) -> float:
        """Width, one sigma, pixels."""
        return float(np.exp(self.log_width))

    def beyond(self, found: EdgeProfiles) -> bool:
        """Whether most steps are sharper than those of an edge can be, as at a scratch."""
        return bool(np.median(found.blur[0][found.good]) < self.log_width - _TOO_SHARP)


def common_forms(profiles: Sequence[EdgeProfiles | None]) -> list[StepForm | None]:
    """Form of the blurred step for each edge: common to all, unless their sharpness differs."""
    if _anisotropic(profiles):
        across, down = (
            _common_forms([p if k % 2 == d else None for k, p in enumerate(profiles)]) for d in (0, 1)
        )
        return [(across, down)[k % 2][k] for k in range(len(profiles))]
    return _common_forms(profiles)


def _common_forms(profiles: Sequence[EdgeProfiles | None]) -> list[StepForm | None]:
    measured = sorted(
        (p.form for p in profiles if p is not None and p.good.sum() > 20), key=lambda f: f.width
    )
    if not measured:
        return [None] * len(profiles)
    if _uneven([form.width for form in measured], profiles):
        return [None if p is None else p.form for p in profiles]
    width = measured[(len(measured) - 1) // 2].width
    weight = sum(form.weight for form in measured)
    lobes = sum(form.weight * form.lobes for form in measured) / max(weight, 1e-12)
    return [None if p is None else StepForm(width, lobes, p.form.half, weight, p.form.tone) for p in profiles]


def sharp_steps(profiles: Sequence[EdgeProfiles | None]) -> list[SharpSteps]:
    """Widths of sharp steps for each edge: common to all, unless their sharpness differs."""
    own = _of_edges([p.blur[0][p.good] if p is not None else np.zeros(0) for p in profiles])
    sharp = [_sharp_steps(widths) for widths in own]
    seen = [each for each, widths in zip(sharp, own, strict=True) if len(widths)]
    if not seen:
        return sharp
    # A line beside one of the edges scatters the widths of that edge only.
    second = min(1, len(seen) - 1)
    texture = sorted(each.texture for each in seen)[second]
    if _anisotropic(profiles):
        scatter = sorted(each.scatter for each in seen)[second]
        log = [_sharp_steps(np.concatenate(own[k::2])).log_width for k in (0, 1)]
        return [SharpSteps(log[k % 2], scatter, texture) for k in range(len(profiles))]
    if _uneven(sorted(each.width for each in seen), profiles):
        return [each._replace(texture=texture) for each in sharp]
    scatter = sorted(each.scatter for each in seen)[second]
    return [SharpSteps(_sharp_steps(np.concatenate(own)).log_width, scatter, texture)] * len(profiles)


def _of_edges(widths: list[Array]) -> list[Array]:
    """Logarithmic widths without those of steps that are far sharper than the other edges.

    Along a part of an edge these are lines of the picture, which would make the edge itself appear sharp.
    """
    sharp = [_sharp_steps(each).log_width if len(each) else np.inf for each in widths]
    kept = []
    for k, each in enumerate(widths):
        slower = each > min((s for j, s in enumerate(sharp) if j != k), default=-np.inf) - _TOO_SHARP
        kept.append(each[slower] if np.isfinite(sharp[k]) and slower.mean() > 0.5 else each)
    return kept


def displaced_by_lines(found: EdgeProfiles, sharp: SharpSteps) -> tuple[Array, float]:
    """Possible displacement of steps by lines beside the edge, pixels (n,); share of affected profiles.

    A second step with a share r of the contrast, at a distance s behind the first, appears as one step that
    is displaced by r·s and has the variance w² + r(1 − r)·s². A step that is too sharp is itself a line.
    """
    sure = _unlike(found, sharp, 2.0)
    part = float(np.mean(sure[found.good] > 0)) if found.good.any() else 0.0
    if part > FEW_DISPLACED:
        # There is such a line; use a lower level of significance for the other profiles.
        sure = _unlike(found, sharp, 1.0)
    moved = np.minimum(np.sqrt(_RATIO * np.expm1(2 * np.maximum(sure, 0.0))), _LARGEST_DISPLACEMENT)
    if part > FEW_DISPLACED:
        moved = moved * np.sqrt(NEIGHBOURS)  # neighbours are displaced alike
    return np.asarray(sharp.width * moved), part


def _unlike(found: EdgeProfiles, sharp: SharpSteps, sigmas: float) -> Array:
    """Significant differences from the width of a sharp step, logarithm (n,): of profiles or groups."""
    other, variance = found.blur[0] - sharp.log_width, found.blur[1] + sharp.texture**2
    size = min(_NEIGHBOURHOODS * NEIGHBOURS, len(other))
    mean, own = (scipy.ndimage.uniform_filter1d(values, size, mode="nearest") for values in (other, variance))
    alone = np.abs(other) - sigmas * np.sqrt(variance)
    together = mean - sigmas * np.sqrt(own / _INDEPENDENT)
    return np.asarray(np.minimum(np.maximum(alone, together) - sharp.scatter, 1.0))


def _sharp_steps(widths: Array) -> SharpSteps:
    if not len(widths):
        return SharpSteps(0.0, _EVEN, 0.0)
    low, high = np.quantile(widths, _QUANTILES)
    # Picture content changes widths at random; a line along the edge widens neighbours alike.
    apart = np.abs(np.diff(widths[::NEIGHBOURS]))
    texture = 1.4826 * float(np.median(apart)) / np.sqrt(2) if len(apart) > 3 else 0.0
    return SharpSteps(float(high), max(float(high - low), _EVEN), texture)


def _uneven(widths: Sequence[float], profiles: Sequence[EdgeProfiles | None]) -> bool:
    """Whether sorted widths differ by more than a picture structure at one of the edges can cause."""
    if len(widths) > 3 and np.log(widths[1] / widths[0]) > _SCRATCHED:
        widths = widths[1:]  # a lens cannot be that sharp at a single edge
    return bool(len(widths) > 2 and np.log(widths[2] / widths[0]) > _UNEVEN) and _smooth(profiles)


def _anisotropic(profiles: Sequence[EdgeProfiles | None]) -> bool:
    """Whether the scan is sharper in one direction: opposite edges are alike, and unlike the others.

    Lens and carriage spread a step differently. A line beside an edge widens this one only, and unevenly.
    """
    if any(p is None or p.good.sum() <= 20 for p in profiles):
        return False
    sharp = [_sharp_steps(p.blur[0][p.good]) for p in profiles if p is not None]
    log = np.array([each.log_width for each in sharp])
    apart = abs(log[0] + log[2] - log[1] - log[3]) / 2
    alike = max(abs(log[0] - log[2]), abs(log[1] - log[3])) < _ALIKE * apart
    return bool(alike and apart < _OTHERWISE and max(each.scatter for each in sharp) < _STEADY)


def _smooth(profiles: Sequence[EdgeProfiles | None]) -> bool:
    """Whether widths at the ends of edges are those of a scan whose sharpness changes smoothly.

    Then two edges are alike where they meet, apart from a difference of the two directions, which scanners
    have. Lines beside two of the edges widen these all along.
    """
    rows, widths = [], []
    for k, found in enumerate(profiles):
        for end in (-1.0, 1.0):
            if found is not None and (near := found.good & (found.place * end > _END)).sum() >= NEIGHBOURS:
                x, y = ((end, -1.0), (1.0, end), (-end, 1.0), (-1.0, -end))[k]
                rows.append((1.0, x, y, float(k % 2)))
                widths.append(np.log(np.hypot(np.exp(np.median(found.blur[0][near])), _PIXEL)))
    if len(rows) < 6:
        return True
    design, observed = np.array(rows), np.array(widths)
    change = np.linalg.lstsq(design, observed, rcond=None)[0]
    rms = np.sqrt(((observed - design @ change) ** 2).sum() / (len(rows) - len(change)))
    return bool(rms < _SMOOTH and abs(change[3]) < _ANISOTROPIC)


_SECTIONS = 20
"""Number of sections of an edge."""
_REACH, _BIN = 7.0, 0.6
"""Range of pixels on both sides, and size of the bins, in widths of the blurred step."""
_MODEL = 0.012
"""Accuracy of the model relative to the contrast of a section."""
_OUT, _BEHIND, _SLOPES = -0.5, 2.5, (0.0, -2.0, 2.0)
"""Approximate values in widths: distance of the edge from the fitted line, of the line behind it from the
edge, and change of the latter from the centre to an end."""
_MOST_MISFIT, _LEAST_GAIN, _CLEAR_GAIN = 1.0, 3.0, 20.0
"""Largest χ² over redundancy with two lines; minimum ratio of χ² with one line to that with two; and the same
if nothing else can be there."""
_CROSSED, _FEW_CROSSED = 9.0, 0.15
"""Misfit of a section, relative to the others, that another structure crosses; and largest share of such."""
_TOGETHER = 1.7
"""Factor on the standard deviation of the edge, because errors of bins are correlated by grain."""
_LINED = 0.25
"""Least share of the sections that show the line."""
_BOW = 0.3
"""Standard deviation of the bow of the edge, in widths."""
_FARTHEST, _WELL = (2.0, 3.2), 0.6
"""Largest displacement of the edge's steps by a line, in widths, for a moderate and for a good fit of two
lines; and the χ² over redundancy that separates these."""
_SHARED = 7
"""Number of parameters common to all sections: p0, p1, p2, q0, q1, q2, h."""


class AdjacentEdge(NamedTuple):
    """Offsets (2,) of the edge at the positions −1 and 1, inwards, their covariance (2, 2), and its bow."""

    ends: Array
    covariance: Array
    bow: float


def edge_beside_line(
    grey: Array, band: Band, line: Array, level: Array, noise: float, width: float
) -> tuple[AdjacentEdge | None, bool]:
    """Adjust an edge together with a line beside it; test against a model without the line.

    Parameters
    ----------
    grey : ndarray (n, s)
        Pixels of the profiles, film darker than the picture.
    band : Band
        Distances of the pixels.
    line : ndarray (n,)
        Offset of the line fitted before, at each profile.
    level : ndarray (n,)
        Tone of the film beside each profile.
    noise, width : float
        Noise of a pixel; width of the blurred step, one sigma, pixels.

    Returns
    -------
    (Companion or None, bool)
        The edge, if two lines describe it; and whether a line may run so close to the edge all along that the
        two cannot be separated: then straight steps describe all sections, which other structures would not.
    """
    two = _two_lines(grey, band, line, level, noise, width)
    if two is None:
        return None, True
    x, place = two.x, two.place
    first, second = x[_SHARED + 1 :: 4] / two.top, x[_SHARED + 2 :: 4] / two.top
    behind = x[3] + x[4] * place + x[5] * place**2 - x[0] - x[1] * place - x[2] * (place**2 - 1)
    # Where there is no second step and most of the contrast is in the first, the edge is seen by itself.
    lined, alone = second > 0.1, (second <= 0.1) & (first > 0.5)
    there = (first > 0.02).mean() > 0.7 and lined.mean() > _LINED and (lined | alone).mean() > 0.5
    there &= (behind > -0.3 * width).mean() > 0.9
    farthest = _FARTHEST[int(two.chi < _WELL)] * width
    there &= np.abs(x[0] + x[1] * place + x[2] * (place**2 - 1)).max() < farthest
    # A structure behind the edge at constant distance may be glare of the scanner, which is less distinct.
    there &= np.ptp(behind) > width or (two.chi < _WELL and two.without > _CLEAR_GAIN * two.chi)
    if two.chi > _MOST_MISFIT or two.without < _LEAST_GAIN * two.chi or not there:
        return None, min(two.without, two.chi) < _MOST_MISFIT
    return two.adjacent_edge(band, line), True


def ends_with_line(
    grey: Array, band: Band, line: Array, level: Array, noise: float, width: float
) -> AdjacentEdge | None:
    """The edge with a line behind it, without a test of the model; arguments as in :func:`edge_beside_line`.

    Its covariance assumes that the model is correct.
    """
    two = _two_lines(grey, band, line, level, noise, width)
    return None if two is None else two.adjacent_edge(band, line)


def is_one_step(grey: Array, band: Band, line: Array, level: Array, noise: float, width: float) -> bool:
    """Whether one straight step describes all sections of an edge; arguments as in :func:`edge_beside_line`.

    Then widened steps do not show where the edge is visible by itself: a line may run beside all of it. Not
    so if too few pixels are visible.
    """
    two = _two_lines(grey, band, line, level, noise, width)
    return two is not None and two.without < _MOST_MISFIT


class _TwoLines(NamedTuple):
    """Adjusted edge and line: parameters (u,), cofactors (u, u), positions and contrasts of sections (s,).

    Also χ² over the redundancy, with the line and without.
    """

    x: Array
    cofactor: Array
    place: Array
    top: Array
    chi: float
    without: float

    def adjacent_edge(self, band: Band, line: Array) -> AdjacentEdge:
        """Its edge."""
        ends = np.array([[1.0, -1.0], [1.0, 1.0]])
        covariance = ends @ self.cofactor[:2, :2] @ ends.T * _TOGETHER**2
        fitted = np.interp([-1.0, 1.0], band.place, line)
        return AdjacentEdge(fitted + ends @ self.x[:2], covariance, float(self.x[2]))


def _two_lines(
    grey: Array, band: Band, line: Array, level: Array, noise: float, width: float
) -> _TwoLines | None:
    sections = _sections(grey - level[:, None], band, line, noise, width)
    if sections is None:
        return None
    place, at, value, weight, top = sections
    model = _Model(place, at, width)
    starts = np.array([model.start(slope, top) for slope in _SLOPES])
    shared = np.array([4.0, 4.0, _BOW, 4.0, 4.0, 4.0, 4.0]) * width
    spread = np.concatenate([shared, _of_steps(0.03 * top, 2 * top, 2 * top, 2 * top)])
    alone = model.start(0.0, top)
    alone[0], alone[_SHARED:] = 0.0, _of_steps(0 * top, top, 0 * top, 0 * top)
    held = np.concatenate([shared[:3], [1e-6] * 4, _of_steps(0.03 * top, 2 * top, 1e-3 * top, 2 * top)])
    for _ in range(2):
        both = model.fitted(value, weight, starts, spread)
        one = model.fitted(value, weight, alone[None], held)
        misfit = np.minimum(both.misfit, one.misfit)
        crossed = misfit > _CROSSED * np.median(misfit)
        if not 0 < crossed.mean() <= _FEW_CROSSED:
            break
        weight = np.where(crossed[:, None], 0.0, weight)
    return _TwoLines(both.x, both.cofactor, place, top, both.chi, one.chi)


def _sections(
    rest: Array, band: Band, line: Array, noise: float, width: float
) -> tuple[Array, Array, Array, Array, Array] | None:
    """Position of each section; distances, tones and weights of its bins; contrast (s,)."""
    distance = band.distance - line[:, None]
    low, count = -_REACH * width, int(2 * _REACH / _BIN)
    step = _BIN * width
    tones = binned(rest, distance, low, step, count)
    at = binned(np.where(np.isfinite(rest), distance, np.nan), distance, low, step, count)
    groups = np.array_split(np.arange(len(rest)), _SECTIONS)
    value, where, known = (np.zeros((len(groups), count)) for _ in range(3))
    for i, group in enumerate(groups):
        seen = np.isfinite(tones[group])
        known[i] = seen.sum(axis=0)
        full = known[i] > 3
        value[i, full] = np.nanmedian(tones[group][:, full], axis=0)
        where[i, full] = np.nanmedian(at[group][:, full], axis=0)
    if (known > 3).mean() < 0.35:
        return None
    # Where the picture is as dark as film, the noise is the scale of its steps.
    top = np.maximum(value.max(axis=1), noise)
    pixels = np.maximum(known * band.columns * step, 1.0)
    variance = (1.25 * noise) ** 2 / pixels + (_MODEL * top[:, None]) ** 2
    place = np.array([band.place[group].mean() for group in groups])
    return place, where, value, np.where(known > 3, 1 / variance, 0.0), top


def _of_steps(film: Array, first: Array, second: Array, change: Array) -> Array:
    """Parameters of the sections in the order of the model."""
    return np.stack([film, first, second, change], axis=1).ravel()


class _Fitted(NamedTuple):
    """Parameters (u,), cofactors (u, u), χ² over the redundancy, and χ² per bin of the sections (s,)."""

    x: Array
    cofactor: Array
    chi: float
    misfit: Array


class _Model:
    """Computed tones of all sections and their derivatives, for :func:`adjust_batch`."""

    def __init__(self, place: Array, at: Array, width: float) -> None:
        self.place, self.at, self.width = place, at, width

    def start(self, slope: float, top: Array) -> Array:
        """Approximate parameters, with the line departing from the edge by `slope` widths."""
        shared = np.array([_OUT, 0.0, 0.0, _OUT + _BEHIND, slope, 0.0, 3.0]) * self.width
        return np.concatenate([shared, _of_steps(0 * top, 0.2 * top, 0.8 * top, -0.3 * top)])

    def fitted(self, value: Array, weight: Array, starts: Array, spread: Array) -> _Fitted:
        """The best fit from several starts."""
        count = len(starts)
        fit = adjust_batch(
            self,
            starts,
            np.broadcast_to(value.ravel(), (count, value.size)),
            weights=np.broadcast_to(weight.ravel(), (count, value.size)),
            prior=(starts, spread),
            options=BatchOptions(max_iterations=40, share=0.01),
        )
        left = value.ravel() - self(fit.estimates, np.arange(count))[0]
        squares = (weight.ravel() * left**2).reshape(count, *weight.shape).sum(axis=2)
        total = np.where(np.isfinite(squares).all(axis=1), squares.sum(axis=1), np.inf)
        best = int(np.argmin(total))
        redundancy = max(int((weight > 0).sum()) - starts.shape[1], 1)
        misfit = squares[best] / np.maximum((weight > 0).sum(axis=1), 1)
        return _Fitted(fit.estimates[best], fit.cofactor[best], float(total[best]) / redundancy, misfit)

    def __call__(self, x: Array, rows: Rows) -> tuple[Array, Array]:
        m, (s, n), w, t = len(x), self.at.shape, self.width, self.place
        p = x[:, 0, None] + x[:, 1, None] * t + x[:, 2, None] * (t**2 - 1)
        q = x[:, 3, None] + x[:, 4, None] * t + x[:, 5, None] * t**2
        each = x[:, _SHARED:].reshape(m, s, 4)
        steps = np.stack([p, q, q + x[:, 6, None]], axis=2)
        u = (self.at[None, :, :, None] - steps[:, :, None, :]) / w
        phi = scipy.special.ndtr(u)
        bell = each[:, :, None, 1:] * np.exp(-0.5 * u * u) / (np.sqrt(2 * np.pi) * -w)
        value = each[:, :, :1] + (each[:, :, None, 1:] * phi).sum(axis=3)
        jacobian = np.zeros((m, s, n, x.shape[1]))
        behind = bell[..., 1] + bell[..., 2]
        tt = t[None, :, None]
        for k, column in enumerate(
            (
                bell[..., 0],
                bell[..., 0] * tt,
                bell[..., 0] * (tt**2 - 1),
                behind,
                behind * tt,
                behind * tt**2,
                bell[..., 2],
            )
        ):
            jacobian[..., k] = column
        for i in range(s):
            own = _SHARED + 4 * i
            jacobian[:, i, :, own] = 1.0
            jacobian[:, i, :, own + 1 : own + 4] = phi[:, i]
        return value.reshape(m, -1), jacobian.reshape(m, s * n, -1)
