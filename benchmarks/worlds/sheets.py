"""Photographs of sheets of disks with coded rings and of testfields, with truth, by a camera with distortion.

Run from the checkout: ``python benchmarks/worlds/sheets.py FOLDER [--count 3] [--condition C …]`` writes
``NAME.png`` and ``NAME.truth.json`` per photograph, and the design beside them.

The print is a function of the position in its plane; every sample of the image is undistorted and projected
back to it. Positions of the truth are the images of the centres of the disks. Light is linear up to the
sensor: reflections are added, a hand hides, noise and the limit of the sensor follow, then the camera's
curve, sharpening and compression.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from worlds.pixels import Array, edge, form, interpolated, per_sample

__all__ = ["CONDITIONS", "Fisheye", "Printed", "Sheet", "View", "Wide", "coded", "pose", "views"]

_WIDTH, _HEIGHT = 960, 720
_OVERSAMPLING = 4
_ITERATIONS = 60
_AROUND = 0.14
"""Light of what is around the paper, relative to it."""


class Printed(Protocol):
    """What is printed on a plane."""

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the targets (n)."""

    @property
    def xy(self) -> Array:
        """Their places (n, 2), y up."""

    def printed(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Shares (h, w) of paper, and of ink on it, at places that follow each other closely."""

    def design(self) -> dict[str, Any]:
        """The design as a document."""


@dataclass(frozen=True, eq=False)
class Sheet:
    """Disks (n, 2) of a diameter, and rings: dark sectors (degrees from x to y) around some of them.

    Parameters
    ----------
    ids : tuple of str
        Of the disks.
    xy : ndarray (n, 2)
        Centres, on a square grid, y up.
    size, inner, outer : float
        Diameters of disks and rings.
    sectors : dict
        Lists of (start, end) by id.
    """

    ids: tuple[str, ...]
    xy: Array
    size: float
    inner: float
    outer: float
    sectors: dict[str, list[tuple[float, float]]]

    def inside(self, x: Array, y: Array) -> Array:
        """Signed distance to the nearest edge of ink, positive inside; exact near the edges."""
        step = float(np.abs(self.xy[1] - self.xy[0]).max())
        corner, count = self.xy.min(axis=0), np.rint(np.ptp(self.xy, axis=0) / step)
        # The nearest disk of the grid.
        u, v = (
            x - corner[0] - step * np.clip(np.rint((x - corner[0]) / step), 0, count[0]),
            y - corner[1] - step * np.clip(np.rint((y - corner[1]) / step), 0, count[1]),
        )
        found = self.size / 2 - np.hypot(u, v)
        for name, sectors in self.sectors.items():
            du, dv = x - self.xy[self.ids.index(name), 0], y - self.xy[self.ids.index(name), 1]
            near = np.nonzero(np.maximum(np.abs(du), np.abs(dv)) < self.outer)
            du, dv = du[near], dv[near]
            radius = np.hypot(du, dv)
            ring = np.minimum(radius - self.inner / 2, self.outer / 2 - radius)
            for start, end in sectors:
                middle, half = np.deg2rad((start + end) / 2), np.deg2rad(end - start) / 2
                angle = np.abs(
                    np.arctan2(
                        dv * np.cos(middle) - du * np.sin(middle), du * np.cos(middle) + dv * np.sin(middle)
                    )
                )
                found[near] = np.maximum(
                    found[near],
                    np.minimum(ring, radius * np.sin(np.clip(half - angle, -np.pi / 2, np.pi / 2))),
                )
        return found

    def printed(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Shares (h, w) of paper, which is everywhere, and of ink."""
        inside = self.inside(x, y)
        # From millimetres to samples, by the slope of the distance itself.
        return np.ones(x.shape), edge(inside / np.maximum(per_sample(inside), 1e-9), 1.0)

    def design(self) -> dict[str, Any]:
        """The design as a document."""
        points = [
            {"id": name, "x": x, "y": y, "sigma": None, "nominal_px": None}
            for name, (x, y) in zip(self.ids, self.xy.tolist(), strict=True)
        ]
        mark = {"shape": "disk", "size": self.size, "line_width": None}
        head = {"schema": "reseau-design/1", "name": "sheet", "unit": "mm", "mark": mark, "polarity": "dark"}
        rings = {"inner": self.inner, "outer": self.outer, "sectors": self.sectors}
        middle = {"origin": self.ids[0], "axis": self.ids[1]}
        return head | middle | {"points": points, "rings": rings}


def coded(rows: int = 9, columns: int = 11, pitch: float = 20.0, size: float = 5.0) -> Sheet:
    """A sheet with four rings of unlike sectors."""
    ids = tuple(f"{chr(65 + i)}{j + 1}" for i in range(rows) for j in range(columns))
    x, y = np.arange(columns) - (columns - 1) / 2, (rows - 1) / 2 - np.arange(rows)
    xy = pitch * np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1).reshape(-1, 2)
    sectors = {
        "B2": [(0.0, 60.0), (90.0, 150.0)],
        f"B{columns - 1}": [(30.0, 120.0), (210.0, 240.0), (270.0, 300.0)],
        f"{chr(63 + rows)}2": [(0.0, 150.0), (180.0, 240.0)],
        f"{chr(63 + rows)}{columns - 1}": [(60.0, 90.0), (120.0, 330.0)],
    }
    return Sheet(ids, xy, size, 0.48 * pitch, 0.9 * pitch, sectors)


