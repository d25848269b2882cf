"""Pictures of boards, sampled finely through a homography: nothing of the formation of images is used."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from reseau.core.data import Array, Frame
from reseau.designs.boards import board_figures
from reseau.io import BoardDesign

FINE = 6
"""Samples of a pixel along each axis."""
SCALE = 16
"""Samples of a millimetre of the drawing, which is drawn first."""


def homography(
    design: BoardDesign, tilt: float, turn: float, distance: float, size: tuple[int, int]
) -> Array:
    """Image (3, 3) of the plane of a board by a camera of 900 px that looks at its middle, degrees and mm."""
    middle = design.xy.mean(axis=0)
    t, k = np.deg2rad([tilt, turn])
    x = np.array([np.cos(k), -np.sin(k), 0.0])
    y = np.array([np.sin(k), np.cos(k), 0.0])
    # y up in the design is y down in the image; then the board is tilted about the x-axis of the camera.
    axes = np.array([[1, 0, 0], [0, np.cos(t), -np.sin(t)], [0, np.sin(t), np.cos(t)]]) @ np.diag([1, -1, -1])
    r = axes @ np.column_stack([x, y, [0, 0, 1.0]])
    shift = np.array([0, 0, distance]) - r[:, :2] @ middle
    camera = np.array([[900.0, 0, size[0] / 2 - 3.3], [0, 900.0, size[1] / 2 + 1.7], [0, 0, 1]])
    return np.asarray(camera @ np.column_stack([r[:, :2], shift]))


def picture(
    design: BoardDesign,
    tilt: float = 20.0,
    turn: float = 10.0,
    distance: float = 420.0,
    size: tuple[int, int] = (480, 400),
    *,
    blur: float = 0.8,
    noise: float = 1.5,
    seed: int = 0,
    moved: tuple[float, float] = (0.0, 0.0),
) -> tuple[Frame, Array]:
    """A picture of a board on white paper, `moved` by some pixels, and the images (n, 2) of its points."""
    polygons, circles = board_figures(design)
    ends = np.concatenate([*polygons, circles[:, :2] - circles[:, 2:], circles[:, :2] + circles[:, 2:]])
    low, high = ends.min(axis=0) - 10, ends.max(axis=0) + 10
    wide, tall = np.rint((high - low) * SCALE).astype(int)
    sheet = np.full((tall, wide), 215.0, np.float32)

    def at(xy: Array) -> Array:
        # The centre of a sample is half a sample from its edge.
        return np.asarray((xy * [1, -1] - [low[0], -high[1]]) * SCALE - 0.5)

    for polygon in polygons:
        box = np.rint(np.concatenate([at(polygon).min(axis=0), at(polygon).max(axis=0)]) + 0.5).astype(int)
        sheet[box[1] : box[3], box[0] : box[2]] = 20
    for x, y, radius in circles:
        centre = at(np.array([x, y]))
        rows, columns = np.indices((int(2 * radius * SCALE) + 8,) * 2)
        first = np.floor(centre - radius * SCALE).astype(int) - 3
        inside = radius * SCALE - np.hypot(columns + first[0] - centre[0], rows + first[1] - centre[1])
        part = sheet[first[1] : first[1] + len(rows), first[0] : first[0] + len(rows)]
        part -= 195 * np.clip(0.5 + inside, 0, 1).astype(np.float32)
    plane: Any = homography(design, tilt, turn, distance, size)
    plane = np.array([[1, 0, moved[0]], [0, 1, moved[1]], [0, 0, 1]]) @ plane
    to_sheet = np.array([[SCALE, 0, -low[0] * SCALE - 0.5], [0, -SCALE, high[1] * SCALE - 0.5], [0, 0, 1.0]])
    # Pixel p covers the fine samples FINE·p … FINE·p + FINE − 1.
    to_fine = np.array([[FINE, 0, (FINE - 1) / 2], [0, FINE, (FINE - 1) / 2], [0, 0, 1.0]])
    whole = to_fine @ plane @ np.linalg.inv(to_sheet)
    fine = cv2.warpPerspective(
        sheet, whole, (FINE * size[0], FINE * size[1]), flags=cv2.INTER_AREA, borderValue=90.0
    )
    fine = cv2.GaussianBlur(fine, (0, 0), blur * FINE)
    pixels = fine.reshape(size[1], FINE, size[0], FINE).mean(axis=(1, 3))
    pixels = pixels + np.random.default_rng(seed).normal(0, noise, pixels.shape)
    image = np.column_stack([design.xy, np.ones(len(design.xy))]) @ plane.T
    return Frame(np.clip(np.rint(pixels), 0, 255).astype(np.uint8), 255.0, "board"), image[:, :2] / image[
        :, 2:
    ]
