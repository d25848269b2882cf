"""Scanned aerial photographs with fiducial marks, with truth, drawn without the project's image formation.

Run from the checkout: ``python benchmarks/worlds/fiducials.py FOLDER [--count 8]`` writes ``NAME.tif`` (or
``.jpg``), ``NAME.design.json`` and ``NAME.truth.json`` per photograph; with ``--camera camera.json`` those of
a camera by its design.

The film is a function of position (mm): a picture of fields, roads and texture within the frame of a camera,
its dark border, and marks given by distances to lines and circles. It is sampled six times per pixel around
the marks, blurred by a Gaussian, a disk, a Gaussian with a wide halo, or motion, and turned into grey values
by a gamma; grain is correlated and depends on the density. Film shrinks unevenly and is turned, shifted,
mirrored; scratches and dust lie on it; the scan may be a JPEG. What the design states of the marks differs
from what is drawn by some percent, as a drawing differs from a camera.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from worlds.pixels import Array, edge

OLDER = ("wild", "wild8", "rings", "dark", "zeiss", "notches", "round", "wedges", "arcs", "checks")
SHAPES = (
    "bars", "brackets", "three", "tees", "floating", "arrows", "polygons", "numbers", "halves", "sectors"
)  # fmt: skip
"""Cameras whose marks are of any shape; three in ten of their scans are negatives."""
KINDS = (*OLDER, *SHAPES)
_OVER = 6


def _turn(u: Array, v: Array, degrees: float) -> tuple[Array, Array]:
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return c * u + s * v, c * v - s * u


def drawn_part(part: dict[str, Any], u: Array, v: Array, step: float) -> Array:
    """Coverage of one part of a mark at positions relative to its point, mm, y up."""
    at = part.get("at", (0.0, 0.0))
    u, v = _turn(u - at[0], v - at[1], part.get("turn_deg", 0.0))
    half, r = part.get("size", 0.0) / 2, np.hypot(u, v)
    w = part.get("line_width", 0.0) / 2
    shape = part["shape"]
    if shape == "disk":
        return edge(half - r, step)
    if shape == "square":
        return edge(half - np.abs(u), step) * edge(half - np.abs(v), step)
    if shape == "bar":
        return edge(half - np.abs(u), step) * edge(w - np.abs(v), step)
    if shape == "polygon":
        return edge(_depth(np.array(part["corners"]), u, v), step)
    if "arms_deg" in part:
        share = np.zeros_like(u)
        for turn in part["arms_deg"]:
            a, b = _turn(u, v, turn)
            share = np.maximum(share, edge(np.minimum(half - a, a + w), step) * edge(w - np.abs(b), step))
        return share
    if shape == "arc" and not w:
        a, b = (_turn(u, v, part[key])[1] for key in ("from_deg", "to_deg"))
        wide = part["to_deg"] - part["from_deg"] > 180
        sides = np.maximum(a, -b) if wide else np.minimum(a, -b)
        return edge(np.minimum(half - r, sides), step)
    if shape == "cross":
        arms = np.maximum(
            edge(w - np.abs(u), step) * edge(half - np.abs(v), step),
            edge(w - np.abs(v), step) * edge(half - np.abs(u), step),
        )
        gap = part.get("gap", 0.0) / 2
        if gap > w:  # arms that end straight
            arms = arms * edge(np.maximum(np.abs(u), np.abs(v)) - gap, step)
        return arms
    if shape in ("ring", "arc"):
        ring = edge(half - r, step) * edge(r - half + 2 * w, step)
        if shape == "arc":
            angle = np.rad2deg(np.arctan2(v, u)) - part["from_deg"]
            ring = ring * ((angle % 360) < part["to_deg"] - part["from_deg"])
        return ring
    slope = part["width"] / 2 / part["size"]
    if shape == "wedge":
        return edge((-v * slope - np.abs(u)) / np.hypot(1, slope), step) * edge(v + part["size"], step)
    if part.get("form") == "round":
        return np.maximum(edge(part["width"] / 2 - r, step), edge(-v, step))
    tooth = edge((-v * slope - np.abs(u)) / np.hypot(1, slope), step)
    return np.maximum(tooth * (v < 0), edge(-part["size"] - v, step))


def _depth(corners: Array, u: Array, v: Array) -> Array:
    """Distance from the outline of a polygon, positive inside."""
    inside, least = np.zeros(u.shape, bool), np.full(u.shape, np.inf)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        dx, dy = x1 - x0, y1 - y0
        t = np.clip(((u - x0) * dx + (v - y0) * dy) / (dx * dx + dy * dy), 0, 1)
        least = np.minimum(least, np.hypot(u - x0 - t * dx, v - y0 - t * dy))
        crosses = (y0 > v) != (y1 > v)
        inside ^= crosses & (u < x0 + (v - y0) * dx / (dy if dy else 1.0))
    return np.where(inside, least, -least)


def _with_digit(part: dict[str, Any], rng: np.random.Generator) -> list[dict[str, Any]]:
    """The part, or a number of bars within a square that the design says to ignore."""
    if part.get("use") != "ignore":
        return [part]
    (x, y), size = part["at"], 0.7 * part["size"]
    turn = part.get("turn_deg", 0.0)
    bars = [(0.0, 0.5, 0.0, 0.6), (0.3, 0.0, 90.0, 1.0), (-0.3, 0.2, 90.0, 0.6), (0.0, 0.0, 0.0, 0.6)]
    kept = [bars[i] for i in range(4) if i < 2 or rng.random() < 0.5]
    return [
        {"shape": "bar", "size": size * long, "line_width": 0.12, "turn_deg": turn + angle,
         "at": (x + _turn(size * a, size * b, -turn)[0], y + _turn(size * a, size * b, -turn)[1])}
        for a, b, angle, long in kept
    ]  # fmt: skip


@dataclass
class Camera:
    """Marks of a camera: drawn parts by kind, places, and the tone of what lies around each kind."""

    marks: dict[str, dict[str, Any]]
    points: list[dict[str, Any]]
    half: float
    seats: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Radius of the plate under a mark of a kind (mm), and its transmittance."""


