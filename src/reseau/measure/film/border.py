"""The border between unexposed film and picture along an edge, from profiles of pixels across it.

All four edges are treated alike (Cruz et al., sect. 2.2): each pixel has its exact distance from an
approximate line, positive towards the picture. Nothing is rotated or resampled.

The strongest gradient is not the edge of a frame if a bright structure runs along it within the picture (Cruz
et al., fig. 7B). The edge is identified by what lies *beyond* it: film of uniform tone. Each place along and
across gets its log-likelihood ratio of picture against unexposed film; the edge is the straight line with the
largest sum of these on its inside. Both likelihoods have heavy tails: dust and scratches on the film and dark
parts of the picture have little weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ...core.data import Array, Mask, Rows
from ...io.scans import Scan

_PROFILES = 400
"""Maximum number of profiles of an edge."""
_COLUMNS, _MANY = 4, 12
"""Maximum number of neighbouring pixel columns in a profile; the second where narrow profiles show no
step."""
_ENDS = 0.03
"""Share of an edge at either end that is left out: corners are rounded."""


@dataclass(frozen=True, eq=False)
class Band:
    """Pixels along an approximate edge.

    Parameters
    ----------
    start, stop : ndarray (2,)
        Ends of the approximate edge, pixels.
    place : ndarray (n,)
        Position of each profile along the edge, −1 at its start and 1 at its end.
    distance : ndarray (n, s)
        Distance of each pixel from the edge, positive inwards.
    grey : ndarray (n, s, channels)
        Grey values; NaN outside the scan.
    columns : int
        Number of neighbouring pixel columns in a profile.
    """

    start: Array
    stop: Array
    place: Array
    distance: Array
    grey: NDArray[np.float32]
    columns: int

    @property
    def normal(self) -> Array:
        """Unit vector pointing inwards."""
        along = self.stop - self.start
        return np.asarray(np.array([-along[1], along[0]]) / np.hypot(*along))

    @property
    def half(self) -> float:
        """Half the side of a pixel across the edge."""
        return float(0.5 * np.abs(self.normal).max())

    def at(self, place: Array, offset: Array) -> Array:
        """Pixels (n, 2) at positions along the edge and offsets inwards."""
        along = (self.stop - self.start) * ((place + 1) / 2)[:, None]
        return np.asarray(self.start + along + offset[:, None] * self.normal)

    def harmonics(self, place: Array, offset: Array) -> Array:
        """Two harmonics (n, 4) of the phase of an edge on the grid of the pixels."""
        phase = 2 * np.pi * self.at(place, offset)[:, int(np.abs(self.normal).argmax())]
        return np.stack([np.cos(phase), np.sin(phase), np.cos(2 * phase), np.sin(2 * phase)], axis=1)


def read_band(
    scan: Scan, start: Array, stop: Array, outward: float, inward: float, *, wide: bool = False
) -> Band:
    """Read the pixels along an approximate edge, from `outward` to `inward` pixels on its sides.

    With `wide`, each profile averages more columns, for weak contrast.
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


_PICTURE, _FILM = 2.3, 0.65
"""Log-likelihood gain of a place that differs from film, and loss of one that does not: half of a picture's
edge may be as dark as film, and one place in twenty of film may be dust."""
_BINS = 72
"""Maximum number of bins across the edge in the search for the border."""
_ALONG = 24
"""Number of columns over which tones are smoothed before comparison with film."""
_SIGNIFICANT, _LEAST_CONTRAST = 4.0, 0.12
"""Places count as film if they differ by less than this multiple of the noise or share of the contrast."""
_STRIPE, _LIT, _DETACHED = 8, 0.06, 3
"""Bins within a line in which film may separate it from the picture, minimum share of an edge that differs
from film where there is a picture, and maximum number of such lines that are skipped."""
_RUNNING = 101
"""Number of profiles over which the tone of film along an edge is taken."""
_SHALLOW = 0.2
"""Largest difference of the centre of a narrow strip of film from film, as a share of the picture's contrast;
a strip that differs more is no film, or so narrow that blur has filled it."""
_NARROW = 0.25
"""Minimum width of a strip of film of known tone, as a share of the usual gap."""


