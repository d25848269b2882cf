"""Fiducial marks in photographs that another renderer drew: errors compared with their sigmas.

Run from the checkout: ``python benchmarks/fiducials.py [--count N] [--kind K] [--learn] [--keep FOLDER]``.
The photographs of ``benchmarks/worlds/fiducials.py`` share no formation of images with the project. Reported
for each kind: photographs declined, marks measured, rms of the errors in pixels, errors over their sigmas (1
is right), wrong marks (beyond 5 sigma and 0.15 px), and orientations and negatives that are wrong without a
remark. With ``--learn`` marks are learnt from one photograph of a camera, each kind from one place that is
given to the pixel, and measured in another one.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from figures import record
from parts import add_options, executor_of, main_of, outcomes
from worlds.fiducials import KINDS, OLDER, SHAPES, photograph, write

from reseau.core.failure import Code, Failure
from reseau.io import FiducialDesign
from reseau.io.images import open_scan
from reseau.measure.fiducials import learn_marks, measure_fiducials
from reseau.measure.fiducials.forms import margin_of, reach_of
from reseau.measure.fiducials.measure import FiducialOptions

WRONG_PX, WRONG_SIGMA = 0.15, 5.0


def drawn_and_assessed(job: tuple[str, int, Path, bool, bool, bool]) -> tuple[str, dict[str, object]]:
    """Name and errors of a photograph of a kind and number, drawn into a folder unless it is there."""
    kind, seed, folder, learn, keep, verbose = job
    frames = (0, 1) if learn else (None,)
    images = [drawn(kind, seed, folder, frame) for frame in frames]
    design = learnt(images[0], verbose) if learn else design_of(images[-1])
    if isinstance(design, Failure):
        found: dict[str, object] = {"declined": design.reason, "seconds": 0.0, "marks": 0}
    else:
        found = assessed(images[-1], design, verbose)
    if not keep:
        for image in images:
            image.unlink()
    return images[-1].name, found


def drawn(kind: str, seed: int, folder: Path, frame: int | None) -> Path:
    """The image of a photograph, which is drawn unless it is there."""
    name = f"{kind}_{seed}" if frame is None else f"{kind}_{seed}_{frame}"
    there = [p for p in folder.glob(f"{name}.*") if p.suffix in (".tif", ".jpg")]
    return there[0] if there else write(folder, name, photograph(kind, seed, frame=frame))


def design_of(image: Path) -> FiducialDesign:
    """What a calibration report states of the camera of a photograph."""
    return FiducialDesign.read(image.with_name(f"{image.name.split('.')[0]}.design.json"))


def truth_of(image: Path) -> dict[str, Any]:
    """What was drawn."""
    found: dict[str, Any] = json.loads(image.with_name(f"{image.name.split('.')[0]}.truth.json").read_text())
    return found


def learnt(image: Path, verbose: bool) -> FiducialDesign | Failure:
    """The camera of a photograph with marks learnt from it; three marks, one of each kind, are placed."""
    design, truth = design_of(image), truth_of(image)
    marks = {point.mark: point.id for point in reversed(design.points)}
    names = [*marks.values(), *(point.id for point in design.points[:3])]
    places = {name: tuple(np.rint(truth["xy"][design.ids.index(name)]).tolist()) for name in names}
    reach = max(reach_of(mark) + margin_of(mark) for mark in design.marks.values())
    found = learn_marks(open_scan(image), design, places, 2 * reach * truth["px_per_mm"])
    if verbose and not isinstance(found, Failure):
        print("   ", image.name, *found.lines(), sep="\n      ")
    return found if isinstance(found, Failure) else found.design


def assessed(image: Path, design: FiducialDesign, verbose: bool) -> dict[str, object]:
    """Errors and sigmas (m, 2) of one photograph, or why it was declined."""
    truth = truth_of(image)
    start = time.process_time()
    found = measure_fiducials(open_scan(image), design, FiducialOptions())
    seconds = time.process_time() - start
    if isinstance(found, Failure):
        return {"declined": found.reason, "seconds": seconds, "marks": len(truth["ids"])}
    right = (found.attitude.rotation, found.attitude.mirrored) == (truth["rotation_deg"], truth["mirrored"])
    if not any(mark.learnt for mark in design.marks.values()):
        right = right and found.negative == truth["negative"]
    ambiguous = any(note.code is Code.AMBIGUOUS for note in found.notes)
    places = np.array(truth["xy"])
    if not right:  # which mark is which is another question: compare places
        nearest = np.hypot(*(found.xy[:, None] - places[None]).transpose(2, 0, 1))
        nearest = np.where(np.isfinite(nearest), nearest, np.inf).argmin(axis=1)
        places = places[nearest]
    error = (found.xy - places)[found.ok]
    sigma = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))[found.ok]
    if verbose:
        print("   ", image.name)
        for i, (e, s) in enumerate(zip(error, sigma, strict=True)):
            print(
                f"      {found.points.names[i]}: {e.round(3)} sigma {s.round(3)}",
                found.likeness[found.ok][i].round(2),
            )
        print("     ", found.attitude, [str(n) for n in found.notes], [w for w in found.why if w])
    return {
        "error": error,
        "sigma": sigma,
        "right": right,
        "ambiguous": ambiguous,
        "seconds": seconds,
        "marks": len(truth["ids"]),
    }


def main() -> None:
    """Measure photographs of every kind and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--kind", choices=(*KINDS, "older", "shapes"), action="append")
    parser.add_argument("--learn", action="store_true", help="learn the marks from another photograph")
    parser.add_argument("--keep", type=Path, help="folder with photographs; missing ones are drawn")
    parser.add_argument("--verbose", action="store_true")
    add_options(parser)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch, executor_of(given) as executor:
        folder = given.keep or Path(scratch)
        print("kind      photos declined  marks  rms px  err/sigma  wrong  silent turns   s")
        every: list[dict[str, object]] = []
        groups = {"older": OLDER, "shapes": SHAPES}
        for kind in [kind for name in given.kind or KINDS for kind in groups.get(name, (name,))]:
            seeds = range(given.first, given.first + given.count)
            keep, verbose = given.keep is not None, given.verbose
            jobs = ((kind, seed, folder, given.learn, keep, verbose) for seed in seeds)
            done = []
            for name, found in outcomes(executor, drawn_and_assessed, jobs):
                done.append(found)
                if "declined" in found:
                    print(f"  {name}: {found['declined']}")
            print(line(kind, done), flush=True)
            every += done
        print(line("all", every))


