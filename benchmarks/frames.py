"""Inner orientation of scanned frames: accuracy, time and memory.

    python benchmarks/frames.py [--frames 200] [--jobs 2] [--only NAME …] [--without]
        [--real DIR] [--pictures DIR]

Simulated frames of every difficulty compared with their truth, and with the method of Cruz, Cardenal and
Delgado (`cruz.py`, with given search areas); table 1 of the paper on a roll of each camera; time of a roll of
36 frames and of a frame of 40 megapixels; the real scans of the reference data.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from cruz import cruz_corners
from figures import ORIGIN, record
from parts import add_options, executor_of, main_of, outcomes
from real_frames import print_real

from reseau.core.data import Array
from reseau.core.tone import ToneCurve
from reseau.execution import Executor, Processes
from reseau.io.images import open_scan
from reseau.io.scans import scan_of
from reseau.measure.film import orient_frames
from reseau.measure.film.orientation import FrameOptions, FrameResult
from reseau.measure.film.roll import Roll, rolls_of, transformed
from reseau.procedures.film_frame import reorient_scan
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
    "soft, hardly noise": FilmFrame(blur_px=1.5, noise=0.5, grain=0.5),
    "sharp, clean": FilmFrame(blur_px=0.3, noise=0.5, grain=0.0),
    "sharp, 9°, bowed": FilmFrame(blur_px=0.4, noise=0.8, grain=0.5, tilt_deg=9.0, bow_mm=0.05),
    "out of focus": FilmFrame(blur_px=0.4, defocus_px=3.0),
    "spread by carriage": FilmFrame(blur_px=0.5, carriage_px=0.45),
    "sRGB, stated": FilmFrame(srgb=True, blur_px=1.0),
    "trees": FilmFrame(scene="trees"),
    "trees, faded edges": FilmFrame(scene="trees", fade=0.75),
    "trees, faint": FilmFrame(scene="trees", fade=0.8, contrast=0.25, noise=2.0, grain=1.0),
    "two bright lines": FilmFrame(beside=Beside(lines=2)),
    "two lines, colour": FilmFrame(beside=Beside(lines=2), colour=True),
    "1200 dpi, soft": FilmFrame(dpi=1200, blur_px=2.5),
    "1200 dpi, soft, film": FilmFrame(dpi=1200, blur_px=2.5, beside=Beside(**_FILM, dust=40, scratches=3)),
    "1200 dpi, soft, 7A": FilmFrame(dpi=1200, blur_px=2.5, beside=Beside(rods=1)),
}

SIDE_BY_SIDE = {
    "sharp, clean": "film, sharp and clean",
    "sharp, 9°, bowed": "film, tilted",
    "perforations, print": "film, perforated",
    "out of focus": "film, out of focus",
}
"""Difficulties that `film_independent.py` has, too, by their rows there."""

PAPER = {"Ricoh, 600 dpi": (0.008, 0.014, 0.015, 0.010), "Hasselblad, 1200 dpi": (0.014, 0.018, 0.026, 0.028)}
"""Table 1, examples 1 and 2: affine σX, σY, conformal σX, σY in mm."""

SEEDS = 700_000
"""Seed of the first frame of every difficulty; seeds below were used for development."""

Row = tuple[FrameResult, Array, Array, Array]


def _areas(corners: Array) -> Array:
    """Search areas as selected by a user: one millimetre to both sides at 600 dpi, between the corners."""
    boxes = []
    for k in range(4):
        a, b = corners[k], corners[(k + 1) % 4]
        low, high = np.minimum(a, b), np.maximum(a, b)
        across = 1 - k % 2
        low[across], high[across] = low[across] - 24, high[across] + 24
        low[1 - across], high[1 - across] = low[1 - across] + 10, high[1 - across] - 10
        boxes.append([*low, *high])
    return np.array(boxes)


def one(frame: FilmFrame, known: bool = True) -> Row:
    """Our result, its errors and sigmas, and errors of the paper's method, for one simulated frame."""
    pixels = frame.scan()
    grey = pixels if pixels.ndim == 2 else pixels[:, :, 0]
    options = FrameOptions(formats=(frame.format[:2],)) if known else FrameOptions()
    scan = scan_of(pixels, dpi=frame.dpi if known else None)
    scan = replace(scan, curve=ToneCurve(None) if frame.srgb else None)
    result = orient_frames(scan, options)[0]
    truth, none = frame.truth.corners, np.full((4, 2), np.nan)
    theirs = cruz_corners(grey, _areas(truth), frame.negative)
    return result, *_errors(result, frame), none if theirs is None else theirs - truth


def _errors(result: FrameResult, frame: FilmFrame) -> tuple[Array, Array]:
    """Errors and standard deviations of the corners (4, 2); NaN where it was declined."""
    if result.lines is None or not result:
        return np.full((4, 2), np.nan), np.full((4, 2), np.nan)
    sigma = np.sqrt(np.diag(result.lines.covariance)).reshape(4, 2)
    return np.asarray(result.lines.corners - frame.truth.corners), sigma