def _corners(a: float) -> dict[str, tuple[float, float]]:
    return {"1": (a, -a), "2": (-a, -a), "3": (-a, a), "4": (a, a)}


def _middles(a: float) -> dict[str, tuple[float, float]]:
    return {"5": (-a, 0.0), "6": (a, 0.0), "7": (0.0, a), "8": (0.0, -a)}


_INWARD = {"5": -90.0, "6": 90.0, "7": 180.0, "8": 0.0, "1": 45.0, "2": -45.0, "3": -135.0, "4": 135.0}
"""Rotation of marks that point from the border into the picture."""


def camera(kind: str, rng: np.random.Generator) -> Camera:
    """A camera of a kind; coordinates deviate from nominal ones as a calibration finds them."""
    half = 114.0
    cross = {"shape": "cross", "size": 2.6, "line_width": 0.12, "gap": 0.5, "turn_deg": 45.0}
    dot = {"shape": "disk", "size": 0.16}
    ring = {"shape": "ring", "size": 1.4, "line_width": 0.12}
    upright = {"shape": "cross", "size": 2.4, "line_width": 0.12}
    places: dict[str, tuple[float, float]]
    kinds: dict[str, str] = {}
    seats: dict[str, tuple[float, float]] = {}
    if kind in ("wild", "wild8"):
        marks = {"x": {"polarity": "bright", "parts": [cross, dot], "margin": 0.6}}
        places = _corners(106.0)
        seats = {"x": (3.2, 0.02), "o": (2.6, 0.02)}
        if kind == "wild8":
            marks["o"] = {
                "polarity": "bright",
                "parts": [dot, ring, {**cross, "turn_deg": 0.0}],
                "margin": 0.5,
            }
            places |= _middles(110.0)
            kinds = dict.fromkeys("5678", "o")
    elif kind == "rings":
        marks = {"o": {"polarity": "bright", "parts": [ring, upright], "margin": 0.6}}
        places, seats = _corners(103.0) | _middles(109.0), {"o": (3.0, 0.03)}
        kinds = dict.fromkeys("12345678", "o")
    elif kind == "dark":
        marks = {"x": {"polarity": "dark", "parts": [{**cross, "gap": 0.3}], "margin": 0.5}}
        places, seats = _corners(105.0), {"x": (2.6, 0.85)}
    elif kind == "zeiss":
        marks = {"dot": {"polarity": "bright", "parts": [{"shape": "disk", "size": 0.3}], "margin": 0.7}}
        places = _corners(113.0) | _middles(113.0)
        kinds, seats = dict.fromkeys("12345678", "dot"), {"dot": (1.6, 0.02)}
        half = 116.0
    elif kind in ("notches", "round"):
        form = (
            {"size": 1.6, "width": 2.0} if kind == "notches" else {"size": 1.0, "width": 2.4, "form": "round"}
        )
        marks = {"n": {"polarity": "dark", "parts": [{"shape": "notch", **form}], "margin": 1.2}}
        places, kinds = _middles(half - (0.0 if kind == "round" else 1.6)), dict.fromkeys("5678", "n")
    elif kind == "wedges":
        marks = {
            "w": {
                "polarity": "bright",
                "parts": [{"shape": "wedge", "size": 2.4, "width": 1.6}],
                "margin": 0.6,
            }
        }
        places, seats = _middles(half + 4.0), {"w": (4.2, 0.02)}
        kinds = dict.fromkeys("5678", "w")
    elif kind == "arcs":
        arcs = [
            {"shape": "arc", "size": 1.8, "line_width": 0.16, "from_deg": a + 20.0, "to_deg": a + 70.0}
            for a in (0.0, 90.0, 180.0, 270.0)
        ]
        marks = {
            "a": {"polarity": "bright", "parts": [{"shape": "disk", "size": 0.25}, *arcs], "margin": 0.5}
        }
        places, seats = _corners(106.0), {"a": (2.4, 0.03)}
        kinds = dict.fromkeys("1234", "a")
    elif kind in SHAPES:
        marks, places, seats, kinds = _of_any_shape(kind, half)
    else:
        squares = [{"shape": "square", "size": 0.9, "at": at} for at in ((0.46, 0.46), (-0.46, -0.46))]
        marks = {"c": {"polarity": "bright", "parts": squares, "margin": 0.5}}
        places, seats = _middles(half + 3.0), {"c": (2.8, 0.02)}
        kinds = dict.fromkeys("5678", "c")
    inward = kind in ("notches", "round", "wedges", "arrows", "halves")
    points = []
    for name, (x, y) in places.items():
        dx, dy = rng.normal(0, 0.006, 2)
        point = {"id": name, "x": x + dx, "y": y + dy, "sigma": 0.002, "mark": kinds.get(name, "x")}
        points.append(point | ({"turn_deg": _INWARD[name]} if inward else {}))
    return Camera(marks, points, half, seats)


