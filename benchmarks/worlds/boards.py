"""Pictures of a printed coded testfield by a camera of the OpenCV model, drawn from distances to its edges.

A pixel looks through the inverse of the distortion, found by iteration, at a place of the plane board; what
is printed there follows from signed distances to the outlines of the nearest target and of the lines. Nothing
of the project is used but the numbers of a design file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from .pixels import Array, Scene, form, form_at, interpolated

__all__ = ["OPENCV", "Camera", "Field", "Pose", "bounds", "picture", "poses"]


@dataclass(frozen=True)
class Camera:
    """Parameters of the OpenCV model and the size of the image in pixels."""

    fx: float = 1050.0
    fy: float = 1052.0
    cx: float = 482.3
    cy: float = 355.1
    k1: float = -0.15
    k2: float = 0.06
    p1: float = 0.0004
    p2: float = -0.0003
    width: int = 960
    height: int = 720

    def distorted(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Distorted tangents of directions."""
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + self.k2 * r2)
        return (
            x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
            y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
        )

    def directions(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Tangents of directions in which pixels look."""
        a, b = (u - self.cx) / self.fx, (v - self.cy) / self.fy
        x, y = a.copy(), b.copy()
        for _ in range(9):
            p, q = self.distorted(x, y)
            x += a - p
            y += b - q
        return x, y

    def image(self, points: Array) -> Array:
        """Images (n, 2) of points (n, 3) in the system of the camera."""
        x, y = self.distorted(points[:, 0] / points[:, 2], points[:, 1] / points[:, 2])
        return np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=1)


OPENCV = Camera()


@dataclass(frozen=True)
class Pose:
    """Rotation (3, 3) and translation (3,) from the board, y upwards, to the camera."""

    rotation: Array
    translation: Array

    @classmethod
    def towards(
        cls, tilt: float, azimuth: float, turn: float, distance: float, aim: tuple[float, float]
    ) -> Pose:
        """A camera tilted against the normal of the board (degrees), which looks at a point of it."""
        t, a, k = np.deg2rad([tilt, azimuth, turn])
        place = distance * np.array([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)])
        forward = -place / distance
        right = np.cross(forward, [np.sin(a), -np.cos(a), 0.0])
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        axes = np.stack([right * np.cos(k) + down * np.sin(k), down * np.cos(k) - right * np.sin(k), forward])
        return cls(axes, -axes @ (place + np.array([*aim, 0.0])))


def poses(
    count: int, seed: int, half: float, tilts: tuple[float, float] = (0.0, 50.0), near: float = 3.2
) -> list[Pose]:
    """Views of a board of this half width from all sides."""
    random = np.random.default_rng(seed)
    return [
        Pose.towards(
            random.uniform(*tilts),
            360 * (k + random.uniform(0, 0.7)) / count,
            90 * k + random.uniform(-30, 30),
            near * half * random.uniform(1.0, 1.15),
            tuple(random.uniform(-0.1, 0.1, 2) * half),
        )
        for k in range(count)
    ]


_SHAPES = {"square": 0, "triangle": 1, "cross": 2, "circle": 3}


@numba.njit(cache=True)
def _inside(shape: int, size: float, x: float, y: float) -> float:
    """Signed distance inside an outline, about its centroid."""
    if shape == 3:
        return size / 2 - np.hypot(x, y)
    a, b = max(abs(x), abs(y)), min(abs(x), abs(y))
    if shape == 0:
        return size / 2 - a
    if shape == 2:
        return -max(a - size / 2, b - size / 6)
    return size / np.sqrt(12) - max(abs(x) * np.sqrt(3) / 2 + y / 2, -y)


@numba.njit(cache=True)
def _nearest(places: Array, x: float) -> int:
    """Index of the nearest of ascending places."""
    low, high = 0, len(places) - 1
    while low < high:
        middle = (low + high) // 2
        if x > (places[middle] + places[middle + 1]) / 2:
            low = middle + 1
        else:
            high = middle
    return low


@numba.njit(cache=True)
def _share(inside: float, change: float) -> float:
    """Share of a sample inside an edge, from the signed distance and its change from sample to sample."""
    return min(1.0, max(0.0, 0.5 + inside / max(change, 1e-9)))


@numba.njit(cache=True)
def _drawn(
    x: Array, y: Array, columns: Array, rows: Array, table: Array, targets: Array, lines: Array,
    vertical: Array, horizontal: Array, border: float,
) -> tuple[Array, Array]:  # fmt: skip
    """Shares (h, w) of board and of ink in samples at places of the board.

    Targets (n, 6) are x, y, shape, size, and cosine and sine of the angle; lines their width and extent.
    """
    h, w = x.shape
    board, ink = np.zeros((h, w)), np.zeros((h, w))
    for i in range(h):
        up, down = max(i - 1, 0), min(i + 1, h - 1)
        for j in range(w):
            left, right = max(j - 1, 0), min(j + 1, w - 1)
            xu, yu = (x[i, right] - x[i, left]) / (right - left), (y[i, right] - y[i, left]) / (right - left)
            xv, yv = (x[down, j] - x[up, j]) / (down - up), (y[down, j] - y[up, j]) / (down - up)
            a, b = x[i, j], y[i, j]
            across, along = np.hypot(xu, xv), np.hypot(yu, yv)
            in_x, in_y = border - abs(a), border - abs(b)
            if not min(in_x, in_y) > -1e3 * border:
                continue
            board[i, j] = _share(min(in_x, in_y), across if in_x < in_y else along)
            if board[i, j] == 0:
                continue
            dark = 0.0
            k = table[_nearest(columns, a), _nearest(rows, b)]
            if k >= 0:
                shape, size, cosine, sine = int(targets[k, 2]), targets[k, 3], targets[k, 4], targets[k, 5]
                dx, dy = a - targets[k, 0], b - targets[k, 1]
                if max(abs(dx), abs(dy)) < size + across + along:
                    p, q = cosine * dx + sine * dy, cosine * dy - sine * dx
                    s = 1e-3 * size
                    inside = _inside(shape, size, p, q)
                    by_p = (_inside(shape, size, p + s, q) - _inside(shape, size, p - s, q)) / (2 * s)
                    by_q = (_inside(shape, size, p, q + s) - _inside(shape, size, p, q - s)) / (2 * s)
                    by_x, by_y = cosine * by_p - sine * by_q, sine * by_p + cosine * by_q
                    dark = _share(inside, np.hypot(by_x * xu + by_y * yu, by_x * xv + by_y * yv))
            for m in range(2):
                # The width of a line is along x or y, and its ends are along the other.
                place, other = (a, b) if m == 0 else (b, a)
                centres = vertical if m == 0 else horizontal
                beside = lines[0] / 2 - abs(place - centres[_nearest(centres, place)])
                ends = min(other - lines[2 - m], lines[4 - m] - other)
                change = across if (beside < ends) == (m == 0) else along
                dark = max(dark, _share(min(beside, ends), change))
            ink[i, j] = dark
    return board, ink


class Field:
    """A printed testfield: its targets, lines and border, as functions of the position on the board.

    Parameters
    ----------
    design : dict
        Contents of a file of the schema ``testfield-design/1``.
    """

    def __init__(self, design: dict[str, Any]) -> None:
        targets, lines = design["targets"], design["lines"]
        self.contents = design
        self.ids = tuple(targets["id"])
        self.xy = np.column_stack([targets["x"], targets["y"]])
        grid = [np.unique(np.round(place, 6)) for place in self.xy.T]
        table = np.full([len(places) for places in grid], -1)
        at = [np.argmin(np.abs(self.xy[:, k, None] - grid[k]), axis=1) for k in range(2)]
        table[at[0], at[1]] = np.arange(len(self.xy))
        shape, angle = [_SHAPES[name] for name in targets["shape"]], np.deg2rad(targets["angle"])
        kinds = np.column_stack([self.xy, shape, targets["size"], np.cos(angle), np.sin(angle)])
        bars = np.array([lines["width"], *lines["extent"]])
        lined = [np.array(lines[name]) for name in ("vertical_x", "horizontal_y")]
        border = max(lines["extent"][2:]) + 0.6 * design["pitch"]
        self._drawn = (*grid, table, kinds, bars, *lined, border)

    def printed(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Shares (h, w) of board and of ink in samples at positions, which follow each other closely."""
        board, ink = _drawn(x, y, *self._drawn)
        return board, ink

    def design(self) -> dict[str, Any]:
        """The design as a document."""
        return self.contents


def picture(
    design: dict[str, Any],
    camera: Camera,
    pose: Pose,
    sigma: float = 0.7,
    noise: float = 1.5,
    seed: int = 0,
    oversampling: int = 4,
) -> tuple[Array, Array]:
    """An 8-bit picture of a testfield, and the images (n, 2) of its targets.

    Parameters
    ----------
    design : dict
        Contents of a file of the schema ``testfield-design/1``.
    sigma : float
        Standard deviation of the point-spread function, in pixels.
    noise : float
        Standard deviation of the grey values before they are rounded.
    """
    field = Field(design)
    light = form(_seen(field, camera, pose), camera.width, camera.height, sigma, oversampling=oversampling)
    light += np.random.default_rng(seed).normal(0, noise, light.shape)
    return np.clip(np.rint(light), 0, 255), _images(field, camera, pose)


def bounds(
    design: dict[str, Any],
    camera: Camera,
    pose: Pose,
    rows: Array,
    sigma: float = 0.7,
    noise: float = 1.5,
) -> Array:
    """Cramér–Rao bounds (n, 2) of the coordinates of some targets in a picture; see `picture`.

    Contrast, level and slopes of the background and the width of the point-spread function are unknown, for
    each target alone. Only pixels count that are nearer to the target than to others, up to half a step.

    Parameters
    ----------
    rows : ndarray of int (n,)
        Targets wanted.
    """
    field = Field(design)
    seen, at = _seen(field, camera, pose), _images(field, camera, pose)
    step = min(float(np.diff(np.unique(np.round(place, 6))).min()) for place in field.xy.T)
    found = []
    for k in rows:
        around = field.xy[k] + step / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        ends = _images(field, camera, pose, around)
        first, last = np.floor(ends.min(axis=0)).astype(int), np.ceil(ends.max(axis=0)).astype(int)
        size = last - first + 1
        light, *slopes = form_at(
            seen, (int(first[0]), int(first[1])), (int(size[0]), int(size[1])), sigma, derivatives=True
        )
        column, row = (first[axis] + np.arange(size[axis]) for axis in (0, 1))
        u, v = np.meshgrid(column - at[k, 0], row - at[k, 1])
        # Inside the image of the square around the target, whose sides are almost straight.
        own = np.ones(u.shape, dtype=bool)
        middle = at[k]
        for a, b in zip(ends, np.roll(ends, -1, axis=0), strict=True):
            side = (b[0] - a[0]) * (v + middle[1] - a[1]) - (b[1] - a[1]) * (u + middle[0] - a[0])
            inner = (b[0] - a[0]) * (middle[1] - a[1]) - (b[1] - a[1]) * (middle[0] - a[0])
            own &= side * inner >= 0
        own &= ((column >= 0) & (column < camera.width))[None, :]
        own &= ((row >= 0) & (row < camera.height))[:, None]
        columns = [*slopes, light, np.ones_like(u), u, v]
        jacobian = np.stack([part[own] for part in columns], axis=1)
        normal = jacobian.T @ jacobian / (noise**2 + 1 / 12)
        found.append(np.sqrt(np.diag(np.linalg.inv(normal))[:2]))
    return np.array(found)


def _seen(field: Field, camera: Camera, pose: Pose) -> Scene:
    """Brightness of the testfield, and of what is behind it, at positions in a picture."""
    back = np.linalg.inv(np.column_stack([pose.rotation[:, :2], pose.translation]))

    def place(u: Array, v: Array) -> Array:
        p, q = camera.directions(u, v)
        return np.asarray(back @ np.stack([p, q, np.ones_like(p)]))

    def scene(u: Array, v: Array, spacing: float) -> Array:
        x, y, z = interpolated(place, u[0], v[:, 0])
        z[z <= 0] = np.nan  # above the horizon
        board, ink = field.printed(x / z, y / z)
        return np.asarray(30 + board * (180 - 170 * ink))

    return scene


def _images(field: Field, camera: Camera, pose: Pose, xy: Array | None = None) -> Array:
    """Images (n, 2) of points of the board (n, 2), of all targets by default."""
    points = np.pad(field.xy if xy is None else xy, ((0, 0), (0, 1)))
    return camera.image(points @ pose.rotation.T + pose.translation)
