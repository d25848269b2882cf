"""Scanned frames of 35 and 70 mm film with known truth: edges of the gate, surrounding film, disturbances.

The gate of a camera limits the exposed area; outside it the film remains unexposed, dark on a slide and
bright on a negative. The scan is formed from the signed distance of each pixel from the gate's outline: a
Gaussian point-spread function, and the disk of a scanner out of focus, convolved with the pixel's square,
exact along a straight edge.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from reseau.core.data import Array

from .streams import stream

Plane = NDArray[np.float32]

_DARK, _BRIGHT = 14.0, 230.0
"""Grey values of unexposed film on a slide and on a negative."""
_FAR, _FAR_SIGMAS = 4.0, 5.0
"""Distance from an outline, pixels and widths of the spread, beyond which a pixel is inside or outside."""
_NODES = 24
"""Nodes of the integration over the disk of a scanner out of focus."""


class FrameFormat(NamedTuple):
    """A camera's frame on its film: size in mm, film 35 or 70 mm wide, radius of its corners, its slits.

    `slits` are the places of V-shaped notches along the left edge, in mm from the middle, y up.
    """

    width: float
    height: float
    film: float
    radius: float = 0.0
    slits: tuple[float, ...] = ()


RICOH = FrameFormat(36.0, 24.0, 35.0, radius=0.3)
"""RICOH KR10M of Cruz et al."""
HASSELBLAD = FrameFormat(56.0, 56.0, 61.5, radius=0.4, slits=(4.0, 8.0))
"""HASSELBLAD 500 CM of Cruz et al.: its magazine leaves two notches at the left."""


@dataclass(frozen=True)
class Beside:
    """Disturbances on the film or in the picture; none by default.

    Parameters
    ----------
    perforations, print, neighbours : bool
        Perforations and edge print of the film, and the frames before and after.
    lines : int
        Bright straight lines near and parallel to an edge, on as many edges (figure 7B of Cruz et al.).
    rods : int
        Bright rods in the picture, bent by the lens and nearly parallel to an edge (figure 7A), dark beyond.
    blown : bool
        Overexposed corner whose light has spread beyond the gate.
    dust, scratches : int
        Grains and hairs of dust; scratches, most of them along the film.
    """

    perforations: bool = False
    print: bool = False
    neighbours: bool = False
    lines: int = 0
    rods: int = 0
    blown: bool = False
    dust: int = 0
    scratches: int = 0


class FrameTruth(NamedTuple):
    """Corners (4, 2) in pixels, ul, ur, lr, ll as seen in the scan, and the gate's corners in mm, y up."""

    corners: Array
    gate: Array