def _of_any_shape(kind: str, half: float) -> Any:
    """Marks, places, plates and kinds of marks of a camera of :data:`SHAPES`."""
    cross = {"shape": "cross", "size": 2.4, "line_width": 0.14}
    part: list[dict[str, Any]]
    places, polarity, margin, seat = _corners(106.0), "bright", 0.5, (2.8, 0.02)
    if kind == "bars":
        part = [{"shape": "bar", "size": 1.6, "line_width": 0.3, "at": (0.0, at)} for at in (-0.5, 0.5)]
    elif kind == "brackets":
        part = [{**cross, "arms_deg": (0.0, 90.0)}]
    elif kind == "three":
        part = [{**cross, "arms_deg": (90.0, 210.0, 330.0)}]
    elif kind == "tees":
        part, places = [{**cross, "arms_deg": (0.0, 90.0, 180.0)}], _middles(108.0)
    elif kind == "floating":
        part, polarity, seat = [{**cross, "size": 3.0, "gap": 1.2}], "dark", (2.6, 0.85)
    elif kind == "arrows":
        part = [
            {"shape": "wedge", "size": 1.0, "width": 0.9},
            {"shape": "bar", "size": 1.4, "line_width": 0.25, "at": (0.0, -1.6), "turn_deg": 90.0},
        ]
        places, seat = _middles(half + 4.0), (4.6, 0.02)
    elif kind == "polygons":
        kite = [(0.0, 0.0), (0.7, 0.9), (0.2, 0.7), (0.2, 1.6), (-0.2, 1.6), (-0.2, 0.7), (-0.7, 0.9)]
        part, seat = [{"shape": "polygon", "corners": [(x, y - 0.8) for x, y in kite]}], (2.8, 0.02)
    elif kind == "numbers":
        part = [
            {**cross, "gap": 0.4},
            {"shape": "disk", "size": 0.16},
            {"shape": "square", "size": 0.9, "at": (0.75, 0.75), "use": "ignore"},
        ]
        margin = 0.6
    elif kind == "halves":
        part = [{"shape": "arc", "size": 2.0, "from_deg": 0.0, "to_deg": 180.0}]
        places = _middles(half + 4.0)
    else:
        part = [{"shape": "arc", "size": 2.0, "from_deg": a, "to_deg": a + 90.0} for a in (0.0, 180.0)]
        part.append({"shape": "disk", "size": 0.4, "use": "cut"})
    mark = {"polarity": polarity, "parts": part, "margin": margin}
    return {"s": mark}, places, {"s": seat}, dict.fromkeys(places, "s")


