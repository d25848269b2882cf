"""The oscilloscope procedure on the simulated bench: correctness of the sigmas, effect of each factor.

Run from the checkout: ``python benchmarks/oscilloscope.py [--frames 200] [--polynomial 100] [--draws 1000]
[--jobs N] [--echoes even] [--keep FOLDER]``, or with ``--part``:

- ``independent``: the sets of another program in ``$RESEAU_DATA``, through ``reseau refine`` (see `refined`);
- ``worlds``: the same with ``--count 200`` worlds of `worlds.oscilloscope`;
- ``points``: such worlds as coordinates with noise of known covariance, without images.

Without it, PHOTO I, II and III of one world per seed go through the complete procedure. For
displays with Wong's physics, and for displays that equations (7a, b) correct exactly, it prints

1. the number of measured points, and errors of positions over their standard deviations;
2. the same for the coefficients of groups A and B, and for the true coordinates of the points of PHOTO III;
3. the remaining errors of those points, factor by factor;
4. which of the two models of a display is preferred;
5. the time;

and, without frames, level and power of the tests of both groups (`group_a`, `group_b`).

Results are compared with the same adjustments of *noise-free* positions, and for group B of the true
positions of the rods, with the same models, weights and common systems, fixed at the measured ones. The
remaining errors of true coordinates in this chain are the approximation error of equations (5) and (7); it is
listed separately, and no sigma covers it. The tolerance of the rods dominates all other errors of group B;
rows with error-free rods show those. Errors within one world are correlated: the number after ± is the
standard error over worlds.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import group_a
import group_b
import numpy as np
from chain import FALSE_PX, FAR_SIGMA, Errors, Found, Trial, trial
from figures import ORIGIN, record
from parts import add_options, executor_of, main_of, outcomes
from photographs import ECHOES, Physics
from refined import Refined, of_points, print_refined, refined
from tables import judged, mean_square, rms, rms_over_worlds
from worlds.oscilloscope import World, write

from reseau.core.data import Array
from reseau.execution import Executor
from reseau.report.factors import FACTORS

VERDICTS = {"first": "the polynomials", "second": "Wong's display", "undecided": "neither"}
PHYSICS = {"wong": "a display of Wong's physics", "polynomial": "a display that (7a, b) correct exactly"}
MOST_SECONDS = 5.0


def normalised(label: str, groups: Sequence[Array]) -> None:
    """A line of the table: x, y and both."""
    print(f"    {label:<28}", end="")
    for name, part in (("x", np.s_[:, :1]), ("y", np.s_[:, 1:]), ("both", np.s_[:, :])):
        value, error = rms_over_worlds([group[part] for group in groups])
        print(f"  {name} {judged(value):<7} ± {error:.3f}", end="")
    print()


def print_found(name: str, found: Sequence[Found]) -> None:
    known, right = sum(f.known for f in found), sum(len(f.errors) for f in found)
    wrong = sum(int((f.row < 0).sum()) for f in found)
    far = sum(int((np.abs(f.errors) > FAR_SIGMA).any(axis=1).sum()) for f in found)
    print(f"  {name}: {right} of {known} found, {100 * (1 - right / known):.1f} % missed; ", end="")
    print(f"{wrong} more than {FALSE_PX:.0f} px from any, {far} more than {FAR_SIGMA:.0f} sigmas off")
    normalised("positions, normalised", [f.errors for f in found])
    x, y = rms(np.concatenate([f.px for f in found]), 0)
    print(f"    rms error {x:.4f} px in x, {y:.4f} px in y")


def print_coefficients(names: Sequence[str], errors: Array) -> None:
    for name, values in zip(names, errors.T, strict=True):
        value, spread = rms_over_worlds(list(values[:, None]))
        dropped = np.isnan(values).mean()
        print(f"    {name:<3} {judged(value):<8} ± {spread:.3f}  mean {np.nanmean(values):+.3f}", end="")
        print(f"   dropped in {100 * dropped:.1f} %" if dropped else "")
    value, spread = rms_over_worlds(list(errors))
    print(f"    all {judged(value):<8} ± {spread:.3f}")


def print_group_b(errors: Sequence[Errors]) -> None:
    print_coefficients(group_b.COEFFICIENTS, np.array([e.coefficients for e in errors]))
    mean, spread = mean_square([np.sqrt([e.jointly]) for e in errors])
    print(f"    jointly, weighted square over 16: {mean:.3f} ± {spread:.3f}")


def print_true_coordinates(errors: Sequence[Errors]) -> None:
    print("  true coordinates of PHOTO III's points, normalised:")
    normalised("against the noise-free chain", [e.chain for e in errors])
    normalised("against the truth", [e.truth for e in errors])
    sigma = rms(np.concatenate([e.sigma for e in errors]), 0)
    print(f"    their sigmas, rms: {sigma[0]:.4f} mm in x, {sigma[1]:.4f} mm in y")
    left = np.concatenate([np.hypot(*e.approximation.T) for e in errors])
    worst = [np.hypot(*e.approximation.T).max() for e in errors]
    print(f"    approximation error: median {np.median(left):.4f} mm, largest in a world ", end="")
    print(f"median {np.median(worst):.4f} mm, of the worst world {max(worst):.4f} mm")


def print_factors(done: Sequence[Trial]) -> None:
    """Factor by factor."""
    print("  factor by factor, rms error of PHOTO III's points in mm:")
    print(f"    {'taken off':<28}  rods as toleranced      rods free of error")
    print(f"    {'':<28}  {'x':>8} {'y':>8}       {'x':>8} {'y':>8}")
    for name in FACTORS:
        pairs = [
            rms(np.concatenate([e.factors[name] for e in errors]), 0)
            for errors in ([t.tolerance for t in done], [t.exact for t in done])
        ]
        print(f"    {name:<28}  {pairs[0][0]:8.4f} {pairs[0][1]:8.4f}       ", end="")
        print(f"{pairs[1][0]:8.4f} {pairs[1][1]:8.4f}")


def print_verdicts(done: Sequence[Trial]) -> None:
    print("  what is preferred as the model of the display:")
    for label, verdicts in (
        ("rods as toleranced", [t.tolerance.verdict for t in done]),
        ("rods free of error", [t.exact.verdict for t in done]),
    ):
        count = Counter(verdicts)
        shares = (f"{text} {100 * count[key] / len(done):.1f} %" for key, text in VERDICTS.items())
        print(f"    {label:<20} {', '.join(shares)}")


def print_time(done: Sequence[Trial], jobs: int) -> None:
    seconds = np.array([t.measured.seconds for t in done])
    whole = float(np.median(seconds.sum(axis=1)))
    each = ", ".join(f"{s:.2f}" for s in np.median(seconds, axis=0))
    print(f"  time of the procedure on 1600 × 1200 frames: median {judged(whole, 0, MOST_SECONDS)} s", end="")
    print(
        f" (PHOTO I, II, III: {each} s; processor {np.median([t.measured.cpu for t in done]):.2f} s;", end=""
    )
    print(f" {jobs} process{'es at a time' if jobs > 1 else ''})")


def print_physics(physics: Physics, found: Sequence[Trial | str], jobs: int) -> None:
    """All tables of one kind of world."""
    done = [t for t in found if isinstance(t, Trial)]
    print(f"\nFrom frames, with {PHYSICS[physics]}: {len(done)} worlds")
    for reason in (t for t in found if isinstance(t, str)):
        print(f"  failed: {reason}")
    if not done:
        return
    print_found("PHOTO II, rods", [t.rods for t in done])
    print_found("PHOTO III, points of the body", [t.body for t in done])
    moved = np.mean([t.measured.moved for t in done])
    similar = np.mean([t.measured.similar for t in done])
    print(f"  camera falsely said to have moved in {100 * moved:.1f} % of photographs; ", end="")
    print(f"no similarity from PHOTO I in {100 * (1 - similar):.1f} %")
    print("  group A, coefficients, normalised:")
    print_coefficients(group_a.COEFFICIENTS, np.array([t.group_a for t in done]))
    for label, errors in (
        ("rods as toleranced", [t.tolerance for t in done]),
        ("rods free of error", [t.exact for t in done]),
    ):
        print(f"  group B, {label}, coefficients, normalised:")
        print_group_b(errors)
        print_true_coordinates(errors)
    keep(done)
    print_factors(done)
    print_verdicts(done)
    print_time(done, jobs)


def keep(done: Sequence[Trial]) -> None:
    """Record what is recorded of the sets of another program, too; each value is that of one world."""
    known, found = sum(t.body.known for t in done), sum(len(t.body.errors) for t in done)
    record("points of PHOTO III", "found", found, of=known)
    ratios = {
        "points of PHOTO III": [float(rms(t.tolerance.truth)) for t in done],
        "points of PHOTO III, rods free of error": [float(rms(t.exact.truth)) for t in done],
        "coefficients of group A": [float(rms(t.group_a)) for t in done],
        "coefficients of group B": [float(rms(t.tolerance.coefficients)) for t in done],
    }
    for row, values in ratios.items():
        record(row, "errors ÷ sigmas", values)
    record("the procedure", "processor time", [t.measured.cpu for t in done], "s")
    what = "oscilloscope, points of PHOTO III"
    record(what, "simulator, found", found, of=known, table=ORIGIN)
    record(what, "simulator, errors ÷ sigmas", ratios["points of PHOTO III"], table=ORIGIN)
    for group in "AB":
        values = ratios[f"coefficients of group {group}"]
        record(
            f"oscilloscope, coefficients of group {group}", "simulator, errors ÷ sigmas", values, table=ORIGIN
        )


def through_the_procedure(
    executor: Executor, physics: Physics, seeds: range, folder: Path | None, echoes: str
) -> list[Trial | str]:
    """Process worlds one after the other, and report each on standard error."""
    found = []
    work = partial(trial, physics=physics, folder=folder, echoes=echoes)
    for seed, one in zip(seeds, outcomes(executor, work, seeds), strict=True):
        found.append(one)
        text = one if isinstance(one, str) else f"{len(one.rods.row)} rods, {len(one.body.row)} points"
        print(f"{physics} {seed}: {text}", file=sys.stderr, flush=True)
    return found


def _world(folder: Path, keep: bool, seed: int) -> Refined:
    """Draw a world, unless it is there already, and run the command on it."""
    name = f"world{seed:03d}"
    if not (folder / f"{name}.truth.json").exists():
        write(folder, name, World.drawn_from(seed))
    found = refined(folder, name, folder)
    if not keep:
        for file in folder.glob(f"{name}.*"):
            file.unlink()
    return found


def _of_others(executor: Executor, part: str, seeds: range, keep: Path | None) -> None:
    """The parts in worlds that share nothing with the project's formation of images."""
    if part == "points":
        found = list(outcomes(executor, of_points, seeds))
        print_refined("Worlds as coordinates with noise", found, 0.95, 1.05, 0.95, 1.05)
        return
    with TemporaryDirectory() as scratch:
        place = Path(scratch) if keep is None else keep.resolve()
        if part == "independent":
            folder = Path(os.environ.get("RESEAU_DATA", "../shared/data")) / "independent" / "oscilloscope"
            names = sorted(file.name.split(".")[0] for file in folder.glob("*.truth.json"))
            found = list(outcomes(executor, partial(refined, folder.resolve(), keep=place), names))
            print_refined("Sets of another program", found, 0.85, 1.15, 0.8, 1.2)
            return
        found = []
        for one in outcomes(executor, partial(_world, place, keep is not None), seeds):
            found.append(one)
            print(f"{one.name}: {one.message or one.worst}", file=sys.stderr, flush=True)
        print_refined("Worlds without the project's formation", found, 0.95, 1.05, 0.95, 1.05)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=200, help="worlds of Wong's physics")
    parser.add_argument("--polynomial", type=int, default=100, help="worlds that (7a, b) correct exactly")
    parser.add_argument("--first", type=int, default=0, help="seed of the first of these worlds")
    parser.add_argument("--echoes", choices=[*ECHOES], default="beam", help="their form")
    parser.add_argument("--draws", type=int, default=1000, help="tests of level, from points")
    add_options(parser)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep there what is measured in frames")
    parser.add_argument("--part", choices=["bench", "independent", "worlds", "points"], default="bench")
    parser.add_argument("--count", type=int, default=200, help="worlds of --part worlds and points")
    parser.set_defaults(jobs=None)
    given = parser.parse_args()
    # The wall time of the procedure is that of one process alone.
    given.jobs = given.jobs or (1 if given.part == "bench" else 2)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)
    begun = time.perf_counter()
    if given.part != "bench":
        with executor_of(given) as executor:
            _of_others(executor, given.part, range(given.first, given.first + given.count), given.keep)
        print(f"\n{time.perf_counter() - begun:.0f} s")
        return 0
    worlds: tuple[tuple[Physics, int], ...] = (("wong", given.frames), ("polynomial", given.polynomial))
    with executor_of(given) as executor:
        for physics, count in worlds:
            if count:
                seeds = range(given.first, given.first + count)
                found = through_the_procedure(executor, physics, seeds, given.keep, given.echoes)
                print_physics(physics, found, given.jobs)
        if given.draws:
            group_a.first_tests(executor, given.draws)
            group_b.f_tests(executor, given.draws)
    print(f"\n{time.perf_counter() - begun:.0f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
