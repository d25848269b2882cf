"""PHOTO I, II and III of an oscilloscope behind a reseau whose wires are parallel to nothing, with truth.

Run from the checkout: ``python benchmarks/worlds/oscilloscope.py FOLDER [--count 3] [--first 0]`` writes per
set ``NAME.photo1|2|3.png``, ``NAME.reseau.design.json``, ``NAME.object.design.json``, ``NAME.truth.json``;
``--check`` compares the photographs with ones sampled more finely, without softened edges.

Systems, all in mm with y up but for pixels: the *common* one of the reseau has its origin in the mark O and
its x-axis through the mark S; a photograph is referred to it by a similarity that maps its O and S there.
Equations (5a, b) with coefficients A lead from the photograph to the reseau, which lies on the screen;
equations (7a, b) with coefficients B from the screen to the test object. The design of the reseau is in
coordinates of a comparator, shifted and turned against the common system. Wires are straight on the reseau,
each with an offset and a slope of its own. An echo is a curved line on the screen: bright evenly along, a
Gaussian across, with soft ends, and hidden by wires. Its position is that of its ridge in the middle.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.special import ndtr

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from worlds.pixels import Array, Scene, edge, form_at, interpolated

__all__ = ["A_NAMES", "B_NAMES", "Difficulty", "Echoes", "Photo", "World", "write"]

A_NAMES = ("a0", "b0", "b1", "b2", "c1", "a2", "c2", "d1", "d2", "k", "h1", "h2", "a1")
B_NAMES = tuple(f"{axis}{i}" for axis in "AB" for i in range(8))
Soft = Callable[[Array], Array]
_SCREEN = (51.0, 41.0)
"""Half the width and the height of the screen, mm."""
_SOFT = 0.6
"""Standard deviation over which edges are softened before the rest of the blur is applied, pixels."""
_ENDS = 8.5
"""Standard deviations beyond which a softened edge is 0 or 1 in double precision."""
_PER_PIXEL = 2
"""Samples per pixel and axis: with edges softened by 0.6 px, 8e-4 of their contrast is aliased at most."""


@dataclass(frozen=True)
class Difficulty:
    """How a world is photographed.

    Parameters
    ----------
    scale : float
        Pixels per mm of the reseau.
    rotation_deg : float
        Of the reseau in PHOTO I.
    psf : float
        Standard deviation of the point-spread function, pixels.
    noise : float
        Standard deviation of the noise, grey levels.
    linear, quadratic : float
        Of the illumination.
    bright_wires : bool
        Wires brighter than the screen.
    columns, rows : int
        Wires of the reseau.
    missing_wires, missing_rods : int
        In the designs, but not in the photographs.
    echo : float
        Brightness of an echo above the screen, grey levels.
    nominal : bool
        Whether the design of the reseau has approximate positions.
    still : bool
        Whether all photographs are taken from the same place.
    plain_display : bool
        Whether group B has no terms A2…A5, B3…B5.
    """

    scale: float = 9.6
    rotation_deg: float = -0.6
    psf: float = 0.9
    noise: float = 2.0
    linear: float = 0.08
    quadratic: float = 0.08
    bright_wires: bool = False
    columns: int = 11
    rows: int = 9
    missing_wires: int = 0
    missing_rods: int = 0
    echo: float = 115.0
    nominal: bool = True
    still: bool = False
    plain_display: bool = False

    @classmethod
    def drawn_from(cls, rng: np.random.Generator) -> Difficulty:
        """Draw one at random; one in two is easy but for its rotation."""
        hard = bool(rng.random() < 0.5)
        columns = int(rng.choice([11, 13]))
        return cls(
            scale=float(rng.uniform(9.2, 10.4)),
            rotation_deg=float(rng.uniform(-9, 9)),
            psf=float(rng.uniform(0.75, 1.3) if hard else 0.9),
            noise=float(rng.uniform(1, 4) if hard else 2.0),
            linear=float(rng.uniform(0.05, 0.45) if hard else 0.08),
            quadratic=float(rng.uniform(0.05, 0.25) if hard else 0.08),
            bright_wires=bool(rng.random() < 0.25),
            columns=columns,
            rows=9 if columns == 13 else int(rng.choice([9, 11])),
            missing_wires=int(hard and rng.random() < 0.5),
            missing_rods=int(rng.integers(1, 7)) if hard and rng.random() < 0.5 else 0,
            echo=float(rng.uniform(50, 130) if hard else 115.0),
            nominal=bool(rng.random() < 0.5),
            still=bool(rng.random() < 0.15),
            plain_display=bool(rng.random() < 0.15),
        )


@dataclass(frozen=True, eq=False)
class Echoes:
    """Echoes on the screen: middle of the ridge (n, 2), length, curvature, width, end and brightness (n,).

    Lengths in mm on the screen; `end` is the standard deviation over which the light ends.
    """

    at: Array
    length: Array
    curvature: Array
    sigma: Array
    end: Array
    bright: Array

    def light(self, which: int, x: Array, y: Array) -> Array:
        """Brightness at points of the screen."""
        u, v = x - self.at[which, 0], y - self.at[which, 1]
        away = v + self.curvature[which] / 2 * u * u
        half, soft = self.length[which] / 2, self.end[which]
        along = ndtr((half - u) / soft) - ndtr((-half - u) / soft)
        return np.asarray(self.bright[which] * along * np.exp(-0.5 * np.square(away / self.sigma[which])))

    @classmethod
    def drawn_from(cls, at: Array, bright: float, rng: np.random.Generator) -> Echoes:
        """Shapes at random for echoes at given places."""
        n = len(at)
        length, rise = rng.uniform(2, 5, n), rng.uniform(0.05, 0.4, n)
        return cls(
            at,
            length,
            8 * rise / length**2,
            rng.uniform(0.12, 0.22, n),
            rng.uniform(0.12, 0.25, n),
            bright * rng.uniform(0.9, 1.1, n),
        )


@dataclass(frozen=True, eq=False)
class Photo:
    """How one photograph is taken: images of O and S, and its grey levels."""

    o: Array
    s: Array
    screen: float
    wire: float
    dark: float


@dataclass(frozen=True, eq=False)
class World:
    """A reseau, a display, a test object, a body, and three photographs of them.

    Parameters
    ----------
    seed : int
        Of everything.
    difficulty : Difficulty
        How it is photographed.
    distance, wire : float
        From O to S, and width of the wires, mm.
    ids : tuple of str (n,)
        Of the marks.
    marks : ndarray (n, 2)
        Common coordinates of the marks.
    normal, offset : ndarray (w, 2), (w,)
        Of the wires in the common system, those across x first.
    there : ndarray (w,) of bool
        Wires in the photographs.
    origin, axis : str
        The marks O and S.
    a, b : dict
        Coefficients of equations (5a, b) and (7a, b).
    rods, rods_there : ndarray (r, 2), (r,)
        Of the test object, and which are in PHOTO II.
    photos : tuple of Photo
        The three photographs.
    size : (int, int)
        Width and height of the photographs.
    pins, body : Echoes
        Of PHOTO II and PHOTO III, on the screen.
    """

    seed: int
    difficulty: Difficulty
    distance: float
    wire: float
    ids: tuple[str, ...]
    marks: Array
    normal: Array
    offset: Array
    there: Array
    origin: str
    axis: str
    a: dict[str, float]
    b: dict[str, float]
    rods: Array
    rods_there: Array
    photos: tuple[Photo, Photo, Photo]
    size: tuple[int, int]
    pins: Echoes
    body: Echoes

    @classmethod
    def drawn_from(cls, seed: int, difficulty: Difficulty | None = None) -> World:
        """Draw a world at random."""
        rng = np.random.default_rng((seed, 11))
        d = Difficulty.drawn_from(rng) if difficulty is None else difficulty
        ids, marks, normal, offset, origin, axis = _reseau(d, rng)
        distance = float(marks[ids.index(axis), 0])
        there = np.ones(len(normal), dtype=bool)
        row = ids.index(origin) // d.columns
        defining = {ids.index(origin) % d.columns, d.columns - 1, d.columns + row}
        free = [w for w in range(len(normal)) if w not in defining]
        there[rng.choice(free, d.missing_wires, replace=False)] = False
        a = _group_a(distance, rng)
        b = _group_b(d.plain_display, rng)
        rods = _rods()
        rods_there = np.ones(len(rods), dtype=bool)
        rods_there[rng.choice(np.arange(7, len(rods)), d.missing_rods, replace=False)] = False
        photos, size = _photos(d, distance, rng)
        pins = Echoes.drawn_from(_on_screen(b, rods), d.echo, rng)
        body = Echoes.drawn_from(_apart(30, rng), d.echo, rng)
        return cls(
            seed=seed,
            difficulty=d,
            distance=distance,
            wire=float(rng.choice([0.45, 0.5])),
            ids=ids,
            marks=marks,
            normal=normal,
            offset=offset,
            there=there,
            origin=origin,
            axis=axis,
            a=a,
            b=b,
            rods=rods,
            rods_there=rods_there,
            photos=photos,
            size=size,
            pins=pins,
            body=body,
        )

    @property
    def visible(self) -> Array:
        """Marks whose two wires are there, (n,) of bool."""
        c = self.difficulty.columns
        i = np.arange(len(self.ids))
        return np.asarray(self.there[i % c] & self.there[c + i // c])

    def to_screen(self, photo: Photo, x: Array, y: Array) -> tuple[Array, Array]:
        """Pixels on the reseau, which lies on the screen: into the common system, then equations (5a, b)."""
        across, down = photo.s - photo.o
        turn = self.distance / (across**2 + down**2)
        u, v = x - photo.o[0], y - photo.o[1]
        return equations_5(self.a, turn * (across * u + down * v), turn * (down * u - across * v))

    def to_pixels(self, photo: Photo, xy: Array) -> Array:
        """Points of the screen (n, 2) in a photograph, by Newton's method."""
        across, down = photo.s - photo.o
        start = np.stack(
            [
                photo.o[0] + (across * xy[:, 0] + down * xy[:, 1]) / self.distance,
                photo.o[1] + (down * xy[:, 0] - across * xy[:, 1]) / self.distance,
            ],
            axis=-1,
        )
        return _inverse(lambda p: np.stack(self.to_screen(photo, *p.T), axis=-1), xy, start)

    def on_screen(self, photo: Photo, x: Array, y: Array) -> Array:
        """The screen (2, h, w) seen by the grid of columns x (w,) and rows y (h,) of a photograph."""
        return interpolated(lambda u, v: np.stack(self.to_screen(photo, u, v)), x, y)

    def clear(self, x: Array, y: Array, soft: Soft, reach: float) -> tuple[Array, Array]:
        """Share of the light of points of the screen that passes the wires, and share on the screen.

        Parameters
        ----------
        x, y : ndarray
            The points.
        soft : callable
            From the signed distance to an edge, mm, to the share inside.
        reach : float
            Distance from an edge, mm, up to which that share is neither 0 nor 1.
        """

        def share(inside: Array) -> Array:
            found, near = (inside > 0).astype(np.float64), np.abs(inside) <= reach
            found[near] = soft(inside[near])
            return found

        half, c = self.wire / 2, self.difficulty.columns
        clear = np.ones_like(x)
        for own, across, along, some in ((0, x, y, slice(None, c)), (1, y, x, slice(c, None))):
            keep = self.there[some]
            n, o = self.normal[some][keep], self.offset[some][keep]
            at = o / n[:, own]
            order = np.argsort(at)
            n, o, at = n[order], o[order], at[order]
            nearest = np.searchsorted((at[1:] + at[:-1]) / 2, across)
            away = np.abs(n[nearest, own] * across + n[nearest, 1 - own] * along - o[nearest])
            clear *= 1.0 - share(half - away)
        return clear, share(_SCREEN[0] - np.abs(x)) * share(_SCREEN[1] - np.abs(y))

    def image(self, which: int) -> Array:
        """A photograph (height, width) without noise; 0, 1, 2 for PHOTO I, II, III.

        The reseau with softened edges, which the rest of the blur completes: exact where edges are straight
        and at right angles. Echoes are sampled finely.
        """
        d, photo, n = self.difficulty, self.photos[which], _PER_PIXEL
        margin = int(np.ceil(6 * d.psf + 2))
        width, height = self.size
        px, py = (np.arange((size + 2 * margin) * n) / n - margin for size in (width, height))
        unit = d.scale / _SOFT
        clear, inside = self.clear(
            *self.on_screen(photo, px, py), lambda away: np.asarray(ndtr(away * unit)), _ENDS / unit
        )
        clear *= photo.screen - photo.wire
        clear += photo.wire - photo.dark
        clear *= inside
        clear += photo.dark
        fx, fy = np.fft.rfftfreq(len(px), 1 / n), np.fft.fftfreq(len(py), 1 / n)[:, None]
        left = d.psf**2 - _SOFT**2
        by_x, by_y = (np.exp(-2 * np.pi**2 * left * f**2) * np.sinc(f) for f in (fx, fy))
        spectrum = scipy.fft.rfft2(clear)
        spectrum *= by_y
        spectrum *= by_x
        inner = slice(margin * n, -margin * n, n)
        image = scipy.fft.irfft2(spectrum, clear.shape)[inner, inner].copy()
        echoes = self.echoes(which)
        if echoes is None:
            return np.asarray(image * self.illumination())
        for k, at in enumerate(self.to_pixels(photo, echoes.at)):
            along, across = echoes.length[k] / 2 + 4 * echoes.end[k], 0.5 + 5 * echoes.sigma[k]
            reach = np.array([along, across + 0.2 * along]) * d.scale + 5 * d.psf
            left_top = np.maximum(np.floor(at - reach), 0).astype(int)
            right_low = np.minimum(np.ceil(at + reach) + 1, self.size).astype(int)
            size = right_low - left_top
            if (size > 0).all():
                first = (int(left_top[0]), int(left_top[1]))
                part = np.s_[first[1] : right_low[1], first[0] : right_low[0]]
                image[part] += form_at(
                    self.of_echo(photo, echoes, k), first, (int(size[0]), int(size[1])), d.psf, 1.0, 6
                )[0]
        return np.asarray(image * self.illumination())

    def of_echo(self, photo: Photo, echoes: Echoes, which: int) -> Scene:
        """The light of an echo that passes the wires."""

        def scene(px: Array, py: Array, spacing: float) -> Array:
            x, y = self.on_screen(photo, px[0], py[:, 0])
            scale = self.difficulty.scale
            clear, inside = self.clear(x, y, lambda away: edge(away * scale, spacing), spacing / scale)
            return echoes.light(which, x, y) * clear * inside

        return scene

    def illumination(self) -> Array:
        """The factor of each pixel, (height, width)."""
        d, (width, height) = self.difficulty, self.size
        u, v = np.meshgrid((np.arange(width) - width / 2) / width, (np.arange(height) - height / 2) / width)
        return np.asarray(1 + d.linear * (0.8 * u - 0.6 * v) - 4 * d.quadratic * (u**2 + v**2))

    def echoes(self, which: int) -> Echoes | None:
        """Those of a photograph that are there."""
        if which == 0:
            return None
        if which == 2:
            return self.body
        keep = self.rods_there
        return Echoes(*(getattr(self.pins, field.name)[keep] for field in fields(Echoes)))


