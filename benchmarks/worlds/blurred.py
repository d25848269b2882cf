"""Blurred photographs of targets, drawn with the rays of batoid.

A double Gauss of six elements, focused in front of or behind a target. For thousands of points of the
entrance pupil, rays from a grid of points on the target's plane are traced by batoid; where they arrive
gives, as polynomials, the point of the target that each place of the sensor sees through that point of the
pupil. The share of the pupil through which a place sees the target is its light. Nothing is shared with the
project: neither rays, nor indices, nor the formation of images.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import batoid
import numba
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

__all__ = [
    "ROWS",
    "SELLMEIER",
    "WAVELENGTHS",
    "WEIGHTS",
    "Lens",
    "Target",
    "add_shares",
    "energy_diameter",
    "light",
    "noisy",
    "smoothed",
    "spiral",
]

Array = NDArray[Any]

WAVELENGTHS = (486.1, 546.1, 632.8)
WEIGHTS = (0.3, 1.0, 0.6)
SCALE = 0.25
"""Of the prescription with a focal length of 100 mm."""
ROWS: tuple[tuple[float, float, str], ...] = (
    (0.01779284094091543, 8.75, "N-SSK2"),
    (0.006566600536925569, 0.5, ""),
    (0.02653743294670983, 12.5, "N-SK2"),
    (0.0, 3.8, "F5"),
    (0.04126892878570084, 16.36944492653564, ""),
    (0.0, 13.74795696388906, "stop"),
    (-0.03523942654429074, 3.8, "F5"),
    (0.0, 11.0, "N-SK16"),
    (-0.02636750828657709, 0.5, ""),
    (0.005636604951748545, 7.0, "N-SK16"),
    (-0.0125926458590576, 61.4875364179821, ""),
)
"""Curvature, distance to the next surface, glass; of a double Gauss f/2 for 100 mm."""
SELLMEIER = {
    "N-SSK2": (1.4306027, 0.153150554, 1.01390904, 0.00823982975, 0.0333736841, 106.870822),
    "N-SK2": (1.28189012, 0.257738258, 0.96818604, 0.0072719164, 0.0242823527, 110.377773),
    "F5": (1.3104463, 0.19603426, 0.96612977, 0.00958633048, 0.0457627627, 115.011883),
    "N-SK16": (1.34317774, 0.241144399, 0.994317969, 0.00704687339, 0.0229005, 92.7508526),
}
"""B1, B2, B3, C1, C2, C3 (µm²) as published by Schott."""


@dataclass(frozen=True)
class Target:
    """A target: shape, diameter or side (mm), place, and axes of its plane, in camera axes."""

    shape: str
    size: float
    centre: Array
    axes: Array


class Lens:
    """The lens in batoid, in millimetres, focused at a distance.

    Parameters
    ----------
    stop_radius : float
        mm.
    image_z : float
        Place of the image plane behind the first surface, mm.
    pitch_mm : float
    principal : (float, float)
        Pixel on the axis.
    """

    def __init__(
        self, stop_radius: float, image_z: float, pitch_mm: float, principal: tuple[float, float]
    ) -> None:
        self.pitch, self.principal, self.stop_radius = pitch_mm, np.array(principal), stop_radius
        items, z, medium = [], 0.0, batoid.ConstMedium(1.0)
        self.stop_z = 0.0
        for k, (curvature, distance, name) in enumerate(ROWS):
            place = batoid.CoordSys(np.array([0.0, 0.0, z]))
            surface = batoid.Plane() if curvature == 0 else batoid.Sphere(SCALE / curvature)
            if name == "stop":
                self.stop_z = z
                behind = medium
                stop = batoid.ObscNegation(batoid.ObscCircle(stop_radius))
                items.append(batoid.Baffle(surface, name="stop", coordSys=place, obscuration=stop))
            else:
                behind = batoid.SellmeierMedium(SELLMEIER[name]) if name else batoid.ConstMedium(1.0)
                items.append(
                    batoid.RefractiveInterface(
                        surface, name=f"s{k}", coordSys=place, inMedium=medium, outMedium=behind
                    )
                )
            medium, z = behind, z + distance * SCALE
        place = batoid.CoordSys(np.array([0.0, 0.0, image_z]))
        items.append(
            batoid.Detector(batoid.Plane(), name="image", coordSys=place, inMedium=medium, outMedium=medium)
        )
        self.optic = batoid.CompoundOptic(items, inMedium=batoid.ConstMedium(1.0), outMedium=medium)
        self.pupil_z, self.pupil_radius = self._entrance_pupil()

    def _entrance_pupil(self) -> tuple[float, float]:
        """Place and radius of the entrance pupil, from rays near the axis."""

        def at_stop(height: float, slope: float) -> float:
            rays = self._traced(
                np.array([[0.0, height - 50 * slope, -50.0]]), np.array([[0.0, slope, 1.0]]), 550.0, "stop"
            )
            return float(rays.y[0])

        h = 1e-3
        a, b = at_stop(h, 0.0) / h, at_stop(0.0, h) / h
        return -(-b / a), self.stop_radius / a

    def _traced(self, xyz: Array, direction: Array, wavelength_nm: float, until: str | None = None) -> Any:
        away = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        count = np.zeros(len(xyz))
        rays = batoid.RayVector(
            *xyz.T.copy(), *away.T.copy(), count, np.full(len(xyz), wavelength_nm * 1e-9), count + 1
        )
        items = self.optic.items
        if until is not None:
            names = [item.name for item in items]
            items = items[: names.index(until) + 1]
        for item in items:
            item.trace(rays)
        return rays

    def arrive(self, points: Array, pupil: Array, wavelength_nm: float, *, stopped: bool = True) -> Array:
        """Pixels (n, 2) of rays from points (n, 3), in camera axes, through points (n, 2) of the pupil.

        NaN where the stop stops them.
        """
        start = points * [1.0, -1.0, -1.0] + [0.0, 0.0, self.pupil_z]
        through = np.concatenate([pupil, np.full((len(pupil), 1), self.pupil_z)], axis=1)
        rays = self._traced(start, through - start, wavelength_nm)
        good = ~rays.failed & (~rays.vignetted | (not stopped))
        xy = np.stack([-rays.x, rays.y], axis=1) / self.pitch + self.principal
        return np.where(good[:, None], xy, np.nan)

    def at_stop(self, points: Array, pupil: Array, wavelength_nm: float) -> Array:
        """Where rays from points (n, 3) through the pupil (n, 2) pass the stop (n, 2), in its radii."""
        start = points * [1.0, -1.0, -1.0] + [0.0, 0.0, self.pupil_z]
        through = np.concatenate([pupil, np.full((len(pupil), 1), self.pupil_z)], axis=1)
        rays = self._traced(start, through - start, wavelength_nm, "stop")
        return np.stack([rays.x, rays.y], axis=1) / self.stop_radius

    def principal_ray(self, point: Array, wavelength_nm: float) -> Array:
        """Pixel of the ray from a point (3,) through the centre of the stop."""
        start = point * [1.0, -1.0, -1.0] + [0.0, 0.0, self.pupil_z]
        at, h = np.zeros(2), 1e-4
        for _ in range(12):
            through = np.array(
                [[*at, self.pupil_z], [at[0] + h, at[1], self.pupil_z], [at[0], at[1] + h, self.pupil_z]]
            )
            rays = self._traced(np.tile(start, (3, 1)), through - start, wavelength_nm, "stop")
            hit = np.stack([rays.x, rays.y], axis=1)
            at = at - np.linalg.solve(((hit[1:] - hit[0]) / h).T, hit[0])
        return self.arrive(point[None], at[None], wavelength_nm)[0]

    def pupil_points(
        self, point: Array, wavelength_nm: float, count: int, beyond: float = 1.0
    ) -> tuple[Array, Array]:
        """Points (n, 2) of the entrance pupil whose rays from a point (3,) fill the stop, and areas (n,).

        They fill the stop to `beyond` of its radius. At the stop they lie on Fibonacci's spiral. The points
        of the pupil are a polynomial of those at the stop, fitted to rays.
        """
        k = np.arange(400) + 0.5
        wide = 1.08 * self.pupil_radius * np.sqrt(k / len(k))[:, None] * spiral(k)
        for _ in range(2):  # the second time about the principal ray
            at_stop = self.at_stop(np.tile(point, (len(k), 1)), wide, wavelength_nm)
            fit = np.linalg.lstsq(_terms(at_stop)[0], wide, rcond=None)[0]
            wide = _terms(1.08 * np.sqrt(k / len(k))[:, None] * spiral(k))[0] @ fit
        k = np.arange(count) + 0.5
        terms, by_x, by_y = _terms(beyond * np.sqrt(k / count)[:, None] * spiral(k))
        dx, dy = by_x @ fit, by_y @ fit
        return terms @ fit, np.abs(dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0])


def spiral(k: Array) -> Array:
    """Unit vectors (n, 2) of Fibonacci's spiral: radii of the root of (k + ½) / n fill a disk evenly."""
    angle = k * np.pi * (3 - np.sqrt(5))
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _terms(xy: Array, degree: int = 7) -> tuple[Array, Array, Array]:
    """Terms (n, t) of a polynomial, and their derivatives by x and y."""
    x, y = xy.T
    powers = _powers(degree)
    terms = np.stack([x**i * y**j for i, j in powers], axis=1)
    by_x = np.stack([i * x ** max(i - 1, 0) * y**j for i, j in powers], axis=1)
    by_y = np.stack([j * x**i * y ** max(j - 1, 0) for i, j in powers], axis=1)
    return terms, by_x, by_y


