"""Formed frames with known truth: errors of measured marks compared with the Cramér–Rao bound, and time.

Run from the checkout: ``python benchmarks/reseau_formed.py [--least N] [--only TEXT]``. Frames of 210 marks
are measured with `measure_reseau`. In the bound, position, width of the point-spread function, contrast,
level and slopes of the background, and size are unknown; all simulated noise is included.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
from figures import ORIGIN, record
from shared import of_the_tests

from reseau.optics.sensor import sigma_of_snr

MOST_RATIO, MOST_BIAS_PX, MOST_BIAS_SIGMA_PX = 1.15, 0.002, 0.0005
NORMALISED = (0.9, 1.1)
MOST_SECONDS = 0.3
BATCH, MOST_FRAMES = 4, 120


def scenes(formed: ModuleType) -> Iterator[tuple[str, Any]]:
    """Cases: every shape, with one parameter changed at a time."""
    for shape, mark in formed.MARKS.items():
        base = formed.Scene(mark=mark)
        for polarity in ("dark", "bright"):
            for snr in (30, 40, 50):
                yield (
                    f"{shape}, {polarity}, {snr} dB",
                    replace(base, polarity=polarity, sigma=sigma_of_snr(snr)),
                )
        for psf in (0.5, 1.0, 1.5):
            yield f"{shape}, psf {psf} px", replace(base, psf_px=psf)
        yield f"{shape}, fill factor 0.8", replace(base, fill=0.8)
        yield f"{shape}, fill factor 0.8, psf 0.5 px", replace(base, fill=0.8, psf_px=0.5)
        yield f"{shape}, shot noise 10 e/grey", replace(base, gain=10.0, sigma=1.0)
        yield f"{shape}, row jitter 0.05 px", replace(base, jitter_px=0.05)
        yield f"{shape}, gradient of light", replace(base, gradient=(0.3, -0.2))
        yield f"{shape}, 8 bits", replace(base, quantise=True)
        yield f"{shape}, 8 bits, 50 dB", replace(base, quantise=True, sigma=sigma_of_snr(50))
        yield (
            f"{shape}, all together",
            replace(base, gain=20.0, sigma=1.0, jitter_px=0.03, fill=0.8, gradient=(0.2, 0.1), quantise=True),
        )


def enough(formed: ModuleType, scene: Any, least: int) -> Any:
    """Form frames until there are enough marks and the bias is sufficiently precise."""
    parts: list[Any] = []
    while len(parts) * BATCH < MOST_FRAMES:
        parts.append(formed.measure_many(scene, BATCH, seed=len(parts)))
        together = formed.Statistics.together(parts)
        if len(together.error) >= least and together.bias_sigma.max() < MOST_BIAS_SIGMA_PX:
            break
    return together


def pair(values: Any, digits: int) -> str:
    return "/".join(f"{value:.{digits}f}" for value in np.asarray(values).tolist())


def row(label: str, s: Any) -> bool:
    """Print one case; return whether it satisfies the limits."""
    bias, sigma = np.abs(s.bias).max(), s.bias_sigma.max()
    missed = s.expected - len(s.error)
    remarks = [
        text
        for text, bad in (
            ("rms", s.ratio.max() > MOST_RATIO),
            ("bias", bias > MOST_BIAS_PX),
            ("sigmas", not (NORMALISED[0] <= s.normalised.min() and s.normalised.max() <= NORMALISED[1])),
            ("missed", missed > 0),
        )
        if bad
    ]
    worst, worst_sigma = s.bias_by_phase()
    record(label, "measured", len(s.error), of=s.expected)
    record(label, "rms", np.sqrt(np.mean(np.square(s.rms))), "px")
    record(label, "rms ÷ bound", s.ratio)
    record(label, "largest bias", bias, "px")
    record(label, "errors ÷ sigmas", s.normalised)
    print(
        f"{label:<34} {len(s.error):>6} {missed:>3} {pair(s.rms, 4):>13} {pair(s.ratio, 3):>11} "
        f"{pair(s.bias * 1e3, 2):>11} ±{sigma * 1e3:.2f} {worst * 1e3:>6.2f} ±{worst_sigma * 1e3:.2f} "
        f"{pair(s.normalised, 3):>11}  {', '.join(remarks) or 'ok'}",
        flush=True,
    )
    return not remarks


def speed(formed: ModuleType) -> None:
    """The time for the marks of an 800×800 frame, the best of five and the median."""
    print("\nSeconds for 202 marks (design of 15×14 without 8) in 800×800 pixels, best and median of five:")
    for shape, mark in formed.MARKS.items():
        scene = formed.Scene(mark=mark, missing=frozenset(range(0, 208, 26)))
        frame = formed.form(scene, np.random.default_rng(0))
        kept = tuple(p for i, p in enumerate(frame.design.points) if i not in scene.missing)
        design = frame.design.model_copy(update={"points": kept, "origin": None, "axis": None})
        frame = replace(frame, design=design)
        times = []
        for _ in range(6):
            cpu, wall = time.process_time(), time.perf_counter()
            result = formed.measured(scene, frame)
            times.append((time.process_time() - cpu, time.perf_counter() - wall))
        cpu_s, wall_s = np.array(times[1:]).T
        print(
            f"  {shape:<10} {result.found} marks   processor {cpu_s.min():.3f} {np.median(cpu_s):.3f}   "
            f"wall {wall_s.min():.3f} {np.median(wall_s):.3f}"
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--least", type=int, default=2000, help="marks per case")
    parser.add_argument("--only", default="", help="only cases whose name contains this text")
    arguments = parser.parse_args()
    formed = of_the_tests("measure/formed.py")
    print(
        f"{'case (40 dB, psf 0.8 px, dark)':<34} {'marks':>6} {'not':>3} {'rms x/y px':>13} "
        f"{'rms/bound':>11} {'bias x/y 1e-3 px':>17} {'by phase':>12} {'norm. rms':>11}"
    )
    cases = {
        label: enough(formed, scene, arguments.least)
        for label, scene in scenes(formed)
        if arguments.only in label
    }
    kept = [row(label, found) for label, found in cases.items()]
    # Wires that cross are told apart: other programs draw them as photographs of an oscilloscope's screen.
    for what, crossing in (("marks of a reseau", False), ("crossings of a reseau", True)):
        of = [s for label, s in cases.items() if label.startswith("line-grid") == crossing]
        measured, expected = sum(len(s.error) for s in of), sum(s.expected for s in of)
        record(what, "simulator, found", measured, of=expected, table=ORIGIN)
        ratios = [float(np.sqrt(np.mean(np.square(s.normalised)))) for s in of]
        record(what, "simulator, errors ÷ sigmas", ratios, table=ORIGIN)
    print(
        f"\n{sum(kept)} of {len(kept)} cases satisfy rms/bound <= {MOST_RATIO}, |bias| < {MOST_BIAS_PX} px,"
    )
    print(
        f"normalised errors {NORMALISED[0]}–{NORMALISED[1]}, and miss no mark. 'By phase': the largest mean"
    )
    print("error in 1e-3 px in an eighth of a pixel, of 16 on two axes.")
    speed(formed)
    return 0 if all(kept) else 1


if __name__ == "__main__":
    raise SystemExit(main())