def equations_5(a: dict[str, float], x: Array, y: Array) -> tuple[Array, Array]:
    """Photo-coordinates of the common system on the reseau, Wishahy's equations (5a, b)."""
    below = 1 / (1 + a["a0"] * x + a["b0"] * y)
    x2, y2, xy = x * x, y * y, x * y  # powers by multiplication: ten times faster
    radial = a["k"] * (x2 + y2)
    return (
        (a["a1"] * x + a["b1"] * y + a["c1"]) * below + a["d1"] * xy + x * radial + a["h1"] * x2 * x2,
        (a["a2"] * x + a["b2"] * y + a["c2"]) * below + a["d2"] * xy + y * radial + a["h2"] * y2 * y2,
    )


def equations_7(b: dict[str, float], x: Array, y: Array) -> tuple[Array, Array]:
    """The screen on the test object, Wishahy's equations (7a, b)."""
    square = x**2 + y**2
    found = [
        b[f"{n}0"]
        + b[f"{n}1"] * p
        + b[f"{n}2"] * q
        + b[f"{n}3"] * x * y
        + b[f"{n}4"] * p**2
        + b[f"{n}5"] * q**2
        + b[f"{n}6"] * p * square
        + b[f"{n}7"] * square**2
        for n, p, q in (("A", x, y), ("B", y, x))
    ]
    return found[0], found[1]


