"""Frames of marks of several contrasts, and of wires that are parallel to nothing, with truth and bounds.

Run from the checkout: ``python benchmarks/worlds/marks.py FOLDER [--kind line-grid] [--count 11]``
writes ``NAME.png``, ``NAME.design.json`` and ``NAME.truth.json`` per frame; ``--check`` compares the frames
with more finely sampled ones, and the bounds with those of ``$RESEAU_DATA/independent/marks``.

Shapes are unions of bars and disks in a plane that is tilted and rotated into the image. Positions of the
truth are centres of the images of the marks (crossings of the axes of their bars), origin in the centre of
the top-left pixel, x right, y down.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from worlds.pixels import Array, edge, form, form_at

__all__ = ["Kind", "Marks", "Shape", "Sheet", "bounds", "drawn", "write"]

Kind = Literal["cross", "disk", "line-grid", "wires"]


@dataclass(frozen=True)
class Shape:
    """A mark in its plane, in pixels of the plane.

    Parameters
    ----------
    kind : {"cross", "disk", "line-grid", "wires"}
        Two bars at right angles, a disk, two bars at any angle, or the crossing of two continuous wires.
    size : float
        Half the length of the bars, or the diameter of the disk.
    width : float
        Of the bars.
    skew_deg : float
        By how much the angle between the bars is less than 90°.
    turn_deg : float
        From the x-axis of the plane to the first bar.
    """

    kind: Kind
    size: float
    width: float = 0.0
    skew_deg: float = 0.0
    turn_deg: float = 0.0

    def covered(self, u: Array, v: Array, spacing: float) -> Array:
        """Share of samples covered, at positions of the plane relative to the mark's centre."""
        if self.kind == "disk":
            return edge(self.size / 2 - np.hypot(u, v), spacing)
        bars = []
        for angle in np.deg2rad([self.turn_deg, self.turn_deg + 90 - self.skew_deg]):
            along, across = (
                u * np.cos(angle) + v * np.sin(angle),
                v * np.cos(angle) - u * np.sin(angle),
            )
            bar = edge(self.width / 2 - np.abs(across), spacing)
            bars.append(bar if self.kind == "wires" else bar * edge(self.size - np.abs(along), spacing))
        return np.maximum(*bars)

    @property
    def reach(self) -> float:
        """Distance from the centre beyond which there is nothing."""
        return self.size / 2 if self.kind == "disk" else float(np.hypot(self.size, self.width))


