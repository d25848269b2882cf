"""Real frames of vidicon cameras: marks found, internal consistency, and agreement with NASA's programs.

Run from the checkout: ``python benchmarks/reseau_frames.py [DATA] [--overlay DIR]``. The frames are read from
DATA/reseau, by default in $RESEAU_DATA or ../shared/data.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from figures import record
from shared import of_the_tests

from reseau.core.data import Array
from reseau.io import ReseauDesign
from reseau.io.images import write_image
from reseau.measure import measure_reseau
from reseau.measure.reseau.marks import ReseauOptions
from reseau.measure.reseau.measure import ReseauResult
from reseau.optics.field import SmoothField

TRIALS = 499
VECTORS = 50


@dataclass(frozen=True)
class Measured:
    """A frame with its result, processor time and wall time in s."""

    case: Any
    result: ReseauResult
    cpu: float
    wall: float


def measure(case: Any) -> Measured:
    cpu, wall = time.process_time(), time.perf_counter()
    result = measure_reseau(case.frame, case.design)
    if not result:
        raise SystemExit(f"{case.name}: {result.reason}")
    return Measured(case, result, time.process_time() - cpu, time.perf_counter() - wall)


def pair(values: Array, digits: int = 3) -> str:
    return "/".join(f"{value:.{digits}f}" for value in np.asarray(values).tolist())


def rms(deviation: Array) -> Array:
    return np.sqrt(np.mean(deviation**2, axis=0))


def found_table(frames: ModuleType, all_measured: list[Measured]) -> None:
    print(
        "Marks found. False: more than 1 px off the leave-one-out prediction of the others found, by distance"
    )
    print(
        "and by the worse axis. Need: probability that white noise would ask as much for a local model, x/y."
    )
    print(
        f"{'frame':<28} {'RESLOC':>6} {'ours':>5} {'both':>5} {'lost':>5} {'false':>7} {'farthest px':>12} "
        f"{'need':>12} {'cpu s':>6} {'wall s':>6}"
    )
    for m in all_measured:
        ok, reference = m.result.ok, m.case.others.get("vicar")
        theirs = np.zeros_like(ok) if reference is None else np.isfinite(reference[:, 0])
        deviation = m.result.deviation[ok]
        distance, axis = np.hypot(*deviation.T), np.abs(deviation).max(axis=1)
        source = m.case.design.xy[ok]
        need = SmoothField.fit(source, m.result.xy[ok], trials=TRIALS).need
        count = "-" if reference is None else str(theirs.sum())
        record(m.case.name, "RESLOC, found", np.nan if reference is None else int(theirs.sum()))
        record(m.case.name, "reseau, found", int(ok.sum()))
        record(m.case.name, "more than 1 px off the prediction by the others", int((distance > 1).sum()))
        print(
            f"{m.case.name:<28} {count:>6} {ok.sum():>5} {(ok & theirs).sum():>5} {(theirs & ~ok).sum():>5} "
            f"{f'{(distance > 1).sum()}, {(axis > 1).sum()}':>7} {distance.max():>12.2f} {pair(need):>12} "
            f"{m.cpu:>6.2f} {m.wall:>6.2f}"
        )
    print()


def deviation_table(frames: ModuleType, all_measured: list[Measured]) -> None:
    print("Leave-one-out rms x/y in px over the marks found by both, with the same predictor.")
    print(f"{'frame':<28} {'predictor':<34} {'marks':>5} {'RESLOC':>12} {'ours':>12}")
    for m in all_measured:
        reference, xy, source = m.case.others.get("vicar"), m.result.xy, m.case.design.xy
        both = m.result.ok if reference is None else m.result.ok & np.isfinite(reference[:, 0])
        rows = [("collocation", both, None)]
        if both.sum() >= 110:
            rows.append(("polynomial of 7th degree", both, 7))
            inner = both & frames.inner_marks(m.case.design)
            if inner.sum() == 118:
                rows.append(("polynomial of 7th degree, inner 118", inner, 7))
        for label, marks, degree in rows:
            ours = rms(frames.leave_one_out(source[marks], xy[marks], degree))
            theirs = (
                "-"
                if reference is None
                else pair(rms(frames.leave_one_out(source[marks], reference[marks], degree)))
            )
            if label == "collocation":
                if reference is not None:
                    off = rms(frames.leave_one_out(source[marks], reference[marks], degree))
                    record(m.case.name, "RESLOC, leave-one-out rms", np.sqrt((off**2).mean()), "px")
                record(m.case.name, "reseau, leave-one-out rms", np.sqrt((ours**2).mean()), "px")
            print(f"{m.case.name:<28} {label:<34} {marks.sum():>5} {theirs:>12} {pair(ours):>12}")
    print()


def agreement_table(frames: ModuleType, all_measured: list[Measured]) -> None:
    print("NASA's corrected frame against ours, resampled by marks: displacement of patches, object px, x/y.")
    print(
        f"{'frame':<28} {'marks of':<8} {'interpolation':<17} {'patches':>7} {'median':>14} {'MAD':>12} "
        f"{'1.4826 MAD':>12}"
    )
    for m in all_measured:
        if m.case.corrected is None:
            continue
        for label, xy in {"ours": m.result.xy, **m.case.others}.items():
            for interpolation in (frames.collocation, frames.piecewise_linear):
                found = frames.agreement(m.case, interpolation(m.case.design.xy, xy))
                print(
                    f"{m.case.name:<28} {label:<8} {interpolation.__name__:<17} {len(found.patches):>7} "
                    f"{pair(found.median):>14} {pair(found.mad):>12} {pair(1.4826 * found.mad):>12}"
                )
    print()


def disguised(design: ReseauDesign, rng: np.random.Generator, mirrored: bool) -> tuple[ReseauDesign, str]:
    """The design without nominal positions, its coordinates rotated, scaled and shifted."""
    angle, scale = np.deg2rad(rng.uniform(-10, 10)), float(np.exp(rng.uniform(-0.5, 0.5)))
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    xy = (design.xy * [1, -1 if mirrored else 1]) @ turn.T + rng.uniform(-5, 5, 2)
    points = tuple(
        point.model_copy(update={"x": float(x), "y": float(y), "nominal_px": None})
        for point, (x, y) in zip(design.points, xy, strict=True)
    )
    mark = design.mark
    grown = mark.model_copy(update={"size": None if mark.size is None else mark.size * scale})
    told = f"{np.rad2deg(angle):+.1f}°, ×{scale:.2f}{', mirrored' if mirrored else ''}"
    return design.model_copy(update={"points": points, "mark": grown}), told


def blind_table(all_measured: list[Measured], seed: int) -> None:
    print(
        "Without nominal positions; designs rotated, scaled, shifted and mirrored at random. Symmetric ones"
    )
    print("(Viking; Voyager except for one mark) match a frame from either side: their marks then have")
    print(
        "the same positions under other names, and the same names if the handedness of the design is given."
    )
    print(
        f"{'frame':<28} {'design':<34} {'found':>5} {'same':>5} {'places':>6} {'largest px':>10} {'cpu s':>6}"
    )
    rng = np.random.default_rng(seed)
    for m in all_measured:
        for mirrored in (False, True):
            design, told = disguised(m.case.design, rng, mirrored)
            if blind_row(m, design, told, ReseauOptions()):
                blind_row(m, design, f"{told}, told", ReseauOptions(mirrored=not mirrored))
    print()


def blind_row(m: Measured, design: ReseauDesign, told: str, options: ReseauOptions) -> bool:
    """Print one case; return whether it was matched from the other side."""
    begun = time.process_time()
    result = measure_reseau(m.case.frame, design, options)
    elapsed = time.process_time() - begun
    if not result:
        print(f"{m.case.name:<28} {told:<34} {result.reason}")
        return False
    both = result.ok & m.result.ok
    off = np.hypot(*(result.xy - m.result.xy)[both].T)
    away = np.hypot(*(result.xy[result.ok][:, None] - m.result.xy[None, m.result.ok]).transpose(2, 0, 1))
    print(
        f"{m.case.name:<28} {told:<34} {result.found:>5} {(off < 0.1).sum():>5} "
        f"{(away.min(axis=1) < 0.1).sum():>6} {off.max():>10.3f} {elapsed:>6.2f}"
    )
    return bool(np.median(off) > 10)


def overlay(m: Measured, folder: Path) -> None:
    """The frame, levelled to show faint marks, with the measured marks; enlarged three times."""
    zoom = 3
    grey = m.case.frame.pixels.astype(np.float32)
    mean = cv2.GaussianBlur(grey, (0, 0), 25)
    spread = np.sqrt(cv2.GaussianBlur((grey - mean) ** 2, (0, 0), 25)) + 1.0
    shown = np.clip(128 + 40 * (grey - mean) / spread, 0, 255).astype(np.uint8)
    shown = np.repeat(np.repeat(shown, zoom, axis=0), zoom, axis=1)
    image = np.ascontiguousarray(np.repeat(shown[:, :, None], 3, axis=2))
    r = m.result

    def at(xy: Array) -> tuple[int, int]:
        x, y = np.rint(zoom * xy + (zoom - 1) / 2).astype(int).tolist()
        return x, y

    for i, name in enumerate(r.ids):
        if r.ok[i]:
            cv2.circle(image, at(r.xy[i]), 4 * zoom, (80, 255, 80), 1, cv2.LINE_AA)
            tip = at(r.xy[i] + VECTORS / zoom * r.deviation[i])
            cv2.line(image, at(r.xy[i]), tip, (255, 200, 0), 1, cv2.LINE_AA)
        elif r.why[i] != "outside the frame":
            x, y = at(r.predicted[i])
            cv2.drawMarker(image, (x, y), (255, 70, 70), cv2.MARKER_TILTED_CROSS, 4 * zoom)
            cv2.putText(
                image, f"{name}: {r.why[i]}", (x + 9, y - 5), 0, 0.34, (255, 110, 110), 1, cv2.LINE_AA
            )
    folder.mkdir(parents=True, exist_ok=True)
    write_image(folder / f"{m.case.name}.png", image)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = os.environ.get("RESEAU_DATA", "../shared/data")
    parser.add_argument("data", nargs="?", type=Path, default=Path(default))
    parser.add_argument(
        "--overlay", type=Path, help="folder for pictures of the frames with the measured marks"
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of the random design systems")
    arguments = parser.parse_args()
    frames = of_the_tests("measure/frames.py")
    directory = arguments.data / "reseau"
    cases = [frames.load(name, directory) for name in frames.names(directory)]
    if not cases:
        print(f"no frames in {directory}")
        return 1
    measure(cases[0])  # the first call pays for imports
    all_measured = [measure(case) for case in cases]
    found_table(frames, all_measured)
    deviation_table(frames, all_measured)
    agreement_table(frames, all_measured)
    blind_table(all_measured, arguments.seed)
    if arguments.overlay is not None:
        for m in all_measured:
            overlay(m, arguments.overlay)
        print(
            f"pictures in {arguments.overlay}; vectors are deviations from the neighbours, ×{VECTORS} in px"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