def _inverse(mapping: Callable[[Array], Array], goal: Array, start: Array) -> Array:
    """Points (n, 2) that a mapping of points maps to `goal`, by Newton's method with differences."""
    at, step = start.copy(), 1e-4
    for _ in range(20):
        off = goal - mapping(at)
        slope = np.stack(
            [(mapping(at + step * e) - mapping(at - step * e)) / (2 * step) for e in np.eye(2)], axis=-1
        )
        at += np.linalg.solve(slope, off[..., None])[..., 0]
    if np.abs(goal - mapping(at)).max() > 1e-9:
        raise ArithmeticError("the mapping has no inverse there")
    return at


def _reseau(d: Difficulty, rng: np.random.Generator) -> tuple[tuple[str, ...], Array, Array, Array, str, str]:
    """Names and common coordinates of the marks, the wires, and the names of O and S."""
    lines = []
    lean = rng.normal(0, 0.002, 2)
    for count, extent, own in ((d.columns, 46.8, 0), (d.rows, 37.0, 1)):
        for place in np.linspace(-extent, extent, count):
            slope = lean[own] + rng.normal(0, 0.003)
            normal = np.array([1.0, -slope]) if own == 0 else np.array([-slope, 1.0])
            lines.append((*normal / np.hypot(*normal), (place + rng.normal(0, 0.08)) / np.hypot(*normal)))
    wires = np.array(lines)
    crossings = np.array(
        [
            np.linalg.solve(wires[[i, d.columns + j], :2], wires[[i, d.columns + j], 2])
            for j in range(d.rows)
            for i in range(d.columns)
        ]
    )
    ids = tuple(f"{chr(ord('A') + j)}{i + 1}" for j in range(d.rows) for i in range(d.columns))
    row, column = d.rows // 2, d.columns // 2
    origin, axis = f"{chr(ord('A') + row)}{column + 1}", f"{chr(ord('A') + row)}{d.columns}"
    o, s = crossings[ids.index(origin)], crossings[ids.index(axis)]
    along = (s - o) / np.hypot(*(s - o))
    turn = np.array([along, [-along[1], along[0]]])
    offset = wires[:, 2] - wires[:, :2] @ o
    return ids, (crossings - o) @ turn.T, wires[:, :2] @ turn.T, offset, origin, axis


