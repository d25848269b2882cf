"""Marks in frames of other programs: errors compared with the Cramér–Rao bound and with their sigmas.

Run from the checkout: ``RESEAU_DATA=… python benchmarks/reseau_independent.py [--part data|worlds|compressed]
[--kind K] [--count N]``. `data` measures the frames in ``independent/marks`` and the crossings of
``independent/oscilloscope``; `worlds` draws N sheets of each kind with ``benchmarks/worlds/marks.py``, which
shares no formation of images with the project: crosses, disks and short crossings of three contrasts in one
frame, and wires at any rotation with slopes to 0.1. The bound is that of position, contrast, background and
blur, in own sheets, whose background slopes, also of its slopes. `compressed` measures JPEG copies of such
sheets, one for each quality: their errors compared with their sigmas. The exit status is 1 where a figure is
beyond its limit.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from worlds.marks import Sheet, write

from reseau.core.data import Array
from reseau.core.failure import Failure
from reseau.io import ReseauDesign
from reseau.io.images import read_image
from reseau.measure import measure_reseau

QUALITIES = (90, 60, 30, 10, 3)
KINDS = ("cross", "disk", "line-grid", "wires")
MOST_RATIO, MOST_OF_FILE, NORMALISED = 1.05, 1.12, (0.85, 1.15)
"""Largest ratio of errors to their bound, of 2000 marks and of one frame; limits of errors ÷ sigmas."""
FEWEST, WRONG = 0.98, 5.0
"""Least share of the marks that is measured; multiple of its sigma from which a coordinate is wrong."""
COMPRESSED = 1.3
"""Largest errors ÷ sigmas of what is measured after compression; where detail is lost, marks are declined."""


def measured(image: Path, design: Path, ids: list[str]) -> tuple[Array, Array, Array] | str:
    """Positions, sigmas and which were measured, of the marks `ids`; or why there are none."""
    found = measure_reseau(read_image(image), ReseauDesign.read(design))
    if isinstance(found, Failure):
        return found.reason
    rows = [found.ids.index(name) for name in ids]
    sigma = np.sqrt(np.diagonal(found.cov[rows], axis1=1, axis2=2))
    return found.xy[rows], sigma, found.ok[rows]


def marks_of(folder: Path, bounds: str = "crlb") -> Iterator[tuple[str, Any]]:
    """Name, and errors, sigmas, bounds (n, 2) of the measured marks and the number of all, of each frame."""
    for path in sorted(folder.glob("*.truth.json")):
        name = path.name.removesuffix(".truth.json")
        truth = json.loads(path.read_text())
        seen = measured(folder / f"{name}.png", folder / f"{name}.design.json", truth["id"])
        if isinstance(seen, str):
            yield name, seen
            continue
        xy, sigma, ok = seen
        bound = np.stack([truth[bounds]["sigma_x"], truth[bounds]["sigma_y"]], axis=1)
        error = xy - np.stack([truth["x"], truth["y"]], axis=1)
        yield name, (error[ok], sigma[ok], bound[ok], len(ok))


def crossings_of(folder: Path) -> Iterator[tuple[str, Any]]:
    """The same for the crossings of oscilloscope photographs, whose bound is not known."""
    for path in sorted(folder.glob("*.truth.json")):
        name = path.name.removesuffix(".truth.json")
        truth = json.loads(path.read_text())
        for number, photo in enumerate(("I", "II", "III"), start=1):
            image = folder / f"{name}.photo{number}.png"
            seen = measured(image, folder / f"{name}.reseau.design.json", truth["reseau"]["id"])
            if isinstance(seen, str):
                yield f"{name} {photo}", seen
                continue
            xy, sigma, ok = seen
            at = truth["photos"][photo]["crossings"]
            error = xy - np.stack([at["x"], at["y"]], axis=1)
            yield f"{name} {photo}", (error[ok], sigma[ok], None, len(ok))


def line(name: str, parts: list[Any], ratio_to: float = MOST_RATIO, coded: bool = False) -> bool:
    """Print a row of the table; whether its figures are within their limits."""
    whole = [np.concatenate([part[k] for part in parts]) for k in (0, 1)]
    error, sigma = whole
    rms, scaled = np.sqrt((error**2).mean()), np.sqrt(((error / sigma) ** 2).mean())
    ratio, good = "", scaled <= COMPRESSED if coded else NORMALISED[0] <= scaled <= NORMALISED[1]
    if parts[0][2] is not None:
        over = np.sqrt(((error / np.concatenate([part[2] for part in parts])) ** 2).mean())
        ratio, good = f"{over:.3f}", good and over <= ratio_to
    worst = np.abs(error / sigma).max()
    all_marks = sum(part[3] for part in parts)
    good &= bool(worst <= WRONG) and (coded or len(error) >= FEWEST * all_marks)
    print(
        f"{name:24} {len(error):5} of {all_marks:5}  {rms:.4f} px  {ratio:>6}  {scaled:.3f}  {worst:.1f}"
        f"{'' if good else '  MISSED'}",
        flush=True,
    )
    return good


def table(title: str, frames: Iterator[tuple[str, Any]], each: bool = True, coded: bool = False) -> bool:
    """Measure frames and print their rows and that of all; whether all are within their limits."""
    parts, good = [], True
    for name, found in frames:
        if isinstance(found, str):
            print(f"{name:24} {found}")
            good &= coded
            continue
        parts.append(found)
        if each:
            # Some 200 marks: errors ÷ sigmas are known to 5 per cent.
            good &= line(name, [found], MOST_OF_FILE)
    return (line(title, parts, coded=coded) if parts else coded) and good


def compressed(folder: Path, quality: int) -> Iterator[tuple[str, Any]]:
    """Results of the frames of a folder after compression with JPEG; the bound no longer holds."""
    with tempfile.TemporaryDirectory() as name:
        copies = Path(name)
        for path in folder.iterdir():
            if path.suffix == ".png":
                frame = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
                if frame.dtype == np.uint16:  # 64 numbers per grey level
                    frame = np.rint(frame / 64).astype(np.uint8)
                cv2.imwrite(str(copies / path.stem) + ".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])
                coded = cv2.imread(str(copies / path.stem) + ".jpg", cv2.IMREAD_GRAYSCALE)
                cv2.imwrite(str(copies / path.name), coded)
            elif path.suffix == ".json":
                (copies / path.name).write_bytes(path.read_bytes())
        for name, found in marks_of(copies):
            yield name, found if isinstance(found, str) else (*found[:2], None, found[3])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--part", choices=("data", "worlds", "compressed"))
    parser.add_argument("--kind", choices=KINDS)
    parser.add_argument("--count", type=int, default=11, help="sheets of each kind")
    options = parser.parse_args()
    print(f"{'':24} {'measured':>14}  {'rms':9}  /bound  error/sigma  worst")
    good = True
    if options.part in (None, "data"):
        root = os.environ.get("RESEAU_DATA")
        if root is None:
            print("RESEAU_DATA is not set: the frames of other programs are not measured")
            good = options.part is None
        else:
            independent = Path(root) / "independent"
            good &= table("all marks", marks_of(independent / "marks"))
            good &= table("all crossings", crossings_of(independent / "oscilloscope"))
    if options.part in (None, "worlds"):
        for kind in KINDS if options.kind is None else (options.kind,):
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                for seed in range(options.count):
                    write(
                        folder, f"{kind}-{seed:02}", Sheet.drawn_from(kind, np.random.default_rng(seed)), seed
                    )
                good &= table(f"{kind}, own worlds", marks_of(folder, "crlb_slopes"), each=False)
    if options.part in (None, "compressed"):
        for kind in KINDS if options.kind is None else (options.kind,):
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                write(folder, kind, Sheet.drawn_from(kind, np.random.default_rng(0)), 0)
                for quality in QUALITIES:
                    good &= table(f"{kind}, quality {quality}", compressed(folder, quality), False, True)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
