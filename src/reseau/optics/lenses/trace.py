r"""Rays through a lens: sequential tracing, and the derivatives of where they end.

Positions are millimetres. A ray starts in the axes of the lens (:class:`.Prescription`) and ends on its last
surface, in the axes of that surface: on the image plane these are image coordinates. At each surface the ray
is intersected with the surface (in closed form for conics, with Newton's method for aspheres) and bent by
Snell's law in vector form (Welford 1986, Aberrations of Optical Systems, chapter 4).

The derivatives follow from those conditions (Feder 1968, Applied Optics 7, 1199): with
:math:`F(p, q) = 0` the surface, g its gradient by the point and :math:`F_q` that by a parameter,

.. math:: dp = (I - d\,g^T / g^T d)(dp_0 + t\,dd) - d\,F_q\,dq / g^T d ,

and the direction behind it changes with the direction in front of it, with the normal, and with the ratio of
the indices. They are accumulated backwards, from the image to the object.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.data import Array, Mask
from ...core.errors import UsageError
from .compiled import traced
from .prescription import COEFFICIENTS, Aperture, Prescription, Surface

SURFACE_PARAMETERS = (
    "curvature",
    "conic",
    "vertex_x",
    "vertex_y",
    "vertex_z",
    "tilt_x",
    "tilt_y",
    "tilt_z",
    "index_before",
    "index_behind",
    *(f"a{2 * k}" for k in range(2, 2 + COEFFICIENTS)),
)
"""Parameters of a surface to which a ray has derivatives; tilts are rotations about its own axes, radians."""

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


@dataclass(frozen=True, eq=False)
class RayDerivatives:
    """Derivatives of the points (n, 2) at which rays end.

    Parameters
    ----------
    xy : ndarray (n, 2)
    by_ray : ndarray (n, 2, 6)
        By the point and the direction with which a ray starts. Directions are not normalised: a change along
        the direction itself has no effect.
    by_surface : ndarray (n, 2, s, p)
        By the parameters of each surface, in the order of :data:`SURFACE_PARAMETERS`.

    Examples
    --------
    The image moves with a decentred lens by 1 - m of its shift; here the object is far away, and m is 0:

    >>> from reseau.optics.lenses import AIR, Prescription, in_order
    >>> from reseau.optics.lenses.media import Constant
    >>> surfaces = in_order([(0.02, 1e-6, Constant(1.5)), (-0.02, 50.0, AIR)])
    >>> lens = Prescription(surfaces, stop=0, stop_radius=1.0)
    >>> axial = Rays(np.array([[0.0, 0.0, -1.0]]), np.array([[0.0, 0.0, 1.0]]))
    >>> by_surface = Tracer(lens).derivatives(axial).by_surface
    >>> by_x = by_surface[0, 0, :, SURFACE_PARAMETERS.index("vertex_x")]
    >>> by_x.round(3).tolist()
    [0.5, 0.5, -1.0]
    """

    xy: Array
    by_ray: Array
    by_surface: Array


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

    def derivatives(self, rays: Rays) -> RayDerivatives:
        """Derivatives of where rays end by where they start and by every parameter of every surface.

        Parameters
        ----------
        rays : Rays
            n rays in the axes of the lens, none of which is lost.

        Raises
        ------
        UsageError
            When a ray is lost.
        """
        traced = self.trace(rays, seen=True)
        if not traced.arrived.all():
            code = int(traced.lost[~traced.arrived][0])
            raise UsageError(f"a ray {self.reason(code)}; it has no derivatives", where=self.lens.name)
        assert traced.seen is not None
        by_surface = np.zeros((len(rays), 2, len(self.surfaces), len(SURFACE_PARAMETERS)))
        after = np.zeros((len(rays), 2, 6))
        last = self.surfaces[-1]
        after[:, :, :3] = last.axes[:, :2].T  # from the axes of the lens to those of the last surface
        for s in range(len(self.surfaces) - 1, -1, -1):
            before = np.concatenate([rays.xyz, rays.directions], axis=1)
            if s:
                ahead = self.surfaces[s - 1]
                point, direction = traced.seen[s - 1, :, :3], traced.seen[s - 1, :, 3:]
                before = np.concatenate(
                    [point @ ahead.axes.T + ahead.vertex, direction @ ahead.axes.T], axis=1
                )
            by_ray, by_parameter = _at_surface(
                self.surfaces[s], self.indices[s : s + 2], before, traced.seen[s, :, :3]
            )
            by_surface[:, :, s] = after @ by_parameter
            after = after @ by_ray
        # Coordinates in the axes of the last surface change when this surface moves or turns.
        local = traced.rays.xyz
        moved = np.zeros((len(rays), 2, len(SURFACE_PARAMETERS)))
        moved[:, :, 2:5] = -last.axes[:, :2].T
        moved[:, :, 5:8] = -_crossed(local)[:, :2]
        by_surface[:, :, -1] += moved
        return RayDerivatives(traced.xy, after, by_surface)


def _crossed(points: Array) -> Array:
    """Derivatives (n, 3, 3) of ω × p by ω."""
    matrix = np.zeros((len(points), 3, 3))
    x, y, z = points.T
    matrix[:, 0, 1], matrix[:, 0, 2] = z, -y
    matrix[:, 1, 0], matrix[:, 1, 2] = -z, x
    matrix[:, 2, 0], matrix[:, 2, 1] = y, -x
    return matrix


def _at_surface(surface: Surface, indices: Array, before: Array, p: Array) -> tuple[Array, Array]:
    """Derivatives of rays (n, 6) behind a surface by the rays in front of it and by its parameters.

    All rays in the axes of the lens, the points p (n, 3) at which they meet the surface in its axes;
    (n, 6, 6) and (n, 6, parameters).
    """
    n, axes = len(before), surface.axes
    p0, d = (before[:, :3] - surface.vertex) @ axes, before[:, 3:] @ axes
    t = ((p - p0) * d).sum(axis=1)
    x, y = p[:, 0], p[:, 1]
    slope, bend, by_form = _form(surface, x, y)
    # Gradient and Hessian of F = sag(r²) − z.
    g = np.stack([2 * slope * x, 2 * slope * y, -np.ones(n)], axis=1)
    hessian = np.zeros((n, 3, 3))
    hessian[:, 0, 0] = hessian[:, 1, 1] = 2 * slope
    hessian[:, :2, :2] += 4 * bend[:, None, None] * p[:, :2, None] * p[:, None, :2]
    # By the ray (6) and by curvature, conic, vertex, tilt, indices, coefficients.
    count = 6 + len(SURFACE_PARAMETERS)
    forms = [6, 7, *range(16, count)]
    start, turn = np.zeros((n, 3, count)), np.zeros((n, 3, count))
    start[:, :, :3], turn[:, :, 3:6] = axes.T, axes.T
    start[:, :, 8:11] = -axes.T
    start[:, :, 11:14], turn[:, :, 11:14] = -_crossed(p0), -_crossed(d)
    f_q = np.zeros((n, count))
    f_q[:, forms] = by_form[:, :, 0]
    g_q = np.zeros((n, 3, count))
    g_q[:, :2, forms] = 2 * p[:, :2, None] * by_form[:, None, :, 1]
    along = (g * d).sum(axis=1)
    free = start + t[:, None, None] * turn
    fall = (np.einsum("ni,niq->nq", g, free) + f_q) / along[:, None]
    dp = free - d[:, :, None] * fall[:, None, :]
    if surface.kind == "plain":
        out = turn
        behind = d
    else:
        length = np.linalg.norm(g, axis=1)
        normal = g / length[:, None]
        change = hessian @ dp + g_q
        d_normal = (
            change - normal[:, :, None] * np.einsum("ni,niq->nq", normal, change)[:, None, :]
        ) / length[:, None, None]
        cosine = (d * normal).sum(axis=1)
        d_cosine = np.einsum("niq,ni->nq", d_normal, d) + np.einsum("niq,ni->nq", turn, normal)
        # Of the square root, in 1 − μ² (1 − cos²), 1 is the square of the length of the direction.
        if surface.kind == "mirror":
            behind = d - 2 * cosine[:, None] * normal
            out = turn - 2 * (d_cosine[:, None, :] * normal[:, :, None] + cosine[:, None, None] * d_normal)
        else:
            ratio = indices[0] / indices[1]
            d_ratio = np.zeros(count)
            d_ratio[14:16] = 1 / indices[1], -ratio / indices[1]
            root = np.sign(cosine) * np.sqrt(1 - ratio**2 * (1 - cosine**2))
            along_d = np.einsum("niq,ni->nq", turn, d)
            d_root = (
                ratio**2 * cosine[:, None] * d_cosine
                - ratio * (1 - cosine**2)[:, None] * d_ratio
                + (1 - ratio**2) * along_d
            ) / root[:, None]
            step = root - ratio * cosine
            d_step = d_root - ratio * d_cosine - cosine[:, None] * d_ratio
            behind = ratio * d + step[:, None] * normal
            out = (
                ratio * turn
                + d[:, :, None] * d_ratio
                + d_step[:, None, :] * normal[:, :, None]
                + step[:, None, None] * d_normal
            )
    # Back to the axes of the lens; a tilt carries point and direction along, a shift the point.
    dp[:, :, 11:14] += _crossed(p)
    out = out.copy()
    out[:, :, 11:14] += _crossed(behind)
    dp, out = axes @ dp, axes @ out
    dp[:, :, 8:11] += np.eye(3)
    both = np.concatenate([dp, out], axis=1)
    return both[:, :, :6], both[:, :, 6:]


def _form(surface: Surface, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Derivatives of the sag by r², once and twice, and those of sag and slope by the form (n, f, 2)."""
    square, c, k1 = x * x + y * y, surface.curvature, 1 + surface.conic
    root = np.sqrt(1 - k1 * c * c * square)
    slope, bend = c / (2 * root), k1 * c**3 / (4 * root**3)
    for power, a in enumerate(surface.coefficients, 2):
        slope = slope + power * a * square ** (power - 1)
        bend = bend + power * (power - 1) * a * square ** (power - 2)
    by_form = np.empty((len(x), 2 + COEFFICIENTS, 2))
    by_form[:, 0, 0] = square / (1 + root) * (1 + k1 * c * c * square / (root * (1 + root)))
    by_form[:, 0, 1] = 1 / (2 * root**3)
    by_form[:, 1, 0] = c**3 * square**2 / (2 * root * (1 + root) ** 2)
    by_form[:, 1, 1] = c**3 * square / (4 * root**3)
    for power in range(2, 2 + COEFFICIENTS):
        by_form[:, power, 0], by_form[:, power, 1] = square**power, power * square ** (power - 1)
    return slope, bend, by_form


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
