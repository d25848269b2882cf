"""Photographs of a ChArUco board on a desk, drawn by rays: for the picture of the first page.

Every sample of a pixel follows its ray to the desk or to the board, which lies on a plate some millimetres
thick; a lamp lights them, and the plate throws its shadow. Nothing of the image formation of reseau is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau.io import BoardDesign

__all__ = ["Desk"]

Pixels = NDArray[np.uint8]
Real = NDArray[np.float64]

_FINE = 2
"""Samples of a pixel along each axis."""
_PER_MM = 8
"""Samples of the board in a millimetre."""
_LAMP = np.array([-380.0, -520.0, 650.0])
"""Place of the lamp: mm from the middle of the board, z up from the desk."""


@dataclass(frozen=True)
class Desk:
    """A board on a desk, in front of a camera with barrel distortion.

    Parameters
    ----------
    design : BoardDesign
        The board.
    size : (int, int)
        Width and height of the images, pixels.
    focal_px, k1 : float
        Focal length, and the first coefficient of distortion.
    thick_mm : float
        Thickness of the plate to which the board is glued.
    """

    design: BoardDesign
    size: tuple[int, int] = (960, 720)
    focal_px: float = 900.0
    k1: float = -0.16
    thick_mm: float = 8.0

    def photograph(
        self,
        aside: tuple[float, float],
        away_mm: float,
        tilt_deg: float,
        way_deg: float,
        roll_deg: float,
        seed: int,
    ) -> Pixels:
        """Colours (h, w, 3) as a camera sees the desk that looks from a direction beside the board."""
        tilt, way, roll = np.deg2rad((tilt_deg, way_deg, roll_deg))
        back = np.array([np.sin(tilt) * np.cos(way), np.sin(tilt) * np.sin(way), np.cos(tilt)])
        right = np.array([-np.sin(way), np.cos(way), 0.0])
        down = np.cross(-back, right)
        right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
        rays = self._rays()
        directions = rays[..., :1] * right + rays[..., 1:] * down - back
        place = away_mm * back + np.array([*aside, self.thick_mm])
        colours = self._seen(place, directions, seed)
        w, h = self.size
        seen = cv2.GaussianBlur(colours, (0, 0), 0.75 * _FINE).reshape(h, _FINE, w, _FINE, 3).mean((1, 3))
        off = np.hypot(*np.meshgrid(np.linspace(-1, 1, w), np.linspace(-0.75, 0.75, h)))
        seen *= (1 - 0.22 * off**2)[..., None]
        noise = np.random.default_rng(seed).normal(0, 1.6, (h, w, 3))
        return np.clip(np.rint(255 * seen ** (1 / 1.3) + noise), 0, 255).astype(np.uint8)

    def _rays(self) -> Real:
        """Directions x/z, y/z of all samples: the inverse of the distortion, by iteration."""
        w, h = self.size
        x, y = ((np.arange(n * _FINE) + 0.5) / _FINE - 0.5 - (n - 1) / 2 for n in (w, h))
        seen = np.stack(np.meshgrid(x, y), axis=-1) / self.focal_px
        uv = seen.copy()
        for _ in range(12):
            uv = seen / (1 + self.k1 * (uv**2).sum(-1, keepdims=True))
        return uv

    def _seen(self, place: Real, directions: Real, seed: int) -> NDArray[np.float32]:
        """Light of the desk and of the board on it, where the rays meet them."""
        desk = _met(place, directions, 0.0)
        colours = _wood(desk, seed) * self._light(desk, 0.0)[..., None]
        # The side of the plate, then its upper face.
        for height in np.linspace(0.0, self.thick_mm, 7):
            at = _met(place, directions, float(height))
            on = self._on_plate(at)
            colours[on] = (0.33, 0.34, 0.36)
        board = self._board(at) * self._light(at, self.thick_mm)[..., None]
        return np.asarray(np.where(on[..., None], board, colours), np.float32)

    def _half(self) -> Real:
        margin = 12.0
        return np.array([self.design.columns, self.design.rows]) * self.design.pitch / 2 + margin

    def _on_plate(self, at: Real) -> NDArray[np.bool_]:
        return np.asarray((np.abs(at) < self._half()).all(axis=-1))

    def _board(self, at: Real) -> Real:
        """Print of the board at places (h, w, 2), y up."""
        columns, rows, pitch = self.design.columns, self.design.rows, self.design.pitch
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        drawn = cv2.aruco.CharucoBoard((columns, rows), pitch, 0.75 * pitch, dictionary)
        size = (int(columns * pitch * _PER_MM), int(rows * pitch * _PER_MM))
        sheet = cv2.GaussianBlur(drawn.generateImage(size).astype(np.float32), (0, 0), 1.2) / 255
        px = (at * [1, -1] + np.array([columns, rows]) * pitch / 2) * _PER_MM - 0.5
        grey = cv2.remap(sheet, px.astype(np.float32), None, cv2.INTER_LINEAR,
                         borderMode=cv2.BORDER_CONSTANT, borderValue=1.0)  # fmt: skip
        return np.asarray((0.035 + 0.8 * grey)[..., None] * [1.0, 0.99, 0.965])

    def _light(self, at: Real, height: float) -> Real:
        """Light of the lamp at places (…, 2) at a height, with the soft shadow of the plate on the desk."""
        to = _LAMP - np.concatenate([at, np.full((*at.shape[:-1], 1), height)], axis=-1)
        far = np.linalg.norm(to, axis=-1)
        light = 0.30 + 0.95 * (to[..., 2] / far) * (780.0 / far) ** 2
        if height:
            return np.asarray(np.minimum(light, 1.15))
        shadow = 0.0
        for part in np.linspace(0.1, 1.0, 8):
            share = part * self.thick_mm / _LAMP[2]
            shadow = shadow + self._on_plate(at + share * to[..., :2]).astype(float) / 8
        return np.asarray(light * (1 - 0.62 * shadow))


def _met(place: Real, directions: Real, height: float) -> Real:
    """Where rays meet a plane at a height; those that do not come down meet it far away."""
    fall = np.minimum(directions[..., 2], -1e-3)
    return np.asarray(place[:2] + directions[..., :2] * ((height - place[2]) / fall)[..., None])


def _wood(at: Real, seed: int) -> Real:
    """Colours of planks of wood: bands of years, and fibres."""
    rng = np.random.default_rng(11)
    plank = np.floor(at[..., 1] / 95.0).astype(int)
    shift = rng.uniform(-400, 400, 64)[plank % 64]
    x, y = (at[..., 0] + shift) / 60.0, at[..., 1] / 9.0
    years = np.sin(y + 1.3 * np.sin(0.31 * x + shift) + 0.6 * np.sin(0.83 * x + 2.0 + 0.2 * y))
    fibres = np.sin(41.0 * y + 3 * np.sin(0.7 * x)) * np.sin(17.3 * y + 2.1 * x)
    tone = 0.50 + 0.055 * years + 0.03 * fibres + rng.uniform(-0.05, 0.05, 64)[plank % 64]
    seam = np.abs(at[..., 1] / 95.0 - np.rint(at[..., 1] / 95.0)) < 0.008
    return np.asarray(np.where(seam, 0.45 * tone, tone)[..., None] * [1.0, 0.72, 0.47])
