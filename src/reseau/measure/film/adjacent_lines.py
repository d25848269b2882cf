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

from ...adjust import adjust_batch
from ...adjust.batch import BatchOptions
from ...core.data import Array, Rows
from .border import Band, binned
from .edges import NEIGHBOURS, EdgeProfiles
from .steps import StepForm

_QUANTILE, _EVEN = 0.3, 0.015
"""Quantile of the widths of profiles that is the width of an edge's steps, because content of the picture
widens some of them; and least standard deviation of its logarithm."""
_MODELLED = 0.3
"""Error of an edge's width by the model of the step, in standard deviations of that of a profile: where
pixels hardly show the width, small errors of their model have a large part in it."""
_SOFTNESS, _DIRECTIONS = 0.03, 0.04
"""Scatter of logarithmic widths from edge to edge, by focus and penumbra, and half the difference of the two
directions of a scan, by lens and carriage; both with the heavy tails of Student's distribution."""
_LINES, _CONTOURS, _HIDDEN = 2.0, 20.0, 3.0
"""Number of lines of a picture that run in the direction of an edge from end to end, number of contours that
a line across the picture meets, and widths of the step within which they are hidden in it."""
_LEVEL = float(np.deg2rad(1.0))
"""Scatter of the directions of these lines about that of the edge: cameras are held so well, radians."""
_SHARPENED = 0.01
"""Prior probability that what was measured is sharper than an edge can be (a scratch)."""
_RANGE = 1.5
"""Range of logarithmic widths of lines that are sharper than edges."""
_PERSISTENT = 0.9
"""Share of the neighbourhoods of profiles beside which a second step goes on to the next."""
_LEAST_SQUARE = 0.6
"""Least variance of a step with a second one, relative to that of the step alone."""
_LEAST = 20
"""Least number of profiles that show the softness of an edge."""


def _second_steps(*, alone: bool) -> tuple[Array, Array, Array]:
    """Second steps as they may be: increase of the logarithmic width, displacement (widths), and weight.

    A second step with a share r of the contrast, at the distance s behind the first, appears as one step that
    is displaced by r·s and has the variance w² + r(1 − r)·s²; a negative share, of a picture that is brighter
    at its edge than behind it, sharpens the step. Where the picture is as dark as film at its edge, the
    second step is seen `alone`, sharper if it is that of a narrow line. Shares are evenly distributed,
    distances in their logarithm.
    """
    shares = np.concatenate([np.linspace(-0.9, -0.05, 18), np.linspace(0.05, 0.9, 18)])
    share, distance = (each.ravel() for each in np.meshgrid(shares, _DISTANCES))
    square = 1 + share * (1 - share) * distance**2
    # What sharpens a step further is visible beside it.
    hidden = square > _LEAST_SQUARE
    increase, moved = 0.5 * np.log(square[hidden]), (share * distance)[hidden]
    if alone:
        narrow, distance = (each.ravel() for each in np.meshgrid([0.0, -0.1, -0.2, -0.3], _DISTANCES))
        increase, moved = np.append(increase, narrow), np.append(moved, distance)
    return increase, moved, np.full(len(moved), 1 / len(moved))


_DISTANCES = np.geomspace(0.15, 6.0, 30)
_ALL, _PARTS = _second_steps(alone=False), _second_steps(alone=True)
"""Those beside all of an edge, which a step of its own must show, and those beside parts of it."""


class Softness(NamedTuple):
    """Softness of an edge's steps, and whether it is its own.

    Parameters
    ----------
    log_width : float
        Logarithm of the width of a single step.
    scatter, texture : float
        Standard deviation of it, and of the width of a profile by content of the picture.
    lined, displaced : float
        Probability that a line beside all of the edge widens its steps, and rms displacement of the edge by
        it, pixels.
    sharpened : float
        Probability that the steps are sharper than those of an edge.
    before, beside : float
        Probabilities, without the widths, of a line beside all of the edge, and of a contour beside a place
        of it.
    """

    log_width: float
    scatter: float = _EVEN
    texture: float = 0.0
    lined: float = 0.0
    displaced: float = 0.0
    sharpened: float = 0.0
    before: float = 0.0
    beside: float = 0.0

    @property
    def width(self) -> float:
        """Width of a single step, one sigma, pixels."""
        return float(np.exp(self.log_width))


