"""Certified problems of NIST StRD: digits of parameters and standard deviations, from both starts.

Run from the checkout: ``python benchmarks/nist.py``. The files are looked for in $RESEAU_DATA/nist_strd.
"""

from __future__ import annotations

import time
from decimal import Decimal
from types import ModuleType
from typing import Any

import numpy as np
from figures import record
from shared import of_the_tests

from reseau.adjust import adjust

# Below this many digits a problem is solved once more in decimal arithmetic.
ENOUGH = 8.0


def row(nist: ModuleType, problem: Any, start: int, number: Any) -> tuple[float, float]:
    """Solve, print one line, and return the digits."""
    begun = time.perf_counter()
    fit = adjust(problem.problem(start, number))
    elapsed = 1e3 * (time.perf_counter() - begun)
    arithmetic = "double" if number is float else "decimal"
    head = f"{problem.name:<9} {start + 1:>5}  {arithmetic:<10}"
    if not fit:
        print(f"{head} {fit.reason}")
        return 0.0, 0.0
    parameters, sigmas = nist.digits_of(fit, problem)
    print(f"{head} {parameters.min():>10.1f} {sigmas.min():>7.1f} {fit.iterations:>10} {elapsed:>8.1f}")
    return float(parameters.min()), float(sigmas.min())


def main() -> int:
    nist = of_the_tests("adjust/nist.py")
    if not nist.names():
        print(f"no NIST StRD files in {nist.data_directory()}")
        return 1
    print("problem   start  arithmetic parameters  sigmas iterations       ms")
    double, best = [], []
    for name in nist.names():
        problem = nist.load(name)
        for start in (0, 1):
            digits = row(nist, problem, start, float)
            double.append(digits)
            if min(digits) < ENOUGH:
                digits = row(nist, problem, start, Decimal)
            best.append(digits)
    for label, figures in (("in double precision", double), ("with decimal arithmetic where needed", best)):
        mean, least = np.mean(figures, axis=0), np.min(figures, axis=0)
        for k, what in enumerate(("parameters", "sigmas")):
            record(label, f"correct digits of {what}", [each[k] for each in figures])
        print(
            f"{label}: parameters {mean[0]:.2f} digits in the mean, {least[0]:.1f} at least; "
            f"sigmas {mean[1]:.2f} and {least[1]:.1f}"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