@dataclass(frozen=True, eq=False)
class View:
    """A photograph of a sheet.

    Parameters
    ----------
    sheet : Printed
        What is photographed.
    rotation, position : ndarray (3, 3), (3,)
        From the sheet to the camera: x_c = R X + t.
    seed : int
        Of the noise and of what the condition leaves open.
    blur : float
        Standard deviation of the point-spread function, pixels.
    motion : float
        Length of the motion during the exposure, pixels.
    contrast : float
        Share of the light that ink takes.
    light : float
        Grey value of paper in the middle.
    fall : float
        Relative change of the light across the picture.
    gloss : float
        Light that a reflection adds in its middle, grey values.
    hand : bool
        Whether an object is in front of a quarter of the sheet.
    gamma : float
        Exponent of the camera's curve: grey = 255 (light / 255)^(1 / gamma).
    noise : float
        Standard deviation at the light of paper; half of the variance is that of photons.
    jpeg : int
        Quality of the compression; 0 without.
    sharpening : float
        Weight of an unsharp mask of 1 px; 0 without.
    shade : float
        Share of the light that the shadows of three bars take; their edges are soft over 1 to 8 px.
    """

    sheet: Printed
    rotation: Array
    position: Array
    seed: int = 0
    blur: float = 0.7
    motion: float = 0.0
    contrast: float = 0.85
    light: float = 215.0
    fall: float = 0.1
    gloss: float = 0.0
    hand: bool = False
    gamma: float = 1.0
    noise: float = 1.5
    jpeg: int = 0
    sharpening: float = 0.0
    shade: float = 0.0

    _focal = np.array([1050.0, 1052.0])
    _centre = np.array([482.3, 355.1])
    _lens = (-0.15, 0.06, 0.0004, -0.0003)

    @cached_property
    def truth(self) -> Array:
        """Images (n, 2) of the centres of the disks."""
        xyz = np.column_stack([self.sheet.xy, np.zeros(len(self.sheet.xy))]) @ self.rotation.T + self.position
        return np.asarray(self._distorted(xyz[:, :2] / xyz[:, 2:]) * self._focal + self._centre)

    @cached_property
    def hidden(self) -> Array:
        """Signed distance (n,) of the disks from the object in front, in pixels; negative behind it."""
        return np.asarray(-self._hand(*self.truth.T)) if self.hand else np.full(len(self.sheet.xy), np.inf)

    def picture(self) -> Array:
        """Grey values (h, w) of 8 bits."""
        rng = np.random.default_rng(self.seed)
        angle = rng.uniform(0, np.pi)
        motion = (self.motion * np.cos(angle), self.motion * np.sin(angle))
        light = form(self._scene, _WIDTH, _HEIGHT, self.blur, 1.0, _OVERSAMPLING, motion)
        # Half of the variance is that of the photons.
        sigma = self.noise * np.sqrt(0.5 + 0.5 * np.maximum(light, 0) / self.light)
        grey = np.clip(light + rng.normal(0, 1, light.shape) * sigma, 0, 255)
        if self.gamma != 1:
            grey = 255 * (grey / 255) ** (1 / self.gamma)
        if self.sharpening:
            grey = grey + self.sharpening * (grey - cv2.GaussianBlur(grey, (0, 0), 1.0))
        pixels = np.rint(np.clip(grey, 0, 255)).astype(np.uint8)
        if self.jpeg:
            coded_file = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg])[1]
            pixels = cv2.imdecode(coded_file, cv2.IMREAD_GRAYSCALE)
        return np.asarray(pixels)

    def _scene(self, x: Array, y: Array, spacing: float) -> Array:
        """Light at positions of the image."""
        back = np.linalg.inv(np.column_stack([self.rotation[:, :2], self.position]))

        def plane(u: Array, v: Array) -> Array:
            at = self._undistorted((np.stack([u, v], axis=-1) - self._centre) / self._focal)
            return np.asarray(back @ np.column_stack([at, np.ones(len(at))]).T)

        a, b, c = interpolated(plane, x[0], y[:, 0])
        paper, ink = self.sheet.printed(a / c, b / c)
        rng = np.random.default_rng(self.seed + 1)
        to = rng.uniform(0, 2 * np.pi)
        u, v = (x - _WIDTH / 2) / _WIDTH, (y - _HEIGHT / 2) / _WIDTH
        grey = self.light * (1 + self.fall * (u * np.cos(to) + v * np.sin(to)))
        grey = grey * (_AROUND + paper * (1 - _AROUND - self.contrast * ink))
        if self.shade:
            grey = grey * self._shadows(x, y)
        if self.gloss:
            middle, wide = rng.uniform([300, 220], [660, 500]), rng.uniform(60, 120)
            grey += self.gloss * np.exp(-0.5 * ((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / wide**2)
        if self.hand:
            share = edge(self._hand(x, y), spacing)
            grey = grey * (1 - share) + share * (125 + 15 * np.sin(x / 17) * np.cos(y / 13))
        return grey

    def _shadows(self, x: Array, y: Array) -> Array:
        """Share of the light that is left behind three bars before a lamp of some size."""
        rng, lit = np.random.default_rng(self.seed + 3), np.ones(np.shape(x))
        for _ in range(3):
            angle, middle, wide, soft = rng.uniform([0, -250, 25, 1], [np.pi, 250, 60, 8])
            off = np.abs((x - _WIDTH / 2) * np.cos(angle) + (y - _HEIGHT / 2) * np.sin(angle) - middle) - wide
            lit = np.minimum(lit, 1 - self.shade * np.clip(0.5 - off / soft, 0, 1))
        return lit

    def _hand(self, x: Array, y: Array) -> Array:
        """Signed distance to the edge of the object in front, positive behind it: a union of fingers."""
        rng = np.random.default_rng(self.seed + 2)
        turn, far = rng.uniform(0, 2 * np.pi), rng.uniform(60, 130)
        found = np.full(np.shape(x), -np.inf)
        for k in range(4):
            angle = turn + 0.35 * (k - 1.5)
            tip = np.array([_WIDTH / 2, _HEIGHT / 2]) + far * np.array([np.cos(angle), np.sin(angle)])
            along = (x - tip[0]) * np.cos(angle) + (y - tip[1]) * np.sin(angle)
            across = (y - tip[1]) * np.cos(angle) - (x - tip[0]) * np.sin(angle)
            found = np.maximum(found, 45 - np.hypot(np.minimum(along, 0), across))
        return found

    def _distorted(self, at: Array) -> Array:
        k1, k2, p1, p2 = self._lens
        x, y = at[..., 0], at[..., 1]
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2 * r2
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=-1,
        )

    def _undistorted(self, at: Array) -> Array:
        found = at
        # Where a wide lens compresses the picture to the share s, an iteration leaves 1 − s of the error.
        for _ in range(_ITERATIONS):
            found = found - (self._distorted(found) - at)
        return found


class Wide(View):
    """A view through a wide lens."""

    _focal = np.array([520.0, 518.0])
    _centre = np.array([471.2, 366.4])
    _lens = (-0.24, 0.045, -0.0006, 0.0008)


class Fisheye(View):
    """A view through a fisheye: the angle from the axis, not its tangent, is proportional to the radius."""

    _focal = np.array([420.0, 419.0])
    _centre = np.array([486.8, 352.2])

    def _distorted(self, at: Array) -> Array:
        r = np.maximum(np.hypot(*np.moveaxis(at, -1, 0)), 1e-12)
        return np.asarray(at * (np.arctan(r) / r)[..., None])

    def _undistorted(self, at: Array) -> Array:
        r = np.maximum(np.hypot(*np.moveaxis(at, -1, 0)), 1e-12)
        return np.asarray(at * (np.tan(r) / r)[..., None])


def pose(seed: int, sheet: Printed, most_tilt_deg: float = 50.0, nearer: float = 1.0) -> tuple[Array, Array]:
    """Rotation and position of a sheet seen from the front; it fills most of a picture, or more if nearer."""
    rng = np.random.default_rng(1000 + seed)
    roll, rho = rng.uniform(0, 2 * np.pi, 2)
    tilt = np.deg2rad(rng.uniform(5, most_tilt_deg))
    axis = np.array([np.cos(rho), np.sin(rho), 0.0])
    turn = (
        cv2.Rodrigues(tilt * axis)[0] @ cv2.Rodrigues(np.array([0, 0, roll]))[0] @ np.diag([1.0, -1.0, -1.0])
    )
    extent = np.hypot(*np.ptp(sheet.xy, axis=0)) / 2
    away = rng.uniform(1.05, 1.4) / nearer * extent * 1050 / (_HEIGHT / 2) * np.cos(tilt / 2)
    return np.asarray(turn), np.array(
        [rng.uniform(-0.05, 0.05) * away, rng.uniform(-0.05, 0.05) * away, away]
    )


CONDITIONS: dict[str, dict[str, Any]] = {
    "clean": {},
    "defoc1.5": {"blur": 1.5},
    "defoc2.2": {"blur": 2.2},
    "motion3": {"motion": 3.0},
    "motion6": {"motion": 6.0},
    "gradient": {"fall": 0.9, "light": 150.0},
    "lowcon": {"contrast": 0.12},
    "specular": {"gloss": 150.0, "light": 190.0},
    "saturated": {"light": 251.0, "fall": 0.3},
    "overexposed": {"light": 340.0},
    "hand": {"hand": True},
    "gamma": {"gamma": 2.2},
    "jpeg60": {"jpeg": 60},
    "sharpened": {"sharpening": 1.2},
    "shadows": {"shade": 0.8},
    "cropped": {"nearer": 2.0},
    "small": {"nearer": 0.5},
}


def views(condition: str, count: int, sheet: Printed | None = None) -> list[View]:
    """Photographs of one condition, each of another pose."""
    sheet = sheet or coded()
    changed = CONDITIONS[condition]
    nearer = changed.get("nearer", 1.0)
    plain = [View(sheet, *pose(seed, sheet, nearer=nearer), seed=10 * seed) for seed in range(count)]
    return [replace(view, **{k: v for k, v in changed.items() if k != "nearer"}) for view in plain]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=3)
    parser.add_argument("--condition", nargs="*", default=list(CONDITIONS))
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    (arguments.folder / "sheet.design.json").write_text(json.dumps(coded().design()))
    for condition in arguments.condition:
        for number, view in enumerate(views(condition, arguments.count)):
            name = f"{condition}_{number}"
            cv2.imwrite(str(arguments.folder / f"{name}.png"), view.picture())
            truth = {"ids": view.sheet.ids, "xy": view.truth.round(4).tolist()}
            truth |= {"clear_px": [min(d, 1e6) for d in view.hidden.tolist()]}
            (arguments.folder / f"{name}.truth.json").write_text(json.dumps(truth))
            print(name, flush=True)


if __name__ == "__main__":
    main()
