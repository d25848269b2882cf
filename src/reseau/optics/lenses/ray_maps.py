"""Maps of rays: from points of the object through points of the stop to pixels, by a lens that is known.

Points of the object are in camera axes: x right, y down, z along the view, millimetres, origin at the
projection centre.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np

from ...core.data import Array, Mask
from ...core.errors import UsageError
from ..mapping import PlaneMapping
from .paraxial import Paraxial
from .prescription import Aperture, Prescription
from .pupils import Aiming, PupilElements
from .trace import Tracer

_DEGREE = 8
"""Of the polynomials of where rays pass an aperture, by where they pass the stop."""
_RADII = 9
"""Places along a radius of the stop at which edges of apertures are looked for."""
_STEPS = 12
"""Bisections towards such an edge."""
_POWERS = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]


def _nodes() -> Array:
    """Points (n, 2) of the stop from which polynomials are fitted: rings, dense at the rim."""
    found = [np.zeros((1, 2))]
    for k in range(6):
        count = 8 + 3 * (5 - k)
        angle = 2 * np.pi * (np.arange(count) + 0.5 * (k % 2)) / count
        found.append(np.cos(np.pi * k / 12) * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.concatenate(found)


_NODES = _nodes()
_DESIGN = np.stack([_NODES[:, 0] ** i * _NODES[:, 1] ** j for i, j in _POWERS], axis=1)
_FIT = np.linalg.pinv(_DESIGN)


class Vignetting:
    """The open part of the stop of a lens at one wavelength.

    Parameters
    ----------
    lens : Prescription
    aiming : Aiming
        What aims rays at its stop, at the same wavelength.
    wavelength_nm : float, optional
        By default that of the corresponding rays.

    Examples
    --------
    A rim in front of the stop cuts it from below for points below the axis:

    >>> from dataclasses import replace
    >>> from reseau.optics.lenses import AIR, Aperture, glass, in_order
    >>> first, *rest = in_order([(0.02, 5.0, glass("N-BK7")), (-0.02, 9.0, AIR), (0.0, 40.0, AIR)])
    >>> rim = replace(first, apertures=(Aperture("circle", (5.0, 0.0)),))
    >>> lens = Prescription((rim, *rest), stop=2, stop_radius=3.0)
    >>> up_and_down = np.array([[0.0, 1.0], [0.0, -1.0]])
    >>> edges = Vignetting(lens, Aiming(lens)).edges(np.array([[0.0, -60.0, -200.0]]), up_and_down)
    >>> edges[1].round(2)
    array([[1.  , 0.16]])
    """

    def __init__(self, lens: Prescription, aiming: Aiming, wavelength_nm: float | None = None) -> None:
        self._aiming, self._tracer = aiming, Tracer(lens, wavelength_nm, apertures=False)
        self._apertures = [(k, each) for k, surface in enumerate(lens.surfaces) for each in surface.apertures]

    def edges(self, points: Array, directions: Array) -> tuple[Array, Array]:
        """Inner and outer radius (n, e) of the open part of the stop, in its radii.

        Parameters
        ----------
        points : ndarray (n, 3)
            Points of the object in the axes of the lens.
        directions : ndarray (e, 2)
            Unit vectors in the stop. Where no light passes along one, both radii are 0.
        """
        shape = len(points), len(directions)
        rays = self._aiming(np.repeat(points, len(_NODES), axis=0), np.tile(_NODES, (len(points), 1))).rays
        traced = self._tracer.trace(rays, seen=True)
        lost = (~traced.arrived).reshape(len(points), len(_NODES))
        assert traced.seen is not None
        # Of a polynomial of both coordinates of the stop, one of the radius along each direction.
        turns = np.zeros((len(_POWERS), len(directions), _DEGREE + 1))
        for term, (i, j) in enumerate(_POWERS):
            turns[term, :, i + j] = directions[:, 0] ** i * directions[:, 1] ** j
        limiting: list[Aperture] = []
        fits: list[Array] = []
        for k, aperture in self._apertures:
            at = traced.seen[k][:, :2].reshape(*lost.shape, 2)
            fit = np.tensordot(_fitted(at, lost), turns, 1).reshape(2, -1, _DEGREE + 1)
            at_rim = aperture.passes(*fit.sum(axis=2))
            if not (at_rim.all() and (lost | aperture.passes(at[..., 0], at[..., 1])).all()):
                limiting.append(aperture)
                fits.append(np.moveaxis(fit, 2, 0))
        if not limiting:
            return np.zeros(shape), np.ones(shape)
        along = np.stack(fits, axis=2)
        radii = np.linspace(0, 1, _RADII)
        opened = np.stack([_passes(limiting, along, radius) for radius in radii], axis=1)
        some = opened.any(axis=1)
        ends = opened.argmax(axis=1), _RADII - 1 - opened[:, ::-1].argmax(axis=1)
        found = []
        for edge, step, whole in zip(ends, (-1, 1), (0, _RADII - 1), strict=True):
            radius, cut = np.where(some, radii[edge], 0.0), np.flatnonzero(some & (edge != whole))
            inside, outside, those = radii[edge[cut]], radii[edge[cut] + step], along[..., cut]
            for _ in range(_STEPS):
                middle = (inside + outside) / 2
                there = _passes(limiting, those, middle)
                inside, outside = np.where(there, middle, inside), np.where(there, outside, middle)
            radius[cut] = inside
            found.append(radius.reshape(shape))
        return found[0], found[1]


def _fitted(values: Array, lost: Mask) -> Array:
    """Coefficients (2, n, t) of polynomials through points (n, nodes, 2), some of which are lost."""
    found = np.einsum("tp,npx->xnt", _FIT, np.where(lost[..., None], 0.0, values))
    for k in np.flatnonzero(lost.any(axis=1)):
        found[:, k] = np.linalg.lstsq(_DESIGN[~lost[k]], values[k, ~lost[k]], rcond=1e-6)[0].T
    return np.asarray(found)


def _passes(apertures: list[Aperture], along: Array, radius: Array) -> Mask:
    """Whether all apertures let light pass at radii (m,), by polynomials (degree, 2, a, m) of the radius."""
    at = along[-1]
    for coefficients in along[-2::-1]:
        at = at * radius + coefficients
    passed = [aperture.passes(*at[:, k]) for k, aperture in enumerate(apertures)]
    return np.asarray(np.logical_and.reduce(passed))


_GOLDEN = np.pi * (3 - np.sqrt(5.0))


class RayMap(Protocol):
    """What forms images by rays: a lens whose design is known, or a stand-in.

    Examples
    --------
    >>> from reseau.optics.lenses import ThinLens
    >>> camera: RayMap = ThinLens(50.0, 25.0, 51.0, SensorPlane((0.005, 0.005), (999.5, 749.5)))
    >>> camera.corresponding(np.array([[0.0, 0.0, 2000.0]])).round(3)
    array([[999.5, 749.5]])
    """

    @property
    def unknown(self) -> float:
        """Standard deviation of where corresponding rays lie in a blurred image, in parts of its blur.

        Of the form of the image, which follows from a design; a stand-in knows it to a part only.
        """

    def corresponding(self, points: Array) -> Array:
        """Pixels (n, 2) of the corresponding rays of points (n, 3): principal rays of one wavelength."""

    def spots(self, points: Array, elements: PupilElements) -> tuple[Array, Array]:
        """Pixels (w, n, e, 2) of rays from points (n, 3), at w wavelengths, through e elements of the stop.

        Besides, the light (w, n, e, 3) that each carries, as a vector along the ray in camera axes: 0 where
        it is stopped. Its product with the normal of a surface is what a part of this surface of diffuse
        remission (Lambert's law) emits into the ray. A pixel is NaN where there is no ray.
        """


class ByRays(ABC):
    """A map of single rays as a :class:`RayMap`."""

    @property
    def unknown(self) -> float:
        """See :class:`RayMap`; of a design, nothing."""
        return 0.0

    @property
    @abstractmethod
    def wavelengths(self) -> tuple[tuple[float, float], ...]:
        """Wavelengths in nm with their weights."""

    @property
    @abstractmethod
    def wavelength_nm(self) -> float:
        """Wavelength of the corresponding rays."""

    @abstractmethod
    def rays(self, points: Array, pupil: Array, wavelength_nm: float) -> tuple[Array, Array]:
        """Pixels (n, 2) and light (n, 3) of rays from points (n, 3) through points (n, 2) of the stop."""

    def open_part(self, points: Array, pupil: Array, wavelength_nm: float) -> tuple[Array, Array]:
        """Points (n, e, 2) of the open part of the stop for points (e, 2) of it all, and areas (n, e)."""
        return np.broadcast_to(pupil, (len(points), *pupil.shape)), np.ones((len(points), len(pupil)))

    def corresponding(self, points: Array) -> Array:
        """See :class:`RayMap`."""
        return self.rays(points, np.zeros((len(points), 2)), self.wavelength_nm)[0]

    def spots(self, points: Array, elements: PupilElements) -> tuple[Array, Array]:
        """See :class:`RayMap`."""
        shape = len(points), len(elements.xy)
        starts = np.repeat(points, shape[1], axis=0)
        xy, light = [], []
        for k, (wavelength, weight) in enumerate(self.wavelengths):
            # Other points of the stop for each wavelength: the spots of all together are denser.
            turned = elements.turned(k * _GOLDEN).xy
            through, area = self.open_part(points, turned, wavelength)
            arrived, carried = self.rays(starts, through.reshape(-1, 2), wavelength)
            xy.append(arrived.reshape(*shape, 2))
            shares = elements.weights * weight * area
            light.append(carried.reshape(*shape, 3) * shares[..., None])
        return np.stack(xy), np.stack(light)


@dataclass(frozen=True)
class SensorPlane:
    """The raster of the sensor on the image surface of a lens.

    Parameters
    ----------
    pitch_mm : (float, float)
    principal_px : (float, float)
        Pixel at which the z axis of the image surface pierces the sensor.
    rotation : float
        Rotation of the rows against the x axis, radians.

    Examples
    --------
    >>> SensorPlane((0.01, 0.01), (100.0, 80.0)).to_pixels(np.array([[-0.5, 0.25]]))
    array([[150., 105.]])
    """

    pitch_mm: tuple[float, float]
    principal_px: tuple[float, float]
    rotation: float = 0.0

    def __post_init__(self) -> None:
        if not min(self.pitch_mm) > 0:
            raise UsageError(f"{self.pitch_mm} mm is not the pitch of pixels")

    @property
    def matrix(self) -> Array:
        """Pixels per millimetre on the image surface: the image is upside down, and rows count downwards."""
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        turned: Array = (
            np.diag(1 / np.array(self.pitch_mm)) @ np.array([[c, s], [-s, c]]) @ np.diag([-1.0, 1.0])
        )
        return turned

    def to_pixels(self, xy: Array) -> Array:
        """Pixels of points (n, 2) on the image surface, in mm."""
        return np.asarray(xy @ self.matrix.T + self.principal_px)


_UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])
"""From camera axes to those of a lens: light travels against the view."""


@dataclass(frozen=True, eq=False)
class LensCamera(ByRays):
    """A camera whose lens is known.

    The transformation from camera axes to those of the lens is that of Meid 1992, section 3.1.3: a rotation,
    and the place of the projection centre in the lens.

    Parameters
    ----------
    lens : Prescription
    sensor : SensorPlane
    rotation : ndarray (3, 3)
        From camera axes to the axes of the lens; by default the view is the optical axis.
    centre : ndarray (3,), optional
        Projection centre in the axes of the lens; by default the centre of the entrance pupil.

    Examples
    --------
    >>> from reseau.optics.lenses import AIR, Prescription, glass, in_order
    >>> rows = [(0.02, 5.0, glass("N-BK7")), (-0.02, 3.0, AIR), (0.0, 44.5, AIR)]
    >>> lens = Prescription(in_order(rows), stop=2, stop_radius=4.0)
    >>> camera = LensCamera(lens, SensorPlane((0.005, 0.005), (999.5, 749.5)))
    >>> camera.rays(np.array([[0.0, 50.0, 1000.0]]), np.zeros((1, 2)), 550.0)[0].round(1)
    array([[ 999.5, 1241.6]])
    """

    lens: Prescription
    sensor: SensorPlane
    rotation: Array = field(default_factory=lambda: _UPSIDE_DOWN.copy())
    centre: Array | None = None

    @property
    def wavelengths(self) -> tuple[tuple[float, float], ...]:
        """Those of the lens."""
        return tuple(zip(self.lens.wavelengths_nm, self.lens.weights, strict=True))

    @property
    def wavelength_nm(self) -> float:
        """That of the lens."""
        return self.lens.wavelength_nm

    @cached_property
    def projection_centre(self) -> Array:
        """Projection centre (3,) in the axes of the lens."""
        if self.centre is not None:
            return self.centre
        position = Paraxial(self.lens).entrance_pupil[0]
        if not np.isfinite(position):
            raise UsageError(
                "is telecentric: it has no projection centre", where=self.lens.name, do="give `centre`"
            )
        front = self.lens.surfaces[0]
        return np.asarray(front.vertex + position * front.axes[:, 2])

    @cached_property
    def _ready(self) -> dict[float, tuple[Aiming, Tracer, Tracer | None, Vignetting | None]]:
        """By wavelength: what aims rays, traces them, and, where it has apertures, stops them."""
        return {}

    def _at(self, wavelength_nm: float) -> tuple[Aiming, Tracer, Tracer | None, Vignetting | None]:
        if wavelength_nm not in self._ready:
            aiming = Aiming(self.lens, wavelength_nm)
            limited = any(surface.apertures for surface in self.lens.surfaces)
            self._ready[wavelength_nm] = (
                aiming,
                Tracer(self.lens, wavelength_nm, apertures=False),
                Tracer(self.lens, wavelength_nm) if limited else None,
                Vignetting(self.lens, aiming, wavelength_nm) if limited else None,
            )
        return self._ready[wavelength_nm]

    def open_part(self, points: Array, pupil: Array, wavelength_nm: float) -> tuple[Array, Array]:
        """See :class:`Vignetting`."""
        part = self._at(wavelength_nm)[3]
        if part is None:
            return super().open_part(points, pupil, wavelength_nm)
        radius = np.hypot(*pupil.T)
        along = np.where(radius[:, None] > 0, pupil, [1.0, 0.0]) / np.where(radius > 0, radius, 1.0)[:, None]
        inner, outer = part.edges(points @ self.rotation.T + self.projection_centre, along)
        area = outer**2 - inner**2
        return np.sqrt(inner**2 + area * radius**2)[..., None] * along, area

    def why_dark(self, point: Array) -> str:
        """Why no light of a point (3,) reaches the sensor, by its principal ray."""
        aiming, tracer, limits, _ = self._at(self.wavelength_nm)
        local = point[None] @ self.rotation.T + self.projection_centre
        reason = aiming.why(local[0])
        if reason is not None:
            return reason
        tracer = limits or tracer
        lost = int(tracer.trace(aiming(local, np.zeros((1, 2))).rays).lost[0])
        return f"its principal ray {tracer.reason(lost)}" if lost else "apertures stop it"

    def rays(self, points: Array, pupil: Array, wavelength_nm: float) -> tuple[Array, Array]:
        """Rays by ray tracing."""
        aiming, tracer, limits, _ = self._at(wavelength_nm)
        aimed = aiming(points @ self.rotation.T + self.projection_centre, pupil)
        free, weight = tracer.trace(aimed.rays), aimed.solid_angle
        if limits is not None:
            weight = weight * limits.trace(aimed.rays).arrived
        flux = np.where(free.arrived, weight, 0.0)[:, None] * np.nan_to_num(aimed.rays.directions)
        return self.sensor.to_pixels(free.xy), flux @ self.rotation


@dataclass(frozen=True, eq=False)
class CalibratedLens:
    """A lens whose images lie where a calibrated camera has them.

    A calibration knows principal distance, principal point and distortion, also one that is not symmetric,
    better than the design of the lens (Meid 1992, section 3.1.3). Places of images, and with them their
    distortion, are those of the calibration; the rays around each place are those of the lens.

    Parameters
    ----------
    camera : RayMap
    mapping : PlaneMapping
        From directions X/Z, Y/Z to pixels.
    directions : callable, optional
        From points (n, 3) to directions (n, 2); those behind windows are not X/Z, Y/Z.

    Examples
    --------
    >>> from reseau.optics import Brown, PixelGrid
    >>> from reseau.optics.lenses import ThinLens
    >>> from reseau.optics.lenses.ray_maps import SensorPlane
    >>> thin = ThinLens(50.0, 12.5, 52.0, SensorPlane((0.01, 0.01), (49.5, 49.5)))
    >>> calibrated = Brown(side="object", grid=PixelGrid(100, 100, (0.01, 0.01))).with_values({"c": 52.5})
    >>> CalibratedLens(thin, calibrated).corresponding(np.array([[1.0, 0.0, 1000.0]]))
    array([[54.75, 49.5 ]])
    """

    camera: RayMap
    mapping: PlaneMapping
    directions: Callable[[Array], Array] | None = None

    @property
    def unknown(self) -> float:
        """See :class:`RayMap`."""
        return self.camera.unknown

    def corresponding(self, points: Array) -> Array:
        """See :class:`RayMap`."""
        if (points[:, 2] <= 0).any():
            raise UsageError("a point of the object lies behind the lens")
        uv = points[:, :2] / points[:, 2:] if self.directions is None else self.directions(points)
        return np.asarray(self.mapping(uv))

    def spots(self, points: Array, elements: PupilElements) -> tuple[Array, Array]:
        """See :class:`RayMap`."""
        xy, light = self.camera.spots(points, elements)
        return xy + (self.corresponding(points) - self.camera.corresponding(points))[:, None], light