@dataclass(frozen=True)
class FilmFrame:
    """One frame of a roll on a desktop scanner.

    Parameters
    ----------
    seed : int
        Seed of all random numbers.
    format : FrameFormat
        Frame of the camera.
    dpi : float
        Resolution of the scan.
    tilt_deg : float
        Rotation of the film on the glass, counter-clockwise in the scan.
    mirrored : bool
        Whether the film lay with its wrong side up.
    negative : bool
        Whether unexposed film is bright.
    contrast : float
        Contrast of the picture against unexposed film, as a fraction of 255.
    noise : float
        Standard deviation of the scanner's noise, grey values.
    grain : float
        Standard deviation of the film's grain, grey values at full density.
    blur_px : float
        Width of the scanner's and the film's spread, one sigma.
    defocus_px : float
        Radius of the disk of a scanner out of focus.
    carriage_px : float
        Width of a further spread along the columns, by the carriage of the scanner.
    srgb : bool
        Whether grey values are coded as sRGB instead of proportional to the light.
    scene : {"forms", "trees"}
        Forms in any direction, or upright trunks before leaves: lines parallel to the edges.
    fade : float
        Share of the light that the picture lacks at its edges; it grows over the outer eighth of its width.
    gate_sigma_mm : float
        Standard deviation of the gate's corners about the nominal format.
    gate_seed : int
        Seed of the camera's gate; frames of one roll share it.
    film_mm, scanner : float
        Deformation of the film, mm at the corners, and difference of the scanner's two scales.
    bow_mm : float
        Sagitta of the edges, each bowed by up to this.
    margin_mm : float
        Unexposed film around the frame that was scanned.
    crop : str
        Name of the edge outside the scan, or empty.
    beside : Beside
        Disturbances.
    bits : int
        Depth of the scan, 8 or 16.
    colour : bool
        Whether the scan has three channels, of different contrast.
    """

    seed: int = 0
    format: FrameFormat = RICOH
    dpi: float = 600.0
    tilt_deg: float = 0.6
    mirrored: bool = False
    negative: bool = False
    contrast: float = 0.7
    noise: float = 1.5
    grain: float = 3.0
    blur_px: float = 0.7
    defocus_px: float = 0.0
    carriage_px: float = 0.0
    srgb: bool = False
    scene: Literal["forms", "trees"] = "forms"
    fade: float = 0.0
    gate_sigma_mm: float = 0.03
    gate_seed: int = 1
    film_mm: float = 0.004
    scanner: float = 2e-4
    bow_mm: float = 0.005
    margin_mm: float = 2.5
    crop: str = ""
    beside: Beside = field(default_factory=Beside)
    bits: int = 8
    colour: bool = False

    @property
    def px_per_mm(self) -> float:
        """Pixels of the scan in a millimetre."""
        return self.dpi / 25.4

    def with_seed(self, seed: int) -> FilmFrame:
        """Another frame of the same kind."""
        return replace(self, seed=seed)

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Height and width of the scan."""
        w, h = (side + 2 * self.margin_mm for side in self.format[:2])
        # As much of the film as a turned frame needs.
        c, s = abs(np.cos(np.deg2rad(self.tilt_deg))), abs(np.sin(np.deg2rad(self.tilt_deg)))
        size = np.array([w * s + h * c, w * c + h * s]) * self.px_per_mm
        size[0 if self.crop in ("upper", "lower") else 1] -= self._cut if self.crop else 0.0
        return round(float(size[0])), round(float(size[1]))

    @property
    def _cut(self) -> float:
        """Pixels that a cropped scan lacks: the margin and a millimetre of the frame."""
        tilted = abs(float(np.sin(np.deg2rad(self.tilt_deg)))) * max(self.format.width, self.format.height)
        return (self.margin_mm + 1.0 + tilted) * self.px_per_mm

    @cached_property
    def gate(self) -> Array:
        """Corners of the camera's gate in mm, y up, (4, 2): ul, ur, lr, ll."""
        half = np.array(self.format[:2]) / 2
        nominal = half * [[-1, 1], [1, 1], [1, -1], [-1, -1.0]]
        return nominal + stream(self.gate_seed, "gate").normal(0, self.gate_sigma_mm, (4, 2))

    @cached_property
    def _matrix(self) -> Array:
        """From mm (y up) to pixels without the shift: two scales, the turn, the wrong side."""
        rng = stream(self.seed, "scanner")
        scale = self.px_per_mm * (1 + self.scanner * rng.normal(0, 1, 2))
        t = np.deg2rad(self.tilt_deg)
        turn = np.array([[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]])
        flip = np.diag([-1.0 if self.mirrored else 1.0, 1.0])
        return np.asarray(np.diag([scale[0], -scale[1]]) @ turn @ flip)

    @cached_property
    def _shift(self) -> Array:
        centre = (np.array(self.shape[::-1]) - 1) / 2
        centre = centre + stream(self.seed, "place").uniform(-0.5, 0.5, 2) * self.px_per_mm * 0.6
        way = {"upper": (0, -1), "lower": (0, 1), "left": (-1, 0), "right": (1, 0)}.get(self.crop, (0, 0))
        return np.asarray(centre + np.array(way) * self._cut / 2)

    @cached_property
    def truth(self) -> FrameTruth:
        """True corners."""
        film = stream(self.seed, "film").normal(0, self.film_mm, (4, 2))
        corners = (self.gate + film) @ self._matrix.T + self._shift
        # As seen: the wrong side shows the frame's right at the left.
        return FrameTruth(corners[[1, 0, 3, 2]] if self.mirrored else corners, self.gate)

    @cached_property
    def bows_px(self) -> Array:
        """Sagittas of the edges (4,) as seen, positive outwards: upper, right, lower, left."""
        bow = stream(self.seed, "bow").uniform(-1, 1, 4) * self.bow_mm * self.px_per_mm
        return np.asarray(bow)

    def light(self) -> Array:
        """Light on the scanner without noise, grey values (h, w) of 255."""
        return _light(self)

    def scan(self) -> NDArray[Any]:
        """The scan: (h, w), or (h, w, 3) in colour."""
        light = self.light()
        if not self.colour:
            return self._exposed(light, "grey")
        base = 255.0 * 0.9 if self.negative else 14.0
        parts = [
            self._exposed(base + (light - base) * gain, name)
            for name, gain in (("red", 1.0), ("green", 0.8), ("blue", 0.45))
        ]
        return np.stack(parts, axis=2)

    def _exposed(self, light: Array, channel: str) -> NDArray[Any]:
        rng = stream(self.seed, "noise", channel)
        noisy = light + self.noise * rng.standard_normal(light.shape, dtype=np.float32)
        if self.grain > 0:
            noisy += _grain(light.shape, self.grain, rng)
        scale = 257.0 if self.bits == 16 else 1.0
        grey = np.clip(np.rint(noisy * scale), 0, 255 * scale)
        return grey.astype(np.uint16 if self.bits == 16 else np.uint8)


