"""A lens behind the windows of a network, for images formed by rays.

A lens whose design is known becomes one prescription with the windows. Before a
stand-in, rays are refracted by the windows first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import overload

import numpy as np

from ...core.data import Array, Mask
from ...core.errors import UsageError
from ..refraction import RefractedRays
from ..refraction.windows import Refraction, RefractionColumns, RefractiveIndex
from .media import Constant, Medium
from .prescription import Surface
from .ray_maps import ByRays, LensCamera
from .stand_ins import ThinLens


@dataclass(frozen=True)
class _Adjusted:
    """The dispersion of a medium, with the index at one wavelength that an adjustment gave."""

    name: str
    dispersion: Callable[[float], float]
    value: float
    wavelength_nm: float

    def index(self, wavelength_nm: float) -> float:
        return self.value + self.dispersion(wavelength_nm) - self.dispersion(self.wavelength_nm)


@dataclass(frozen=True, eq=False)
class ThinLensBehindWindows(ByRays):
    """A stand-in for a lens, seen through windows.

    A ray from a point of the stop is refracted by the windows. Before them it is a straight line, which the
    lens images as that of a point in air.

    Parameters
    ----------
    lens : ThinLens
    refraction, path, rotation, x0, unit_mm
        See :func:`behind_windows`.

    Examples
    --------
    See :func:`behind_windows`.
    """

    lens: ThinLens
    refraction: Refraction
    path: int
    rotation: Array
    x0: Array
    unit_mm: float = 1.0

    @property
    def unknown(self) -> float:
        """See :class:`RayMap`."""
        return self.lens.unknown

    @property
    def wavelengths(self) -> tuple[tuple[float, float], ...]:
        """Those of the lens."""
        return self.lens.wavelengths

    @property
    def wavelength_nm(self) -> float:
        """That of the lens."""
        return self.lens.wavelength_nm

    def directions(self, points: Array) -> Array:
        """Directions (n, 2) before the windows of the rays from points to the projection centre, or NaN."""
        seen, reached = self._seen(np.zeros_like(points), points, self.wavelength_nm)
        return np.where(reached[:, None], seen, np.nan)

    def rays(self, points: Array, pupil: Array, wavelength_nm: float) -> tuple[Array, Array]:
        """Rays by refraction at the windows, and the geometry of the lens."""
        depth = points[:, 2:]
        if (depth <= 0).any():
            raise UsageError("a point of the object lies behind the lens")
        middle, _ = self._seen(np.zeros_like(points), points, wavelength_nm)
        stop = self.lens.stop_points(depth * np.column_stack([middle, np.ones(len(middle))]), pupil)
        seen, reached = self._seen(stop, points, wavelength_nm)
        before = stop + depth * np.column_stack([seen, np.ones(len(seen))])
        xy, light = self.lens.rays(before, pupil, wavelength_nm)
        return np.where(reached[:, None], xy, np.nan), light * reached[:, None]

    def _seen(self, stop: Array, points: Array, wavelength_nm: float) -> tuple[Array, Mask]:
        """Directions (n, 2) from points of the stop, and whether there is a ray (n,)."""
        if wavelength_nm not in self._columns:
            values = self.refraction.values.copy()
            for medium in self.refraction.media:
                at = self.refraction.names.index(medium.label)
                adjusted = replace(medium, value=float(values[at]), free=False, sigma=None)
                values[at] = _medium(adjusted, self.wavelength_nm).index(wavelength_nm)
            self._columns[wavelength_nm] = self.refraction.columns(values)
        rays = RefractedRays.beside(
            self._columns[wavelength_nm], self.path, self.rotation, self.x0, stop / self.unit_mm,
            points / self.unit_mm,
        )  # fmt: skip
        return rays.uv, rays.reached

    @cached_property
    def _columns(self) -> dict[float, RefractionColumns]:
        """Windows by wavelength."""
        return {}


@overload
def behind_windows(
    camera: LensCamera, refraction: Refraction, path: int, rotation: Array, x0: Array, *, unit_mm: float = ...
) -> LensCamera: ...


@overload
def behind_windows(
    camera: ThinLens, refraction: Refraction, path: int, rotation: Array, x0: Array, *, unit_mm: float = ...
) -> ThinLens | ThinLensBehindWindows: ...


def behind_windows(
    camera: LensCamera | ThinLens,
    refraction: Refraction,
    path: int,
    rotation: Array,
    x0: Array,
    *,
    unit_mm: float = 1.0,
) -> LensCamera | ThinLens | ThinLensBehindWindows:
    """Put the windows that the rays of an image pass in front of a lens.

    Parameters
    ----------
    camera : LensCamera or ThinLens
        The lens with its sensor, in the first medium of the path.
    refraction : Refraction
        Windows and media, with the values to be used. Media with a dispersion keep it; their index at the
        wavelength of the corresponding rays is that of the refraction.
    path : int
        Number of the path; −1 for images in air.
    rotation, x0 : ndarray (3, 3), (3,)
        Pose of the image, for windows on the object.
    unit_mm : float
        Unit of object space, mm.

    Returns
    -------
    LensCamera, or ThinLens or ThinLensBehindWindows
        Its object points are in the last medium; the projection centre is where it was.

    Raises
    ------
    UsageError
        For a cylinder before a design, which the tracing of lenses does not know, and for a window on a rig.

    Examples
    --------
    >>> from reseau.optics.lenses import AIR, Prescription, glass, in_order
    >>> from reseau.optics.lenses.media import Constant
    >>> from reseau.optics.lenses.ray_maps import SensorPlane
    >>> from reseau.optics.refraction import Window
    >>> lens = Prescription(in_order([(0.02, 5.0, glass("N-BK7")), (-0.02, 47.0, AIR)]), 0, 4.0)
    >>> camera = LensCamera(lens, SensorPlane((0.005, 0.005), (999.5, 749.5)))
    >>> media = RefractiveIndex("air", 1.0), RefractiveIndex("water", 1.333)
    >>> surface = Window("surface", "plane", "camera", {"distance": 20.0}, ("air", "water"))
    >>> refraction = Refraction(media, (surface,), ((0,),), np.array([0]))
    >>> wet = behind_windows(camera, refraction, 0, np.eye(3), np.zeros(3))
    >>> far = np.array([[100.0, 0.0, 1000.0]])
    >>> bool(wet.corresponding(far)[0, 0] > camera.corresponding(far)[0, 0])
    True

    A thin lens in place of it, with the surface of the water at its stop: directions follow Snell's law.

    >>> from reseau.optics.lenses import ThinLens
    >>> near = Window("surface", "plane", "camera", {"distance": 1e-6}, ("air", "water"))
    >>> thin = ThinLens(50.0, 12.5, 50.0, SensorPlane((0.005, 0.005), (999.5, 749.5)))
    >>> refraction = Refraction(media, (near,), ((0,),), np.array([0]))
    >>> wet = behind_windows(thin, refraction, 0, np.eye(3), np.zeros(3))
    >>> sine = 1.333 * np.sin(np.arctan(0.1))
    >>> bool(abs(wet.corresponding(far)[0, 0] - 999.5 - 1e4 * sine / np.sqrt(1 - sine**2)) < 1e-3)
    True
    """
    if path < 0:
        return camera
    if isinstance(camera, ThinLens):
        return ThinLensBehindWindows(camera, refraction, path, rotation, x0, unit_mm)
    lens, centre = camera.lens, camera.projection_centre
    named = {medium.name: _medium(medium, lens.wavelength_nm) for medium in refraction.media}
    found: list[Surface] = []
    for k in refraction.paths[path]:
        window = refraction.windows[k]
        if window.shape == "cylinder":
            raise UsageError("rays of lenses are not traced through cylinders", where=f"window {window.name}")
        if window.on == "rig":
            raise UsageError(
                "is on a rig", where=f"window {window.name}", do="use `Refraction.on_cameras` before"
            )
        media = [named[name] for name in window.media]
        described = window.surfaces(refraction.of_window(k))
        for (side, row, _), near in zip(described, media, strict=False):
            unit, at, round_ = row[:3], row[3:6], float(row[6])
            if window.on == "object":
                unit, at = rotation @ unit, rotation @ (at - x0)
            if window.shape == "plane":
                view, curvature = side * unit, -side * round_
            else:
                # The vertex lies in the view from the centre; the other half is not looked through.
                view = np.array([0.0, 0.0, 1.0])
                at, curvature = at + side * round_ * view, side / round_
            found.append(
                Surface(
                    curvature / unit_mm,
                    medium=near,
                    vertex=camera.rotation @ (unit_mm * at) + centre,
                    axes=_axes(-(camera.rotation @ view)),
                    name=f"window {window.name}",
                )
            )
    last = named[refraction.windows[refraction.paths[path][-1]].media[-1]]
    # Light comes from the object.
    surfaces = (*reversed(found), *lens.surfaces)
    wet = replace(lens, surfaces=surfaces, stop=lens.stop + len(found), before=last)
    return replace(camera, lens=wet, centre=centre)


def _medium(medium: RefractiveIndex, wavelength_nm: float) -> Medium:
    if medium.dispersion is None:
        return Constant(medium.value, medium.name)
    return _Adjusted(medium.name, medium.dispersion, medium.value, wavelength_nm)


def _axes(along: Array) -> Array:
    """Axes in columns whose third is the direction of the light."""
    near = np.eye(3)[int(np.argmin(np.abs(along)))]
    x = near - (near @ along) * along
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(along, x), along], axis=1)
