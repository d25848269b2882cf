"""What a lens consists of: surfaces in the order in which light meets them, media between them, a stop.

Lengths are millimetres. The axes of the lens are those of its first surface: z along the optical axis in the
direction of the light, y up in the drawing. Each surface has its own place and axes, so that folded and
decentred systems need no special case. The surface of a system of axes is

.. math:: z = \\frac{c\\,r^2}{1 + \\sqrt{1 - (1 + k)\\,c^2 r^2}} + \\sum_{i \\ge 2} a_{2i}\\,r^{2i},

with the curvature c, the conic constant k, and coefficients of an even asphere from :math:`r^4` on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import scipy

from ...core.data import Array, Mask
from ...core.errors import UsageError
from .media import AIR, Medium

COEFFICIENTS = 10
"""Largest number of coefficients of an asphere; Numba's cache of `compiled.py` does not notice a change."""
_FARTHEST = 1e9
"""Largest coordinate of a vertex, mm."""


@dataclass(frozen=True, eq=False)
class Aperture:
    """Part of a surface that lets light pass, or, as an obscuration, does not.

    Parameters
    ----------
    shape : {"circle", "rectangle", "polygon"}
    size : tuple
        Outer and inner radius of a circle or an annulus (0: a circle); half width and half height.
    corners : ndarray (n, 2), optional
        Corners of a polygon.
    centre : (float, float)
    turn : float
        Rotation of a rectangle, x into y, radians.
    blocks : bool
        Whether light is blocked inside instead of outside.

    Examples
    --------
    >>> annulus = Aperture("circle", (10.0, 3.0))
    >>> annulus.passes(np.array([0.0, 5.0, 11.0]), np.zeros(3)).tolist()
    [False, True, False]
    """

    shape: Literal["circle", "rectangle", "polygon"]
    size: tuple[float, float] = (0.0, 0.0)
    corners: Array | None = None
    centre: tuple[float, float] = (0.0, 0.0)
    turn: float = 0.0
    blocks: bool = False

    def __post_init__(self) -> None:
        if self.shape == "polygon":
            if self.corners is None or self.corners.ndim != 2 or len(self.corners) < 3:
                raise UsageError("an aperture of the shape polygon needs three corners or more")
        elif not (self.size[0] > 0 and self.size[1] >= 0):
            raise UsageError(f"{self.size} is not the size of an aperture of the shape {self.shape}")

    def passes(self, x: Array, y: Array) -> Mask:
        """Whether light passes at points of the surface."""
        u, v = x - self.centre[0], y - self.centre[1]
        if self.shape == "circle":
            square = u * u + v * v
            inside = (square <= self.size[0] ** 2) & (square >= self.size[1] ** 2)
        elif self.shape == "rectangle":
            c, s = np.cos(self.turn), np.sin(self.turn)
            inside = (np.abs(c * u + s * v) <= self.size[0]) & (np.abs(c * v - s * u) <= self.size[1])
        else:
            assert self.corners is not None
            inside = _inside(self.corners, u, v)
        return np.asarray(~inside if self.blocks else inside)


def _inside(corners: Array, x: Array, y: Array) -> Mask:
    """Whether points are inside a polygon, by crossings of its sides."""
    inside = np.zeros(x.shape, dtype=np.bool_)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 != y1:
            inside ^= ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


