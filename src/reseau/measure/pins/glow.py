"""The light of a raster: how it falls off over a screen, told by what shines between the echoes.

A phosphor, a tube and a lens give less light towards the corners, to the picture as to the raster's own glow.
Over the length of an echo that is a slope which moves its middle to the brighter side, by the slope times the
square of its width.
"""

from __future__ import annotations

import numpy as np

from ...core.data import Array, Mask
from .echoes import Grey

__all__ = ["falloff"]

_STEP = 20
"""Distance of the places at which the glow is looked at, pixels."""
_INSIDE = 0.08
"""Part of the reseau's extent at its edges that is not looked at: there a screen may end."""
_LEAST = 10.0
"""Glow over the noise from which on the raster counts as lit."""
_ROUGH = 0.1
"""Scatter of the glow about a parabola, as a share of it, from which on it is no glow but an image."""
_LIMITS = (0.5, 2.0)


def falloff(ground: Grey, hidden: Mask, noise: float) -> Grey | None:
    """Light of the raster relative to the middle: a paraboloid through what shines between the echoes.

    Parameters
    ----------
    ground : ndarray (h, w)
        The frame without what is small in it.
    hidden : ndarray (h, w) of bool
        Pixels that a reseau covers; within its extent the raster is looked at.
    noise : float
        Standard deviation of the grey values.

    Returns
    -------
    ndarray (h, w) or None
        None where no raster is lit, or too little of it is seen.
    """
    ends = [np.flatnonzero(hidden.any(axis=axis))[[0, -1]] for axis in (0, 1) if hidden.any()]
    lengths = [int(high - low) for low, high in ends]
    if not ends or min(lengths) < 8 * _STEP:
        return None
    x, y = (
        np.arange(low + _INSIDE * n, high - _INSIDE * n, _STEP).astype(np.intp)
        for (low, high), n in zip(ends, lengths, strict=True)
    )
    h, w = ground.shape
    middle, size = np.array([w - 1, h - 1]) / 2, max(h, w) / 2
    u, v = np.meshgrid((x - middle[0]) / size, (y - middle[1]) / size)
    glow = ground[np.ix_(y, x)].astype(np.float64).ravel()
    design = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1).reshape(-1, 6)
    weight: Array = np.ones_like(glow)
    values: Array = np.zeros(6)
    scatter = np.inf
    for _ in range(6):  # Tukey's weights: where an echo is as wide as the ground's window, it is none of it
        found = np.linalg.lstsq(design * weight[:, None], glow * weight, rcond=None)[0]
        values = np.asarray(found, dtype=np.float64)
        off = np.abs(glow - design @ values)
        scatter = float(max(1.4826 * np.median(off), 1e-3 * noise))
        weight = np.clip(1 - (off / (5 * scatter)) ** 2, 0, None)
    if values[0] < _LEAST * noise or scatter > _ROUGH * values[0]:
        return None
    across, down = (np.arange(w) - middle[0]) / size, ((np.arange(h) - middle[1]) / size)[:, None]
    c = values / values[0]
    light = 1 + c[1] * across + c[2] * down + c[3] * across**2 + c[4] * across * down + c[5] * down**2
    return np.asarray(np.clip(light, *_LIMITS), dtype=np.float32)
