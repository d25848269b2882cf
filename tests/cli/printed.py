"""Photographs of a printed sheet, rendered from its PDF: by nothing of the project.

The print is what pdftoppm (poppler-utils) makes of the PDF. Each pixel is the mean of samples of the print at
the places where its rays through a lens of OpenCV's model, inverted here, meet the paper.
"""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

__all__ = ["Lens", "photograph", "poses", "print_out", "printer"]

Array = Any
_DPI = 300
_DARK, _PAPER = 25.0, 200.0
_INK_MM = 0.15
"""Width of the edges of ink: sharper ones, sampled three times in a pixel, would be displaced by 0.02 px."""

_BEYOND = 6
"""Pixels around the frame from which the point-spread function takes light."""


def printer() -> str | None:
    """The program that rasterises, if it is there."""
    return shutil.which("pdftoppm")


def print_out(pdf: Path) -> Array:
    """Grey values of the first page, 300 per inch."""
    target = pdf.with_suffix("")
    command = ["pdftoppm", "-r", str(_DPI), "-gray", "-singlefile", "-png", str(pdf), str(target)]
    subprocess.run(command, check=True)
    pixels = cv2.imread(str(target.with_suffix(".png")), cv2.IMREAD_GRAYSCALE)
    grey = (_DARK + (_PAPER - _DARK) / 255 * pixels).astype(np.float32)
    return cv2.GaussianBlur(grey, (0, 0), _INK_MM / 25.4 * _DPI)


@dataclass(frozen=True)
class Lens:
    """A camera of OpenCV's model, and how finely its pixels are sampled."""

    width: int = 800
    height: int = 600
    fx: float = 742.3
    fy: float = 741.1
    cx: float = 404.6
    cy: float = 295.2
    k1: float = -0.21
    k2: float = 0.06
    p1: float = 0.0009
    p2: float = -0.0006
    fine: int = 4

    def rays(self) -> Array:
        """Undistorted directions of all samples, also of those of `_BEYOND` pixels around the frame."""
        x, y = (
            (np.arange((size + 2 * _BEYOND) * self.fine) + 0.5) / self.fine - 0.5 - _BEYOND
            for size in (self.width, self.height)
        )
        bent = np.stack(np.meshgrid((x - self.cx) / self.fx, (y - self.cy) / self.fy), axis=-1)
        u, v = bent[..., 0].copy(), bent[..., 1].copy()
        for _ in range(25):  # x_d = x (1 + k1 r² + k2 r⁴) + decentering, solved for x by its own iteration
            r2 = u * u + v * v
            radial = 1 + r2 * (self.k1 + r2 * self.k2)
            u, v = (
                (bent[..., 0] - 2 * self.p1 * u * v - self.p2 * (r2 + 2 * u * u)) / radial,
                (bent[..., 1] - self.p1 * (r2 + 2 * v * v) - 2 * self.p2 * u * v) / radial,
            )
        return np.stack([u, v], axis=-1)


def poses(count: int, paper: tuple[float, float], rng: np.random.Generator) -> list[tuple[Array, Array]]:
    """Rotations from the paper (mm, x right, y down) to the camera, and the place of its middle there."""
    found = []
    for k in range(count):
        roll = np.deg2rad(90.0 * (k % 4) + rng.uniform(-8, 8))
        tilt = np.deg2rad(0 if k % 5 == 0 else rng.uniform(25, 42))
        way = 2 * np.pi * (k / count + rng.uniform(0, 0.1)) * 2
        axis = np.array([np.cos(way), np.sin(way), 0]) * tilt
        turn = cv2.Rodrigues(axis)[0] @ cv2.Rodrigues(np.array([0, 0, roll]))[0]
        distance = paper[1] * rng.uniform(0.95, 1.35)
        aside = rng.uniform(-0.16, 0.16, 2) * distance
        found.append((turn, np.array([*aside, distance])))
    return found


def photograph(
    sheet: Array,
    lens: Lens,
    rays: Array,
    pose: tuple[Array, Array],
    rng: np.random.Generator,
    *,
    blur: float = 0.7,
    noise: float = 1.5,
) -> Array:
    """A photograph (h, w) of the paper in front of something grey, 8 bit."""
    turn, middle = pose
    scale = _DPI / 25.4
    half = np.array([sheet.shape[1], sheet.shape[0]]) / 2 / scale
    corner = middle - turn[:, :2] @ half
    # x_camera = H (x, y, 1) on the paper; its inverse takes rays to the paper.
    to_paper = np.linalg.inv(np.column_stack([turn[:, 0], turn[:, 1], corner]))
    at = rays @ to_paper[:, :2].T + to_paper[:, 2]
    where = (at[..., :2] / at[..., 2:] * scale - 0.5).astype(np.float32)
    fine = cv2.remap(
        sheet,
        where,
        None,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=110.0,  # type: ignore[call-overload]
    )
    fine = cv2.GaussianBlur(fine, (0, 0), blur * lens.fine)
    high, wide = (size + 2 * _BEYOND for size in (lens.height, lens.width))
    pixels = fine.reshape(high, lens.fine, wide, lens.fine).mean(axis=(1, 3))
    pixels = pixels[_BEYOND:-_BEYOND, _BEYOND:-_BEYOND]
    return np.clip(np.rint(pixels + rng.normal(0, noise, pixels.shape)), 0, 255).astype(np.uint8)
