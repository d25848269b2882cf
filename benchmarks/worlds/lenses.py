"""Boards seen through wide lenses, as networks: drawn with OpenCV's cameras, not with those of ``reseau``.

A lens is OpenCV's fisheye (Kannala–Brandt) or OpenCV's standard camera with any of its coefficients. A flat
or slightly bent board is seen from many sides, near and far, also in the corners of the image. The network is
a ``reseau-network/1`` document as a user would write it: the board held as designed, a rough focal length,
no distortion (cold start), or values close to the truth (warm start).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

__all__ = ["Lens", "board", "document", "fisheye", "views"]


@dataclass(frozen=True)
class Lens:
    """A lens as OpenCV computes it.

    Parameters
    ----------
    width, height : int
        Pixels.
    matrix : ndarray (3, 3)
        Camera matrix.
    coefficients : ndarray
        Distortion coefficients of `cv2.projectPoints`, or four of `cv2.fisheye.projectPoints`.
    fisheye : bool
        Which of the two.
    widest : float
        Largest angle from the optical axis (rad) at which the lens sees.
    """

    width: int
    height: int
    matrix: np.ndarray
    coefficients: np.ndarray
    fisheye: bool = False
    widest: float = 1.45

    def project(self, x: np.ndarray) -> np.ndarray:
        """Pixels (n, 2) of points in the camera system (n, 3); NaN outside the view."""
        angle = np.arctan2(np.hypot(x[:, 0], x[:, 1]), x[:, 2])
        none, given = np.zeros(3), np.ascontiguousarray(x[:, None, :])
        if self.fisheye:
            xy, _ = cv2.fisheye.projectPoints(given, none, none, self.matrix, self.coefficients)
        else:
            xy, _ = cv2.projectPoints(given, none, none, self.matrix, self.coefficients)
        xy = xy[:, 0]
        inside = (xy > 0).all(axis=1) & (xy < [self.width - 1, self.height - 1]).all(axis=1)
        return np.where((inside & (angle < self.widest))[:, None], xy, np.nan)


def fisheye(half_diagonal_deg: float, size: tuple[int, int] = (1280, 960), k1: float = 0.02) -> Lens:
    """A lens near the equidistant projection with this angle in the corners of the image."""
    width, height = size
    angle = np.radians(half_diagonal_deg)
    coefficients = np.array([k1, -0.004, 0.001, -0.0002])
    powers = angle ** np.array([2, 4, 6, 8])
    f = 0.5 * np.hypot(width, height) / (angle * (1 + coefficients @ powers))
    matrix = np.array([[f, 0, 0.508 * width], [0, 1.002 * f, 0.512 * height], [0, 0, 1]])
    return Lens(width, height, matrix, coefficients, True, widest=angle + 0.05)


def board(columns: int, rows: int, pitch: float, bend: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points of a board as designed, and as they are with a deflection of `bend` in the middle (n, 3)."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(columns), np.arange(rows)))
    flat = pitch * np.column_stack([x, y, np.zeros(len(x))])
    s = (flat[:, :2] - flat[:, :2].mean(axis=0)) / np.ptp(flat[:, :2], axis=0)
    true = flat.copy()
    true[:, 2] += bend * (1 - 4 * (0.8 * s[:, 0] ** 2 + 0.2 * s[:, 1] ** 2 + 0.3 * s[:, 0] * s[:, 1]))
    return flat, true


def views(
    lens: Lens,
    designed: np.ndarray,
    true: np.ndarray,
    count: int,
    noise: float,
    seed: int,
    *,
    whole: bool = True,
    fill: tuple[float, float] = (0.35, 1.2),
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Points (rows of the board) and measured pixels of each view.

    Parameters
    ----------
    whole : bool
        Whether the whole board must be seen, as by OpenCV's detector of chessboards.
    fill : (float, float)
        Range of the board's diagonal in its distance.
    """  # fmt: skip
    rng, found = np.random.default_rng(seed), []
    middle, size = true.mean(axis=0), float(np.linalg.norm(np.ptp(designed, axis=0)))
    for _ in range(200 * count):
        if len(found) == count:
            break
        aim = rng.uniform([0, 0], [lens.width - 1, lens.height - 1])
        off = (aim - lens.matrix[:2, 2]) / lens.matrix[0, 0]
        angle = float(np.linalg.norm(off))
        angle = min(angle if lens.fisheye else np.arctan(angle), 0.85 * lens.widest)
        way = np.append(np.sin(angle) * off / max(np.linalg.norm(off), 1e-9), np.cos(angle))
        distance = size / rng.uniform(*fill)
        normal = way + rng.normal(0, 0.45, 3)
        normal /= np.linalg.norm(normal)
        side = np.cross([0.0, 1.0, 0.0], normal)
        side /= np.linalg.norm(side)
        turn = rng.normal(0, 0.4)
        upright = np.stack([side, np.cross(normal, side), normal], axis=1)
        rotation = upright @ cv2.Rodrigues(np.array([0.0, 0.0, turn]))[0]
        x = (true - middle) @ rotation.T + distance * way
        if (x[:, 2] < 0.02 * distance).any():
            continue
        xy = lens.project(x)
        seen = np.isfinite(xy).all(axis=1)
        if seen.all() if whole else seen.sum() >= 12:
            rows = np.flatnonzero(seen)
            found.append((rows, xy[rows] + rng.normal(0, noise, (len(rows), 2))))
    return found


def document(
    lens: Lens, designed: np.ndarray, seen: list[tuple[np.ndarray, np.ndarray]], parameters: dict[str, float],
    free: list[str], sigma: float = 0.3, model: str = "opencv", **more: Any,
) -> dict[str, Any]:  # fmt: skip
    """The network of a board held as designed."""
    table: dict[str, list[Any]] = {"image": [], "point": [], "x": [], "y": [], "sx": [], "sy": []}
    for i, (rows, xy) in enumerate(seen):
        table["image"] += [f"v{i:03d}"] * len(rows)
        table["point"] += [str(j) for j in rows]
        table["x"] += xy[:, 0].tolist()
        table["y"] += xy[:, 1].tolist()
        table["sx"] += [sigma] * len(rows)
        table["sy"] += [sigma] * len(rows)
    m, p = len(seen), len(designed)
    camera = {"id": "A", "width": lens.width, "height": lens.height, "model": model,
              "parameters": parameters, "free": free}  # fmt: skip
    return {
        "schema": "reseau-network/1", "unit": "mm", "cameras": [camera | more],
        "images": {"id": [f"v{i:03d}" for i in range(m)], "camera": ["A"] * m, "X0": [None] * m,
                   "rotation": [None] * m},
        "points": {"id": [str(j) for j in range(p)], "xyz": designed.tolist(), "sigma": [[0, 0, 0]] * p,
                   "role": ["control"] * p},
        "observations": table, "datum": "control",
    }  # fmt: skip
