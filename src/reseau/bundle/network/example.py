"""A small synthetic network for examples and first trials."""

from __future__ import annotations

import numpy as np

from ...optics.poses import Pose, matrix_to_vector, project
from .camera import Camera
from .network import Network


def example_network(noise_px: float = 0.05, seed: int = 0) -> Network:
    """Simulate eight convergent images of twenty points, taken with one camera, as a free network.

    Parameters
    ----------
    noise_px : float
        Standard deviation of the image coordinates, px.
    seed : int
        Seed of the noise.

    Returns
    -------
    Network
        With approximate coordinates of all points and a camera ``camera`` to be calibrated.

    Examples
    --------
    >>> example_network()
    <Network: 1 camera, 8 images, 20 points, 160 image points, datum free>
    """
    names = ("c", "x0", "y0", "K1")
    camera = Camera(
        "camera", 640, 480, (0.01, 0.01), "brown", np.array([8.0, 0.02, -0.01, 1e-3] + 6 * [0.0]), names
    )
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-0.75, 0.75, 4)))
    xyz = np.column_stack([x, y, 0.3 * ((np.arange(20) * 7) % 4)])
    angle = np.arange(8) * np.pi / 4
    centres = np.column_stack([2.2 * np.cos(angle), 2.2 * np.sin(angle), np.full(8, 4.0)])
    rng, xy = np.random.default_rng(seed), np.zeros((8, 20, 2))
    for k, x0 in enumerate(centres):
        pose = Pose(matrix_to_vector(_towards(x0, np.array([0.0, 0.0, 0.4]), k * np.pi / 2)), x0)
        xy[k] = project(camera.bare_mapping(), pose, xyz).xy + noise_px * rng.normal(size=(20, 2))
    return Network(
        cameras=(camera,),
        images=tuple(f"image{k}" for k in range(8)),
        camera_of=np.zeros(8, dtype=np.intp),
        x0=np.full((8, 3), np.nan),
        rotation=np.full((8, 3), np.nan),
        points=tuple(f"p{j}" for j in range(20)),
        xyz=xyz,
        sigma=np.full((20, 3), np.nan),
        role=("tie",) * 20,
        image_of=np.repeat(np.arange(8), 20).astype(np.intp),
        point_of=np.tile(np.arange(20), 8).astype(np.intp),
        xy=xy.reshape(-1, 2),
        cov=np.tile(np.eye(2) * noise_px**2, (160, 1, 1)),
        distance_of=np.zeros((0, 2), dtype=np.intp),
        distance=np.zeros((0, 2)),
        datum="free",
        datum_points=np.ones(20, dtype=bool),
        groups=(None,) * 8,
        files=(None,) * 8,
        unit="m",
    )


def _towards(x0: np.ndarray, target: np.ndarray, roll: float) -> np.ndarray:
    """Rotation of a camera at x0 that looks at a target, with a roll about its axis."""
    z = (target - x0) / np.linalg.norm(target - x0)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    c, s = np.cos(roll), np.sin(roll)
    upright = np.stack([x, np.cross(z, x), z])
    turned: np.ndarray = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ upright
    return turned
