"""Screens with real echoes behind a reseau: reverberations, tails, speckle, graphics, film; with truth.

A second program beside `worlds.oscilloscope`, with nothing of it: everything is sampled on one fine grid, no
edge is softened. Run from the checkout: ``python benchmarks/worlds/echo_screens.py FOLDER [--count 3]
[--first 0] [--kind speckle]``. Files and truth are those that `refined` reads.

Systems: a photograph is referred by a similarity to the common one of the marks O and S; Wishahy's (5a, b)
lead from it to the reseau on the screen, (7a, b) from there to the object, all in mm with y up.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["KINDS", "Screen", "write_screen"]

Array = NDArray[np.float64]
KINDS = (
    "plain", "bowed", "coarse", "dense", "reverberation", "tail", "flat", "stacked", "speckle", "graphics",
    "gamma", "hum", "vignetting", "jpeg", "colour", "polaroid", "portrait",
)  # fmt: skip
"""What a world shows beside sound echoes; `stacked`: real points behind others, weaker, at equal spacings."""
FINE = 3
"""Samples per pixel along each axis."""
HALF = np.array([51.0, 41.0])
"""Half the size of the screen, mm."""


@dataclass(eq=False)
class Screen:
    """One world; everything follows from its seed.

    Parameters
    ----------
    seed : int
        Of the world.
    kind : str
        One of `KINDS`; by default the one of the seed.
    """

    seed: int
    kind: str = ""

    def __post_init__(self) -> None:
        self.kind = self.kind or KINDS[self.seed % len(KINDS)]
        self.rng = rng = np.random.default_rng([self.seed, 5151])
        self._reseau(rng)
        self.distance = float(self.marks[self.ids.index(self.axis), 0])
        k, h = rng.normal(0, 1.3e-6), rng.normal(0, 7e-9)
        a0 = rng.normal(0, 5e-5)
        self.a = {
            "a0": a0, "b0": rng.normal(0, 5e-5), "b1": rng.normal(0, 1e-3), "b2": 1 + rng.normal(0, 2e-3),
            "c1": 0.0, "a2": 0.0, "c2": 0.0, "d1": rng.normal(0, 1e-5), "d2": rng.normal(0, 1e-5), "k": k,
            "h1": h, "h2": rng.normal(0, 1e-8),
            "a1": (1 - k * self.distance**2 - h * self.distance**3) * (1 + a0 * self.distance),
        }  # fmt: skip
        spread = (0.6, 0.012, 5e-3, 6e-5, 8e-5, 6e-5, 1e-6, 1.5e-8)
        self.b = {f"{n}{i}": rng.normal(0, spread[i]) for n in "AB" for i in range(8)}
        for name, value in {"A0": 47.0, "B0": 37.0, "A1": 1.17, "B1": 1.17, "A6": -2e-6, "B6": -2e-6}.items():
            self.b[name] += value
        rods = [(x + 4 * (r % 2), 15.0 * r) for r in range(6) for x in range(0, 91, 15)]
        self.rods = np.array([*rods, (41, 7), (56, 22.5), (26, 22.5), (71, 52.5), (11, 52.5)], dtype=float)
        self.scale = rng.uniform(9.0, 10.5)
        self.psf, self.noise = rng.uniform(0.7, 1.2), rng.uniform(1.0, 3.0)
        self.bright = rng.uniform(70, 130)
        self.repeats = 0.0, 0.0
        if self.kind == "reverberation":
            self.repeats = rng.uniform(0.5, 4.0), rng.uniform(0.1, 0.6)
        self.tail = rng.uniform(0.15, 0.4) if self.kind == "tail" else 0.0
        turn = rng.uniform(-6, 6) + (rng.choice([-90, 90]) if self.kind == "portrait" else 0)
        self.turns = np.deg2rad(turn + np.array([0, *rng.uniform(-0.5, 0.5, 2)]))
        self.pins = self._shapes(_solved(self.object, self.rods, (self.rods - [47, 37]) / 1.17), rng)
        self.body = self._shapes(self._points(rng), rng)
        if self.kind == "stacked":  # every third point has another one behind it
            first = np.arange(0, len(self.body["x"]), 3)
            for name, values in self.body.items():
                self.body[name] = np.concatenate([values, values[first]])
            self.body["y"][-len(first) :] -= 3.1
            self.body["light"][-len(first) :] *= 0.5

    def _reseau(self, rng: np.random.Generator) -> None:
        """Wires x = o + s y + b (1 − (y/h)²), and y likewise; their crossings; O and S."""
        counts = {"coarse": (7, 6), "dense": (15, 12)}.get(self.kind, (11, 9))
        self.width = {"coarse": 0.6, "dense": 0.35}.get(self.kind, rng.uniform(0.4, 0.5))
        bow = 0.15 if self.kind in ("bowed", "dense") else 0.0
        self.wires = [
            np.stack(
                [
                    np.linspace(-e, e, n) + rng.normal(0, 0.07, n),
                    rng.normal(0, 0.003, n),
                    bow * rng.uniform(-1, 1, n),
                ],
                axis=1,
            )
            for n, e in zip(counts, (46.8, 37.0), strict=True)
        ]
        i, j = (index.ravel() for index in np.meshgrid(np.arange(counts[0]), np.arange(counts[1])))
        x, y = self.wires[0][i, 0], self.wires[1][j, 0]
        for _ in range(30):
            x, y = _course(self.wires[0][i], y, 37.0), _course(self.wires[1][j], x, 46.8)
        self.ids = [f"{chr(65 + b)}{a + 1}" for a, b in zip(i, j, strict=True)]
        row = chr(65 + counts[1] // 2)
        self.origin, self.axis = f"{row}{counts[0] // 2 + 1}", f"{row}{counts[0]}"
        raw = np.stack([x, y], axis=1)
        self.shift = raw[self.ids.index(self.origin)]
        along = raw[self.ids.index(self.axis)] - self.shift
        c, s = along / np.hypot(*along)
        self.turn = np.array([[c, -s], [s, c]])  # common = (raw − shift) · turn
        self.marks = (raw - self.shift) @ self.turn

    def _points(self, rng: np.random.Generator) -> Array:
        """Places of a body, whose echoes and reverberations do not touch."""
        below = 3.1 if self.kind == "stacked" else self.repeats[0]
        found: list[Array] = []
        while len(found) < 27:
            at = rng.uniform([-43, -31], [43, 33])
            off = [p - at for p in found]
            if all(abs(d[0]) > 6.5 or abs(d[1]) > 2.4 + below for d in off):
                found.append(at)
        return np.array(found)

    def _shapes(self, xy: Array, rng: np.random.Generator) -> dict[str, Array]:
        n = len(xy)
        length, rise = rng.uniform(2, 5, n), rng.uniform(0.05, 0.35, n)
        return {
            "x": xy[:, 0], "y": xy[:, 1], "length": length, "curvature": 8 * rise / length**2,
            "sigma": rng.uniform(0.12, 0.21, n), "end": rng.uniform(0.12, 0.24, n),
            "light": self.bright * rng.uniform(0.85, 1.15, n),
        }  # fmt: skip

    def screen(self, p: Array) -> Array:
        """Photo-coordinates (…, 2) on the reseau, equations (5a, b)."""
        x, y, a = p[..., 0], p[..., 1], self.a
        below = 1 + a["a0"] * x + a["b0"] * y
        r = a["k"] * (x * x + y * y)
        return np.stack(
            [
                (a["a1"] * x + a["b1"] * y) / below + a["d1"] * x * y + x * r + a["h1"] * x**4,
                a["b2"] * y / below + a["d2"] * x * y + y * r + a["h2"] * y**4,
            ],
            axis=-1,
        )

    def object(self, p: Array) -> Array:
        """The screen (…, 2) on the object, equations (7a, b)."""
        sides, square = [], (p**2).sum(axis=-1)
        for n, u, v in (("A", p[..., 0], p[..., 1]), ("B", p[..., 1], p[..., 0])):
            terms = (1, u, v, u * v, u * u, v * v, u * square, square**2)
            sides.append(sum(self.b[f"{n}{i}"] * t for i, t in enumerate(terms)))
        return np.stack(sides, axis=-1)

    def photo(self, which: int) -> tuple[Array, Array, tuple[int, int]]:
        """Images of O and S, and the size of a photograph."""
        turn = self.turns[0]
        box = np.abs([[np.cos(turn), np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ HALF + 3
        size = tuple(int(2 * v * self.scale) for v in box)
        rng = np.random.default_rng([self.seed, 77, which])
        scale = self.scale * (1 + (which > 0) * rng.uniform(-0.003, 0.003))
        o = np.array(size) / 2 + rng.normal(0, 2, 2)
        t = self.turns[which]
        return o, o + self.distance * scale * np.array([np.cos(t), np.sin(t)]), (size[0], size[1])

    def common(self, which: int, px: Array) -> Array:
        """Photo-coordinates of pixels (…, 2)."""
        o, s, _ = self.photo(which)
        z = ((px[..., 0] - o[0]) - 1j * (px[..., 1] - o[1])) / complex(s[0] - o[0], o[1] - s[1])
        return np.stack([z.real, z.imag], axis=-1) * self.distance

    def pixels(self, which: int, xy: Array) -> Array:
        """Pixels of points (n, 2) of the screen."""
        o, s, _ = self.photo(which)
        z = _solved(self.screen, xy, xy)
        w = (z[:, 0] + 1j * z[:, 1]) / self.distance * complex(s[0] - o[0], o[1] - s[1])
        return np.stack([o[0] + w.real, o[1] - w.imag], axis=-1)

    def clear(self, p: Array, sharp: float) -> Array:
        """Share of the light of points (…, 2) of the screen that passes all wires; `sharp` samples per mm."""
        raw = p @ self.turn.T + self.shift
        free = np.ones(p.shape[:-1])
        for own, extent in ((0, 37.0), (1, 46.8)):
            for wire in self.wires[own]:
                away = np.abs(raw[..., own] - _course(wire, raw[..., 1 - own], extent)) - self.width / 2
                free *= np.clip(away * sharp + 0.5, 0, 1)
        return free

    def light(self, e: dict[str, Array], k: int, p: Array) -> Array:
        """Light of an echo at points of the screen, without wires."""
        u, v = (
            p[..., 0] - e["x"][k],
            p[..., 1] - e["y"][k] + e["curvature"][k] / 2 * (p[..., 0] - e["x"][k]) ** 2,
        )
        along = 1 / (1 + np.exp(np.clip((np.abs(u) - e["length"][k] / 2) / (0.55 * e["end"][k]), -50, 50)))

        def profile(depth: Array) -> Array:
            shape = np.exp(-0.5 * (depth / e["sigma"][k]) ** 2)
            if self.tail:  # the transducer rings: light decays behind the echo
                rise = 1 / (1 + np.exp(-np.clip(4 * depth / e["sigma"][k], -50, 50)))
                shape = shape + 0.25 * rise * np.exp(-np.maximum(depth, 0) / self.tail)
            return np.asarray(shape)

        across = profile(-v)
        if self.repeats[0]:
            across = across + self.repeats[1] * profile(-v - self.repeats[0])
        across = np.asarray(e["light"][k] * along * across)
        return np.minimum(across, 0.75 * e["light"][k]) if self.kind == "flat" else across

    def image(self, which: int) -> NDArray[np.uint8]:
        """A photograph as a file shows it."""
        _, _, (w, h) = self.photo(which)
        rng = np.random.default_rng([self.seed, 88, which])
        x, y = ((np.arange(n * FINE) + 0.5) / FINE - 0.5 for n in (w, h))
        # the mapping is smooth: sampled at whole pixels and interpolated
        coarse = self.screen(
            self.common(which, np.stack(np.meshgrid(x[:: 4 * FINE], y[:: 4 * FINE]), axis=-1))
        )
        grid = _dense(coarse, (len(x), len(y)), 4 * FINE)
        clear = self.clear(grid, self.scale * FINE)
        inside = np.clip((HALF - np.abs(grid)) * self.scale * FINE + 0.5, 0, 1).prod(axis=-1)
        level, wire = (175.0, 45.0) if which == 0 else (60.0, 20.0)
        glow = np.full(grid.shape[:2], level)
        if which and self.kind == "speckle":
            fine = rng.normal(0, 1, (2, *(n // 4 for n in glow.shape)))
            field = [cv2.resize(cv2.GaussianBlur(f, (0, 0), 1.1), glow.shape[::-1]) for f in fine]
            tissue = np.hypot(*field)
            glow += 13 * (tissue / tissue.mean() - 1)
        if which:
            for k, at in enumerate(self.pixels(which, self._places(which))):
                self._add(glow, grid, which, k, at)
            if self.kind == "graphics":
                self._graphics(glow, which)
        picture = 12.0 + inside * (wire + clear * (glow - wire) - 12.0)
        picture = cv2.GaussianBlur(picture, (0, 0), self.psf * FINE)
        picture = picture.reshape(h, FINE, w, FINE).mean(axis=(1, 3))
        return self._developed(picture, rng)

    def _places(self, which: int) -> Array:
        e = self.pins if which == 1 else self.body
        return np.stack([e["x"], e["y"]], axis=1)

    def _add(self, glow: Array, grid: Array, which: int, k: int, at: Array) -> None:
        e = self.pins if which == 1 else self.body
        reach = (e["length"][k] / 2 + 1.5 + self.repeats[0] + 4 * self.tail) * self.scale
        x0, y0 = np.maximum(np.floor(at - reach), 0).astype(int) * FINE
        x1, y1 = np.ceil(at + reach).astype(int) * FINE
        part = np.s_[y0:y1, x0:x1]
        glow[part] += self.light(e, k, grid[part])

    def _graphics(self, glow: Array, which: int) -> None:
        """Ticks of a scale and letters, drawn on the screen."""
        white = 55.0
        for i in range(15):
            a, b = self.pixels(
                which, np.array([[-49.0, 36 - 5.0 * i], [-47.0 + 2 * (i % 5 == 0), 36 - 5.0 * i]])
            )
            _stroke(glow, a, b, white)
        at = self.pixels(which, np.array([[15.0, 38.5]]))[0] * FINE
        layer = np.zeros(glow.shape, np.uint8)
        for line, text in enumerate(("3.5 MHZ  GAIN 42", "DEPTH 12 CM")):
            place = (int(at[0]), int(at[1] + 70 * line))
            cv2.putText(layer, text, place, cv2.FONT_HERSHEY_SIMPLEX, 1.6, 255, 5)
        glow += white / 255 * layer

    def _developed(self, picture: Array, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Film, scanner and file."""
        h, w = picture.shape
        if self.kind == "vignetting":
            v, u = np.meshgrid((np.arange(h) - h / 2) / w, (np.arange(w) - w / 2) / w, indexing="ij")
            picture = picture * (1 + 0.2 * u - 0.15 * v - 0.9 * (u**2 + v**2))
        if self.kind == "gamma":
            picture = 255 * np.clip(picture / 255, 0, 1) ** 0.8
        if self.kind == "hum":
            picture = picture + 3 * np.sin(2 * np.pi * np.arange(h)[:, None] / 37.3 + 1.1)
        if self.kind == "polaroid":
            grain = cv2.GaussianBlur(rng.normal(0, 1, picture.shape), (0, 0), 0.8)
            picture = picture * (1 + 0.05 * grain / grain.std())
            picture = picture + 2 * np.sin(2 * np.pi * np.arange(h)[:, None] / 3.1)
            for x, y in rng.uniform(0, [w, h], (40, 2)):
                cv2.circle(
                    picture, (int(x), int(y)), int(rng.integers(1, 3)), float(rng.choice([15, 170])), -1
                )
        done = np.clip(np.rint(picture + rng.normal(0, self.noise, picture.shape)), 0, 255).astype(np.uint8)
        if self.kind == "jpeg":
            code = cv2.imencode(".jpg", done, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(85, 96))])[1]
            done = np.asarray(cv2.imdecode(code, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
        if self.kind == "colour":  # green phosphor; OpenCV writes blue, green, red
            done = np.stack([np.rint(0.8 * done), done, np.rint(0.6 * done)], axis=-1).astype(np.uint8)
        return done

    def hidden(self, e: dict[str, Array]) -> Array:
        """Share of the light of each echo behind wires."""
        found = []
        for k in range(len(e["x"])):
            reach = e["length"][k] / 2 + 0.8
            x, y = np.meshgrid(np.linspace(-reach, reach, 240), np.linspace(-1.2, 0.9, 130))
            p = np.stack([x + e["x"][k], y + e["y"][k]], axis=-1)
            light = self.light(e, k, p)
            found.append(1 - float((light * self.clear(p, 100.0)).sum() / light.sum()))
        return np.round(found, 4)

    def truth(self, name: str) -> dict[str, Any]:
        """The truth as `refined` reads it."""

        def echoes(which: int, e: dict[str, Array], ids: list[str]) -> dict[str, Any]:
            place = np.stack([e["x"], e["y"]], axis=1)
            px, made = self.pixels(which, place), self.object(place)
            noise = np.hypot(self.noise, {"speckle": 7.0, "polaroid": 4.0}.get(self.kind, 0.0))
            columns = {
                "x": px[:, 0], "y": px[:, 1], "screen_x_mm": place[:, 0], "screen_y_mm": place[:, 1],
                "object_X_mm": made[:, 0], "object_Y_mm": made[:, 1], "hidden": self.hidden(e),
                "visible": e["light"] > 5 * noise,
            }  # fmt: skip
            return {"id": ids} | {key: values.tolist() for key, values in columns.items()}

        names = [{0: "M", 6: "N"}.get(i, str(i + 1)) for i in range(len(self.rods))]
        checks = [f"C{i + 1}" for i in range(len(self.body["x"]))]
        photos = {
            "II": {"pins": echoes(1, self.pins, names)},
            "III": {"check": echoes(2, self.body, checks)},
        }
        about = {"set": name, "kind": self.kind, "repeats_mm": self.repeats}
        return about | {"A": self.a, "B": self.b, "photos": photos}

    def designs(self, name: str) -> tuple[dict[str, Any], dict[str, Any]]:
        """Designs of the reseau in coordinates of a comparator, and of the rods; every other with places."""
        rng = np.random.default_rng([self.seed, 99])
        t = rng.uniform(-0.03, 0.03)
        turn = np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]])
        near = [self.pixels(k, p) for k, p in ((0, self.marks), (1, self._places(1)))]
        near = [p + rng.uniform(-6, 6, 2) + rng.normal(0, 2, p.shape) for p in near]

        def points(ids: list[str], xy: Array, px: Array) -> list[dict[str, Any]]:
            rows = zip(ids, xy.tolist(), np.round(px, 1).tolist(), strict=True)
            return [
                {"id": i, "x": x, "y": y} | ({"nominal_px": p} if self.seed % 2 else {})
                for i, (x, y), p in rows
            ]

        head = {"schema": "reseau-design/1", "name": name, "unit": "mm"}
        mark = {"shape": "line-grid", "size": self.width, "line_width": self.width}
        names = [{0: "M", 6: "N"}.get(i, str(i + 1)) for i in range(len(self.rods))]
        return (
            head | {"mark": mark, "polarity": "dark", "origin": self.origin, "axis": self.axis}
            | {"points": points(self.ids, self.marks @ turn + rng.uniform(-50, 50, 2), near[0])},
            head | {"mark": {"shape": "rod", "size": 0.75}, "polarity": "bright", "origin": "M", "axis": "N"}
            | {"points": points(names, self.rods, near[1])},
        )  # fmt: skip


