"""One edge of a frame at full resolution: location of the step from film to picture in profiles across it.

All four edges are treated alike (Cruz et al., sect. 2.2): positions are distances from an approximate line,
positive towards the picture. Nothing is rotated or resampled; pixels keep their exact distances. The model of
a profile is film, a step blurred by a Gaussian, and a picture whose tone may change once more close behind
it:

.. math:: g(d) = b + A\\,\\Phi(u) + c\\,\\Phi(u - 3), \\qquad u = (d - p)/w .
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from ...adjust import adjust_batch, weight_function
from ...adjust.batch import BatchAdjustment, BatchOptions
from ...core.data import Array, Mask, Rows
from .border import Band, Border, Film, binned, border_of, row_median
from .steps import SHIFTS, STRAIGHT, StepForm, Tone, profile_function

_CHANGE = 0.15
"""Standard deviation of a change of the picture's tone behind the edge, relative to the contrast."""
_INWARD, _OUTWARD, _LEAST_INWARD = 2.0, 4.0, 2.0
"""Extent of the profile behind the edge and beyond it, in widths of the step; the former at least in pixels:
behind a sharp step the tone of the picture is seen only by pixels that lie behind it entirely."""
NEIGHBOURS = 15
"""Number of neighbouring profiles used to estimate how well a step is determined."""
_BATCH = BatchOptions(max_iterations=7, share=0.05, reweight=weight_function("danish", 2.5))
_SECTIONS = BatchOptions(max_iterations=25, share=0.05, reweight=weight_function("danish", 2.5))
_FREE, _TIGHTENED = 0.5, (0.02, 0.12)
"""Standard deviation of the logarithm of the width: at first; then for a width from other edges, and for one
from this edge."""
_MODEL = 0.012, 0.05
"""Accuracy of the model relative to the contrast, for a known and for an unknown width; larger for the
latter, so that model errors are not treated as blunders."""
_ROUNDS, _LEAST_PIXELS = 2, 100
"""Rounds of estimating the common width, and minimum number of pixels of a section used for it."""
_FORMING, _HELD, _WIDTHS = 3, 0.005, (0.4, 6.0)
"""Iterations of the common form of sharp steps; standard deviation of a logarithm of a width that is held;
and the range of widths."""
_PHASE = 0.04
"""Standard deviation of the harmonics by which the logarithm of a width depends on the phase of pixels."""
_LOBES, _MOST_LOBES = 0.1, (-0.12, 0.2)
"""Prior standard deviation of the lobes of a step, and their range."""


@dataclass(frozen=True, eq=False)
class EdgeProfiles:
    """Profiles of an edge in one channel, in columns over the n profiles.

    Parameters
    ----------
    place : ndarray (n,)
        Position along the approximate edge, −1 to 1.
    offset, sigma : ndarray (n,)
        Position of the step, inwards from the approximate edge, and its standard deviation, pixels.
    good : ndarray of bool (n,)
        Which profiles show a step that can be located.
    contrast : ndarray (n,)
        Contrast of the step there, from neighbouring profiles.
    blur : ndarray (2, n)
        Logarithm of the width estimated from a profile and its neighbours alone, and its variance.
    form : StepForm
        Form of the blurred step.
    border : Border
        Film and picture along the edge.
    """

    place: Array
    offset: Array
    sigma: Array
    good: Mask
    contrast: Array
    blur: Array
    form: StepForm
    border: Border

    @property
    def width(self) -> float:
        """Width of the blurred step, one sigma, pixels."""
        return self.form.width


