r"""Level and power of the F-tests of group B: of every monomial first, then of those that are kept.

The test of one coefficient compares the model without it with the model with it, :math:`F = (\Omega_0 -
\Omega)/(\Omega/r)`, with the variance factor of the adjustment itself: only the ratios of the standard
deviations of rods and pins matter. Equations (7a, b) are linear in their coefficients and the errors of the
pins are small compared with those of the rods, so that F has one and r degrees of freedom, and a coefficient
of s standard deviations has the non-centrality s².

At the end of an elimination this no longer holds for the remaining coefficients: the smallest of several
statistics was dropped at each step, and of correlated monomials (x², y² and r⁴ over the rods: ρ up to 0.94)
the one that remains includes what the others explained by chance. The expected rates are therefore simulated
with a linear model of the same design.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import cache, partial

import numpy as np
import scipy.stats
from group_a import EVERYTHING, in_pixels
from parts import outcomes
from tables import ALPHA, SIZES, level_band, print_power

from reseau.adjust.elimination import Elimination
from reseau.calibration import CameraCorrection
from reseau.core.data import Array, ImagePoints
from reseau.designs import standard_reseau, test_object
from reseau.execution import Executor
from reseau.optics import RationalPolynomial
from reseau.refine import correct_camera, correct_instrument

__all__ = ["COEFFICIENTS", "f_tests"]

COEFFICIENTS = RationalPolynomial.ultrasonic().names
DATUM = ("A0", "A1", "A2", "B0", "B1", "B2")
"""Coefficients that the elimination always keeps."""
TESTED = tuple(name for name in COEFFICIENTS if name not in DATUM)
PAPER = ("A6", "A7", "B6", "B7")
"""Tested coefficients in the reduced model of the paper."""
LARGE = 8.0
"""Size, in standard deviations, of a coefficient that every test detects."""
PIN_PX = 0.05
LINEAR_DRAWS = 20000


@cache
def camera() -> CameraCorrection:
    """A camera without distortion."""
    design = standard_reseau()
    points = ImagePoints.with_sigma(design.ids, in_pixels(design.xy), 0.007)
    return correct_camera(points, design, trials=0).required()


def on_screen(xy: Array) -> Array:
    """Object coordinates on the screen, as a scanner draws them there."""
    return xy * (1.03, 0.98) + (0.0, 54.5)


def elimination(made: Array, sizes: dict[str, float], noise: Array, alpha: float = ALPHA) -> Elimination:
    """Group B from rods with tolerance and pins with noise, in a world with given coefficients."""
    rods = test_object()
    sigma = unit_sigmas() if sizes else {}
    values = {name: size * sigma[name] for name, size in sizes.items()}
    displayed = RationalPolynomial.ultrasonic().with_values({"A1": 1.0, "B1": 1.0} | values)
    pixels = in_pixels(displayed.inverse(on_screen(made))) + noise
    points = ImagePoints.with_sigma(rods.ids, pixels, PIN_PX)
    fit = correct_instrument(points, rods, camera(), alpha=alpha, trials=0).required().fit
    assert fit is not None
    return fit.elimination


@cache
def unit_sigmas() -> dict[str, float]:
    """Standard deviations of the coefficients in a world without distortion."""
    xy = test_object().xy
    full = elimination(xy, {}, np.zeros_like(xy), EVERYTHING).full
    return dict(zip(full.names, full.sigma.tolist(), strict=True))


def drawn(seed: int, sizes: dict[str, float], alpha: float = ALPHA) -> Elimination:
    """The same with the tolerance of a workshop and the noise of measured pins."""
    design = test_object()
    rng = np.random.default_rng([seed, *(round(10 * size) for size in sizes.values()), 3])
    tolerance = np.array([point.sigma for point in design.points], dtype=np.float64)
    made = design.xy + tolerance[:, None] * rng.standard_normal(design.xy.shape)
    return elimination(made, sizes, rng.normal(0.0, PIN_PX, made.shape), alpha)


def tested(seed: int, size: float) -> Array:
    """Which coefficients the first F-tests call significant in a world that has each at `size` sigmas."""
    p = {test.name: test.p for test in drawn(seed, dict.fromkeys(TESTED, size), EVERYTHING).kept}
    return np.array([p[name] < ALPHA for name in TESTED])


def kept(seed: int, present: Collection[str]) -> Array:
    """Which coefficients remain at the end, of a world that has those of `present` and no others."""
    dropped = drawn(seed, {name: LARGE * (name in present) for name in TESTED}).dropped
    return np.array([name not in dropped for name in TESTED])


def kept_of_a_linear_model(present: Collection[str], draws: int = LINEAR_DRAWS) -> Array:
    """Rates at which coefficients remain when a linear model of this design is reduced, (k,)."""
    matrix = RationalPolynomial.ultrasonic().derivatives(on_screen(test_object().xy)).d_parameters
    matrix = matrix.reshape(-1, len(COEFFICIENTS))
    matrix = matrix / np.linalg.norm(matrix, axis=0)
    normal, rows = matrix.T @ matrix, len(matrix)
    critical = scipy.stats.f.isf(ALPHA, 1, rows - np.arange(len(COEFFICIENTS) + 1))
    sigma = np.sqrt(np.diagonal(np.linalg.inv(normal)))
    large = LARGE * sigma * np.isin(COEFFICIENTS, list(present))
    candidate = np.isin(COEFFICIENTS, TESTED)
    rng, remain = np.random.default_rng(0), np.zeros(len(COEFFICIENTS))
    for _ in range(draws):
        y = matrix @ large + rng.standard_normal(rows)
        right, free = matrix.T @ y, np.arange(len(COEFFICIENTS))
        while candidate[free].any():
            cofactor = np.linalg.inv(normal[np.ix_(free, free)])
            values = cofactor @ right[free]
            variance = (y @ y - values @ right[free]) / (rows - len(free))
            f = np.where(candidate[free], values**2 / np.diagonal(cofactor) / variance, np.inf)
            weakest = int(f.argmin())
            if f[weakest] > critical[len(free)]:
                break
            free = np.delete(free, weakest)
        remain[free] += 1
    return remain[candidate] / draws


def f_tests(executor: Executor, draws: int) -> None:
    """Simulate and print level and power of the first tests, and the result of the elimination."""
    seeds = [draws] + [max(1, draws // 4)] * (len(SIZES) - 1)
    rates = [
        np.mean(list(outcomes(executor, partial(tested, size=size), range(n), together=25)), axis=0)
        for size, n in zip(SIZES, seeds, strict=True)
    ]
    r = 2 * len(test_object().ids) - len(COEFFICIENTS)
    critical = scipy.stats.f.isf(ALPHA, 1, r)
    theory = np.array([scipy.stats.ncf.sf(critical, 1, r, max(size**2, 1e-12)) for size in SIZES])
    print_power("Group B, first F-test of each coefficient", TESTED, rates, seeds, theory)
    low, high = level_band(draws)
    print(
        f"\nGroup B, what F-tests at {100 * ALPHA:.0f} % keep at the end of the elimination, in %, ", end=""
    )
    print(f"over {draws} seeds (99 % band {100 * low:.1f}–{100 * high:.1f})")
    print(" " * 36 + "".join(f"{name:>7}" for name in TESTED))
    worlds: tuple[tuple[str, Collection[str]], ...] = (
        ("none is in the world", ()),
        (f"{', '.join(PAPER)} at {LARGE:.0f} sigmas", PAPER),
    )
    for label, present in worlds:
        work = partial(kept, present=present)
        share = np.mean(list(outcomes(executor, work, range(draws), together=25)), axis=0)
        linear = kept_of_a_linear_model(present)
        for text, values in ((label, share), ("  a linear model", linear)):
            print(f"  {text:<34}" + "".join(f"{100 * value:7.1f}" for value in values))
        outside = [
            name
            for name, value in zip(TESTED, share, strict=True)
            if name not in present and not low <= value <= high
        ]
        print(f"  {'level kept by all' if not outside else 'off the level: ' + ', '.join(outside) + ' !'}")