@dataclass
class Photograph:
    """A drawn scan and its truth."""

    pixels: NDArray[Any]
    design: dict[str, Any]
    truth: dict[str, Any]
    jpeg: int | None


def _picture(rng: np.random.Generator, size: int) -> NDArray[np.float32]:
    """Transmittance of a picture: fields, roads, texture of all scales."""
    f = np.hypot(*np.meshgrid(np.fft.rfftfreq(size), np.fft.fftfreq(size)))
    f[0, 0] = 1.0
    wave = np.fft.rfft2(rng.standard_normal((size, size))) / f ** rng.uniform(0.9, 1.4)
    texture = np.fft.irfft2(wave)
    texture = (texture / texture.std()).astype(np.float32)
    fields = np.zeros((size, size), np.float32)
    for _ in range(int(rng.integers(20, 120))):
        c = rng.uniform(0, size, 2)
        box = cv2.boxPoints(
            (tuple(map(float, c)), tuple(map(float, rng.uniform(20, 260, 2))), rng.uniform(0, 90))
        )
        cv2.fillConvexPoly(fields, np.intp(box), float(rng.normal(0, 1)))
    for _ in range(int(rng.integers(5, 30))):
        a, b = rng.integers(-200, size + 200, (2, 2))
        cv2.line(
            fields,
            tuple(map(int, a)),
            tuple(map(int, b)),
            float(rng.choice([-2, 2])),
            int(rng.integers(1, 4)),
        )
    tone = rng.uniform(0.35, 0.65) + 0.10 * texture + 0.13 * fields
    return np.clip(tone, 0.06, 0.95).astype(np.float32)


def camera_of(design: dict[str, Any], rng: np.random.Generator) -> Camera:
    """A camera by its design, on dark plates; coordinates deviate from those of the design by 6 µm."""
    off = rng.normal(0, 0.006, (len(design["points"]), 2))
    points = [
        p | {"x": p["x"] + dx, "y": p["y"] + dy} for p, (dx, dy) in zip(design["points"], off, strict=True)
    ]
    return Camera(design["marks"], points, 114.0, dict.fromkeys(design["marks"], (3.2, 0.02)))