def _light(frame: FilmFrame) -> Array:
    """The film as light, grey values (h, w): picture, unexposed film, perforations, dust, scratches."""
    rng = stream(frame.seed, "scene")
    corners = frame.truth.corners
    x, y = _pixels(frame.shape)
    inside = _share(_gate_distance(frame, x, y, corners), frame)
    view = _View(frame, corners)
    picture = (_trees if frame.scene == "trees" else _picture)(frame, rng)
    if frame.fade > 0:
        depth = np.minimum.reduce([_edge_depth(view, k, x, y) for k in range(4)]) / (view.size.max() / 8)
        picture = picture * (1 - np.float32(frame.fade) * np.clip(1 - depth, 0, 1)).astype(np.float32)
    picture = _features(frame, view, picture, x, y, rng)
    base = _BRIGHT if frame.negative else _DARK
    sign = -1.0 if frame.negative else 1.0
    exposure = inside * picture
    if frame.beside.neighbours:
        exposure = np.maximum(exposure, _neighbours(frame, x, y, rng))
    if frame.beside.blown:
        exposure = _blown(frame, exposure, x, y, corners, rng)
    grey = base + sign * 255.0 * frame.contrast * exposure
    grey = _film(frame, view, grey, rng)
    if frame.carriage_px > 0:
        column = cv2.getGaussianKernel(2 * int(np.ceil(4 * frame.carriage_px)) + 1, frame.carriage_px)
        spread: Any = cv2.sepFilter2D(grey, -1, np.ones(1), column, borderType=cv2.BORDER_REPLICATE)
        grey = spread
    part = np.clip(grey, 0.0, 255.0).astype(np.float64) / 255.0
    if not frame.srgb:
        return np.asarray(255.0 * part)
    return 255.0 * np.where(part > 0.0031308, 1.055 * part ** (1 / 2.4) - 0.055, 12.92 * part)


def _grain(shape: tuple[int, ...], sigma: float, rng: np.random.Generator) -> Plane:
    """Noise of the film's grain, which is wider than a pixel."""
    white = rng.standard_normal(shape, dtype=np.float32)
    smooth = cv2.GaussianBlur(white, (0, 0), 0.8)
    # What a Gaussian of 0.8 px leaves of white noise: 1/(2·√π·0.8).
    return np.asarray(smooth * np.float32(sigma * 2 * np.sqrt(np.pi) * 0.8), dtype=np.float32)


def _pixels(shape: tuple[int, int]) -> tuple[Plane, Plane]:
    x, y = np.meshgrid(np.arange(shape[1], dtype=np.float32), np.arange(shape[0], dtype=np.float32))
    return x, y


def _share(distance: Plane, frame: FilmFrame) -> Plane:
    """Share of pixels within an outline at signed distances, the pixel's square folded with the spread.

    Along the steeper axis the square is integrated exactly, along the other it adds its variance.
    """
    tilt = np.deg2rad(abs(frame.tilt_deg) % 90)
    major, minor = max(np.cos(tilt), np.sin(tilt)), min(np.cos(tilt), np.sin(tilt))
    sigma, half = float(np.hypot(frame.blur_px, minor / np.sqrt(12))), major / 2
    share: Plane = (distance > 0).astype(np.float32)
    near = np.abs(distance) < max(_FAR, _FAR_SIGMAS * sigma) + half + frame.defocus_px
    d = distance[near].astype(np.float64)

    def integral(t: Array) -> Array:
        return np.asarray(t * scipy.special.ndtr(t) + np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi))

    def step(t: Array) -> Array:
        """The blurred step without the disk."""
        rises = integral((t + half) / sigma) - integral((t - half) / sigma)
        return np.asarray(rises * sigma / (2 * half))

    if frame.defocus_px == 0:
        share[near] = step(d)
        return share
    # The disk along a line across the edge is a half circle: Gauss and Chebyshev's rule of the second kind.
    turn = np.pi * np.arange(1, _NODES + 1) / (_NODES + 1)
    weight = np.sin(turn) ** 2 / (np.sin(turn) ** 2).sum()
    share[near] = sum(w * step(d - frame.defocus_px * c) for w, c in zip(weight, np.cos(turn), strict=True))
    return share


