"""Marks in frames of other programs: errors compared with the Cramér–Rao bound and with their sigmas.

Run from the checkout: ``RESEAU_DATA=… python benchmarks/reseau_independent.py [--part data|worlds|compressed]
[--kind K] [--count N] [--jobs N]``. `data` measures the frames in ``independent/marks`` and the crossings of
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
import tempfile
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from figures import ORIGIN, record
from parts import add_options, executor_of, main_of, outcomes
from worlds.marks import Sheet, write

from reseau.core.data import Array
from reseau.core.failure import Failure
from reseau.execution import Executor
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


def marks_of(executor: Executor, folder: Path, bounds: str = "crlb") -> Iterator[tuple[str, Any]]:
    """Name, and errors, sigmas, bounds (n, 2) of the measured marks and the number of all, of each frame."""
    return outcomes(executor, partial(in_frame, bounds), sorted(folder.resolve().glob("*.truth.json")))


def in_frame(bounds: str, path: Path) -> tuple[str, Any]:
    """The same of the frame whose truth is in a file."""
    name, truth = path.name.removesuffix(".truth.json"), json.loads(path.read_text())
    seen = measured(path.with_name(f"{name}.png"), path.with_name(f"{name}.design.json"), truth["id"])
    if isinstance(seen, str):
        return name, seen
    xy, sigma, ok = seen
    bound = np.stack([truth[bounds]["sigma_x"], truth[bounds]["sigma_y"]], axis=1)
    error = xy - np.stack([truth["x"], truth["y"]], axis=1)
    return name, (error[ok], sigma[ok], bound[ok], len(ok))


def crossings_of(executor: Executor, folder: Path) -> Iterator[tuple[str, Any]]:
    """The same for the crossings of oscilloscope photographs, whose bound is not known."""
    paths = sorted(folder.resolve().glob("*.truth.json"))
    return outcomes(executor, in_photograph, [(path, number) for path in paths for number in (1, 2, 3)])


def in_photograph(job: tuple[Path, int]) -> tuple[str, Any]:
    """The same of one of the three photographs of a set."""
    (path, number), photo = job, "I" * job[1]
    name, truth = path.name.removesuffix(".truth.json"), json.loads(path.read_text())
    image, design = (
        path.with_name(f"{name}.{rest}") for rest in (f"photo{number}.png", "reseau.design.json")
    )
    seen = measured(image, design, truth["reseau"]["id"])
    if isinstance(seen, str):
        return f"{name} {photo}", seen
    xy, sigma, ok = seen
    at = truth["photos"][photo]["crossings"]
    error = xy - np.stack([at["x"], at["y"]], axis=1)
    return f"{name} {photo}", (error[ok], sigma[ok], None, len(ok))


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
    record(name, "measured", len(error), of=all_marks)
    record(name, "rms", rms, "px")
    record(name, "rms ÷ bound", float(ratio or "nan"))
    record(name, "errors ÷ sigmas", scaled)
    record(name, "largest error", worst, "sigma")
    good &= bool(worst <= WRONG) and (coded or len(error) >= FEWEST * all_marks)
    print(
        f"{name:24} {len(error):5} of {all_marks:5}  {rms:.4f} px  {ratio:>6}  {scaled:.3f}  {worst:.1f}"
        f"{'' if good else '  MISSED'}",
        flush=True,
    )
    return good


def table(title: str, frames: Iterable[tuple[str, Any]], each: bool = True, coded: bool = False) -> bool:
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
    if each and parts:
        what = f"{title.removeprefix('all ')} of a reseau"
        counts = sum(len(part[0]) for part in parts), sum(part[3] for part in parts)
        record(what, "independent, found", counts[0], of=counts[1], table=ORIGIN)
        ratios = [np.sqrt(((part[0] / part[1]) ** 2).mean()) for part in parts]
        record(what, "independent, errors ÷ sigmas", ratios, table=ORIGIN)
    return (line(title, parts, coded=coded) if parts else coded) and good


def compressed(executor: Executor, folder: Path, quality: int) -> Iterator[tuple[str, Any]]:
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
        for name, found in marks_of(executor, copies):
            yield name, found if isinstance(found, str) else (*found[:2], None, found[3])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--part", choices=("data", "worlds", "compressed"))
    parser.add_argument("--kind", choices=KINDS)
    parser.add_argument("--count", type=int, default=11, help="sheets of each kind")
    add_options(parser)
    options = parser.parse_args()
    print(f"{'':24} {'measured':>14}  {'rms':9}  /bound  error/sigma  worst")
    with executor_of(options) as executor:
        return 0 if chosen(executor, options) else 1


def chosen(executor: Executor, options: argparse.Namespace) -> bool:
    """Do what the options ask for; whether all is within its limits."""
    good = True
    if options.part in (None, "data"):
        root = os.environ.get("RESEAU_DATA")
        if root is None:
            print("RESEAU_DATA is not set: the frames of other programs are not measured")
            good = options.part is None
        else:
            independent = Path(root) / "independent"
            good &= table("all marks", marks_of(executor, independent / "marks"))
            good &= table("all crossings", crossings_of(executor, independent / "oscilloscope"))
    for kind in KINDS if options.kind is None else (options.kind,):
        if options.part in (None, "worlds"):
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                list(outcomes(executor, partial(drawn, folder, kind), range(options.count)))
                frames = marks_of(executor, folder, "crlb_slopes")
                good &= table(f"{kind}, own worlds", frames, each=False)
    for kind in KINDS if options.kind is None else (options.kind,):
        if options.part in (None, "compressed"):
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                write(folder, kind, Sheet.drawn_from(kind, np.random.default_rng(0)), 0)
                for quality in QUALITIES:
                    frames = compressed(executor, folder, quality)
                    good &= table(f"{kind}, quality {quality}", frames, False, True)
    return good


def drawn(folder: Path, kind: str, seed: int) -> None:
    """Draw a sheet of a kind into a folder."""
    write(folder, f"{kind}-{seed:02}", Sheet.drawn_from(kind, np.random.default_rng(seed)), seed)


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