def _course(wire: Array, along: Array, extent: float) -> Array:
    """Where a wire (…, 3) passes, across, at places along it."""
    return np.asarray(wire[..., 0] + wire[..., 1] * along + wire[..., 2] * (1 - (along / extent) ** 2))


def _solved(mapping: Any, goal: Array, start: Array) -> Array:
    """Points (n, 2) that a mapping maps to `goal`."""
    at = start.astype(float).copy()
    for _ in range(60):
        off = mapping(at) - goal
        slope = np.stack([(mapping(at + e) - mapping(at - e)) / 2e-3 for e in 1e-3 * np.eye(2)], axis=-1)
        at -= np.linalg.solve(slope, off[..., None])[..., 0]
    return at


def _dense(coarse: Array, size: tuple[int, int], step: int) -> Array:
    """Values on the fine grid from every `step`-th, by cubic splines."""
    from scipy.interpolate import RectBivariateSpline

    y, x = (np.arange(n) * float(step) for n in coarse.shape[:2])
    fine = [RectBivariateSpline(y, x, coarse[..., k])(np.arange(size[1]), np.arange(size[0])) for k in (0, 1)]
    return np.stack(fine, axis=-1)


def _stroke(glow: Array, a: Array, b: Array, white: float) -> None:
    layer = np.zeros(glow.shape, np.uint8)
    ends = [(int(p[0] * FINE), int(p[1] * FINE)) for p in (a, b)]
    cv2.line(layer, ends[0], ends[1], 255, 2 * FINE)
    glow += white / 255 * layer


def write_screen(folder: Path, name: str, world: Screen) -> None:
    """Write photographs, designs and truth."""
    folder.mkdir(parents=True, exist_ok=True)
    for which in range(3):
        if not cv2.imwrite(str(folder / f"{name}.photo{which + 1}.png"), world.image(which)):
            raise OSError(f"{folder / name}.photo{which + 1}.png cannot be written")
    reseau, rods = world.designs(name)
    for label, content in (("reseau.design", reseau), ("object.design", rods), ("truth", world.truth(name))):
        (folder / f"{name}.{label}.json").write_text(json.dumps(content))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--count", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--kind", default="", choices=["", *KINDS])
    given = parser.parse_args()
    for seed in range(given.first, given.first + given.count):
        world = Screen(seed, given.kind)
        write_screen(given.folder, f"screen{seed:03d}", world)
        print(f"screen{seed:03d} {world.kind}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