def _powers(degree: int) -> list[tuple[int, int]]:
    """Powers of x and y in the terms of a polynomial."""
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


_SECOND = [_powers(2).index(power) for power in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))]
"""Terms of the second degree in the order of the maps: 1, x, y, x², xy, y²."""


def energy_diameter(lens: Lens, point: Array, share: float = 0.8) -> float:
    """Diameter in pixels that contains a share of the light of a point (3,), about its centroid."""
    spots = []
    for w in WAVELENGTHS:
        pupil, _ = lens.pupil_points(point, w, 400)
        spots.append(lens.arrive(np.tile(point, (len(pupil), 1)), 0.9999 * pupil, w))
    weight = np.concatenate([np.full(len(s), w) for s, w in zip(spots, WEIGHTS, strict=True)])
    xy = np.concatenate(spots)
    good = np.isfinite(xy[:, 0])
    xy, weight = xy[good], weight[good]
    away = np.hypot(*(xy - np.average(xy, axis=0, weights=weight)).T)
    order = np.argsort(away)
    inside = np.cumsum(weight[order]) / weight.sum()
    return 2 * float(away[order][np.searchsorted(inside, share)])


def add_shares(
    image: Array, maps: Array, places: Array, low: Array, side: int, square: bool, half: float, weights: Array
) -> None:
    """Add, to every sample, the weights of the points of the pupil through which it sees the target.

    Parameters
    ----------
    image : ndarray (r, c)
        Samples, `side` per pixel.
    maps : ndarray (p, 2 or 4, 6)
        Polynomials of the second degree from places of the sensor to those of the target's plane, and to
        those of the stop, in its radii; without the latter, no ray is stopped.
    places : ndarray (p, n, 2)
        Places of the sensor between which the target lies.
    low : ndarray (2,)
        Upper left corner of the samples.
    half : float
        Radius, or half the side, of the target.
    """
    if maps.shape[1] == 2:
        maps = np.concatenate([maps, np.zeros_like(maps)], axis=1)
    # A sequence that fills the square evenly: the average of places within samples is their centre.
    jitter = (0.5 + np.arange(len(maps))[:, None] * np.array([0.7548776662, 0.5698402910])) % 1.0
    size = np.array(image.shape[::-1])
    first = np.clip(np.floor((places.min(axis=1) - low) * side).astype(int) - 1, 0, size)
    last = np.clip(np.ceil((places.max(axis=1) - low) * side).astype(int) + 1, 0, size)
    _add(image, maps, first, last, low, 1 / side, square, half, weights, jitter)


