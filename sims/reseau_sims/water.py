"""A camera in a housing under water: its port, the water, and the exact rays through both.

Rays are traced forwards from the camera by Snell's law in vectors, and a two-dimensional Newton iteration
aims them at the object points. It shares nothing with :mod:`reseau.optics.refraction`, and knows more: the
surfaces of the port are bent to a paraboloid and not quite parallel, the index of the water follows its
temperature, and the light is not of one colour.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np

from reseau.core.data import Array, Mask
from reseau.core.errors import UsageError
from reseau.optics import rotation_matrix
from reseau.optics.lenses.media import Water as WaterMedium

_GLASS = 1.5195, -5.0e-5
"""Index of the glass at 546 nm, and its change per nm."""
_GREEN_NM = 546.0
_AIR = 1.0
_WIDEST = 0.9
"""Largest sine of the angle of a ray to the normal of the port; rays beyond are far outside of any frame."""
_STEPS, _FOUND_MM, _DIFFERENCE = 40, 1e-8, 1e-5
_BENT_AT_MM = 30.0
SIGMAS = {"distance": 0.5, "thickness": 0.05, "tilt": 5e-3, "curvature": 5e-6, "water": 1e-4}
"""How well the description of a port is known: mm, mm, tangents, 1/mm, and the index of the water."""


class Directions(NamedTuple):
    """Where a camera sees points: ideal directions (n, 2), their derivatives by the points (n, 2, 3), and
    whether the ray was found (n,); others are turned towards their points, outside of any frame."""

    xy: Array
    d_point: Array
    found: Mask


@dataclass(frozen=True)
class Water:
    """A plane port on the camera, and water behind it.

    Parameters
    ----------
    distance_mm : float
        Distance of the inner surface of the port from the projection centre, along its normal.
    thickness_mm : float
        Thickness of the glass.
    tilt_deg : (float, float)
        Rotations of the port about the x- and the y-axis of the camera.
    bend_um : float
        Sag of both surfaces 30 mm from the middle of the port.
    wedge_arcsec : float
        Angle between the surfaces of the port.
    temperature_c : float
        Temperature of the water.
    colour_nm : float
        Mean wavelength of the light.
    width_nm : float
        Half of the light is of wavelengths longer than the mean by this, half of shorter ones. They are
        refracted differently, a blur that grows towards the edges of the frame.

    Raises
    ------
    UsageError
        If a length is not positive.

    Examples
    --------
    The image of a point is farther from the centre than it would be in air:

    >>> seen = Water().directions(np.array([[300.0, 0.0, 1000.0]]))
    >>> seen.xy.round(3), bool(seen.found.all())
    (array([[0.406, 0.   ]]), True)
    """

    distance_mm: float = 60.0
    thickness_mm: float = 12.0
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    bend_um: float = 0.0
    wedge_arcsec: float = 0.0
    temperature_c: float = 18.0
    colour_nm: float = 546.0
    width_nm: float = 15.0

    def __post_init__(self) -> None:
        for name in ("distance_mm", "thickness_mm"):
            if not getattr(self, name) > 0:
                raise UsageError(f"{getattr(self, name):g} is not positive", where=name)
        if not max(map(abs, self.tilt_deg)) < 20:
            raise UsageError("is not less than 20°", where="tilt_deg")

    def made(self, rng: np.random.Generator) -> Self:
        """Return the port as made and mounted: it differs from this design by its tolerances."""
        off = rng.normal(0.0, 1.0, 7).tolist()
        tilt = float(np.rad2deg(SIGMAS["tilt"]))
        return type(self)(
            self.distance_mm + SIGMAS["distance"] * off[0],
            self.thickness_mm + SIGMAS["thickness"] * off[1],
            (self.tilt_deg[0] + tilt * off[2], self.tilt_deg[1] + tilt * off[3]),
            self.bend_um + 1.0 * off[4],
            self.wedge_arcsec + 5.0 * off[5],
            self.temperature_c + 0.5 * off[6],
            self.colour_nm,
            self.width_nm,
        )

    @property
    def index(self) -> float:
        """Index of the water at the mean wavelength."""
        return self.indices(self.colour_nm)[1]

    @property
    def colours(self) -> tuple[float, ...]:
        """Wavelengths (nm) of equal shares of the light."""
        w = self.width_nm
        return (self.colour_nm - w, self.colour_nm + w) if w else (self.colour_nm,)

    def toml(self, instrument: str = "camera") -> str:
        """Return the description of port and water for an instrument of a ``bench.toml``."""
        x, y = np.tan(np.deg2rad(self.tilt_deg)).tolist()
        d, t = self.distance_mm, self.thickness_mm
        glass, water = self.indices(self.colour_nm)
        port = f"instruments.{instrument}.refraction"
        # The normal, the z-axis, turned about y leans towards x, and turned about x away from y.
        return f"""
[{port}.media]
air = {_AIR}
glass = {glass:.6f}
water = {{index = {water:.6f}, free = true, sigma = {SIGMAS["water"]}}}

[[{port}.windows]]
id = "port"
shape = "plane"
on = "camera"
media = ["air", "glass", "water"]
parameters = {{tilt_X = {y:.6f}, tilt_Y = {-x:.6f}, distance = {d:.3f}, thickness = {t:.3f}}}
free = ["tilt_X", "tilt_Y", "distance", "curvature"]

