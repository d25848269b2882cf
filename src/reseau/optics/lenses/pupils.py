r"""Rays from points of the object through given points of the stop.

The real stop limits the light, not its paraxial image. A ray through a point of the stop is found by Newton's
method on the point of the entrance pupil's plane at which it is aimed; the determinant of that mapping also
gives the solid angle of an element of the stop, and with it the light that passes the element.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.data import Array, Mask
from ...core.errors import UsageError
from ..newton import determinant, solve_2x2
from .paraxial import Paraxial
from .prescription import Prescription
from .trace import Rays, Tracer

_STEPS = 12
"""Largest number of Newton steps."""
_NEAR = 1e-10
"""A ray is aimed when it passes the stop this near to its point, in radii of the stop."""


@dataclass(frozen=True, eq=False)
class PupilElements:
    """Points of the stop with weights that add up to 1.

    Parameters
    ----------
    xy : ndarray (n, 2)
        In radii of the stop.
    weights : ndarray (n,)

    Examples
    --------
    >>> equal, gauss = PupilElements.equal_areas(3), PupilElements.gauss(3)
    >>> len(equal.xy), len(gauss.xy), bool(np.isclose(gauss.weights @ (gauss.xy**2).sum(axis=1), 0.5))
    (19, 40, True)
    """

    xy: Array
    weights: Array

    @classmethod
    def equal_areas(cls, rings: int) -> PupilElements:
        """A central element, and rings of 6, 12, 18 … elements around it, all of the same area."""
        total = 1 + 3 * rings * (rings - 1)
        found = [np.zeros((1, 2))]
        for k in range(1, rings):
            inner, outer = (np.sqrt((1 + 3 * j * (j - 1)) / total) for j in (k, k + 1))
            found.append(_ring(np.sqrt((inner**2 + outer**2) / 2), 6 * k, 0.5 * (k % 2)))
        return cls(np.concatenate(found), np.full(total, 1 / total))

    @classmethod
    def gauss(cls, rings: int) -> PupilElements:
        """Gauss's quadrature in the square of the radius (Forbes 1988, J. Opt. Soc. Am. A 5, 1943).

        Moments of a spot are exact for aberrations that are polynomials, already with few rings.
        """
        node, weight = np.polynomial.legendre.leggauss(rings)
        found, weights = [], []
        for k, (square, w) in enumerate(zip((node + 1) / 2, weight / 2, strict=True)):
            count = max(8, int(np.ceil(2 * np.pi * np.sqrt(square) * rings)) // 2 * 2)
            # The golden section keeps points of different rings from lining up.
            found.append(_ring(np.sqrt(square), count, (k * 0.618034) % 1.0))
            weights.append(np.full(count, w / count))
        return cls(np.concatenate(found), np.concatenate(weights))

    def turned(self, angle: float) -> PupilElements:
        """The same elements turned about the centre of the stop, radians."""
        c, s = np.cos(angle), np.sin(angle)
        return PupilElements(self.xy @ np.array([[c, s], [-s, c]]), self.weights)


def _ring(radius: float, count: int, offset: float) -> Array:
    angle = 2 * np.pi * (np.arange(count) + offset) / count
    return np.asarray(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


@dataclass(frozen=True, eq=False)
class Aimed:
    """Rays from points of the object through points of the stop.

    Parameters
    ----------
    rays : Rays
        n rays in the axes of the lens; NaN where there is none.
    solid_angle : ndarray (n,)
        Solid angle, seen from the point of the object, of a unit area of the stop, sr/mm².
    found : ndarray of bool (n,)
        Whether there is a ray through the point of the stop.

    Examples
    --------
    >>> nothing = np.full((1, 3), np.nan)
    >>> Aimed(Rays(nothing, nothing), np.zeros(1), np.array([False])).found.any()
    np.False_
    """

    rays: Rays
    solid_angle: Array
    found: Mask


def aim(lens: Prescription, points: Array, pupil: Array, wavelength_nm: float | None = None) -> Aimed:
    """Aim rays from points of the object at points of the real stop.

    Parameters
    ----------
    lens : Prescription
    points : ndarray (n, 3)
        Points of the object in the axes of the lens, mm, in front of its first surface.
    pupil : ndarray (n, 2)
        Points of the stop in its radii.
    wavelength_nm : float, optional
        By default that of the corresponding rays.

    Raises
    ------
    UsageError
        When a point lies behind the first surface, or the radius of the stop is not known.

    Notes
    -----
    Derived in ``docs/mathematics/lenses.md``.

    Examples
    --------
    >>> from reseau.optics.lenses import AIR, Prescription, Tracer, glass, in_order
    >>> rows = [(0.02, 5.0, glass("N-BK7")), (-0.02, 3.0, AIR), (0.0, 60.0, AIR)]
    >>> lens = Prescription(in_order(rows), stop=2, stop_radius=4.0)
    >>> rays = aim(lens, np.array([[10.0, 0.0, -200.0]]), np.array([[0.5, 0.5]])).rays
    >>> Tracer(lens, last=2).trace(rays).xy.round(9)
    array([[2., 2.]])
    """
    return Aiming(lens, wavelength_nm)(points, pupil)


class Aiming:
    """A lens at one wavelength, ready to aim rays at its stop; see :func:`aim`.

    Parameters
    ----------
    lens : Prescription
    wavelength_nm : float, optional
        By default that of the corresponding rays.

    Raises
    ------
    UsageError
        When the radius of the stop is not known.

    Examples
    --------
    >>> from reseau.optics.lenses import AIR, Prescription, glass, in_order
    >>> rows = [(0.02, 5.0, glass("N-BK7")), (-0.02, 3.0, AIR), (0.0, 60.0, AIR)]
    >>> aiming = Aiming(Prescription(in_order(rows), stop=2, stop_radius=4.0))
    >>> aiming(np.array([[0.0, 0.0, -200.0]]), np.zeros((1, 2))).rays.directions
    array([[0., 0., 1.]])
    """

    def __init__(self, lens: Prescription, wavelength_nm: float | None = None) -> None:
        if lens.stop_radius is None:
            raise UsageError("the radius of its stop is not known", where=lens.name, do="give `stop_radius`")
        self.lens, self.radius, self.front = lens, lens.stop_radius, lens.surfaces[0]
        position, scale = Paraxial(lens, wavelength_nm).entrance_pupil
        # A plane at which rays are aimed: that of the entrance pupil unless it is far away.
        near = np.isfinite(position) and abs(position) < 1e3 * self.radius
        self._plane = self.front.vertex + (position if near else 0.0) * self.front.axes[:, 2]
        self._scale = scale if near and np.isfinite(scale) else 1.0
        self._to_stop = Tracer(lens, wavelength_nm, last=lens.stop, apertures=False)

    def __call__(self, points: Array, pupil: Array) -> Aimed:
        """Rays from points (n, 3) of the object through points (n, 2) of the stop; see :func:`aim`."""
        points, wanted = np.atleast_2d(points), self.radius * np.atleast_2d(pupil)
        _checked(self.lens, points)
        found = self._newton(points, self._scale * wanted, wanted)
        if not found[2].all():  # wide angles: approach the point from the axis
            found = self._approached(points, self._scale * wanted, wanted, found)
        targets, det, ok = found
        away = self._away(targets, points)
        distance = np.linalg.norm(away, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            angle = np.abs(away @ self.front.axes[:, 2]) / distance**3 / np.abs(det)
        rays = Rays(np.where(ok[:, None], points, np.nan), self._along(away))
        rays = Rays(rays.xyz, np.where(ok[:, None], rays.directions, np.nan))
        return Aimed(rays, np.where(ok, angle, 0.0), ok)

    def why(self, point: Array) -> str | None:
        """Why there is no principal ray of a point (3,); None if there is one.

        The ray towards the middle of the entrance pupil says what happens to such rays in front of the stop.
        """
        aimed = self(point[None], np.zeros((1, 2)))
        if aimed.found[0]:
            return None
        towards = Rays(point[None], self._along(self._away(np.zeros((1, 2)), point[None])))
        lost = int(self._to_stop.trace(towards).lost[0])
        return f"its principal ray {self._to_stop.reason(lost)}" if lost else "no ray passes the stop"

    def _away(self, targets: Array, start: Array) -> Array:
        """Vectors (n, 3) from points (n, 3) to targets (n, 2) in the plane at which rays are aimed."""
        return np.asarray(self._plane + targets @ self.front.axes[:, :2].T - start)

    def _along(self, away: Array) -> Array:
        """Directions (n, 3) of the light, also where the pupil lies in front of the object."""
        length = np.linalg.norm(away, axis=1) * np.sign(away @ self.front.axes[:, 2])
        return np.asarray(away / length[:, None])

    def _newton(self, points: Array, targets: Array, wanted: Array) -> tuple[Array, Array, Mask]:
        """Targets for rays through the wanted points of the stop, determinants, and which were found."""
        targets = targets.copy()
        det, ok = np.full(len(points), np.nan), np.zeros(len(points), dtype=np.bool_)
        h = 1e-6 * self.radius
        todo = np.arange(len(points))
        for _ in range(_STEPS):
            at, start = targets[todo], np.tile(points[todo], (3, 1))
            three = np.concatenate([at, at + np.array([h, 0]), at + np.array([0, h])])
            rays = Rays(start, self._along(self._away(three, start)))
            hit = self._to_stop.trace(rays).xy.reshape(3, -1, 2)
            miss = hit[0] - wanted[todo]
            slope = np.stack([hit[1] - hit[0], hit[2] - hit[0]], axis=2) / h
            det[todo] = determinant(slope)
            done = np.hypot(miss[:, 0], miss[:, 1]) < _NEAR * self.radius
            ok[todo[done]] = True
            step = solve_2x2(slope, miss)
            usable = ~done & np.isfinite(step).all(axis=1)
            targets[todo[usable]] -= step[usable]
            todo = todo[usable]
            if not len(todo):
                break
        return targets, det, ok

    def _approached(
        self, points: Array, guess: Array, wanted: Array, found: tuple[Array, Array, Mask]
    ) -> tuple[Array, Array, Mask]:
        """Aim again what was not found, from points nearer to the axis outwards."""
        targets, det, ok = found
        rest = np.flatnonzero(~ok)
        axis, current = points[rest].copy(), guess[rest]
        axis[:, :2] = self.front.vertex[:2]
        alive = np.ones(len(rest), dtype=np.bool_)
        for share in np.linspace(0, 1, 9):
            near = axis + share * (points[rest] - axis)
            new, d, good = self._newton(near, current, wanted[rest])
            alive &= good
            current = np.where(good[:, None], new, current)
            det[rest], targets[rest] = d, current
        ok[rest] = alive
        return targets, det, ok


def _checked(lens: Prescription, points: Array) -> None:
    front = lens.surfaces[0]
    local = (points - front.vertex) @ front.axes
    if not np.isfinite(local).all():
        raise UsageError("a point of the object is not finite", where=lens.name)
    with np.errstate(invalid="ignore"):
        sag = np.nan_to_num(front.sag(local[:, 0], local[:, 1]))
    if (local[:, 2] >= np.minimum(sag, 0)).any():
        raise UsageError(
            f"a point of the object lies behind {front.name or 'the first surface'}",
            where=lens.name,
            do="objects are in front of the lens, at negative z",
        )
