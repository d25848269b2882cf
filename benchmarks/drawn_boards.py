"""Boards of other programs in pictures drawn by ``worlds.prints``, beside the programs that find them.

Run from the checkout: ``python benchmarks/drawn_boards.py [--kind K …] [--condition C …] [--count 2]
[--calibrate SEEDS]``. With ``--calibrate`` the camera is calibrated from ten views for each seed, and the
errors of its parameters are compared with their sigmas. Without, for every picture: points measured of
those in sight and clear, and those of the other program that are right to a pixel; rms error and the
other's; errors over sigmas; points wrong by more than 0.15 px and 5 sigma; names wrong beyond the symmetry
of the board (? where a note says that they are ambiguous), and those of the other program; processor time
of both. A row is missed with fewer points than the other program has, with a point or a name that is wrong,
and with errors over sigmas outside 0.85 to 1.2, or outside of what 99.8 % of as many independent errors
have where that is wider. Of several other programs a row shows the one with the most points.

The others are OpenCV; for AprilGrids ``aprilgrid``, and with borders of one bit the detector of the AprilTag
library (``pupil-apriltags``); for a board of as many rows as columns mrgingham (Debian), which finds no
other. Those that are not installed are left out.
"""

from __future__ import annotations

import argparse
import importlib.util
import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from figures import BOUND, ORIGIN, record
from parts import add_options, executor_of, main_of, outcomes, timed
from scipy.stats import chi2
from worlds import prints
from worlds.pixels import Array
from worlds.sheets import CONDITIONS, Fisheye, View, Wide, pose, views

from reseau.core.data import Frame, Rows
from reseau.core.failure import Failure
from reseau.designs import board
from reseau.execution import Executor
from reseau.io import BoardDesign
from reseau.measure import measure_board
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.target_measurement import measurer_of

WRONG_PX, WRONG_SIGMA, NORMALISED, SPREAD = 0.15, 5.0, (0.85, 1.2), 0.001
APRIL, ARUCO = "DICT_APRILTAG_36h11", "DICT_4X4_100"
APRIL_CORNERS = {"aprilgrid": np.array([0, 1, 2, 3]), "markers": np.array([1, 0, 3, 2])}
"""Corners of a tag of a design, in the order of the AprilTag library."""
KINDS: dict[str, tuple[BoardDesign, prints.Print | prints.Deltille]] = {
    "aprilgrid2": (
        board("aprilgrid", 6, 6, 28.6, size=22.0, border_bits=2),
        prints.aprilgrid(6, 6, 22.0, 0.3, APRIL, 2),
    ),
    "aprilgrid1": (
        board("aprilgrid", 5, 4, 39.0, size=30.0),
        prints.aprilgrid(5, 4, 30.0, 0.3, APRIL, 1),
    ),
    "april16h5": (
        board("aprilgrid", 5, 4, 39.0, size=30.0, dictionary="DICT_APRILTAG_16h5"),
        prints.aprilgrid(5, 4, 30.0, 0.3, "DICT_APRILTAG_16h5", 1),
    ),
    "april25h9": (
        board("aprilgrid", 5, 4, 37.5, size=30.0, dictionary="DICT_APRILTAG_25h9"),
        prints.aprilgrid(5, 4, 30.0, 0.25, "DICT_APRILTAG_25h9", 1),
    ),
    "markers": (
        board("markers", 6, 5, 40.0, size=30.0, dictionary=ARUCO),
        prints.markers(6, 5, 30.0, 10.0, ARUCO),
    ),
    "april_markers": (
        board("markers", 6, 5, 40.0, size=30.0, dictionary=APRIL),
        prints.markers(6, 5, 30.0, 10.0, APRIL),
    ),
    "charuco": (
        board("charuco", 9, 6, 30.0, size=22.0, dictionary=ARUCO),
        prints.charuco(9, 6, 30.0, 22.0, ARUCO),
    ),
    "charuco_old": (
        board("charuco", 9, 6, 30.0, size=22.0, dictionary=ARUCO, legacy=True),
        prints.charuco(9, 6, 30.0, 22.0, ARUCO, True),
    ),
    "chess": (board("chess", 10, 7, 25.0), prints.chess(10, 7, 25.0)),
    "chess_square": (board("chess", 8, 8, 25.0), prints.chess(8, 8, 25.0)),
    "deltille": (board("deltille", 9, 8, 25.0), prints.Deltille(9, 8, 25.0)),
    "circles": (board("circles", 9, 7, 25.0, size=12.0), prints.circles(9, 7, 25.0, 12.0)),
    "asymmetric": (
        board("circles", 4, 11, 20.0, size=16.0, asymmetric=True),
        prints.circles(4, 11, 20.0, 16.0, True),
    ),
}