def measure_profiles(
    band: Band,
    channel: int,
    polarity: int,
    reach: float,
    gap: float,
    known: StepForm | None = None,
    film: Film | None = None,
    tone: Tone = STRAIGHT,
) -> EdgeProfiles | None:
    """Locate the step from film to picture in every profile of one channel.

    Parameters
    ----------
    band : Band
        Pixels along the edge.
    channel : int
        Index of the channel.
    polarity : int
        1 if film is darker than the picture, −1 if brighter.
    reach : float
        Largest distance of the edge from the approximate one, pixels.
    gap : float
        Width of film in pixels beyond which structures do not belong to the frame.
    known : StepForm, optional
        Form of the blurred step, if known from other edges.
    film : Film, optional
        Film as shown by other edges, if little film lies beyond this one.
    tone : Tone
        Curve between light and grey values, unless `known` has it.

    Returns
    -------
    EdgeProfiles or None
        None if nothing differs from film.
    """
    grey = band.grey[:, :, channel].astype(np.float64) * polarity
    border = border_of(grey, band, reach, gap, film)
    if border is None:
        return None
    found = _fitted(grey, band, border, known, tone)
    if found is None:
        return None
    steps, form = found
    place, sigma = np.where(steps.good, steps.place, 0.0), np.where(steps.good, steps.sigma, 1.0)
    blur = _without_phase(steps, band.harmonics(band.place, _smoothed(place, steps.good)))
    contrast = _along(np.where(steps.good, steps.contrast, np.inf))
    contrast = np.where(np.isfinite(contrast) & (contrast > 0), contrast, border.contrast)
    return EdgeProfiles(band.place, place, sigma, steps.good, contrast, blur, form, border)


def _without_phase(steps: _Steps, harmonics: Array) -> Array:
    """Widths without what depends on the phase of the edge on the grid of the pixels."""
    value, variance = steps.blur
    weight = steps.good / (variance + _PHASE**2)
    rest = value - float(np.median(value[steps.good]))
    # Neighbours share the profiles of which their widths are means.
    normal = harmonics.T @ (weight[:, None] * harmonics) / NEIGHBOURS + np.eye(4) / _PHASE**2
    part = np.linalg.solve(
        normal, harmonics.T @ (weight * np.clip(rest, -4 * _PHASE, 4 * _PHASE)) / NEIGHBOURS
    )
    return np.stack([value - harmonics @ part, variance])


def _width(grey: Array, band: Band, border: Border) -> float:
    """Width of the blurred step from the mean of all profiles, each divided by its contrast."""
    at = band.distance - border.start[:, None]
    rest = grey - border.level[:, None]
    place = np.arange(-12.0, 12.0, 0.5)
    tones = binned(rest, at, -12.0, 0.5, len(place))
    inside = row_median(np.where((place > 1) & (place < 6), tones, np.nan))
    lit = inside[np.isfinite(inside) & (inside > 0)]
    if not len(lit):
        return 1.0
    strong = np.asarray(inside > 0.5 * float(np.median(lit)))
    with warnings.catch_warnings():  # bins without pixels in any profile have no mean
        warnings.simplefilter("ignore", RuntimeWarning)
        mean = np.nanmedian(tones[strong] / inside[strong][:, None], axis=0)
    top = max(float(np.nanmax(mean[(place > 0) & (place < 6)])), 0.1)
    crossing = []
    for share in (0.16, 0.5):
        above = np.flatnonzero((mean > share * top) & (place > -10))
        crossing.append(float(place[above[0]]) if len(above) else 0.0)
    return float(np.clip(crossing[1] - crossing[0], 0.8, 4.0))


class _Steps(NamedTuple):
    """Steps of n profiles: distances, contrasts, standard deviations of the distances, mask of good ones, and
    widths as in :class:`EdgeProfiles`.
    """

    place: Array
    contrast: Array
    sigma: Array
    good: Mask
    blur: Array


def _fitted(
    grey: Array, band: Band, border: Border, known: StepForm | None, tone: Tone
) -> tuple[_Steps, StepForm] | None:
    """Step of every profile, and their common form."""
    form = known or StepForm(_width(grey, band, border), 0.0, band.half, tone=tone)
    # The border is accurate to one or two pixels, not enough for a narrow window.
    first = _one_by_one(grey, band, border, border.start, form, _FREE)
    if first is None:
        return None
    start = _smoothed(first.place, first.good)
    if known is None:
        width = float(np.clip(np.exp(np.median(first.blur[0][first.good])), *_WIDTHS))
        form = form._replace(width=width)
        for _ in range(_ROUNDS):
            form = _common_form(grey, band, border, start, first, form)
    steps = _one_by_one(grey, band, border, start, form, _TIGHTENED[known is None])
    return None if steps is None else (steps, form)


