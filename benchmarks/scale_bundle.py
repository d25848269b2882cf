"""Networks of growing size adjusted with the covariances of all images, beside Ceres and COLMAP.

Run as ``python benchmarks/scale.py --part bundle [--kinds ladybug venice] [--sizes 50 160 500 1600 5000]``.
Every network and program has a process of its own; one that takes more memory than the machine has, or longer
than ``--longest``, is ended, and its line says so. All start from the same values, minimise the same sum of
squares and use two threads. Times are those of all processors together, without import, compilation, making
or reading the network. Memory is what the adjustment needs besides the network, of Ceres with it.

Ceres (libceres-dev, g++) uses ITERATIVE_SCHUR with the preconditioner SCHUR_JACOBI. COLMAP (pycolmap), with a
camera RADIAL for each image, chooses by their number: up to 50 DENSE_SCHUR, up to 1000 SPARSE_SCHUR, then
ITERATIVE_SCHUR. Both stop when the relative change of the sum of squares is below 1e-6 (ours: corrections
below 1e-6 standard deviations). They compute no covariances here: those of a network without a datum need
Ceres's dense singular value decomposition.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scale_networks import KINDS
from watched import forget_peak, peak_mb, run_watched

from bundle import colmap_command, compiled_peer
from reseau.bundle import problem_of
from reseau.bundle.solver.problem import BundleFit

__all__ = ["part_bundle"]


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
    before = forget_peak()
    begun = time.process_time()
    fit = problem.adjusted()
    spent = time.process_time() - begun
    found = {
        "images": len(network.images), "points": len(network.points), "rays": len(network.xy),
        "before_mb": before, "peak_mb": peak_mb(),
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


def peer_line(name: str, command: Sequence[str | Path], mine: dict[str, Any], longest_s: float) -> str:
    """One line about the adjustment by a peer of the network of `mine`."""
    ended = run_watched(command, longest_s)
    if ended.why:
        return f"    {name}: {ended.why}; {ended.seconds:.0f} s, at most {ended.peak_mb:.0f} MB"
    words = ended.out.split()
    to_it = "" if name == "COLMAP" else words.pop(0)
    spent, half_cost, steps = float(words[0]), float(words[1]), words[2]
    said = [f"{spent:.1f} s ({1e6 * spent / (2 * mine['rays']):.1f} µs a coordinate)"]
    if to_it:
        said.append(f"{float(to_it):.1f} s to this minimum" if float(to_it) >= 0 else "not to this minimum")
    said.append(f"½Σr² {half_cost:.8g} ({half_cost / mine['half_cost'] - 1:+.1e})")
    said.append(f"{steps} steps" + ("" if to_it else f" ({words[3]})"))
    memory = f"{ended.peak_mb if to_it else float(words[5]) - float(words[4]):.0f} MB"
    return f"    {name} {', '.join(said)}; {memory}"


def part_bundle(
    kinds: Sequence[str], sizes: Sequence[int], memory_gb: float | None, *, peers: bool, longest_s: float
) -> None:
    """Print a line for each network and program."""
    with tempfile.TemporaryDirectory() as name:
        program = compiled_peer(Path(name)) if peers else None
        file = Path(name) / "network.txt"
        others: dict[str, Callable[[float], Sequence[str | Path]]] = {}
        if program is not None:
            others["Ceres"] = lambda target: [program, "bal", file, repr(target), "iterative"]
        if peers and colmap_command("bal", file):
            others["COLMAP"] = lambda _: colmap_command("bal", file)
        elif peers:
            print("no pycolmap: no comparison with COLMAP")
        for kind in kinds:
            for images in sizes:
                words: list[str | Path] = [sys.executable, __file__, kind, str(images)]
                words += [] if memory_gb is None else ["--memory", str(memory_gb)]
                ended = run_watched(words, longest_s)
                if ended.why:
                    print(f"{kind} {images}: {ended.why}; at most {ended.peak_mb:.0f} MB", flush=True)
                    continue
                mine = json.loads(ended.out)
                print(f"{kind} {said(mine)}", flush=True)
                if others and "half_cost" in mine:
                    KINDS[kind](images).write(file)
                    for which, command in others.items():
                        target = mine["half_cost"] * (1 + 1e-6)
                        print(peer_line(which, command(target), mine, longest_s), flush=True)


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