@dataclass(frozen=True, eq=False)
class Other:
    """What another program finds: points (n, 2), their rows in the design, and its processor time (s)."""

    program: str
    xy: Array
    rows: Rows
    seconds: float


def by_others(design: BoardDesign, pixels: Any) -> list[Other]:
    """What the other programs find that are installed and know the board; OpenCV knows no deltilles."""
    programs: dict[str, Any] = {}
    if design.kind == "aprilgrid":
        if importlib.util.find_spec("aprilgrid") is not None:
            programs["aprilgrid"] = by_aprilgrid
        if design.border_bits == 1 and importlib.util.find_spec("pupil_apriltags") is not None:
            programs["AprilTag"] = by_apriltag
    elif design.kind != "deltille":
        programs["OpenCV"] = by_opencv
        if "APRILTAG" in str(design.dictionary) and importlib.util.find_spec("pupil_apriltags") is not None:
            programs["AprilTag"] = by_apriltag
        if design.kind == "chess" and design.columns == design.rows and shutil.which("mrgingham"):
            programs["mrgingham"] = by_mrgingham
    done = []
    for program, find in programs.items():
        if program == "AprilTag":
            april_detector(design)  # is set up once; not part of the time
        start = used_s()
        xy, rows = find(design, pixels)
        xy = np.asarray(xy, float).reshape(-1, 2)
        done.append(Other(program, xy, np.asarray(rows).ravel()[: len(xy)], used_s() - start))
    return done


