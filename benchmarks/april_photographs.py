"""Real photographs of an AprilGrid, beside the PyPI package `aprilgrid`.

Run from the checkout: ``python benchmarks/april_photographs.py --design grid.json PHOTOGRAPH …``, with a
design by ``reseau design board --from aprilgrid.yaml --json grid.json``. The grids of EuRoC and TUM VI have
6 × 6 tags of 88 mm and a spacing of 0.3. For every photograph: corners measured, and those of the package;
rms deviation of the corners that both have from a smooth mapping of the plane (a lens, or a polynomial),
fitted to each of them in turn. It contains by what the board is not plane.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import reseau
from reseau.core.data import Array
from reseau.core.failure import Failure
from reseau.io import BoardDesign
from reseau.measure import measure_board
from reseau.measure.reseau.lens_mapping import mapping_through

COMMON_PX, SIGMA_PX = 2.0, 0.05


def by_package(path: Path) -> Array:
    """Corners (n, 2) that the package finds."""
    from aprilgrid import Detector

    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    if pixels.dtype != np.uint8:
        pixels = (pixels * (255.0 / pixels.max())).astype(np.uint8)
    found = [tag.corners.reshape(-1, 2) for tag in Detector("t36h11").detect(pixels)]
    return np.concatenate(found).astype(np.float64) if found else np.zeros((0, 2))


def scatter(at: Array, xy: Array, shape: tuple[int, int]) -> float:
    """Rms deviation of positions from a smooth mapping, pixels."""
    mapping = mapping_through(at, xy, np.full(len(at), SIGMA_PX), shape).mapping
    return float(np.sqrt(((mapping(at) - xy) ** 2).mean()))


def line(path: Path, design: BoardDesign) -> bool:
    """Measure a photograph and print its row; whether it has as many corners as the package finds."""
    frame, theirs = reseau.read_image(path), by_package(path)
    found = measure_board(frame, design)
    if isinstance(found, Failure):
        print(f"{path.name:32} declined: {found.reason}; other {len(theirs)}", flush=True)
        return not len(theirs)
    own: NDArray[np.intp] = np.flatnonzero(found.ok)
    gap = np.hypot(*(theirs[:, None] - found.xy[own][None]).transpose(2, 0, 1))
    both, of = own[gap.argmin(axis=1)], gap.min(axis=1) < COMMON_PX
    at, shape = design.xy[both[of]] / design.pitch, (frame.height, frame.width)
    rms = (
        [scatter(at, xy, shape) for xy in (found.xy[both[of]], theirs[of])] if of.sum() > 20 else [np.nan] * 2
    )
    print(f"{path.name:32} {len(own):5} {len(theirs):5}    {rms[0]:.3f}  {rms[1]:.3f}", flush=True)
    return len(own) >= len(theirs)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--design", type=Path, required=True)
    parser.add_argument("photographs", type=Path, nargs="+")
    given = parser.parse_args()
    design = reseau.read_design(given.design)
    assert isinstance(design, BoardDesign), "the design is not that of a board"
    print(f"{'photograph':32} found other  rms/px other")
    good = [line(path, design) for path in given.photographs]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
