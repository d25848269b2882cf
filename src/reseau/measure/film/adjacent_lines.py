"""How sharp the steps of a frame's edges are, and by how much what lies beside an edge may have drawn them.

A line of the picture close behind an edge (Cruz et al., fig. 7B) cannot be told from it by a profile alone.
But it widens the step that is seen, and neighbours alike; a picture's forms do so at random, here and there.

An edge and a line of the picture close behind it, fitted together (Cruz et al., fig. 7B).

Where a bright line of the picture runs within some pixels of an edge, the larger step from the dark ground
to the line draws the smaller one from film to ground towards it; a profile alone does not tell the two apart.
What does is that both are smooth all along the edge. Sections of it, i = 1 … s, at the places t_i from −1 to
1, are averaged and fitted as one,

.. math::
    g_i(d) = b_i + A_i\\,\\Phi\\Bigl(\\frac{d - p(t_i)}{w}\\Bigr)
             + B_i\\,\\Phi\\Bigl(\\frac{d - q(t_i)}{w}\\Bigr)
             + C_i\\,\\Phi\\Bigl(\\frac{d - q(t_i) - h}{w}\\Bigr), \\qquad
    p = p_0 + p_1 t + p_2 (t^2 - 1), \\quad q = q_0 + q_1 t + q_2 t^2,

with the known width w of a blurred step: where the line leaves the edge, the edge is seen by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.special import ndtr

from ...adjust import BatchOptions, adjust_batch
from ...core.data import Array, Rows
from .border import Band, binned
from .edges import NEIGHBOURS, EdgeProfiles

__all__ = [
    "FEW_DRAWN",
    "Companion",
    "Sharp",
    "common_widths",
    "drawn_by_lines",
    "edge_beside_line",
    "ends_with_line",
    "sharp_steps",
]

_QUANTILES, _EVEN = (0.1, 0.3), 0.015
"""Of the widths of profiles: the greater is that of a sharp step, their difference tells how they differ from
place to place, logarithm, at least so much."""
_UNEVEN, _SCRATCHED = 0.2, 0.5
"""Logarithms by which widths of three edges differ if the scan is sharper at one side than at another, and
that of the sharpest from the next if it is no edge's."""
_TOO_SHARP = 0.3
"""Logarithm by which steps are too sharp for those of an edge."""
_FARTHEST_DRAWN = 1.5
"""Widths by which a line may draw a step at most; one that is farther away is seen by itself."""
_RATIO, FEW_DRAWN = 4.0, 0.22
"""Of the second step to the first, where a line of the picture draws an edge; and part of its profiles that
show it by chance."""
_NEIGHBOURHOODS, _INDEPENDENT = 5, 2.5
"""Neighbourhoods of profiles that a line widens alike; as how many their mean tells in a picture's forms."""


class Sharp(NamedTuple):
    """Sharp steps of an edge.

    Parameters
    ----------
    log_width : float
        Logarithm of their width.
    scatter, texture : float
        By how much it differs from place to place at least; and at random, by the picture's forms.
    """

    log_width: float
    scatter: float
    texture: float

    @property
    def width(self) -> float:
        """One sigma, pixels."""
        return float(np.exp(self.log_width))

    def beyond(self, found: EdgeProfiles) -> bool:
        """Whether most steps are sharper than those of an edge can be: a scratch's."""
        return bool(np.median(found.blur[0][found.good]) < self.log_width - _TOO_SHARP)


