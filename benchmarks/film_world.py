"""Corners of film frames in scans drawn by the way of the light, compared with their truth.

Run from the checkout: ``python benchmarks/film_world.py [--frames 4] [--strips 0] [--first 0] [--jobs 2]
[--only KIND …] [--rolls] [--each]``.
The scans are those of ``benchmarks/worlds/film.py``, which shares nothing with the project; their resolution
and format are given, and the curve of their grey values as a file states it, except for those of `UNSTATED`.
With `--rolls` no file states a curve, and the frames of a kind are a roll, which decides about it once.
For each kind: frames drawn, oriented, answered with three edges, wrong by more than 0.5 px and 5 sigma; of
those that are oriented rms and largest of the errors of corners, the same over sigmas, and the mean outwards.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from typing import NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from film_independent import far_off
from parts import add_options, executor_of, main_of, outcomes
from worlds.film import KINDS, World, frame, strip

from reseau.core.data import Array
from reseau.core.tone import ToneCurve
from reseau.execution import Executor
from reseau.io.scans import scan_of
from reseau.measure.film.curves import CurveEvidence, curves_of_roll, curves_of_scan
from reseau.procedures.film_frame import FrameOptions, FrameResult, orient_scan

UNSTATED = ("unstated curve", "negative, density")
"""Kinds whose file does not state that grey values are not proportional to the light."""
BY_THE_FILM = ("penumbra", "halation")
"""Kinds in which the film itself shows the edge of the gate elsewhere."""
_OUTWARDS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


class Row(NamedTuple):
    """What was said of a frame; errors and sigmas of its corners (4, 2), NaN if it was declined."""

    kind: str
    seed: int
    status: str
    why: str
    error: Array
    sigma: Array

    @property
    def wrong(self) -> bool:
        """Whether a corner is off by more than 0.5 px and 5 sigma."""
        return far_off(self.error, self.sigma)


STRIPS = ("slide", "negative", "soft", "dust, scratches")
"""Kinds of frames of which strips are drawn."""


def one_strip(job: tuple[str, int]) -> tuple[str, int, int, int]:
    """Draw a strip and orient its frames: numbers of those drawn, right in their order, and wrong."""
    kind, seed = job
    pixels, corners, scale = strip(KINDS[kind], seed)
    scan = replace(scan_of(pixels, dpi=25.4 * scale), curve=_curve(kind, KINDS[kind]))
    results = orient_scan(scan)
    right = wrong = 0
    for found in results:
        if found.lines is None or not found:
            continue
        sigma = np.sqrt(np.diag(found.lines.covariance)).reshape(4, 2)
        off = [far_off(found.lines.corners - truth, sigma) for truth in corners]
        wrong += all(off)
        right += not off[min((found.frame or 1) - 1, len(off) - 1)]
    return kind, len(corners), right, wrong


def _curve(kind: str, world: World) -> ToneCurve | None:
    """The curve that the file states."""
    if kind in UNSTATED or world.code == "linear":
        return None
    return ToneCurve(None if world.code == "srgb" else world.gamma)


def one(job: tuple[str, int, bool, Array | None]) -> tuple[Row, CurveEvidence | None]:
    """Draw and orient one frame; with or without the curve stated, and with that of its roll."""
    kind, seed, stated, share = job
    drawn = frame(KINDS[kind], 1000 * list(KINDS).index(kind) + seed)
    scan = scan_of(drawn.pixels, dpi=25.4 * drawn.px_per_mm)
    scan = replace(scan, curve=_curve(kind, KINDS[kind]) if stated else None)
    results = orient_scan(scan, FrameOptions(formats=(drawn.format_mm,), curves=share))
    curves = curves_of_scan(scan, (each.curves for each in results))
    found = [_compared(result, drawn.corners) for result in results if result.lines is not None and result]
    nothing = np.full((4, 2), np.nan)
    if not found:
        return Row(kind, seed, results[0].status, results[0].why, nothing, nothing), curves
    # Of the frames of a strip, the one in its middle.
    status, why, error, sigma = min(found, key=lambda each: float(np.abs(each[2]).max()))
    return Row(kind, seed, status, why, error, sigma), curves


def of_kind(executor: Executor, kind: str, seeds: range, rolls: bool) -> list[Row]:
    """Draw and orient frames of a kind, alone or as a roll."""
    found = list(outcomes(executor, one, ((kind, seed, not rolls, None) for seed in seeds)))
    if rolls:
        curves = curves_of_roll(own for _, own in found)
        shares = (None if curve is None else curve.share for curve in curves)
        jobs = ((kind, seed, False, share) for seed, share in zip(seeds, shares, strict=True))
        found = list(outcomes(executor, one, jobs))
    return [row for row, _ in found]


def _compared(result: FrameResult, truth: Array) -> tuple[str, str, Array, Array]:
    assert result.lines is not None
    error = result.lines.corners - truth
    return result.status, result.why, error, np.sqrt(np.diag(result.lines.covariance)).reshape(4, 2)


def _print(name: str, rows: list[Row]) -> None:
    good = [row for row in rows if row.status == "oriented" and not row.wrong]
    three = sum(row.status == "three-edges" for row in rows)
    wrong = sum(row.wrong for row in rows)
    text = f"{name:26} {len(rows):5} {len(good):8} {three:5} {wrong:5}"
    if good:
        error, sigma = np.array([r.error for r in good]), np.array([r.sigma for r in good])
        ratio = error / sigma
        text += f" {np.sqrt(np.mean(error**2)):8.3f} {np.sqrt(np.mean(ratio**2)):6.2f}"
        text += f" {np.abs(error).max():8.2f} {np.abs(ratio).max():5.1f} {np.mean(error * _OUTWARDS):+9.3f}"
    print(text, flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--frames", type=int, default=4, help="frames of each kind")
    parser.add_argument("--strips", type=int, default=0, help="strips of each of some kinds")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    add_options(parser)
    parser.add_argument("--only", nargs="*", default=[], help="parts of names of kinds")
    parser.add_argument("--rolls", action="store_true", help="frames of a kind are a roll without a curve")
    parser.add_argument("--each", action="store_true", help="print every frame that is not oriented, and why")
    given = parser.parse_args()
    kinds = [kind for kind in KINDS if not given.only or any(part in kind for part in given.only)]
    print(f"{'':26} drawn oriented three wrong   rms px  err/σ largest  of σ  outwards")
    every: list[Row] = []
    with executor_of(given) as executor:
        for kind in kinds:
            seeds = range(given.first, given.first + given.frames)
            rows = of_kind(executor, kind, seeds, given.rolls)
            _print(kind, rows)
            for row in rows:
                if row.wrong or (given.each and row.status != "oriented"):
                    mark = "WRONG " if row.wrong else ""
                    off = f"{np.abs(row.error).max():.2f} px, " if np.isfinite(row.error).all() else ""
                    print(f"    {row.seed}: {mark}{row.status}: {off}{row.why[:150]}")
            every += rows
        for kind in STRIPS if given.strips else ():
            seeds = range(given.first, given.first + given.strips)
            done = list(outcomes(executor, one_strip, ((kind, seed) for seed in seeds)))
            drawn, right, wrong = (sum(each[k] for each in done) for k in (1, 2, 3))
            print(
                f"strips of {kind:16} {len(done):4} {drawn:4} frames, {right} right in order, {wrong} wrong"
            )
    ours = [row for row in every if row.kind not in (*UNSTATED, *BY_THE_FILM)]
    _print("all but unstated, by film", ours)
    _print("all", every)
    return 1 if any(row.wrong for row in every) else 0


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
