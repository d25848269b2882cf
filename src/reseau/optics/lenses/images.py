r"""Images of plane targets formed by rays: blurred by defocus, aberrations and colour.

A pupil element of one wavelength forms a sharp image of the target, displaced and distorted; the image is the
sum of these over the elements of the stop and the wavelengths (Meid 1992, section 3.1.4; Herzberger 1947).
The outline of each is mapped by rays, so that the sum is one outline integral
(:mod:`reseau.optics.formation`): the limit of infinitely small elements of the target, integrated over
pixels, without sampling in the image plane. Within a target the rays of an element are mapped with a
polynomial of second degree through nine traced points.

Points of the object are in camera axes: x right, y down, z along the view, millimetres, origin at the
projection centre.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from ...core.data import Array
from ...core.errors import UsageError
from ..formation import Outline
from ..gridded import GriddedOutline
from ..mapping import PlaneMapping
from .paraxial import Paraxial
from .prescription import Prescription
from .pupils import Aiming, PupilElements
from .trace import Tracer

__all__ = [
    "AberratedLens",
    "CalibratedLens",
    "LensCamera",
    "PlaneTarget",
    "RayImage",
    "RayMap",
    "RaySurrogate",
    "SensorPlane",
    "ThinLens",
    "counted_image",
    "ray_image",
]

_GRID = np.array([[u, v] for u in (-1.0, 0.0, 1.0) for v in (-1.0, 0.0, 1.0)])


def _powers(uv: Array) -> Array:
    """Terms (n, 6) of a polynomial of second degree."""
    u, v = uv[..., 0], uv[..., 1]
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


_GOLDEN = np.pi * (3 - np.sqrt(5.0))
_FIT = np.linalg.pinv(_powers(_GRID))


class RayMap(Protocol):
    """What forms images by rays: a lens whose design is known, a surrogate of it, or a stand-in.

    Examples
    --------
    >>> camera: RayMap = ThinLens(50.0, 25.0, 51.0, SensorPlane((0.005, 0.005), (999.5, 749.5)))
    >>> camera.corresponding(np.array([[0.0, 0.0, 2000.0]])).round(3)
    array([[999.5, 749.5]])
    """

    def corresponding(self, points: Array) -> Array:
        """Pixels (n, 2) of the corresponding rays of points (n, 3): principal rays of one wavelength."""

    def spots(self, points: Array, elements: PupilElements) -> tuple[Array, Array]:
        """Pixels (w, n, e, 2) of rays from points (n, 3), at w wavelengths, through e elements of the stop.

        Besides, the light (w, n, e, 3) that each carries, as a vector along the ray in camera axes: 0 where
        it is stopped. Its product with the normal of a surface is what a part of this surface of diffuse
        remission (Lambert's law) emits into the ray. A pixel is NaN where there is no ray.
        """


class _ByRays(ABC):
    """A map of single rays as a :class:`RayMap`."""

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
            through = np.tile(elements.turned(k * _GOLDEN).xy, (shape[0], 1))
            arrived, carried = self.rays(starts, through, wavelength)
            xy.append(arrived.reshape(*shape, 2))
            light.append(carried.reshape(*shape, 3) * (elements.weights * weight)[:, None])
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
class LensCamera(_ByRays):
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
    def _ready(self) -> dict[float, tuple[Aiming, Tracer, Tracer | None]]:
        """By wavelength: what aims rays, traces them, and traces them with apertures, where it has any."""
        return {}

    def _at(self, wavelength_nm: float) -> tuple[Aiming, Tracer, Tracer | None]:
        if wavelength_nm not in self._ready:
            limited = any(surface.apertures for surface in self.lens.surfaces)
            self._ready[wavelength_nm] = (
                Aiming(self.lens, wavelength_nm),
                Tracer(self.lens, wavelength_nm, apertures=False),
                Tracer(self.lens, wavelength_nm) if limited else None,
            )
        return self._ready[wavelength_nm]

    def why_dark(self, point: Array) -> str:
        """Why no light of a point (3,) reaches the sensor, by its principal ray."""
        aiming, tracer, limits = self._at(self.wavelength_nm)
        local = point[None] @ self.rotation.T + self.projection_centre
        reason = aiming.why(local[0])
        if reason is not None:
            return reason
        tracer = limits or tracer
        lost = int(tracer.trace(aiming(local, np.zeros((1, 2))).rays).lost[0])
        return f"its principal ray {tracer.reason(lost)}" if lost else "apertures stop it"

    def rays(self, points: Array, pupil: Array, wavelength_nm: float) -> tuple[Array, Array]:
        """Rays by ray tracing."""
        aiming, tracer, limits = self._at(wavelength_nm)
        aimed = aiming(points @ self.rotation.T + self.projection_centre, pupil)
        free, weight = tracer.trace(aimed.rays), aimed.solid_angle
        if limits is not None:
            weight = weight * limits.trace(aimed.rays).arrived
        flux = np.where(free.arrived, weight, 0.0)[:, None] * np.nan_to_num(aimed.rays.directions)
        return self.sensor.to_pixels(free.xy), flux @ self.rotation


@dataclass(frozen=True)
class ThinLens(_ByRays):
    """Stand-in for a lens whose design is not known: one thin lens without aberrations, its stop at the lens.

    Parameters
    ----------
    focal_length : float
        mm.
    diameter : float
        Diameter of the entrance pupil, mm.
    image_distance : float
        Distance of the sensor from the lens, mm.
    sensor : SensorPlane

    Examples
    --------
    The blur of a point at a distance of 1 m, with the lens focused at infinity: D f / Z = 0.625 mm.

    >>> camera = ThinLens(50.0, 12.5, 50.0, SensorPlane((0.01, 0.01), (0.0, 0.0)))
    >>> edges = camera.rays(np.array([[0.0, 0.0, 1000.0]] * 2), np.array([[-1.0, 0], [1, 0]]), 550.0)[0]
    >>> round(float(abs(edges[1, 0] - edges[0, 0])), 3)
    62.5
    """

    focal_length: float
    diameter: float
    image_distance: float
    sensor: SensorPlane
    colours: tuple[tuple[float, float], ...] = ((550.0, 1.0),)

    @property
    def wavelength_nm(self) -> float:
        """The first one."""
        return self.colours[0][0]

    @property
    def wavelengths(self) -> tuple[tuple[float, float], ...]:
        """All; without dispersion they differ in nothing."""
        return self.colours

    def rays(self, points: Array, pupil: Array, wavelength_nm: float) -> tuple[Array, Array]:
        """Rays in the geometry of a thin lens."""
        x, y, depth = points.T
        if (depth <= 0).any():
            raise UsageError("a point of the object lies behind the lens")
        c, at = self.image_distance, 0.5 * self.diameter * pupil
        # In the axes of the lens; the image of a point lies at f z / (z - f), through which its rays pass.
        defocus = 1 - c * (1 / self.focal_length - 1 / depth)
        xy = np.stack([-c * x / depth, c * y / depth], axis=1) + at * defocus[:, None]
        away = np.stack([at[:, 0] - x, -at[:, 1] - y, -depth], axis=1)
        # The area of an element over the square of its distance, seen obliquely.
        return self.sensor.to_pixels(xy), away * (depth / (away**2).sum(axis=1) ** 2)[:, None]


@dataclass(frozen=True)
class AberratedLens(ThinLens):
    r"""Stand-in for a lens whose design is not known: pupil and aberrations are parameters.

    To the rays of a thin lens it adds the aberrations of third order (Welford 1986, section 8.4): with the
    point :math:`\rho` of the stop in its radii, and the place h of the image in units of `field_mm`, a ray
    arrives beside its place by

    .. math:: S_1\rho^2\rho + S_2(2(\rho h)\rho + \rho^2 h) + S_3(\rho h)h + S_4h^2\rho + S_5h^2h ,

    where the S are millimetres at the edge of the stop and of the field. A term :math:`\rho^4\rho` is that of
    fifth order. The parameters can be estimated from the images of targets
    (:func:`reseau.measure.blurred.estimate_optics`).

    Parameters
    ----------
    field_mm : float
        Distance from the axis for which the coefficients are given.
    spherical, coma, astigmatism, curvature, distortion : float
        :math:`S_1` to :math:`S_5`, mm.
    spherical_5 : float
        Of fifth order, mm.
    narrowing : float
        Share of its width that the pupil loses towards the edge of the field, along the radius.
    colour : float
        Defocus at the edge of the stop, mm, where the wavelength is shorter by a tenth than the first one;
        proportional to the difference.

    Examples
    --------
    Coma: the mean of a ring of rays is beside the principal ray by twice the coefficient.

    >>> lens = AberratedLens(50.0, 12.5, 50.0, SensorPlane((0.01, 0.01), (0.0, 0.0)), coma=0.01)
    >>> ring = np.stack([np.cos(np.arange(8) * np.pi / 4), np.sin(np.arange(8) * np.pi / 4)], axis=1)
    >>> rays = lens.rays(np.array([[-2e5, 0.0, 1e6]] * 9), np.concatenate([ring, np.zeros((1, 2))]), 550.0)[0]
    >>> (rays[:8].mean(axis=0) - rays[8]).round(6) + 0.0
    array([-2.,  0.])
    """

    field_mm: float = 10.0
    spherical: float = 0.0
    coma: float = 0.0
    astigmatism: float = 0.0
    curvature: float = 0.0
    distortion: float = 0.0
    spherical_5: float = 0.0
    narrowing: float = 0.0
    colour: float = 0.0

    def rays(self, points: Array, pupil: Array, wavelength_nm: float) -> tuple[Array, Array]:
        """Rays of a thin lens with aberrations."""
        field = points[:, :2] * [-self.image_distance, self.image_distance] / points[:, 2:] / self.field_mm
        square = (field**2).sum(axis=1, keepdims=True)
        pupil = pupil - 0.5 * self.narrowing * (pupil * field).sum(axis=1, keepdims=True) * field
        xy, light = super().rays(points, pupil, wavelength_nm)
        across, radius = (pupil * field).sum(axis=1, keepdims=True), (pupil**2).sum(axis=1, keepdims=True)
        shorter = 10 * (1 - wavelength_nm / self.wavelength_nm)
        sideways = self.astigmatism * across + self.distortion * square
        wide = self.spherical * radius + self.spherical_5 * radius**2 + self.curvature * square
        aside = (
            (wide + self.colour * shorter) * pupil
            + self.coma * (2 * across * pupil + radius * field)
            + sideways * field
        )
        return xy + aside @ self.sensor.matrix.T, light


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

    Examples
    --------
    >>> from reseau.optics import Brown, PixelGrid
    >>> from reseau.optics.lenses import SensorPlane
    >>> thin = ThinLens(50.0, 12.5, 52.0, SensorPlane((0.01, 0.01), (49.5, 49.5)))
    >>> calibrated = Brown(side="object", grid=PixelGrid(100, 100, (0.01, 0.01))).with_values({"c": 52.5})
    >>> CalibratedLens(thin, calibrated).corresponding(np.array([[1.0, 0.0, 1000.0]]))
    array([[54.75, 49.5 ]])
    """

    camera: RayMap
    mapping: PlaneMapping

    def corresponding(self, points: Array) -> Array:
        """See :class:`RayMap`."""
        if (points[:, 2] <= 0).any():
            raise UsageError("a point of the object lies behind the lens")
        return np.asarray(self.mapping(points[:, :2] / points[:, 2:]))

    def spots(self, points: Array, elements: PupilElements) -> tuple[Array, Array]:
        """See :class:`RayMap`."""
        xy, light = self.camera.spots(points, elements)
        return xy + (self.corresponding(points) - self.camera.corresponding(points))[:, None], light


@dataclass(frozen=True, eq=False)
class PlaneTarget:
    """A plane target in space.

    Parameters
    ----------
    centre : ndarray (3,)
        Its point, in camera axes, mm.
    axes : ndarray (3, 2)
        Unit vectors of the plane, in columns, in camera axes.
    outline : Outline
        Outline (j, 2) about its point, mm; see :func:`reseau.optics.formation.mark_outline`.

    Examples
    --------
    >>> disk = PlaneTarget(np.array([0.0, 0, 500]), np.eye(3)[:, :2], Outline.circle(4.0, 0.2))
    >>> round(disk.extent, 1), disk.points(np.array([[1.0, 0.0]]))
    (4.0, array([[  1.,   0., 500.]]))
    """

    centre: Array
    axes: Array
    outline: Outline

    @cached_property
    def extent(self) -> float:
        """Half the side of a square around the target, mm."""
        return float(np.abs(self.outline.xy).max())

    @property
    def normal(self) -> Array:
        """Unit vector (3,) across the plane."""
        return np.asarray(np.cross(self.axes[:, 0], self.axes[:, 1]))

    def points(self, uv: Array) -> Array:
        """Points (n, 3) in camera axes of points (n, 2) of the plane."""
        return np.asarray(self.centre + uv @ self.axes.T)


@dataclass(frozen=True, eq=False)
class RayImage:
    """Image of a target by rays.

    Parameters
    ----------
    outline : Outline
        Nodes (j, 2) in pixels from the corresponding point; their tangents contain the light of each element,
        so that the image of a target without losses has the light 1 inside.
    point : ndarray (2,)
        Pixel of the corresponding ray: the principal ray, in one wavelength, of the target's point.
    blur : float
        Root mean square distance of rays of one point from their mean, pixels.

    Examples
    --------
    >>> image = RayImage(Outline.circle(3.0, 0.5), np.array([10.0, 20.0]), 0.0)
    >>> bool(np.abs(image.centroid).max() < 1e-12)
    True
    """

    outline: Outline
    point: Array
    blur: float

    @cached_property
    def gridded(self) -> GriddedOutline:
        """The outline, gridded for the formation of images."""
        return GriddedOutline.of(self.outline)

    @property
    def centroid(self) -> Array:
        """Centre of density, in pixels from the corresponding point."""
        (x, y), (dx, dy) = self.outline.xy.T, self.outline.dxy.T
        area = 0.5 * (x * dy - y * dx).sum()
        return np.asarray(np.array([0.5 * (x * x * dy).sum(), -0.5 * (y * y * dx).sum()]) / area)


def ray_image(camera: RayMap, target: PlaneTarget, elements: PupilElements) -> RayImage:
    """Form the image of a target.

    Parameters
    ----------
    camera : RayMap
    target : PlaneTarget
    elements : PupilElements
        Elements of the stop, used for each wavelength.

    Raises
    ------
    UsageError
        When no light of the target reaches the sensor.

    Examples
    --------
    >>> camera = ThinLens(50.0, 12.5, 52.0, SensorPlane((0.01, 0.01), (0.0, 0.0)))
    >>> disk = PlaneTarget(np.array([0.0, 0, 1000]), np.eye(3)[:, :2], Outline.circle(4.0, 0.2))
    >>> image = ray_image(camera, disk, PupilElements.gauss(6))
    >>> bool(np.abs(image.centroid).max() < 1e-9), round(image.blur, 1)
    (True, 5.3)
    """
    xy, light = camera.spots(target.points(target.extent * _GRID), elements)
    point = camera.corresponding(target.centre[None])[0]
    usable = np.asarray(np.isfinite(xy).all(axis=(1, 3)))
    maps = np.einsum("tg,wgex->wetx", _FIT, np.where(usable[:, None, :, None], xy, 0.0))
    emitted = np.abs(light.mean(axis=1) @ target.normal)
    coefficients, share = maps.reshape(-1, 6, 2), np.where(usable, emitted, 0.0).ravel()
    if not (share.sum() > 0 and np.isfinite(point).all()):
        lens = camera.camera if isinstance(camera, CalibratedLens) else camera
        why = lens.why_dark(target.centre) if isinstance(lens, LensCamera) else "it is not in the field"
        raise UsageError(f"no light of the target reaches the sensor: {why}")
    # Elements without light remain, as points: images with other parameters have the same nodes.
    coefficients[share == 0] = 0.0
    coefficients[share == 0, 0] = point
    return _assembled(coefficients, share / share.sum(), target, point)


def _assembled(coefficients: Array, share: Array, target: PlaneTarget, point: Array) -> RayImage:
    """Outline of an image from the mappings (m, 6, 2) of the elements and their light (m,)."""
    uv = target.outline.xy / target.extent
    xy = _powers(uv) @ coefficients
    (u, v), none, one = uv.T, np.zeros(len(uv)), np.ones(len(uv))
    by_u = np.stack([none, one, none, 2 * u, v, none], axis=1) @ coefficients
    by_v = np.stack([none, none, one, none, u, 2 * v], axis=1) @ coefficients
    du, dv = target.outline.dxy.T[:, None, :, None] / target.extent
    dxy = (by_u * du + by_v * dv) * share[:, None, None]
    outline = Outline((xy - point).reshape(-1, 2), dxy.reshape(-1, 2)).oriented()
    spot = coefficients[:, 0]
    away = spot - share @ spot
    return RayImage(outline, point, float(np.sqrt(share @ (away**2).sum(axis=1))))


def counted_image(
    camera: RayMap, target: PlaneTarget, elements: PupilElements, side: int, columns: Array, rows: Array
) -> Array:
    """Image of a target by counting rays in the pixels, as Meid 1992, section 3.1.4, describes it.

    For comparison with :func:`ray_image`; it needs millions of rays.

    Parameters
    ----------
    camera, target, elements
        As for :func:`ray_image`.
    side : int
        Number of elements of the target along the side of the square around it.
    columns, rows : ndarray (c,), (r,)
        Adjacent pixels.

    Returns
    -------
    ndarray (r, c)
        Light in the pixels; their sum is 1 if all light of the target falls into them.

    Examples
    --------
    >>> camera = ThinLens(50.0, 12.5, 52.0, SensorPlane((0.01, 0.01), (0.0, 0.0)))
    >>> disk = PlaneTarget(np.array([0.0, 0, 1000]), np.eye(3)[:, :2], Outline.circle(2.0, 0.2))
    >>> pixels = np.arange(-20.0, 21.0)
    >>> image = counted_image(camera, disk, PupilElements.equal_areas(3), 20, pixels, pixels)
    >>> round(float(image.sum()), 6)
    1.0
    """
    from matplotlib.path import Path

    middle = (np.arange(side) + 0.5) * 2 / side - 1
    uv = target.extent * np.stack(np.meshgrid(middle, middle), axis=-1).reshape(-1, 2)
    uv = uv[Path(target.outline.xy).contains_points(uv)]
    image, total = np.zeros((len(rows), len(columns))), 0.0
    ends = [np.append(pixels - 0.5, pixels[-1] + 0.5) for pixels in (rows, columns)]
    for at, weight in zip(elements.xy, elements.weights, strict=True):
        xy, light = camera.spots(target.points(uv), PupilElements(at[None], weight[None]))
        xy, light = xy.reshape(-1, 2), np.abs(np.nan_to_num(light) @ target.normal).ravel()
        image += np.histogram2d(xy[:, 1], xy[:, 0], bins=ends, weights=light)[0]
        total += float(light.sum())
    return image / total


@dataclass(frozen=True, eq=False)
class RaySurrogate:
    """Polynomials in place of rays, for many images by one lens.

    The pixel of a ray through each element of the stop is a polynomial of direction and reciprocal depth of
    the point of the object, in Chebyshev's form, fitted to traced rays.

    Parameters
    ----------
    elements : PupilElements
    low, high : ndarray (3,)
        Range of X/Z, Y/Z and 1/Z in which it holds.
    coefficients : ndarray (a, b, c, w, e, 5)
        By the degrees in the three; x, y and the light.
    corresponding_coefficients : ndarray (a, b, c, 2)
    error_px : float
        Largest difference from traced rays at points between those of the fit.

    Examples
    --------
    See :meth:`of`, which makes one.
    """

    elements: PupilElements
    low: Array
    high: Array
    coefficients: Array
    corresponding_coefficients: Array
    error_px: float

    @classmethod
    def of(
        cls,
        camera: RayMap,
        elements: PupilElements,
        slopes: tuple[tuple[float, float], tuple[float, float]],
        depths: tuple[float, float],
        degrees: tuple[int, int] = (8, 3),
    ) -> RaySurrogate:
        """Fit a surrogate in a range of the object space.

        Parameters
        ----------
        camera : RayMap
        elements : PupilElements
        slopes : ((float, float), (float, float))
            Least and largest X/Z, least and largest Y/Z.
        depths : (float, float)
            Least and largest Z, mm.
        degrees : (int, int)
            In each of X/Z and Y/Z, and in 1/Z.

        Raises
        ------
        UsageError
            When light is stopped by an aperture in this range: vignetting is no polynomial.

        Examples
        --------
        >>> camera = ThinLens(50.0, 12.5, 52.0, SensorPlane((0.01, 0.01), (0.0, 0.0)))
        >>> range_ = ((-0.3, 0.3), (-0.2, 0.2)), (900.0, 1100.0)
        >>> fast = RaySurrogate.of(camera, PupilElements.gauss(4), *range_)
        >>> fast.error_px < 1e-6
        True
        """
        low = np.array([slopes[0][0], slopes[1][0], 1 / depths[1]])
        high = np.array([slopes[0][1], slopes[1][1], 1 / depths[0]])
        orders = degrees[0], degrees[0], degrees[1]
        nodes = [np.cos(np.pi * (np.arange(n + 1) + 0.5) / (n + 1)) for n in orders]
        unit = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, 3)
        values, corresponding = cls._sampled(camera, elements, low, high, unit)
        shape = tuple(n + 1 for n in orders)
        fits = [
            np.linalg.inv(np.polynomial.chebyshev.chebvander(x, n))
            for x, n in zip(nodes, orders, strict=True)
        ]
        found = []
        for column in (values, corresponding):
            table = column.reshape(*shape, -1)
            for axis, fit in enumerate(fits):
                table = np.moveaxis(np.tensordot(fit, table, (1, axis)), 0, axis)
            found.append(table.reshape(*shape, *column.shape[1:]))
        fast = cls(elements, low, high, found[0], found[1], 0.0)
        between = np.random.default_rng(0).uniform(-1, 1, (60, 3))
        traced, point = cls._sampled(camera, elements, low, high, between)
        error = np.abs(fast._at(between, fast.coefficients) - traced)[..., :2].max()
        error = max(error, np.abs(fast._at(between, fast.corresponding_coefficients) - point).max())
        return replace(fast, error_px=float(error))

    @staticmethod
    def _sampled(
        camera: RayMap, elements: PupilElements, low: Array, high: Array, unit: Array
    ) -> tuple[Array, Array]:
        """Pixels and light (n, w, e, 5) of rays, and corresponding points (n, 2), at points of the range."""
        scaled = low + (unit + 1) / 2 * (high - low)
        points = np.stack([scaled[:, 0], scaled[:, 1], np.ones(len(unit))], axis=1) / scaled[:, 2:]
        xy, light = camera.spots(points, elements)
        if not light.any(axis=-1).all():
            raise UsageError(
                "light is stopped by an aperture in the range of the surrogate; trace rays instead"
            )
        both = np.concatenate([xy, light], axis=-1)
        return np.moveaxis(both, 1, 0), camera.corresponding(points)

    def _at(self, unit: Array, coefficients: Array) -> Array:
        """Values (n, …) of polynomials at points (n, 3) of the unit cube."""
        terms = [
            np.polynomial.chebyshev.chebvander(unit[:, axis], coefficients.shape[axis] - 1)
            for axis in range(3)
        ]
        together = np.einsum("na,nb,nc->nabc", *terms).reshape(len(unit), -1)
        flat = coefficients.reshape(together.shape[1], -1)
        return np.asarray((together @ flat).reshape(len(unit), *coefficients.shape[3:]))

    def _unit(self, points: Array) -> Array:
        scaled = np.stack([points[:, 0], points[:, 1], np.ones(len(points))], axis=1) / points[:, 2:]
        unit = 2 * (scaled - self.low) / (self.high - self.low) - 1
        if np.abs(unit).max(initial=0.0) > 1 + 1e-9:
            raise UsageError("a point is outside the range of the surrogate", do="fit it in a larger range")
        return np.asarray(unit)

    def corresponding(self, points: Array) -> Array:
        """See :class:`RayMap`."""
        return self._at(self._unit(points), self.corresponding_coefficients)

    def spots(self, points: Array, elements: PupilElements) -> tuple[Array, Array]:
        """See :class:`RayMap`; the elements must be those of the surrogate."""
        if elements is not self.elements:
            raise UsageError("these elements of the stop are not those of the surrogate")
        found = np.moveaxis(self._at(self._unit(points), self.coefficients), 0, 1)
        return found[..., :2], found[..., 2:]
