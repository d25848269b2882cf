"""A reseau on film scanned in two halves, as that of KH-9: crosses, deformation of the film, common raster.

Run from the checkout: ``python benchmarks/reseau_film.py [--count N]``; ``--write FOLDER`` writes the first
film, for ``docs/howto/reseau-on-film.md``. A terrain with dark crosses at 10 mm
is drawn as a function of position with ``benchmarks/worlds/pixels.py``, which shares no formation of images
with the project. The film is stretched, bent and shrunk unevenly; each half is scanned with a rotation of its
own, grain and noise. Printed for each half: crosses measured, rms of their errors, errors over sigmas; rms of
what remains of the deformation in millimetres of the reseau at places between the crosses; then by how much
the halves put the same place of the film elsewhere in the strip that both show, and where the second begins.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from worlds.pixels import Array, edge, form

from reseau.calibration import CorrectedImage
from reseau.core.data import Frame, ImagePoints
from reseau.core.failure import Failure
from reseau.designs import regular_reseau
from reseau.io import Mark, ReseauDesign
from reseau.io.images import write_image
from reseau.measure import measure_reseau
from reseau.measure.reseau.marks import ReseauOptions
from reseau.refine import correct_camera

PX_PER_MM, ARM, LINE = 10.0, 1.2, 0.16
"""Resolution of the scans; length of the arms of a cross and width of its lines, mm."""
MOST_MM = 0.01
"""Largest difference of the halves in the strip that both show, rms: a tenth of a pixel of the scan."""


def _design() -> ReseauDesign:
    """Crosses at 10 mm; O and S lie in the strip that both halves show."""
    cross = Mark(shape="cross", size=2 * ARM, line_width=LINE)
    film = regular_reseau(15, 9, 10.0, cross)
    named = {tuple(xy.tolist()): name for name, xy in zip(film.ids, film.xy, strict=True)}
    return film.model_copy(update={"origin": named[0.0, 0.0], "axis": named[10.0, 0.0], "polarity": "dark"})


def _deformed(xy: Array, bend: Array) -> Array:
    """The film as it is scanned, mm: unequal shrinkage, and a bend of some hundredths of a millimetre."""
    x, y = xy[..., 0] / 70, xy[..., 1] / 40
    dx = bend[0] * x * y + bend[1] * y**2 + bend[2] * x**3
    dy = bend[3] * x * y + bend[4] * x**2 + bend[5] * y**3
    return np.stack([xy[..., 0] * 1.0004 + dx, xy[..., 1] * 0.9997 + dy], axis=-1)


def _undeformed(xy: Array, bend: Array) -> Array:
    found = xy
    for _ in range(6):
        found = found + xy - _deformed(found, bend)
    return found


def half(side: int, seed: int, design: ReseauDesign) -> tuple[Array, Any, Any]:
    """Grey values of one half, and mappings from millimetres of the reseau to its pixels and back."""
    common = np.random.default_rng([9, seed])
    bend = common.normal(0, 0.03, 6)
    fields = common.uniform(-1, 1, (12, 6))
    rng = np.random.default_rng([9, seed, side + 1])
    angle = rng.normal(0, 0.01)
    turn = PX_PER_MM * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = turn @ np.diag([1.0, -1.0])
    width, height = int(95 * PX_PER_MM), int(92 * PX_PER_MM)
    shift = np.array([width / 2, height / 2]) - matrix @ [side * 32.0, 0.0] + rng.uniform(-5, 5, 2)
    back = np.linalg.inv(matrix)

    def film(px: Array) -> Array:
        return _undeformed((px - shift) @ back.T, bend)

    def scene(x: Array, y: Array, spacing: float) -> Array:
        xy = film(np.stack([x, y], axis=-1))
        u, v = xy[..., 0], xy[..., 1]
        tone = 0.5 + 0.06 * np.sin(u * 0.7 + 2 * np.sin(v * 0.31)) * np.sin(v * 0.9 + np.sin(u * 0.23))
        for cx, cy, a, b, turned, tint in fields:
            c, s = np.cos(3 * turned), np.sin(3 * turned)
            p, q = c * (u - 70 * cx) + s * (v - 40 * cy), c * (v - 40 * cy) - s * (u - 70 * cx)
            inside = np.minimum(2 + 6 * abs(a) - np.abs(p), 2 + 6 * abs(b) - np.abs(q))
            tone = tone + 0.12 * tint * edge(inside * PX_PER_MM, spacing)
        du, dv = (np.abs(w - 10 * np.rint(w / 10)) for w in (u, v))
        arm = [np.minimum(LINE / 2 - p, ARM - q) * PX_PER_MM for p, q in ((du, dv), (dv, du))]
        on = (np.abs(u) < 72) & (np.abs(v) < 42)
        return np.where(on, tone * (1 - 0.75 * edge(np.maximum(*arm), spacing)), 0.03)

    light = form(scene, width, height, 0.8, oversampling=3)
    grain = rng.normal(0, 1, light.shape)
    grain = (grain + np.roll(grain, 1, 0) + np.roll(grain, 1, 1) + np.roll(grain, 1, (0, 1))) / 2
    grey = 20 + 210 * np.clip(light, 0, 1) + 3.0 * np.sqrt(np.clip(light, 0.02, 1)) * grain
    grey += rng.normal(0, 1.0, light.shape)
    return np.clip(np.rint(grey), 0, 255), lambda mm: _deformed(mm, bend) @ matrix.T + shift, film


def _scans(seed: int, design: ReseauDesign) -> Iterator[tuple[Array, ReseauDesign, Any]]:
    """Grey values of both halves, the crosses that each shows, and where millimetres are in it."""
    for side in (-1, 1):
        grey, scanned, _ = half(side, seed, design)
        shown = [
            p for p, xy in zip(design.points, scanned(design.xy), strict=True) if _within(xy, grey.shape)
        ]
        yield grey, design.model_copy(update={"points": tuple(shown)}), scanned


def _halves(seed: int) -> bool:
    strip, rasters = [], []
    for side, (grey, part, scanned) in zip((-1, 1), _scans(seed, _design()), strict=True):
        # Seen from the front.
        frame = Frame(grey.astype(np.uint8), 255.0)
        found = measure_reseau(frame, part, ReseauOptions(mirrored=False, max_rotation_deg=20.0))
        if isinstance(found, Failure):
            print(f"  {seed} {side:+d}: declined: {found.reason}")
            return False
        marks: ImagePoints = found.points
        error = marks.xy - scanned(part.xy[[part.ids.index(name) for name in marks.names]])
        ratio = error / marks.sigma
        camera = correct_camera(marks, part, trials=0)
        if isinstance(camera, Failure):
            print(f"  {seed} {side:+d}: {camera.reason}")
            return False
        x = np.linspace(-65, 65, 66)
        between = np.stack(np.meshgrid(x, np.linspace(-37, 37, 38)), axis=-1).reshape(-1, 2)
        between = between[[_within(xy, grey.shape) for xy in scanned(between)]]
        left = camera.model(camera.photo_system(scanned(between))) - between
        print(
            f"  {seed} {side:+d}: {len(marks)} of {len(part.ids)} crosses, "
            f"{np.sqrt(np.mean(error**2)):.3f} px, "
            f"errors ÷ sigmas {np.sqrt(np.mean(ratio**2)):.2f} (at most {np.abs(ratio).max():.1f}), "
            f"film corrected to {1000 * np.sqrt(np.mean(left**2)):.1f} µm"
        )
        here = np.stack(np.meshgrid(np.linspace(-8, 8, 9), np.linspace(-37, 37, 20)), axis=-1).reshape(-1, 2)
        strip.append(camera.model(camera.photo_system(scanned(here))))
        rasters.append(CorrectedImage.plan(camera, (grey.shape[1], grey.shape[0]), 10.0))
    apart = float(np.sqrt(np.mean((strip[1] - strip[0]) ** 2)))
    offset = (np.array(rasters[1].origin) - np.array(rasters[0].origin)) * rasters[0].slope
    whole = bool(np.abs(offset - np.rint(offset)).max() < 1e-6)
    print(
        f"  {seed}: halves differ by {1000 * apart:.1f} µm in their strip; second begins at column, row "
        f"{np.rint(offset).astype(int).tolist()} of the first{'' if whole else ': NOT A WHOLE PIXEL'}"
    )
    return whole and apart < MOST_MM


def _within(xy: Array, shape: tuple[int, ...]) -> bool:
    return bool((xy > 25).all() and (xy < np.array(shape[::-1]) - 25).all())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--count", type=int, default=2, help="films")
    parser.add_argument("--write", type=Path, help="folder for the scans of the first film and their designs")
    given = parser.parse_args()
    if given.write is not None:
        given.write.mkdir(parents=True, exist_ok=True)
        for name, (grey, part, _) in zip(("left", "right"), _scans(0, _design()), strict=True):
            write_image(given.write / f"{name}.tif", grey.astype(np.uint8))
            part.model_copy(update={"name": name}).write(given.write / f"{name}.json")
        return 0
    print("reseau on film, two halves")
    return 0 if all(list(map(_halves, range(given.count)))) else 1


if __name__ == "__main__":
    sys.exit(main())