def _group_a(distance: float, rng: np.random.Generator) -> dict[str, float]:
    """Coefficients of camera and film; a1, a2, c1, c2 follow from the definition of the common system."""
    a = {
        "a0": rng.normal(0, 6e-5),
        "b0": rng.normal(0, 6e-5),
        "b1": rng.normal(0, 1.1e-3),
        "b2": 1 + rng.normal(0, 1.7e-3),
        "c1": 0.0,
        "a2": 0.0,
        "c2": 0.0,
        "d1": rng.normal(0, 1.1e-5),
        "d2": rng.normal(0, 1.1e-5),
        "k": rng.normal(0, 1.5e-6),
        "h1": rng.normal(0, 7e-9),
        "h2": rng.normal(0, 1.2e-8),
    }
    a["a1"] = (1 - a["k"] * distance**2 - a["h1"] * distance**3) * (1 + a["a0"] * distance)
    return {name: float(a[name]) for name in A_NAMES}


def _group_b(plain: bool, rng: np.random.Generator) -> dict[str, float]:
    """Coefficients of the instrument."""
    sizes = {0: 0.7, 1: 0.015, 2: 6e-3, 3: 7e-5, 4: 9e-5, 5: 7e-5, 6: 1e-6, 7: 2e-8}
    middle = {"A0": 47.5, "B0": 37.7, "A1": 1.18, "B1": 1.18, "A6": -2.8e-6, "B6": -2.8e-6}
    b = {name: middle.get(name, 0.0) + float(rng.normal(0, sizes[int(name[1])])) for name in B_NAMES}
    for name in ("A2", "A3", "A4", "A5", "B3", "B4", "B5") if plain else ():
        b[name] = 0.0
    return b


