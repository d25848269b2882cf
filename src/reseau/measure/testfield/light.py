"""How a board is lit over a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.data import Array

__all__ = ["Light"]


@dataclass(frozen=True, eq=False)
class Light:
    """How a testfield is lit, as polynomials of second degree over the frame.

    Parameters
    ----------
    level, contrast : ndarray (6,)
        Coefficients of the grey value of the ground, and of what a mark takes of it or adds.
    size : (float, float)
        Width and height of the frame.
    """

    level: Array
    contrast: Array
    size: tuple[float, float]

    @classmethod
    def through(cls, xy: Array, level: Array, contrast: Array, size: tuple[float, float]) -> Light:
        """Fit to what was found at points (n, 2), twice: the second time without what is far off."""
        design = _quadratic(xy, size)
        found = []
        for values in (level, contrast):
            keep = np.isfinite(values)
            for _ in range(3):
                fitted: Array = np.linalg.lstsq(design[keep], values[keep], rcond=1e-6)[0].astype(np.float64)
                off = np.abs(values - design @ fitted)
                keep = np.isfinite(values) & (off <= 4 * np.nanmedian(off[keep]) + 1e-9)
            found.append(fitted)
        return cls(found[0], found[1], size)

    def at(self, xy: Array) -> tuple[Array, Array]:
        """Level and contrast (n,) at points (n, 2)."""
        design = _quadratic(xy, self.size)
        return design @ self.level, design @ self.contrast

    def contrast_over(self, shape: tuple[int, int]) -> Array:
        """Contrast of every pixel of a frame (h, w)."""
        u, v = (2 * np.arange(n) / size - 1 for n, size in zip(shape[::-1], self.size, strict=True))
        one, by_u, by_v, by_uu, by_uv, by_vv = self.contrast
        over: Array = (
            (one + by_u * u + by_uu * u * u) + np.outer(v, by_v + by_uv * u) + (by_vv * v * v)[:, None]
        )
        return over


def _quadratic(xy: Array, size: tuple[float, float]) -> Array:
    u, v = (2 * xy / np.array(size) - 1).T
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
