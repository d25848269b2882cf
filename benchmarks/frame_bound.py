"""Cramér–Rao bound of an edge with a bright line behind it (Cruz et al., fig. 7B).

    python benchmarks/frame_bound.py [--frames 200]

For frames that are declined when processed alone: the smallest standard deviation of the ends of the edge
that the pixels allow, with edge and line, their contrasts in twenty sections and the end of the line unknown,
and the width of the point-spread function known. The geometry is that of the frame without noise; the noise
is that of the scan.
"""

from __future__ import annotations

import argparse
import dataclasses
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from frames import CASES, SEEDS

from reseau.core.data import Array
from reseau.io.scans import Scan, scan_of
from reseau.measure.film import orient_frames
from reseau.measure.film.adjacent_lines import ends_with_line
from reseau.measure.film.border import read_band
from reseau.measure.film.orientation import FrameOptions
from reseau_sims.filmframe import Beside, FilmFrame

LIMIT_PX = 0.33
"""Standard deviation of a corner above which a frame is not oriented."""
_DARK = 14.0
_REACH_PX = 20.0


def scanned(frame: FilmFrame) -> Scan:
    """Without noise and grain."""
    return scan_of(np.rint(frame.light()).astype(np.uint8), dpi=frame.dpi)


def bound(frame: FilmFrame) -> Array:
    """Standard deviations (2,) of the ends of the edge beside the line, pixels."""
    seen, bare = scanned(frame), scanned(dataclasses.replace(frame, beside=Beside()))
    corners = frame.truth.corners
    bands = [
        (
            read_band(seen, corners[k], corners[(k + 1) % 4], _REACH_PX, _REACH_PX),
            read_band(bare, corners[k], corners[(k + 1) % 4], _REACH_PX, _REACH_PX),
        )
        for k in range(4)
    ]
    band = max(bands, key=lambda pair: float(np.nanmean(np.abs(pair[0].grey - pair[1].grey))))[0]
    nought = np.zeros(len(band.place))
    noise, width = float(np.hypot(frame.noise, frame.grain)), float(np.hypot(frame.blur_px, 12**-0.5))
    found = ends_with_line(band.grey[:, :, 0].astype(np.float64), band, nought, nought + _DARK, noise, width)
    return np.full(2, np.inf) if found is None else np.sqrt(np.diag(found.covariance))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=200)
    count, declined, beyond = parser.parse_args().frames, 0, 0
    print("Frames declined alone, and the bound of the ends of their edge in pixels")
    for seed in range(SEEDS, SEEDS + count):
        frame = CASES["bright line (7B)"].with_seed(seed)
        options = FrameOptions(formats=(frame.format[:2],))
        result = orient_frames(scan_of(frame.scan(), dpi=frame.dpi), options)[0]
        if result.status == "oriented":
            continue
        ends = bound(frame)
        declined, beyond = declined + 1, beyond + int(ends.max() > LIMIT_PX)
        print(f"  {seed}  {ends[0]:.2f} {ends[1]:.2f}  {result.why}", flush=True)
    print(f"{declined} of {count} declined; for {beyond} the bound of an end exceeds {LIMIT_PX} px")


if __name__ == "__main__":
    main()