def _rods() -> Array:
    """The test object: six rows at 15 mm, every other one shifted by 4 mm, and five rods between."""
    rows = [(x + 4 * (r % 2), 15.0 * r) for r in range(6) for x in range(0, 91, 15)]
    return np.array([*rows, (41, 7), (56, 22.5), (26, 22.5), (71, 52.5), (11, 52.5)], dtype=np.float64)


def _on_screen(b: dict[str, float], rods: Array) -> Array:
    """Where the rods appear on the screen, (n, 2)."""
    start = (rods - [b["A0"], b["B0"]]) / [b["A1"], b["B1"]]
    return _inverse(lambda p: np.stack(equations_7(b, *p.T), axis=-1), rods, start)


def _apart(count: int, rng: np.random.Generator) -> Array:
    """Places on the screen whose echoes do not touch."""
    found: list[Array] = []
    while len(found) < count:
        at = rng.uniform([-44, -34], [44, 34])
        if all(abs(at[0] - p[0]) > 6.5 or abs(at[1] - p[1]) > 2.5 for p in found):
            found.append(at)
    return np.array(found)


def _photos(
    d: Difficulty, distance: float, rng: np.random.Generator
) -> tuple[tuple[Photo, Photo, Photo], tuple[int, int]]:
    """How the photographs are taken, and their size: the screen with a margin of 3.5 mm."""
    turn = abs(np.deg2rad(d.rotation_deg))
    half = d.scale * (np.array([[np.cos(turn), np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ _SCREEN + 3.5)
    size = (2 * int(half[0]), 2 * int(half[1]))
    middle, photos = np.array(size) / 2 + rng.uniform(-1, 1, 2), []
    for which in range(3):
        moved = which > 0 and not d.still
        angle = np.deg2rad(d.rotation_deg + moved * rng.uniform(-0.5, 0.5))
        scale = d.scale * (1 + moved * rng.uniform(-0.003, 0.003))
        shift = rng.normal(0, 2, 2) * moved
        screen, wire = ((45.0, 150.0), (22.0, 120.0)) if d.bright_wires else ((175.0, 45.0), (70.0, 22.0))
        o = middle + shift
        s = o + distance * scale * np.array([np.cos(angle), np.sin(angle)])
        photos.append(Photo(o, s, *((screen, wire)[which > 0]), dark=18.0 if which == 0 else 12.0))
    return (photos[0], photos[1], photos[2]), size


def _noisy(image: Array, noise: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """An image of 8 bits."""
    return np.asarray(np.clip(np.rint(image + rng.normal(0, noise, image.shape)), 0, 255), dtype=np.uint8)


def _hidden(world: World, echoes: Echoes) -> list[float]:
    """Share of the light of each echo behind wires."""
    found = []
    for k, at in enumerate(echoes.at):
        reach = np.array([echoes.length[k] / 2 + 4 * echoes.end[k], 1.5])
        x, y = np.meshgrid(
            *(np.linspace(c - r, c + r, n) for c, r, n in zip(at, reach, (300, 200), strict=True))
        )
        light = echoes.light(k, x, y)
        clear, inside = world.clear(x, y, lambda away: (away > 0).astype(np.float64), 0.0)
        found.append(round(float(1 - (light * clear * inside).sum() / light.sum()), 4))
    return found


def _shapes(world: World, photo: Photo, echoes: Echoes) -> dict[str, Any]:
    """Truth of echoes."""
    px, obj = world.to_pixels(photo, echoes.at), np.stack(equations_7(world.b, *echoes.at.T), axis=-1)
    columns = {
        "x": px[:, 0],
        "y": px[:, 1],
        "screen_x_mm": echoes.at[:, 0],
        "screen_y_mm": echoes.at[:, 1],
        "object_X_mm": obj[:, 0],
        "object_Y_mm": obj[:, 1],
        "length_mm": echoes.length,
        "curvature_per_mm": echoes.curvature,
        "sigma_mm": echoes.sigma,
        "end_mm": echoes.end,
        "bright": echoes.bright,
    }
    return {name: np.round(values, 9).tolist() for name, values in columns.items()} | {
        "hidden": _hidden(world, echoes)
    }


def truth_of(world: World, name: str) -> dict[str, Any]:
    """The truth as in the file."""
    photos = {}
    for which, (label, photo) in enumerate(zip(("I", "II", "III"), world.photos, strict=True)):
        px = world.to_pixels(photo, world.marks)
        photos[label] = {
            "image": f"{name}.photo{which + 1}.png",
            "O_px": photo.o.tolist(),
            "S_px": photo.s.tolist(),
            "psf_sigma_px": world.difficulty.psf,
            "noise_sigma": world.difficulty.noise,
            "levels": {"screen": photo.screen, "wire": photo.wire, "dark": photo.dark},
            "crossings": {"x": px[:, 0].tolist(), "y": px[:, 1].tolist()},
        }
    _, two, three = world.photos
    photos["II"]["pins"] = {"id": _rod_ids(world), "visible": world.rods_there.tolist()} | _shapes(
        world, two, world.pins
    )
    ids = [f"C{i + 1}" for i in range(len(world.body.at))]
    photos["III"]["check"] = {"id": ids, "visible": [True] * len(ids)} | _shapes(world, three, world.body)
    d = world.difficulty
    return {
        "schema": "worlds-oscilloscope/1",
        "set": name,
        "seed": world.seed,
        "difficulty": {field.name: getattr(d, field.name) for field in fields(d)},
        "O": world.origin,
        "S": world.axis,
        "D_mm": world.distance,
        "wire_mm": world.wire,
        "reseau": {
            "id": list(world.ids),
            "X": world.marks[:, 0].tolist(),
            "Y": world.marks[:, 1].tolist(),
            "visible": world.visible.tolist(),
        },
        "A": world.a,
        "B": world.b,
        "photos": photos,
    }


def _rod_ids(world: World) -> list[str]:
    """Names of the rods; M and N are the ends of the first row."""
    return [{0: "M", 6: "N"}.get(i, str(i + 1)) for i in range(len(world.rods))]


def designs_of(world: World, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Designs of the reseau, in coordinates of a comparator, and of the test object."""
    rng = np.random.default_rng((world.seed, 12))
    angle, shift = np.deg2rad(rng.uniform(-2, 2)), rng.uniform(-60, 60, 2)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    comparator = world.marks @ turn.T + shift
    one, two, _ = world.photos
    nominal = (
        world.to_pixels(one, world.marks) + rng.uniform(-10, 10, 2) + rng.normal(0, 1.7, comparator.shape)
    )
    pins = world.to_pixels(two, world.pins.at) + np.clip(rng.normal(0, 3.6, world.rods.shape), -12, 12)
    bright = world.difficulty.bright_wires

    def points(ids: Any, xy: Array, at: Array | None) -> list[dict[str, Any]]:
        known: list[dict[str, Any]] = [
            {"id": i, "x": round(float(x), 6), "y": round(float(y), 6)}
            for i, (x, y) in zip(ids, xy, strict=True)
        ]
        if at is not None:
            for point, px in zip(known, np.round(at, 1).tolist(), strict=True):
                point["nominal_px"] = px
        return known

    head = {"schema": "reseau-design/1", "name": name, "unit": "mm"}
    reseau = head | {
        "mark": {"shape": "line-grid", "size": world.wire, "line_width": world.wire},
        "polarity": "bright" if bright else "dark",
        "origin": world.origin,
        "axis": world.axis,
        "points": points(world.ids, comparator, nominal if world.difficulty.nominal else None),
    }
    rods = head | {
        "mark": {"shape": "rod", "size": 0.75, "line_width": None},
        "polarity": "bright",
        "origin": "M",
        "axis": "N",
        "points": points(_rod_ids(world), world.rods, pins),
    }
    return reseau, rods


def write(folder: Path, name: str, world: World) -> None:
    """Write the photographs, designs and truth of a world."""
    folder.mkdir(parents=True, exist_ok=True)
    for which in range(3):
        rng = np.random.default_rng((world.seed, 20 + which))
        pixels = _noisy(world.image(which), world.difficulty.noise, rng)
        if not cv2.imwrite(str(folder / f"{name}.photo{which + 1}.png"), pixels):
            raise OSError(f"{folder / name}.photo{which + 1}.png cannot be written")
    reseau, rods = designs_of(world, name)
    for label, content in (
        ("reseau.design", reseau),
        ("object.design", rods),
        ("truth", truth_of(world, name)),
    ):
        (folder / f"{name}.{label}.json").write_text(json.dumps(content))


def check() -> None:
    """Compare photographs around marks and echoes with ones sampled more finely, without softened edges."""
    print("photographs against 16 samples per pixel: largest displacement / px, largest difference / %")
    world = World.drawn_from(1)
    for which, at in (
        (0, world.marks[world.visible]),
        (1, world.pins.at[world.rods_there]),
        (2, world.body.at),
    ):
        photo, image, echoes = world.photos[which], world.image(which), world.echoes(which)

        def whole(px: Array, py: Array, spacing: float, photo: Photo = photo, echoes: Any = echoes) -> Array:
            x, y = world.to_screen(photo, px, py)
            scale = world.difficulty.scale
            clear, inside = world.clear(x, y, lambda away: edge(away * scale, spacing), spacing / scale)
            light = photo.dark + (photo.wire + (photo.screen - photo.wire) * clear - photo.dark) * inside
            for k in range(0 if echoes is None else len(echoes.at)):
                if np.abs(echoes.at[k] - [x.mean(), y.mean()]).max() < 9:
                    light += echoes.light(k, x, y) * clear * inside
            return light

        moved, off = [], []
        half = 16 if which else 9
        for px in world.to_pixels(photo, at)[::4]:
            x0, y0 = (round(float(c)) - half for c in px)
            fine = form_at(whole, (x0, y0), (2 * half + 1,) * 2, world.difficulty.psf, 1.0, 16)[0]
            part = np.s_[y0 : y0 + 2 * half + 1, x0 : x0 + 2 * half + 1]
            fine, coarse = fine * world.illumination()[part], image[part]
            gy, gx = np.gradient(fine)
            a = np.stack([-gx.ravel(), -gy.ravel(), np.ones(gx.size)], axis=-1)
            moved.append(np.linalg.lstsq(a, (coarse - fine).ravel(), rcond=None)[0][:2])
            off.append(np.abs(coarse - fine).max() / np.ptp(fine))
        print(f"  PHOTO {'I' * (which + 1):<4} {np.abs(moved).max():.5f} {100 * max(off):.3f}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help="folder to write to")
    parser.add_argument("--count", type=int, default=3, help="worlds")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--check", action="store_true", help="compare with finer sampling")
    given = parser.parse_args()
    if given.check:
        check()
    for seed in range(given.first, given.first + given.count if given.folder is not None else given.first):
        begun = time.perf_counter()
        write(given.folder, f"world{seed:03d}", World.drawn_from(seed))
        print(f"world{seed:03d} {time.perf_counter() - begun:.1f} s", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
