"""Modulation transfer function of slanted edges: the free curve, the Gaussian, and plain ISO 12233.

Run from the checkout: ``python benchmarks/edge.py [--edges N]``. Edges are formed by brute force (clouds of
rays), 48 × 48 pixels, at 3° to 20°, of both orientations and polarities. Errors are computed at 32
frequencies up to one cycle per pixel, against the transform of the same rays.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from shared import of_the_tests

from reseau.core.data import Array
from reseau.sensor import EdgeSpread, FreeCurve, measure_edge
from reseau.sensor.free_curve import FREQUENCIES

edges = of_the_tests("sensor/edges.py")
SHOWN = FREQUENCIES[1:]


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def row(kind: str, decibels: float, count: int) -> str:
    errors, sigmas, gaussian, plain, rejected = [], [], [], [], 0
    for seed in range(count):
        edge = edges.edge_of(kind, np.random.default_rng([seed, 77]), decibels=decibels, shot=bool(seed % 2))
        found = measure_edge(edge.frame)
        assert isinstance(found, EdgeSpread)
        assert isinstance(found.free, FreeCurve)
        assert found.gaussian is not None
        truth, (value, sigma) = edge.truth(SHOWN), found.free.mtf(SHOWN)
        errors.append(value - truth)
        sigmas.append(sigma)
        gaussian.append(found.mtf(SHOWN) - truth)
        plain.append(edges.plain_iso(edge.frame, SHOWN) - truth)
        rejected += found.gaussian.significant
    over = np.array(errors) / np.array(sigmas)
    bias = np.abs(over.mean(axis=0)).max()
    curves = " ".join(f"{rms(np.array(each)):9.4f}" for each in (errors, plain, gaussian))
    return f"{kind:<9} {decibels:3.0f} dB {curves} {rms(over):10.2f} {bias:10.2f} {rejected:5d}/{count}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--edges", type=int, default=60, help="Number of edges of each kind and noise level.")
    count = parser.parse_args().edges
    began = time.process_time()
    print("rms error of the modulation: free curve, plain ISO 12233, Gaussian; free: rms error/σ, largest")
    print("bias/σ of a frequency; share of edges rejected as Gaussian at 1 %")
    print(f"{'':16} {'free':>9} {'ISO':>9} {'Gaussian':>9} {'error/σ':>10} {'bias/σ':>10} rejected")
    for kind in edges.KINDS:
        for decibels in (30.0, 40.0, 50.0):
            print(row(kind, decibels, count), flush=True)
    print(f"{time.process_time() - began:.0f} s of CPU")


if __name__ == "__main__":
    main()
