"""Testfield and sheet in pictures of another program: what is found, errors, sigmas and processor time.

Run from the checkout: ``RESEAU_DATA=… python benchmarks/boards.py [--target tf|sheet] [--data FOLDER]
[--condition C …] [--each] [--others] [--squares] [--worlds N]``. The pictures of ``independent/boards``
share neither the camera nor the formation of pixels with the project. Poses are pooled; with ``--each``
every picture has its own row. ``--others`` also measures the pictures of all other targets with the design:
they must be declined. ``--squares`` cuts single squares with their lines from the pictures of the testfield,
and measures each. ``--worlds`` draws and measures N sets of 15 views, near and wide to 65° and k1 to -0.3,
with ``benchmarks/worlds/boards.py``, and compares the errors with their Cramér–Rao bound (contrast,
background and blur of every target unknown). ``--calibrate`` draws 12 views of the testfield for each of
``--seeds`` 20, calibrates the camera as ``reseau calibrate`` does with its defaults, and compares the errors
of its parameters with their sigmas. ``--keep FOLDER`` keeps the pictures of the calibrations for the next
run.

A target counts as inside where its whole image, and two pixels more, lies in the picture and nothing hides
it. Wrong is a position in error by more than 0.15 px and 5 sigma.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from figures import ORIGIN, record
from parts import add_options, executor_of, main_of, outcomes, timed
from worlds.boards import OPENCV, bounds, picture, poses

from reseau.core.data import Array, Frame, ImagePoints, Mask
from reseau.core.failure import Failure
from reseau.execution import Executor
from reseau.io import parse_design
from reseau.io.images import read_image
from reseau.measure import measure_reseau, measure_testfield
from reseau.measure.reseau.marks import ReseauOptions
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.target_measurement import measurer_of

DESIGNS = {"tf": "testfield.design.json", "sheet": "sheet.design.json"}
DECLINED = {"defoc3", "mirror"}
"""Conditions in which declining is right; those mirrored are measured with the design from behind, too."""
ROUGH = {"jpeg60", "sharpened", "motion3", "motion6", "specular"}
MARGIN_PX, LEAST_FOUND, WRONG_PX, WRONG_SIGMA = 2.0, 0.95, 0.15, 5.0
NORMALISED, NORMALISED_ROUGH = (0.85, 1.2), (0.7, 1.25)
SQUARE_MARGIN_PX = 8
BOUND_EACH = 16
"""One in so many targets is compared with its Cramér–Rao bound."""
LABELS = {"tn": "near", "td": "near, distorted"}

PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
VIEWS, CALIBRATED = 12, (0.9, 1.15)
"""Number of pictures of a calibration, and limits of the normalised errors of all parameters together."""

Measure = Callable[[Frame], Any]


@dataclass(frozen=True, eq=False)
class Measured:
    """Errors and sigmas (n, 2) of the measured points `ok` of a picture, and counts."""

    error: Array
    sigma: Array
    ok: Mask
    inside: int
    found: int
    seconds: float


def measurers(target: str, design: Any) -> tuple[Measure, Measure]:
    """Functions that measure the target, from the front and from behind."""
    behind = design.from_behind()
    if target == "tf":
        return partial(measure_testfield, design=design), partial(measure_testfield, design=behind)
    options = ReseauOptions(mirrored=True)
    return partial(measure_reseau, design=design), partial(measure_reseau, design=behind, options=options)


def reaches(target: str, design: Any, xy: Array) -> Array:
    """Half the width and height (n, 2) of the targets in the image, from a projectivity through the truth."""
    found: Any = cv2.findHomography(design.xy, xy)[0]
    depth = np.column_stack([design.xy, np.ones(len(xy))]) @ found[2]
    ends = [np.column_stack([design.xy + d, np.ones(len(xy))]) @ found.T for d in np.eye(2)]
    image = np.column_stack([design.xy, np.ones(len(xy))]) @ found.T / depth[:, None]
    slope = np.stack([end[:, :2] / end[:, 2:] - image[:, :2] for end in ends], axis=2)
    size = np.array(design.targets.size) if target == "tf" else np.full(len(xy), design.mark.size)
    reach: Array = np.abs(slope).sum(axis=2) * size[:, None] * (0.6 if target == "tf" else 0.5)
    return reach


def measured(frame: Frame, measure: Measure, xy: Array, whole: Mask) -> Measured | str:
    """Errors of a picture, or why it was declined or what was raised."""
    gc.collect()
    try:
        found, seconds = timed(partial(measure, frame), "boards")
    except Exception as raised:  # whatever is raised is a finding
        return f"RAISED {type(raised).__name__}: {str(raised).splitlines()[-1][:80]}"
    if isinstance(found, Failure):
        return f"declined: {found.reason} [{found.code}] ({seconds:.2f} s)"
    sigma = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))[found.ok]
    error = (found.xy - xy)[found.ok]
    return Measured(error, sigma, found.ok, int(whole.sum()), int((found.ok & whole).sum()), seconds)


def pictures(folder: Path, target: str) -> Iterator[tuple[str, str, Any]]:
    """Name of each picture of a target, its condition, and its truth."""
    for name, truth in sorted(json.loads((folder / "truth.json").read_text()).items()):
        if truth.get("target", truth.get("kind")) == target and (folder / name).is_file():
            yield name, truth.get("condition") or LABELS.get(name[:2], name[:2]), truth


def line(name: str, done: list[Measured], rough: bool, title: str = "") -> bool:
    """Print a row of the table `title`; whether it is within its limits."""
    error, sigma = (np.concatenate([getattr(part, k) for part in done]) for k in ("error", "sigma"))
    inside, found = sum(part.inside for part in done), sum(part.found for part in done)
    seconds = sum(part.seconds for part in done) / len(done)
    if not len(error):
        print(f"{name:26} {found:5} of {inside:5}", flush=True)
        return False
    off, scaled = np.hypot(*error.T), np.abs(error / sigma).max(axis=1)
    wrong = int(((off > WRONG_PX) & (scaled > WRONG_SIGMA)).sum())
    ratio = float(np.sqrt(((error / sigma) ** 2).mean()))
    low, high = NORMALISED_ROUGH if rough else NORMALISED
    good = found >= LEAST_FOUND * inside and not wrong and low <= ratio <= high
    record(name, "found", found, of=inside, table=title)
    record(name, "rms", np.sqrt((error**2).mean()), "px", table=title)
    record(name, "errors ÷ sigmas", ratio, table=title)
    record(name, "wrong", wrong, table=title)
    record(name, "processor time", [part.seconds for part in done], "s", table=title)
    print(
        f"{name:26} {found:5} of {inside:5}  {np.sqrt((error**2).mean()):.4f}  {off.max():.3f} px "
        f"{scaled.max():5.1f}  {wrong:5}  {ratio:11.3f}  {seconds:6.2f} s  {'ok' if good else 'MISSED'}",
        flush=True,
    )
    return good


def in_picture(
    folder: Path, target: str, design: Any, picture: tuple[str, str, Any]
) -> list[tuple[str, Measured | str]]:
    """What is measured in a picture, from the front, and where it is mirrored, from behind."""
    name, condition, truth = picture
    front, behind = measurers(target, design)
    frame, xy = read_image(folder / name), np.array(truth["xy"])
    hidden = np.array(truth.get("hidden", truth.get("hid")) or np.zeros(len(xy))) > 0
    size = np.array([frame.width, frame.height])
    edge = reaches(target, design, xy) + MARGIN_PX
    whole = ((xy > edge - 0.5) & (xy < size - 0.5 - edge)).all(axis=1) & ~hidden
    ways = [(condition, front)] + [("mirrored", behind)] * (condition == "mirror")
    return [(label, measured(frame, measure, xy, whole)) for label, measure in ways]


def table(
    executor: Executor, folder: Path, target: str, design: Any, conditions: list[str], each: bool
) -> bool:
    """Measure the pictures of a target and print a row for each condition."""
    parts: dict[str, list[Measured]] = {}
    good = True
    print(f"{target:26} {'measured':>14}  {'rms':6}  {'worst':8} {'sigma':>5}  wrong  error/sigma")
    chosen = [one for one in pictures(folder, target) if not conditions or one[1] in conditions]
    done = outcomes(executor, partial(in_picture, folder, target, design), chosen)
    for (name, _, _), labelled in zip(chosen, done, strict=True):
        for label, found in labelled:
            if isinstance(found, str):
                right = label in DECLINED and found.startswith("declined")
                good &= right
                print(f"{name:26} {found}  {'ok' if right else 'MISSED'}", flush=True)
                continue
            parts.setdefault(label, []).append(found)
            if each:
                line(name, [found], label in ROUGH)
    for label, several in parts.items():
        good &= line(label, several, label in ROUGH, target)
    every = [part for several in parts.values() for part in several]
    what = {"tf": "coded testfield", "sheet": "sheet of disks"}[target]
    found, inside = sum(part.found for part in every), sum(part.inside for part in every)
    record(what, "independent, found", found, of=inside, table=ORIGIN)
    ratios = [
        np.sqrt(np.mean(np.concatenate([(part.error / part.sigma).ravel() for part in several]) ** 2))
        for several in parts.values()
    ]
    record(what, "independent, errors ÷ sigmas", ratios, table=ORIGIN)
    return good


def in_squares(folder: Path, design: Any, picture: tuple[str, str, Any]) -> list[Measured | str]:
    """What is measured in every square that lies in a picture with its four lines, cut out with a margin."""
    name, _, truth = picture
    front, _ = measurers("tf", design)
    of, found = np.array(design.targets.square), []
    frame, xy = read_image(folder / name), np.array(truth["xy"])
    to_image: Any = cv2.findHomography(design.xy, xy)[0]
    for number in np.unique(of):
        ends = design.centres[number - 1] + design.pitch / 2 * np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
        corners = cv2.perspectiveTransform(ends[None].astype(np.float64), to_image)[0]
        low = np.floor(corners.min(axis=0)).astype(int) - SQUARE_MARGIN_PX
        high = np.ceil(corners.max(axis=0)).astype(int) + SQUARE_MARGIN_PX + 1
        if (low < 0).any() or (high > [frame.width, frame.height]).any():
            continue
        part = replace(frame, pixels=frame.pixels[low[1] : high[1], low[0] : high[0]])
        found.append(measured(part, front, xy - low, of == number))
    return found


def squares(executor: Executor, folder: Path, design: Any, conditions: list[str]) -> bool:
    """Measure single squares of the testfield, and print a row for each picture."""
    good = True
    print(f"{'one square with its lines':26} {'read':>10}")
    chosen = [one for one in pictures(folder, "tf") if one[1] in (conditions or ["clean"])]
    done = outcomes(executor, partial(in_squares, folder, design), chosen)
    for (name, _, _), found in zip(chosen, done, strict=True):
        parts = [one for one in found if isinstance(one, Measured)]
        misnumbered = sum(int((np.hypot(*one.error.T) > 2).sum()) for one in parts)
        good &= not any(isinstance(one, str) and one.startswith("RAISED") for one in found)
        print(f"{name:26} {len(parts):3} of {len(found):3}, {misnumbered} misnumbered")
        good &= line(name, parts, rough=False) and not misnumbered if parts else False
    return good


def in_other(folder: Path, target: str, design: Any, name: str) -> Measured | str:
    """What is measured in a picture of another target: nothing, if all is well."""
    front, _ = measurers(target, design)
    none = np.zeros((len(design.xy), 2))
    return measured(read_image(folder / name), front, none, np.zeros(len(none), dtype=bool))


def others(executor: Executor, folder: Path, target: str, design: Any) -> bool:
    """Measure the pictures of all other targets with this design; none may be accepted, none may raise."""
    wrong = 0
    names = sorted(
        n
        for n, t in json.loads((folder / "truth.json").read_text()).items()
        if t.get("target", t.get("kind")) != target
    )
    done = outcomes(executor, partial(in_other, folder, target, design), names)
    for name, found in zip(names, done, strict=True):
        if not isinstance(found, str) or found.startswith("RAISED"):
            wrong += 1
            print(f"{name:26} {found if isinstance(found, str) else f'{len(found.error)} points'}  MISSED")
    print(f"{target}: {len(names)} pictures of other targets, {wrong} not declined")
    return wrong == 0


def in_world(design_path: Path, world: tuple[int, int, float, float]) -> tuple[Measured, Array] | str:
    """What is measured in an own view, and the bounds of some of its targets."""
    seed, k, k1, tilt = world
    contents = json.loads(design_path.read_text())
    measure, _ = measurers("tf", parse_design(design_path.read_text(), design_path))
    camera = replace(OPENCV, k1=k1, k2=0.06 if k1 else 0.0)
    pose = poses(4, 15 * seed + k, 500.0, (tilt - 1, tilt))[(seed + k) % 4]
    pixels, xy = picture(contents, camera, pose, seed=seed)
    whole = ((xy > 10) & (xy < [camera.width - 11, camera.height - 11])).all(axis=1)
    found = measured(Frame(pixels.astype(np.uint8), 255.0), measure, xy, whole)
    if isinstance(found, str):
        return found
    some = np.flatnonzero(found.ok & whole)[seed % BOUND_EACH :: BOUND_EACH]
    ratios = np.stack([found.error[np.cumsum(found.ok)[some] - 1], bounds(contents, camera, pose, some)])
    return found, ratios


def worlds(executor: Executor, design_path: Path, count: int) -> bool:
    """Measure views of the testfield drawn by ``benchmarks/worlds/boards.py``, near and wide.

    The tilt is 29 to 65 degrees, and k1 is 0 to -0.3.
    """
    parts, good, ratios = [], True, []
    drawn = list(product((0.0, -0.15, -0.3), (30.0, 53.0, 57.0, 61.0, 65.0)))
    every = [(seed, k, *view) for seed in range(count) for k, view in enumerate(drawn)]
    done = outcomes(executor, partial(in_world, design_path), every)
    for (seed, _, k1, tilt), found in zip(every, done, strict=True):
        name = f"k1 {k1:g}, {tilt:g}°, seed {seed}"
        if isinstance(found, str):
            print(f"{name:26} {found}  MISSED", flush=True)
            good = False
            continue
        line(name, [found[0]], rough=False)
        parts.append(found[0])
        ratios.append(found[1])
    if not parts:
        return False
    error, least = np.concatenate(ratios, axis=1)
    rms, bound = (float(np.sqrt((values**2).mean())) for values in (error, least))
    print(
        f"{len(error)} of the targets: rms {rms:.4f} px, bound {bound:.4f} px, "
        f"errors over their bounds {np.sqrt(((error / least) ** 2).mean()):.3f}"
    )
    return line("own worlds", parts, rough=False) and good


def views(contents: dict[str, Any], seed: int, keep: Path | None) -> Iterator[tuple[Frame, Array]]:
    """Pictures of the testfield for a calibration, with the images of its targets."""
    for k, pose in enumerate(poses(VIEWS, seed, 500.0)):
        name = f"view-{seed:03}-{k:02}.png"
        kept = keep is not None and (keep / name).is_file()
        pixels = cv2.imread(str(keep / name), cv2.IMREAD_GRAYSCALE) if keep and kept else None
        board = np.column_stack([contents["targets"]["x"], contents["targets"]["y"]])
        xy = OPENCV.image(np.column_stack([board, 0 * board[:, 0]]) @ pose.rotation.T + pose.translation)
        if pixels is None:
            pixels = picture(contents, OPENCV, pose, seed=VIEWS * seed + k)[0].astype(np.uint8)
            if keep is not None:
                keep.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(keep / name), pixels)
        yield Frame(np.asarray(pixels), 255.0, name), xy


def normalised(measured: dict[str, ImagePoints], truth: dict[str, Array], ids: tuple[str, ...]) -> Array:
    """Errors (n, 2) of image points of all pictures over their sigmas."""
    row = {name: k for k, name in enumerate(ids)}
    parts = []
    for name, points in measured.items():
        error = points.xy - truth[name][[row[target] for target in points.names]]
        parts.append(error / np.sqrt(np.diagonal(points.cov, axis1=1, axis2=2)))
    return np.concatenate(parts)


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A calibration from own views.

    `scaled` and `white` are the errors of its parameters over their sigmas, and free of their correlations;
    `points` (n, 2) the errors of image points over theirs.
    """

    scaled: Array
    white: Array
    points: Array
    sigma0: float
    seconds: float
    declined: dict[str, str]


