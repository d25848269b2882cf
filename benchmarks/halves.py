"""Real photographs that others took: halves of each set of photographs beside what their calibrations claim.

Run from the checkout: ``python benchmarks/halves.py [--sets NAME …] [--jobs N] [--model NAME]``. The sets
are listed in ``benchmarks/corpus/sets.toml``, with source, licence and what a person sees in the photographs.
The image coordinates that this project measured are beside it, one table a set, where the licence allows.
Those of other sets are read from the folder $RESEAU_CORPUS: tables ``NAME.csv.gz``, or photographs in folders
``NAME``, which are measured and whose table is then written there; without them these sets are skipped.

All photographs of a set are calibrated as ``reseau calibrate`` does with its defaults, and so is each half,
which chooses a model of its own. Halves are odd and even photographs, and halves by pose: photographs of
similar poses, such as frames of a video, are groups, and whole groups are given to the halves in turn. Two
calibrations are compared as ``reseau compare`` does. The ratio is the difference by the 95 % bound that is
claimed for it, at the centre, and root mean square of the four corners; in a circular image, of the places
nearest to them. Every rms is that of one coordinate. OpenCV calibrates the same points, with the board as
designed, with four and five coefficients: rms, and the largest difference of its halves (odd and even) in
the corners. mrcal (Debian's ``python3-mrcal``) calibrates chessboards and circles with LENSMODEL_OPENCV8:
rms, and the ratios of its halves (odd and even) at the centre and in the corners; its uncertainties contain
shifts of the whole image, which the comparison removes.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import json
import math
import os
import re
import subprocess
import tomllib
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
import scipy.special
from figures import record
from parts import add_options, executor_of, main_of, outcomes
from scipy.cluster.hierarchy import fcluster, leaves_list, linkage

import reseau
from reseau.calibration import CameraMapping, FieldDifference, calibration_difference
from reseau.core.data import Array, ImagePoints
from reseau.core.failure import Failure
from reseau.io import BoardDesign
from reseau.optics import OpenCV
from reseau.optics.poses import rotation_matrix
from reseau.procedures.calibrated import Calibrated
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.calibration_options import CalibrationOptions, CameraOptions
from reseau.procedures.target_measurement import measurer_of

FOLDER = Path(__file__).parent / "corpus"
PHOTOGRAPHS = Path(os.environ.get("RESEAU_CORPUS", ""))
ENOUGH = 16
"""Photographs of a set whose halves count in the summary."""
LEAST = 3
GROUP = 4
"""Mean number of photographs in a group of similar poses."""
ACROSS = 25
LEVEL = 0.05
BOUND = float(scipy.special.chdtri(2, LEVEL))
"""χ² of two coordinates at the 95 % bound."""
SMALLEST = 1e-300
PHOTOGRAPHIC = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".pgm")
COLUMNS = "image,point,x,y,sx,sy,rxy"

SYSTEM = "/usr/bin/python3"
"""The Python that has mrcal, where it is installed."""

T = TypeVar("T")
Points = dict[str, ImagePoints]


@dataclass(frozen=True)
class Photographs:
    """A set: its name, entry in the list, design of the target, points by photograph, and size in pixels."""

    name: str
    entry: Mapping[str, Any]
    design: BoardDesign
    points: Points
    size: tuple[int, int]


class Halves(NamedTuple):
    """Difference of the calibrations of two halves."""

    p: float
    chi2: float
    degrees: int
    centre: float
    corners: float
    centre_px: float
    corners_px: float


@dataclass(frozen=True)
class Row:
    """Result of a set."""

    name: str
    photographs: int
    images: int = 0
    points: int = 0
    model: str = ""
    rms: float = math.nan
    causes: str = ""
    halves: Mapping[str, Halves | str] = field(default_factory=dict)
    opencv: Mapping[int, tuple[float, float]] = field(default_factory=dict)
    mrcal: tuple[float, ...] = ()
    reason: str = ""


# What is called of the project


def calibrated(of: Photographs, images: Sequence[str], model: CameraOptions | None) -> Calibrated | Failure:
    """The calibration of some photographs of a set, with the defaults of ``reseau calibrate``."""
    taken = [(image, of.points[image]) for image in images]
    options = CalibrationOptions(focal_35_mm=of.entry.get("focal_35_mm"))
    return calibrate_camera(taken, of.design, measurer_of(of.design), of.size, model, options)


def mapping_of(done: Calibrated) -> CameraMapping:
    """The mapping of a calibration, as ``reseau compare`` reads it from the document."""
    return CameraMapping.from_calibration(done.calibration())


def model_of(done: Calibrated) -> CameraOptions:
    """The model that was chosen, to be asked for by name."""
    camera = done.result.network.cameras[0]
    return CameraOptions(camera.model, camera.free, options=dict(camera.options))


def causes_of(done: Calibrated) -> str:
    """What the verdict says is wrong."""
    return ", ".join(f"{each.code} {each.amount_px:.2g} px" for each in done.explanation.causes)


# Sets


def listed() -> dict[str, dict[str, Any]]:
    """The entries of ``sets.toml`` by their names."""
    return dict(tomllib.loads((FOLDER / "sets.toml").read_text())["sets"])


def read(name: str, entry: Mapping[str, Any]) -> Photographs | str:
    """A set, or why it is not used."""
    if "refused" in entry:
        return f"refused: {entry['refused']}"
    design = BoardDesign(name=name, unit="mm", **entry["design"])
    places = (FOLDER / f"{name}.csv.gz", PHOTOGRAPHS / f"{name}.csv.gz")
    for path in places if os.environ.get("RESEAU_CORPUS") else places[:1]:
        if path.is_file():
            return Photographs(name, entry, design, table(path), tuple(entry["size"]))
    if not os.environ.get("RESEAU_CORPUS") or not (PHOTOGRAPHS / name).is_dir():
        return f"skipped: {entry['licence']} licence, and not in $RESEAU_CORPUS"
    points = measured(PHOTOGRAPHS / name, entry, design)
    write_table(PHOTOGRAPHS / f"{name}.csv.gz", points)
    return Photographs(name, entry, design, points, tuple(entry["size"]))


def measured(folder: Path, entry: Mapping[str, Any], design: BoardDesign) -> Points:
    """Measure the target in the photographs of a set."""
    files = [each for each in folder.glob(entry.get("files", "*")) if each.suffix.lower() in PHOTOGRAPHIC]
    files.sort(key=lambda each: [int(t) if t.isdigit() else t for t in re.split(r"(\d+)", each.name)])
    points, size, measure = Points(), tuple(entry["size"]), measurer_of(design)
    for path in files[:: entry.get("every", 1)]:
        frame = reseau.read_image(path)
        if "crop" in entry:
            left, upper, width, height = entry["crop"]
            frame = replace(frame, pixels=frame.pixels[upper : upper + height, left : left + width])
        found = measure(frame)
        if not isinstance(found, Failure) and (frame.width, frame.height) == size and found.found:
            points[path.name] = found.points
    return points


def write_table(path: Path, points: Points) -> None:
    """Write the points of all photographs of a set."""
    rows = [COLUMNS]
    for image, each in points.items():
        sigma = np.sqrt(each.cov[:, [0, 1], [0, 1]])
        r = each.cov[:, 0, 1] / sigma.prod(axis=1)
        columns = [*each.xy.T, *sigma.T]
        numbers = [[f"{value:.4f}" for value in column] for column in columns]
        numbers.append([f"{value:.3f}" for value in r])
        rows += [",".join([image, *row]) for row in zip(each.names, *numbers, strict=True)]
    with path.open("wb") as raw, gzip.GzipFile(filename="", fileobj=raw, mode="wb", mtime=0) as file:
        file.write(("\n".join(rows) + "\n").encode())


def table(path: Path) -> Points:
    """Read the points of all photographs of a set."""
    rows: dict[str, list[list[str]]] = {}
    with gzip.open(path, "rt", newline="") as file:
        for row in list(csv.reader(file))[1:]:
            rows.setdefault(row[0], []).append(row[1:])
    points = {}
    for image, each in rows.items():
        x, y, sx, sy, r = np.array([row[1:] for row in each], dtype=np.float64).T
        cov = np.stack([sx**2, r * sx * sy, r * sx * sy, sy**2], axis=1).reshape(-1, 2, 2)
        points[image] = ImagePoints(tuple(row[0] for row in each), np.column_stack([x, y]), cov)
    return points


# Halves


def alternating(images: Sequence[T]) -> tuple[list[T], list[T]]:
    """Odd and even photographs."""
    return list(images[::2]), list(images[1::2])


def by_pose(of: Photographs, done: Calibrated) -> tuple[list[str], list[str]]:
    """Halves of groups of similar poses: axis of the camera on the target, place in the image."""
    every = done.images
    known = np.flatnonzero(np.isfinite(every.rotation).all(axis=1))
    names = [every.names[k] for k in known]
    axes = np.array([rotation_matrix(every.rotation[k])[2] for k in known])
    middle = np.array([of.points[name].xy.mean(axis=0) for name in names]) / max(of.size)
    tree = linkage(np.column_stack([axes, middle]), "ward", optimal_ordering=True)
    count = max(4, round(len(names) / GROUP))
    group = fcluster(tree, count, "maxclust")
    order = list(dict.fromkeys(group[leaves_list(tree)]))
    halves: tuple[list[str], list[str]] = ([], [])
    for number in order:
        members = [names[k] for k in np.flatnonzero(group == number)]
        # In turn, unless the other half has fewer photographs.
        halves[len(halves[0]) > len(halves[1])].extend(members)
    return halves


def compared(of: Photographs, halves: Iterable[Sequence[str]], model: CameraOptions | None) -> Halves | str:
    """Calibrate two halves and compare them; or why not."""
    lenses = []
    for half in halves:
        if len(half) < LEAST:
            return "too few"
        done = calibrated(of, half, model)
        if isinstance(done, Failure):
            return f"half refused: {done.code}"
        lenses.append(mapping_of(done))
    try:
        found = calibration_difference(lenses[0], lenses[1], ACROSS)
        p_at = found.p_at
    except (reseau.ReseauError, np.linalg.LinAlgError) as error:
        return f"not compared: {error}"
    at = places(found, p_at)
    ratio = np.sqrt(scipy.special.chdtri(2, np.maximum(p_at, SMALLEST)) / BOUND)
    # The p of a place is that of its two coordinates, whatever its distribution.
    size = np.hypot(*np.moveaxis(found.difference, -1, 0))
    centre, corners = at[0], at[1:]
    return Halves(
        found.p, found.statistic, found.degrees, float(ratio[centre]), _rms([ratio[k] for k in corners]),
        float(size[centre]), max(float(size[k]) for k in corners),
    )  # fmt: skip


def places(found: FieldDifference, p_at: Array) -> list[tuple[int, int]]:
    """Rows and columns of the centre, and of the places with rays that are nearest to the four corners."""
    shape = found.xy.shape[:2]
    known = np.isfinite(found.difference).all(axis=2) & np.isfinite(p_at)
    rows, columns = np.indices(shape)
    wanted = [(shape[0] // 2, shape[1] // 2)]
    wanted += [(r, c) for r in (0, shape[0] - 1) for c in (0, shape[1] - 1)]
    far = [np.where(known, np.hypot(rows - r, columns - c), np.inf) for r, c in wanted]
    nearest = [np.unravel_index(int(each.argmin()), shape) for each in far]
    return [(int(r), int(c)) for r, c in nearest]


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# Others


class ByOpenCV(NamedTuple):
    """OpenCV's calibration: rms of a coordinate, mapping without errors, values, and poses of the board."""

    rms: float
    mapping: CameraMapping
    values: list[float]
    frames: list[list[float]]


