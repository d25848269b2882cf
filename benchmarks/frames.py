"""Inner orientation of scanned frames: the evidence, printed by one command.

    python benchmarks/frames.py [--frames 200] [--jobs 2] [--only NAME …] [--real DIR] [--pictures DIR]

Simulated frames of every difficulty against their truth, beside the method of Cruz, Cardenal and Delgado as
their paper says it (`cruz.py`, with its search areas given); table 1 of the paper on a roll of each camera; a
roll of 36 and a frame of 40 megapixels by the clock; the real scans of the reference data.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from cruz import cruz_corners
from real_frames import print_real

from reseau.data import Array
from reseau.refine.frame import FrameOptions, FrameResult, orient_frames, roll_of, transformed
from reseau.scans import open_scan, scan_of
from reseau_sims.filmframe import HASSELBLAD, RICOH, Beside, FilmFrame

_FILM = {"perforations": True, "print": True, "neighbours": True}

CASES = {
    "plain": FilmFrame(),
    "contrast 0.25": FilmFrame(contrast=0.25),
    "tilt 14°": FilmFrame(tilt_deg=14.0),
    "tilt −15°, mirrored": FilmFrame(tilt_deg=-15.0, mirrored=True),
    "noise 8": FilmFrame(noise=8.0),
    "grain 10": FilmFrame(grain=10.0),
    "dust": FilmFrame(beside=Beside(dust=150)),
    "scratches": FilmFrame(beside=Beside(scratches=8)),
    "perforations, print": FilmFrame(beside=Beside(**_FILM)),
    "negative, all of film": FilmFrame(negative=True, beside=Beside(**_FILM, dust=40, scratches=3)),
    "bright line (7B)": FilmFrame(beside=Beside(lines=1)),
    "rods (7A)": FilmFrame(beside=Beside(rods=1)),
    "blown corner": FilmFrame(beside=Beside(blown=True)),
    "rounded corners": FilmFrame(format=RICOH._replace(radius=1.5)),
    "bowed edges": FilmFrame(bow_mm=0.1),
    "Hasselblad, slits": FilmFrame(format=HASSELBLAD),
}

PAPER = {"Ricoh, 600 dpi": (0.008, 0.014, 0.015, 0.010), "Hasselblad, 1200 dpi": (0.014, 0.018, 0.026, 0.028)}
"""Table 1, examples 1 and 2: affine σX, σY, conformal σX, σY in mm."""

SEEDS = 400_000
"""Of the first frame of every difficulty. Nothing was tuned to these: that was done on seeds below."""

Row = tuple[str, Array, Array, Array]


def _areas(corners: Array) -> Array:
    """Search areas as a user draws them: a millimetre to both sides at 600 dpi, between the corners."""
    boxes = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        low, high = np.minimum(a, b), np.maximum(a, b)
        across = 1 - k % 2
        low[across], high[across] = low[across] - 24, high[across] + 24
        low[1 - across], high[1 - across] = low[1 - across] + 10, high[1 - across] - 10
        boxes.append([*low, *high])
    return np.array(boxes)


def one(frame: FilmFrame) -> Row:
    """Status, errors and sigmas of ours, errors of the paper's method: of one simulated frame."""
    pixels = frame.scan()
    options = FrameOptions(formats=(frame.format[:2],))
    result = orient_frames(scan_of(pixels, dpi=frame.dpi), options)[0]
    truth, none = frame.truth.corners, np.full((4, 2), np.nan)
    error, sigma = none, none
    if result.lines is not None and result:
        error = result.lines.corners - truth
        sigma = np.sqrt(np.diag(result.lines.covariance)).reshape(4, 2)
    theirs = cruz_corners(pixels, _areas(truth), frame.negative)
    return result.status, error, sigma, none if theirs is None else theirs - truth


def print_cases(pool: ProcessPoolExecutor, count: int, only: list[str]) -> None:
    """The table of difficulties."""
    print(f"\nSimulated frames at 600 dpi, {count} of every difficulty; errors of corners in pixels")
    print("                        oriented  rms   largest  wrong by  sigmas      method of the paper")
    print("                           %      px      px      > 1 px   err/σ rms   rms/px  > 1 px")
    for name, frame in CASES.items():
        if only and not any(part in name for part in only):
            continue
        rows = list(pool.map(one, [frame.with_seed(SEEDS + seed) for seed in range(count)], chunksize=4))
        status = np.array([row[0] for row in rows])
        good = status == "oriented"
        error, sigma, theirs = (np.array([row[k] for row in rows]) for k in (1, 2, 3))
        e, s = error[good], sigma[good]
        far = np.abs(e).max(axis=(1, 2))
        away = np.nanmax(np.abs(np.nan_to_num(theirs, nan=99.0)), axis=(1, 2))
        known = np.isfinite(theirs).all(axis=(1, 2))
        rms = np.sqrt(np.mean(theirs[known] ** 2)) if known.any() else np.nan
        print(
            f"  {name:22s} {100 * good.mean():6.1f} {np.sqrt(np.mean(e**2)):7.3f} {far.max():7.2f} "
            f"{int((far > 1).sum()):7d} {np.sqrt(np.mean((e / s) ** 2)):11.2f} "
            f"{rms:10.2f} {100 * np.mean(away > 1):6.0f} %",
            flush=True,
        )


