"""Chessboards, ChArUco boards and circle grids in pictures of another program, beside OpenCV.

Run from the checkout: ``RESEAU_DATA=… python benchmarks/other_boards.py [--target charuco|chess|circ]
[--condition C …] [--jobs N]``. For every picture: points measured of those in sight, and OpenCV's; the rms
error beside the Cramér–Rao bound (of twelve points: levels, slopes, blur and directions of edges unknown,
noise as in the picture, window of half a square; not for ChArUco) and OpenCV's rms; errors over sigmas;
points wrong by more than 0.15 px and 5 sigma; names wrong beyond the symmetry of the board; processor time
beside OpenCV's. ``CharucoDetector``, ``findChessboardCornersSB`` and ``findCirclesGrid`` run in the same
process; times are those of the process that measures a picture, the least of several rounds in which both
take turns. The last row of a target has the mean times over its pictures and their ratio.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from figures import BOUND as BESIDE
from figures import ORIGIN, record
from parts import add_options, executor_of, main_of, outcomes
from worlds.pixels import Array, edge, form_at

from reseau.core.failure import Failure
from reseau.designs import board
from reseau.io import BoardDesign
from reseau.io.images import read_image
from reseau.measure import measure_board
from reseau.measure.boards.measure import BoardOptions

DESIGNS = {
    "charuco": board("charuco", 11, 11, 23.0, size=17.0, dictionary="DICT_5X5_100"),
    "chess": board("chess", 12, 11, 23.0),
    "circ": board("circles", 10, 10, 25.0, size=12.0),
}
WRONG_PX, WRONG_SIGMA, NORMALISED = 0.15, 5.0, (0.85, 1.2)
BOUND, LEAST_PX, SLOWER = 1.15, 0.003, 3.0
SAMPLE = 12
BLUR = {"defoc1.5": 1.5, "defoc2.2": 2.2, "defoc3": 3.0}
MIRRORED = ("charuco", "mirror")
"""Target and condition that must be declined from the front; it is measured from behind, too."""


def by_opencv(target: str, pixels: Any) -> tuple[Array, float]:
    """Points (n, 2) that OpenCV finds, and its processor time."""
    start = time.process_time()
    points: Any = None
    if target == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard((11, 11), 23.0, 17.0, dictionary))
        points = detector.detectBoard(pixels)[0]
    elif target == "chess":
        flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
        found, points = cv2.findChessboardCornersSB(pixels, (11, 10), flags=flags)
        points = points if found else None
    else:
        found, points = cv2.findCirclesGrid(pixels, (10, 10), flags=cv2.CALIB_CB_SYMMETRIC_GRID)
        points = points if found else None
    seconds = time.process_time() - start
    return (np.zeros((0, 2)) if points is None else np.asarray(points, float).reshape(-1, 2)), seconds


def slopes(design: BoardDesign, xy: Array) -> Array:
    """Image (n, 2, 2) of a step to the right and one downwards, in columns."""
    matrix: Any = cv2.findHomography(design.nodes.astype(float), xy)[0]

    def image(nodes: Array) -> Array:
        at = np.column_stack([nodes, np.ones(len(nodes))]) @ matrix.T
        return np.asarray(at[:, :2] / at[:, 2:])

    step = 0.01
    nodes = design.nodes.astype(float)
    parts = [(image(nodes + d) - image(nodes - d)) / (2 * step) for d in step * np.eye(2)]
    return np.stack(parts, axis=2)


def bound(design: BoardDesign, pixels: Any, at: Array, slope: Array, sigma: float) -> float:
    """Cramér–Rao bound of a coordinate of one point, pixels."""
    half = np.abs(slope).sum(axis=1) / 2
    first = np.floor(at - half).astype(int)
    size = np.ceil(at + half).astype(int) - first + 1
    circles = design.kind == "circles"

    def formed(change: Array, offset: float = 0.0) -> Array:
        steps = slope @ (np.eye(2) + change)
        back = np.linalg.inv(steps)

        def scene(x: Array, y: Array, spacing: float) -> Array:
            u, v = (back[k, 0] * (x - at[0]) + back[k, 1] * (y - at[1]) for k in (0, 1))
            if circles:
                assert design.size is not None
                radius = np.hypot(u, v)
                grow_x, grow_y = (
                    (u * back[0, k] + v * back[1, k]) / np.maximum(radius, 1e-9) for k in (0, 1)
                )
                share = (design.size / design.pitch / 2 + offset - radius) / np.hypot(grow_x, grow_y)
                return edge(share, spacing)
            one, two = (edge(w / np.hypot(*back[k]), spacing) for k, w in ((0, u), (1, v)))
            return np.asarray(one * two + (1 - one) * (1 - two))

        return form_at(scene, tuple(first), tuple(size), sigma, derivatives=True)  # type: ignore[arg-type]

    share, by_x, by_y, by_sigma = formed(np.zeros((2, 2)))
    step, columns = 1e-3, [by_x, by_y, by_sigma]
    if circles:
        columns.append((formed(np.zeros((2, 2)), step)[0] - share) / step)
    else:
        for change in ([[0, 0], [1, 0]], [[0, 1], [0, 0]]):
            columns.append((formed(step * np.array(change))[0] - share) / step)
    x, y = np.meshgrid(*(first[k] + np.arange(size[k]) - at[k] for k in (0, 1)))
    back = np.linalg.inv(slope)
    inside = np.ones(x.shape, dtype=bool)
    u, v = (np.abs(back[k, 0] * x + back[k, 1] * y) for k in (0, 1))
    inside &= (u < 0.5) & (v < 0.5)
    h, w = pixels.shape
    column, row = first[0] + np.arange(size[0]), first[1] + np.arange(size[1])
    inside &= ((column >= 0) & (column < w))[None, :] & ((row >= 0) & (row < h))[:, None]
    grey = pixels[np.clip(row, 0, h - 1)[:, None], np.clip(column, 0, w - 1)[None, :]].astype(float)
    parts = [share > 0.99, share < 0.01]
    levels, variances = [], []
    for part in parts:
        use = part & inside
        plane = np.stack([np.ones_like(x), x, y], axis=-1)[use]
        rest = grey[use] - plane @ np.linalg.lstsq(plane, grey[use], rcond=None)[0]
        levels.append(float(np.median(grey[use])))
        variances.append(float((rest**2).sum() / max(use.sum() - 3, 1)))
    contrast = levels[0] - levels[1]
    variance = variances[1] + share * (variances[0] - variances[1])
    design_matrix = [contrast * part for part in columns] + [
        np.ones_like(x),
        x,
        y,
        share,
        share * x,
        share * y,
    ]
    a = np.stack([part[inside] for part in design_matrix], axis=1)
    a = a / np.linalg.norm(a, axis=0) * np.append([1.0, 1.0], np.ones(a.shape[1] - 2))
    scale = np.array([np.linalg.norm((contrast * part)[inside]) for part in columns[:2]])
    cofactor = np.linalg.inv((a / variance[inside][:, None]).T @ a)
    return float(np.sqrt((np.diag(cofactor)[:2] / scale**2).mean()))


def misnamed(design: BoardDesign, own: Array, near: Array) -> int:
    """Points named against all symmetries: names must be those of nodes turned or reflected as a whole."""
    a = np.column_stack([design.nodes[own], np.ones(len(own))])
    b = design.nodes[near].astype(float)
    turn = np.linalg.lstsq(a, b, rcond=None)[0]
    whole = np.rint(turn)
    if not np.isclose(abs(np.linalg.det(whole[:2])), 1.0):
        return len(own)
    return int((np.abs(a @ whole - b).max(axis=1) > 0.1).sum())


@dataclass(frozen=True)
class Row:
    """A picture: its row, whether it is within its limits, and what is pooled where it was measured.

    Points `found` of those in `sight`, and those of OpenCV, rms errors, their bound and that of OpenCV (px),
    errors over sigmas, and processor times (s) of both.
    """

    text: str
    good: bool
    found: int = 0
    sight: int = 0
    theirs: int = 0
    rms: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    ratio: float = np.nan
    seconds: tuple[float, float] | None = None


def measured(folder: Path, target: str, rounds: int, picture: tuple[str, Any, bool]) -> Row:
    """Measure a picture of which name, truth, and whether it is seen from behind are given."""
    cv2.setNumThreads(1)
    name, truth, mirrored = picture
    design, condition = DESIGNS[target], truth["condition"]
    frame, xy = read_image(folder / name), np.array(truth["xy"])
    hidden = np.array(truth.get("hidden") or np.zeros(len(xy))) > 0
    sight = ~hidden & ((xy > 2) & (xy < [frame.width - 3, frame.height - 3])).all(axis=1)
    options = BoardOptions(mirrored=mirrored)
    found = measure_board(frame, design, options)  # compiled code is loaded before anything is timed
    seconds = their_time = np.inf
    for _ in range(rounds):
        others, theirs_now = by_opencv(target, frame.pixels)
        start = time.process_time()
        found = measure_board(frame, design, options)
        seconds = min(seconds, time.process_time() - start)
        their_time = min(their_time, theirs_now)
    if isinstance(found, Failure):
        right = (target, condition) == MIRRORED and not mirrored
        text = f"{name:24} declined: {found.reason} [{found.code}]  {'ok' if right else 'MISSED'}"
        return Row(text, right)
    own = np.flatnonzero(found.ok)
    near = np.hypot(*(found.xy[own, None] - xy[None]).transpose(2, 0, 1)).argmin(axis=1)
    error = found.xy[own] - xy[near]
    sigma = np.sqrt(np.diagonal(found.cov[own], axis1=1, axis2=2))
    wrong_names = misnamed(design, own, near)
    if target == "charuco":
        wrong_names = int((near != own).sum())
    off, scaled = np.hypot(*error.T), np.abs(error / sigma).max(axis=1)
    wrong = int(((off > WRONG_PX) & (scaled > WRONG_SIGMA)).sum())
    ratio, rms = float(np.sqrt(((error / sigma) ** 2).mean())), float(np.sqrt((error**2).mean()))
    theirs = np.nan
    if len(others):
        gap = (others[:, None] - xy[None])[np.arange(len(others)), np.hypot(
            *(others[:, None] - xy[None]).transpose(2, 0, 1)
        ).argmin(axis=1)]  # fmt: skip
        theirs = float(np.sqrt((gap**2).mean()))
    least = np.nan
    # Light of markers reaches the edges of small or blurred ChArUco squares: their bound is not computed.
    if target != "charuco" and (condition in BLUR or condition == "clean"):
        some = np.flatnonzero(sight)[:: max(1, int(sight.sum()) // SAMPLE)]
        steps = slopes(design, xy)
        each = [bound(design, frame.pixels, xy[k], steps[k], BLUR.get(condition, 0.7)) for k in some]
        least = float(np.sqrt(np.mean(np.square(each))))
    count = int((sight[near]).sum())
    slow = "  slow" if seconds > SLOWER * their_time else "      "
    good = count >= len(others) and not wrong and not wrong_names
    good &= NORMALISED[0] <= ratio <= NORMALISED[1]
    limit = LEAST_PX if np.isnan(least) else max(BOUND * least, LEAST_PX)
    good &= condition != "clean" or rms <= limit
    text = (
        f"{name:24} {count:4} of {int(sight.sum()):4} {len(others):4}  {rms:.4f} {least:7.4f} {theirs:7.4f}  "
        f"{off.max():.3f} {scaled.max():5.1f} {ratio:6.2f}  {wrong:3} {wrong_names:4}  "
        f"{seconds:6.2f} {their_time:6.2f}{slow}  {'ok' if good else 'MISSED'}"
    )
    figures = (rms, least, theirs), ratio, (seconds, their_time)
    return Row(text, bool(good), count, int(sight.sum()), len(others), *figures)


TITLES = {"charuco": "ChArUco board", "chess": "chessboard", "circ": "circle grid"}
CLEAN = {"_1_clean.png": "near", "_3_clean.png": "at 60°"}
"""Ends of the names of clean pictures, and their poses."""


def keep(target: str, names: list[str], rows: list[Row]) -> None:
    """Record the figures of the pictures of a target."""
    title = TITLES[target]
    for name, row in zip(names, rows, strict=True):
        pose = CLEAN.get(name.removeprefix(target))
        if pose is not None:
            for who, error in zip(("reseau", "bound", "OpenCV"), row.rms, strict=True):
                record(f"{title}, {pose}", who, error, table=BESIDE)
    done = [row for row in rows if row.seconds is not None]
    sight = sum(row.sight for row in done)
    for who, k, found in (
        ("reseau", 0, sum(row.found for row in done)),
        ("OpenCV", 2, sum(row.theirs for row in done)),
    ):
        record(f"{title}, {who}", "found", found, of=sight)
        record(f"{title}, {who}", "rms of a picture", [row.rms[k] for row in done], "px")
        seconds = [row.seconds[k // 2] for row in done if row.seconds is not None]
        record(f"{title}, {who}", "processor time", seconds, "s")
    ratios = [row.ratio for row in done]
    record(f"{title}, reseau", "errors ÷ sigmas", ratios)
    what = f"{title}"
    record(what, "independent, found", sum(row.found for row in done), of=sight, table=ORIGIN)
    record(what, "independent, errors ÷ sigmas", ratios, table=ORIGIN)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--target", choices=tuple(DESIGNS))
    parser.add_argument("--data", type=Path, help="folder of the pictures")
    parser.add_argument("--condition", nargs="+", default=[], help="only these conditions")
    parser.add_argument("--rounds", type=int, default=3, help="of measurements that are timed")
    add_options(parser)
    options = parser.parse_args()
    root = os.environ.get("RESEAU_DATA")
    folder = options.data or (Path(root) / "independent" / "boards" if root else None)
    if folder is None:
        print("RESEAU_DATA is not set, and --data not given: nothing to measure")
        return 1
    good, contents = True, json.loads((folder / "truth.json").read_text())
    with executor_of(options) as executor:
        for target in DESIGNS if options.target is None else (options.target,):
            pictures = [
                (name, truth, mirrored)
                for name, truth in sorted(contents.items())
                if truth.get("target") == target and (folder / name).is_file()
                if not options.condition or truth["condition"] in options.condition
                for mirrored in ((False, True) if (target, truth["condition"]) == MIRRORED else (False,))
            ]
            print(
                f"{target:24} measured OpenCV   rms   bound  OpenCV  worst sigma  ratio wrong name  "
                " seconds OpenCV"
            )
            rows = []
            work = partial(measured, folder.resolve(), target, options.rounds)
            for row in outcomes(executor, work, pictures):
                print(row.text, flush=True)
                rows.append(row)
            good &= all(row.good for row in rows)
            times = [row.seconds for row in rows if row.seconds is not None]
            if not times:
                continue
            ours, theirs = np.mean(times, axis=0)
            print(
                f"{target:24} mean of {len(times)} pictures: {ours:.3f} {theirs:.3f} s, "
                f"ratio {ours / theirs:.2f}"
            )
            keep(target, [name for name, _, _ in pictures], rows)
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