@dataclass(frozen=True)
class Sheet:
    """How a frame is taken.

    Parameters
    ----------
    shape : Shape
        Of all marks.
    columns, rows : int
        Of the lattice.
    pitch : float
        Of the lattice, in pixels of the plane.
    sigma : float
        Standard deviation of the point-spread function, pixels.
    fill : float
        Light-sensitive share of a pixel's area.
    noise : float
        Standard deviation of the noise, grey levels.
    bits : int
        8 with one, 16 with 64 numbers per grey level.
    background : float
        Its level in the middle of the frame; 50 below bright, 190 around dark marks.
    contrasts : tuple of float
        Of which every mark has one; negative for dark marks.
    slope : (float, float)
        Of the background, grey levels per pixel.
    kappa_deg, tilt_deg, rho_deg : float
        Rotation of the plane, its tilt and the direction of the tilt.
    jitter : float
        Largest deviation of marks from the lattice, pixels of the image.
    slopes : float
        Largest slope of continuous wires against the axes of the lattice.
    clear : float
        Radius in which crossing bars are observed for their bound, pixels.
    """

    shape: Shape
    columns: int = 16
    rows: int = 12
    pitch: float = 28.0
    sigma: float = 0.8
    fill: float = 1.0
    noise: float = 1.0
    bits: int = 8
    background: float = 50.0
    contrasts: tuple[float, ...] = (30.0, 80.0, 150.0)
    slope: tuple[float, float] = (0.0, 0.0)
    kappa_deg: float = 0.0
    tilt_deg: float = 0.0
    rho_deg: float = 0.0
    jitter: float = 0.5
    slopes: float = 0.0
    clear: float = 6.0

    @property
    def plane(self) -> Array:
        """From the plane to the image, (2, 2)."""
        kappa, rho = np.deg2rad([self.kappa_deg, self.rho_deg])
        turn, aside = (np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for a in (kappa, rho))
        return np.asarray(turn @ aside @ np.diag([np.cos(np.deg2rad(self.tilt_deg)), 1.0]) @ aside.T)

    @property
    def quantised(self) -> float:
        """Standard deviation of the noise with that of rounding."""
        step = 1.0 if self.bits == 8 else 1 / 64
        return float(np.sqrt(self.noise**2 + step**2 / 12))

    @classmethod
    def drawn_from(cls, kind: Kind, rng: np.random.Generator) -> Sheet:
        """A frame of a kind at random: rotation, blur, aperture, bits, polarity, line width, skew."""
        bright = bool(rng.random() < 0.5)
        if kind == "cross":
            shape = Shape(kind, float(rng.uniform(5, 8)), float(rng.uniform(2.5, 4.5)))
        elif kind == "disk":
            shape = Shape(kind, float(rng.uniform(8, 20)))
        else:
            skew = float(rng.uniform(-6, 6)) if kind == "line-grid" else 0.0
            shape = Shape(kind, 10.0, float(rng.uniform(1.25, 3.5)), skew)
        pitch = round(2 * shape.reach + float(rng.uniform(8, 14)))
        sheet = cls(
            shape,
            pitch=pitch,
            sigma=float(rng.uniform(0.5, 1.2)),
            fill=float(rng.choice([0.64, 1.0])),
            bits=int(rng.choice([8, 16])),
            background=50.0 if bright else 190.0,
            contrasts=tuple((1.0 if bright else -1.0) * c for c in (30, 80, 150)),
            slope=tuple(float(s) for s in rng.uniform(-0.02, 0.02, 2)),  # type: ignore[arg-type]
            kappa_deg=float(rng.uniform(-180, 180) if kind == "wires" else rng.uniform(-30, 30)),
            tilt_deg=float(rng.choice([0.0, rng.uniform(0, 8)])),
            rho_deg=float(rng.uniform(-90, 90)),
            slopes=0.1 if kind == "wires" else 0.0,
        )
        if kind != "wires":
            return sheet
        # All wires of a frame are of one kind of thread, in any light.
        contrasts, noise = (float(rng.choice(sheet.contrasts)),), float(rng.uniform(0.5, 2.0))
        return replace(sheet, contrasts=contrasts, noise=noise, sigma=float(rng.uniform(0.5, 1.8)))


@dataclass(frozen=True, eq=False)
class Marks:
    """A frame with its truth.

    Parameters
    ----------
    image : ndarray (height, width)
        Without noise, in grey levels.
    xy : ndarray (n, 2)
        True positions of the marks.
    plane : ndarray (n, 2)
        Their designed coordinates.
    nominal : ndarray (n, 2)
        Approximate positions.
    contrast : ndarray (n,)
        Of each mark.
    crlb : dict
        Bounds `sigma_x`, `sigma_y`, `rho` (n,) of each mark by what else is unknown; see `bounds`.
    """

    image: Array
    xy: Array
    plane: Array
    nominal: Array
    contrast: Array
    crlb: dict[str, dict[str, Any]]


@dataclass(frozen=True)
class _Wires:
    """Continuous wires: direction (2,) and offset of each along the normal, (k, 2) and (k,)."""

    normal: Array
    offset: Array

    def covered(self, x: Array, y: Array, half: float, spacing: float) -> Array:
        """Share of samples that any of the wires covers."""
        found = np.zeros(x.shape)
        corners = np.array(
            [[x.flat[i], y.flat[i]] for i in (0, x.shape[1] - 1, x.size - x.shape[1], x.size - 1)]
        )
        away = corners @ self.normal.T - self.offset
        near = (away.min(axis=0) < half + 1) & (away.max(axis=0) > -half - 1)
        for (a, b), c in zip(self.normal[near], self.offset[near], strict=True):
            np.maximum(found, edge(half - np.abs(a * x + b * y - c), spacing), out=found)
        return found


def _lattice(sheet: Sheet) -> Array:
    """Designed coordinates of the marks, row by row, pixels of the plane."""
    x, y = np.meshgrid(np.arange(sheet.columns), np.arange(sheet.rows))
    return np.stack([x.ravel(), y.ravel()], axis=-1) * sheet.pitch