def by_opencv(of: Photographs, images: Sequence[str], coefficients: int) -> ByOpenCV | None:
    """OpenCV's calibration of some photographs; None where it fails."""
    row = {name: k for k, name in enumerate(of.design.ids)}
    plane, seen = [], []
    for image in images:
        points = of.points[image]
        xy = of.design.xy[[row[name] for name in points.names]]
        plane.append(np.column_stack([xy, np.zeros(len(xy))]).astype(np.float32))
        seen.append(points.xy.astype(np.float32))
    flags = cv2.CALIB_FIX_K3 if coefficients == 4 else 0
    try:
        rms, matrix, k, turns, shifts, *_ = cv2.calibrateCamera(plane, seen, of.size, None, None, flags=flags)
    except cv2.error:
        return None
    names = ("k1", "k2", "p1", "p2", "k3")
    values = dict(zip(names, np.ravel(k)[:5].tolist(), strict=True))
    frame = {"fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2]}
    lens = OpenCV.from_parameters({**frame, **values})
    mapping = CameraMapping(lens, *of.size, np.array([0, 1]), np.eye(2) * 1e-12)
    frames = [
        np.concatenate([turn.ravel(), shift.ravel()]).tolist()
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    return ByOpenCV(float(rms) / math.sqrt(2), mapping, [*frame.values(), *values.values()], frames)


def opencv(of: Photographs, images: Sequence[str], coefficients: int) -> tuple[float, float]:
    """The rms of OpenCV's calibration, and the largest difference of odd and even halves in the corners."""
    whole = by_opencv(of, images, coefficients)
    if whole is None:
        return math.nan, math.nan
    halves = alternating(images)
    if min(map(len, halves)) < LEAST:
        return whole.rms, math.nan
    both = [by_opencv(of, half, coefficients) for half in halves]
    if both[0] is None or both[1] is None:
        return whole.rms, math.nan
    try:
        found = calibration_difference(both[0].mapping, both[1].mapping, ACROSS)
    except (reseau.ReseauError, np.linalg.LinAlgError):
        return whole.rms, math.nan
    size = np.hypot(*np.moveaxis(found.difference, -1, 0))
    rows, columns = size.shape
    corners = [size[r, c] for r in (0, rows - 1) for c in (0, columns - 1)]
    return whole.rms, float(np.max(corners))


def mrcal(of: Photographs, images: Sequence[str]) -> tuple[float, ...]:
    """The rms of mrcal's calibration, and the ratios of its halves; empty where it is not used, or fails."""
    start = by_opencv(of, images, 5) if of.design.kind in ("chess", "charuco", "circles") else None
    if start is None or min(map(len, alternating(images))) < LEAST or not Path(SYSTEM).is_file():
        return ()
    at = np.rint((of.design.xy - of.design.xy.min(axis=0)) / of.design.pitch).astype(int)
    row = {name: k for k, name in enumerate(of.design.ids)}
    width, height = at.max(axis=0) + 1
    corners = np.zeros((len(images), height, width, 3))
    corners[..., 2] = -1.0
    for k, image in enumerate(images):
        points = of.points[image]
        j, i = at[[row[name] for name in points.names]].T
        corners[k, i, j] = np.column_stack([points.xy, np.ones(len(i))])
    # The board of mrcal starts at its first corner.
    frames = np.array(start.frames)
    first = np.append(of.design.xy.min(axis=0), 0.0)
    frames[:, 3:] += np.array([rotation_matrix(each[:3]) @ first for each in frames])
    numbers = range(len(images))
    document = {
        "size": of.size, "spacing": of.design.pitch, "values": [*start.values, 0.0, 0.0, 0.0],
        "corners": corners.tolist(), "frames": frames.tolist(), "halves": [alternating(numbers)],
    }  # fmt: skip
    try:
        run = subprocess.run(
            [SYSTEM, FOLDER / "by_mrcal.py"], input=json.dumps(document), capture_output=True, text=True,
            check=True, env={"PATH": "/usr/bin"}, timeout=120,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return ()
    found = json.loads(run.stdout)
    return found["rms"] / math.sqrt(2), *found["halves"][0]


# Sets, rows and tables


def outcome(job: tuple[str, Mapping[str, Any], str]) -> Row:
    """The result of a set."""
    name, entry, model = job
    of = read(name, entry)
    photographs = int(entry["photographs"])
    if isinstance(of, str):
        return Row(name, photographs, reason=of)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            return _outcome(of, photographs, model)
        except (reseau.ReseauError, np.linalg.LinAlgError) as error:
            return Row(name, photographs, len(of.points), reason=f"failed: {error}")


def _outcome(of: Photographs, photographs: int, model: str) -> Row:
    done = calibrated(of, list(of.points), CameraOptions(model) if model else None)
    others = list(of.points) if isinstance(done, Failure) else list(done.measured)
    theirs = {count: opencv(of, others, count) for count in (4, 5)} if len(others) >= LEAST else {}
    if isinstance(done, Failure):
        points = sum(map(len, of.points.values()))
        return Row(
            of.name, photographs, len(of.points), points, opencv=theirs, reason=f"refused: {done.reason}"
        )
    used = list(done.measured)
    chosen = model_of(done)
    residuals = np.asarray(done.result.residuals)
    given = chosen if model else None
    odd = compared(of, alternating(used), given)
    pose: Halves | str = "too few"
    if len(used) >= 2 * LEAST:
        pose = compared(of, by_pose(of, done), given)
    return Row(
        of.name, photographs, len(used), sum(map(len, done.measured.values())),
        f"{chosen.model}, {len(chosen.free)}", float(np.sqrt(np.nanmean(residuals**2))), causes_of(done),
        {"odd": odd, "pose": pose}, theirs, mrcal(of, used),
    )  # fmt: skip


HEADINGS = (
    "set", "photographs", "used", "points", "model, parameters", "rms px", "causes", "p odd/even",
    "p by pose", "χ²/dof", "centre", "corners", "corners px", "OpenCV 4: rms, corners px",
    "OpenCV 5: rms, corners px", "mrcal: rms, centre, corners",
)  # fmt: skip


def cells(row: Row) -> list[str]:
    """The cells of the table of a set."""
    first = [row.name, str(row.photographs), str(row.images), str(row.points)]
    theirs = [f"{_number(a)}, {_number(b)}" for a, b in row.opencv.values()] or ["", ""]
    theirs.append(", ".join(map(_number, row.mrcal)))
    if row.reason:
        return [*first, row.reason, *[""] * 8, *theirs]
    halves = [row.halves["odd"], row.halves["pose"]]

    def both(values: Sequence[str | float]) -> str:
        return " / ".join(each if isinstance(each, str) else _number(each) for each in values)

    got = [each for each in halves if isinstance(each, Halves)]
    return [
        *first, row.model, _number(row.rms), row.causes or "none",
        *(f"{each.p:.2g}" if isinstance(each, Halves) else each for each in halves),
        both([each.chi2 / max(each.degrees, 1) for each in got]),
        both([each.centre for each in got]), both([each.corners for each in got]),
        both([each.corners_px for each in got]), *theirs,
    ]  # fmt: skip


def _number(value: float) -> str:
    return "–" if not math.isfinite(value) else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def summary(rows: Sequence[Row]) -> list[str]:
    """What is asked of the whole corpus; sets and halves that are refused are counted, too."""
    known = [row for row in rows if not row.reason.startswith("skipped")]
    many = [row for row in known if row.photographs >= ENOUGH]
    refused = [row.name for row in known if row.reason]
    lines = [
        f"{len(rows)} sets, {len(rows) - len(known)} skipped, {len(refused)} refused"
        + (f" ({', '.join(refused)})" if refused else "")
        + f"; {len(many)} with at least {ENOUGH} photographs, to which the following applies"
    ]
    for which, name in (("odd", "odd/even"), ("pose", "by pose")):
        found = {row.name: row.halves.get(which) for row in many}
        halves = {name: each for name, each in found.items() if isinstance(each, Halves)}
        if not halves:
            continue
        p = np.array([each.p for each in halves.values()])
        least = min(halves, key=lambda name: halves[name].p)
        lines.append(
            f"{name}: {len(halves)} compared; p < {LEVEL} in {np.mean(p < LEVEL):.0%} of these, p < 0.001 in "
            f"{np.sum(p < 0.001)}; smallest p {p.min():.2g} ({least})"
        )
        record(f"halves {name}", f"p < {LEVEL}", int(np.sum(p < LEVEL)), of=len(p))
        record(f"halves {name}", "p < 0.001", int(np.sum(p < 0.001)), of=len(p))
        for place in ("centre", "corners"):
            ratio = np.array([getattr(each, place) for each in halves.values()])
            below = int(np.sum(ratio < 1))
            lines.append(
                f"{name}, {place}: below the claimed 95 % in {below / len(ratio):.0%} of these, in "
                f"{below / len(many):.0%} of all; median ratio {np.nanmedian(ratio):.2f}"
            )
            record(f"halves {name}", f"below the claims, {place}", below, of=len(many))
            record(f"halves {name}", f"median ratio, {place}", float(np.nanmedian(ratio)))
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=[], help="names; by default all")
    parser.add_argument("--model", default="", help="camera model; by default that of `reseau calibrate`")
    parser.add_argument("--seen", action="store_true", help="also print what a person sees in each set")
    add_options(parser, jobs=1)
    given = parser.parse_args()
    entries = listed()
    unknown = [name for name in given.sets if name not in entries]
    if unknown:
        parser.error(f"{', '.join(unknown)}: not in {FOLDER / 'sets.toml'}")
    jobs = [(name, entries[name], given.model) for name in given.sets or entries]
    print(f"| {' | '.join(HEADINGS)} |\n|{'---|' * len(HEADINGS)}", flush=True)
    rows = []
    with executor_of(given) as executor:
        for row in outcomes(executor, outcome, jobs):
            rows.append(row)
            print(f"| {' | '.join(cells(row))} |", flush=True)
    print("\n" + "\n".join(summary(rows)))
    if given.seen:
        print("\n| set | seen | causes |\n|---|---|---|")
        for row in rows:
            print(f"| {row.name} | {entries[row.name]['seen']} | {row.causes or row.reason or 'none'} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