def common_widths(profiles: Sequence[EdgeProfiles | None]) -> list[float | None]:
    """Width of the blurred step for each edge: one for all, unless they are focused differently."""
    told = sorted(p.width for p in profiles if p is not None and p.good.sum() > 20)
    if not told:
        return [None] * len(profiles)
    if _uneven(told):
        return [None if p is None else p.width for p in profiles]
    return [told[(len(told) - 1) // 2]] * len(profiles)


def sharp_steps(profiles: Sequence[EdgeProfiles | None]) -> list[Sharp]:
    """Sharp steps of each edge: of all together, unless they are focused differently."""
    own = [p.blur[0][p.good] if p is not None else np.zeros(0) for p in profiles]
    sharp = [_sharp(widths) for widths in own]
    seen = [each for each, widths in zip(sharp, own, strict=True) if len(widths)]
    if not seen:
        return sharp
    # A line beside one of the edges scatters its widths, not those of the others.
    second = min(1, len(seen) - 1)
    texture = sorted(each.texture for each in seen)[second]
    if _uneven(sorted(each.width for each in seen)):
        return [each._replace(texture=texture) for each in sharp]
    scatter = sorted(each.scatter for each in seen)[second]
    return [Sharp(_sharp(np.concatenate(own)).log_width, scatter, texture)] * len(profiles)


def drawn_by_lines(found: EdgeProfiles, sharp: Sharp) -> tuple[Array, float]:
    """By how much lines of the picture beside an edge may draw its steps to them, pixels (n,); how many do.

    A second step of a part r of the contrast, s behind the first, is seen as one that is moved by r·s and has
    the variance w² + r(1 − r)·s². One that is too sharp is a line by itself.
    """
    sure = _unlike(found, sharp, 2.0)
    part = float(np.mean(sure[found.good] > 0)) if found.good.any() else 0.0
    if part > FEW_DRAWN:
        # There is such a line: what is no proof is a sign now.
        sure = _unlike(found, sharp, 1.0)
    moved = np.minimum(np.sqrt(_RATIO * np.expm1(2 * np.maximum(sure, 0.0))), _FARTHEST_DRAWN)
    if part > FEW_DRAWN:
        moved = moved * np.sqrt(NEIGHBOURS)  # which are drawn alike
    return np.asarray(sharp.width * moved), part


def _unlike(found: EdgeProfiles, sharp: Sharp, sigmas: float) -> Array:
    """By how much widths surely differ from a sharp step's, logarithm (n,): alone, or with those around."""
    other, variance = found.blur[0] - sharp.log_width, found.blur[1] + sharp.texture**2
    size = min(_NEIGHBOURHOODS * NEIGHBOURS, len(other))
    mean, own = (uniform_filter1d(values, size, mode="nearest") for values in (other, variance))
    alone = np.abs(other) - sigmas * np.sqrt(variance)
    together = mean - sigmas * np.sqrt(own / _INDEPENDENT)
    return np.asarray(np.minimum(np.maximum(alone, together) - sharp.scatter, 1.0))


def _sharp(widths: Array) -> Sharp:
    if not len(widths):
        return Sharp(0.0, _EVEN, 0.0)
    low, high = np.quantile(widths, _QUANTILES)
    # A picture's forms move the steps, too, where it shows; a line along the edge widens neighbours alike.
    apart = np.abs(np.diff(widths[::NEIGHBOURS]))
    texture = 1.4826 * float(np.median(apart)) / np.sqrt(2) if len(apart) > 3 else 0.0
    return Sharp(float(high), max(float(high - low), _EVEN), texture)


def _uneven(widths: Sequence[float]) -> bool:
    """Whether sorted widths differ by more than what a picture beside one of the edges does to it."""
    if len(widths) > 3 and np.log(widths[1] / widths[0]) > _SCRATCHED:
        widths = widths[1:]  # no lens is that sharp at one edge alone
    return bool(len(widths) > 2 and np.log(widths[2] / widths[0]) > _UNEVEN)


_SECTIONS = 20
"""Sections of an edge."""
_REACH, _BIN = 7.0, 0.6
"""How far to both sides pixels are used, and in what steps they are averaged, widths of the blurred step."""
_MODEL = 0.012
"""Part of a section's contrast to which the model describes it."""
_OUT, _BEHIND, _SLOPES = -0.5, 2.5, (0.0, -2.0, 2.0)
"""Approximate values, widths: of the edge from the line that was fitted, of the line behind it from the edge,
and by how much that leaves it from the middle to an end."""
_MOST_MISFIT, _LEAST_GAIN, _CLEAR_GAIN = 1.0, 3.0, 20.0
"""χ² over the redundancy with which two lines describe an edge, and how often as large it is with one: at
least, and where nothing else can be there."""
_TOGETHER = 1.7
"""By how much more the edge varies than from bins whose errors were independent: grain is wider."""
_BOW = 0.3
"""Widths by which the edge itself may be bowed, one sigma."""
_FARTHEST, _WELL = (2.0, 3.2), 0.6
"""Widths by which a line draws the edge's steps at most, where two lines describe it less well and well; and
the χ² over the redundancy that parts these."""
_SHARED = 7
"""Parameters of all sections: p0, p1, p2, q0, q1, q2, h."""


class Companion(NamedTuple):
    """Offsets (2,) of the edge at the places −1 and 1, inwards, with their covariance (2, 2), and its bow."""

    ends: Array
    covariance: Array
    bow: float


def edge_beside_line(
    grey: Array, band: Band, line: Array, level: Array, noise: float, width: float
) -> tuple[Companion | None, bool]:
    """The edge where a line of the picture runs beside it, if two lines describe it; if one does as well.

    Parameters
    ----------
    grey : ndarray (n, s)
        Pixels of the profiles, film darker than the picture.
    band : Band
        Where they are.
    line : ndarray (n,)
        Offset of the line that was fitted, at each profile.
    level : ndarray (n,)
        Tone of film beside each profile.
    noise, width : float
        Of a pixel; of the blurred step, one sigma, pixels.

    Returns
    -------
    (Companion or None, bool)
        The second tells whether a line could run so close to the edge all along that nothing parts the two:
        all sections are described by straight steps. With other things beside the edge they are not.
    """
    two = _two_lines(grey, band, line, level, noise, width)
    if two is None:
        return None, True
    x, place = two.x, two.place
    first, second = x[_SHARED + 1 :: 4] / two.top, x[_SHARED + 2 :: 4] / two.top
    behind = x[3] + x[4] * place + x[5] * place**2 - x[0] - x[1] * place - x[2] * (place**2 - 1)
    there = (first > 0.02).mean() > 0.7 and (second > 0.1).mean() > 0.5
    there &= (behind > -0.3 * width).mean() > 0.9
    farthest = _FARTHEST[int(two.chi < _WELL)] * width
    there &= np.abs(x[0] + x[1] * place + x[2] * (place**2 - 1)).max() < farthest
    # What lies behind the edge at one distance all along may be the scanner's own glare, which is less clear.
    there &= np.ptp(behind) > width or (two.chi < _WELL and two.without > _CLEAR_GAIN * two.chi)
    if two.chi > _MOST_MISFIT or two.without < _LEAST_GAIN * two.chi or not there:
        return None, min(two.without, two.chi) < _MOST_MISFIT
    return two.companion(band, line), True


def ends_with_line(
    grey: Array, band: Band, line: Array, level: Array, noise: float, width: float
) -> Companion | None:
    """The edge with a line behind it, whether or not that describes it; as :func:`edge_beside_line`.

    Its covariance is what the pixels tell of the edge if that is what is there.
    """
    two = _two_lines(grey, band, line, level, noise, width)
    return None if two is None else two.companion(band, line)


class _TwoLines(NamedTuple):
    """An edge and a line fitted: parameters (u,), cofactors (u, u), places and contrasts of sections (s,).

    Besides χ² over the redundancy with the line, and without.
    """

    x: Array
    cofactor: Array
    place: Array
    top: Array
    chi: float
    without: float

    def companion(self, band: Band, line: Array) -> Companion:
        """The edge of it."""
        ends = np.array([[1.0, -1.0], [1.0, 1.0]])
        covariance = ends @ self.cofactor[:2, :2] @ ends.T * _TOGETHER**2
        fitted = np.interp([-1.0, 1.0], band.place, line)
        return Companion(fitted + ends @ self.x[:2], covariance, float(self.x[2]))


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
    estimates, cofactor, chi = model.fitted(value, weight, starts, spread)
    best = int(np.argmin(chi))
    alone = model.start(0.0, top)
    alone[0], alone[_SHARED:] = 0.0, _of_steps(0 * top, top, 0 * top, 0 * top)
    held = np.concatenate([shared[:3], [1e-6] * 4, _of_steps(0.03 * top, 2 * top, 1e-6 * top, 2 * top)])
    without = float(model.fitted(value, weight, alone[None], held)[2][0])
    return _TwoLines(estimates[best], cofactor[best], place, top, float(chi[best]), without)


def _sections(
    rest: Array, band: Band, line: Array, noise: float, width: float
) -> tuple[Array, Array, Array, Array, Array] | None:
    """Of each section its place, and of its bins: distances, tones, weights; and the contrast (s,)."""
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
    top = np.maximum(value.max(axis=1), 1e-6)
    pixels = np.maximum(known * band.columns * step, 1.0)
    variance = (1.25 * noise) ** 2 / pixels + (_MODEL * top[:, None]) ** 2
    place = np.array([band.place[group].mean() for group in groups])
    return place, where, value, np.where(known > 3, 1 / variance, 0.0), top


def _of_steps(film: Array, first: Array, second: Array, change: Array) -> Array:
    """Parameters of the sections in their order."""
    return np.stack([film, first, second, change], axis=1).ravel()


class _Model:
    """Computed tones of all sections and their derivatives, for :func:`adjust_batch`."""

    def __init__(self, place: Array, at: Array, width: float) -> None:
        self.place, self.at, self.width = place, at, width

    def start(self, slope: float, top: Array) -> Array:
        """Approximate parameters, with the line behind the edge leaving it by so many widths."""
        shared = np.array([_OUT, 0.0, 0.0, _OUT + _BEHIND, slope, 0.0, 3.0]) * self.width
        return np.concatenate([shared, _of_steps(0 * top, 0.2 * top, 0.8 * top, -0.3 * top)])

    def fitted(self, value: Array, weight: Array, starts: Array, spread: Array) -> tuple[Array, Array, Array]:
        """Estimates from several starts, their cofactors, and χ² over the redundancy."""
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
        redundancy = max(int((weight > 0).sum()) - starts.shape[1], 1)
        chi = (weight.ravel() * left**2).sum(axis=1) / redundancy
        return fit.estimates, fit.cofactor, np.where(np.isfinite(chi), chi, np.inf)

    def __call__(self, x: Array, rows: Rows) -> tuple[Array, Array]:
        m, (s, n), w, t = len(x), self.at.shape, self.width, self.place
        p = x[:, 0, None] + x[:, 1, None] * t + x[:, 2, None] * (t**2 - 1)
        q = x[:, 3, None] + x[:, 4, None] * t + x[:, 5, None] * t**2
        each = x[:, _SHARED:].reshape(m, s, 4)
        steps = np.stack([p, q, q + x[:, 6, None]], axis=2)
        u = (self.at[None, :, :, None] - steps[:, :, None, :]) / w
        phi = ndtr(u)
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
