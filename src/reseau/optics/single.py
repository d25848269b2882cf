"""Images of many small shapes in single precision, compiled.

The sums are those of :mod:`reseau.optics.formation`; here they are taken shape by shape, so that a cache
holds them, the normal distribution comes from a table, and a node of an outline is looked at only in the rows
that see it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

__all__ = ["formed"]

F = TypeVar("F", bound=Callable[..., Any])
Single = NDArray[Any]

_SIDE = 5.5
"""Where the table of the normal distribution ends, in standard deviations: 2e-8 of the light are beyond."""
_PER_SIGMA = 64
"""Its entries for one; with the next two terms of the series in between it is good to 1e-7."""


def _table() -> tuple[Single, Single]:
    """Distribution and density of the normal distribution at steps of 1/64 from −5.5 to 5.5."""
    z = np.arange(-_SIDE * _PER_SIGMA, _SIDE * _PER_SIGMA + 1) / _PER_SIGMA
    return ndtr(z).astype(np.float32), (np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)).astype(np.float32)


_STEP, _BELL = _table()


def _compiled(function: F) -> F:
    """Compile with Numba, kept on disk; other threads may run meanwhile."""
    options: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": True}
    return cast(F, numba.njit(**options)(function))


@_compiled
def _normal(z: np.float32) -> tuple[np.float32, np.float32]:
    """Distribution and density at z."""
    if z <= -_SIDE:
        return np.float32(0), np.float32(0)
    if z >= _SIDE:
        return np.float32(1), np.float32(0)
    at = (z + np.float32(_SIDE)) * np.float32(_PER_SIGMA) + np.float32(0.5)
    k = np.int32(at)
    middle = np.float32(k) / np.float32(_PER_SIGMA) - np.float32(_SIDE)
    d = z - middle
    bell = _BELL[k]
    step = _STEP[k] + bell * d * (np.float32(1) - np.float32(0.5) * d * middle)
    return step, bell * (
        np.float32(1) - d * (middle - np.float32(0.5) * d * (middle * middle - np.float32(1)))
    )


@_compiled
def _responses(
    pixels: Single, point: np.float32, sigma: np.float32, half: np.float32, out: Single
) -> tuple[int, int]:
    """Integral, value and derivative (3, c) of the response of pixels to light at a point.

    Pixels are one apart. Returns the first one that has any response, and the first beyond.
    """
    reach = np.float32(_SIDE) * sigma + half
    per = np.float32(1) / (np.float32(2) * half)
    inverse = np.float32(1) / sigma
    first, last = 0, 0
    for k in range(len(pixels)):
        t = pixels[k] - point
        if t <= -reach:
            first = k + 1
            out[0, k], out[1, k], out[2, k] = np.float32(0), np.float32(0), np.float32(0)
        elif t >= reach:
            out[0, k], out[1, k], out[2, k] = np.float32(1), np.float32(0), np.float32(0)
        else:
            right, left = t + half, t - half
            step_r, bell_r = _normal(right * inverse)
            step_l, bell_l = _normal(left * inverse)
            out[0, k] = (right * step_r - left * step_l + sigma * (bell_r - bell_l)) * per
            out[1, k] = (step_r - step_l) * per
            out[2, k] = (bell_r - bell_l) * inverse * per
            last = k + 1
    return first, max(first, last)


@_compiled
def formed(
    xy: Single,
    dxy: Single,
    motion: Single,
    columns: Single,
    rows: Single,
    sigma: Single,
    fill: float,
    parts: Single,
) -> None:
    """Form share and derivatives of shapes.

    Parameters
    ----------
    xy, dxy : ndarray (k, j, 2)
        Nodes of their outlines, tangents times weights; see :class:`reseau.optics.Outline`.
    motion : ndarray (k, j, 2)
        Velocities of the nodes for a parameter of the form.
    columns, rows : ndarray (k, c), (k, r)
        Coordinates of the pixels.
    sigma : ndarray (k,)
        Widths of the point-spread function.
    fill : float
        Light-sensitive part of the pitch.
    parts : ndarray (k, 1, r, c) or (k, 5, r, c)
        The share, and its derivatives by a shift along x, along y, the width, and the form, if there is room.
    """
    half = np.float32(max(fill, 1e-6) / 2)
    all_parts = parts.shape[1] > 1
    across = np.empty((3, columns.shape[1]), np.float32)
    down = np.empty((3, rows.shape[1]), np.float32)
    for k in range(len(xy)):
        parts[k] = np.float32(0)
        s = sigma[k]
        for j in range(xy.shape[1]):
            dx, dy = dxy[k, j, 0], dxy[k, j, 1]
            if dx == 0 and dy == 0:
                continue
            first, last = _responses(rows[k], xy[k, j, 1], s, half, down)
            _responses(columns[k], xy[k, j, 0], s, half, across)
            normal = motion[k, j, 0] * dy - motion[k, j, 1] * dx
            for r in range(first, last):
                h = down[1, r]
                of_share = -h * dy
                if not all_parts:
                    for c in range(parts.shape[3]):
                        parts[k, 0, r, c] += of_share * across[0, c]
                    continue
                of_y, of_form, bent = -h * dx, h * normal, s * down[2, r] * dx
                of_width = s * of_share
                for c in range(parts.shape[3]):
                    value = across[1, c]
                    parts[k, 0, r, c] += of_share * across[0, c]
                    parts[k, 1, r, c] -= of_share * value
                    parts[k, 2, r, c] += of_y * value
                    parts[k, 3, r, c] += of_width * across[2, c] + bent * value
                    parts[k, 4, r, c] += of_form * value