@numba.njit(cache=True, fastmath=True)
def _add(
    image: Any,
    maps: Any,
    first: Any,
    last: Any,
    low: Any,
    step: float,
    square: bool,
    half: float,
    weights: Any,
    jitter: Any,
) -> None:
    h2 = half * half
    for p in range(len(maps)):
        w, left = weights[p], low[0] + jitter[p, 0] * step
        for r in range(first[p, 1], last[p, 1]):
            y = low[1] + (r + jitter[p, 1]) * step
            m = maps[p]
            a0, a1, a2 = m[0, 0] + y * (m[0, 2] + y * m[0, 5]), m[0, 1] + y * m[0, 4], m[0, 3]
            b0, b1, b2 = m[1, 0] + y * (m[1, 2] + y * m[1, 5]), m[1, 1] + y * m[1, 4], m[1, 3]
            d0, d1, d2 = m[2, 0] + y * (m[2, 2] + y * m[2, 5]), m[2, 1] + y * m[2, 4], m[2, 3]
            e0, e1, e2 = m[3, 0] + y * (m[3, 2] + y * m[3, 5]), m[3, 1] + y * m[3, 4], m[3, 3]
            row = image[r]
            # Without branches, so that several samples are computed at once.
            if square:
                for c in range(first[p, 0], last[p, 0]):
                    x = left + c * step
                    u, v = a0 + x * (a1 + x * a2), b0 + x * (b1 + x * b2)
                    s, t = d0 + x * (d1 + x * d2), e0 + x * (e1 + x * e2)
                    seen = (u * u <= h2) & (v * v <= h2) & (s * s + t * t <= 1.0)
                    row[c] += w if seen else 0.0
            else:
                for c in range(first[p, 0], last[p, 0]):
                    x = left + c * step
                    u, v = a0 + x * (a1 + x * a2), b0 + x * (b1 + x * b2)
                    s, t = d0 + x * (d1 + x * d2), e0 + x * (e1 + x * e2)
                    seen = (u * u + v * v <= h2) & (s * s + t * t <= 1.0)
                    row[c] += w if seen else 0.0


