"""What a reseau in front of a screen tells about the light: its falloff, and the blur of the camera.

Phosphor, tube and lens reduce the light towards the corners, of the image and of the raster's glow alike.
Over the length of an echo this is a slope that shifts its centre to the brighter side, by the relative slope
times the square of its width. The falloff is estimated from the glow between the echoes.

A lens blurs a bent line towards the inside of its bend, by half the curvature times the variance of the blur.
The blur is estimated from the edges of the wires.
"""

from __future__ import annotations

import numpy as np
import scipy

from ...core.data import Array, Mask
from .echoes import Grey

_STEP = 20
"""Distance of the places at which the glow is sampled, pixels."""
_INSIDE = 0.08
"""Margin of the reseau's extent that is not sampled, as a share: the screen may end there."""
_LEAST = 4.0
"""Minimum glow of a lit raster over the noise; a dark level in it makes the correction too small only."""
_ROUGH = 0.1
"""Largest scatter of the glow about a parabola, as a share of it; a larger one belongs to an image."""
_LIMITS = (0.25, 2.0)
"""Bounds of the light relative to the centre."""
_BESIDE_PX = 9
"""Length of the profile on either side of a wire, pixels."""
_LEAST_PROFILES, _MOST_PROFILES = 60, 600
"""Numbers of profiles across wires that determine the blur."""
_ALIKE = 0.15
"""Largest difference of the grey values on both sides of a wire, as a share of its contrast."""
_DISTINCT = 6.0
"""Minimum contrast of a wire over the noise."""
_MOST_BLUR_PX = 4.0
_ROUNDS = 4
"""Rounds of adjusting the common profile and the centre of each."""
_OFF_PX = 2.0
"""Largest distance of a wire from the middle of the pixels that it hides, pixels."""
_ALLOWED_PX = 0.02
"""Error of the blur of what is no even bar, and not blurred by a Gaussian."""


def falloff(ground: Grey, hidden: Mask, noise: float) -> Grey | None:
    """Light of the raster relative to the centre: a paraboloid fitted to the glow between the echoes.

    Parameters
    ----------
    ground : ndarray (h, w)
        The frame without small structures.
    hidden : ndarray (h, w) of bool
        Pixels covered by a reseau; the raster is sampled within its extent.
    noise : float
        Standard deviation of the grey values.

    Returns
    -------
    ndarray (h, w) or None
        None if no raster is lit, or too little of it is visible.
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
    for _ in range(6):  # Tukey's weights reject places where an echo is as wide as the window of the ground
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


def blur_of_wires(grey: Grey, hidden: Mask, noise: float) -> tuple[float, float] | None:
    """Width of the camera's blur, from profiles across the wires, with the pixel's own.

    Every profile is that of a bar, blurred by a Gaussian, at its own place. Its mean over all wires that
    cross the rows (or columns) steeply, each about its own centre, is as sharp as one of them.

    Parameters
    ----------
    grey : ndarray (h, w)
        Frame.
    hidden : ndarray (h, w) of bool
        Pixels covered by wires, with a margin.
    noise : float
        Standard deviation of the grey values.

    Returns
    -------
    (float, float) or None
        Width (one sigma) and its standard deviation, pixels; None if no wires can be seen clearly.
    """
    widths = []
    for image, mask in ((grey, hidden), (grey.T, hidden.T)):
        if (found := _blur_across(image, mask, noise)) is not None:
            widths.append(found)
    if not widths:
        return None
    values, weights = np.array(widths), 1 / np.array(widths)[:, 1] ** 2
    mean = float((values[:, 0] * weights).sum() / weights.sum())
    apart = float(np.ptp(values[:, 0])) / 2
    return mean, float(np.hypot(1 / np.sqrt(weights.sum()), apart))


def _blur_across(grey: Grey, hidden: Mask, noise: float) -> tuple[float, float] | None:
    """Width of the blur along the rows, from the wires that cross them."""
    edge = np.diff(np.pad(hidden, [(0, 0), (1, 1)]).astype(np.int8), axis=1)
    row, first = np.nonzero(edge > 0)
    last = np.nonzero(edge < 0)[1] - 1
    width = last - first + 1
    usual = np.bincount(width).argmax() if len(width) else 0
    reach = int(usual) // 2 + _BESIDE_PX
    middle = (first + last) // 2
    single = (np.abs(width - usual) <= 1) & (middle >= reach) & (middle < grey.shape[1] - reach)
    # Beside the wire nothing else is hidden.
    offsets = np.arange(-reach, reach + 1)
    row, middle = row[single], middle[single]
    clear = hidden[row[:, None], middle[:, None] + offsets].sum(axis=1) <= usual + 1
    row, middle = row[clear], middle[clear]
    if len(row) < _LEAST_PROFILES:
        return None
    chosen = np.linspace(0, len(row) - 1, min(len(row), _MOST_PROFILES)).astype(np.intp)
    profiles = grey[row[chosen, None], middle[chosen, None] + offsets].astype(np.float64)
    left, right = profiles[:, :4].mean(axis=1), profiles[:, -4:].mean(axis=1)
    depth = profiles[:, reach - 1 : reach + 2].mean(axis=1) - 0.5 * (left + right)
    usual_depth = float(np.median(depth))
    if abs(usual_depth) < _DISTINCT * noise:
        return None
    # No echo, and no edge of the screen, beside the wire.
    flat = np.abs(right - left) < _ALIKE * abs(usual_depth) + 2 * noise
    flat &= profiles[:, : _BESIDE_PX - 3].std(axis=1) < 2 * noise + 0.05 * abs(usual_depth)
    flat &= profiles[:, -_BESIDE_PX + 3 :].std(axis=1) < 2 * noise + 0.05 * abs(usual_depth)
    flat &= np.abs(depth / usual_depth - 1) < 0.3
    if flat.sum() < _LEAST_PROFILES:
        return None
    slope = np.linspace(0, 1, len(offsets))
    ground = left[flat, None] + (right - left)[flat, None] * slope
    shares = (profiles[flat] - ground) / depth[flat, None]
    centre = np.clip((shares * offsets).sum(axis=1) / np.maximum(shares.sum(axis=1), 1e-3), -_OFF_PX, _OFF_PX)
    values = np.array([usual / 3, 1.0, 1.0, 0.0])

    def rest(values: Array) -> Array:
        half, blur, height, level = values
        x = offsets - centre[:, None]
        bar = scipy.special.ndtr((x + half) / blur) - scipy.special.ndtr((x - half) / blur)
        return np.asarray((height * bar + level - shares).ravel())

    # Errors of the centres would blur the mean of the profiles: each is adjusted to its edges.
    for _ in range(_ROUNDS):
        fit = scipy.optimize.least_squares(
            rest,
            values,
            bounds=([0.3, 0.2, 0.5, -0.5], [usual, _MOST_BLUR_PX, 2.0, 0.5]),
            loss="soft_l1",
            f_scale=3 * noise / abs(usual_depth),
        )
        values = fit.x
        off, step = rest(values).reshape(shares.shape), 0.05
        centre += step
        slope = (rest(values).reshape(shares.shape) - off) / step
        centre -= step + np.clip(
            (slope * off).sum(axis=1) / np.maximum((slope**2).sum(axis=1), 1e-12), -_OFF_PX, _OFF_PX
        )
    cofactor = np.linalg.pinv(fit.jac.T @ fit.jac)
    sigma = float(np.sqrt(cofactor[1, 1] * (rest(fit.x) ** 2).mean()))
    return float(values[1]), sigma + _ALLOWED_PX
