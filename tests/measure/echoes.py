"""Frames of echoes of several kinds, behind the wires of a reseau, drawn without the project's formation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.special import erf

from reseau.core.data import Array, Frame, Mask

__all__ = ["KINDS", "Drawn", "draw"]

KINDS = ("beam", "even", "tapering", "fading", "saturated", "clipped")
_FINE = 3
"""Samples per pixel, along both axes."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """A frame, the middles of the echoes (k, 2), the hidden pixels, and the share of each that is hidden."""

    frame: Frame
    truth: Array
    hidden: Mask
    share: Array


def _along(kind: str, t: Array, soft: float) -> Array:
    """Brightness along a line of the half length 1, with soft ends."""
    if kind == "beam":
        return np.asarray(np.exp(-0.5 * (2 * t) ** 2))
    line = 0.5 * (erf((t + 1) / (np.sqrt(2) * soft)) - erf((t - 1) / (np.sqrt(2) * soft)))
    if kind == "tapering":
        line = line * (0.35 + 0.65 * np.cos(np.clip(t, -1.2, 1.2) * np.pi / 2))
    elif kind == "fading":
        line = line * np.clip(0.65 - 0.35 * t, 0.1, None)
    return np.asarray(line)


def draw(
    kind: str,
    seed: int,
    *,
    size: tuple[int, int] = (620, 820),
    turn: float = 0.0,
    wires: bool = True,
    light: float = 90.0,
    glow: float = 60.0,
    noise: float = 1.5,
    blur: float = 0.9,
) -> Drawn:
    """A frame of 36 echoes on a lit screen.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    seed : int
        Seed of positions, lengths, curvatures and noise.
    size : (int, int)
        Height and width of the frame.
    turn : float
        Rotation of wires and echoes (rad).
    wires : bool
        Whether there is a reseau in front of the screen.
    light, glow, noise : float
        Grey values of the echoes and the screen, and noise.
    blur : float
        Width of the point-spread function (px).
    """
    rng = np.random.default_rng(seed)
    h, w = size
    x, y = np.meshgrid(110 + 120 * np.arange(6), 70 + 96 * np.arange(6))
    truth = np.stack([x.ravel(), y.ravel()], axis=1) + rng.uniform(-25, 25, (36, 2)) * [1, 0.6]
    fine = (np.arange(_FINE) - (_FINE - 1) / 2) / _FINE
    columns, rows = ((np.arange(n)[:, None] + fine).ravel() for n in (w, h))
    signal = np.zeros((len(rows), len(columns)))
    wire = np.ones_like(signal)
    c, s = np.cos(turn), np.sin(turn)
    if wires:
        across, down = c * columns[None] + s * rows[:, None], c * rows[:, None] - s * columns[None]
        for at in np.arange(-400, 1400, 84.0):
            for off in (across - at - rng.uniform(-3, 3), down - at - rng.uniform(-3, 3)):
                wire[np.abs(off) < 2.1] = 0.3
    covered = np.zeros(36)
    for k, (px, py) in enumerate(truth):
        half, b = rng.uniform(10, 24), rng.uniform(1.4, 2.2)
        bend = rng.uniform(0.05, 0.45) / half
        near_x, near_y = (np.abs(axis - at) < 75 for axis, at in ((columns, px), (rows, py)))
        dx, dy = columns[near_x][None] - px, rows[near_y][:, None] - py
        u, v = c * dx + s * dy, c * dy - s * dx
        arc = _along(kind, u / half, 2.0 / half) * np.exp(-0.5 * ((v - 0.5 * bend * u * u) / b) ** 2)
        arc *= rng.uniform(0.75, 1.0)
        at = np.ix_(near_y, near_x)
        covered[k] = float((arc * (wire[at] < 1)).sum() / arc.sum())
        signal[at] += arc
    if kind == "saturated":
        signal = 1.2 * (1 - np.exp(-2.5 * signal))
    shown = np.where(wire < 1, glow * 0.3, glow + light * signal)
    if kind == "clipped":
        shown = np.minimum(shown, glow + 0.6 * light)
    seen = gaussian_filter(shown, blur * _FINE).reshape(h, _FINE, w, _FINE).mean(axis=(1, 3))
    masked = (
        gaussian_filter((wire < 1).astype(float), blur * _FINE).reshape(h, _FINE, w, _FINE).mean(axis=(1, 3))
    )
    seen += noise * rng.standard_normal(size)
    frame = Frame(np.clip(np.rint(seen), 0, 255).astype(np.uint8), 255.0, f"{kind}-{seed}")
    return Drawn(frame, truth, masked > 0.01, covered)