def light(
    lens: Lens,
    target: Target,
    columns: Array,
    rows: Array,
    sigma: float,
    count: int = 9000,
) -> Array:
    """Share (r, c) of the light of each pixel that the target takes.

    Parameters
    ----------
    columns, rows : ndarray
        Adjacent pixels.
    sigma : float
        Of an additional Gaussian point-spread function, pixels.
    count : int
        Points of the entrance pupil.
    """
    side = 4 if len(columns) < 50 else 3
    grid = 0.75 * target.size * np.array([[u, v] for u in (-1, 0, 1) for v in (-1, 0, 1)])
    points = target.centre + grid @ target.axes.T
    normal = np.cross(*target.axes.T)
    maps, weights, places = [], [], []
    for weight, wavelength in zip(WEIGHTS, WAVELENGTHS, strict=True):
        # Beyond the edge of the stop: rays of other points of the target pass it elsewhere.
        pupil, area = lens.pupil_points(target.centre, wavelength, count // len(WAVELENGTHS), 1.03)
        rays = np.repeat(points, len(pupil), axis=0), np.tile(pupil, (9, 1)), wavelength
        xy = lens.arrive(*rays, stopped=False).reshape(9, len(pupil), 2)
        hit = lens.at_stop(*rays).reshape(9, len(pupil), 2)
        # What each place of the sensor sees, relative to the middle of the window for the sake of the digits.
        x, y = xy[..., 0].T - columns.mean(), xy[..., 1].T - rows.mean()
        places.append(np.stack([x, y], axis=-1))
        terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
        turned = np.swapaxes(terms, 1, 2)
        seen = np.concatenate([np.broadcast_to(grid, (len(pupil), 9, 2)), np.swapaxes(hit, 0, 1)], axis=2)
        maps.append(np.swapaxes(np.linalg.solve(turned @ terms, turned @ seen), 1, 2))
        through = np.concatenate([pupil, np.zeros((len(pupil), 1))], axis=1) * [1.0, -1.0, 1.0]
        away = through - target.centre
        emitted = area * np.abs(away[:, 2] * (away @ normal)) / np.linalg.norm(away, axis=1) ** 4
        # What a place of the sensor receives of it: by the area of the target that it sees, at its centre.
        (u, v), one, none = (x[:, 4], y[:, 4]), np.ones(len(x)), np.zeros(len(x))
        slopes = np.stack([[none, one, none, 2 * u, v, none], [none, none, one, none, u, 2 * v]])
        by_x, by_y = np.einsum("dtp,pct->dpc", slopes, maps[-1][:, :2])
        weights.append(weight * emitted * np.abs(by_x[:, 0] * by_y[:, 1] - by_x[:, 1] * by_y[:, 0]))
    low = np.array([columns[0] - columns.mean() - 0.5, rows[0] - rows.mean() - 0.5])
    margin = int(np.ceil(5 * sigma)) + 1
    samples = np.zeros(((len(rows) + 2 * margin) * side, (len(columns) + 2 * margin) * side))
    seen, share, where = np.concatenate(maps), np.concatenate(weights), np.concatenate(places)
    add_shares(samples, seen, where, low - margin, side, target.shape == "square", target.size / 2, share)
    # What a ground that fills the field would send: the light falls off towards the edge of the field.
    y, x = (low[k] - margin + (np.arange(samples.shape[1 - k]) + 0.5) / side for k in (1, 0))
    at = np.stack(np.meshgrid(*(np.linspace(v.min(), v.max(), 9) for v in (x, y))), axis=-1).reshape(-1, 2)
    stop = np.einsum("pct,nt->cpn", seen[:, 2:], _terms(at, 2)[0][:, _SECOND])
    fit = np.linalg.lstsq(_terms(at, 2)[0], share @ (np.hypot(*stop) <= 1), rcond=None)[0]
    ground = sum(c * x**i * y[:, None] ** j for c, (i, j) in zip(fit, _powers(2), strict=True))
    return smoothed(samples / ground, side, sigma, margin)


def smoothed(samples: Array, side: int, sigma: float, margin: int) -> Array:
    """Pixels of samples, `side` per pixel, after a Gaussian of sigma pixels; without a margin of pixels."""
    samples = gaussian_filter(samples, sigma * side, truncate=5)
    r, c = (n // side for n in samples.shape)
    return np.asarray(samples.reshape(r, side, c, side).mean(axis=(1, 3))[margin:-margin, margin:-margin])


def noisy(image: Array, contrast: float, decibels: float, rng: np.random.Generator) -> Array:
    """8-bit grey values with photon, read and quantisation noise, in all `decibels` below the contrast."""
    sigma = contrast * 10 ** (-decibels / 20)
    rest = max(sigma**2 - 1 / 12, 0.0)
    gain = 0.5 * rest / float(np.median(image))
    electrons = rng.poisson(image / gain) if gain > 0 else image
    values = electrons * gain + rng.normal(0.0, np.sqrt(0.5 * rest), image.shape)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