@dataclass(frozen=True, eq=False)
class Surface:
    """A surface, and the medium behind it.

    Parameters
    ----------
    curvature : float
        Reciprocal radius, 1/mm; positive where the centre of curvature is on the side of +z.
    conic : float
        Conic constant: 0 sphere, -1 paraboloid.
    coefficients : tuple of float
        :math:`a_4, a_6, …` of an even asphere, in powers of 1/mm.
    kind : {"refracting", "mirror", "plain"}
        A plain surface does not change rays: a stop, a baffle, a place to see them at.
    medium : Medium
        Medium behind a refracting surface.
    vertex : ndarray (3,)
        Place of the vertex in the axes of the lens.
    axes : ndarray (3, 3)
        Axes of the surface, in columns, in the axes of the lens.
    apertures : tuple of Aperture
        All of them must let a ray pass.
    name : str
        Name in messages.

    Examples
    --------
    >>> Surface(curvature=0.01).sag(np.array([5.0]), np.array([0.0])).round(6)
    array([0.125078])
    """

    curvature: float = 0.0
    conic: float = 0.0
    coefficients: tuple[float, ...] = ()
    kind: Literal["refracting", "mirror", "plain"] = "refracting"
    medium: Medium = AIR
    vertex: Array = field(default_factory=lambda: np.zeros(3))
    axes: Array = field(default_factory=lambda: np.eye(3))
    apertures: tuple[Aperture, ...] = ()
    name: str = ""

    def __post_init__(self) -> None:
        numbers = [self.curvature, self.conic, *self.coefficients, *self.vertex, *self.axes.ravel()]
        if not np.isfinite(numbers).all():
            raise UsageError("has a number that is not finite", where=self.name or "surface")
        if np.abs(self.vertex).max() > _FARTHEST:
            raise UsageError(f"lies {np.abs(self.vertex).max():g} mm away", where=self.name or "surface")
        if len(self.coefficients) > COEFFICIENTS:
            raise UsageError(
                f"has {len(self.coefficients)} coefficients; {COEFFICIENTS} are possible",
                where=self.name or "surface",
            )

    def sag(self, x: Array, y: Array) -> Array:
        """Height of the surface above the plane at its vertex; NaN where it has none."""
        square, c = x * x + y * y, self.curvature
        with np.errstate(invalid="ignore"):
            z = c * square / (1 + np.sqrt(1 - (1 + self.conic) * c * c * square))
        for power, a in enumerate(self.coefficients, 2):
            z = z + a * square**power
        return np.asarray(z)


@dataclass(frozen=True, eq=False)
class Prescription:
    """A lens: its surfaces in the order of the light; the last one is the image surface.

    Parameters
    ----------
    surfaces : tuple of Surface
    stop : int
        Index of the aperture stop.
    stop_radius : float, optional
        Radius of the stop, mm; by default that of its circular aperture.
    wavelengths_nm, weights : tuple of float
        Wavelengths for which the lens is meant, with their weights.
    reference : int
        Index of the wavelength of the corresponding rays.
    before : Medium
        Medium in front of the first surface.
    name : str
    notes : tuple of str
        What a user should know about how it was read.

    Raises
    ------
    UsageError
        When there is no surface that bends rays, no image surface, no stop, or no wavelength.

    Examples
    --------
    >>> from reseau.optics.lenses.media import glass
    >>> surfaces = in_order([(0.02, 5.0, glass("N-BK7")), (-0.02, 45.0, AIR)])
    >>> lens = Prescription(surfaces, stop=0, stop_radius=5.0, wavelengths_nm=(587.5618,))
    >>> lens.indices(587.5618).round(4)
    array([1.    , 1.5168, 1.    , 1.    ])
    """

    surfaces: tuple[Surface, ...]
    stop: int
    stop_radius: float | None = None
    wavelengths_nm: tuple[float, ...] = (587.5618,)
    weights: tuple[float, ...] = ()
    reference: int = 0
    before: Medium = AIR
    name: str = "lens"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        def refuse(what: str, do: str | None = None) -> None:
            raise UsageError(what, where=self.name, do=do)

        if len(self.surfaces) < 2 or all(surface.kind == "plain" for surface in self.surfaces[:-1]):
            refuse("is not a lens: it has no surface that refracts or reflects")
        if self.surfaces[-1].kind != "plain":
            refuse("has no image surface", "add a last surface that does not change rays")
        if not 0 <= self.stop < len(self.surfaces) - 1:
            refuse("has no stop", "say which surface limits the light")
        if not self.wavelengths_nm:
            refuse("has no wavelength", "give one or more, in nm")
        if not self.weights:
            object.__setattr__(self, "weights", (1.0,) * len(self.wavelengths_nm))
        if len(self.weights) != len(self.wavelengths_nm) or min(self.weights) < 0 or sum(self.weights) <= 0:
            refuse(f"has {len(self.wavelengths_nm)} wavelengths, which need as many weights, none negative")
        if not 0 <= self.reference < len(self.wavelengths_nm):
            refuse("has no wavelength for its corresponding rays")
        if self.stop_radius is None:
            circles = [
                a.size[0] for a in self.surfaces[self.stop].apertures if a.shape == "circle" and not a.blocks
            ]
            if circles:
                object.__setattr__(self, "stop_radius", min(circles))
        elif not (np.isfinite(self.stop_radius) and self.stop_radius > 0):
            refuse(f"has a stop with a radius of {self.stop_radius} mm")

    @property
    def wavelength_nm(self) -> float:
        """Wavelength of the corresponding rays."""
        return self.wavelengths_nm[self.reference]

    def indices(self, wavelength_nm: float) -> Array:
        """Indices in front of the first surface and behind each surface, (1 + s,)."""
        found = [self.before.index(wavelength_nm)]
        for surface in self.surfaces:
            found.append(surface.medium.index(wavelength_nm) if surface.kind == "refracting" else found[-1])
        return np.array(found)

    def moved(self, shift: Sequence[float], at: int = -1) -> Prescription:
        """The lens with one surface moved; by default the image surface, which changes the focus.

        Parameters
        ----------
        shift : (3,)
            In the axes of the lens, mm.
        at : int
            Index of the surface.
        """
        surfaces = list(self.surfaces)
        surfaces[at] = replace(surfaces[at], vertex=surfaces[at].vertex + np.asarray(shift, dtype=float))
        return replace(self, surfaces=tuple(surfaces))