def with_roll(doubtful: tuple[FrameResult, FilmFrame, tuple[Roll, ...]]) -> tuple[str, float]:
    """Status and largest error of a frame with the shape of its roll, if it was not oriented without."""
    before, frame, rolls = doubtful
    options = FrameOptions(formats=(frame.format[:2],))
    result = reorient_scan(scan_of(frame.scan(), dpi=frame.dpi), rolls, [before], options)[0]
    return result.status, float(np.abs(_errors(result, frame)[0]).max())


def print_cases(executor: Executor, count: int, only: list[str], stated: bool) -> None:
    """The table of difficulties."""
    what = "" if stated else ", format and resolution not given"
    print(f"\nSimulated frames at 600 dpi, {count} of every difficulty{what}; errors of corners in pixels")
    print("                        oriented  rms   largest  wrong by  sigmas      method of the paper")
    print("                           %      px      px      > 1 px   err/σ rms   rms/px  > 1 px")
    for name, frame in CASES.items():
        if only and not any(part in name for part in only):
            continue
        drawn = (frame.with_seed(SEEDS + seed) for seed in range(count))
        rows = list(outcomes(executor, partial(one, known=stated), drawn))
        good = np.array([row[0].status == "oriented" for row in rows])
        error, sigma, theirs = (np.array([row[k] for row in rows]) for k in (1, 2, 3))
        if not good.any():
            print(f"  {name:22s}    0.0", flush=True)
            continue
        e, s = error[good], sigma[good]
        ratios = np.sqrt(np.mean((e / s) ** 2, axis=(1, 2)))
        record(name, "oriented", int(good.sum()), of=len(good))
        record(name, "rms of a frame", np.sqrt(np.mean(e**2, axis=(1, 2))), "px")
        record(name, "errors ÷ sigmas", np.sqrt(np.mean((e / s) ** 2)))
        record(name, "Hough method, rms of a frame", np.sqrt(np.mean(theirs**2, axis=(1, 2))), "px")
        if name in SIDE_BY_SIDE:
            row = SIDE_BY_SIDE[name]
            record(row, "simulator, found", int(good.sum()), of=len(good), table=ORIGIN)
            record(row, "simulator, errors ÷ sigmas", ratios, table=ORIGIN)
        far = np.abs(e).max(axis=(1, 2))
        away = np.nanmax(np.abs(np.nan_to_num(theirs, nan=99.0)), axis=(1, 2))
        known = np.isfinite(theirs).all(axis=(1, 2))
        rms = np.sqrt(np.mean(theirs[known] ** 2)) if known.any() else np.nan
        print(
            f"  {name:22s} {100 * good.mean():6.1f} {np.sqrt(np.mean(e**2)):7.3f} {far.max():7.2f} "
            f"{int((far > 1).sum()):7d} {np.sqrt(np.mean((e / s) ** 2)):11.2f} "
            f"{rms:10.2f} {100 * np.mean(away > 1):6.0f} %"
            f"{_of_roll(executor, frame, [row[0] for row in rows])}",
            flush=True,
        )


def _of_roll(executor: Executor, frame: FilmFrame, results: list[FrameResult]) -> str:
    """Orient the remaining frames with the shape of the oriented frames of the same camera."""
    rolls = rolls_of(results, frame.dpi)
    doubtful = [
        (result, frame.with_seed(SEEDS + seed), rolls)
        for seed, result in enumerate(results)
        if result.status != "oriented"
    ]
    if not doubtful or not rolls:
        return ""
    again = [far for status, far in outcomes(executor, with_roll, doubtful) if status == "oriented"]
    share = 100 * (1 - (len(doubtful) - len(again)) / len(results))
    return f"  with its roll {share:.1f} %, those by {max(again, default=0.0):.2f} px at most"


def print_table_1(executor: Executor, count: int) -> None:
    """Table 1 of the paper: transformations to corners calibrated with a roll of frames."""
    print(f"\nTable 1: transformation to calibrated corners (from another {count} frames), σX σY in mm")
    print("                              affine           conformal")
    for name, form, dpi in (("Ricoh, 600 dpi", RICOH, 600.0), ("Hasselblad, 1200 dpi", HASSELBLAD, 1200.0)):
        base = FilmFrame(format=form, dpi=dpi, gate_seed=5, film_mm=0.008, scanner=3e-4)
        found = list(outcomes(executor, _results, map(base.with_seed, range(2 * count))))
        rolls = rolls_of(found[count:], dpi)
        if not rolls:
            print(f"  {name:22s} too few frames are oriented")
            continue
        roll = rolls[0]
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