def calibrated(design_path: Path, keep: Path | None, seed: int) -> Calibrated | str:
    """Calibrate the camera from own views; or say why it was declined."""
    contents = json.loads(design_path.read_text())
    design = parse_design(design_path.read_text(), design_path)
    true = np.array([getattr(OPENCV, name) for name in PARAMETERS])
    pictured = list(views(contents, seed, keep))
    start = time.process_time()
    done = calibrate_camera([frame for frame, _ in pictured], design, measurer_of(design))
    seconds = time.process_time() - start
    if isinstance(done, Failure):
        return f"{done.reason} [{done.code}]"
    camera = done.cameras["camera"]
    at = [camera.parameters.index(name) for name in PARAMETERS]
    error, cov = camera.values[at] - true, camera.covariance[np.ix_(at, at)]
    return Calibrated(
        error / np.sqrt(np.diag(cov)), np.linalg.solve(np.linalg.cholesky(cov), error),
        normalised(done.measured, {frame.name: xy for frame, xy in pictured}, design.ids),
        done.sigma0, seconds, {name: str(why) for name, why in done.declined.items()},
    )  # fmt: skip


def calibrations(executor: Executor, design_path: Path, seeds: range, keep: Path | None) -> bool:
    """Calibrate the camera from own views, and print the errors of its parameters over their sigmas."""
    scaled, white, good = [], [], True
    print(
        f"calibration {'points':>7} {'error/sigma':>11} {'sigma0':>6}  "
        + " ".join(f"{p:>6}" for p in PARAMETERS)
    )
    every = outcomes(executor, partial(calibrated, design_path, keep), seeds)
    for seed, done in zip(seeds, every, strict=True):
        if isinstance(done, str):
            print(f"seed {seed:<6} {done}  MISSED", flush=True)
            good = False
            continue
        scaled.append(done.scaled)
        white.append(done.white)
        points = done.points
        print(
            f"seed {seed:<6} {len(points):>7} {np.sqrt((points**2).mean()):>11.3f} {done.sigma0:>6.3f}  "
            + " ".join(f"{value:>6.2f}" for value in done.scaled)
            + f"  {done.seconds:.1f} s"
            + "".join(f"  {name}: {why}" for name, why in done.declined.items()),
            flush=True,
        )
    if not scaled:
        return False
    each = np.sqrt((np.array(scaled) ** 2).mean(axis=0))
    ratio, doubt = float(np.sqrt((np.array(scaled) ** 2).mean())), 1 / np.sqrt(2 * np.size(white))
    low, high = CALIBRATED
    good &= low <= ratio <= high
    print(f"{'error/sigma':34}  " + " ".join(f"{value:>6.2f}" for value in each))
    print(
        f"all parameters {ratio:.3f} ± {doubt * ratio:.3f}, free of correlations "
        f"{np.sqrt((np.array(white) ** 2).mean()):.3f}  {'ok' if good else 'MISSED'}"
    )
    return good


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--target", choices=tuple(DESIGNS))
    parser.add_argument("--data", type=Path, help="folder of the pictures")
    parser.add_argument("--condition", nargs="+", default=[], help="only these conditions")
    parser.add_argument("--each", action="store_true", help="a row for every picture")
    parser.add_argument("--others", action="store_true", help="pictures of other targets, too")
    parser.add_argument("--squares", action="store_true", help="only single squares of the testfield")
    parser.add_argument("--worlds", type=int, default=0, help="sets of own views, drawn at 2 s each")
    parser.add_argument("--calibrate", action="store_true", help="calibrate from own views, and nothing else")
    parser.add_argument("--seeds", type=int, default=20, help="number of calibrations")
    parser.add_argument("--first", type=int, default=0, help="seed of the first calibration")
    parser.add_argument("--keep", type=Path, help="folder of the pictures of calibrations")
    add_options(parser)
    options = parser.parse_args()
    root = os.environ.get("RESEAU_DATA")
    folder = options.data or (Path(root) / "independent" / "boards" if root else None)
    if folder is None:
        print("RESEAU_DATA is not set, and --data not given: nothing to measure")
        return 1
    with executor_of(options) as executor:
        return 0 if chosen(executor, options, folder.resolve()) else 1


def chosen(executor: Executor, options: argparse.Namespace, folder: Path) -> bool:
    """Do what the options ask for; whether all is within its limits."""
    field = folder / DESIGNS["tf"]
    if options.calibrate:
        seeds = range(options.first, options.first + options.seeds)
        return calibrations(executor, field, seeds, options.keep)
    if options.squares:
        return squares(executor, folder, parse_design(field.read_text(), field), options.condition)
    good = True
    for target in DESIGNS if options.target is None else (options.target,):
        path = folder / DESIGNS[target]
        design = parse_design(path.read_text(), path)
        good &= table(executor, folder, target, design, options.condition, options.each)
        if options.others:
            good &= others(executor, folder, target, design)
        if target == "tf" and options.worlds:
            good &= worlds(executor, path, options.worlds)
    return good


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