def _inward(width: float) -> float:
    """Extent of the profile behind a step of known position, pixels."""
    return max(_INWARD * width, _LEAST_INWARD)


def _one_by_one(
    grey: Array, band: Band, border: Border, start: Array, form: StepForm, spread: float
) -> _Steps | None:
    """Step of every profile, with a prior on the common width; None if none is good."""
    width = form.width
    near = _OUTWARD * width + 2.0 if spread == _FREE else _inward(width)
    window = _window(grey, band, border, start, width, near)
    if window is None:
        return None
    value, distance, weight = window
    fit = _fit(value, distance, weight, border, start, border.level, form, spread)
    p, step = fit.estimates[:, 0], fit.estimates[:, 3]
    scale = np.maximum(np.nan_to_num(fit.sigma0, nan=1.0), 1.0)
    own, own_step = (np.sqrt(fit.cofactor[:, k, k]) * scale for k in (0, 3))
    measured = np.isfinite(own) & (fit.reasons <= 1) & (weight.sum(axis=1) > 8)
    # From neighbours: a profile whose step is too high by chance is located too far inwards and would get a
    # larger weight.
    sigma = _along(np.where(measured, own, np.inf))
    ratio = _along(np.where(measured & (step > 0), step / np.where(measured, own_step, 1.0), 0.0))
    good = measured & (ratio > 4) & (step > 0) & (own < 3 * sigma) & (sigma < 0.8 * width)
    good &= np.abs(p - start) < 2.5 * width + 1.5
    if not good.any():
        return None
    blur = _own_width(fit.estimates[:, 2], fit.cofactor[:, 2, 2], np.log(width), spread, good)
    return _Steps(p, step, sigma, good, blur)


def _fit(
    value: Array,
    distance: Array,
    weight: Array,
    border: Border,
    start: Array,
    level: Array,
    form: StepForm,
    spread: float,
    options: BatchOptions = _BATCH,
) -> BatchAdjustment:
    """Adjust profiles, starting from expected parameters."""
    one, width = np.ones(len(value)), form.width
    none = [0 * one] * len(SHIFTS)
    initial = np.stack([start, level, np.log(width) * one, border.contrast * one, *none], axis=1)
    # Film is known from its surroundings; an immediate change of tone in the picture is an exception.
    changes = [_CHANGE * border.contrast] * len(SHIFTS)
    prior = np.array([10 * width, 0.5 * border.noise, spread, 4 * border.contrast, *changes])
    return adjust_batch(
        profile_function(distance, form),
        initial,
        value,
        weights=weight / (border.noise**2 + (_MODEL[spread == _FREE] * border.contrast) ** 2),
        prior=(initial, prior),
        options=options,
    )


def _smoothed(place: Array, good: Mask) -> Array:
    """Steps smoothed over neighbouring profiles, independent of the noise of a profile's own pixels."""
    index = np.arange(len(place))
    return _along(np.interp(index, index[good], place[good]))


