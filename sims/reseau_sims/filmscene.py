"""The picture within a film frame, and what is around it, as light on the scanner's pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from reseau.core.data import Array

from .streams import stream

if TYPE_CHECKING:
    from .filmframe import FilmFrame

__all__ = ["grain", "light"]

Plane = NDArray[np.float32]

_DARK, _BRIGHT = 14.0, 230.0
"""Grey values of unexposed film on a slide and on a negative."""
_FAR, _FAR_SIGMAS = 4.0, 5.0
"""Distance from an outline, pixels and widths of the spread, beyond which a pixel is inside or outside."""


def light(frame: FilmFrame) -> Array:
    """The film as light, grey values (h, w): picture, unexposed film, perforations, dust, scratches."""
    rng = stream(frame.seed, "scene")
    corners = frame.truth.corners
    x, y = _pixels(frame.shape)
    inside = _share(_gate_distance(frame, x, y, corners), frame)
    view = _View(frame, corners)
    picture = _picture(frame, rng)
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
    return np.clip(grey, 0.0, 255.0).astype(np.float64)


def grain(shape: tuple[int, ...], sigma: float, rng: np.random.Generator) -> Plane:
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
    near = np.abs(distance) < max(_FAR, _FAR_SIGMAS * sigma) + half
    d = distance[near].astype(np.float64)

    def integral(t: Array) -> Array:
        return np.asarray(t * ndtr(t) + np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi))

    share[near] = (integral((d + half) / sigma) - integral((d - half) / sigma)) * sigma / (2 * half)
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
