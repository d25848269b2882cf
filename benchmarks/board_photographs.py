"""Real photographs of boards, beside OpenCV, and beside the PyPI package `aprilgrid` for AprilGrids.

Run from the checkout: ``python benchmarks/board_photographs.py --design board.json PHOTOGRAPH …``, with a
design by ``reseau design board``. For every photograph: points measured, and those of the other program; rms
deviation of the points that both have from a smooth mapping of the plane (a lens, or a polynomial), fitted to
each of them in turn. It contains by what the board is not plane.

The public photographs of ``docs/benchmarks/calibration.md``: the AprilGrids of EuRoC and TUM VI have 6 × 6
tags of 88 mm and a spacing of 0.3; the chessboard of ``udacity/CarND-Camera-Calibration`` has 9 × 7 squares,
those of ``sourishg/stereo-calibration`` and ``sourishg/fisheye-stereo-calibration`` have 10 × 7, the screen
of ``henrikmidtiby/camera-calibration-with-large-chessboards`` 60 × 34; the ChArUco board of
``DominikBabiarczyk/camera-calibration`` has 13 × 18 squares, markers of 15/20 of them, DICT_4X4_250.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
from drawn_boards import by_others
from numpy.typing import NDArray

import reseau
from reseau.core.data import Array
from reseau.core.failure import Failure
from reseau.io import BoardDesign
from reseau.measure import measure_board
from reseau.measure.plane.lens_mapping import mapping_through

COMMON_PX, SIGMA_PX, LEAST = 2.0, 0.05, 20


def by_another(path: Path, design: BoardDesign) -> Array:
    """Points (n, 2) that `aprilgrid` or OpenCV finds."""
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    if pixels.dtype != np.uint8:
        pixels = (pixels * (255.0 / pixels.max())).astype(np.uint8)
    return by_others(design, pixels)[0].xy


def scatter(at: Array, xy: Array, shape: tuple[int, int]) -> float:
    """Rms deviation of positions from a smooth mapping, pixels."""
    mapping = mapping_through(at, xy, np.full(len(at), SIGMA_PX), shape).mapping
    return float(np.sqrt(((mapping(at) - xy) ** 2).mean()))


def line(path: Path, design: BoardDesign) -> Array:
    """Measure a photograph and print its row: points of both programs, and their scatter."""
    frame, theirs = reseau.read_image(path), by_another(path, design)
    found = measure_board(frame, design)
    if isinstance(found, Failure):
        print(f"{path.name:32} declined: {found.reason}; other {len(theirs)}", flush=True)
        return np.array([0, len(theirs), np.nan, np.nan])
    own: NDArray[np.intp] = np.flatnonzero(found.ok)
    rms = [np.nan, np.nan]
    if len(theirs):
        gap = np.hypot(*(theirs[:, None] - found.xy[own][None]).transpose(2, 0, 1))
        both, of = own[gap.argmin(axis=1)], gap.min(axis=1) < COMMON_PX
        if of.sum() > LEAST:
            at, shape = design.xy[both[of]] / design.pitch, (frame.height, frame.width)
            rms = [scatter(at, xy, shape) for xy in (found.xy[both[of]], theirs[of])]
    print(f"{path.name:32} {len(own):5} {len(theirs):5}    {rms[0]:.3f}  {rms[1]:.3f}", flush=True)
    return np.array([len(own), len(theirs), *rms])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--design", type=Path, required=True)
    parser.add_argument("photographs", type=Path, nargs="+")
    given = parser.parse_args()
    design = reseau.read_design(given.design)
    assert isinstance(design, BoardDesign), "the design is not that of a board"
    print(f"{'photograph':32} found other  rms/px other")
    every = np.array([line(path, design) for path in given.photographs])
    for who, found, rms in zip(("reseau", "other"), every[:, :2].T, every[:, 2:].T, strict=True):
        known = rms[np.isfinite(rms)]
        text = f", rms {np.median(known):.3f} px (median)" if len(known) else ""
        print(f"{who:8} {(found > 0).sum()} of {len(every)} photographs, {found.sum():.0f} points{text}")
    return 0 if (every[:, 0] >= every[:, 1]).all() else 1


if __name__ == "__main__":
    sys.exit(main())
