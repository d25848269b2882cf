"""Stand-ins for a lens whose design is not known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.data import Array
from ...core.errors import UsageError
from .ray_maps import ByRays, SensorPlane


@dataclass(frozen=True)
class ThinLens(ByRays):
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
    def unknown(self) -> float:
        """See :class:`RayMap`; a value of experience, with a double Gauss in place of which it stood."""
        return 0.1

    @property
    def wavelength_nm(self) -> float:
        """The first one."""
        return self.colours[0][0]

    @property
    def wavelengths(self) -> tuple[tuple[float, float], ...]:
        """All; without dispersion they differ in nothing."""
        return self.colours

    def directions(self, points: Array) -> Array:
        """Directions (n, 2) in which the projection centre sees points (n, 3)."""
        return np.asarray(points[:, :2] / points[:, 2:])

    def stop_points(self, points: Array, pupil: Array) -> Array:
        """Points of the stop (n, 3) in camera axes, mm, through which rays from points (n, 3) pass."""
        at = 0.5 * self.diameter * pupil
        return np.column_stack([at[:, 0], -at[:, 1], np.zeros(len(at))])

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

    @property
    def unknown(self) -> float:
        """See :class:`RayMap`; a value of experience, with aberrations estimated from photographs."""
        return 0.02

    def stop_points(self, points: Array, pupil: Array) -> Array:
        """See :class:`ThinLens`."""
        return super().stop_points(points, self._narrowed(pupil, self._field(points)))

    def _field(self, points: Array) -> Array:
        """Places of the images (n, 2), in parts of the field."""
        away = np.array([-self.image_distance, self.image_distance]) / self.field_mm
        return np.asarray(points[:, :2] / points[:, 2:] * away)

    def _narrowed(self, pupil: Array, field: Array) -> Array:
        along = (pupil * field).sum(axis=1, keepdims=True)
        return np.asarray(pupil - 0.5 * self.narrowing * along * field)

    def rays(self, points: Array, pupil: Array, wavelength_nm: float) -> tuple[Array, Array]:
        """Rays of a thin lens with aberrations."""
        field = self._field(points)
        square = (field**2).sum(axis=1, keepdims=True)
        pupil = self._narrowed(pupil, field)
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
