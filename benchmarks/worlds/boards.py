"""Pictures of a printed coded testfield by a camera of the OpenCV model, drawn from distances to its edges.

A pixel looks through the inverse of the distortion, found by iteration, at a place of the plane board; what
is printed there follows from signed distances to the outlines of the nearest target and of the lines. Nothing
of the project is used but the numbers of a design file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .pixels import Array, edge, form

__all__ = ["OPENCV", "Camera", "Pose", "picture", "poses"]


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


def _inside(shape: str, size: float, x: Array, y: Array) -> Array:
    """Signed distance inside an outline, about its centroid."""
    if shape == "circle":
        return size / 2 - np.hypot(x, y)
    if shape == "square":
        return size / 2 - np.maximum(np.abs(x), np.abs(y))
    if shape == "cross":
        arms = [np.maximum(np.abs(p) - size / 2, np.abs(q) - size / 6) for p, q in ((x, y), (y, x))]
        return np.asarray(-np.minimum(*arms))
    slanted = np.abs(x) * np.sqrt(3) / 2 + y / 2
    return np.asarray(size / np.sqrt(12) - np.maximum(slanted, -y))


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
    targets, lines, pitch = design["targets"], design["lines"], design["pitch"]
    tx, ty = np.array(targets["x"]), np.array(targets["y"])
    columns, rows = (np.unique(np.round(place, 6)) for place in (tx, ty))
    table = np.full((len(columns), len(rows)), -1)
    at = [np.argmin(np.abs(place[:, None] - grid), axis=1) for place, grid in ((tx, columns), (ty, rows))]
    table[at[0], at[1]] = np.arange(len(tx))
    kinds = list(dict.fromkeys(zip(targets["shape"], targets["size"], targets["angle"], strict=True)))
    kind = np.array(
        [kinds.index(k) for k in zip(targets["shape"], targets["size"], targets["angle"], strict=True)]
    )
    x0, y0, x1, y1 = lines["extent"]
    vertical, horizontal = (np.array(lines[name]) for name in ("vertical_x", "horizontal_y"))
    border = max(x1, y1) + 0.6 * pitch
    r, t = pose.rotation, pose.translation
    back = np.linalg.inv(np.column_stack([r[:, :2], t]))

    def scene(u: Array, v: Array, spacing: float) -> Array:
        p, q = camera.directions(u, v)
        a, b, c = (back[k, 0] * p + back[k, 1] * q + back[k, 2] for k in range(3))
        x, y = a / c, b / c

        def drawn(inside: Array) -> Array:
            down, across = np.gradient(inside, spacing)
            return edge(inside / np.maximum(np.hypot(down, across), 1e-9), spacing)

        column, row = (
            np.searchsorted((grid[1:] + grid[:-1]) / 2, place) for place, grid in ((x, columns), (y, rows))
        )
        nearest = table[column, row]
        # Derivatives of the board's coordinates; the nearest target changes suddenly, its distance may not.
        (x_down, x_across), (y_down, y_across) = (np.gradient(place, spacing) for place in (x, y))
        dark = np.zeros(x.shape)
        for number, (shape, size, angle) in enumerate(kinds):
            of = (nearest >= 0) & (kind[nearest] == number)
            if of.any():
                dx, dy = x[of] - tx[nearest[of]], y[of] - ty[nearest[of]]
                cosine, sine = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
                dx, dy = cosine * dx + sine * dy, cosine * dy - sine * dx
                inside = _inside(shape, size, dx, dy)
                by_x, by_y = (
                    (_inside(shape, size, dx + h, dy + k) - _inside(shape, size, dx - h, dy - k)) / 2e-3
                    for h, k in ((1e-3 * cosine, -1e-3 * sine), (1e-3 * sine, 1e-3 * cosine))
                )
                change = np.hypot(
                    by_x * x_across[of] + by_y * y_across[of], by_x * x_down[of] + by_y * y_down[of]
                )
                dark[of] = edge(inside / np.maximum(change, 1e-9), spacing)
        half = lines["width"] / 2
        for place, centres, other, ends in ((x, vertical, y, (y0, y1)), (y, horizontal, x, (x0, x1))):
            near = centres[np.searchsorted((centres[1:] + centres[:-1]) / 2, place)]
            along = np.minimum(other - ends[0], ends[1] - other)
            dark = np.maximum(dark, drawn(np.minimum(half - np.abs(place - near), along)))
        board = drawn(border - np.maximum(np.abs(x), np.abs(y)))
        return np.where(c > 0, 30 + board * (180 - 170 * dark), 30.0)

    light = form(scene, camera.width, camera.height, sigma, oversampling=oversampling)
    light += np.random.default_rng(seed).normal(0, noise, light.shape)
    board = np.column_stack([tx, ty, np.zeros(len(tx))])
    return np.clip(np.rint(light), 0, 255), camera.image(board @ r.T + t)