class _View:
    """Places within a frame: u from left to right, v from top to bottom, 0 to 1 within it."""

    def __init__(self, frame: FilmFrame, corners: Array) -> None:
        self.corners, self.scale = corners, frame.px_per_mm
        self.size = np.array([np.hypot(*(corners[1] - corners[0])), np.hypot(*(corners[3] - corners[0]))])

    def __call__(self, u: float | Array, v: float | Array) -> Array:
        """Pixels (..., 2)."""
        u, v = np.asarray(u)[..., None], np.asarray(v)[..., None]
        ul, ur, lr, ll = self.corners
        return np.asarray((1 - v) * ((1 - u) * ul + u * ur) + v * ((1 - u) * ll + u * lr))

    def mm(self, x: float | Array, y: float | Array) -> Array:
        """Pixels of places given in mm from the upper left corner, y down."""
        return self(np.asarray(x) * self.scale / self.size[0], np.asarray(y) * self.scale / self.size[1])


def _gate_distance(frame: FilmFrame, x: Plane, y: Plane, corners: Array) -> Plane:
    """Distance in pixels within the gate: bowed edges, rounded corners, slits."""
    inward = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        length = float(np.hypot(*(b - a)))
        along = (b - a) / length
        # Around as seen with y down is clockwise: the inside is at (−t_y, t_x).
        d = (x - a[0]) * -along[1] + (y - a[1]) * along[0]
        t = ((x - a[0]) * along[0] + (y - a[1]) * along[1]) * (2 / length) - 1
        inward.append((d + frame.bows_px[k] * (1 - np.clip(t, -1.2, 1.2) ** 2)).astype(np.float32))
    radius = np.float32(frame.format.radius * frame.px_per_mm)
    pairs = [(inward[i], inward[(i + 1) % 4]) for i in range(4)]
    distance = np.minimum.reduce(inward)
    for p, q in pairs:
        corner = (p < radius) & (q < radius)
        if radius > 0 and corner.any():
            rounded = radius - np.hypot(radius - p[corner], radius - q[corner])
            distance[corner] = np.minimum(distance[corner], rounded)
    for at in frame.format.slits:
        distance = np.maximum(distance, _slit(frame, inward, at))
    return np.asarray(distance, dtype=np.float32)


def _slit(frame: FilmFrame, inward: list[Plane], at: float) -> Plane:
    """Distance within a notch that stands out of the left edge of the camera's frame by half a millimetre."""
    edge = inward[1] if frame.mirrored else inward[3]
    middle = (inward[0] - inward[2]) / 2 + np.float32(at * frame.px_per_mm)
    depth = 0.5 * frame.px_per_mm
    return np.asarray(np.minimum(edge + depth - np.abs(middle) * 1.5, depth - edge) * 0.55, dtype=np.float32)


def _picture(frame: FilmFrame, rng: np.random.Generator) -> Plane:
    """A scene, 0 to 1: large forms, texture, and straight things in any direction."""
    h, w = frame.shape
    scene = np.full((h, w), 0.45, dtype=np.float32)
    for cells, weight in ((3, 0.30), (9, 0.18), (40, 0.10), (160, 0.06)):
        coarse = rng.uniform(-1, 1, (max(2, round(cells * h / w)) + 1, cells + 1)).astype(np.float32)
        scene += np.float32(weight) * cv2.resize(coarse, (w, h), interpolation=cv2.INTER_CUBIC)
    for _ in range(12):
        at, size = rng.uniform(0, 1, 2) * (w, h), rng.uniform(0.03, 0.25, 2) * w
        box = cv2.boxPoints((tuple(at), tuple(size), float(rng.uniform(0, 180))))
        shade = float(rng.uniform(0.1, 0.95))
        cv2.fillPoly(scene, [np.rint(box * 16).astype(np.int32)], shade, cv2.LINE_AA, 4)
    return np.clip(cv2.GaussianBlur(scene, (0, 0), frame.blur_px), 0.04, 1.0)