def photograph(
    kind: str,
    seed: int,
    px_per_mm: float | None = None,
    design: dict[str, Any] | None = None,
    frame: int | None = None,
) -> Photograph:
    """A photograph of a kind of camera, or of that with a design; of a block by one camera a `frame`."""
    which = [KINDS.index(kind) if design is None else len(OLDER), seed]
    rng = np.random.default_rng(which)
    cam = camera(kind, rng) if design is None else camera_of(design, rng)
    k = float(px_per_mm or rng.uniform(11, 20))
    if frame is not None:
        rng = np.random.default_rng([*which, frame])
    negative = kind in SHAPES and bool(rng.random() < 0.3)
    size = round(2 * 124.0 * k)
    texture = _picture(rng, 2048)
    fine = rng.standard_normal((512, 512)).astype(np.float32)
    turn, mirrored = int(rng.choice([0, 0, 90, 180, 270])), bool(rng.random() < 0.25)
    angle = np.deg2rad(turn + rng.uniform(-2.5, 2.5))
    shrink = np.array(
        [[1 + rng.normal(0, 8e-4), rng.normal(0, 3e-4)], [rng.normal(0, 3e-4), 1 + rng.normal(0, 8e-4)]]
    )
    side = np.diag([-1.0 if mirrored else 1.0, -1.0])
    rot = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    linear = k * side @ rot @ shrink
    shift = (size - 1) / 2 + rng.uniform(-2.0, 2.0, 2) * k
    back = np.linalg.inv(linear)
    border = float(rng.uniform(0.01, 0.04))
    stray = rng.normal(0, 1, 3) * [0.02, 0.0002, 0.0002]  # of the light of the scanner
    lines = rng if frame is None else np.random.default_rng([*which, 0, 0])  # of the camera
    real = {
        name: [
            part | {key: part[key] * float(1 + lines.normal(0, 0.04)) for key in {"line_width"} & part.keys()}
            for whole in mark["parts"]
            for part in _with_digit(whole, lines)
        ]
        for name, mark in cam.marks.items()
    }

    def film(x: Array, y: Array, step: float) -> Array:
        inner = edge(np.minimum(cam.half - np.abs(x), cam.half - np.abs(y)), step)
        tu, tv = ((a / (2 * 124.0) + 0.5) * 2047 for a in (x, y))
        tone = cv2.remap(texture, tu.astype(np.float32), tv.astype(np.float32), cv2.INTER_LINEAR).astype(
            float
        )
        tone += 0.03 * fine[(np.floor(x * 9).astype(int)) % 512, (np.floor(y * 9).astype(int)) % 512]
        light = border + inner * (tone - border)
        for point in cam.points:
            u, v = x - point["x"], y - point["y"]
            near = (np.abs(u) < 8) & (np.abs(v) < 8)
            if not near.any():
                continue
            u, v, here = u[near], v[near], light[near]
            seat = cam.seats.get(point["mark"])
            if seat is not None:
                plate = edge(seat[0] - np.hypot(u, v), step)
                here = here + plate * (seat[1] - here)
            mark = cam.marks[point["mark"]]
            tu2, tv2 = _turn(u, v, point.get("turn_deg", 0.0))
            share = np.zeros_like(u)
            for part in real[point["mark"]]:
                drawn = drawn_part(part, tu2, tv2, step)
                cut = part.get("use") == "cut"
                share = share * (1 - drawn) if cut else np.maximum(share, drawn)
            tone_of = border if mark["polarity"] == "dark" else bright
            light[near] = here + share * (tone_of - here)
        return light

    bright = float(rng.uniform(0.25, 0.9))
    form = str(rng.choice(["gauss", "disk", "halo", "motion"]))
    blur = float(rng.uniform(0.6, 1.6))
    rows, columns = np.arange(size), np.arange(size)
    light = np.empty((size, size), np.float32)
    for top in range(0, size, 256):
        y, x = np.meshgrid(rows[top : top + 256], columns, indexing="ij")
        at = (np.stack([x, y], -1) - shift) @ back.T
        light[top : top + 256] = film(at[..., 0], at[..., 1], 1 / k)
    light = cv2.GaussianBlur(light, (0, 0), blur)
    places = np.array([[p["x"], p["y"]] for p in cam.points]) @ linear.T + shift
    reach = int(6.0 * k)
    for place in places:
        x0, y0 = np.maximum(np.rint(place).astype(int) - reach, 0)
        x1, y1 = np.minimum(np.rint(place).astype(int) + reach, size - 1)
        if x1 - x0 < 8 or y1 - y0 < 8:
            continue
        light[y0:y1, x0:x1] = _sampled(film, (x0, y0, x1, y1), shift, back, k, form, blur)
    light = light * (
        1
        + stray[0]
        + stray[1] * (columns - size / 2)[None] * 0.3
        + stray[2] * (rows - size / 2)[:, None] * 0.3
    )
    light = np.clip(light, 0, 1.2)
    gamma = float(rng.uniform(0.6, 1.1))
    grain = cv2.GaussianBlur(
        rng.standard_normal((size, size)).astype(np.float32), (0, 0), float(rng.uniform(0.5, 1.3))
    )
    grain /= grain.std()
    amount = float(rng.uniform(0.005, 0.03))
    grey = light**gamma + amount * grain * np.sqrt(np.clip(light, 0.01, 1)) * 1.4
    grey += float(rng.uniform(0.002, 0.006)) * rng.standard_normal((size, size)).astype(np.float32)
    grey = (20 + 200 * grey).astype(np.float32)
    if negative:
        grey = 240 - grey
    _dirt(grey, rng)
    depth16 = bool(rng.random() < 0.3)
    jpeg = None if depth16 or rng.random() < 0.6 else int(rng.integers(60, 96))
    pixels: NDArray[Any] = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    if depth16:
        pixels = np.clip(np.rint(grey * 200), 0, 65535).astype(np.uint16)
    calibrated = [
        p | {key: round(p[key] + rng.normal(0, 0.001), 4) for key in ("x", "y")} for p in cam.points
    ]
    content = {
        "schema": "fiducial-design/1",
        "name": kind,
        "unit": "mm",
        "marks": cam.marks,
        "points": calibrated,
    }
    truth = {
        "ids": [p["id"] for p in cam.points],
        "xy": places.tolist(),
        "rotation_deg": turn,
        "mirrored": mirrored,
        "px_per_mm": k,
        "negative": negative,
        "blur": [form, blur],
        "jpeg": jpeg,
    }
    return Photograph(pixels, content, truth, jpeg)


