"""Polynomials in place of rays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...core.data import Array
from ...core.errors import UsageError
from .pupils import PupilElements
from .ray_maps import ByRays, RayMap


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
    unknown : float
        That of the map of rays; see :class:`RayMap`.

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
    unknown: float = 0.0

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
        >>> from reseau.optics.lenses import ThinLens
        >>> from reseau.optics.lenses.ray_maps import SensorPlane
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
        fast = cls(elements, low, high, found[0], found[1], 0.0, camera.unknown)
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
        cut = isinstance(camera, ByRays) and any(
            (camera.open_part(points, elements.xy, wavelength)[1] < 1).any()
            for wavelength, _ in camera.wavelengths
        )
        if cut or not light.any(axis=-1).all():
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
