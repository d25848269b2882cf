"""Edges formed by brute force, with their truth; and the curve that ISO 12233 computes in its plain form."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, qmc

from reseau.core.data import Array, Frame

KINDS = ("gaussian", "defocus", "flare", "motion", "coma")
_POINTS = 2**15
_DRAWN = np.clip(qmc.Sobol(6, seed=1).random(_POINTS), 1e-9, 1 - 1e-9)
DARK, STEP = 40.0, 160.0


def rays(kind: str, rng: np.random.Generator) -> Array:
    """Where light of one point falls (n, 2), as a cloud of equal rays."""
    u, v, third = _DRAWN[:, 0], _DRAWN[:, 1], _DRAWN[:, 2]
    normal = np.stack([norm.ppf(u), norm.ppf(v)], axis=1)
    if kind == "none":
        return np.zeros_like(normal)
    if kind == "gaussian":
        return normal * rng.uniform(0.3, 1.2)
    if kind == "defocus":
        turned = 2 * np.pi * v
        disk = np.sqrt(u)[:, None] * np.stack([np.cos(turned), np.sin(turned)], axis=1)
        return disk * rng.uniform(0.8, 2.5)
    if kind == "flare":
        far = third < rng.uniform(0.05, 0.2)
        return normal * np.where(far, rng.uniform(2, 4), rng.uniform(0.4, 0.7))[:, None]
    turned = rng.uniform(0, np.pi)
    along = third - 0.5 if kind == "motion" else 0.7 * np.log(third) ** 2 / 4
    moved = along[:, None] * np.array([np.cos(turned), np.sin(turned)]) * rng.uniform(1, 4)
    return normal * rng.uniform(0.3, 0.6) + moved


@dataclass(frozen=True)
class Edge:
    """An edge with its true values."""

    frame: Frame
    truth: Callable[[Array], Array]
    variance: Array

    def half(self) -> float:
        """Where half of the modulation is left first."""
        f = np.linspace(0.005, 1, 2000)
        values = self.truth(f)
        k = int(np.flatnonzero(values < 0.5)[0])
        return float(np.interp(0.5, values[[k, k - 1]], f[[k, k - 1]]))


def edge_of(
    kind: str,
    rng: np.random.Generator,
    *,
    decibels: float | None = None,
    shot: bool = False,
    bow: float = 0.0,
) -> Edge:
    """One at 3° to 20°, of either orientation and polarity, 30 to 50 dB of its step above the noise.

    The point-spread function and the square of a pixel are clouds of rays; a pixel has as many of them as
    fall on the bright side, and the truth is the transform of the same rays.
    """
    size = 48
    angle = np.deg2rad(rng.uniform(3, 20)) * rng.choice([-1, 1])
    cloud = rays(kind, rng) + _DRAWN[:, 3:5] - 0.5
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    slope = np.tan(angle) + 2 * bow * y
    aside = x - rng.uniform(-1, 1) - np.tan(angle) * y - bow * (y**2 - (size**2 - 1) / 12)
    across = np.sort(cloud @ np.array([np.cos(angle), -np.sin(angle)]))
    share = np.searchsorted(across, aside / np.hypot(1, slope)) / _POINTS
    share = share if rng.random() < 0.5 else 1 - share
    level = STEP / 10 ** ((decibels or rng.uniform(30, 50)) / 20)
    variance = level**2 * ((0.2 + 0.8 * share) if shot else np.ones_like(share))
    pixels = DARK + STEP * share + rng.normal(0, np.sqrt(variance))
    counts, bounds = np.histogram(across, np.linspace(-40, 40, 8001))
    centres = (bounds[1:] + bounds[:-1]) / 2

    def truth(f: Array) -> Array:
        seen = counts > 0
        return np.abs(np.exp(-2j * np.pi * np.outer(f, centres[seen])) @ counts[seen]) / _POINTS

    if rng.random() < 0.5:
        pixels, variance = pixels.T, variance.T
    return Edge(Frame(pixels, 1e4), truth, variance)


def plain_iso(frame: Frame, frequency: Array) -> Array:
    """ISO 12233 as it stands: centroids of rows, a line, bins of a quarter of a pixel, a Hamming window, and
    the transform freed of the difference's own; frequencies along the edge's normal.
    """
    pixels = frame.pixels
    if np.abs(np.diff(pixels, axis=0)).sum() > np.abs(np.diff(pixels, axis=1)).sum():
        pixels = pixels.T
    height, width = pixels.shape
    rows, gradient = np.arange(height), np.diff(pixels, axis=1)
    at = np.arange(width - 1) + 0.5
    line = np.array([0.0, (width - 1) / 2])
    for _ in range(2):
        window = _hamming(at - np.polyval(line, rows)[:, None], width - 1)
        centre = (gradient * window * at).sum(axis=1) / (gradient * window).sum(axis=1)
        line = np.polyfit(rows, centre, 1)
    bins = np.floor(4 * (np.arange(width) - np.polyval(line, rows)[:, None])).astype(int)
    first, half = bins.min(), 2 * width - 8
    counts, sums = np.bincount((bins - first).ravel()), np.bincount((bins - first).ravel(), pixels.ravel())
    spread = (sums / np.maximum(counts, 1))[-first - half : half - first]
    filled = counts[-first - half : half - first] > 0
    spread = np.interp(np.arange(2 * half), np.flatnonzero(filled), spread[filled])
    lines = (spread[2:] - spread[:-2]) / 2
    k = np.arange(len(lines))
    lines = lines * _hamming(k - (len(lines) - 1) / 2, len(lines))
    along_row = frequency * np.cos(np.arctan(line[0]))
    found = np.abs(np.exp(-2j * np.pi * np.outer(along_row, k / 4)) @ lines) / abs(lines.sum())
    return found / np.sinc(along_row / 2)


def _hamming(away: Array, size: int) -> Array:
    return 0.54 + 0.46 * np.cos(2 * np.pi * away / size)
