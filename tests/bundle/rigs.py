"""A simulated rig of cameras in front of a board."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from reseau.bundle import Camera, Network
from reseau.bundle.network.rig import Rig
from reseau.optics.poses import matrix_to_vector, rotation_matrix

__all__ = ["PLACES", "drawn"]

PITCH, SIZE, SIGMA = 0.005, (1000, 800), 0.1
PLACES = (
    (np.zeros(3), np.zeros(3)),
    (np.array([0.02, 0.22, 0.01]), np.array([150.0, 4.0, -8.0])),
    (np.array([0.1, -0.15, 0.4]), np.array([-90.0, 60.0, 20.0])),
)
"""Rotation vector and centre of the cameras in the axes of the first, mm."""


def drawn(
    seed: int = 0,
    *,
    cameras: int = 2,
    exposures: int = 8,
    left_out: tuple[tuple[int, int], ...] = (),
    control: bool = False,
    noise: float = SIGMA,
) -> Network:
    """A board of 7 × 6 points in front of a rig; all images but some, (camera, exposure)."""
    rng = np.random.default_rng(5)
    grid = np.stack(np.meshgrid(np.arange(7.0), np.arange(6.0)), axis=-1).reshape(-1, 2) * 40.0
    xyz = np.concatenate([grid - grid.mean(axis=0), rng.normal(0, 15.0, (len(grid), 1))], axis=1)
    turns, centres, of, exposure, xy, image_of, point_of = [], [], [], [], [], [], []
    mappings = [
        Camera(
            "c", *SIZE, (PITCH, PITCH), "brown", np.array([c, *9 * [0.0]]), ("c", "K1"), {"side": "object"}
        )
        for c in (6.0, 6.2, 5.9)[:cameras]
    ]
    for e in range(exposures):
        tilt, about = 0.5 * rng.uniform(0.6, 1.0), 2 * np.pi * e / exposures
        turn = rotation_matrix(np.array([0.0, 0.0, 0.7 * e])) @ rotation_matrix(
            np.array([np.pi + tilt * np.cos(about), tilt * np.sin(about), 0.0])
        )
        at = -turn.T @ np.array([-30.0 + rng.uniform(-20, 20), rng.uniform(-20, 20), 650.0])
        for c in range(cameras):
            if (c, e) in left_out:
                continue
            vector, base = PLACES[c]
            turns.append(rotation_matrix(vector) @ turn)
            centres.append(at + turn.T @ base)
            of.append(c)
            exposure.append(e)
            seen = (xyz - centres[-1]) @ turns[-1].T
            pixels = mappings[c].bare_mapping(mappings[c].values)(seen[:, :2] / seen[:, 2:])
            inside = ((pixels > 0) & (pixels < np.array(SIZE))).all(axis=1) & (seen[:, 2] > 0)
            xy.append(pixels[inside])
            point_of.append(np.flatnonzero(inside))
            image_of.append(np.full(int(inside.sum()), len(of) - 1))
    n, p, m = sum(map(len, xy)), len(xyz), len(of)
    sigma = np.full((p, 3), np.nan)
    if control:
        sigma[[0, 6, 20, 35, 41]] = 0.0
    noisy = np.concatenate(xy) + noise * np.random.default_rng(seed).normal(size=(n, 2))
    return Network(
        cameras=tuple(replace(each, id=f"camera {k}") for k, each in enumerate(mappings)),
        images=tuple(f"{c}-{e}" for c, e in zip(of, exposure, strict=True)), camera_of=np.array(of),
        x0=np.array(centres), rotation=matrix_to_vector(np.array(turns)),
        points=tuple(str(k) for k in range(p)), xyz=xyz, sigma=sigma,
        role=tuple("control" if row[0] == 0 else "tie" for row in sigma),
        image_of=np.concatenate(image_of), point_of=np.concatenate(point_of), xy=noisy,
        cov=np.tile(np.eye(2) * SIGMA**2, (n, 1, 1)),
        distance_of=np.array([[0, 41]]), distance=np.array([[np.linalg.norm(xyz[0] - xyz[41]), 0.01]]),
        datum="control" if control else "free", datum_points=np.ones(p, dtype=bool), groups=(None,) * m,
        files=(None,) * m, rig=Rig(np.array(of), np.array(exposure)),
    )  # fmt: skip