def _common_form(
    grey: Array, band: Band, border: Border, start: Array, steps: _Steps, form: StepForm
) -> StepForm:
    """Form of the step from sections of neighbouring profiles, each fitted as one profile.

    From single noisy profiles the width would be too small, as each has unknowns of its own (Neyman and Scott
    1948), and with a wrong width all positions are biased to one side. The width is the median of those of
    the sections; where the pixels are seen in the step, width and lobes are common to all sections, because a
    section in which the edge lies on the grid in one way cannot tell one from the other.
    """
    contrast = _along(np.where(steps.good, steps.contrast, np.inf))
    lit = steps.good & np.isfinite(contrast) & (contrast > 0)
    window = _window(grey, band, border, start, form.width, _inward(form.width))
    if window is None:
        return form
    value, distance, weight = window
    distance = distance - start[:, None]
    value, part = _of_contrast(value, distance, border, np.where(lit, contrast, border.contrast), form)
    form, tone = form._replace(tone=STRAIGHT), form.tone
    each = min(NEIGHBOURS, len(value))
    sections = len(value) // each
    value, distance, weight = (
        values[: sections * each].reshape(sections, -1)
        for values in (value, distance, weight * lit[:, None] * part**2)
    )
    measured = (weight > 0).sum(axis=1) > _LEAST_PIXELS
    if not measured.any():
        return form._replace(tone=tone)
    value, distance, weight = value[measured], distance[measured], weight[measured]
    none = np.zeros(len(value))
    fit = _fit(value, distance, weight, border, none, none, form, _FREE, _SECTIONS)
    found = fit.estimates[fit.converged, 2]
    # If another structure runs along the edge, few sections converge.
    if len(found) <= 0.5 * len(value):
        return form._replace(tone=tone)
    form = form._replace(width=float(np.clip(np.exp(np.median(found)), *_WIDTHS)))
    for _ in range(0 if form.gaussian else _FORMING):
        fit = _fit(value, distance, weight, border, none, none, form, _HELD, _SECTIONS)
        form = _formed(form, fit, value, distance, weight, border)
    return form._replace(tone=tone)


def _of_contrast(
    value: Array, distance: Array, border: Border, contrast: Array, form: StepForm
) -> tuple[Array, Array]:
    """Light of profiles (n, s) as if all had the contrast of the edge, and how much noise it has less."""
    level, top = border.level[:, None], contrast[:, None]
    if form.tone.linear:
        return (value - level) * border.contrast / top, np.broadcast_to(top / border.contrast, value.shape)
    tone = form.tone
    low = tone.light(level)
    rise = (tone.light(level + top) - low) / border.contrast
    # The noise of light depends on the expected grey value.
    expected = tone.grey(low + rise * border.contrast * scipy.special.ndtr(distance / form.width))
    return (tone.light(value) - low) / rise, rise / tone.slope(expected)


def _formed(
    form: StepForm,
    fit: BatchAdjustment,
    value: Array,
    distance: Array,
    weight: Array,
    border: Border,
) -> StepForm:
    """Width and lobes common to sections, a step of Newton's method from the given ones."""
    rows = np.flatnonzero(fit.converged)
    if len(rows) < 2:
        return form
    x = np.concatenate([fit.estimates[rows], np.full((len(rows), 1), form.lobes)], axis=1)
    computed, jacobian = profile_function(distance, form)(x, rows)
    root = np.sqrt(weight[rows] * fit.factors[rows])
    rest, slope = root * (value[rows] - computed), root[..., None] * jacobian
    # The prior of the tone of film and of a change behind the edge, as in the adjustment of the sections.
    own = slope[..., [0, 1, 3, 4]]
    inner = np.einsum("kni,knj->kij", own, own)
    strength = (_MODEL[0] * border.contrast) ** 2 + border.noise**2
    inner += strength * np.diag([0.0, (2 / border.noise) ** 2, 0.0, (_CHANGE * border.contrast) ** -2])
    inner += 1e-9 * np.trace(inner, axis1=1, axis2=2)[:, None, None] * np.eye(4)
    common = slope[..., [2, 5]]
    mixed = np.einsum("kni,knj->kij", own, common)
    solved = np.linalg.solve(inner, mixed)
    normal = np.einsum("kni,knj->kij", common, common) - np.einsum("kin,kij->knj", mixed, solved)
    right = np.einsum("kni,kn->ki", common, rest)
    right -= np.einsum("kij,ki->kj", solved, np.einsum("kni,kn->ki", own, rest))
    variance = (rest**2).sum(axis=1) / np.maximum((root > 0).sum(axis=1) - 6, 1)
    # Sections with other structures have larger residuals.
    sure = variance < 4 * np.median(variance)
    normal = (normal[sure] / variance[sure, None, None]).sum(axis=0)
    right = (right[sure] / variance[sure, None]).sum(axis=0)
    information = float(normal[1, 1] - normal[0, 1] ** 2 / max(float(normal[0, 0]), 1e-9))
    normal += np.diag([1 / _FREE**2, 1 / _LOBES**2])
    right[1] -= form.lobes / _LOBES**2
    by_width, by_lobes = np.linalg.solve(normal, right)
    width = float(np.clip(form.width * np.exp(np.clip(by_width, -0.3, 0.3)), *_WIDTHS))
    lobes = float(np.clip(form.lobes + by_lobes, *_MOST_LOBES))
    return form._replace(width=width, lobes=lobes, weight=max(information, 0.0))


