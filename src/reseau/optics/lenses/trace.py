"""Rays through a lens: sequential tracing.

Positions are millimetres. A ray starts in the axes of the lens (:class:`.Prescription`) and ends on its last
surface, in the axes of that surface: on the image plane these are image coordinates. At each surface the ray
is intersected with the surface (in closed form for conics, with Newton's method for aspheres) and bent by
Snell's law in vector form (Welford 1986, Aberrations of Optical Systems, chapter 4).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Mask
from .compiled import traced
from .prescription import COEFFICIENTS, Aperture, Prescription, Surface

_KINDS = {"refracting": 0.0, "mirror": 1.0, "plain": 2.0}
_SHAPES = {"circle": 0.0, "rectangle": 1.0, "polygon": 2.0}
_REASONS = ("misses", "is totally reflected at", "is stopped at")
_TOGETHER = 16384
"""Smallest number of rays for a thread of its own."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays in columns.

    Parameters
    ----------
    xyz : ndarray (n, 3)
        Points on the rays, mm.
    directions : ndarray (n, 3)
        Unit vectors in the direction of the light.

    Examples
    --------
    >>> Rays.between(np.zeros(3), np.array([[0.0, 0.0, 5.0]])).directions
    array([[0., 0., 1.]])
    """

    xyz: Array
    directions: Array

    @classmethod
    def between(cls, start: Array, through: Array) -> Rays:
        """Rays from points (n, 3) or (3,) through points (n, 3) or (3,)."""
        start, through = np.broadcast_arrays(np.asarray(start, dtype=float), np.asarray(through, dtype=float))
        away = np.atleast_2d(through - start)
        return cls(np.atleast_2d(start), away / np.linalg.norm(away, axis=1, keepdims=True))

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False)
class Traced:
    """Rays on the last surface, in its axes; lost rays are NaN.

    Parameters
    ----------
    rays : Rays
    lost : ndarray of int (n,)
        0 for a ray that arrives; 4 s + 1, 2 or 3 for one that misses surface s, is totally reflected there,
        or stopped by its aperture.
    seen : ndarray (s, n, 6), optional
        Rays behind each surface, in its axes; those of a lost ray mean nothing from where it is lost on.

    Examples
    --------
    >>> Traced(Rays(np.ones((2, 3)), np.ones((2, 3))), np.array([0, 3])).arrived
    array([ True, False])
    """

    rays: Rays
    lost: NDArray[np.int64]
    seen: Array | None = None

    @property
    def xy(self) -> Array:
        """Points (n, 2) on the last surface, mm."""
        return self.rays.xyz[:, :2]

    @property
    def arrived(self) -> Mask:
        """Whether a ray arrived."""
        return np.asarray(self.lost == 0)


class Tracer:
    """A lens at one wavelength, ready to trace rays.

    Parameters
    ----------
    lens : Prescription
    wavelength_nm : float, optional
        By default that of the corresponding rays.
    last : int, optional
        Index of the surface at which rays end; by default the image surface.
    apertures : bool
        Whether apertures stop rays.
    threads : int
        Threads for large numbers of rays.

    Examples
    --------
    >>> from reseau.optics.lenses import AIR, Prescription, glass, in_order
    >>> surfaces = in_order([(0.02, 5.0, glass("N-BK7")), (-0.02, 46.5, AIR)])
    >>> lens = Prescription(surfaces, stop=0, stop_radius=5.0)
    >>> parallel = Rays(np.array([[0.0, 2.0, -1.0]]), np.array([[0.0, 0.0, 1.0]]))
    >>> Tracer(lens).trace(parallel).xy.round(3)
    array([[0.   , 0.037]])
    """

    def __init__(
        self,
        lens: Prescription,
        wavelength_nm: float | None = None,
        *,
        last: int | None = None,
        apertures: bool = True,
        threads: int = 1,
    ) -> None:
        self.lens, self.threads = lens, threads
        self.wavelength_nm = lens.wavelength_nm if wavelength_nm is None else wavelength_nm
        count = len(lens.surfaces) if last is None else range(len(lens.surfaces))[last] + 1
        self.surfaces = lens.surfaces[:count]
        self.indices = lens.indices(self.wavelength_nm)[: count + 1]
        self._tables = _tables(self.surfaces, self.indices, apertures)

    def trace(self, rays: Rays, *, seen: bool = False) -> Traced:
        """Trace rays to the last surface.

        Parameters
        ----------
        rays : Rays
            n rays in the axes of the lens.
        seen : bool
            Whether the rays behind each surface are wanted.
        """
        n = len(rays)
        points, directions = (np.ascontiguousarray(part, np.float64) for part in (rays.xyz, rays.directions))
        ends, behind, lost = np.empty((n, 3)), np.empty((n, 3)), np.empty(n, dtype=np.int64)
        records = np.empty((len(self.surfaces) if seen else 0, 6, n))

        def part(first: int, last: int) -> None:
            inside = slice(first, last)
            traced(
                *self._tables,
                points[inside],
                directions[inside],
                ends[inside],
                behind[inside],
                lost[inside],
                records[:, :, inside],
            )

        count = max(1, min(self.threads, n // _TOGETHER))
        if count == 1:
            part(0, n)
        else:
            limits = np.linspace(0, n, count + 1).astype(int)
            with ThreadPoolExecutor(count) as pool:
                list(pool.map(part, limits[:-1], limits[1:]))
        return Traced(Rays(ends, behind), lost, records.transpose(0, 2, 1) if seen else None)

    def reason(self, code: int) -> str:
        """Say why a ray was lost: 'is totally reflected at surface 3'.

        Parameters
        ----------
        code : int
            One of :attr:`Traced.lost`.
        """
        surface = self.surfaces[(code - 1) // 4]
        return f"{_REASONS[(code - 1) % 4]} {surface.name or f'surface {(code - 1) // 4 + 1}'}"


def _tables(
    surfaces: tuple[Surface, ...], indices: Array, apertures: bool
) -> tuple[Array, Array, Array, Array]:
    """Tables of surfaces, places, apertures and corners; see :func:`reseau.optics.lenses.compiled.traced`."""
    rows, places = np.zeros((len(surfaces), 5 + COEFFICIENTS)), np.zeros((len(surfaces), 13))
    stops: list[Array] = []
    corners: list[Array] = []
    axes, vertex, used = np.eye(3), np.zeros(3), 0
    for s, surface in enumerate(surfaces):
        form = np.trim_zeros(np.array(surface.coefficients, dtype=float), "b")
        rows[s, :4] = _KINDS[surface.kind], surface.curvature, surface.conic, len(form)
        rows[s, 4 : 4 + len(form)] = form
        rows[s, 4 + COEFFICIENTS] = indices[s] / indices[s + 1]
        turn = surface.axes.T @ axes
        straight = np.abs(turn - np.eye(3)).max() < 1e-15
        places[s, :3] = surface.axes.T @ (vertex - surface.vertex)
        places[s, 3:12], places[s, 12] = turn.ravel(), not straight
        axes, vertex = surface.axes, surface.vertex
        for aperture in surface.apertures if apertures else ():
            row, polygon = _aperture(aperture)
            stops.append(np.concatenate([[s], row, [used, used + len(polygon)]]))
            corners.append(polygon)
            used += len(polygon)
    return (
        rows,
        places,
        np.array(stops).reshape(-1, 11),
        np.concatenate([np.zeros((0, 2)), *corners]),
    )


def _aperture(aperture: Aperture) -> tuple[Array, Array]:
    """Shape, size, centre, turn and whether it blocks, (8,), and the corners of a polygon."""
    row: Any = [
        _SHAPES[aperture.shape],
        *aperture.size,
        *aperture.centre,
        np.cos(aperture.turn),
        np.sin(aperture.turn),
        aperture.blocks,
    ]
    return np.array(row, dtype=float), np.zeros((0, 2)) if aperture.corners is None else aperture.corners
