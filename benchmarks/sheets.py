"""Photographs of sheets and testfields of independent formation: what is found, errors and sigmas.

Run from the checkout: ``python benchmarks/sheets.py [--target sheet|field] [--count 3] [--condition C …]
[--large] [--sizes]``; see :mod:`worlds.sheets` for the conditions. ``--large`` measures one photograph of 20
megapixels of a sheet, and prints processor time and memory. ``--sizes`` measures testfields of decreasing
size in the picture, and reads their squares with the true lines given, as far as the pixels of targets
allow. A target counts as inside if its image is more than 2 px from the border and nothing in front of the
sheet comes nearer than 2 px (to disks: 12 px from the centre).
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from boards import reaches
from parts import add_options, executor_of, main_of, outcomes, timed
from worlds.boards import Field
from worlds.sheets import CONDITIONS, Printed, View, coded, pose, views

from reseau.core.data import Frame
from reseau.core.failure import Failure
from reseau.designs import coded_testfield
from reseau.execution import Executor
from reseau.io import ReseauDesign, TestfieldDesign, parse_design
from reseau.measure import measure_reseau
from reseau.measure.plane.lattice_mapping import started
from reseau.measure.plane.polynomial import refit
from reseau.measure.testfield.lattice import LatticeFit
from reseau.measure.testfield.recognition import read_clusters
from reseau.optics.formation import PixelResponse
from reseau.procedures.target_measurement import measurer_of

_MARGIN_PX, _CLEAR_PX = 2.0, 12.0
_WRONG_PX, _WRONG_SIGMA = 0.15, 5.0


def measured(target: str, view: View) -> tuple[np.ndarray, np.ndarray, int, int, float] | Failure:
    """Errors (n, 2) and the same in units of sigmas, numbers found and inside, and processor time."""
    design = parse_design(json.dumps(view.sheet.design()), Path(target))
    pixels = view.picture()
    found, seconds = timed(partial(measurer_of(design), Frame(pixels, 255.0)), target)
    if isinstance(found, Failure):
        return found
    size = np.array(pixels.shape[::-1])
    edge = reaches("tf" if target == "field" else "sheet", design, view.truth) + _MARGIN_PX
    inside = ((view.truth > edge - 0.5) & (view.truth < size - 0.5 - edge)).all(axis=1)
    inside &= view.hidden > (np.hypot(*edge.T) if target == "field" else _CLEAR_PX)
    error = (found.xy - view.truth)[found.ok]
    root = np.linalg.cholesky(found.cov[found.ok])
    scaled = np.linalg.solve(root, error[..., None])[..., 0]
    return error, scaled, int((found.ok & inside).sum()), int(inside.sum()), seconds


def of_size(field: Printed, job: tuple[float, int]) -> str:
    """Measure a testfield of some size, and read its squares where the lines are known; a row."""
    nearer, seed = job
    design = parse_design(json.dumps(field.design()), Path("field"))
    assert isinstance(design, TestfieldDesign)
    lines = round(np.sqrt(len(design.centres)))
    at, numbers = design.xy / design.pitch + lines / 2, np.arange(lines + 1)
    view = View(field, *pose(seed, field, nearer=nearer), seed=10 * seed)
    pixels, (wide, high) = view.picture(), np.ptp(view.truth, axis=0)
    straight: Any = cv2.findHomography(at, view.truth)[0]
    mapping = refit(started(straight, 3, pixels.shape), at, view.truth, 0.03)
    fit = LatticeFit(mapping, numbers, numbers)
    read = read_clusters(pixels.astype(np.float32), fit, design, view.blur, PixelResponse())
    legible = 0 if isinstance(read, Failure) else sum(map(bool, read.decoded))
    found = measured("field", view)
    text = f"declined: {found.reason}" if isinstance(found, Failure) else ""
    if not isinstance(found, Failure):
        error, scaled, count_in, inside, _ = found
        text = f"{count_in} of {inside} targets, rms {np.sqrt((error**2).mean()):.4f} px, "
        text += f"error/sigma {np.sqrt((scaled**2).mean()):.2f}"
    return f"{wide:.0f} x {high:.0f} px, {legible} of {lines**2} squares legible with known lines: {text}"


def sizes(executor: Executor, field: Printed, count: int) -> None:
    """Measure testfields of decreasing size."""
    every = product((0.5, 0.45, 0.4, 0.36, 0.33, 0.3, 0.26, 0.22), range(count))
    for text in outcomes(executor, partial(of_size, field), every):
        print(text, flush=True)


def large() -> None:
    """Measure a sheet of 13 × 17 disks in a picture of 5184 × 3888 pixels, seen obliquely."""
    sheet, (h, w) = coded(13, 17), (3888, 5184)
    (left, bottom), (right, top) = sheet.xy.min(axis=0) - 20, sheet.xy.max(axis=0) + 20
    corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]], np.float32)
    on_image = np.array([[500, 300], [4700, 500], [4400, 3500], [300, 3300]], np.float32)
    to_image = cv2.getPerspectiveTransform(corners, on_image).astype(float)
    back, grey = np.linalg.inv(to_image), np.empty((h, w), np.float32)
    for top_row in range(0, h, 216):  # 216 rows at a time
        x, y = np.meshgrid(np.arange(w), np.arange(top_row, top_row + 216))
        plane = np.stack([x, y, np.ones_like(x)], axis=-1) @ back.T
        share = np.clip(0.5 + 12 * sheet.inside(*np.moveaxis(plane[..., :2] / plane[..., 2:], 2, 0)), 0, 1)
        grey[top_row : top_row + 216] = 200 - 150 * share
    grey = cv2.GaussianBlur(grey, (0, 0), 1.0)
    grey += np.random.default_rng(0).standard_normal(grey.shape, np.float32) * 2
    frame = Frame(np.clip(np.rint(grey), 0, 255).astype(np.uint8), 255.0)
    truth = np.column_stack([sheet.xy, np.ones(len(sheet.xy))]) @ to_image.T
    del grey, plane, share
    design = ReseauDesign.parse(json.dumps(sheet.design()), where="sheet")
    before = _resident_mb()
    seconds = []
    for _ in range(3):  # the first loads the compiler and its kernels
        start = time.process_time()
        found = measure_reseau(frame, design)
        seconds.append(time.process_time() - start)
    if isinstance(found, Failure):
        print(f"declined: {found.reason}")
        return
    error = (found.xy - truth[:, :2] / truth[:, 2:])[found.ok]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{w} x {h} pixels: {found.found} of {len(sheet.xy)} disks, rms {np.sqrt((error**2).mean()):.4f} px, "
        f"processor time {seconds[0]:.2f} s in a new process, then {min(seconds[1:]):.2f} s, "
        f"memory {before:.0f} MB before, at most {peak:.0f} MB"
    )


def _resident_mb() -> float:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--target", choices=("sheet", "field"), default="sheet")
    parser.add_argument("--count", type=int, default=3)
    parser.add_argument("--condition", nargs="*", default=list(CONDITIONS))
    parser.add_argument("--sizes", action="store_true", help="only testfields of decreasing size")
    parser.add_argument("--large", action="store_true", help="only time and memory for 20 megapixels")
    add_options(parser)
    arguments = parser.parse_args()
    if arguments.large:
        large()
        return
    with executor_of(arguments) as executor:
        if arguments.sizes:
            sizes(executor, Field(json.loads(coded_testfield().to_json())), arguments.count)
        else:
            conditions(executor, arguments.target, arguments.condition, arguments.count)


def conditions(executor: Executor, target: str, names: list[str], count: int) -> None:
    """Print a row for each condition."""
    sheet = coded() if target == "sheet" else Field(json.loads(coded_testfield().to_json()))
    print(f"{'condition':12} {'measured':>14}  rms     worst px, sigma  wrong  error/sigma  processor time")
    for condition in names:
        parts = []
        for found in outcomes(executor, partial(measured, target), views(condition, count, sheet)):
            if isinstance(found, Failure):
                print(f"{condition:12} declined: {found.reason}")
            else:
                parts.append(found)
        if not parts:
            continue
        error, scaled = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
        off, sigmas = np.hypot(*error.T), np.hypot(*scaled.T)
        wrong = int(((off > _WRONG_PX) & (sigmas > _WRONG_SIGMA)).sum())
        known, inside = (sum(part[k] for part in parts) for k in (2, 3))
        print(
            f"{condition:12} {known:5} of {inside:5}  {np.sqrt((error**2).mean()):.4f}  {off.max():.3f}  "
            f"{sigmas.max():5.1f}      {wrong:5}  {np.sqrt((scaled**2).mean()):11.2f}  "
            f"{np.mean([part[4] for part in parts]):.2f} s",
            flush=True,
        )


if __name__ == "__main__":
    main_of(__file__)