def used_s() -> float:
    """Processor time (s) of this process and of those that it has started and seen end."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime


def by_aprilgrid(design: BoardDesign, pixels: Any) -> tuple[Array, Rows]:
    from aprilgrid import Detector

    family = f"t{str(design.dictionary).split('_')[-1]}" + ("b1" if design.border_bits == 1 else "")
    tags = [tag for tag in Detector(family).detect(pixels) if tag.tag_id < design.columns * design.rows]
    return np.array([tag.corners for tag in tags], float), np.array(
        [4 * tag.tag_id + np.arange(4) for tag in tags], int
    )


@cache
def april_detector(design: BoardDesign) -> Any:
    """The detector of the AprilTag library; one thread, all pixels."""
    from pupil_apriltags import Detector

    family = f"tag{str(design.dictionary).split('_')[-1]}"
    return Detector(families=family, nthreads=1, quad_decimate=1.0, refine_edges=1)


def by_apriltag(design: BoardDesign, pixels: Any) -> tuple[Array, Rows]:
    tags = [
        tag
        for tag in april_detector(design).detect(pixels)
        if tag.tag_id < design.columns * design.rows and tag.hamming == 0
    ]
    rows = np.array([4 * tag.tag_id + APRIL_CORNERS[design.kind] for tag in tags], int)
    # Its coordinates have their origin in the corner of the first pixel.
    return np.array([tag.corners for tag in tags], float) - 0.5, rows


def by_mrgingham(design: BoardDesign, pixels: Any) -> tuple[Array, Rows]:
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "board.png"
        cv2.imwrite(str(file), pixels)
        command = ["mrgingham", "--jobs", "1", "--gridn", str(design.rows - 1), str(file)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    rows = [line.split()[1:3] for line in done.stdout.splitlines() if not line.startswith("#")]
    xy = np.array([(float(x), float(y)) for x, y in rows if x != "-"])
    return xy, np.arange(len(xy))


def by_opencv(design: BoardDesign, pixels: Any) -> tuple[Array, Rows]:
    xy, rows = np.zeros((0, 2)), np.arange(len(design.ids))
    if design.kind in ("markers", "charuco"):
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, str(design.dictionary)))
        if design.kind == "markers":
            parameters = cv2.aruco.DetectorParameters()
            parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
            corners, ids, _ = cv2.aruco.ArucoDetector(words, parameters).detectMarkers(pixels)
            if ids is not None:
                own = ids.ravel() < design.columns * design.rows
                xy, rows = np.array(corners)[own], 4 * ids.ravel()[own, None] + np.arange(4)
        else:
            size = (design.columns, design.rows)
            plan = cv2.aruco.CharucoBoard(size, design.pitch, float(design.size or 0), words)
            plan.setLegacyPattern(design.legacy)
            corners, ids, _, _ = cv2.aruco.CharucoDetector(plan).detectBoard(pixels)
            if ids is not None:
                xy, rows = corners, ids
    elif design.kind == "chess":
        flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
        good, corners = cv2.findChessboardCornersSB(
            pixels, (design.columns - 1, design.rows - 1), flags=flags
        )
        xy = corners if good else xy
    elif design.kind == "circles":
        flags = cv2.CALIB_CB_ASYMMETRIC_GRID if design.asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
        good, corners = cv2.findCirclesGrid(pixels, (design.columns, design.rows), flags=flags)
        xy = corners if good else xy
    return xy, rows


def misnamed(design: BoardDesign, ways: int, own: Rows, near: Rows) -> int:
    """Points with the name of another, beyond turns of the whole board by which it equals itself."""
    wrong = own != near
    if not wrong.any() or ways == 1:
        return int(wrong.sum())
    a = np.column_stack([design.nodes[own], np.ones(len(own))])
    turn = np.rint(np.linalg.lstsq(a, design.nodes[near].astype(float), rcond=None)[0])
    if not np.isclose(np.linalg.det(turn[:2]), 1.0):
        return len(own)
    moved = a @ turn
    same = {tuple(node) for node in (np.column_stack([design.nodes, np.ones(len(design.nodes))]) @ turn)}
    whole = same == {tuple(node) for node in design.nodes.astype(float)}
    return int((np.abs(moved - design.nodes[near]).max(axis=1) > 0.1).sum()) if whole else len(own)


@dataclass(frozen=True)
class Row:
    """A picture: its row, whether it is within its limits, and what is pooled.

    Points `found` of those in `sight`, rms error (px), errors over sigmas, points and names that are wrong,
    processor time (s); and for each other program its points that are right, their rms error, and its time.
    """

    kind: str
    label: str
    text: str
    good: bool
    sight: int
    others: dict[str, tuple[int, float, float]]
    found: int = 0
    rms: float = np.nan
    ratio: float = np.nan
    wrong: int = 0
    seconds: float = np.nan


def row(job: tuple[str, str, View]) -> Row:
    """Measure a picture."""
    cv2.setNumThreads(1)
    kind, label, view = job
    design, printed = KINDS[kind]
    pixels, xy = view.picture(), view.truth
    h, w = pixels.shape
    sight = ((xy > 6) & (xy < [w - 7, h - 7])).all(axis=1) & (view.hidden > 6)
    several: dict[str, tuple[int, float, float]] = {}
    others, theirs, their_wrong, their_time = 0, np.nan, 0, 0.0
    for other in by_others(design, pixels):
        count, error_px, misread = 0, np.nan, 0
        if len(other.xy):
            gap = np.hypot(*(other.xy[:, None] - xy[None]).transpose(2, 0, 1))
            right = gap.min(axis=1) < 1.0
            count, gap = int(right.sum()), gap[right]
            error_px = float(np.sqrt((gap.min(axis=1) ** 2).mean() / 2)) if count else np.nan
            misread = misnamed(design, printed.symmetries, other.rows[right], gap.argmin(axis=1))
        several[other.program] = count, error_px, other.seconds
        if count > others or len(several) == 1:
            others, theirs, their_wrong, their_time = count, error_px, misread, other.seconds
    pooled = {"kind": kind, "label": label, "sight": int(sight.sum()), "others": several}
    found, seconds = timed(partial(measure_board, Frame(pixels, 255.0, label), design), kind)
    if isinstance(found, Failure):
        good = others == 0
        text = f"{kind:12} {label:14} declined: {found.reason[:70]}; other {others}  "
        return Row(text=f"{text}{'ok' if good else 'MISSED'}", good=good, **pooled)
    own = np.flatnonzero(found.ok)
    if not len(own):
        text = f"{kind:12} {label:14}    0 of {int(sight.sum()):4} {others:4}  "
        return Row(text=f"{text}{'MISSED' if others else 'ok'}", good=not others, **pooled)
    near = np.hypot(*(found.xy[own, None] - xy[None]).transpose(2, 0, 1)).argmin(axis=1)
    error = found.xy[own] - xy[near]
    sigma = np.sqrt(np.diagonal(found.cov[own], axis1=1, axis2=2))
    off, scaled = np.hypot(*error.T), np.abs(error / sigma).max(axis=1)
    wrong = int(((off > WRONG_PX) & (scaled > WRONG_SIGMA)).sum())
    names = misnamed(design, printed.symmetries, own, near)
    unclear = any(note.code.value == "ambiguous" for note in found.notes)
    ratio, rms = float(np.sqrt(((error / sigma) ** 2).mean())), float(np.sqrt((error**2).mean()))
    slow = "slow" if seconds > 3 * their_time else "    "
    good = len(own) >= others and not wrong and (not names or unclear)
    spread = np.sqrt(chi2.ppf([SPREAD, 1 - SPREAD], error.size) / error.size)
    good &= min(NORMALISED[0], spread[0]) <= ratio <= max(NORMALISED[1], spread[1])
    text = (
        f"{kind:12} {label:14} {len(own):4} of {int(sight.sum()):4} {others:4}  {rms:.4f} {theirs:7.4f} "
        f"{off.max():6.3f} {scaled.max():5.1f} {ratio:5.2f} {wrong:3} {names:3}{'?' if unclear else ' '} "
        f"{their_wrong:4} {seconds:6.2f} {their_time:6.2f} {slow} {'ok' if good else 'MISSED'}"
    )
    wrong += 0 if unclear else names
    figures = {"found": len(own), "rms": rms, "ratio": ratio, "wrong": wrong, "seconds": seconds}
    return Row(text=text, good=bool(good), **pooled, **figures)


def keep(kind: str, rows: list[Row]) -> None:
    """Record the figures of the pictures of a kind: of each program one row."""
    title, sight, measured = TITLES[kind], sum(r.sight for r in rows), [r for r in rows if r.found]
    found = sum(r.found for r in rows)
    record(f"{title}, reseau", "found", found, of=sight)
    record(f"{title}, reseau", "rms of a picture", [r.rms for r in measured], "px")
    record(f"{title}, reseau", "errors ÷ sigmas", [r.ratio for r in measured])
    record(f"{title}, reseau", "wrong", sum(r.wrong for r in rows))
    record(f"{title}, reseau", "processor time", [r.seconds for r in measured], "s")
    for program in dict.fromkeys(program for r in rows for program in r.others):
        theirs = [r.others[program] for r in rows]
        record(f"{title}, {program}", "found", sum(count for count, _, _ in theirs), of=sight)
        record(f"{title}, {program}", "rms of a picture", [error for _, error, _ in theirs], "px")
        record(f"{title}, {program}", "processor time", [seconds for _, _, seconds in theirs], "s")
    what = f"{title}, drawn"
    record(what, "independent, found", found, of=sight, table=ORIGIN)
    record(what, "independent, errors ÷ sigmas", [r.ratio for r in measured], table=ORIGIN)
    for r in rows:
        if r.label == CLEAN.get(kind):
            record(title, "reseau", r.rms, table=BOUND)
            for program, (_, error, _) in r.others.items():
                record(title, program, error, table=BOUND)


TITLES = {
    "aprilgrid2": "AprilGrid 36h11, borders of two bits",
    "aprilgrid1": "AprilGrid 36h11",
    "april16h5": "AprilGrid 16h5",
    "april25h9": "AprilGrid 25h9",
    "markers": "separate markers",
    "april_markers": "separate tags 36h11",
    "charuco": "ChArUco board",
    "charuco_old": "ChArUco board of older versions",
    "chess": "chessboard",
    "chess_square": "square chessboard",
    "deltille": "deltille",
    "circles": "grid of circles",
    "asymmetric": "asymmetric grid of circles",
}
CLEAN = {
    "aprilgrid2": "clean_0",
    "aprilgrid1": "clean_0",
    "april_markers": "clean_0",
    "chess_square": "small_0",
}
"""Kinds of which a clean picture is shown beside the bounds of other targets, and that picture."""


def held_out(kind: str, count: int) -> list[tuple[str, View]]:
    """Wide lenses, fisheyes, near 60°, small boards, partial views."""
    printed, found = KINDS[kind][1], list[tuple[str, View]]()
    for k in range(count):
        turn, place = pose(50 + k, printed, nearer=1.7)
        found.append((f"wide_{k}", Wide(printed, turn, place * [1, 1, 0.55], seed=900 + k)))
        turn, place = pose(60 + k, printed, most_tilt_deg=30.0, nearer=1.0)
        found.append((f"fish_{k}", Fisheye(printed, turn, place * [1, 1, 0.45], seed=980 + k)))
        turn, place = pose(70 + k, printed, nearer=0.4)
        found.append((f"far_{k}", View(printed, turn, place, seed=920 + k, noise=3.0)))
        turn, place = pose(90 + k, printed, nearer=1.2)
        tilt = cv2.Rodrigues(np.deg2rad(60) * np.array([np.cos(k), np.sin(k), 0.0]))[0]
        found.append((f"steep_{k}", View(printed, tilt @ np.diag([1.0, -1, -1]), place, seed=940 + k)))
        turn, place = pose(110 + k, printed, nearer=2.6)
        shift = np.append(np.random.default_rng(k).uniform(-60, 60, 2), 0.0)
        found.append((f"part_{k}", View(printed, turn, place + shift, seed=960 + k)))
    return found


CALIBRATED, VIEWS = (0.75, 1.3), 10
"""Limits of the normalised errors of parameters, free of correlations, and number of views."""
PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


def calibrated(kind: str, seed: int) -> tuple[str, Array] | str:
    """Calibrate from views that fill the frame, some beyond it: a row, and errors free of correlations."""
    design, printed = KINDS[kind]
    true = np.array([*View._focal, *View._centre, *View._lens])
    drawn = [
        View(printed, *pose(100 * seed + k, printed, nearer=1.15), seed=7777 * seed + k) for k in range(VIEWS)
    ]
    frames = [Frame(view.picture(), 255.0, str(k)) for k, view in enumerate(drawn)]
    done = calibrate_camera(frames, design, measurer_of(design))
    if isinstance(done, Failure):
        return str(done.reason)
    camera = done.cameras["camera"]
    at = [camera.parameters.index(name) for name in PARAMETERS]
    error, cov = camera.values[at] - true, camera.covariance[np.ix_(at, at)]
    z = " ".join(f"{value:5.1f}" for value in error / np.sqrt(np.diag(cov)))
    text = f"{kind:12} seed {seed:2}: sigma0 {done.sigma0:.2f}, errors over sigmas {z}"
    return text, np.linalg.solve(np.linalg.cholesky(cov), error)


def calibrations(executor: Executor, kind: str, seeds: int) -> bool:
    """Calibrate for each seed; print errors over sigmas."""
    white, good = [], True
    for seed, done in enumerate(outcomes(executor, partial(calibrated, kind), range(seeds))):
        if isinstance(done, str):
            print(f"{kind:12} seed {seed}: {done}  MISSED")
            good = False
            continue
        print(done[0], flush=True)
        white.append(done[1])
    if not white:
        return False
    ratio = float(np.sqrt((np.array(white) ** 2).mean()))
    good &= CALIBRATED[0] <= ratio <= CALIBRATED[1]
    print(f"{kind:12} free of correlations {ratio:.2f}  {'ok' if good else 'MISSED'}", flush=True)
    return good


def pictures(kinds: list[str], conditions: list[str], count: int) -> Iterator[tuple[str, str, View]]:
    """Kind, label and view of each picture."""
    for kind in kinds:
        for condition in conditions:
            if condition == "held":
                for label, view in held_out(kind, count):
                    yield kind, label, view
                continue
            for k, view in enumerate(views(condition, count, KINDS[kind][1])):
                yield kind, f"{condition}_{k}", view


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kind", nargs="+", default=list(KINDS), choices=list(KINDS))
    known = [*CONDITIONS, "held"]
    parser.add_argument("--condition", nargs="+", default=known, choices=known)
    parser.add_argument("--count", type=int, default=2)
    parser.add_argument("--calibrate", type=int, default=0, help="number of calibrations, and nothing else")
    add_options(parser)
    options = parser.parse_args()
    with executor_of(options) as executor:
        if options.calibrate:
            # Every kind is calibrated, whatever the others give.
            done = [calibrations(executor, kind, options.calibrate) for kind in options.kind]
            return 0 if all(done) else 1
        print(
            "kind         picture      measured  other rms   theirs worst sigma ratio wrong names theirs s "
            "other"
        )
        rows = list[Row]()
        for found in outcomes(executor, row, pictures(options.kind, options.condition, options.count)):
            print(found.text, flush=True)
            rows.append(found)
        for kind in options.kind:
            keep(kind, [each for each in rows if each.kind == kind])
    return 0 if all(each.good for each in rows) else 1


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
