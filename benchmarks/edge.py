"""Modulation transfer function of slanted edges: the free curve, the Gaussian, and plain ISO 12233.

Run from the checkout: ``python benchmarks/edge.py [--edges N] [--jobs N]``. Edges are formed by brute force
(clouds of rays), 48 × 48 pixels, at 3° to 20°, of both orientations and polarities. Errors are computed at
32 frequencies up to one cycle per pixel, against the transform of the same rays.
"""

from __future__ import annotations

import argparse
import time
from typing import NamedTuple

import numpy as np
from figures import record
from parts import add_options, executor_of, main_of, outcomes
from shared import of_the_tests

from reseau.core.data import Array
from reseau.execution import Executor
from reseau.sensor import EdgeSpread, FreeCurve, measure_edge
from reseau.sensor.free_curve import FREQUENCIES

edges = of_the_tests("sensor/edges.py")
SHOWN = FREQUENCIES[1:]


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


class Errors(NamedTuple):
    """Errors of the free curve, of plain ISO 12233 and of the Gaussian, and sigmas of the first (32,).

    Also whether the Gaussian was rejected, and the processor time (s).
    """

    free: Array
    plain: Array
    gaussian: Array
    sigma: Array
    rejected: bool
    seconds: float


def measured(job: tuple[str, float, int]) -> Errors:
    """Form and measure one edge."""
    began, (kind, decibels, seed) = time.process_time(), job
    edge = edges.edge_of(kind, np.random.default_rng([seed, 77]), decibels=decibels, shot=bool(seed % 2))
    found = measure_edge(edge.frame)
    assert isinstance(found, EdgeSpread)
    assert isinstance(found.free, FreeCurve)
    assert found.gaussian is not None
    truth, (value, sigma) = edge.truth(SHOWN), found.free.mtf(SHOWN)
    plain, gaussian = edges.plain_iso(edge.frame, SHOWN) - truth, found.mtf(SHOWN) - truth
    seconds = time.process_time() - began
    return Errors(value - truth, plain, gaussian, sigma, bool(found.gaussian.significant), seconds)


def row(kind: str, decibels: float, count: int, executor: Executor) -> tuple[str, float]:
    """Return a row of the table, and the processor time (s) that it took."""
    done = list(outcomes(executor, measured, ((kind, decibels, seed) for seed in range(count)), 5))
    free, plain, gaussian, sigma = (
        np.array([getattr(each, name) for each in done]) for name in ("free", "plain", "gaussian", "sigma")
    )
    over, rejected = free / sigma, sum(each.rejected for each in done)
    label = f"{kind}, {decibels:.0f} dB"
    for who, curves in (("reseau, free curve", free), ("ISO 12233", plain), ("Gaussian", gaussian)):
        record(label, f"{who}, rms error of an edge", [rms(each) for each in curves])
    record(label, "errors ÷ sigmas", rms(over))
    bias = np.abs(over.mean(axis=0)).max()
    columns = " ".join(f"{rms(each):9.4f}" for each in (free, plain, gaussian))
    line = f"{kind:<9} {decibels:3.0f} dB {columns} {rms(over):10.2f} {bias:10.2f} {rejected:5d}/{count}"
    return line, sum(each.seconds for each in done)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--edges", type=int, default=60, help="Number of edges of each kind and noise level.")
    add_options(parser)
    given, spent = parser.parse_args(), 0.0
    print("rms error of the modulation: free curve, plain ISO 12233, Gaussian; free: rms error/σ, largest")
    print("bias/σ of a frequency; share of edges rejected as Gaussian at 1 %")
    print(f"{'':16} {'free':>9} {'ISO':>9} {'Gaussian':>9} {'error/σ':>10} {'bias/σ':>10} rejected")
    with executor_of(given) as executor:
        for kind in edges.KINDS:
            for decibels in (30.0, 40.0, 50.0):
                line, seconds = row(kind, decibels, given.edges, executor)
                spent += seconds
                print(line, flush=True)
    print(f"{spent:.0f} s of processor time")


if __name__ == "__main__":
    main_of(__file__)
