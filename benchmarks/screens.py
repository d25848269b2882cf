"""Screens with reverberations, tails, speckle, graphics and film through ``reseau refine``, with fresh seeds.

Run from the checkout: ``python benchmarks/screens.py [--count 34] [--first 1000] [--kind speckle]``. The
worlds are those of `worlds.echo_screens`, one of each kind in turn. Printed for each kind: sets that were
refused; the share of the visible points (less than half hidden, brighter than five times the noise) of PHOTO
III that were delivered, where refused sets count as none; errors over sigmas of points and of both groups;
points beyond 5 sigma and 0.02 mm; points that are none, as reverberations are; sets noted as inconsistent.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from figures import record
from parts import add_options, executor_of, main_of, outcomes
from refined import Refined, refined
from tables import judged
from worlds.echo_screens import KINDS, Screen, write_screen

__all__: list[str] = []
FAR_SIGMA, FAR_MM = 5.0, 0.02


def one(folder: Path, kind: str, seed: int) -> tuple[str, Refined]:
    """Draw a world, run the command on it, and compare."""
    world, name = Screen(seed, kind), f"screen{seed:04d}"
    if not (folder / f"{name}.truth.json").exists():
        write_screen(folder, name, world)
    return world.kind, refined(folder, name, folder)


def far(s: Refined) -> int:
    """Points silently wrong."""
    return int(((np.abs(s.errors) > FAR_SIGMA) & (np.abs(s.mm) > FAR_MM)).any(axis=1).sum())


def root(values: Sequence[float], count: float) -> float:
    return float(np.sqrt(np.sum(values) / count)) if count else np.nan


def row(label: str, sets: Sequence[Refined]) -> None:
    """A line of the table."""
    errors = np.concatenate([s.errors for s in sets])
    found, known = sum(s.found for s in sets), sum(s.known for s in sets)
    points = root([(errors**2).sum()], errors.size)
    groups = [
        root([p[0] for p in pairs], sum(p[1] for p in pairs))
        for pairs in ([s.a for s in sets], [s.b for s in sets])
    ]
    wrong, none = sum(far(s) for s in sets), sum(s.false for s in sets)
    noted = sum("deviate" in s.notes for s in sets)
    refused = sum(s.exit != 0 for s in sets)
    print(
        f"  {label:<14} {len(sets):>4} {refused:>7}  {found:>4} of {known:<4}",
        f"{found / max(known, 1):>4.0%}  ",
        end="",
    )
    print(
        f"{judged(points, 0.8, 1.25):<8} {judged(groups[0], 0.8, 1.25):<8} {judged(groups[1], 0.8, 1.25):<8}",
        end="",
    )
    print(f" {wrong:>5} {none:>6} {noted:>5}")
    record(f"screens, {label}", "found", found, of=known)
    record(f"screens, {label}", "wrong", wrong + none)
    record(f"screens, {label}", "errors ÷ sigmas", points)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=34, help="worlds")
    parser.add_argument("--first", type=int, default=1000, help="seed of the first")
    parser.add_argument("--kind", default="", choices=["", *KINDS], help="all of this kind")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the files there")
    add_options(parser)
    given = parser.parse_args()
    found: dict[str, list[Refined]] = {}
    with TemporaryDirectory() as scratch, executor_of(given) as executor:
        folder = Path(scratch) if given.keep is None else given.keep.resolve()
        seeds = range(given.first, given.first + given.count)
        for seed, (kind, s) in zip(
            seeds, outcomes(executor, partial(one, folder, given.kind), seeds), strict=True
        ):
            found.setdefault(kind, []).append(s)
            groups = " ".join(f"{np.sqrt(p[0] / p[1]):.2f}" if p[1] else "–" for p in (s.a, s.b))
            size = np.sqrt((s.errors**2).mean(axis=0)).round(2) if len(s.errors) else ""
            print(
                f"{seed} {kind}: {s.found} of {s.known}, none {s.false}, wrong {far(s)}, {size}, {groups}"
                f" {s.message or s.worst} {s.notes}",
                flush=True,
            )
    print(f"\n  {'kind':<14} {'sets':>4} {'refused':>7}  visible points      ", end="")
    print("points   A        B        wrong   none notes")
    for kind, sets in found.items():
        row(kind, sets)
    row("all", [s for sets in found.values() for s in sets])
    return 0


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