def _own_width(found: Array, cofactor: Array, known: float, spread: float, good: Mask) -> Array:
    """Logarithm of the width without its prior, averaged over neighbours, and its variance (2, n)."""
    share = np.clip(1 - cofactor / spread**2, 1e-3, 1.0)
    weight = np.where(good, share / np.maximum(cofactor, 1e-9), 1e-9)
    alone = np.where(good, np.clip((found - known) / share, -1.0, 1.0), 0.0)
    size = min(NEIGHBOURS, len(found))
    total = np.maximum(scipy.ndimage.uniform_filter1d(weight, size, mode="nearest"), 1e-9)
    mean = scipy.ndimage.uniform_filter1d(weight * alone, size, mode="nearest") / total
    return np.stack([known + mean, 1 / (size * total)])


def _along(values: Array) -> Array:
    """Running median over neighbouring profiles."""
    return np.asarray(scipy.ndimage.median_filter(values, size=min(NEIGHBOURS, len(values)), mode="nearest"))


def merged(fine: EdgeProfiles, wide: EdgeProfiles) -> EdgeProfiles:
    """Profiles of an edge, with wide ones where no narrow one nearby shows a step."""
    half = 0.5 * float(np.median(np.diff(wide.place))) if len(wide.place) > 1 else 1.0
    at = fine.place[fine.good]
    if len(at):
        after = np.searchsorted(at, wide.place)
        nearest = np.minimum(
            np.abs(at[np.minimum(after, len(at) - 1)] - wide.place), np.abs(at[after - 1] - wide.place)
        )
        lone = wide.good & (nearest > half)
    else:
        lone = wide.good
    place = np.concatenate([fine.place, wide.place[lone]])
    order = np.argsort(place, kind="stable")
    offset, sigma, good, contrast = (
        np.concatenate([a, b[lone]])[order]
        for a, b in (
            (fine.offset, wide.offset),
            (fine.sigma, wide.sigma),
            (fine.good, wide.good),
            (fine.contrast, wide.contrast),
        )
    )
    blur = np.concatenate([fine.blur, wide.blur[:, lone]], axis=1)[:, order]
    return replace(
        fine, place=place[order], offset=offset, sigma=sigma, good=good, contrast=contrast, blur=blur
    )


def _window(
    grey: Array, band: Band, border: Border, start: Array, width: float, high: float
) -> tuple[Array, Array, Array] | None:
    """Pixels of profiles from film to a distance inside their starts: values, distances, weights (n, s)."""
    low = np.maximum(-_OUTWARD * width - 2.0, border.outermost - start)
    at = band.distance - start[:, None]
    # A pixel leaves the window as gradually as the edge moves on the grid.
    inside: Array = np.clip(high + band.half - at, 0.0, 1.0)
    used: Array = np.where((at > low[:, None]) & np.isfinite(grey), inside, 0.0)
    size = int(np.count_nonzero(used, axis=1).max(initial=0))
    if size < 8:
        return None
        # Used pixels come first, in their order; the rest have zero weight.
    order: Rows = np.argsort(used == 0, axis=1, kind="stable")[:, :size]
    value, place, weight = (np.take_along_axis(part, order, axis=1) for part in (grey, band.distance, used))
    return np.where(weight > 0, value, 0.0), place, weight