def _wires(sheet: Sheet, rng: np.random.Generator) -> tuple[_Wires, Array]:
    """Wires in the image, each with its own slope and offset, and their crossings (n, 2)."""
    normals, offsets = [], []
    common = rng.uniform(-sheet.slopes, sheet.slopes, 2)  # the two sets are not at right angles either
    for axis, count in ((0, sheet.columns), (1, sheet.rows)):
        middle = (np.array([sheet.columns, sheet.rows]) - 1) * sheet.pitch / 2
        for i in range(count):
            through = middle.copy()
            through[axis] = i * sheet.pitch + rng.uniform(-0.02, 0.02) * sheet.pitch
            slope = common[axis] + rng.uniform(-0.004, 0.004)
            along = np.array([slope, 1.0]) if axis == 0 else np.array([1.0, slope])
            start, step = sheet.plane @ through, sheet.plane @ along
            normal = np.array([step[1], -step[0]]) / np.hypot(*step)
            normals.append(normal)
            offsets.append(float(normal @ start))
    normal, offset = np.array(normals), np.array(offsets)
    c = sheet.columns
    crossings = [
        np.linalg.solve(normal[[i, c + j]], offset[[i, c + j]]) for j in range(sheet.rows) for i in range(c)
    ]
    return _Wires(normal, offset), np.array(crossings)


def drawn(sheet: Sheet, seed: int, oversampling: int = 8) -> Marks:
    """Draw a frame.

    Parameters
    ----------
    sheet : Sheet
        How it is taken.
    seed : int
        Of contrasts, jitter and offsets.
    oversampling : int
        Samples per pixel and axis.
    """
    rng = np.random.default_rng((seed, 1))
    shape, plane = sheet.shape, _lattice(sheet)
    contrast = rng.choice(sheet.contrasts, len(plane))
    wires: _Wires | None = None
    if shape.kind == "wires":
        wires, xy = _wires(sheet, rng)
        contrast[:] = sheet.contrasts[0]
    else:
        xy = plane @ sheet.plane.T + rng.uniform(-sheet.jitter, sheet.jitter, plane.shape)
    margin = 8.0 + shape.reach
    shift = np.ceil(margin - xy.min(axis=0)) + rng.uniform(0, 1, 2)
    xy = xy + shift
    width, height = (int(np.ceil(edge + margin)) for edge in xy.max(axis=0))
    if wires is not None:  # comparator coordinates, turned against the wires
        wires = replace(wires, offset=wires.offset + wires.normal @ shift)
        angle = rng.uniform(-np.pi, np.pi)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        plane = xy @ np.linalg.inv(sheet.plane).T @ turn.T
    back = np.linalg.inv(sheet.plane)

    def scene(x: Array, y: Array, spacing: float) -> Array:
        light = np.zeros(x.shape)
        if wires is not None:
            return wires.covered(x, y, shape.width / 2, spacing) * contrast[0]
        reach = shape.reach + 1
        first, pitch = np.array([x[0, 0], y[0, 0]]), 1 / spacing
        for at, level in zip(xy, contrast, strict=True):
            low = np.maximum(np.floor((at - reach - first) * pitch), 0).astype(int)
            high = np.maximum(np.ceil((at + reach - first) * pitch) + 1, 0).astype(int)
            part = np.s_[low[1] : high[1], low[0] : high[0]]
            if x[part].size:
                du, dv = x[part] - at[0], y[part] - at[1]
                u, v = (row[0] * du + row[1] * dv for row in back)
                light[part] += level * shape.covered(u, v, spacing)
        return light

    image = form(scene, width, height, sheet.sigma, float(np.sqrt(sheet.fill)), oversampling)
    x, y = np.meshgrid(np.arange(width) - (width - 1) / 2, np.arange(height) - (height - 1) / 2)
    image += sheet.background + sheet.slope[0] * x + sheet.slope[1] * y
    nominal = np.round(xy + rng.uniform(-2, 2, xy.shape))
    crlb = bounds(sheet, xy, contrast, lines=None if wires is None else (wires.normal, wires.offset))
    return Marks(image, xy, plane, nominal, contrast, crlb)


