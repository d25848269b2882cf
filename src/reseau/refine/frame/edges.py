"""One edge of a frame at full resolution: profiles across it, and where each steps from film to picture.

All four edges are one case (Cruz et al., sect. 2.2): places are distances from an approximate line, positive
towards the picture. Nothing is rotated or resampled for it; pixels keep their exact distances. A profile is
film, a step blurred by a Gaussian, and a picture whose tone may slope:

.. math:: g(d) = b + A\\,\\Phi(u) + e\\,w\\,(u\\,\\Phi(u) + \\varphi(u)), \\qquad u = (d - p)/w .
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.special import ndtr

from ...adjust import BatchOptions, adjust_batch, weight_function
from ...data import Array, Mask, Rows
from ...scans import Scan
from .border import best_line, first_departure, likelihood

__all__ = ["Band", "EdgeProfiles", "measure_profiles", "merged", "read_band"]

_PROFILES = 400
"""Profiles of an edge, where it is long enough for as many."""
_COLUMNS, _MANY = 4, 12
"""Neighbouring columns of pixels that make a profile, at most; and where so few show no step."""
_ENDS = 0.03
"""Part of an edge at either end that is left out: corners are rounded."""
_BINS = 72
"""Places across at which the search for the border looks, at most."""
_ALONG = 24
"""Columns over which tones are smoothed before they are compared with film."""
_SHIFTS, _CHANGE = (3.0,), 0.15
"""Where behind its edge, in widths of the step, a picture may change its tone, and by how much of the
contrast, one sigma."""
_ROBUST = weight_function("danish", 2.5)
_SIGNIFICANT, _LEAST_CONTRAST = 4.0, 0.12
"""In noise, and of the contrast along the edge: what differs from film by less is film."""


@dataclass(frozen=True, eq=False)
class Band:
    """Pixels along an approximate edge.

    Parameters
    ----------
    start, stop : ndarray (2,)
        Ends of the approximate edge, pixels.
    place : ndarray (n,)
        Of the profiles along it, −1 at its start and 1 at its end.
    distance : ndarray (n, s)
        Of the pixels from it, positive inwards.
    grey : ndarray (n, s, channels)
        Their values; NaN outside the scan.
    columns : int
        Neighbouring columns of pixels in a profile.
    """

    start: Array
    stop: Array
    place: Array
    distance: Array
    grey: NDArray[np.float32]
    columns: int

    @property
    def normal(self) -> Array:
        """Unit vector inwards."""
        along = self.stop - self.start
        return np.asarray(np.array([-along[1], along[0]]) / np.hypot(*along))


@dataclass(frozen=True, eq=False)
class EdgeProfiles:
    """What the profiles of an edge in one channel tell, in columns over the n profiles.

    Parameters
    ----------
    place : ndarray (n,)
        Along the approximate edge, −1 to 1.
    offset, sigma : ndarray (n,)
        Of the step, inwards from the approximate edge, and its standard deviation, pixels.
    good : ndarray of bool (n,)
        Which show a step that can be located.
    contrast : float
        Of the picture against film, in standard deviations of the noise.
    width : float
        Of the blurred step, one sigma, pixels.
    margin : float
        By how much the line of the border is better than any other, log-likelihood per profile.
    lit : float
        Part of the profiles that differ from film anywhere.
    clean : float
        Part of the places beyond the edge that are film.
    """

    place: Array
    offset: Array
    sigma: Array
    good: Mask
    contrast: float
    width: float
    margin: float
    lit: float
    clean: float


def read_band(
    scan: Scan, start: Array, stop: Array, outward: float, inward: float, *, wide: bool = False
) -> Band:
    """Read the pixels along an approximate edge, `outward` and `inward` pixels to its sides.

    `wide` profiles are of more columns each, for weak contrast.
    """
    along = stop - start
    length = float(np.hypot(*along))
    tangent = along / length
    axis = int(abs(tangent[1]) > abs(tangent[0]))  # 0: profiles are columns of the scan
    across = 1 - axis
    normal = np.array([-tangent[1], tangent[0]])
    spans = abs(along[axis]) * (1 - 2 * _ENDS)
    count = int(np.clip(spans / (_MANY if wide else 2), 8, _PROFILES))
    each = int(np.clip(spans / count, 1, _MANY if wide else _COLUMNS))
    centre = start[axis] + along[axis] * (_ENDS + (1 - 2 * _ENDS) * (np.arange(count) + 0.5) / count)
    step = np.rint(centre - (each - 1) / 2).astype(np.intp)
    sign = np.sign(normal[across])
    low, high = sorted((-outward * sign / abs(normal[across]), inward * sign / abs(normal[across])))
    size = int(np.ceil(high - low)) + 1
    slope = along[across] / along[axis]
    first = np.rint(start[across] + (step + (each - 1) / 2 - start[axis]) * slope + low).astype(np.intp)
    grey = np.full((count, each, size, len(scan.channels)), np.nan, dtype=np.float32)
    limits = (scan.width, scan.height)
    for i in range(count):
        a0, a1 = max(step[i], 0), min(step[i] + each, limits[axis])
        b0, b1 = max(first[i], 0), min(first[i] + size, limits[across])
        if a1 <= a0 or b1 <= b0:
            continue
        box = (b0, b1, a0, a1) if axis == 0 else (a0, a1, b0, b1)
        part: NDArray[Any] = scan.window(*(int(v) for v in box))
        turned = part.transpose(1, 0, 2) if axis == 0 else part
        grey[i, a0 - step[i] : a1 - step[i], b0 - first[i] : b1 - first[i]] = turned
    at = np.empty((count, each, size, 2))
    at[..., axis] = step[:, None, None] + np.arange(each)[None, :, None]
    at[..., across] = first[:, None, None] + np.arange(size)
    distance = (at - start) @ normal
    middle = step + (each - 1) / 2
    place = 2 * (middle - start[axis]) / along[axis] - 1
    flat = distance.reshape(count, -1), grey.reshape(count, each * size, -1)
    return Band(start, stop, place, *flat, each)


@dataclass(frozen=True, eq=False)
class _Border:
    """Film and picture of one channel along an edge, before the steps are located."""

    level: Array
    noise: float
    contrast: float
    start: Array
    margin: float
    lit: float
    clean: float


def measure_profiles(
    band: Band, channel: int, polarity: int, reach: float, gap: float, width: float | None = None
) -> EdgeProfiles | None:
    """Locate the step from film to picture in every profile of one channel.

    Parameters
    ----------
    band : Band
        The pixels.
    channel : int
        Which of its channels.
    polarity : int
        1 where film is darker than the picture.
    reach : float
        How far the edge may be from the approximate one, pixels.
    gap : float
        Width of film, pixels, beyond which things have nothing to do with the edge.
    width : float, optional
        Of the blurred step, one sigma, where it is known from other edges; then the picture may have a step
        of its own near the edge.

    Returns
    -------
    EdgeProfiles or None
        None where nothing differs from film.
    """
    grey = band.grey[:, :, channel].astype(np.float64) * polarity
    border = _border(grey, band, reach, gap)
    if border is None:
        return None
    fits = _fitted(grey, band, border, width)
    if fits is None:
        return None
    offset, sigma, good, width = fits
    return EdgeProfiles(
        band.place,
        offset,
        sigma,
        good,
        border.contrast / border.noise,
        width,
        border.margin,
        border.lit,
        border.clean,
    )


def _binned(grey: Array, distance: Array, low: float, size: float, count: int) -> Array:
    """Means of the pixels of each profile in bins of distance (n, count); NaN where there are none."""
    column = np.floor((distance - low) / size).astype(np.intp)
    used = (column >= 0) & (column < count) & np.isfinite(grey)
    flat = (np.arange(len(grey))[:, None] * count + column)[used]
    total = np.bincount(flat, grey[used], minlength=len(grey) * count)
    number = np.bincount(flat, minlength=len(grey) * count)
    with np.errstate(invalid="ignore"):
        return np.asarray((total / np.where(number > 0, number, np.nan)).reshape(len(grey), count))


def _border(grey: Array, band: Band, reach: float, gap: float) -> _Border | None:
    """Tone of film along the edge, and the line where film ends."""
    low, high = float(band.distance.min(axis=1).max()), float(band.distance.max(axis=1).min())
    size = max(1.0, (high - low) / _BINS)
    count = int((high - low) / size)
    tones = _binned(grey, band.distance, low, size, count)
    known = np.isfinite(tones)
    beyond = low + (np.arange(count) + 0.5) * size
    outer = known & (beyond < -0.4 * reach)
    if outer.sum() < 3 * len(tones) or known.mean() < 0.5:
        return None
    # A median of a profile, and along the edge of these: dust, print and scratches do not move it.
    own = _row_median(np.where(outer, tones, np.nan))
    level = median_filter(np.where(np.isfinite(own), own, np.nanmedian(own)), size=101, mode="nearest")
    rest = np.where(known, tones - level[:, None], 0.0)
    over = max(1, round(_ALONG / band.columns))
    # Medians: a scratch that crosses the edge is a few columns wide.
    smooth = median_filter(rest, size=(over | 1, 1), mode="nearest")
    # Within each profile: perforations and the scanner's light change from profile to profile.
    own = _row_median(np.where(outer, smooth, np.nan))
    noise = 1.4826 * float(np.nanmedian(np.abs(smooth - own[:, None])[outer]))
    inner = smooth[:, beyond > 0]
    contrast = float(np.quantile(inner, 0.85))
    least = max(_SIGNIFICANT * noise, _LEAST_CONTRAST * contrast, 1e-9)
    if contrast < 1.5 * least:
        return None
    start = int(np.clip((0.3 * reach - low) / size, 1, count - 1))
    found = likelihood(smooth / least, known, start, max(2, round(gap / size)))
    first, last = (int(np.clip((r - low) / size, 1, count - 2)) for r in (-reach, reach))
    begin, end, margin = best_line(found, band.place, first, last, max(2, (last - first) // 2))
    line = begin * (1 - band.place) / 2 + end * (1 + band.place) / 2
    near = first_departure(found, line, max(2, round(0.1 * gap / size)))
    outside = (np.arange(count) < line[:, None] - 2) & (np.arange(count) > line[:, None] - 2 - gap / size)
    clean = 1.0 - float(((found > 0) & outside & known).sum()) / max(float((outside & known).sum()), 1.0)
    inside = (np.arange(count) >= line[:, None]) & (np.arange(count) < line[:, None] + 6)
    lit = float((((found > 0) & inside).any(axis=1)).mean())
    raw = 1.4826 * float(np.nanmedian(np.abs((grey - level[:, None])[band.distance < -0.5 * reach])))
    return _Border(level, max(raw, 1e-6), contrast, low + size * near, margin, lit, clean)


def _row_median(values: Array) -> Array:
    """Medians of rows, NaN left out; NaN for a row that has nothing else."""
    empty: Mask = np.asarray(~np.isfinite(values).any(axis=1))
    filled = np.where(empty[:, None], 0.0, values)
    return np.asarray(np.where(empty, np.nan, np.nanmedian(filled, axis=1)))


def _width(grey: Array, band: Band, border: _Border) -> float:
    """Width of the blurred step from the mean of all profiles, each over its own contrast."""
    at = band.distance - border.start[:, None]
    rest = grey - border.level[:, None]
    place = np.arange(-12.0, 12.0, 0.5)
    tones = _binned(rest, at, -12.0, 0.5, len(place))
    inside = _row_median(np.where((place > 1) & (place < 6), tones, np.nan))
    half = 0.5 * float(np.nanmedian(np.where(inside > 0, inside, np.nan)))
    strong = np.asarray(inside > half)
    if not strong.any():
        return 1.0
    with warnings.catch_warnings():  # where no profile has a pixel there is no mean, and none is needed
        warnings.simplefilter("ignore", RuntimeWarning)
        mean = np.nanmedian(tones[strong] / inside[strong][:, None], axis=0)
    top = max(float(np.nanmax(mean[(place > 0) & (place < 6)])), 0.1)
    crossing = []
    for share in (0.16, 0.5):
        above = np.flatnonzero((mean > share * top) & (place > -10))
        crossing.append(float(place[above[0]]) if len(above) else 0.0)
    return float(np.clip(crossing[1] - crossing[0], 0.8, 4.0))


def _fitted(
    grey: Array, band: Band, border: _Border, known: float | None
) -> tuple[Array, Array, Mask, float] | None:
    """Step of every profile: offset, sigma, which are good, and the common width."""
    start = border.start
    width = _width(grey, band, border) if known is None else known
    for spread in (0.5, 0.12, 0.12) if known is None else (0.02,):
        window = _window(grey, band.distance, start, -4.0 * width - 2.0, 4.0 * width + 2.0)
        if window is None:
            return None
        value, distance, weight = window
        one = np.ones(len(value))
        none = [0 * one] * len(_SHIFTS)
        initial = np.stack([start, border.level, np.log(width) * one, border.contrast * one, *none], axis=1)
        # Film is known from its surroundings; that the picture changes at once is an exception.
        changes = [_CHANGE * border.contrast] * len(_SHIFTS)
        prior = np.array([10 * width, 0.5 * border.noise, spread, 4 * border.contrast, *changes])
        fit = adjust_batch(
            _profile_function(distance),
            initial,
            value,
            weights=weight / border.noise**2,
            prior=(initial, prior),
            options=BatchOptions(max_iterations=7, share=0.05, reweight=_ROBUST),
        )
        p, step, w = fit.estimates[:, 0], fit.estimates[:, 3], np.exp(fit.estimates[:, 2])
        scale = np.maximum(np.nan_to_num(fit.sigma0, nan=1.0), 1.0)
        own, own_step = (np.sqrt(fit.cofactor[:, k, k]) * scale for k in (0, 3))
        told = np.isfinite(own) & (fit.reasons <= 1) & (weight.sum(axis=1) > 8)
        # By neighbours: a profile with a step too high by chance lies too far in, and would weigh more.
        sigma = _along(np.where(told, own, np.inf))
        ratio = _along(np.where(told & (step > 0), step / np.where(told, own_step, 1.0), 0.0))
        good = told & (ratio > 4) & (step > 0) & (own < 3 * sigma) & (sigma < 0.8 * width)
        good &= np.abs(p - start) < 2.5 * width + 1.5
        if not good.any():
            return None
        settled = float(np.clip(np.median(w[good]), 0.4, 6.0)) if known is None else known
        done = spread < 0.5 and abs(np.log(settled / width)) < 0.05
        start, width = np.where(good, p, start), settled
        if done:
            break
    return np.where(good, p, 0.0), np.where(good, sigma, 1.0), good, width


def _along(values: Array) -> Array:
    """Running median over neighbouring profiles."""
    return np.asarray(median_filter(values, size=min(15, len(values)), mode="nearest"))


def merged(fine: EdgeProfiles, wide: EdgeProfiles) -> EdgeProfiles:
    """The profiles of an edge, and wide ones where no other near them shows a step."""
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
    offset, sigma, good = (
        np.concatenate([a, b[lone]])[order]
        for a, b in ((fine.offset, wide.offset), (fine.sigma, wide.sigma), (fine.good, wide.good))
    )
    return replace(fine, place=place[order], offset=offset, sigma=sigma, good=good)


def _window(
    grey: Array, distance: Array, start: Array, low: float, high: float
) -> tuple[Array, Array, Array] | None:
    """Pixels of each profile between two distances from its start: values, distances, weights (n, s)."""
    at = distance - start[:, None]
    used = (at > low) & (at < high) & np.isfinite(grey)
    size = int(used.sum(axis=1).max(initial=0))
    if size < 8:
        return None
    # Those used first, in their order; the rest have no weight.
    order: Rows = np.argsort(~used, axis=1, kind="stable")[:, :size]
    value, place, weight = (
        np.take_along_axis(part, order, axis=1) for part in (grey, distance, used.astype(np.float64))
    )
    return np.where(weight > 0, value, 0.0), place, weight


def _profile_function(distance: Array) -> Any:
    """The model of a profile and its derivatives by p, b, log w, A and the c, for :func:`adjust_batch`."""
    shifts = np.array([0.0, *_SHIFTS])

    def function(x: Array, rows: Rows) -> tuple[Array, Array]:
        p, b, w, steps = x[:, 0, None], x[:, 1, None], np.exp(x[:, 2, None]), x[:, None, 3:]
        u = ((distance[rows] - p) / w)[:, :, None] - shifts
        phi, bell = ndtr(u), np.exp(-0.5 * u * u) / np.sqrt(2 * np.pi)
        jacobian = np.empty((*u.shape[:2], 3 + len(shifts)))
        jacobian[..., 0] = -(steps * bell).sum(axis=2) / w
        jacobian[..., 1] = 1.0
        # The steps behind the first move with the width; u + shift is where they were without it.
        jacobian[..., 2] = -(steps * bell * (u + shifts)).sum(axis=2)
        jacobian[..., 3:] = phi
        return b + (steps * phi).sum(axis=2), jacobian

    return function