@dataclass(frozen=True)
class Film:
    """Tone of unexposed film from other edges of the frame, for an edge with little film beyond it.

    Parameters
    ----------
    tone, noise : float
        Grey value times the polarity, and the scatter of smoothed values.
    """

    tone: float
    noise: float


@dataclass(frozen=True, eq=False)
class Border:
    """Film and picture of one channel along an edge, before the steps are located.

    Parameters
    ----------
    level : ndarray (n,)
        Tone of the film beside each profile.
    noise, spread : float
        Noise of a pixel of film; scatter of film smoothed along the edge.
    contrast : float
        Contrast of the picture against film.
    start : ndarray (n,)
        Approximate distance of the step.
    outermost : ndarray (n,)
        Minimum distance to which film extends outwards.
    clean : float
        Share of the places beyond the edge that are film.
    """

    level: Array
    noise: float
    spread: float
    contrast: float
    start: Array
    outermost: Array
    clean: float

    @property
    def film(self) -> Film:
        """The film beyond the edge."""
        return Film(float(np.median(self.level)), self.spread)


def likelihood(departure: Array, known: Array, start: int, gap: int) -> Array:
    """Log-likelihood ratio of places: picture against film.

    Parameters
    ----------
    departure : ndarray (n, s)
        Difference of n profiles from film, positive towards the picture, over the smallest significant
        difference; s places from outside to inside.
    known : ndarray of bool (n, s)
        Which places are in the scan.
    start : int
        A column that is not far outside the edge. Places further outwards behind `gap` columns of film, such
        as perforations and neighbouring frames, count as film.
    """
    ratio = np.clip((departure - 0.5) / 0.5, 0.0, 1.0) * known
    differs = ratio > 0.5
    run, beyond = np.zeros(len(ratio)), np.zeros(len(ratio), dtype=bool)
    for column in range(start, -1, -1):
        run = np.where(differs[:, column], 0.0, run + 1)
        ratio[beyond, column] = 0.0
        beyond |= run >= gap
    found = np.where(known, -_FILM + (_PICTURE + _FILM) * ratio, 0.0)
    # A profile that differs nowhere gives no information about the border.
    lit = (ratio > 0.5).any(axis=1, keepdims=True)
    return np.asarray(np.where(lit, found, 0.0))


def best_line(found: Array, along: Array, first: int, last: int, tilt: int) -> tuple[float, float]:
    """Straight line with the largest sum on its inside.

    Parameters
    ----------
    found : ndarray (n, s)
        Result of :func:`likelihood`.
    along : ndarray (n,)
        Positions of the profiles, −1 to 1.
    first, last : int
        Range of columns for both ends of the line.
    tilt : int
        Largest difference between the columns of its ends.

    Returns
    -------
    (float, float)
        First inside columns at the positions −1 and 1; the line is half a column before.
    """
    within = np.cumsum(found[:, ::-1], axis=1)[:, ::-1]
    within = np.concatenate([within, np.zeros((len(found), 1))], axis=1)
    ends = np.arange(first, last + 1)
    start, stop = (e.ravel() for e in np.meshgrid(ends, ends, indexing="ij"))
    near = np.abs(stop - start) <= tilt
    start, stop = start[near], stop[near]
    share = (along + 1) / 2
    column = np.rint(start[:, None] * (1 - share) + stop[:, None] * share).astype(np.intp)
    total = within[np.arange(len(found)), np.clip(column, 0, found.shape[1])].sum(axis=1)
    best = int(np.argmax(total))
    # Average over neighbouring lines that are equally good.
    alike = total > total[best] - 0.5
    alike &= (np.abs(start - start[best]) <= 1) & (np.abs(stop - stop[best]) <= 1)
    return float(start[alike].mean()), float(stop[alike].mean())


def _detached(found: Array, line: Array) -> bool:
    """Whether film separates the outermost structure along the whole edge from the picture.

    Then it is a scratch beside the edge, or print, and is set to film in `found`: at a picture's edge some
    part is always brighter than film.
    """
    column = np.rint(line).astype(np.intp)[:, None] + np.arange(_STRIPE)
    seen = np.take_along_axis(found, np.clip(column, 0, found.shape[1] - 1), axis=1) > 0
    lit = seen.mean(axis=0)
    dark = np.flatnonzero(lit < _LIT)
    if not len(dark) or lit[: dark[0] + 1].max() < _LIT:
        return False
    found[np.arange(found.shape[1]) <= column[:, dark[-1]][:, None]] = -_FILM
    return True