def _trees(frame: FilmFrame, rng: np.random.Generator) -> Plane:
    """A scene, 0 to 1: leaves and sky above a dark ground, and dark trunks, nearly upright."""
    h, w = frame.shape
    fine = cv2.GaussianBlur(rng.standard_normal((h, w), dtype=np.float32), (0, 0), w / 300)
    coarse = cv2.GaussianBlur(rng.standard_normal((h, w), dtype=np.float32), (0, 0), w / 40)
    leaves = fine / fine.std() + 1.5 * coarse / coarse.std()
    scene = np.where(leaves > rng.uniform(-0.5, 1.0), 0.25, rng.uniform(0.55, 0.9)).astype(np.float32)
    ground = round(h * rng.uniform(0.6, 0.95))
    scene[ground:] = rng.uniform(0.15, 0.5) + 0.05 * coarse[ground:] / coarse.std()
    for _ in range(int(rng.integers(4, 9))):
        foot, half, lean = rng.uniform(0, w), rng.uniform(0.003, 0.02) * w, rng.normal(0, 0.03) * h
        at = [
            (foot - half, h),
            (foot + half, h),
            (foot + 0.8 * half + lean, 0),
            (foot - 0.8 * half + lean, 0),
        ]
        shade = float(rng.uniform(0.05, 0.2))
        cv2.fillPoly(scene, [np.rint(np.array(at) * 16).astype(np.int32)], shade, cv2.LINE_AA, 4)
    spread = float(np.hypot(frame.blur_px, frame.defocus_px / 2))
    return np.clip(cv2.GaussianBlur(scene, (0, 0), spread), 0.04, 1.0)


def _features(
    frame: FilmFrame, view: _View, picture: Plane, x: Plane, y: Plane, rng: np.random.Generator
) -> Plane:
    """Bright lines of a road near an edge (7B); rods of a camera stand before a dark ground (7A)."""
    edges = rng.permutation(4)
    for k in edges[: frame.beside.lines]:
        ground = np.float32(rng.uniform(0.12, 0.3))
        zone = _edge_depth(view, int(k), x, y)
        reach = rng.uniform(0.8, 1.6) * frame.px_per_mm
        picture = np.where(zone < reach, picture * 0.15 + ground, picture).astype(np.float32)
        away, turn = rng.uniform(0.15, 0.7) * frame.px_per_mm, np.tan(np.deg2rad(rng.uniform(-0.3, 0.3)))
        half = rng.uniform(0.04, 0.15) * frame.px_per_mm
        along = _edge_along(view, int(k), x, y)
        line = _share((half - np.abs(zone - away - turn * (along - along.mean()))).astype(np.float32), frame)
        picture = (picture * (1 - line) + 0.97 * line).astype(np.float32)
    for k in edges[: frame.beside.rods]:
        zone, along = _edge_depth(view, int(k), x, y), _edge_along(view, int(k), x, y)
        t = (along - along.mean()) / np.float32(view.size.max() / 2)
        # The picture grows dark towards the corners, where the lens bends the rod away from the edge.
        fading = np.exp(-1.2 * t**2 * np.exp(-zone / (4 * frame.px_per_mm)))
        middle = (rng.uniform(0.25, 0.6) + rng.uniform(0.3, 1.2) * t**2) * frame.px_per_mm
        half = rng.uniform(0.1, 0.25) * frame.px_per_mm
        rod = _share((half - np.abs(zone - middle)).astype(np.float32), frame)
        picture = (picture * fading * (1 - rod) + 0.9 * rod).astype(np.float32)
    return picture


def _edge_depth(view: _View, k: int, x: Plane, y: Plane) -> Plane:
    a, b = view.corners[k], view.corners[(k + 1) % 4]
    t = (b - a) / np.hypot(*(b - a))
    return np.asarray((x - a[0]) * -t[1] + (y - a[1]) * t[0], dtype=np.float32)


def _edge_along(view: _View, k: int, x: Plane, y: Plane) -> Plane:
    a, b = view.corners[k], view.corners[(k + 1) % 4]
    t = (b - a) / np.hypot(*(b - a))
    return np.asarray((x - (a + b)[0] / 2) * t[0] + (y - (a + b)[1] / 2) * t[1], dtype=np.float32)


