"""Networks of growing size adjusted with the covariances of all images, beside Ceres: time and memory.

Run as ``python benchmarks/scale.py --part bundle [--kinds ladybug venice] [--sizes 50 160 500 1600 5000]``.
Every network and program has a process of its own. Times are those of all processors together, without
import, compilation, making or reading the network; memory is the peak of the process. Ceres (libceres-dev,
g++) uses ITERATIVE_SCHUR with the preconditioner SCHUR_JACOBI and stops when the relative change of the sum
of squares is below 1e-6 (ours: corrections below 1e-6 standard deviations); it computes no covariances here,
because those of a network without a datum need its dense singular value decomposition.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scale_networks import KINDS

from bundle import compiled_peer
from reseau.bundle import BundleFit, problem_of

__all__ = ["part_bundle"]

# Room above what is read: an adjustment that takes longer says so.
LONGEST_S = 3600


def adjusted(kind: str, images: int, memory_gb: float | None, rounds: int) -> dict[str, Any]:
    """Adjust one network in this process."""
    small = replace(problem_of(KINDS[kind](12).network())[0], rounds=rounds)
    for memory in (0.0, 1e12):
        replace(small, memory=memory, max_iterations=3).adjusted()
    network = KINDS[kind](images).network()
    seen: list[tuple[float, float]] = []
    problem = replace(
        problem_of(network)[0], rounds=rounds, memory=None if memory_gb is None else 1e9 * memory_gb,
        watch=lambda _, cost: seen.append((time.process_time() - begun, cost)),
    )  # fmt: skip
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    begun = time.process_time()
    fit = problem.adjusted()
    spent = time.process_time() - begun
    found = {
        "images": len(network.images), "points": len(network.points), "rays": len(network.xy),
        "before_mb": before, "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10,
        "to_minimum_s": seen[-1][0] if seen else float("nan"), "total_s": spent,
    }  # fmt: skip
    if not isinstance(fit, BundleFit):
        return found | {"failed": str(fit)}
    unknowns, reduced = fit.unknowns, fit.cofactors.reduced
    begun = time.process_time()
    sigma = np.sqrt(np.diagonal(reduced.blocks(unknowns.pose[:, None] + np.arange(6)), axis1=1, axis2=2))
    one = reduced.block(unknowns.pose[0] + np.arange(6), unknowns.pose[0] + np.arange(6))
    return found | {
        "solver": "gradients" if fit.linear.system.iterative else "band" if unknowns.bands else "full",
        "factors_gb": unknowns.bytes_of_factors / 1e9, "iterations": fit.iterations, "sigma0": fit.sigma0,
        "half_cost": 0.5 * fit.cost, "covariances_of_all": bool(np.isfinite(sigma).all()),
        "one_image_s": time.process_time() - begun, "sigma_x0": float(np.sqrt(one[3, 3])),
    }  # fmt: skip


def ceres(program: Path, kind: str, images: int, target: float, folder: Path) -> dict[str, Any]:
    """Adjust the same network by Ceres, with conjugate gradients."""
    file = folder / f"{kind}-{images}.txt"
    KINDS[kind](images).write(file)
    timed = [
        "/usr/bin/env",
        sys.executable,
        "-c",
        PEAK,
        str(program),
        "bal",
        str(file),
        repr(target),
        "iterative",
    ]
    out = subprocess.run(timed, check=True, capture_output=True, text=True, timeout=LONGEST_S).stdout.split()
    file.unlink()
    return {
        "to_target_s": float(out[0]), "total_s": float(out[1]), "half_cost": float(out[2]),
        "iterations": int(out[3]), "peak_mb": float(out[5]),
    }  # fmt: skip


PEAK = """
import resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**10)
"""
"""Runs a program and prints its peak memory (MB) after what it prints."""


def part_bundle(kinds: Sequence[str], sizes: Sequence[int], memory_gb: float | None, *, peer: bool) -> None:
    """Print a line for each network and program."""
    with tempfile.TemporaryDirectory() as name:
        program = compiled_peer(Path(name)) if peer else None
        for kind in kinds:
            for images in sizes:
                words = [sys.executable, __file__, kind, str(images)]
                words += [] if memory_gb is None else ["--memory", str(memory_gb)]
                run = subprocess.run(words, capture_output=True, text=True, timeout=LONGEST_S, check=False)
                if run.returncode:
                    said_last = run.stderr.strip().splitlines()[-1:] or [f"ended by signal {-run.returncode}"]
                    print(f"{kind} {images}: {said_last[0]}", flush=True)
                    continue
                mine = json.loads(run.stdout)
                print(f"{kind} {said(mine)}", flush=True)
                if program is not None and "half_cost" in mine:
                    target = mine["half_cost"] * (1 + 1e-6)
                    theirs = ceres(program, kind, images, target, Path(name))
                    each = 1e6 * theirs["total_s"] / (2 * mine["rays"])
                    to_it = theirs["to_target_s"]
                    print(
                        f"    Ceres {theirs['total_s']:.1f} s ({each:.1f} µs), "
                        f"{'not at that sum of squares' if to_it < 0 else f'{to_it:.1f} s to it'}, "
                        f"½Σr² {theirs['half_cost']:.8g}, {theirs['iterations']} steps, "
                        f"{theirs['peak_mb']:.0f} MB",
                        flush=True,
                    )


def said(found: dict[str, Any]) -> str:
    """One line about an adjustment."""
    n = 2 * found["rays"]
    line = f"{found['images']} images, {found['points']} points, {found['rays']} image points: "
    if "failed" in found:
        return f"{line}{found['failed']} after {found['total_s']:.1f} s, {found['peak_mb']:.0f} MB"
    return (
        f"{line}{found['solver']}, {found['to_minimum_s']:.1f} s to the minimum "
        f"({1e6 * found['to_minimum_s'] / n:.1f} µs a coordinate), {found['total_s']:.1f} s with all "
        f"statistics ({1e6 * found['total_s'] / n:.1f} µs), {found['iterations']} iterations, "
        f"½Σr² {found['half_cost']:.8g}, sigma0 {found['sigma0']:.4f}; "
        f"{found['peak_mb'] - found['before_mb']:.0f} MB "
        f"({2**20 * (found['peak_mb'] - found['before_mb']) / n:.0f} bytes a coordinate; predicted for the "
        f"factors {1e3 * found['factors_gb']:.0f} MB); covariances of "
        f"{'all images' if found['covariances_of_all'] else 'single images only'}"
    )


def main() -> None:
    """Adjust one network and print what was measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("images", type=int)
    parser.add_argument("--memory", type=float)
    parser.add_argument("--rounds", type=int, default=99)
    given = parser.parse_args()
    print(json.dumps(adjusted(given.kind, given.images, given.memory, given.rounds)))


if __name__ == "__main__":
    main()