def bounds(
    sheet: Sheet,
    xy: Array,
    contrast: Array,
    *,
    lines: tuple[Array, Array] | None = None,
    oversampling: int = 8,
) -> dict[str, dict[str, Any]]:
    """Cramér–Rao bounds of the positions of marks, each alone in its frame.

    Unknown are the position, the contrast, the level of the background and the width of the point-spread
    function; in a second set the slopes of the background too. Bars that cross are observed within a circle
    of `clear` pixels: where they end is no property of the crossing.

    Parameters
    ----------
    sheet : Sheet
        How the frame is taken.
    xy, contrast : ndarray (n, 2), (n,)
        Positions and contrasts.
    lines : (ndarray (k, 2), ndarray (k,)), optional
        Normals and offsets of continuous wires.
    oversampling : int
        Samples per pixel and axis.

    Returns
    -------
    dict
        `crlb` and `crlb_slopes`, each with `sigma_x`, `sigma_y` and `rho` (n,).
    """
    shape, back = sheet.shape, np.linalg.inv(sheet.plane)
    crossing = shape.kind in ("line-grid", "wires")
    reach = sheet.clear if crossing else shape.reach + 5 * sheet.sigma
    half = int(np.ceil(reach)) + 1
    offset = np.arange(-half, half + 1)
    found = np.empty((2, len(xy), 3))
    for row, ((x0, y0), level) in enumerate(zip(xy, contrast, strict=True)):
        first = (round(x0) - half, round(y0) - half)

        def scene(x: Array, y: Array, spacing: float, x0: float = x0, y0: float = y0) -> Array:
            if lines is not None:
                return _Wires(*lines).covered(x, y, shape.width / 2, spacing)
            u, v = (r[0] * (x - x0) + r[1] * (y - y0) for r in back)
            return shape.covered(u, v, spacing)

        side, aperture = (2 * half + 1,) * 2, float(np.sqrt(sheet.fill))
        parts = form_at(scene, first, side, sheet.sigma, aperture, oversampling, derivatives=True)
        x, y = np.meshgrid(first[0] + half + offset - x0, first[1] + half + offset - y0)
        columns = [parts[1] * level, parts[2] * level, parts[3] * level, parts[0], np.ones_like(x), x, y]
        weight = np.hypot(x, y) <= reach
        a = np.stack([column[weight] for column in columns], axis=-1) / sheet.quantised
        for which, unknowns in enumerate((5, 7)):
            cov = np.linalg.inv(a[:, :unknowns].T @ a[:, :unknowns])[:2, :2]
            sigma = np.sqrt(np.diagonal(cov))
            found[which, row] = *sigma, cov[0, 1] / sigma.prod()
    nuisance, keys = "contrast, background, psf sigma", ("sigma_x", "sigma_y", "rho")
    return {
        name: {"nuisance": told} | {k: np.round(v, 7).tolist() for k, v in zip(keys, values.T, strict=True)}
        for name, told, values in (
            ("crlb", nuisance, found[0]),
            ("crlb_slopes", f"{nuisance}, slopes of the background", found[1]),
        )
    }


def write(folder: Path, name: str, sheet: Sheet, seed: int) -> None:
    """Write image, design and truth of a frame."""
    marks = drawn(sheet, seed)
    shape, bright = sheet.shape, sheet.contrasts[0] > 0
    rng = np.random.default_rng((seed, 2))
    dn = 1 if sheet.bits == 8 else 64
    noisy = (marks.image + rng.normal(0, sheet.noise, marks.image.shape)) * dn
    top = 2**sheet.bits - 1
    pixels = np.clip(np.rint(noisy), 0, top).astype(np.uint8 if sheet.bits == 8 else np.uint16)
    if not cv2.imwrite(str(folder / f"{name}.png"), pixels):
        raise OSError(f"{folder / name}.png cannot be written")
    ids = [str(i + 1) for i in range(len(marks.xy))]
    crossing = shape.kind in ("line-grid", "wires")
    size = shape.width if crossing else shape.size * (1 if shape.kind == "disk" else 2)
    design = {
        "schema": "reseau-design/1",
        "name": name,
        "unit": "plane px",
        "mark": {
            "shape": "line-grid" if crossing else shape.kind,
            "size": size,
            "line_width": shape.width or None,
        },
        "polarity": "bright" if bright else "dark",
        "points": [
            {"id": i, "x": round(float(x), 6), "y": round(float(y), 6), "nominal_px": n}
            for i, (x, y), n in zip(ids, marks.plane, marks.nominal.tolist(), strict=True)
        ],
    }
    truth = {
        "schema": "worlds-marks/1",
        "image": f"{name}.png",
        "shape": {
            "kind": shape.kind,
            "size": shape.size,
            "line_width": shape.width,
            "skew_deg": shape.skew_deg,
            "clear": sheet.clear,
        },
        "psf_sigma_px": sheet.sigma,
        "fill_factor": sheet.fill,
        "noise_sigma": sheet.noise,
        "noise_sigma_with_quantisation": sheet.quantised,
        "bits": sheet.bits,
        "dn_per_grey": dn,
        "background": sheet.background,
        "slope": list(sheet.slope),
        "kappa_deg": sheet.kappa_deg,
        "tilt_deg": sheet.tilt_deg,
        "rho_deg": sheet.rho_deg,
        "A": sheet.plane.tolist(),
        "id": ids,
        "x": np.round(marks.xy[:, 0], 7).tolist(),
        "y": np.round(marks.xy[:, 1], 7).tolist(),
        "contrast": marks.contrast.tolist(),
    } | marks.crlb
    (folder / f"{name}.design.json").write_text(json.dumps(design))
    (folder / f"{name}.truth.json").write_text(json.dumps(truth))