def print_table_1(pool: ProcessPoolExecutor, count: int) -> None:
    """Table 1 of the paper: transformations to calibrated corners, which a roll of frames gave."""
    print(f"\nTable 1: transformation to calibrated corners (from another {count} frames), σX σY in mm")
    print("                              affine           conformal")
    for name, form, dpi in (("Ricoh, 600 dpi", RICOH, 600.0), ("Hasselblad, 1200 dpi", HASSELBLAD, 1200.0)):
        base = FilmFrame(format=form, dpi=dpi, gate_seed=5, film_mm=0.008, scanner=3e-4)
        found = list(pool.map(_results, [base.with_seed(seed) for seed in range(2 * count)]))
        roll = roll_of(found[count:], dpi)
        if not roll:
            print(f"  {name:22s} {roll.reason}")
            continue
        cells = []
        for kind in ("affine", "similarity"):
            sigmas = []
            for result in found[:count]:
                document = result.document()
                change = transformed(document, roll.corners, kind) if result else None
                if change and change.sigma_mm:
                    sigmas.append(change.sigma_mm)
            cells += np.sqrt(np.mean(np.square(sigmas), axis=0)).tolist()
        paper = "  ".join(f"{value:.3f}" for value in PAPER[name])
        print(f"  {name:22s} ours  " + "  ".join(f"{value:.3f}" for value in cells))
        print(f"  {'':22s} paper {paper}")
        truth = base.gate - base.gate.mean(axis=0)
        mine = roll.corners.xy() - roll.corners.xy().mean(axis=0)
        side = np.hypot(*(np.roll(mine, -1, 0) - mine).T) - np.hypot(*(np.roll(truth, -1, 0) - truth).T)
        print(
            f"  {'':22s} calibrated corners of {roll.frames} frames: σ {roll.corners.sigma[0]:.4f} "  # type: ignore[index]
            f"{roll.corners.sigma[1]:.4f} mm, sides off the true gate by {np.abs(side).max():.4f} mm at most"  # type: ignore[index]
        )


def _results(frame: FilmFrame) -> FrameResult:
    return orient_frames(scan_of(frame.scan(), dpi=frame.dpi), FrameOptions(formats=(frame.format[:2],)))[0]


def _by_file(path: Path) -> str:
    return orient_frames(open_scan(path), FrameOptions(formats=((36.0, 24.0),)))[0].status


def print_times(pool: ProcessPoolExecutor) -> None:
    """A roll of 36 and a frame of 40 megapixels."""
    import resource

    import tifffile

    print("\nTimes and memory")
    with tempfile.TemporaryDirectory() as folder:
        paths = []
        for seed in range(36):
            paths.append(Path(folder) / f"{seed:02d}.tif")
            pixels = FilmFrame(seed, dpi=1200, beside=Beside(**_FILM)).scan()
            tifffile.imwrite(paths[-1], pixels, photometric="minisblack", resolution=(1200, 1200))
        start = time.perf_counter()
        status = list(pool.map(_by_file, paths))
        took = time.perf_counter() - start
        print(f"  roll of 36 frames, 1200 dpi: {took:.1f} s, {status.count('oriented')} oriented")
        large = Path(folder) / "large.tif"
        pixels = FilmFrame(1, dpi=4800, blur_px=2.0, colour=False, margin_mm=2.0).scan()
        tifffile.imwrite(large, np.repeat(pixels[:, :, None], 3, axis=2), photometric="rgb")
        size = large.stat().st_size / 1e6
        times = []
        for _ in range(3):
            start = time.perf_counter()
            state = _by_file(large)
            times.append(time.perf_counter() - start)
        print(f"  {pixels.size / 1e6:.0f} megapixels RGB ({size:.0f} MB): {min(times):.2f} s, {state}")
        del pixels
    peak = pool.submit(_peak).result()
    print(
        f"  peak memory of a worker: {peak:.0f} MB; of this process: "
        f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB (it simulates, too)"
    )


def _peak() -> float:
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument(
        "--only", nargs="*", default=[], help="parts of names of difficulties, or: table times real"
    )
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    data = Path(os.environ.get("RESEAU_DATA", beside))
    parser.add_argument("--real", type=Path, default=data / "film_frames")
    parser.add_argument("--pictures", type=Path, default=None, help="folder for the overlays of real scans")
    given = parser.parse_args()
    parts = {"table", "times", "real"}
    only = [name for name in given.only if name not in parts]
    with ProcessPoolExecutor(given.jobs) as pool:
        if only or not given.only:
            print_cases(pool, given.frames, only)
        if not given.only or "table" in given.only:
            print_table_1(pool, max(6, given.frames // 10))
        if not given.only or "times" in given.only:
            print_times(pool)
    if not given.only or "real" in given.only:
        print_real(given.real, given.pictures)


if __name__ == "__main__":
    main()