class Layout:
    """Place and axes of the next surface, while surfaces are placed one after the other.

    Examples
    --------
    >>> layout = Layout()
    >>> layout.advance(10.0)
    >>> layout.turn((0.0, 1.0), (90.0, 0.0, 0.0))
    >>> layout.advance(5.0)
    >>> layout.vertex.round(12) + 0.0
    array([ 0., -4., 10.])
    """

    def __init__(self) -> None:
        self.vertex, self.axes = np.zeros(3), np.eye(3)

    def advance(self, distance: float) -> None:
        """Go along the z axis."""
        self.vertex = self.vertex + distance * self.axes[:, 2]

    def turn(
        self,
        decentre: tuple[float, float],
        tilt_deg: tuple[float, float, float],
        *,
        tilt_first: bool = False,
    ) -> None:
        """Shift and turn the axes: a break of coordinates, as lens programs call it.

        Parameters
        ----------
        decentre : (float, float)
            Along x and y, mm.
        tilt_deg : (float, float, float)
            About x, then about the new y, then about the newest z, right-handed.
        tilt_first : bool
            Whether the axes are turned before they are shifted, and then about z, y, x.
        """
        if tilt_first:
            self.axes = (
                self.axes
                @ scipy.spatial.transform.Rotation.from_euler("ZYX", tilt_deg[::-1], degrees=True).as_matrix()
            )
        self.vertex = self.vertex + self.axes[:, :2] @ np.asarray(decentre, dtype=float)
        if not tilt_first:
            self.axes = (
                self.axes
                @ scipy.spatial.transform.Rotation.from_euler("XYZ", tilt_deg, degrees=True).as_matrix()
            )


def in_order(rows: Sequence[tuple[float, float, Medium]]) -> tuple[Surface, ...]:
    """Centred surfaces from rows of a table: curvature, distance to the next surface, medium in between.

    A plane image surface is added at the end.

    Examples
    --------
    >>> [float(surface.vertex[2]) for surface in in_order([(0.02, 5.0, AIR), (-0.02, 45.0, AIR)])]
    [0.0, 5.0, 50.0]
    """
    found, layout = [], Layout()
    for k, (curvature, distance, medium) in enumerate(rows, 1):
        found.append(Surface(curvature, medium=medium, vertex=layout.vertex, name=f"surface {k}"))
        layout.advance(distance)
    found.append(Surface(kind="plain", vertex=layout.vertex, name="image"))
    return tuple(found)