def _neighbours(frame: FilmFrame, x: Plane, y: Plane, rng: np.random.Generator) -> Plane:
    """The frames before and after on the film: along the width of a 35 mm frame, else above and below."""
    ul, ur, _, ll = frame.truth.corners
    wide = frame.format.film == 35.0
    step = (ur - ul if wide else ll - ul) / (frame.format.width if wide else frame.format.height)
    total = np.zeros(frame.shape, dtype=np.float32)
    for way in (-1.0, 1.0):
        pitch = (frame.format.width if wide else frame.format.height) + rng.uniform(1.2, 2.2)
        moved = frame.truth.corners + way * pitch * step
        inside = _share(_gate_distance(frame, x, y, moved), frame)
        shade = cv2.resize(rng.uniform(0.1, 0.9, (6, 8)).astype(np.float32), frame.shape[::-1])
        total = np.maximum(total, inside * shade)
    return np.asarray(total, dtype=np.float32)


def _blown(
    frame: FilmFrame, exposure: Plane, x: Plane, y: Plane, corners: Array, rng: np.random.Generator
) -> Plane:
    """Light that spreads from a corner far beyond white, on both sides of the gate."""
    at = corners[rng.integers(4)] + rng.normal(0, 0.3, 2) * frame.px_per_mm
    size = rng.uniform(0.4, 1.0) * frame.px_per_mm
    glow = rng.uniform(0.9, 1.6) * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * size**2))
    return np.asarray(np.minimum(exposure + glow, 1.0 / max(frame.contrast, 0.3)), dtype=np.float32)


def _film(frame: FilmFrame, view: _View, grey: Plane, rng: np.random.Generator) -> Plane:
    """Perforations, edge print, dust and scratches."""
    grey = np.ascontiguousarray(grey, dtype=np.float32)
    beside, w, h = frame.beside, frame.format.width, frame.format.height
    if beside.perforations:
        mask = np.zeros(frame.shape, dtype=np.float32)
        start = rng.uniform(0, 4.75)
        for side in (-1.0, 1.0):
            middle = h / 2 + side * (35.0 / 2 - 2.01 - 2.794 / 2)
            for i in range(-3, int(w / 4.75) + 4):
                hole = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [0.99, 1.397]
                at = view.mm(start + 4.75 * i + hole[:, 0], middle + hole[:, 1])
                cv2.fillPoly(mask, [np.rint(at * 16).astype(np.int32)], 1.0, cv2.LINE_AA, 4)
        mask[:] = cv2.GaussianBlur(mask, (0, 0), max(0.03 * frame.px_per_mm, 0.7))
        grey = np.asarray(grey * (1 - mask) + 252.0 * mask, dtype=np.float32)
    if beside.print:
        letters = np.zeros(frame.shape, dtype=np.uint8)
        for i in range(6):
            x, y = view.mm(rng.uniform(0, w), -0.9 if i % 2 else h + 1.6)
            text, size = "KODAK 12A"[: rng.integers(3, 10)], 0.03 * frame.px_per_mm
            thick, font = max(1, round(frame.px_per_mm / 16)), cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(letters, text, (round(x), round(y)), font, size, 255, thick, cv2.LINE_AA)
        grey += (np.float32(60.0 if frame.negative else 150.0) - grey) * (letters / np.float32(255))
    return _damage(frame, view, grey, rng)


def _damage(frame: FilmFrame, view: _View, grey: Plane, rng: np.random.Generator) -> Plane:
    h, w = frame.shape
    for _ in range(frame.beside.dust):
        at = rng.uniform(0, 1, 2) * (w, h)
        if rng.random() < 0.3:  # a hair
            bend = np.cumsum(rng.normal(0, 1, (12, 2)), axis=0) * 0.12 * frame.px_per_mm
            way = np.rint((at + bend) * 16).astype(np.int32)
            cv2.polylines(grey, [way], False, float(rng.uniform(0, 60)), 1, cv2.LINE_AA, 4)
            continue
        size = rng.uniform(0.02, 0.12, 2) * frame.px_per_mm
        tone = float(rng.choice([rng.uniform(0, 40), 250.0]))
        box = (tuple(at), tuple(2 * size), float(rng.uniform(0, 180)))
        cv2.ellipse(grey, box, tone, -1, cv2.LINE_AA)
    for _ in range(frame.beside.scratches):
        v = rng.uniform(-0.03, 1.03)
        ends = view(np.array([-0.3, 1.3]), v + rng.normal(0, 0.004, 2))
        if rng.random() < 0.3:
            ends = rng.uniform(0, 1, (2, 2)) * (w, h)
        tone = float(rng.choice([5.0, 245.0]))
        scratch = [np.rint(ends * 16).astype(np.int32)]
        cv2.polylines(grey, scratch, False, tone, max(1, round(frame.px_per_mm / 24)), cv2.LINE_AA, 4)
    return grey
