"""Real photographs of a chessboard, measured by the project, by OpenCV and by ``mrgingham``.

Run from the checkout: ``RESEAU_DATA=… python benchmarks/stereo_chessboard.py``. For the left and the right
camera of ``chessboard_stereo``: photographs in which corners were found, and corners; rms of the reprojection
in ``cv2.calibrateCamera``; rms of each photograph with the camera calibrated from the others.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from figures import record

from reseau.designs import board
from reseau.io.images import read_image
from reseau.measure import measure_board

DESIGN = board("chess", 10, 7, 25.0)
PLANE = np.column_stack([DESIGN.xy * [1, -1], np.zeros(len(DESIGN.xy))]).astype(np.float32)
LEAST, SIZE = 20, (640, 480)
Seen = tuple[Any, Any]


def by_us(path: Path) -> Seen | None:
    found = measure_board(read_image(path), DESIGN)
    return (PLANE[found.ok], found.xy[found.ok].astype(np.float32)) if found else None


def by_opencv(path: Path) -> Seen | None:
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    pixels: Any = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    good, xy = cv2.findChessboardCornersSB(pixels, (9, 6), flags=flags)
    return (PLANE, xy.reshape(-1, 2)) if good else None


def by_mrgingham(path: Path) -> Seen | None:
    # Only square grids are found: nothing, unless the board has as many rows as columns.
    out = subprocess.run(
        ["mrgingham", "--gridn", "9", str(path)], capture_output=True, text=True, check=False
    )
    rows = [line.split()[1:3] for line in out.stdout.splitlines() if not line.startswith("#")]
    xy = [(float(x), float(y)) for x, y in rows if x != "-"]
    return (PLANE, np.array(xy, np.float32)) if len(xy) == len(PLANE) else None


def main() -> int:
    root = os.environ.get("RESEAU_DATA")
    if root is None:
        print("RESEAU_DATA is not set: nothing to measure")
        return 1
    others = {"reseau": by_us, "OpenCV": by_opencv}
    if shutil.which("mrgingham"):
        others["mrgingham"] = by_mrgingham
    for side in ("left", "right"):
        for name, measure in others.items():
            found = [
                measure(path) for path in sorted((Path(root) / "chessboard_stereo").glob(f"{side}*.jpg"))
            ]
            seen = [one for one in found if one is not None and len(one[1]) >= LEAST]
            record(f"{side}, {name}", "photographs", len(seen), of=len(found))
            if len(seen) < 3:
                print(f"{side:6} {name:10} {len(seen):2} of {len(found)} photographs")
                continue
            a, b = [one[0] for one in seen], [one[1] for one in seen]
            none: Any = None
            rms = cv2.calibrateCamera(a, b, SIZE, none, none)[0]
            square = []
            for k in range(len(seen)):
                rest = a[:k] + a[k + 1 :], b[:k] + b[k + 1 :]
                _, camera, lens, *_ = cv2.calibrateCamera(*rest, SIZE, none, none)
                _, turn, shift = cv2.solvePnP(a[k], b[k], camera, lens)
                image = cv2.projectPoints(a[k], turn, shift, camera, lens)[0].reshape(-1, 2)
                square.append(((image - b[k]) ** 2).sum(axis=1))
            crossed = float(np.sqrt(np.concatenate(square).mean()))
            record(f"{side}, {name}", "corners", sum(map(len, b)))
            record(f"{side}, {name}", "reprojection", rms, "px")
            record(f"{side}, {name}", "cross-validated", crossed, "px")
            print(
                f"{side:6} {name:10} {len(seen):2} of {len(found)} photographs, {sum(map(len, b))} corners: "
                f"reprojection {rms:.3f} px, cross-validated {crossed:.3f} px"
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
