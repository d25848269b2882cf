"""Echoes of several shapes behind the wires of a reseau, in frames without the project's formation of images.

Run from the checkout: ``python benchmarks/echoes.py [--frames 4] [--first 0] [--kind tapering …]``. The
frames are those of ``tests/measure/echoes.py``: beams, and lines of even brightness, that taper, fade towards
one end, saturate, or are clipped by the camera. Their shapes are not those that the measurement matches: it
may choose another form, which its sigmas have to cover, or decline. Errors are those of the middles of the
lines.
"""

from __future__ import annotations

import argparse
from functools import partial

import numpy as np
from parts import add_options, executor_of, main_of, outcomes
from shared import of_the_tests
from tables import judged

from reseau.core.data import Array
from reseau.measure import find_pins

HIDDEN = 0.5
"""Hidden share of an echo from which it need not be found."""
NEAR_PX = 12.0
"""Distance from a true echo beyond which a point is none."""
WRONG_SIGMA = 5.0
TURNS = (0.02, -0.1, 0.05, 0.0)
"""Rotations of wires and echoes (rad)."""


def of_frame(kind: str, seed: int) -> tuple[int, int, int, Array, Array]:
    """Echoes of a frame that are to be found, found, and none; errors (n, 2) and their sigmas."""
    drawn = of_the_tests("measure/echoes.py").draw(kind, seed=seed, turn=TURNS[seed % len(TURNS)])
    points = find_pins(drawn.frame, hidden=drawn.hidden).points
    off = points.xy[:, None] - drawn.truth
    distance = np.hypot(off[..., 0], off[..., 1])
    row = distance.argmin(axis=1)
    near = distance.min(axis=1) < NEAR_PX
    wanted, found = int((drawn.share < HIDDEN).sum()), int((near & (drawn.share[row] < HIDDEN)).sum())
    return wanted, found, int((~near).sum()), off[np.arange(len(row)), row][near], points.sigma[near]


def main() -> int:
    drawing = of_the_tests("measure/echoes.py")
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=4, help="frames of each kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--kind", nargs="+", default=list(drawing.KINDS), choices=list(drawing.KINDS))
    add_options(parser)
    given = parser.parse_args()
    print(f"{'shape':<10} {'found':>12} {'none':>5} {'> 5 σ':>6} {'largest':>8}   ", end="")
    print("error/σ x  y           rms px x  y")
    with executor_of(given) as executor:
        for kind in given.kind:
            seeds = range(given.first, given.first + given.frames)
            done = list(outcomes(executor, partial(of_frame, kind), seeds))
            wanted, found, none = (sum(each[k] for each in done) for k in range(3))
            error, sigma = (np.concatenate([each[k] for each in done]) for k in (3, 4))
            normalised = error / sigma
            x, y = np.sqrt((normalised**2).mean(axis=0)).tolist()
            px = np.sqrt((error**2).mean(axis=0))
            largest = np.abs(normalised).max(axis=1)
            wrong = int((largest > WRONG_SIGMA).sum())
            print(f"{kind:<10} {f'{found} of {wanted}':>12} {none:>5} {wrong:>6} ", end="")
            print(f"{largest.max():8.1f}   {judged(x, 0.85, 1.15)} {judged(y, 0.85, 1.15)}   ", end="")
            print(f"{px[0]:.3f} {px[1]:.3f}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
