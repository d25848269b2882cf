"""Edges with their truth, and the curve that ISO 12233 computes in its plain form.

Edges by rays are formed by brute force. Edges by waves are integrals over the transfer function of a pupil
with a rim: their light falls like 1/d² and leaves every region.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, qmc

from reseau.core.data import Array, Frame

RAYS = ("gaussian", "defocus", "flare", "motion", "coma")
WAVES = ("airy", "annular", "waves")
KINDS = (*RAYS, *WAVES)
Curve = Callable[[Array], Array]
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

    By rays, the point-spread function and the square of a pixel are clouds of them; a pixel has as many as
    fall on the bright side, and the truth is the transform of the same rays.
    """
    size = 48
    angle = np.deg2rad(rng.uniform(3, 20)) * rng.choice([-1, 1])
    form = by_waves if kind in WAVES else by_rays
    spread, truth = form(kind, rng, float(np.cos(angle)), float(np.sin(angle)))
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    slope = np.tan(angle) + 2 * bow * y
    aside = x - rng.uniform(-1, 1) - np.tan(angle) * y - bow * (y**2 - (size**2 - 1) / 12)
    share = spread(aside / np.hypot(1, slope))
    share = share if rng.random() < 0.5 else 1 - share
    level = STEP / 10 ** ((decibels or rng.uniform(30, 50)) / 20)
    variance = level**2 * ((0.2 + 0.8 * share) if shot else np.ones_like(share))
    pixels = DARK + STEP * share + rng.normal(0, np.sqrt(variance))
    if rng.random() < 0.5:
        pixels, variance = pixels.T, variance.T
    return Edge(Frame(pixels, 1e4), truth, variance)


def by_rays(kind: str, rng: np.random.Generator, c: float, s: float) -> tuple[Curve, Curve]:
    """The bright share at distances from the edge with the normal (c, −s), and the modulation."""
    cloud = rays(kind, rng) + _DRAWN[:, 3:5] - 0.5
    across = np.sort(cloud @ np.array([c, -s]))
    counts, bounds = np.histogram(across, np.linspace(-40, 40, 8001))
    centres = (bounds[1:] + bounds[:-1]) / 2

    def truth(f: Array) -> Array:
        seen = counts > 0
        return np.abs(np.exp(-2j * np.pi * np.outer(f, centres[seen])) @ counts[seen]) / _POINTS

    return lambda d: np.searchsorted(across, d) / _POINTS, truth


def by_waves(kind: str, rng: np.random.Generator, c: float, s: float) -> tuple[Curve, Curve]:
    """The same for a pupil: a disk, with a central obscuration, or defocused by waves of light."""
    most = rng.uniform(0.35, 1.6)
    hole = rng.uniform(0.25, 0.5) if kind == "annular" else 0.0
    waves = rng.uniform(0.3, 1.0) if kind == "waves" else 0.0

    def transfer(f: Array) -> Array:
        u = np.minimum(np.abs(f) / most, 1.0)
        pupil = _defocused(u, waves) if waves else _annular(u, hole)
        return pupil * np.sinc(f * c) * np.sinc(f * s)

    nodes, weights = np.polynomial.legendre.leggauss(800)
    frequency = (nodes + 1) / 2 * most
    weighed = weights / 2 * most * transfer(frequency) / (np.pi * frequency)
    at = np.linspace(-45, 45, 9001)
    spread = 0.5 + np.sin(2 * np.pi * np.outer(at, frequency)) @ weighed
    return lambda d: np.interp(d, at, spread), lambda f: np.abs(transfer(f))


def _lens(r: Array, q: float, d: Array) -> Array:
    """Area that disks of the radii r ≥ q share at the distance d."""
    x = (d**2 + r**2 - q**2) / (2 * np.maximum(d, 1e-12))
    y = d - x
    part = [k**2 * np.arccos(np.clip(a / k, -1, 1)) - a * np.sqrt(np.maximum(k**2 - a**2, 0))
            for k, a in ((r, x), (q, y))]  # fmt: skip
    return np.where(d >= r + q, 0.0, np.where(d <= r - q, np.pi * q**2, part[0] + part[1]))


def _annular(u: Array, hole: float) -> Array:
    """Autocorrelation of a ring, by the areas that displaced disks share."""
    d = 2 * u
    shared = _lens(1.0, 1.0, d)
    if hole:
        shared = shared - 2 * _lens(1.0, hole, d) + _lens(hole, hole, d)
    return shared / (np.pi * (1 - hole**2))


def _defocused(u: Array, waves: float) -> Array:
    """H. H. Hopkins, Proc. R. Soc. A 231 (1955) 91, as an integral over the pupil."""
    nodes, weights = np.polynomial.legendre.leggauss(120)
    x = np.outer(1 - u, nodes)
    height = np.sqrt(np.maximum(1 - (np.abs(x) + u[:, None]) ** 2, 0.0))
    return (1 - u) * ((2 * height * np.cos(8 * np.pi * waves * u[:, None] * x)) @ weights) / np.pi


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
