"""The real scans of film: what is found of their frames, and pictures of the edges to be looked at."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from reseau.data import Array
from reseau.refine.frame import FrameOptions, orient_frames
from reseau.report.frames import contact_sheet, frame_tile
from reseau.scans import open_scan

__all__ = ["print_real"]

_SCANS: dict[str, tuple[tuple[float, float], tuple[float, ...] | None]] = {
    "fac_neg.jpg": ((24.0, 36.0), None),
    "strw_in1.jpg": ((36.0, 24.0), None),
    "strw_in3.jpg": ((36.0, 24.0), None),
    "kino_1264.jpg": ((22.0, 16.0), (893, 1676, 2874, 3145)),
    "kino_1265.jpg": ((22.0, 16.0), (885, 1615, 2870, 3085)),
}
"""Formats, and where a frame is to be looked for among others: left, top, right, bottom."""


def print_real(folder: Path, pictures: Path | None) -> None:
    """Orient every real scan; they were copied by tilted cameras: shapes are known to 2 % and 1° only."""
    if not folder.is_dir():
        print(f"\nReal scans: no reference data in {folder}")
        return
    print("\nReal scans: status, largest σ of a corner in px, px/mm along x and y, bows of the edges in px")
    tiles = []
    for name, (size, near) in _SCANS.items():
        scan, start = open_scan(folder / name), time.perf_counter()
        options = FrameOptions((size,), near=_box(near), aspect_sigma=0.02, angle_sigma_deg=1.0)
        for result in orient_frames(scan, options):
            took = time.perf_counter() - start
            print(f"  {name:15s} {result.status:12s} {took:5.1f} s  {result.why}")
            tiles.append(frame_tile(scan, result.document()))
            if result.lines is None or result.px_per_mm is None:
                continue
            sigma = np.sqrt(np.diag(result.lines.covariance))
            x, y = result.px_per_mm
            bows = " ".join(f"{bow:.1f}" for bow in result.lines.bow)
            print(f"  {'':15s} σ {sigma.max():.2f}  scale {x:.2f} {y:.2f}  bows {bows}")
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        contact_sheet(pictures / "real.png", tiles)
        print(f"  overlays: {pictures / 'real.png'}")


def _box(near: tuple[float, ...] | None) -> Array | None:
    if near is None:
        return None
    x0, y0, x1, y1 = near
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