def _commanded(*arguments: object) -> tuple[str, float, float, float]:
    """Output of `reseau orient`, wall and processor time in s, peak memory in MB."""
    start = time.perf_counter()
    command = [str(Path(sys.executable).with_name("reseau")), "orient", *map(str, arguments)]
    command += ["--format-mm", "36x24"]
    with tempfile.TemporaryFile() as said:
        child = subprocess.Popen(command, stdout=said)
        _, _, used = os.wait4(child.pid, 0)
        took = time.perf_counter() - start
        said.seek(0)
        text = said.read().decode()
    return text, took, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def print_times() -> None:
    """A roll of 36, a frame of 40 megapixels, and scans of 600 MB by the command, for its memory."""
    print("\nWall time, processor time and memory of `reseau orient`, including its start")
    with tempfile.TemporaryDirectory() as name, Processes(2) as executor:
        # Other processes make the scans: a child begins with the memory of its parent.
        folder = Path(name)
        paths = list(outcomes(executor, partial(_roll_frame, folder), range(36)))
        said, took, used, _ = _commanded(*paths, "--out", folder / "out", "--jobs", 2)
        done = said.count(": oriented")
        print(f"  roll of 36 at 1200 dpi, with marked copies: {took:.1f} s, {used:.1f} s, {done} oriented")
        ((plain, wide, coded),) = outcomes(executor, _large, [folder])
        runs = [run for _ in range(3) for run in outcomes(executor, _oriented_within, [plain])]
        took, used = (min(run[k] for run in runs) for k in (1, 2))
        print(f"  40 megapixels, uncompressed, without the start: {took:.2f} s, {used:.2f} s, {runs[0][0]}")
        size, out = wide.stat().st_size / 1e6, folder / "large"
        for what, path, given in (
            ("", wide, ()),
            (", with a marked copy", wide, ("--out", out)),
            (", LZW, one row per strip, with a marked copy", coded, ("--out", out)),
        ):
            said, took, used, peak = _commanded(path, "--jobs", 1, *given)
            done = said.count(": oriented")
            print(
                f"  RGB of 16 bit, {size:.0f} MB{what}: {took:.1f} s, {used:.1f} s, {peak:.0f} MB at most, "
                f"{done} oriented"
            )


def _roll_frame(folder: Path, seed: int) -> Path:
    import tifffile

    path = folder / f"{seed:02d}.tif"
    pixels = FilmFrame(seed, dpi=1200, beside=Beside(**_FILM)).scan()
    tifffile.imwrite(path, pixels, photometric="minisblack", resolution=(1200, 1200))
    return path


def _large(folder: Path) -> tuple[Path, Path, Path]:
    """A scan of 40 megapixels, the same at 7700 dpi in colour, and this compressed row by row."""
    import cv2
    import tifffile

    pixels = FilmFrame(1, dpi=4800, blur_px=2.0, margin_mm=2.0).scan()
    plain, wide, coded = (folder / f"{name}.tif" for name in ("plain", "wide", "coded"))
    tifffile.imwrite(plain, pixels, photometric="minisblack", resolution=(4800, 4800))
    finer = cv2.resize(pixels, None, fx=1.6, fy=1.6, interpolation=cv2.INTER_LINEAR).astype(np.uint16) * 257
    colours = np.repeat(finer[:, :, None], 3, axis=2)
    tifffile.imwrite(wide, colours, photometric="rgb")
    tifffile.imwrite(coded, colours, photometric="rgb", compression="lzw", rowsperstrip=1)
    return plain, wide, coded


def _oriented_within(path: Path) -> tuple[str, float, float]:
    """Status, time by the clock and processor time of opening and orienting in this process."""
    start, used = time.perf_counter(), time.process_time()
    result = orient_frames(open_scan(path), FrameOptions(formats=((36.0, 24.0),)))[0]
    return result.status, time.perf_counter() - start, time.process_time() - used


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=200)
    add_options(parser)
    parser.add_argument("--without", action="store_true", help="frames without their format")
    parser.add_argument(
        "--only", nargs="*", default=[], help="parts of names of difficulties, or: table, times, real"
    )
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    data = Path(os.environ.get("RESEAU_DATA", beside))
    parser.add_argument("--real", type=Path, default=data / "film_frames")
    parser.add_argument("--pictures", type=Path, default=None, help="folder for the overlays of real scans")
    given = parser.parse_args()
    parts = {"table", "times", "real"}
    only = [name for name in given.only if name not in parts]
    with executor_of(given) as executor:
        if only or not given.only:
            print_cases(executor, given.frames, only, not given.without)
        if not given.only or "table" in given.only:
            print_table_1(executor, max(6, given.frames // 10))
        if not given.only or "times" in given.only:
            print_times()
    if not given.only or "real" in given.only:
        print_real(given.real, given.pictures)


if __name__ == "__main__":
    main_of(__file__)