def student(value: Array, scale: Array | float) -> Array:
    """Density of Student's distribution with four degrees of freedom."""
    square = 1 + np.square(value / (2 * scale))
    return np.asarray(0.375 / (square * square * np.sqrt(square) * scale))


def softness_of(widths: Sequence[tuple[float, float] | None], side: float) -> list[Softness]:
    """Explain the widths of the steps of four edges together.

    Each edge is as soft as the scan in its direction, with a scatter of its own; or a line beside it widens
    its steps; or they are those of a scratch. The softness of the scan is what all edges explain best.

    Parameters
    ----------
    widths : sequence of (float, float) or None
        Logarithm of the width of each edge and its standard deviation; None if it was not measured.
    side : float
        Side of the frame, pixels: the wider a step, the more of the picture is hidden in it.
    """
    seen = [k for k, each in enumerate(widths) if each is not None]
    if not seen:
        return [Softness(0.0)] * len(widths)
    own, sigma = np.array([widths[k] for k in seen]).T
    scale = np.hypot(_SOFTNESS, sigma)
    common = np.linspace(own.min() - 0.4, own.max() + 0.4, 161)
    apart = np.linspace(-0.4, 0.4, 33) if len(seen) > 2 else np.zeros(1)
    sign = np.where(np.array(seen) % 2 == 0, -1.0, 1.0)
    away = own - common[:, None, None] - sign * apart[:, None]  # (common, apart, edge)
    hidden = 2 * _HIDDEN * np.exp(own) / side
    before = _LINES * hidden * np.minimum(hidden / _LEVEL, 1.0)
    before, beside = before / (1 + before), 1 - np.exp(-_CONTOURS * hidden / 2)
    alike = (1 - before) * (1 - _SHARPENED) * student(away, scale)
    increase, displaced, share = _ALL
    sums, flat = np.stack([share, share * displaced**2], axis=1), away.reshape(-1, len(seen))
    each = np.concatenate([  # in blocks that fit into the cache
        student(rows[..., None] - increase, scale[:, None]) @ sums
        for rows in np.array_split(flat, len(flat) // 16 + 1)
    ]).reshape(*away.shape, 2)  # fmt: skip
    lined = before * each[..., 0]
    sharp = (
        _SHARPENED / _RANGE * ((away < 0) & (away > -_RANGE)) * (1 - 2 * scale**2 / (away**2 + 2 * scale**2))
    )
    every = alike + lined + sharp
    total = np.log(every).sum(axis=2) + np.log(student(apart, _DIRECTIONS))
    weight = np.exp(total - total.max())
    weight /= weight.sum()
    moved = each[..., 1] / each[..., 0] * np.exp(2 * common)[:, None, None]
    found = [Softness(0.0)] * len(widths)
    for i, k in enumerate(seen):
        p, q = (float((weight * part[..., i] / every[..., i]).sum()) for part in (lined, sharp))
        scan = float((weight * (common[:, None] + sign[i] * apart)).sum())
        square = float((weight * lined[..., i] / every[..., i] * moved[..., i]).sum()) / max(p, 1e-12)
        log = scan if p + q > 0.5 else float(own[i])
        found[k] = Softness(
            log, float(sigma[i]), 0.0, p, float(np.sqrt(square)), q, float(before[i]), float(beside[i])
        )
    return found


def common_forms(profiles: Sequence[EdgeProfiles | None], side: float) -> list[StepForm | None]:
    """Form of the blurred step for each edge: width as the edges together explain it, common lobes."""
    kept = [p if p is not None and p.good.sum() > _LEAST else None for p in profiles]
    soft = softness_of([None if p is None else (float(np.log(p.width)), 2 * _EVEN) for p in kept], side)
    forms = [p.form for p in kept if p is not None]
    if not forms:
        return [None] * len(profiles)
    weight = sum(form.weight for form in forms)
    lobes = sum(form.weight * form.lobes for form in forms) / max(weight, 1e-12)
    middle = float(np.median([each.width for each, p in zip(soft, kept, strict=True) if p is not None]))
    return [
        None
        if p is None
        else StepForm(each.width if k is not None else middle, lobes, p.form.half, weight, p.form.tone)
        for p, k, each in zip(profiles, kept, soft, strict=True)
    ]


def soft_steps(profiles: Sequence[EdgeProfiles | None], side: float) -> list[Softness]:
    """Softness of the steps of each edge, from its profiles."""
    widths: list[tuple[float, float] | None] = []
    textures = []
    for found in profiles:
        if found is None or found.good.sum() <= _LEAST:
            widths.append(None)
            continue
        own, variance = found.blur[:, found.good]
        low, high = _quantiles(own, 1 / (variance + _EVEN**2), (0.1, _QUANTILE))
        shown = _MODELLED * float(np.sqrt(1 / (1 / (variance + _EVEN**2)).mean()))
        widths.append((high, float(np.sqrt(_EVEN**2 + (high - low) ** 2 / 4 + shown**2))))
        # Picture content changes widths at random; a line along the edge widens neighbours alike.
        change = np.abs(np.diff(own[::NEIGHBOURS]))
        textures.append(1.4826 * float(np.median(change)) / np.sqrt(2) if len(change) > 3 else 0.0)
    texture = sorted(textures)[min(1, len(textures) - 1)] if textures else 0.0
    return [each._replace(texture=texture) for each in softness_of(widths, side)]


def _quantiles(values: Array, weight: Array, shares: Sequence[float]) -> list[float]:
    """Weighted quantiles: a sharp step in the middle of a pixel hardly shows its width."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weight[order]) / weight.sum()
    at = np.minimum(np.searchsorted(below, shares), len(order) - 1)
    return [float(each) for each in values[order][at]]


def displaced_by_lines(found: EdgeProfiles, soft: Softness) -> tuple[Array, Array, Array]:
    """Displacements of steps by what is beside parts of the edge: a second step widens or sharpens them.

    Returns
    -------
    (ndarray (n,), ndarray (n,), ndarray (n,))
        Standard deviations of the displacements of profiles, pixels, probabilities of a second step, and mean
        displacements by it, inwards.
    """
    n, good = len(found.place), np.flatnonzero(found.good)
    groups = [g for g in np.array_split(good, max(1, n // NEIGHBOURS)) if len(g)]
    if not groups:
        return np.zeros(n), np.zeros(n), np.zeros(n)
    weight = 1 / (found.blur[1] + _EVEN**2)
    excess = np.array([np.average(found.blur[0][g], weights=weight[g]) for g in groups]) - soft.log_width
    # The texture was seen with the noise in it.
    noise = np.array([max(1 / weight[g].mean(), soft.texture**2) for g in groups])
    scale = np.sqrt(noise + soft.scatter**2)
    increase, displaced, share = _PARTS
    each = share * student(excess[:, None] - increase, scale[:, None])
    lined = _chain(np.stack([student(excess, scale), each.sum(axis=1)], axis=1), max(soft.beside, soft.lined))
    mean, square = (lined * (each @ displaced**k) / each.sum(axis=1) * soft.width**k for k in (1, 2))
    middle = np.array([found.place[g].mean() for g in groups])
    sigma, lined, mean = (
        np.interp(found.place, middle, part)
        for part in (np.sqrt(np.maximum(square - mean**2, 0.0)), lined, mean)
    )
    return sigma, lined, mean


def _chain(seen: Array, prior: float) -> Array:
    """Probability (n,) of a second step beside each part of an edge (Rabiner 1989).

    What is beside one part is beside the next one, too: a hidden Markov chain. `seen` are the likelihoods of
    the widths (n, 2) without a second step and with one.
    """
    share = np.array([1 - prior, prior])
    change = _PERSISTENT * np.eye(2) + (1 - _PERSISTENT) * share
    before, after = np.empty_like(seen), np.ones_like(seen)
    state = share
    for k, likelihood in enumerate(seen):
        before[k] = state * likelihood / (state * likelihood).sum()
        state = before[k] @ change
    for k in range(len(seen) - 2, -1, -1):
        after[k] = change @ (seen[k + 1] * after[k + 1])
        after[k] /= after[k].sum()
    return np.asarray((before * after)[:, 1] / (before * after).sum(axis=1))


_SECTIONS = 20
"""Number of sections of an edge."""
_REACH, _BIN = 7.0, 0.6
"""Range of pixels on both sides, and size of the bins, in widths of the blurred step."""
_MODEL = 0.012
"""Accuracy of the model relative to the contrast of a section."""
_OUT, _BEHIND, _SLOPES = (-0.5, -2.0), 2.5, (0.0, -2.0, 2.0)
"""Approximate values in widths: distance of the edge from the fitted line, of the line behind it from the
edge, and change of the latter from the centre to an end."""
_INDEPENDENT_BINS = 5
"""Number of bins of all sections whose errors are independent: those of the model are common to sections."""
_CROSSED, _FEW_CROSSED = 9.0, 0.15
"""Misfit of a section, relative to the others, that another structure crosses; and largest share of such."""
_TOGETHER = 1.7
"""Factor on the standard deviation of the edge, because errors of bins are correlated by grain."""
_BOW = 0.3
"""Standard deviation of the bow of the edge, in widths."""
_FARTHEST = 3.2
"""Largest displacement of the edge's steps by a line, in widths: of one further away both are visible."""
_SHARED = 7
"""Number of parameters common to all sections: p0, p1, p2, q0, q1, q2, h."""


class AdjacentEdge(NamedTuple):
    """Offsets (2,) of the edge at the positions −1 and 1, inwards, their covariance (2, 2), and its bow."""

    ends: Array
    covariance: Array
    bow: float


def edge_beside_line(
    grey: Array, band: Band, line: Array, level: Array, noise: float, width: float, own: float, bow: float
) -> tuple[AdjacentEdge | None, float]:
    """Adjust an edge together with a line beside it, and compare with one step of any softness.

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
    noise, width, own : float
        Noise of a pixel; width of the blurred step, one sigma, pixels, and the width that the edge shows.
    bow : float
        Bow of the line fitted before: it may be real, or that of the displacement by the line.

    Returns
    -------
    (AdjacentEdge or None, float)
        The edge, if two lines can describe it; and the logarithm of the likelihood of the line, over that of
        one step with the width that the edge shows.
    """
    two = _two_lines(grey, band, line, level, noise, width, bow)
    if two is None:
        return None, 0.0
    x, place = two.x, two.place
    behind = x[3] + x[4] * place + x[5] * place**2 - x[0] - x[1] * place - x[2] * (place**2 - 1)
    moved = np.abs(x[0] + x[1] * place + x[2] * (place**2 - 1)).max()
    # The line lies behind the edge, and not so far that both are seen.
    if (behind > -0.3 * width).mean() < 0.9 or moved > _FARTHEST * width:
        return None, 0.0
    one = _two_lines(grey, band, line, level, noise, own, bow, still=True)
    without = two.without if one is None else min(one.without, one.chi, two.without)
    gain = _INDEPENDENT_BINS / 2 * float(np.log(max(without, 1e-9) / max(two.chi, 1e-9)))
    return two.adjacent_edge(band, line), gain


def ends_with_line(
    grey: Array, band: Band, line: Array, level: Array, noise: float, width: float
) -> AdjacentEdge | None:
    """The edge with a line behind it, without a test of the model; arguments as in :func:`edge_beside_line`.

    Its covariance assumes that the model is correct.
    """
    two = _two_lines(grey, band, line, level, noise, width, 0.0)
    return None if two is None else two.adjacent_edge(band, line)


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
    grey: Array,
    band: Band,
    line: Array,
    level: Array,
    noise: float,
    width: float,
    bow: float,
    *,
    still: bool = False,
) -> _TwoLines | None:
    """The adjustment with and without a line behind the edge; `still` if the edge is at the fitted one."""
    sections = _sections(grey - level[:, None], band, line, noise, width)
    if sections is None:
        return None
    place, at, value, weight, top = sections
    model = _Model(place, at, width)
    starts = np.array([model.start(out, slope, top) for out in _OUT for slope in _SLOPES])
    shared = np.array([4.0, 4.0, np.hypot(_BOW, bow / width), 4.0, 4.0, 4.0, 4.0]) * width
    spread = np.concatenate([shared, _of_steps(0.03 * top, 2 * top, 2 * top, 2 * top)])
    step = model.start(0.0, 0.0, top)
    step[0], step[_SHARED:] = 0.0, _of_steps(0 * top, top, 0 * top, 0 * top)
    held = np.concatenate([shared[:3], [1e-6] * 4, _of_steps(0.03 * top, 2 * top, 1e-3 * top, 2 * top)])
    if still:
        starts = np.array([model.start(0.0, slope, top) for slope in _SLOPES])
        spread[:3] = held[:3] = 1e-3 * width
    for _ in range(2):
        one = model.fitted(value, weight, step[None], held)
        both = model.fitted(value, weight, starts, spread)
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

    def start(self, out: float, slope: float, top: Array) -> Array:
        """Approximate parameters, with the edge `out` widths inwards and the line departing by `slope`."""
        shared = np.array([out, 0.0, 0.0, out + _BEHIND, slope, 0.0, 3.0]) * self.width
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