def _like(truth: dict[str, Any]) -> Sheet:
    """How a frame of the data was taken, from its truth."""
    s = truth["shape"]
    if s["kind"] == "disk":
        shape = Shape("disk", s["diameter"])
    else:
        shape = Shape(s["kind"], s["half_length"], s["line_width"], s.get("skew_deg", 0.0))
    return Sheet(
        shape,
        sigma=truth["psf_sigma_px"],
        fill=truth["fill_factor"],
        noise=truth["noise_sigma"],
        bits=truth["bits"],
        background=truth["background"],
        kappa_deg=truth["kappa_deg"],
        tilt_deg=truth["tilt_deg"],
        rho_deg=truth["rho_deg"],
        clear=s.get("clear", 6.0),
    )


def _shift_between(first: Array, second: Array, at: Array, half: int = 9) -> Array:
    """Displacements (n, 2) of patches around marks from one image to the other, by least squares."""
    found = []
    gy, gx = np.gradient(first)
    for x, y in np.rint(at).astype(int):
        part = np.s_[y - half : y + half + 1, x - half : x + half + 1]
        a = np.stack([-gx[part].ravel(), -gy[part].ravel(), np.ones(gx[part].size)], axis=-1)
        found.append(np.linalg.lstsq(a, (second - first)[part].ravel(), rcond=None)[0][:2])
    return np.array(found)


def check(data: Path) -> None:
    """Compare with more finely sampled frames, and the bounds with those of the data."""
    print("frames at 8 samples per pixel against 20: largest displacement of a mark / px, of a value / %")
    for kind in ("cross", "disk", "line-grid", "wires"):
        rng = np.random.default_rng(3)
        sheet = replace(Sheet.drawn_from(kind, rng), columns=6, rows=4, sigma=0.5)  # the hardest to sample
        coarse, fine = (drawn(sheet, 5, n) for n in (8, 20))
        moved = np.abs(_shift_between(fine.image, coarse.image, fine.xy)).max()
        step = np.abs(coarse.image - fine.image).max() / np.ptp(fine.image)
        print(f"  {kind:<10} {moved:.5f} {100 * step:.3f}")
    print("bounds over those of the data, x and y: mean, lowest, highest")
    for file in sorted(data.glob("*.truth.json")):
        truth = json.loads(file.read_text())
        xy = np.stack([truth["x"], truth["y"]], axis=-1)
        own = bounds(_like(truth), xy[:40], np.array(truth["contrast"])[:40])["crlb"]
        ratio = np.array([own[k] for k in ("sigma_x", "sigma_y")]) / np.array(
            [truth["crlb"][k][:40] for k in ("sigma_x", "sigma_y")]
        )
        print(f"  {file.name:<30} {ratio.mean():.4f} {ratio.min():.4f} {ratio.max():.4f}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help="folder to write to")
    parser.add_argument("--kind", choices=["cross", "disk", "line-grid", "wires"], help="default: all")
    parser.add_argument("--count", type=int, default=3, help="frames of each kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--check", action="store_true", help="compare with finer sampling and with the data")
    given = parser.parse_args()
    if given.check:
        check(Path(os.environ.get("RESEAU_DATA", "../shared/data")) / "independent" / "marks")
    if given.folder is not None:
        given.folder.mkdir(parents=True, exist_ok=True)
        kinds: tuple[Kind, ...] = (given.kind,) if given.kind else ("cross", "disk", "line-grid", "wires")
        for kind in kinds:
            for seed in range(given.first, given.first + given.count):
                sheet = Sheet.drawn_from(kind, np.random.default_rng((seed, 0)))
                write(given.folder, f"{kind}_{seed:03d}", sheet, seed)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