def line(name: str, done: list[dict[str, object]]) -> str:
    """One line of the table."""
    good = [d for d in done if "error" in d]
    marks = sum(int(d["marks"]) for d in done)  # type: ignore[call-overload]
    seconds = float(np.mean([d["seconds"] for d in done]))  # type: ignore[arg-type]
    if not good:
        record(name, "marks", 0, of=marks)
        return f"{name:10}{len(done):6}{len(done):9}{'0/' + str(marks):>9}{'':40}{seconds:5.1f}"
    e, s = (np.concatenate([d[key] for d in good]) for key in ("error", "sigma"))  # type: ignore[misc]
    wrong = int(((np.abs(e) > WRONG_PX) & (np.abs(e) > WRONG_SIGMA * s)).any(axis=1).sum())
    silent = sum(not d["right"] and not d["ambiguous"] for d in good)
    rms, ratio = np.sqrt((e**2).mean()), np.sqrt(((e / s) ** 2).mean())
    record(name, "marks", len(e), of=marks)
    record(name, "wrong", wrong)
    record(name, "rms", rms, "px")
    record(name, "errors ÷ sigmas", ratio)
    record(name, "wrong orientations without a note", silent)
    return (
        f"{name:10}{len(done):6}{len(done) - len(good):9}{f'{len(e)}/{marks}':>9}{rms:8.3f}{ratio:10.2f}"
        f"{wrong:8}{silent:9}{seconds:9.1f}"
    )


if __name__ == "__main__":
    main_of(__file__)