def first_departure(found: Array, middle: Array, reach: int) -> Array:
    """First inside column of each profile, within `reach` of the given columns (n,)."""
    within = np.cumsum(found[:, ::-1], axis=1)[:, ::-1]
    columns = np.rint(middle).astype(np.intp)[:, None] + np.arange(-reach, reach + 1)
    columns = np.clip(columns, 0, found.shape[1] - 1)
    value = np.take_along_axis(within, columns, axis=1)
    return np.asarray(np.take_along_axis(columns, value.argmax(axis=1)[:, None], axis=1)[:, 0], dtype=float)


def binned(grey: Array, distance: Array, low: float, size: float, count: int) -> Array:
    """Means of the pixels of each profile in bins of distance (n, count); NaN where there are none."""
    column = np.floor((distance - low) / size).astype(np.intp)
    used = (column >= 0) & (column < count) & np.isfinite(grey)
    flat = (np.arange(len(grey))[:, None] * count + column)[used]
    total = np.bincount(flat, grey[used], minlength=len(grey) * count)
    number = np.bincount(flat, minlength=len(grey) * count)
    with np.errstate(invalid="ignore"):
        return np.asarray((total / np.where(number > 0, number, np.nan)).reshape(len(grey), count))


def row_median(values: Array) -> Array:
    """Medians of rows without NaN; NaN for an empty row. Quicker than those of NumPy, by masks."""
    count, rows = np.isfinite(values).sum(axis=1), np.arange(len(values))
    ordered = np.sort(values, axis=1)
    return np.asarray((ordered[rows, (count - 1) // 2] + ordered[rows, count // 2]) / 2)


def _running(values: Array) -> Array:
    """Median along the edge, robust against dust, print and scratches. NaN if all values are missing."""
    if not np.isfinite(values).any():
        return values
    filled = np.where(np.isfinite(values), values, np.nanmedian(values))
    return np.asarray(scipy.ndimage.median_filter(filled, size=_RUNNING, mode="nearest"))


def border_of(grey: Array, band: Band, reach: float, gap: float, film: Film | None = None) -> Border | None:
    """Tone of film along an edge, and the line where film ends; None if nothing differs from film.

    Parameters
    ----------
    grey : ndarray (n, s)
        Pixels of one channel, times the polarity, so that film is darker.
    band : Band
        Distances of the pixels.
    reach : float
        Largest distance of the edge from the approximate one, pixels.
    gap : float
        Width of film in pixels beyond which structures do not belong to the frame.
    film : Film, optional
        Film as shown by other edges; by default the film beyond `reach` is used.
    """
    low, high = float(band.distance.min(axis=1).max()), float(band.distance.max(axis=1).min())
    size = max(1.0, (high - low) / _BINS)
    count = int((high - low) / size)
    tones = binned(grey, band.distance, low, size, count)
    known, beyond = np.isfinite(tones), low + (np.arange(count) + 0.5) * size
    first, last = (int(np.clip((r - low) / size, 1, count - 2)) for r in (-reach, reach))
    outer: Mask = np.asarray(known & (beyond < -0.4 * reach))
    if known.mean() < 0.5 or (film is None and outer.sum() < 3 * len(tones)):
        return None
    ground = _ground(tones, outer, band, film, (first, last))
    contrast = float(np.quantile(ground.smooth[:, beyond > 0], 0.85))
    least = max(_SIGNIFICANT * ground.spread, _LEAST_CONTRAST * contrast, 1e-9)
    if contrast < 1.5 * least:
        return None
    start = int(np.clip((0.3 * reach - low) / size, 1, count - 1))
    narrow, parted = film is not None, gap if film is None else _NARROW * gap
    found = likelihood(ground.smooth / least, known, start, max(2, round(parted / size)))
    found[ground.foreign] = -_FILM
    for _ in range(_DETACHED):
        begin, end = best_line(found, band.place, first, last, max(2, (last - first) // 2))
        line = begin * (1 - band.place) / 2 + end * (1 + band.place) / 2
        if not _detached(found, line):
            break
        narrow = True
    near = first_departure(found, line, max(2, round(0.1 * gap / size)))
    away = np.arange(count) - line[:, None] + 2
    outside = (away < 0) & (away > -parted / size) & known
    differs = found > 0 if film is None else (ground.smooth > least) & ~ground.foreign
    clean = 1.0 - float((differs & outside).sum()) / max(float(outside.sum()), 1.0)
    level, outermost, beside = ground.level, np.full(len(near), -np.inf), band.distance < -0.5 * reach
    if narrow:
        level, column = _strip(tones, line, _NARROW * gap / size)
        outermost = low + size * column
        beside = np.abs(band.distance - outermost[:, None]) < size
    rest = np.abs((grey - level[:, None])[beside])
    if not np.isfinite(rest).any():
        return None
    raw = 1.4826 * float(np.nanmedian(rest))
    return Border(level, max(raw, 1e-6), ground.spread, contrast, low + size * near, outermost, clean)


class _Ground(NamedTuple):
    """Tone of film beside each profile (n,), smoothed departures from it (n, s), their scatter in film, and
    a mask of places beyond a strip of film that do not belong to the frame."""

    level: Array
    smooth: Array
    spread: float
    foreign: Mask


def _ground(tones: Array, outer: Mask, band: Band, film: Film | None, between: tuple[int, int]) -> _Ground:
    """Film beyond an edge: outside the reach, or a strip as dark as the film at other edges."""
    foreign = np.zeros(tones.shape, dtype=bool)
    if film is None:
        level = _running(row_median(np.where(outer, tones, np.nan)))
    else:
        level = np.full(len(tones), film.tone)
        # Perforations of a negative differ from film in the opposite direction; they do not belong to it.
        strip = _alike(np.abs(tones - film.tone) / max(film.noise, 1e-6), band.place, *between)
        darkest = _running(row_median(_beside(tones, strip, [-1, 0, 1])))
        bright = float(np.nanquantile(tones, 0.85)) - film.tone
        if abs(np.median(darkest) - film.tone) < _SHALLOW * bright:
            level, foreign = darkest, np.asarray(np.arange(tones.shape[1]) <= strip[:, None])
    over = max(1, round(_ALONG / band.columns))
    # Medians, because a scratch that crosses the edge is a few columns wide.
    rest = np.where(np.isfinite(tones), tones - level[:, None], 0.0)
    smooth = scipy.ndimage.median_filter(rest, size=(over | 1, 1), mode="nearest")
    return _Ground(level, smooth, _spread(smooth, outer) if film is None else film.noise, foreign)


def _spread(smooth: Array, outer: Mask) -> float:
    """Scatter of film within profiles; perforations and the scanner's light vary between profiles."""
    own = row_median(np.where(outer, smooth, np.nan))
    return 1.4826 * float(np.nanmedian(np.abs(smooth - own[:, None])[outer]))


def _alike(departure: Array, along: Array, first: int, last: int) -> Array:
    """Columns (n,) of the straight line along a narrow strip of film, where tones depart least from it."""
    step = np.diff(np.where(np.isfinite(departure), departure, np.nanmax(departure)), axis=1, append=0.0)
    step[:, -1] = 0.0
    # The sum of these steps from a column on is the last departure minus that of the column.
    begin, end = best_line(step, along, first, last, max(2, (last - first) // 4))
    return np.asarray(begin * (1 - along) / 2 + end * (1 + along) / 2)


def _beside(tones: Array, line: Array, away: Sequence[int] | Rows) -> Array:
    """Tones (n, m) of the columns at given distances inside a line."""
    column = np.clip(np.rint(line[:, None] + np.asarray(away)).astype(np.intp), 0, tones.shape[1] - 1)
    return np.take_along_axis(tones, column, axis=1)


def _strip(tones: Array, line: Array, width: float) -> tuple[Array, Array]:
    """Tone of a narrow strip of film beyond a line, and the column of its centre, the darkest one.

    Blur fills the strip from both sides, so only its centre shows film.
    """
    away = np.arange(1, max(3, round(2.5 * width)) + 1)
    values = _beside(tones, line, -away)
    middle = row_median(values.T)
    best = int(np.argmin(np.where(np.isfinite(middle), middle, np.inf)))
    around = values[:, max(best - 1, 0) : best + 2]
    return _running(row_median(around)), np.asarray(line - away[best])