def _sampled(
    film: Any,
    box: tuple[int, int, int, int],
    shift: Array,
    back: Array,
    k: float,
    form: str,
    blur: float,
) -> Array:
    """Light of the pixels of a box: sampled finely, blurred, and averaged over pixels."""
    x0, y0, x1, y1 = box
    n, room = _OVER, 8
    x = np.arange((x0 - room) * n, (x1 + room) * n) / n + (1 / n - 1) / 2
    y = np.arange((y0 - room) * n, (y1 + room) * n) / n + (1 / n - 1) / 2
    gx, gy = np.meshgrid(x, y)
    at = (np.stack([gx, gy], -1) - shift) @ back.T
    light = film(at[..., 0], at[..., 1], 1 / (n * k)).astype(np.float32)
    if form == "disk":
        r = 2 * blur * n
        half = int(r) + 1
        u = np.hypot(*np.meshgrid(np.arange(-half, half + 1), np.arange(-half, half + 1)))
        kernel = np.clip(r + 0.5 - u, 0, 1)
        light = cv2.filter2D(light, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
    elif form == "halo":
        light = 0.85 * cv2.GaussianBlur(light, (0, 0), 0.8 * blur * n) + 0.15 * cv2.GaussianBlur(
            light, (0, 0), 3 * blur * n
        )
    elif form == "motion":
        light = cv2.GaussianBlur(light, (0, 0), 0.7 * blur * n)
        light = cv2.blur(light, (int(2 * blur * n) | 1, 1))
    else:
        light = cv2.GaussianBlur(light, (0, 0), blur * n)
    small = cv2.resize(light, None, fx=1 / n, fy=1 / n, interpolation=cv2.INTER_AREA)
    return np.asarray(small[room:-room, room:-room])


def _dirt(grey: NDArray[np.float32], rng: np.random.Generator) -> None:
    """Scratches and dust over the whole film."""
    size = len(grey)
    for _ in range(int(rng.integers(0, 12))):
        a = rng.integers(0, size, 2)
        b = a + rng.integers(-size // 3, size // 3, 2)
        cv2.line(grey, tuple(map(int, a)), tuple(map(int, b)), float(rng.choice([15, 240])), 1, cv2.LINE_AA)
    for _ in range(int(rng.integers(50, 500))):
        cv2.circle(
            grey,
            tuple(map(int, rng.integers(0, size, 2))),
            int(rng.integers(1, 4)),
            float(rng.choice([12, 235])),
            -1,
        )


def write(folder: Path, name: str, shot: Photograph) -> Path:
    """Write image, design and truth; return the image's path."""
    folder.mkdir(parents=True, exist_ok=True)
    if shot.jpeg is not None:
        path = folder / f"{name}.jpg"
        cv2.imwrite(str(path), shot.pixels, [cv2.IMWRITE_JPEG_QUALITY, shot.jpeg])
    else:
        path = folder / f"{name}.tif"
        cv2.imwrite(str(path), shot.pixels, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    (folder / f"{name}.design.json").write_text(json.dumps(shot.design, indent=1))
    (folder / f"{name}.truth.json").write_text(json.dumps(shot.truth))
    return path


def main() -> None:
    """Write photographs of every kind."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=2)
    parser.add_argument("--kind", choices=KINDS, action="append")
    parser.add_argument("--camera", type=Path, help="Design of a camera (fiducial-design/1).")
    given = parser.parse_args()
    design = None if given.camera is None else json.loads(given.camera.read_text("utf-8"))
    for kind in (given.kind or KINDS) if design is None else [given.camera.stem]:
        for seed in range(given.count):
            shot = photograph(kind, seed, design=design)
            print(write(given.folder, f"{kind}_{seed}", shot), file=sys.stderr)


if __name__ == "__main__":
    main()
