"""Images of points through windows, by rays shot forwards with Snell's law; nothing is shared with reseau.

A ray begins in a pixel, is refracted at each surface in vectors, and is aimed anew (secant steps with
differences) until it passes the object point. Surfaces are planes (a point and a normal) and spheres (a
centre and a radius), in camera or object coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Surface:
    """A plane (`radius` 0: `at` is a point of it) or a sphere around `at`, and the index behind it."""

    at: tuple[float, float, float]
    normal: tuple[float, float, float]
    radius: float
    behind: float
    on_camera: bool


@dataclass(frozen=True, eq=False)
class Scene:
    """Poses (rotation to the camera, x to the right, y down), points, lens and surfaces in order."""

    rotation: Array
    x0: Array
    xyz: Array
    focal: float
    centre: tuple[float, float]
    k1: float
    size: tuple[int, int]
    surfaces: tuple[Surface, ...]

    def pixels(self) -> tuple[Array, Array, Array]:
        """Image and point of each observation, and its image point (px); only what is inside the image."""
        m, p = len(self.x0), len(self.xyz)
        image, point = (a.ravel() for a in np.meshgrid(np.arange(m), np.arange(p), indexing="ij"))
        uv = self._aimed(image, point)
        r2 = (uv**2).sum(axis=1, keepdims=True)
        xy = self.focal * uv * (1 + self.k1 * r2) + self.centre
        inside = (xy > 5).all(axis=1) & (xy < np.array(self.size) - 5).all(axis=1)
        return image[inside], point[inside], xy[inside]

    def _aimed(self, image: Array, point: Array) -> Array:
        x = np.einsum("nij,nj->ni", self.rotation[image], self.xyz[point] - self.x0[image])
        uv, h = x[:, :2] / x[:, 2:], 1e-6
        for _ in range(12):
            off = self._misses(image, point, uv)
            slope = np.stack(
                [
                    (self._misses(image, point, uv + step) - self._misses(image, point, uv - step)) / (2 * h)
                    for step in h * np.eye(2)
                ],
                axis=2,
            )
            uv = uv - np.linalg.solve(slope, off[:, :, None])[:, :, 0]
        assert np.abs(self._misses(image, point, uv)).max() < 1e-11
        return uv

    def _misses(self, image: Array, point: Array, uv: Array) -> Array:
        """Where the rays pass their points, in the two directions perpendicular to the view."""
        turn = self.rotation[image]
        ray = np.einsum("nji,nj->ni", turn, np.column_stack([uv, np.ones(len(uv))]))
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        at, index = self.x0[image].copy(), 1.0
        for surface in self.surfaces:
            where, normal = np.array(surface.at), np.array(surface.normal)
            if surface.on_camera:
                where = self.x0[image] + np.einsum("nji,j->ni", turn, where)
                normal = np.einsum("nji,j->ni", turn, normal)
            normal = np.broadcast_to(normal, ray.shape)
            if surface.radius:
                away = at - where
                b = (away * ray).sum(axis=1)
                root = np.sqrt(b**2 - (away**2).sum(axis=1) + surface.radius**2)
                at = at + (-b + root)[:, None] * ray
                normal = (at - where) / surface.radius
            else:
                t = ((where - at) * normal).sum(axis=1) / (ray * normal).sum(axis=1)
                at = at + t[:, None] * ray
            along = (ray * normal).sum(axis=1, keepdims=True)
            side = np.sign(along)
            flat = index / surface.behind * (ray - along * normal)
            ray = flat + side * np.sqrt(1 - (flat**2).sum(axis=1, keepdims=True)) * normal
            index = surface.behind
        to = np.einsum("nij,nj->ni", turn, self.xyz[point] - at)
        ray = np.einsum("nij,nj->ni", turn, ray)
        return to[:, :2] - to[:, 2:] * ray[:, :2] / ray[:, 2:]


def around(count: int, points: int, seed: int = 0, tilt: float = 0.7) -> tuple[Array, Array, Array]:
    """Poses on two rings above points in a box of 2 × 2 × 0.8: rotation, projection centres, points."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    height = np.where(np.arange(count) % 2, 3.2, 2.4)
    out = np.where(np.arange(count) % 2, tilt, 1.6 * tilt) * height
    x0 = np.column_stack([out * np.cos(angle), out * np.sin(angle), height])
    rotation = []
    for k, at in enumerate(x0):
        z = rng.uniform(-0.15, 0.15, 3) - at
        z /= np.linalg.norm(z)
        x = np.cross([0.0, 0.0, 1.0], z)
        x /= np.linalg.norm(x)
        y, roll = np.cross(z, x), np.pi / 2 * k
        c, s = np.cos(roll), np.sin(roll)
        rotation.append(np.stack([c * x + s * y, -s * x + c * y, z]))
    xyz = rng.uniform(-1, 1, (points, 3)) * [1.0, 1.0, 0.4]
    return np.stack(rotation), x0, xyz
