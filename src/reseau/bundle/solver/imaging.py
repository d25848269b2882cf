"""Image points and their derivatives by pose, point and camera, in compiled loops over the observations.

For every observation: the misfit v (px) and its derivatives by the pose (rotation about the axes of the
camera, projection centre), by the parameters of the camera, of windows and media, and by the object point.
Rays through windows are computed before, by :mod:`reseau.optics.refraction`; the loops then begin with their
directions. The cameras are the registered models of :mod:`reseau.optics.cameras`. For each model with a
kernel the loops are compiled with this kernel; all other cameras are evaluated by their mappings in
:func:`mapped`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ...core.compiled import Kernel, compiled, kernel
from ...core.data import Array, Mask, Rows
from ...optics.cameras.kernels import CameraColumns, camera
from ...optics.cameras.registry import additional_model, camera_model
from ...optics.mapping import PlaneMapping
from ...optics.poses import seen_by
from ...optics.refraction import RefractedRays
from ...optics.refraction.windows import Mounts
from ..network.network import Network
from ..network.rig import RigValues

# Kind of cameras without a kernel, for which the mapping is used.
_NO_KERNEL = -1
# Steps of Newton's method to the line on which a point is seen, and the change at which it ends.
_LINES, _CLOSE = 20, 1e-11


class Seen(NamedTuple):
    """Image observations in columns (n, …): rows of image, point, camera and additional set (−1 for none).

    `xy` is in pixels; `root` (n, 2, 2) is the lower triangular W with P = Wᵀ W.
    """

    image: Rows
    point: Rows
    camera: Rows
    extra: Rows
    xy: Array
    root: Array


class Orientation(NamedTuple):
    """Rotations (m, 3, 3), projection centres (m, 3), object points (p, 3), velocities and rates (m, 6)."""

    rotation: Array
    x0: Array
    xyz: Array
    motion: Array


class Rays(NamedTuple):
    """How the rays of each camera come about: parallel (c,) or not, and its shutter (c, 4).

    See :meth:`~reseau.bundle.network.shutter.Shutter.columns`; the time of a line is 0 for images that are
    taken at one moment.
    """

    parallel: Mask
    shutter: Array


class Bent(NamedTuple):
    """Rays through windows: path of each image (m,), −1 in air; see RefractedRays for the other columns."""

    path: Rows
    uv: Array
    by: Array


@kernel
def _turned(t: float, motion: Array, i: int, x: Array, y: Array, z: Array) -> None:
    """Write exp(t·ω) x, and the rate ω × of the result, to `y` and `z` (3,)."""
    a, b, c = t * motion[i, 3], t * motion[i, 4], t * motion[i, 5]
    s = a * a + b * b + c * c
    if s > 1e-8:
        w = np.sqrt(s)
        one, two = np.sin(w) / w, (1.0 - np.cos(w)) / s
    else:
        one, two = 1.0 - s / 6.0, 0.5 - s / 24.0
    p, q, r = b * x[2] - c * x[1], c * x[0] - a * x[2], a * x[1] - b * x[0]
    y[0] = x[0] + one * p + two * (b * r - c * q)
    y[1] = x[1] + one * q + two * (c * p - a * r)
    y[2] = x[2] + one * r + two * (a * q - b * p)
    z[0] = motion[i, 4] * y[2] - motion[i, 5] * y[1]
    z[1] = motion[i, 5] * y[0] - motion[i, 3] * y[2]
    z[2] = motion[i, 3] * y[1] - motion[i, 4] * y[0]


@kernel
def _direct(
    k: int, seen: Seen, at: Orientation, bent: Bent, cameras: CameraColumns, x: Array, by_uv: Array,
    d: Array, more: Array, off: Array,
) -> None:  # fmt: skip
    """Write the point in the camera system to `x`; compute misfit and derivatives with the camera kernel."""
    i, j, c = seen.image[k], seen.point[k], seen.camera[k]
    dx, dy, dz = at.xyz[j, 0] - at.x0[i, 0], at.xyz[j, 1] - at.x0[i, 1], at.xyz[j, 2] - at.x0[i, 2]
    for q in range(3):
        x[q] = at.rotation[i, q, 0] * dx + at.rotation[i, q, 1] * dy + at.rotation[i, q, 2] * dz
    u, v = x[0] / x[2], x[1] / x[2]
    if bent.path[i] >= 0:
        u, v = bent.uv[k, 0], bent.uv[k, 1]
    camera(k, c, seen.extra[k], u, v, seen.xy, cameras, by_uv, d, more, off)


@kernel
def _at_once(
    k: int, seen: Seen, at: Orientation, bent: Bent, cameras: CameraColumns, rays: Rays, x: Array,
    room: Array, by_uv: Array, d: Array, more: Array, off: Array,
) -> float:  # fmt: skip
    """As :func:`_direct`, with the arguments of :func:`_scanned`.

    Written out: with a call of `_direct` the compiled loop takes a third longer.
    """
    i, j, c = seen.image[k], seen.point[k], seen.camera[k]
    dx, dy, dz = at.xyz[j, 0] - at.x0[i, 0], at.xyz[j, 1] - at.x0[i, 1], at.xyz[j, 2] - at.x0[i, 2]
    for q in range(3):
        x[q] = at.rotation[i, q, 0] * dx + at.rotation[i, q, 1] * dy + at.rotation[i, q, 2] * dz
    u, v = x[0] / x[2], x[1] / x[2]
    if bent.path[i] >= 0:
        u, v = bent.uv[k, 0], bent.uv[k, 1]
    camera(k, c, seen.extra[k], u, v, seen.xy, cameras, by_uv, d, more, off)
    return 0.0


# A slot: with shutters or parallel rays it is `_scanned`, which costs time that others need not spend.
imaged = _at_once


@kernel
def _scanned(
    k: int, seen: Seen, at: Orientation, bent: Bent, cameras: CameraColumns, rays: Rays, x: Array,
    room: Array, by_uv: Array, d: Array, more: Array, off: Array,
) -> float:  # fmt: skip
    """As :func:`_direct` for all cameras; return the time of the image point.

    Writes the point at time 0, less t·v, to room[0].
    """
    i, j, c = seen.image[k], seen.point[k], seen.camera[k]
    if rays.shutter[c, 0] == 0.0 and not rays.parallel[c]:
        _direct(k, seen, at, bent, cameras, x, by_uv, d, more, off)
        return 0.0
    dx, dy, dz = at.xyz[j, 0] - at.x0[i, 0], at.xyz[j, 1] - at.x0[i, 1], at.xyz[j, 2] - at.x0[i, 2]
    for q in range(3):
        x[q] = at.rotation[i, q, 0] * dx + at.rotation[i, q, 1] * dy + at.rotation[i, q, 2] * dz
    if rays.shutter[c, 0] == 0.0:
        camera(k, c, seen.extra[k], x[0], x[1], seen.xy, cameras, by_uv, d, more, off)
        return 0.0
    # The line on which the point is seen, by Newton's method: f(line) = line with a rolling shutter,
    # f(line) = row with a line camera, where f is the y of the camera at the time of the line.
    line_s, solved, row = rays.shutter[c, 0], rays.shutter[c, 3] == 1.0, rays.shutter[c, 2]
    is_rolling = np.isnan(row)
    line = seen.xy[k, 1]
    a, b, e = x[0], x[1], x[2]
    t, fx, fy = 0.0, 0.0, 0.0
    for step in range(_LINES):
        t = (line - rays.shutter[c, 1]) * line_s
        room[0, 0] = a - t * at.motion[i, 0]
        room[0, 1] = b - t * at.motion[i, 1]
        room[0, 2] = e - t * at.motion[i, 2]
        _turned(t, at.motion, i, room[0], x, room[1])
        _turned(t, at.motion, i, at.motion[i, :3], room[2], room[3])
        for q in range(3):
            room[1, q] -= room[2, q]
        if rays.parallel[c]:
            u, v, up, vp = x[0], x[1], room[1, 0], room[1, 1]
        else:
            u, v = x[0] / x[2], x[1] / x[2]
            up, vp = (room[1, 0] - u * room[1, 2]) / x[2], (room[1, 1] - v * room[1, 2]) / x[2]
        camera(k, c, seen.extra[k], u, v, seen.xy, cameras, by_uv, d, more, off)
        if not solved:
            return float(t)
        fx = (by_uv[0, 0] * up + by_uv[0, 1] * vp) * line_s
        fy = (by_uv[1, 0] * up + by_uv[1, 1] * vp) * line_s
        missing = off[1] + seen.xy[k, 1] - (line if is_rolling else row)
        slope = fy - (1.0 if is_rolling else 0.0)
        if step == _LINES - 1 or abs(missing) < _CLOSE * abs(slope):
            break
        line -= missing / slope
    # A change of the line follows every change: dx = ∂x + fx·dline, dline = −∂y/(fy − 1 or 0).
    across, along = -fx / slope, -1.0 / slope
    for q in range(2):
        by_uv[0, q] += across * by_uv[1, q]
        by_uv[1, q] *= along
    for q in range(d.shape[1]):
        d[0, q] += across * d[1, q]
        d[1, q] *= along
    for q in range(more.shape[1]):
        more[0, q] += across * more[1, q]
        more[1, q] *= along
    off[1] = line - seen.xy[k, 1]
    return float(t)


@kernel
def _misfit(
    begin: int,
    end: int,
    own: int,
    kind: Rows,
    seen: Seen,
    at: Orientation,
    bent: Bent,
    cameras: CameraColumns,
    rays: Rays,
    out: Array,
) -> None:
    """Write weighted misfits to `out` (n, 2), for observations begin…end by cameras of kind `own`."""
    by_uv, off, x = np.empty((2, 2)), np.empty(2), np.empty(3)
    d, more = np.empty((2, cameras.values.shape[1])), np.empty((2, cameras.extra.shape[1]))
    root = seen.root
    for k in range(begin, end):
        if kind[seen.camera[k]] != own:
            continue
        _direct(k, seen, at, bent, cameras, x, by_uv, d, more, off)
        out[k, 0] = root[k, 0, 0] * off[0]
        out[k, 1] = root[k, 1, 0] * off[0] + root[k, 1, 1] * off[1]


@kernel
def _scanned_misfit(
    begin: int,
    end: int,
    own: int,
    kind: Rows,
    seen: Seen,
    at: Orientation,
    bent: Bent,
    cameras: CameraColumns,
    rays: Rays,
    out: Array,
) -> None:
    """As :func:`_misfit`, for networks with shutters or parallel rays; others are computed faster by that."""
    by_uv, off, x, room = np.empty((2, 2)), np.empty(2), np.empty(3), np.empty((4, 3))
    d, more = np.empty((2, cameras.values.shape[1])), np.empty((2, cameras.extra.shape[1]))
    root = seen.root
    for k in range(begin, end):
        if kind[seen.camera[k]] != own:
            continue
        _scanned(k, seen, at, bent, cameras, rays, x, room, by_uv, d, more, off)
        out[k, 0] = root[k, 0, 0] * off[0]
        out[k, 1] = root[k, 1, 0] * off[0] + root[k, 1, 1] * off[1]


@kernel
def _derive(
    begin: int, end: int, own: int, kind: Rows, seen: Seen, at: Orientation, bent: Bent,
    cameras: CameraColumns, rays: Rays, moving: int, free: Rows, count: Rows, width: Rows, movable: Array,
    r_out: Array, a_out: Array, b_out: Array,
) -> None:  # fmt: skip
    """Compute weighted misfits (n, 2) and derivatives of observations begin…end by cameras of kind `own`.

    Derivatives by the pose are written to a_out[:, :, :6], those by the `count` (c,) parameters `free`
    (c, p) of the camera to the columns after it, those by the `width` (e,) additional parameters to the last
    columns, those by windows and media to the columns before these, those by the `moving` (0 or 6) velocities
    and rates to the columns before these, those by the point to b_out (n, 2, 3); `movable` (p, 3) is 0 for
    held coordinates and 1 for others. Where rays are parallel, the projection centre moves along the axes of
    the camera.
    """
    by_uv, off, x, room = np.empty((2, 2)), np.empty(2), np.empty(3), np.empty((4, 3))
    back, body = np.empty(3), np.empty(3)
    d, more = np.empty((2, cameras.values.shape[1])), np.empty((2, cameras.extra.shape[1]))
    g, root, turn = np.empty((2, 3)), seen.root, at.rotation
    last = a_out.shape[2] - cameras.extra.shape[1]
    windows = max(bent.by.shape[2] - 9, 0)
    for k in range(begin, end):
        if kind[seen.camera[k]] != own:
            continue
        t = imaged(k, seen, at, bent, cameras, rays, x, room, by_uv, d, more, off)
        w0, w1, w2 = root[k, 0, 0], root[k, 1, 0], root[k, 1, 1]
        for q in range(2):
            g[0, q] = w0 * by_uv[0, q]
            g[1, q] = w1 * by_uv[0, q] + w2 * by_uv[1, q]
        i, j, c, e = seen.image[k], seen.point[k], seen.camera[k], seen.extra[k]
        r_out[k, 0] = w0 * off[0]
        r_out[k, 1] = w1 * off[0] + w2 * off[1]
        through = bent.path[i] >= 0
        for q in range(2):
            if through:
                for s in range(6):
                    a_out[k, q, s] = g[q, 0] * bent.by[k, 0, s] + g[q, 1] * bent.by[k, 1, s]
                for s in range(3):
                    along = g[q, 0] * bent.by[k, 0, 6 + s] + g[q, 1] * bent.by[k, 1, 6 + s]
                    b_out[k, q, s] = along * movable[j, s]
                for s in range(windows):
                    a_out[k, q, last - windows + s] = (
                        g[q, 0] * bent.by[k, 0, 9 + s] + g[q, 1] * bent.by[k, 1, 9 + s]
                    )
                continue
            for s in range(3):
                body[s] = x[s]
            if rays.parallel[c]:
                g[q, 2] = 0.0
            else:
                g[q, 0] /= x[2]
                g[q, 1] /= x[2]
                g[q, 2] = -(g[q, 0] * x[0] + g[q, 1] * x[1]) / x[2]
            if rays.shutter[c, 0] != 0.0:
                if moving:
                    _by_rates(t, at.motion, i, x, g, q, a_out, k, last - windows - 3)
                _turned(-t, at.motion, i, g[q], back, room[1])
                for s in range(3):
                    g[q, s] = back[s]
                if moving:
                    for s in range(3):
                        a_out[k, q, last - windows - 6 + s] = -t * g[q, s]
                # The rotation turns the point before the shift.
                for s in range(3):
                    body[s] = room[0, s] + t * at.motion[i, s]
            a_out[k, q, 0] = g[q, 2] * body[1] - g[q, 1] * body[2]
            a_out[k, q, 1] = g[q, 0] * body[2] - g[q, 2] * body[0]
            a_out[k, q, 2] = g[q, 1] * body[0] - g[q, 0] * body[1]
            for s in range(3):
                along = g[q, 0] * turn[i, 0, s] + g[q, 1] * turn[i, 1, s] + g[q, 2] * turn[i, 2, s]
                a_out[k, q, 3 + s] = -(g[q, s] if rays.parallel[c] else along)
                b_out[k, q, s] = along * movable[j, s]
        for s in range(count[c]):
            f = free[c, s]
            a_out[k, 0, 6 + s] = w0 * d[0, f]
            a_out[k, 1, 6 + s] = w1 * d[0, f] + w2 * d[1, f]
        if e >= 0:
            for s in range(width[e]):
                a_out[k, 0, last + s] = w0 * more[0, s]
                a_out[k, 1, last + s] = w1 * more[0, s] + w2 * more[1, s]


@kernel
def _by_rates(
    t: float, motion: Array, i: int, x: Array, g: Array, q: int, a_out: Array, k: int, at: int
) -> None:
    """Write the derivatives by the rotation rates: t·J(tω)ᵀ (x × g), where exp(θ + dθ) ≈ exp(J dθ) exp(θ)."""
    a, b, c = t * motion[i, 3], t * motion[i, 4], t * motion[i, 5]
    s = a * a + b * b + c * c
    if s > 1e-8:
        w = np.sqrt(s)
        one, two = (1.0 - np.cos(w)) / s, (w - np.sin(w)) / (s * w)
    else:
        one, two = 0.5 - s / 24.0, 1.0 / 6.0 - s / 120.0
    l0 = x[1] * g[q, 2] - x[2] * g[q, 1]
    l1 = x[2] * g[q, 0] - x[0] * g[q, 2]
    l2 = x[0] * g[q, 1] - x[1] * g[q, 0]
    m0, m1, m2 = b * l2 - c * l1, c * l0 - a * l2, a * l1 - b * l0
    a_out[k, q, at] = t * (l0 - one * m0 + two * (b * m2 - c * m1))
    a_out[k, q, at + 1] = t * (l1 - one * m1 + two * (c * m0 - a * m2))
    a_out[k, q, at + 2] = t * (l2 - one * m2 + two * (a * m1 - b * m0))


class _Loops(NamedTuple):
    """The loops, compiled with the kernel of a camera model and that of its additional parameters."""

    misfit: Callable[..., None]
    derive: Callable[..., None]


@cache
def _loops(model: str, additional: str | None, scanned: bool) -> _Loops:
    slots: dict[str, Kernel[..., Any]] = {}
    own = camera_model(model).kernel
    if own is not None:
        slots["camera"] = own
    if additional is not None:
        slots["additional"] = additional_model(additional).kernel
    if scanned:
        slots["imaged"] = _scanned
    return _Loops(compiled(_scanned_misfit if scanned else _misfit, **slots), compiled(_derive, **slots))


class Imaging:
    """The cameras of a network in columns, with their compiled loops.

    Parameters
    ----------
    network : Network
        Network with the cameras.
    sets : tuple of (int, str)
        Camera and label of each set of additional parameters.
    origin : ndarray (3,)
        Point of object space from which the coordinates of points are counted.
    mounts : ndarray of int (c,)
        Number of each camera among those whose places on a rig are unknown, and move windows before it; −1
        for the others.
    """

    def __init__(
        self, network: Network, sets: tuple[tuple[int, str], ...], origin: Array, mounts: Rows
    ) -> None:
        self.refraction, self.origin, self._mounts = network.refraction, origin, mounts
        self._air = np.full(len(network.images), -1, dtype=np.intp)
        if network.refraction is not None:
            self._path_of, self._path, self._mounted = network.refraction.split(network.camera_of)
        kinds = network.kernels
        known = list(dict.fromkeys(kind for kind in kinds if kind is not None))
        extras = [entry.additional for entry in (network.cameras[c] for c, _ in sets) if entry.additional]
        scanned = any(entry.shutter is not None or entry.parallel for entry in network.cameras)
        self._loops = [_loops(*kind, scanned) for kind in known]
        self.kind: Rows = np.array(
            [_NO_KERNEL if kind is None else known.index(kind) for kind in kinds], dtype=np.intp
        )
        self.rays = Rays(
            np.array([entry.parallel for entry in network.cameras], dtype=np.bool_),
            np.array([entry.shutter_columns for entry in network.cameras]),
        )
        self.moving = 6 if any(entry.moving for entry in network.cameras) else 0
        self.width: Rows = np.array([len(extra.names) for extra in extras] or [0], dtype=np.intp)
        constants = [entry.constants for entry in network.cameras]
        padded = np.zeros((len(constants), max(len(row) for row in constants)))
        for row, given in zip(padded, constants, strict=True):
            row[: len(given)] = given
        grid = [((c.width - 1) / 2, (c.height - 1) / 2, *c.pitch_mm) for c in network.cameras]
        nothing = np.zeros((0, 0))
        self._columns = CameraColumns(
            nothing,
            padded,
            np.array(grid),
            nothing,
            np.array([extra.base for extra in extras] or [(0.0, 0.0)]),
        )

    def bent(
        self,
        seen: Seen,
        at: Orientation,
        values: Array,
        rig: RigValues | None,
        *,
        derivatives: bool,
        crossings: Array | None = None,
    ) -> tuple[Bent, Callable[[int, int], None]]:
        """Return room for the rays through windows, and a function that computes them for a part of `seen`.

        Parameters
        ----------
        seen : Seen
            Observations.
        at : Orientation
            Poses and points.
        values : ndarray (r,)
            Parameters of windows and media.
        rig : RigValues, optional
            Places of the cameras on a rig.
        derivatives : bool
            Whether derivatives are needed.
        crossings : ndarray (n, k, 3), optional
            See :meth:`RefractedRays.worker`.
        """
        if self.refraction is None:
            return Bent(self._air, np.zeros((0, 2)), np.zeros((0, 2, 0))), lambda begin, end: None
        columns = self.refraction.columns(values, self.origin, self._places(rig))
        width = 9 + columns.by_parameters.shape[3] if derivatives else 0
        rays = RefractedRays.empty(len(seen.image), width)
        work = RefractedRays.worker(
            columns, self._path_of, at.rotation, at.x0, at.xyz, seen.image, seen.point, rays, crossings
        )
        return Bent(self._path_of, rays.uv, rays.by), work

    def _places(self, rig: RigValues | None) -> Mounts:
        """Paths of windows by the places of their cameras; those not on a rig are anywhere."""
        own = self._mounted
        rotation, base = np.tile(np.eye(3), (len(own), 1, 1)), np.zeros((len(own), 3))
        if rig is not None:
            rotation[own >= 0], base[own >= 0] = rig.rotation[own[own >= 0]], rig.base[own[own >= 0]]
        number = np.where(own >= 0, self._mounts[own], -1)
        column = np.where(number >= 0, 6 * number, -1).astype(np.intp)
        return Mounts(self._path, rotation, base, column, int(self._mounts.max(initial=-1)) + 1)

    def misfit(
        self, begin: int, end: int, seen: Seen, at: Orientation, bent: Bent, values: Array, extra: Array,
        out: Array,
    ) -> None:  # fmt: skip
        """Write weighted misfits of observations begin…end to `out` (n, 2), for cameras with a kernel.

        Parameters
        ----------
        begin, end : int
            Rows of `seen`.
        seen : Seen
            Observations.
        at : Orientation
            Poses and points.
        bent : Bent
            Rays through windows.
        values, extra : ndarray (c, p), (e, a)
            Parameters of the cameras and additional parameters, padded.
        out : ndarray (n, 2)
            Result.
        """
        cameras = self._columns._replace(values=values, extra=extra)
        for own, loops in enumerate(self._loops):
            loops.misfit(begin, end, own, self.kind, seen, at, bent, cameras, self.rays, out)

    def derive(
        self, begin: int, end: int, seen: Seen, at: Orientation, bent: Bent, values: Array, extra: Array,
        free: Rows, count: Rows, movable: Array, r_out: Array, a_out: Array, b_out: Array,
    ) -> None:  # fmt: skip
        """Write weighted misfits to r_out (n, 2) and compute derivatives, for cameras with a kernel.

        Derivatives by the pose are written to a_out[:, :, :6], those by the `count` (c,) parameters `free`
        (c, p) of the camera to the columns after it, those by additional parameters to the last columns,
        those by windows and media to the columns before these, those by the point to b_out (n, 2, 3);
        `movable` (p, 3) is 0 for held coordinates and 1 for others. Other parameters as in :meth:`misfit`.
        """
        cameras = self._columns._replace(values=values, extra=extra)
        for own, loops in enumerate(self._loops):
            loops.derive(
                begin, end, own, self.kind, seen, at, bent, cameras, self.rays, self.moving, free, count,
                self.width, movable, r_out, a_out, b_out,
            )  # fmt: skip


def in_cameras(at: Orientation, image: Rows, point: Rows) -> Array:
    """Object points (n, 3) in the systems of their images."""
    x = at.rotation[image] @ (at.xyz[point] - at.x0[image])[:, :, None]
    return np.asarray(x[:, :, 0])


def mapped_points(
    camera: PlaneMapping, at: Orientation, image: Rows, point: Rows, bent: Bent, rows: Rows
) -> Array:
    """Compute image points (n, 2) only; see :func:`mapped`."""
    x = in_cameras(at, image, point)
    uv = x[:, :2] if camera.parallel else x[:, :2] / x[:, 2:]
    through = np.flatnonzero(bent.path[image] >= 0)
    uv[through] = bent.uv[rows[through]]
    return np.asarray(camera(uv))


def mapped(
    camera: PlaneMapping, at: Orientation, image: Rows, point: Rows, bent: Bent, rows: Rows
) -> tuple[Array, Array, Array, Array, Array]:
    """Compute image points of any camera and their derivatives, in NumPy.

    Parameters
    ----------
    camera : PlaneMapping
        From ideal directions to pixels.
    at : Orientation
        Poses and points.
    image, point : ndarray of int (n,)
        Rows of poses and points.
    bent : Bent
        Rays through windows.
    rows : ndarray of int (n,)
        Their rows.

    Returns
    -------
    ndarray (n, 2), ndarray (n, 2, 6), ndarray (n, 2, u), ndarray (n, 2, 3), ndarray (n, 2, f)
        Pixels, and derivatives by the pose (rotation about the axes of the camera, projection centre), by the
        parameters of the camera, by the point, and by the free parameters of windows and media.
    """
    turn, x = at.rotation[image], in_cameras(at, image, point)
    xy, by_x, by_camera = seen_by(camera, x)
    by_point = by_x @ turn
    # g·(δ × x) = δ·(x × g)
    by_pose = np.concatenate([np.cross(x[:, None, :], by_x), -by_point], axis=2)
    by_windows = np.zeros((len(image), 2, max(bent.by.shape[2] - 9, 0)))
    if camera.parallel:
        by_pose[:, :, 3:] = -by_x
    through = np.flatnonzero(bent.path[image] >= 0)
    if len(through):
        behind = rows[through]
        xy[through], by_uv, by_camera[through] = camera.derivatives(bent.uv[behind])
        if bent.by.shape[2]:
            along = by_uv @ bent.by[behind]
            by_pose[through], by_point[through] = along[:, :, :6], along[:, :, 6:9]
            by_windows[through] = along[:, :, 9:]
    return xy, by_pose, by_camera, by_point, by_windows
