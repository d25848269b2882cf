"""A scene seen by several cameras, and the residuals of a network at the values that it was read with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reseau.bundle import Network
from reseau.core.data import Array
from reseau.optics.poses import rotation_matrix


@dataclass(frozen=True)
class Scene:
    """Points (p, 3), projection centres (m, 3) and rotations (m, 3, 3) from object space to the cameras."""

    xyz: Array
    x0: Array
    turns: Array

    @property
    def directions(self) -> Array:
        """X/Z and Y/Z of every point in every camera (m, p, 2), x right, y down."""
        local = np.einsum("mij,mpj->mpi", self.turns, self.xyz[None] - self.x0[:, None])
        assert (local[..., 2] > 0).all()
        return local[..., :2] / local[..., 2:]


def scene(images: int = 4, points: int = 15, seed: int = 7) -> Scene:
    """Points around the origin, cameras at a height of 8 that look at them, turned about the view."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-2.0, 2.0, (points, 3))
    x0 = np.column_stack([rng.uniform(-3, 3, images), rng.uniform(-3, 3, images), np.full(images, -8.0)])
    view = -x0 / np.linalg.norm(x0, axis=1, keepdims=True)
    angle = rng.uniform(-np.pi, np.pi, images)
    side = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(images)])
    side -= (side * view).sum(axis=1, keepdims=True) * view
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return Scene(xyz, x0, np.stack([side, np.cross(view, side), view], axis=1))


def residuals(network: Network) -> Array:
    """Computed minus observed image coordinates (n, 2), px, at poses, points and cameras as given."""
    turns, image = rotation_matrix(network.rotation), network.image_of
    local = np.einsum("nij,nj->ni", turns[image], network.xyz[network.point_of] - network.x0[image])
    found = np.full(network.xy.shape, np.nan)
    for c, camera in enumerate(network.cameras):
        rows = np.flatnonzero(network.camera_of[image] == c)
        found[rows] = camera.plane_mapping()(local[rows, :2] / local[rows, 2:]) - network.xy[rows]
    return found
