"""Scans of film frames with true corners, by the way of the light: camera, film, scanner, file.

Run from the checkout: ``python benchmarks/worlds/film.py FOLDER [--count 2] [--kind KIND …]`` writes
``NAME.npy`` and ``NAME.truth.json`` per frame. numpy only.

A gate of four curves limits the light on the film, with a penumbra of its own at each of them. The emulsion
spreads it (an exponential, not a Gaussian), and its characteristic curve turns the logarithm of the exposure
into a density, decreasing on a slide and increasing on a negative. Grain is a fluctuation of density. The
scanner measures transmittances: point spread with wide tails, aperture of the sensor, glare, jitter of its
carriage; grey values are proportional to them, or a power, or those of sRGB; then sharpening, compression.
What lies beside the gate: perforations, numbers, neighbouring frames, a mount, dust, hairs, scratches, fog.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["KINDS", "FilmScan", "World", "frame", "strip"]

Array = NDArray[np.float64]
Plane = NDArray[np.float32]

_OVER = 3
"""Samples per pixel and axis."""
_ROOM = 8
"""Pixels around the scan that are drawn, too."""
_PITCH = 38.0
"""From a frame of 35 mm film to the next, mm."""


@dataclass(frozen=True)
class World:
    """What is different from kind to kind; ranges are drawn from evenly for every frame.

    Parameters
    ----------
    film : {"slide", "negative", "mask"}
        Unexposed film dark; bright; or orange, in three channels.
    code : {"linear", "power", "srgb", "density"}
        Grey values of transmittances.
    gamma : float
        Of the power.
    format : (float, float)
        Of the gate, mm.
    scale : (float, float)
        Pixels per mm.
    tilt : (float, float)
        Rotation of the film, degrees; the sign is random.
    bow, wave : (float, float)
        Largest sagittas of the edges and amplitudes of a full wave along them, mm; the sign is random.
    radius : (float, float)
        Radius of the rounded corners, mm; each has its own.
    penumbra : (float, float)
        Width of the penumbra of each edge, mm.
    scatter, halo : (float, float)
        Length over which the emulsion spreads light, mm, and share of light in the halo of its base.
    blur, tails, glare : (float, float)
        Width of the scanner's spread (px), share of light in an exponential spread four times as wide, and
        share that is spread over the whole scan.
    grain, noise : (float, float)
        Scatter of the density of a pixel at density 1, and of a grey value of 255.
    range : (float, float)
        Logarithm of the brightest over the darkest light in the picture.
    exposure : (float, float)
        Logarithm of the light of the scene over that of middle grey.
    scene : tuple of str
        Of ``forms``, ``posts``, ``horizon``, ``near`` (a line beside an edge), ``night``, ``frame`` (a
        rectangle within the picture), ``half`` (one half nearly without light).
    beside : tuple of str
        Of ``strip`` (perforations, numbers, neighbours), ``close`` (neighbours at 0.5 to 1 mm), ``mount``,
        ``dust``, ``hairs`` (in the gate), ``scratches``, ``leak``, ``crop``, ``table`` (film ends on glass).
    jitter : (float, float)
        Amplitude of periodic errors of the carriage, px.
    sharpen : (float, float)
        Amount of an unsharp mask.
    blocks : (float, float)
        Step of a quantisation of blocks of 8 × 8 as of JPEG, grey values; 0: none.
    """

    film: str = "slide"
    code: str = "linear"
    gamma: float = 1.8
    format: tuple[float, float] = (36.0, 24.0)
    scale: tuple[float, float] = (20.0, 28.0)
    tilt: tuple[float, float] = (0.0, 2.0)
    bow: tuple[float, float] = (0.0, 0.01)
    wave: tuple[float, float] = (0.0, 0.0)
    radius: tuple[float, float] = (0.0, 0.15)
    penumbra: tuple[float, float] = (0.0, 0.0)
    scatter: tuple[float, float] = (0.0, 0.0)
    halo: tuple[float, float] = (0.0, 0.0)
    blur: tuple[float, float] = (0.35, 0.8)
    tails: tuple[float, float] = (0.0, 0.04)
    glare: tuple[float, float] = (0.001, 0.004)
    grain: tuple[float, float] = (0.01, 0.03)
    noise: tuple[float, float] = (0.4, 1.5)
    range: tuple[float, float] = (0.8, 1.4)
    exposure: tuple[float, float] = (-0.1, 0.35)
    scene: tuple[str, ...] = ("forms",)
    beside: tuple[str, ...] = ()
    jitter: tuple[float, float] = (0.0, 0.0)
    sharpen: tuple[float, float] = (0.0, 0.0)
    blocks: tuple[float, float] = (0.0, 0.0)


_PLAIN = World()
KINDS: dict[str, World] = {
    "slide": _PLAIN,
    "slide, sRGB": replace(_PLAIN, code="srgb"),
    "slide, power": replace(_PLAIN, code="power", blur=(0.8, 1.6)),
    "unstated curve": replace(_PLAIN, code="srgb"),
    "negative": replace(_PLAIN, film="negative", range=(1.0, 1.8)),
    "negative, density": replace(_PLAIN, film="negative", code="density", range=(1.0, 1.8)),
    "orange mask": replace(_PLAIN, film="mask", code="srgb", range=(1.0, 1.8)),
    "tails and glare": replace(_PLAIN, tails=(0.1, 0.3), glare=(0.01, 0.03)),
    "soft": replace(_PLAIN, blur=(1.6, 3.0)),
    "tilted, bowed": replace(_PLAIN, tilt=(4.0, 13.0), bow=(0.02, 0.08)),
    "waves": replace(_PLAIN, wave=(0.003, 0.02)),
    "round corners": replace(_PLAIN, radius=(0.4, 1.5)),
    "penumbra": replace(_PLAIN, penumbra=(0.015, 0.06), scatter=(0.001, 0.003)),
    "halation": replace(_PLAIN, scatter=(0.003, 0.008), halo=(0.005, 0.03)),
    "grain, little contrast": replace(_PLAIN, grain=(0.06, 0.12), exposure=(-0.9, -0.4), noise=(1.0, 3.0)),
    "dust, scratches": replace(_PLAIN, beside=("dust", "scratches"), scene=("forms", "posts")),
    "hairs in the gate": replace(_PLAIN, beside=("hairs",)),
    "light leak": replace(_PLAIN, beside=("leak", "strip")),
    "night": replace(_PLAIN, scene=("night",), range=(1.8, 2.4)),
    "half dark": replace(_PLAIN, scene=("forms", "half")),
    "strip": replace(_PLAIN, beside=("strip",), scene=("forms", "horizon")),
    "strip, negative": replace(_PLAIN, film="negative", beside=("strip", "dust"), range=(1.0, 1.8)),
    "close neighbours": replace(_PLAIN, beside=("close",)),
    "mount": replace(_PLAIN, beside=("mount",), radius=(0.5, 2.0), penumbra=(0.02, 0.06)),
    "lines beside edges": replace(_PLAIN, scene=("forms", "near", "horizon")),
    "posts": replace(_PLAIN, scene=("posts", "horizon")),
    "rectangle": replace(_PLAIN, scene=("forms", "frame"), exposure=(-0.5, 0.1)),
    "jitter": replace(_PLAIN, jitter=(0.03, 0.12)),
    "compressed": replace(_PLAIN, code="srgb", blocks=(6.0, 20.0), grain=(0.03, 0.06)),
    "sharpened": replace(_PLAIN, code="srgb", sharpen=(0.5, 1.5), blur=(0.6, 1.2)),
    "on a table": replace(_PLAIN, beside=("table", "strip")),
    "out of focus": replace(_PLAIN, blur=(1.5, 4.0), tails=(0.0, 0.01), scene=("forms", "posts")),
    "half frame": replace(_PLAIN, format=(18.0, 24.0), beside=("strip",)),
    "6x7": replace(_PLAIN, format=(69.0, 56.0), scale=(12.0, 15.0), film="negative", range=(1.0, 1.8)),
    "16 mm": replace(_PLAIN, format=(10.26, 7.49), scale=(60.0, 90.0), radius=(0.2, 0.6)),
    "6x6": replace(_PLAIN, format=(56.0, 56.0), scale=(14.0, 18.0), radius=(0.2, 0.8), tilt=(0.0, 4.0)),
    "cut": replace(_PLAIN, beside=("crop",)),
}
"""Kinds of frames; 36 mm × 24 mm unless said."""


@dataclass
class FilmScan:
    """A drawn scan with its truth.

    Parameters
    ----------
    pixels : ndarray (h, w) or (h, w, 3) of uint8
        Grey values.
    corners : ndarray (4, 2)
        Where the chords of the edges meet: upper left, upper right, lower right, lower left, px.
    px_per_mm : float
        Resolution of the scan.
    format_mm : (float, float)
        Of the gate; a mount's opening is smaller.
    about : dict
        What was drawn.
    """

    pixels: NDArray[np.uint8]
    corners: Array
    px_per_mm: float
    format_mm: tuple[float, float]
    about: dict[str, Any] = field(default_factory=dict)


def _noise(rng: np.random.Generator, shape: tuple[int, int], transfer: Callable[[Array], Array]) -> Plane:
    """Random field of unit variance with a transfer function of the frequency in cycles per sample."""
    f = np.hypot(np.fft.rfftfreq(shape[1]), np.fft.fftfreq(shape[0])[:, None])
    white = rng.standard_normal(shape, dtype=np.float32)
    wave = np.fft.irfft2(np.fft.rfft2(white) * transfer(f).astype(np.float32), shape)
    return np.asarray(wave / wave.std(), np.float32)


def _ramp(inside: Array, width: float) -> Plane:
    return np.clip(0.5 + inside / width, 0, 1).astype(np.float32)


def _scene(world: World, rng: np.random.Generator, x: Array, y: Array, half: Array) -> Plane:
    """Light of the scene, 0 (darkest) to 1 in its logarithm, at positions in mm."""
    px = abs(float(x[0, 1] - x[0, 0])) + abs(float(y[0, 1] - y[0, 0]))
    power = rng.uniform(0.9, 1.4)
    tone = 0.55 + 0.16 * _noise(rng, (x.shape[0], x.shape[1]), lambda f: np.maximum(f, 0.002) ** -power)
    soft = px * rng.uniform(1.0, 2.5)

    def box(cx: float, cy: float, w: float, h: float, turn: float) -> Plane:
        c, s = np.cos(turn), np.sin(turn)
        u, v = c * (x - cx) + s * (y - cy), c * (y - cy) - s * (x - cx)
        return _ramp(w / 2 - np.abs(u), soft) * _ramp(h / 2 - np.abs(v), soft)

    if "night" in world.scene:
        tone = 0.10 + 0.04 * tone
        for _ in range(int(rng.integers(20, 60))):
            at, size = rng.uniform(-1, 1, 2) * half, rng.uniform(0.2, 3.0, 2)
            tone += box(*at, *size, rng.uniform(0, 3)) * rng.uniform(0.1, 0.9)
        # The glow of a city.
        tone += np.float32(rng.uniform(0.1, 0.5)) * np.exp(-(((y - rng.uniform(-0.3, 1) * half[1]) / 6) ** 2))
    if "forms" in world.scene:
        for _ in range(int(rng.integers(8, 30))):
            share, tint = (
                box(*(rng.uniform(-1, 1, 2) * half), *rng.uniform(0.5, 14, 2), rng.uniform(0, 3)),
                rng.uniform(),
            )
            tone += share * (np.float32(tint) - tone)
    if "posts" in world.scene:
        for _ in range(int(rng.integers(4, 12))):
            share = box(rng.uniform(-1, 1) * half[0], 0, rng.uniform(0.1, 1.5), 90.0, rng.normal(0, 0.03))
            tone += share * (np.float32(rng.uniform(0.0, 0.25)) - tone)
    if "horizon" in world.scene:
        at, turn = rng.uniform(-0.5, 0.95) * half[1], rng.normal(0, 0.01)
        low = _ramp(y + turn * x - at, soft)
        tone += low * np.float32(rng.uniform(-0.4, -0.1))
    if "near" in world.scene:
        for k in rng.permutation(4)[: int(rng.integers(1, 3))]:
            depth = [y + half[1], half[0] - x, half[1] - y, x + half[0]][k]
            along = [x, y, x, y][k]
            at, slope = rng.uniform(0.1, 0.7), rng.normal(0, 0.006)
            line = _ramp(rng.uniform(0.05, 0.15) - np.abs(depth - at - slope * along), soft)
            tone += line * (np.float32(rng.choice([0.0, 1.0])) - tone)
            before = _ramp(at + slope * along - depth, soft)
            tone += before * (np.float32(rng.uniform(0.15, 0.5)) - tone) * 0.8
    if "frame" in world.scene:
        w, h = rng.uniform(0.4, 0.8) * half[0] * 2, 0.0
        h = w * half[1] / half[0] * rng.uniform(0.97, 1.03)
        share = box(*(rng.uniform(-0.12, 0.12, 2) * half), w, h, rng.normal(0, 0.02))
        tone = 0.25 + 0.3 * tone + share * (0.75 * tone)
    if "half" in world.scene:
        side = rng.choice([-1, 1])
        way = x / half[0] if rng.random() < 0.6 else y / half[1]
        tone *= 1 - 0.97 * _ramp(side * way - rng.uniform(-0.1, 0.5), 0.3)
    return np.clip(tone, 0.0, 1.0).astype(np.float32)


@dataclass(frozen=True)
class _Grid:
    """Samples of the scan: positions on the film in mm, the way from these to pixels, their spacing in mm."""

    x: Plane
    y: Plane
    matrix: Array
    shift: Array
    step: float

    def near(self, cx: float, cy: float, reach: float) -> tuple[slice, slice]:
        """Rows and columns around a place on the film."""
        at = (self.matrix @ (cx, cy) + self.shift + _ROOM) * _OVER
        r = reach * _OVER * float(np.abs(self.matrix).sum(axis=1).max())
        low, high = np.maximum(at - r, 0).astype(int), np.maximum(at + r, 0).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])


class _Gate:
    """Four curves, mm, y down, in the order upper, right, lower, left."""

    def __init__(self, world: World, rng: np.random.Generator, shrunk: float) -> None:
        half = np.array(world.format) / 2 * shrunk
        self.corners = half * [[-1, -1], [1, -1], [1, 1], [-1, 1]] + rng.normal(0, 0.02, (4, 2))
        sign = rng.choice([-1.0, 1.0], (2, 4))
        self.bow, self.wave = (
            s * rng.uniform(*r, 4) for s, r in zip(sign, (world.bow, world.wave), strict=True)
        )
        self.radius = rng.uniform(*world.radius, 4)
        self.penumbra = rng.uniform(*world.penumbra, 4)

    def depths(self, x: Array, y: Array) -> list[Array]:
        """Distances inwards from each curve."""
        found = []
        corners = self.corners.astype(np.float32)
        for k in range(4):
            a, b = corners[k], corners[(k + 1) % 4]
            length = float(np.hypot(*(b - a)))
            ux, uy = (b - a) / length
            d = (x - a[0]) * -uy + (y - a[1]) * ux
            t = np.clip(((x - a[0]) * ux + (y - a[1]) * uy) / length, -0.1, 1.1)
            bow, wave = float(self.bow[k]), float(self.wave[k])
            found.append(d + bow * 4 * t * (1 - t) + (wave * np.sin(2 * np.pi * t) if wave else 0.0))
        return found

    def light(self, x: Array, y: Array, step: float) -> Plane:
        """Share of light that passes."""
        depth = self.depths(x, y)
        share = np.ones(x.shape, np.float32)
        for d, w in zip(depth, self.penumbra, strict=True):
            share *= _ramp(d, float(w) + step)
        for k in range(4):
            p, q, r = depth[k], depth[k - 1], float(self.radius[k])
            within = (p < r) & (q < r)
            if r > 0 and within.any():
                share[within] *= _ramp(
                    r - np.hypot(r - p[within], r - q[within]), float(self.penumbra[k]) + step
                )
        return share


def frame(world: World, seed: int) -> FilmScan:
    """Draw a frame of a kind."""
    rng = np.random.default_rng([77, seed])
    k = float(rng.uniform(*world.scale))
    mount = "mount" in world.beside
    gate = _Gate(world, rng, float(rng.uniform(0.955, 0.985)) if mount else 1.0)
    turn = np.deg2rad(rng.uniform(*world.tilt) * rng.choice([-1, 1]))
    scales = k * (1 + rng.normal(0, 2e-4, 2))
    matrix = np.diag(scales) @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    margin = rng.uniform(1.6, 4.0, 2)
    if "table" in world.beside:
        margin = np.array([rng.uniform(2, 4), 12.0])
    c, s = abs(np.cos(turn)), abs(np.sin(turn))
    w, h = world.format
    size = np.ceil((np.array([w * c + h * s, w * s + h * c]) + 2 * margin) * k).astype(int)
    size = (size + 2 * _ROOM + 31) // 32 * 32 - 2 * _ROOM  # for a quick transform
    shift = (size - 1) / 2 + rng.uniform(-0.4, 0.4, 2) * k
    if "crop" in world.beside:
        away, way = int(rng.integers(0, 2)), int(rng.choice([-1, 1]))
        cut = (margin[away] + rng.uniform(0.7, 3.0)) * k
        size[away] -= int(cut)
        shift[away] -= cut if way < 0 else 0.0
    width, height = (int(v) for v in size)
    n = _OVER
    px, py = (np.arange(-n * _ROOM, (m + _ROOM) * n) / n + (1 / n - 1) / 2 for m in (width, height))
    gx, gy = (grid.astype(np.float32) for grid in np.meshgrid(px, py))
    if world.jitter[1] > 0:
        period = rng.uniform(8, 120, 3)
        phase, amount = rng.uniform(0, 7, 3), rng.uniform(*world.jitter) * np.array([0.6, 0.3, 0.3])
        moved = (amount * np.sin(2 * np.pi * py[:, None] / period + phase)).sum(axis=1)
        gy = gy + moved[:, None].astype(np.float32)
    back = np.linalg.inv(matrix).astype(np.float32)
    shift = shift.astype(np.float32)
    x = back[0, 0] * (gx - shift[0]) + back[0, 1] * (gy - shift[1])
    y = back[1, 0] * (gx - shift[0]) + back[1, 1] * (gy - shift[1])
    step = 1 / (n * k)
    grid = _Grid(x, y, matrix, shift, step)
    x0, y0 = x[::n, ::n], y[::n, ::n]
    half = np.array(world.format) / 2
    tone = np.repeat(np.repeat(_scene(world, rng, x0, y0, half), n, 0), n, 1)
    span = float(rng.uniform(*world.range))
    light = 10 ** (span * (tone - 0.55) + float(rng.uniform(*world.exposure)))
    share = gate.light(x, y, step)
    if "hairs" in world.beside:
        share *= _hairs(rng, gate, grid)
    stray = 10 ** float(rng.uniform(-3.5, -2.5))
    around = np.full(x.shape, stray, np.float32)
    if "strip" in world.beside or "close" in world.beside:
        gap = float(rng.uniform(0.5, 1.0)) if "close" in world.beside else _PITCH - w
        for side in (-1, 1):
            other = _Gate(world, rng, 1.0)
            moved = x - side * (w + gap)
            around += np.roll(light, 400 * side, axis=1) * other.light(moved, y, step)
    if "leak" in world.beside:
        at, reach = rng.uniform(-0.8, 0.8) * half[0], rng.uniform(2, 7)
        edge = rng.choice([-1, 1]) * (half[1] + rng.uniform(2, 5))
        fog = np.exp(-(((x - at) / reach) ** 2) - ((y - edge) / rng.uniform(2, 5)) ** 2)
        around += np.float32(rng.uniform(0.2, 1.5)) * fog
    if "strip" in world.beside:
        around += 3.0 * _numbers(rng, grid, half)
    response = _response(world, rng)
    if world.scatter[1] > 0:
        f = np.hypot(np.fft.rfftfreq(gx.shape[1], 1 / n), np.fft.fftfreq(gx.shape[0], 1 / n)[:, None])
        scatter, halo = float(rng.uniform(*world.scatter)) * k, float(rng.uniform(*world.halo))
        emulsion = (1 - halo) / (1 + (2 * np.pi * f * scatter) ** 2) ** 1.5
        emulsion += halo * np.exp(-2 * (f * 0.08 * k * np.pi) ** 2)
        layers = [response(np.maximum(_filtered(around + light * share, emulsion), stray))]
    else:
        # The edge of the gate is as sharp as the samples: these are shares of film and picture.
        layers = [response(around), response(around + light)]
    planes = []
    grain = _noise(rng, gx.shape, lambda f: np.exp(-((f * n / 0.35) ** 2)))
    amount = float(rng.uniform(*world.grain)) * n / 2
    clear = _clear(world, rng, x, y, step, k)
    kernel = _scanner(world, rng, gx.shape)
    noise = float(rng.uniform(*world.noise))
    coded = _coder(world)
    mask = {"mask": ((0.25, 1.0), (0.7, 0.8), (1.0, 0.7))}.get(world.film, ((0.08, 1.0),))
    dust = _dust(world, rng, grid)
    floor = rng.uniform(2, 6)
    for base, gain in mask:
        own = [d * gain + amount * grain * np.sqrt(np.maximum(d, 0.05)) for d in layers]
        through = [10 ** -(d + base) for d in own]
        seen = (through[0] + share * (through[-1] - through[0])) * dust
        if clear is not None:
            seen = seen + clear[0] * (clear[1] - seen)
        seen = _filtered(seen, kernel)
        seen = seen.reshape(seen.shape[0] // n, n, -1, n).mean(axis=(1, 3))[_ROOM:-_ROOM, _ROOM:-_ROOM]
        glare = float(rng.uniform(*world.glare))
        grey = floor + 235 * coded(np.clip((seen * (1 - glare) + glare * seen.mean()) * 10**base, 1e-4, 1.5))
        grey += noise * rng.standard_normal(grey.shape) * np.sqrt(0.3 + 0.7 * np.clip(grey, 0, 255) / 255)
        planes.append(_processed(world, rng, grey))
    pixels = np.clip(np.rint(np.stack(planes, axis=2)), 0, 255).astype(np.uint8)
    return FilmScan(
        pixels[:, :, 0] if len(planes) == 1 else pixels,
        gate.corners @ matrix.T + shift,
        k,
        world.format,
        {"tilt_deg": float(np.rad2deg(turn)), "px_per_mm": k, "mount": mount},
    )


def strip(world: World, seed: int) -> tuple[NDArray[np.uint8], list[Array], float]:
    """Draw a strip of two to six frames side by side: its pixels, the corners of each, and pixels per mm."""
    rng = np.random.default_rng([78, seed])
    scale = float(rng.uniform(*world.scale))
    level = replace(world, scale=(scale, scale), tilt=(0.0, 0.3))
    drawn = [frame(level, 100 * seed + k) for k in range(int(rng.integers(2, 7)))]
    height = min(len(each.pixels) for each in drawn)
    parts, corners, left = [], [], 0
    for each in drawn:
        # Between frames half a millimetre to two of film stay on either side.
        x, away = each.corners[:, 0], rng.uniform(0.5, 2.0, 2) * scale
        first, last = max(int(x.min() - away[0]), 0), min(int(x.max() + away[1]), each.pixels.shape[1])
        down = (len(each.pixels) - height) // 2
        parts.append(each.pixels[down : down + height, first:last])
        corners.append(each.corners + np.array([left - first, -down]))
        left += last - first
    return np.concatenate(parts, axis=1), corners, scale


def _filtered(light: Array | Plane, transfer: Array) -> Array:
    spectrum = np.fft.rfft2(light.astype(np.float32))
    return np.asarray(np.fft.irfft2(spectrum * transfer.astype(np.float32), light.shape))


def _response(world: World, rng: np.random.Generator) -> Callable[[Array], Array]:
    """The characteristic curve: density of an exposure above that of the clear film."""
    slope = float(rng.uniform(1.3, 2.0))
    if world.film == "slide":
        most = float(rng.uniform(2.4, 3.4))
        return lambda exposure: np.asarray(most / (1 + 10 ** (slope * (np.log10(exposure) + 0.35))))
    most = float(rng.uniform(1.6, 2.4))
    return lambda exposure: np.asarray(most / (1 + 10 ** (-0.6 * slope * (np.log10(exposure) - 0.3))))


def _coder(world: World) -> Callable[[Array], Array]:
    if world.code == "srgb":
        return lambda t: np.where(t < 0.0031308, 12.92 * t, 1.055 * np.maximum(t, 1e-6) ** (1 / 2.4) - 0.055)
    if world.code == "power":
        return lambda t: t ** (1 / world.gamma)
    if world.code == "density":
        return lambda t: 1 + np.log10(np.maximum(t, 1e-3)) / 3.0
    return lambda t: t


def _scanner(world: World, rng: np.random.Generator, shape: tuple[int, int]) -> Array:
    """Transfer function of the lens: a Gaussian with tails, unequal in both directions, without pixels."""
    n = _OVER
    fx, fy = np.fft.rfftfreq(shape[1], 1 / n), np.fft.fftfreq(shape[0], 1 / n)[:, None]
    sx = float(rng.uniform(*world.blur))
    sy = sx * float(rng.uniform(0.85, 1.2))
    core = np.exp(-2 * np.pi**2 * ((sx * fx) ** 2 + (sy * fy) ** 2))
    wide = (1 + (2 * np.pi * 4 * sx) ** 2 * (fx**2 + fy**2)) ** -1.5
    tails = float(rng.uniform(*world.tails))
    return np.asarray((1 - tails) * core + tails * wide)


def _processed(world: World, rng: np.random.Generator, grey: Array) -> Array:
    amount = float(rng.uniform(*world.sharpen))
    if amount > 0:
        f2 = np.fft.rfftfreq(grey.shape[1]) ** 2 + np.fft.fftfreq(grey.shape[0])[:, None] ** 2
        grey = np.clip(grey, 0, 255)
        grey = grey + amount * (
            grey - _filtered(grey, np.exp(-2 * np.pi**2 * f2 * rng.uniform(0.6, 1.5) ** 2))
        )
    step = float(rng.uniform(*world.blocks))
    if step > 0:
        j = np.arange(8)
        dct = np.cos(np.pi * (j + 0.5) * j[:, None] / 8) * np.where(j[:, None] == 0, np.sqrt(1 / 8), 0.5)
        h, w = (m // 8 * 8 for m in grey.shape)
        part = grey[:h, :w].reshape(h // 8, 8, w // 8, 8).transpose(0, 2, 1, 3)
        table = step * (1 + 0.35 * (j + j[:, None]))
        part = dct.T @ (np.rint(dct @ part @ dct.T / table) * table) @ dct
        grey = grey.copy()
        grey[:h, :w] = part.transpose(0, 2, 1, 3).reshape(h, w)
    return grey


def _hairs(rng: np.random.Generator, gate: _Gate, grid: _Grid) -> Plane:
    """Fibres that stand from the gate into the light."""
    left = np.ones(grid.x.shape, np.float32)
    for _ in range(int(rng.integers(3, 12))):
        k, t = int(rng.integers(0, 4)), rng.uniform(0.05, 0.95)
        a, b = gate.corners[k], gate.corners[(k + 1) % 4]
        u = (b - a) / np.hypot(*(b - a))
        at, inward = a + t * (b - a), np.array([-u[1], u[0]])
        lean, bend, long = rng.normal(0, 0.8), rng.normal(0, 0.5), rng.uniform(0.1, 1.2)
        near = grid.near(*at, 2.5)
        x, y = grid.x[near] - at[0], grid.y[near] - at[1]
        p, q = x * u[0] + y * u[1], x * inward[0] + y * inward[1]
        hair = _ramp(rng.uniform(0.006, 0.03) - np.abs(p - lean * q - bend * q * q), grid.step + 0.01)
        left[near] *= 1 - hair * _ramp(long - np.abs(q), grid.step)
    return left


def _numbers(rng: np.random.Generator, grid: _Grid, half: Array) -> Plane:
    """Strokes and bars that the maker exposed beside the perforations."""
    light = np.zeros(grid.x.shape, np.float32)
    for side in (-1, 1):
        for _ in range(int(rng.integers(4, 14))):
            cx, cy = rng.uniform(-1, 1) * half[0], side * (half[1] + rng.uniform(0.5, 1.0))
            w, h = rng.uniform(0.1, 0.8), rng.uniform(0.1, 0.6)
            near = grid.near(cx, cy, 1.0)
            x, y = np.abs(grid.x[near] - cx), np.abs(grid.y[near] - cy)
            light[near] += ((x < w / 2) & (y < h / 2)).astype(np.float32)
    return light


def _clear(
    world: World, rng: np.random.Generator, x: Array, y: Array, step: float, k: float
) -> tuple[Plane, Array] | None:
    """What covers the film or lies beside it: its share, and its transmittance."""
    share: Plane = np.zeros(x.shape, np.float32)
    tone = np.full(x.shape, 1.0)
    if "strip" in world.beside:
        first = rng.uniform(0, 4.75)
        for side in (-1, 1):
            u = (x - first + 2.375) % 4.75 - 2.375
            v = y - side * (17.5 - 2.0 - 1.4)
            r = 0.5
            corner = np.hypot(np.maximum(np.abs(u) - 0.99 + r, 0), np.maximum(np.abs(v) - 1.4 + r, 0))
            share = np.maximum(share, _ramp(r - corner, step))
    if "table" in world.beside:
        share = np.maximum(share, _ramp(np.abs(y) - 17.5, step))
    if "mount" in world.beside:
        return None
    return (share, tone) if share.any() else None


def _dust(world: World, rng: np.random.Generator, grid: _Grid) -> Plane:
    """Transmittance of dust and scratches on the film."""
    x, y, step = grid.x, grid.y, grid.step
    left = np.ones(x.shape, np.float32)
    reach = np.array([np.abs(x).max(), np.abs(y).max()])
    for _ in range(int(rng.integers(60, 250)) if "dust" in world.beside else int(rng.integers(0, 12))):
        (cx, cy), r = rng.uniform(-1, 1, 2) * reach, rng.lognormal(-3.4, 0.7)
        near = grid.near(cx, cy, 2 * r + 0.1)
        u, v = x[near] - cx, y[near] - cy
        form = r * (1 + 0.4 * np.sin(3 * np.arctan2(v, u) + rng.uniform(0, 6)))
        left[near] *= 1 - rng.uniform(0.5, 1) * _ramp(form - np.hypot(u, v), step + 0.01)
    for _ in range(int(rng.integers(2, 9)) if "scratches" in world.beside else 0):
        slope, at = rng.normal(0, 0.03), rng.uniform(-1, 1) * reach[1]
        line = _ramp(rng.uniform(0.005, 0.02) - np.abs(y - at - slope * x), step)
        left *= 1 + line * np.float32(rng.choice([-0.8, 1.5]))
    return left


def main() -> None:
    """Write frames of every kind."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=2)
    parser.add_argument("--kind", choices=KINDS, action="append")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    for i, kind in enumerate(KINDS):
        for seed in range(given.count if not given.kind or kind in given.kind else 0):
            drawn, name = (
                frame(KINDS[kind], 1000 * i + seed),
                f"{kind.replace(', ', '-').replace(' ', '-')}_{seed}",
            )
            np.save(given.folder / f"{name}.npy", drawn.pixels)
            truth = {"corners": drawn.corners.tolist(), "format_mm": drawn.format_mm, **drawn.about}
            (given.folder / f"{name}.truth.json").write_text(json.dumps(truth))
            print(given.folder / f"{name}.npy")


if __name__ == "__main__":
    main()
