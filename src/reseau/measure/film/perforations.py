"""The perforations of 35 mm film as a measure in the scan: the film's own plane from their pitch.

Perforations are punched every 4.75 mm on both sides of the film, so exactly that film carries its own scale
(ISO 2906, SMPTE 139: pitch 4.75 mm, rows 28.17 mm apart). Their edges are steps as those of a frame are, and
measured in the same way; a tilted camera that copied the film and the distortion of its lens are estimated
from where they lie.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...adjust import BatchOptions, GaussMarkov, Parameters, adjust_batch, robust
from ...core.data import Array
from ...core.failure import Code, Failure
from ...io.scans import Scan
from .border import binned, read_band
from .edges import measure_profiles, profile_function
from .lines import robust_line

__all__ = ["PITCH_MM", "FilmPlane", "edge_of", "film_plane"]

PITCH_MM = 4.75
"""From one perforation to the next."""
_ROWS_MM = 28.17
"""From the middle of one row of perforations to that of the other."""
_SIZE_MM = 1.98, 2.79
"""Height and width of a perforation, approximate: both are estimated."""
_STRAIGHT = 0.45
"""Part of a perforation's side between its rounded corners."""
_LEAST = 20
"""Edges from which the plane is determined well."""
_RIM_PX = 10.0
"""Width of what is looked at outside a perforation: its rim is a dark line some pixels wide."""
_ASIDE, _BLUR_PX = 4.0, 2.0
"""How far from the steepest place a step is looked at, and its width to begin with."""
_LEAST_CONTRAST = 8.0
"""Grey values by which the light in a perforation is brighter than its rim at least."""


@dataclass(frozen=True, eq=False)
class FilmPlane:
    """From pixels of a scan to millimetres on the film.

    Parameters
    ----------
    values, covariance : ndarray (9,), (9, 9)
        Eight of a projective transformation, and the radial distortion at half the scan's longer side.
    centre, unit : ndarray (2,), float
        Of the pixel coordinates: the scan's middle, half its longer side.
    at : ndarray (n, 2)
        Where edges of perforations were found, pixels.
    rms_px : float
        What they differ from the plane.
    """

    values: Array
    covariance: Array
    centre: Array
    unit: float
    at: Array
    rms_px: float

    @property
    def edges(self) -> int:
        """How many edges were found."""
        return len(self.at)

    def to_mm(self, xy: Array) -> Array:
        """Places on the film (n, 2), mm, of pixels (n, 2)."""
        return _plane(self.values, (xy - self.centre) / self.unit)

    def apart(self, first: Array, second: Array) -> tuple[float, float]:
        """Mean distance along the film of two edges, mm, and its standard deviation by the plane alone.

        Both are points (n, 2), pixels; they are compared where they have the same places across the film.
        """

        def distance(values: Array) -> float:
            a, b = (_plane(values, (xy - self.centre) / self.unit) for xy in (first, second))
            a, b = a[np.argsort(a[:, 0])], b[np.argsort(b[:, 0])]
            across = np.linspace(max(a[0, 0], b[0, 0]), min(a[-1, 0], b[-1, 0]), 50)
            return float(np.mean(np.interp(across, *b.T) - np.interp(across, *a.T)))

        step = np.sqrt(np.diag(self.covariance))
        slope = np.array([distance(self.values + e) - distance(self.values - e) for e in np.diag(step)])
        slope /= 2 * np.maximum(step, 1e-300)
        return distance(self.values), float(np.sqrt(slope @ self.covariance @ slope))


def _plane(x: Array, place: Array) -> Array:
    undistorted = place * (1 + x[8] * (place**2).sum(axis=1, keepdims=True))
    along = undistorted @ np.array([[x[0], x[3]], [x[1], x[4]]]) + [x[2], x[5]]
    return np.asarray(along / (1 + undistorted @ x[6:8])[:, None])