[{port}.windows.sigma]
tilt_X = {SIGMAS["tilt"]}
tilt_Y = {SIGMAS["tilt"]}
distance = {SIGMAS["distance"]}
curvature = {SIGMAS["curvature"]}
"""

    def directions(self, points: Array, colour_nm: float | None = None) -> Directions:
        """Return the directions in which the camera sees points of its system (n, 3), z along the view.

        Parameters
        ----------
        points : ndarray (n, 3)
            Points (mm).
        colour_nm : float, optional
            Wavelength; by default the mean one.
        """
        index = self.indices(colour_nm or self.colour_nm)
        turn = rotation_matrix(np.deg2rad(np.array([*self.tilt_deg, 0.0])))
        # The system of the port: its normal is z.
        aim = points @ turn
        behind = aim[:, 2] > self.distance_mm + self.thickness_mm
        # Towards the point from where a straight ray would leave the port.
        through = aim[:, :2] * (1 - (self.distance_mm + self.thickness_mm) / np.maximum(aim[:, 2:], 1.0))
        deep = aim[:, 2] - self.distance_mm - self.thickness_mm
        sine = _limited(index[1] * through / np.hypot(np.hypot(*through.T), deep)[:, None])
        off = self._hit(sine, aim[:, 2], index)[0] - aim[:, :2]
        for _ in range(_STEPS):
            rest = np.flatnonzero(behind & (np.abs(off).max(axis=1) > _FOUND_MM))
            s, z = sine[rest], aim[rest, 2]
            trial = _limited(s - _solved(self._slope(s, z, index), off[rest]))
            if not (trial != s).any():
                break
            sine[rest], off[rest] = trial, self._hit(trial, z, index)[0] - aim[rest, :2]
        found = behind & (np.abs(off).max(axis=1) <= _FOUND_MM)
        # By the implicit function theorem: the last segment passes the point.
        slope, last = self._slope(sine, aim[:, 2], index), self._hit(sine, aim[:, 2], index)[1]
        inverse = np.linalg.inv(slope)
        d_aim = np.concatenate([inverse, -inverse @ last[:, :, None]], axis=2)
        up = np.sqrt(1 - (sine**2).sum(axis=1))
        d_up = -sine / up[:, None]
        ray = np.column_stack([sine, up]) @ turn.T
        d_ray = turn[:, :2] + turn[:, 2:] * d_up[:, None, :]
        xy = ray[:, :2] / ray[:, 2:]
        d_xy = (d_ray[:, :2] - xy[:, :, None] * d_ray[:, 2:]) / ray[:, 2, None, None]
        return Directions(xy, d_xy @ d_aim @ turn.T, found)

    def indices(self, colour_nm: float) -> tuple[float, float]:
        """Indices of glass and water at a wavelength."""
        glass = _GLASS[0] + _GLASS[1] * (colour_nm - _GREEN_NM)
        return glass, WaterMedium(self.temperature_c).index(colour_nm)

    def _slope(self, sine: Array, z: Array, index: tuple[float, float]) -> Array:
        """Derivatives (n, 2, 2) of the point that a ray hits, by central differences."""
        columns = []
        for k in range(2):
            step = _DIFFERENCE * np.eye(2)[k]
            ahead, back = self._hit(sine + step, z, index)[0], self._hit(sine - step, z, index)[0]
            columns.append((ahead - back) / (2 * _DIFFERENCE))
        return np.stack(columns, axis=2)

    def _hit(self, sine: Array, z: Array, index: tuple[float, float]) -> tuple[Array, Array]:
        """Trace rays from the camera; where they pass the heights z (n, 2), and their slope there (n, 2)."""
        u, v = sine.T
        w, before = np.sqrt(1 - u * u - v * v), _AIR
        x = y = h = np.zeros(len(u))
        k = 2e-3 * self.bend_um / _BENT_AT_MM**2
        wedge = np.deg2rad(self.wedge_arcsec / 3600)
        for height, lean, behind in (
            (self.distance_mm, 0.0, index[0]),
            (self.distance_mm + self.thickness_mm, wedge, index[1]),
        ):
            # The surface is z = height + lean·x + k (x² + y²)/2.
            a = 0.5 * k * (u * u + v * v)
            b = w - k * (x * u + y * v) - lean * u
            c = height + lean * x + 0.5 * k * (x * x + y * y) - h
            # The root that does not vanish with the curvature.
            far = 2 * c / (b + np.sqrt(b * b - 4 * a * c))
            x, y, h = x + far * u, y + far * v, h + far * w
            p, q = -lean - k * x, -k * y
            size = np.sqrt(1 + p * p + q * q)
            p, q, r = p / size, q / size, 1 / size
            ratio, cosine = before / behind, p * u + q * v + r * w
            more = np.sqrt(1 - ratio**2 * (1 - cosine * cosine)) - ratio * cosine
            u, v, w, before = ratio * u + more * p, ratio * v + more * q, ratio * w + more * r, behind
        slope = np.stack([u / w, v / w], axis=1)
        return np.stack([x, y], axis=1) + (z - h)[:, None] * slope, slope


def _solved(matrix: Array, right: Array) -> Array:
    """Solutions (n, 2) of systems of two equations."""
    (a, b), (c, d) = matrix.transpose(1, 2, 0)
    e, f = right.T
    solved: Array = np.stack([d * e - b * f, a * f - c * e], axis=1) / (a * d - b * c)[:, None]
    return solved


def _limited(sine: Array) -> Array:
    size = np.linalg.norm(sine, axis=1)[:, None]
    return np.asarray(sine * np.minimum(1.0, _WIDEST / np.maximum(size, 1e-300)))
