"""A lens behind the windows of a network: one prescription of both, for images formed by rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ...core.data import Array
from ...core.errors import UsageError
from ..refraction import Refraction, RefractiveIndex
from .media import Constant, Medium
from .prescription import Surface
from .ray_maps import LensCamera

__all__ = ["behind_windows"]


@dataclass(frozen=True)
class _Adjusted:
    """The dispersion of a medium, with the index at one wavelength that an adjustment gave."""

    name: str
    dispersion: Callable[[float], float]
    value: float
    wavelength_nm: float

    def index(self, wavelength_nm: float) -> float:
        return self.value + self.dispersion(wavelength_nm) - self.dispersion(self.wavelength_nm)


def behind_windows(
    camera: LensCamera,
    refraction: Refraction,
    path: int,
    rotation: Array,
    x0: Array,
    *,
    unit_mm: float = 1.0,
) -> LensCamera:
    """Put the windows that the rays of an image pass in front of a lens.

    Parameters
    ----------
    camera : LensCamera
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
    LensCamera
        Its object points are in the last medium; the projection centre is where it was.

    Raises
    ------
    UsageError
        For a cylinder, which the tracing of lenses does not know, and for a window on a rig.

    Examples
    --------
    >>> from reseau.optics.lenses import AIR, Constant, Prescription, SensorPlane, glass, in_order
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
    """
    if path < 0:
        return camera
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