def film_plane(
    scan: Scan, rows: Sequence[Array], count: int, *, channel: int = 2, reach: float = 12.0
) -> FilmPlane | Failure:
    """Measure two rows of perforations and the plane in which they lie.

    Parameters
    ----------
    scan : Scan
        The scan; perforations brighter than their rims, film from top to bottom.
    rows : sequence of two ndarray (4,)
        Left, top, right and bottom of the first perforation of the left and of the right row, then the
        approximate pitch, pixels: (5,).
    count : int
        Perforations in a row.
    channel : int
        Which channel; that in which rims are darkest is the blue one.
    reach : float
        Pixels by which their approximate edges may be off.
    """
    places, axes, targets, signs = [], [], [], []
    for side, (left, top, right, bottom, pitch) in zip((-1, 1), rows, strict=True):
        for i in range(count):
            box = np.array([left, top + i * pitch, right, bottom + i * pitch])
            for k, xy in _sides_of(scan, box, channel, reach):
                places.append(xy)
                axes.append(1 - k % 2)
                targets.append(i * PITCH_MM if k % 2 == 0 else side * _ROWS_MM / 2)
                signs.append((-1, 1, 1, -1)[k])
    if len(places) < _LEAST:
        return Failure(
            f"{len(places)} edges of perforations are seen, and {_LEAST} are needed", Code.NOT_FOUND
        )
    centre = (np.array([scan.width, scan.height]) - 1) / 2
    unit = max(scan.width, scan.height) / 2
    xy, axis, sign = (np.array(places) - centre) / unit, np.array(axes), np.array(signs)
    pitch_px = float(np.mean([row[4] for row in rows]))
    scale = PITCH_MM / pitch_px

    def function(x: Array) -> Array:
        at = _plane(x, xy)[np.arange(len(xy)), axis]
        return np.asarray(at - sign * x[9 + (1 - axis)] / 2)

    start = np.array([unit * scale, 0, 0, 0, unit * scale, 0, 0, 0, 0, *_SIZE_MM])
    start[5] = -float(np.median((xy * start[0])[axis == 1, 1] - np.array(targets)[axis == 1]))
    names = [*"abcdefghk", "height", "width"]
    problem = GaussMarkov(
        function, np.array(targets), np.full(len(xy), 0.5 * scale), Parameters(names, start)
    )
    found = robust(problem, "tukey")
    if isinstance(found, Failure):
        return found
    fit = found.adjustment
    rms = float(np.sqrt(np.mean(fit.residuals**2))) / scale
    return FilmPlane(fit.values[:9], fit.covariance[:9, :9], centre, unit, np.array(places), rms)


def edge_of(scan: Scan, start: Array, stop: Array, channel: int, reach: float = 24.0) -> Array | None:
    """Points (50, 2) of the line along which film ends near another one, the picture at its right as seen.

    `start` and `stop` are pixels (2,); film is darker, and is looked at for twice the `reach` beyond.
    """
    band = read_band(scan, start, stop, 3 * reach, 3 * reach)
    found = measure_profiles(band, channel, 1, reach, reach)
    if found is None:
        return None
    good = found.good
    line = robust_line(found.place[good], found.offset[good], found.sigma[good], 0.05)
    if line is None:
        return None
    (first, last, bow), _ = line
    t = np.linspace(-0.9, 0.9, 50)
    offset = (first * (1 - t) + last * (1 + t)) / 2 - bow * (1 - t**2)
    return np.asarray(start + (stop - start) * ((t + 1) / 2)[:, None] + offset[:, None] * band.normal)


def _sides_of(scan: Scan, box: Array, channel: int, reach: float) -> list[tuple[int, Array]]:
    """Middles of the straight parts of a perforation's sides: upper, right, lower, left; those seen."""
    corners = box[[[0, 1], [2, 1], [2, 3], [0, 3]]].astype(np.float64)
    found = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        middle, half = (a + b) / 2, (b - a) * _STRAIGHT / 2
        band = read_band(scan, middle - half, middle + half, reach + _RIM_PX, reach + _RIM_PX)
        offset = _step(band.grey[:, :, channel].astype(np.float64), band.distance, reach)
        if offset is not None:
            found.append((k, middle + offset * band.normal))
    return found


def _step(grey: Array, distance: Array, reach: float) -> float | None:
    """Where the rim of a perforation steps to the light in it: one profile of a side's many columns."""
    if not np.isfinite(grey).all():
        return None
    low, count = -reach - _RIM_PX, 2 * int(reach + _RIM_PX)
    tones = np.median(binned(grey, distance, low, 1.0, count), axis=0)
    rise = np.where(np.isfinite(tones), tones, np.nanmedian(tones))
    rise = rise[2:] - rise[:-2]
    inner = slice(int(_RIM_PX), int(_RIM_PX + 2 * reach))
    at = low + 1.5 + inner.start + int(np.argmax(rise[inner]))
    used = (distance > at - _ASIDE) & (distance < at + 2 * _ASIDE)
    light, rim = np.nanmax(tones), tones[int(at - low) - 3 : int(at - low)].min()
    start = np.array([[at, rim, np.log(_BLUR_PX), light - rim, 0.0]])
    fit = adjust_batch(
        profile_function(distance[used][None]),
        start,
        grey[used][None],
        prior=(start, np.array([_ASIDE, light - rim, 0.5, light - rim, 0.05 * (light - rim)])),
        options=BatchOptions(max_iterations=15, share=0.01),
    )
    offset, contrast = fit.estimates[0, [0, 3]]
    seen = fit.reasons[0] <= 1 and contrast > _LEAST_CONTRAST and abs(offset - at) < _ASIDE
    return float(offset) if seen else None
