"""Blurred targets that moved during the exposure, in photographs drawn with rays of batoid.

Run from the checkout: ``python benchmarks/moving.py [--count 16] [--first 0]``; needs batoid. The photographs
are those of ``benchmarks/blurred.py`` (double Gauss, twelve disks and squares tilted to 40°, blur of 3 or 6
px), 40 dB, drawn at 41 places of the image along its way. Kinds, in turn: at rest; straight; curved or
accelerated; vibrations along a line and along an ellipse, with amplitudes of 1 to 5 px; a focus other than
stated; a stop that is stated a tenth too wide; a reflection, a second image with a fifth of the light, which
is none of the explanations. For each kind: photographs whose
reason was named, targets measured, rms of errors (px) and of errors over sigmas, beside a measurement with
the lens at rest; and of those not named, how many were said not to be like their images.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import numpy as np
from blurred import BRIGHT, DARK, PITCH, PRINCIPAL, PSF, SIZE, camera_of, plane_targets, world
from figures import record
from parts import add_options, executor_of, main_of, outcomes
from worlds.blurred import Array, Lens, light, noisy

from reseau.core.data import Frame
from reseau.core.failure import Code
from reseau.measure.blurred import BlurredOptions, measure_blurred
from reseau.measure.blurred.measure import BlurredResult
from reseau.measure.blurred.motion import measure_explained
from reseau.procedures.blurred import refocused

KINDS = ("rest", "straight", "curved", "vibration", "ellipse", "focus", "stop", "reflection")
SAID = dict.fromkeys(("straight", "curved"), "moved") | dict.fromkeys(("vibration", "ellipse"), "vibrated")
SAID |= {"focus": "focus", "stop": "stop"}
PLACES, DECIBELS = 41, 40.0


def way(kind: str, rng: np.random.Generator) -> Array:
    """Places (m, 2) of the image at equal steps of time, from that of its coordinate; pixels."""
    angle, size = rng.uniform(0, 2 * np.pi), rng.uniform(1.0, 5.0)
    first = size * np.array([np.cos(angle), np.sin(angle)])
    turn = rng.uniform(0, 2 * np.pi)
    second = size * rng.uniform(0.3, 0.7) * np.array([np.cos(turn), np.sin(turn)])
    time = (np.arange(PLACES) + 0.5)[:, None] / PLACES * 2 - 1
    if kind in ("straight", "curved"):
        return time * first + (time**2 * second if kind == "curved" else 0)
    if kind in ("vibration", "ellipse"):
        across = rng.uniform(0.3, 0.9) * np.array([-first[1], first[0]])
        return np.cos(np.pi * time) * first + (np.sin(np.pi * time) * across if kind == "ellipse" else 0)
    if kind == "reflection":
        return np.array([[0.0, 0.0]] * 4 + [(3 * first).tolist()])
    return np.zeros((1, 2))


@dataclass(frozen=True, eq=False)
class Done:
    """What was said of a photograph; errors (2n,) in pixels, over sigmas, and with the lens at rest."""

    kind: str
    named: bool
    unlike: bool
    measured: float
    off: Array
    ratio: Array
    alone: Array


def drawn(seed: int) -> Done:
    """Draw the photograph of a seed, and measure it."""
    kind, rng = KINDS[seed % len(KINDS)], np.random.default_rng((seed, 57))
    # Photographs of both blurs, whatever the kind.
    still = world(5 * (seed // len(KINDS)) + 1 + (seed // len(KINDS)) % 2)
    lens, places = Lens(still.stop, still.image_z, PITCH, PRINCIPAL), way(kind, rng)
    image = np.full(SIZE[::-1], BRIGHT)
    for target, point, blur in zip(still.targets, still.truth, still.blurs, strict=True):
        reach = np.abs(places).max()
        half = int(0.75 * target.size / PITCH * 25.7 / target.centre[2] + 1.2 * blur + reach) + 12
        columns, rows = (np.arange(-half, half + 1) + round(v) for v in point)
        count = max(900, (3000 + round(800 * blur)) // len(places))
        share = np.mean(
            [light(lens, target, columns - dx, rows - dy, PSF, count) for dx, dy in places], axis=0
        )
        inside = (rows[:, None] >= 0) & (rows[:, None] < SIZE[1]) & (columns >= 0) & (columns < SIZE[0])
        y, x = np.broadcast_arrays(rows[:, None], columns[None])
        image[y[inside], x[inside]] -= (BRIGHT - DARK) * share[inside]
    frame = Frame(noisy(image, BRIGHT - DARK, DECIBELS, rng), 255.0, f"moving {seed}")
    if kind == "focus":
        still = replace(still, image_z=still.image_z + rng.choice([-1, 1]) * rng.uniform(0.03, 0.1))
    if kind == "stop":
        still = replace(still, stop=1.1 * still.stop)
    camera, planes = camera_of(still), plane_targets(still)
    names = [str(k) for k in range(len(planes))]
    job = frame, camera, names, planes, BlurredOptions()
    found, alone = measure_explained(*job, altered=refocused)[0], measure_blurred(*job)
    lines, said = [note.text for note in found.notes], SAID.get(kind)
    unlike = any(note.code == Code.INCONSISTENT for note in found.notes)
    named = bool(lines) and all(said in line for line in lines) if said else unlike == (kind == "reflection")
    off, ratio = _errors(found, still.truth)
    return Done(kind, named, unlike, float(found.ok.mean()), off, ratio, _errors(alone, still.truth)[0])


def _errors(found: BlurredResult, truth: Array) -> tuple[Array, Array]:
    """Errors (2n,) of the measured targets in pixels, and over their sigmas."""
    off = (found.xy - truth)[found.ok]
    return off.ravel(), (off / np.sqrt(np.diagonal(found.cov[found.ok], axis1=1, axis2=2))).ravel()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=16, help="photographs, the kinds in turn")
    parser.add_argument("--first", type=int, default=0)
    add_options(parser)
    chosen = parser.parse_args()
    seeds = range(chosen.first, chosen.first + chosen.count)
    with executor_of(chosen) as executor:
        every = list(outcomes(executor, drawn, seeds))
    print(f"{'kind':10s} named  unlike  measured   rms px   errors/sigmas   at rest, rms px")
    for kind in KINDS:
        some = [each for each in every if each.kind == kind]
        if not some:
            continue
        off, ratio, alone = (
            np.concatenate([getattr(each, name) for each in some]) for name in ("off", "ratio", "alone")
        )
        rms = [float(np.sqrt(np.mean(each**2))) if len(each) else np.nan for each in (off, ratio, alone)]
        named, unlike = (sum(getattr(each, name) for each in some) for name in ("named", "unlike"))
        measured = 100 * np.mean([each.measured for each in some])
        print(
            f"{kind:10s} {named:2d}/{len(some):2d}  {unlike:2d}/{len(some):2d}   {measured:5.1f} %   "
            f"{rms[0]:.4f}   {rms[1]:10.2f} {rms[2]:16.4f}"
        )
        record(kind, "named", named, of=len(some))
        record(kind, "rms", rms[0], "px")
        record(kind, "errors ÷ sigmas", rms[1])
        record(kind, "at rest, rms", rms[2], "px")


if __name__ == "__main__":
    main_of(__file__)
