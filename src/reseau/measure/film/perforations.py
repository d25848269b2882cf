"""The plane of 35 mm film in a scan, from its perforations.

Perforations are punched every 4.75 mm on both sides of the film, so accurately that they define its scale
(ISO 2906, SMPTE 139: pitch 4.75 mm, rows 28.17 mm apart). Their edges are measured like those of a frame.
From their positions a projective transformation (tilted copying camera) and the radial distortion of the lens
are estimated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...adjust import GaussMarkov, Parameters, adjust_batch
from ...adjust.batch import BatchOptions
from ...adjust.outliers import robust
from ...core.data import Array
from ...core.failure import Code, Failure
from ...core.overlaid import Overlaid
from ...io.scans import Scan
from .border import binned, read_band
from .edges import measure_profiles
from .lines import robust_line
from .steps import profile_function

if TYPE_CHECKING:
    from ...core.overlay import Layer


PITCH_MM = 4.75
"""Distance between perforations."""
ROWS_MM = 28.17
"""Distance between the centre lines of the two rows of perforations."""
_SIZE_MM = 1.98, 2.79
"""Approximate height and width of a perforation; both are estimated."""
_STRAIGHT = 0.45
"""Share of a perforation's side between its rounded corners."""
_LEAST = 20
"""Minimum number of edges for the plane."""
_RIM_PX = 10.0
"""Width examined outside a perforation; its rim is a dark line a few pixels wide."""
_ASIDE, _BLUR_PX = 4.0, 2.0
"""Range of the fit around the steepest place of a step, and approximate width of the step."""
_LEAST_CONTRAST = 8.0
"""Minimum difference in grey values between a perforation and its rim."""


@dataclass(frozen=True, eq=False)
class FilmPlane(Overlaid):
    """Transformation from pixels of a scan to millimetres on the film.

    Parameters
    ----------
    values, covariance : ndarray (9,), (9, 9)
        Eight parameters of a projectivity, and the radial distortion at half the scan's longer side.
    centre, unit : ndarray (2,), float
        Normalization of the pixel coordinates: centre of the scan, half its longer side.
    at : ndarray (n, 2)
        Positions of the edges of perforations, pixels.
    rms_px : float
        Rms of the residuals.

    Examples
    --------
    >>> values = np.array([15.0, 0.0, 0.0, 0.0, 15.0, 0.0, 0.0, 0.0, 0.0])
    >>> centre = np.array([100.0, 80.0])
    >>> plane = FilmPlane(values, np.zeros((9, 9)), centre, 100.0, np.zeros((24, 2)), rms_px=0.02)
    >>> plane.to_mm(np.array([[100.0, 80.0], [200.0, 80.0]])).tolist(), plane.edges
    ([[0.0, 0.0], [15.0, 0.0]], 24)
    """

    values: Array
    covariance: Array
    centre: Array
    unit: float
    at: Array
    rms_px: float

    @property
    def edges(self) -> int:
        """Number of edges found."""
        return len(self.at)

    def layers(self) -> list[Layer]:
        """What is drawn over the scan: the edges of the perforations."""
        from ...core.overlay import Layer

        return [Layer(f"edges, {self.edges}", self.at, symbol="|")]

    def _heading(self) -> str:
        return f"edges of perforations, rms {self.rms_px:.2g} px"

    def to_mm(self, xy: Array) -> Array:
        """Film coordinates (n, 2) in mm of pixels (n, 2)."""
        return _plane(self.values, (xy - self.centre) / self.unit)

    def apart(self, first: Array, second: Array) -> tuple[float, float]:
        """Mean distance of two edges along the film in mm, and its standard deviation from the plane alone.

        Both edges are points (n, 2) in pixels; they are compared at the same positions across the film.
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
    """Measure two rows of perforations and the film plane.

    Parameters
    ----------
    scan : Scan
        The scan; perforations brighter than their rims, film from top to bottom.
    rows : sequence of two ndarray (4,)
        Left, top, right and bottom of the first perforation of the left and of the right row, then the
        approximate pitch, all in pixels: (5,).
    count : int
        Number of perforations in a row.
    channel : int
        Index of the channel; rims are usually darkest in the blue one.
    reach : float
        Largest error of the approximate edges, pixels.

    Returns
    -------
    FilmPlane or Failure
        A failure if too few edges of perforations are found.

    Examples
    --------
    Six perforations on each side, 30 px apart:

    >>> from reseau.io.scans import scan_of
    >>> from reseau.optics.formation import draw, rectangles
    >>> scale = 30 / PITCH_MM
    >>> centres = np.array([(x, y) for x in (25.3, 25.3 + 28.17 * scale) for y in range(25, 205, 30)])
    >>> half = np.array([2.79, 1.98]) / 2 * scale
    >>> boxes = np.hstack([centres - half, centres + half])
    >>> light, rim = (draw(rectangles(boxes + grow, 0.5), (205, 228), 1.0) for grow in (0, [-3, -3, 3, 3]))
    >>> grey = 80 + 150 * light - 60 * rim + np.random.default_rng(0).normal(0, 2, light.shape)
    >>> rows = [np.array([*boxes[k] + 0.7, 30.0]) for k in (0, 6)]
    >>> plane = film_plane(scan_of(grey.astype(np.uint8)), rows, 6, channel=0, reach=3.0)
    >>> plane.edges, np.diff(plane.to_mm(centres[[0, 6]]), axis=0).round(1)
    (48, array([[28.2,  0. ]]))
    """
    places, axes, targets, signs = [], [], [], []
    for side, (left, top, right, bottom, pitch) in zip((-1, 1), rows, strict=True):
        for i in range(count):
            box = np.array([left, top + i * pitch, right, bottom + i * pitch])
            for k, xy in _sides_of(scan, box, channel, reach):
                places.append(xy)
                axes.append(1 - k % 2)
                targets.append(i * PITCH_MM if k % 2 == 0 else side * ROWS_MM / 2)
                signs.append((-1, 1, 1, -1)[k])
    if len(places) < _LEAST:
        return Failure(
            f"{len(places)} edges of perforations were found, and {_LEAST} are needed", Code.NOT_FOUND
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
    """Points (50, 2) of an edge of a frame near another one, with the picture on its right as seen.

    `start` and `stop` are pixels (2,); film is darker, and is searched up to twice the `reach` beyond.

    Examples
    --------
    >>> from reseau.io.scans import scan_of
    >>> from reseau.optics.formation import draw, rectangles
    >>> light = draw(rectangles(np.array([[20.2, -20.0, 80.0, 60.0]]), 0.5), (40, 60), 1.0)
    >>> grey = 50 + 100 * light + np.random.default_rng(0).normal(0, 1, light.shape)
    >>> start, stop = np.array([21.0, 36.0]), np.array([21.0, 4.0])
    >>> edge_of(scan_of(grey.astype(np.uint8)), start, stop, channel=0, reach=5.0).mean(axis=0).round(1)
    array([20.2, 20. ])
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
    """Centres of the straight parts of a perforation's sides that are visible: upper, right, lower, left."""
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
    """Position of the step from the rim of a perforation to its light, in the mean profile of a side."""
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
