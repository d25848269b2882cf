r"""Group A on the simulated bench: correctness of the sigmas, level of the tests, remaining errors.

Run from the checkout: ``python benchmarks/group_a.py [--frames 200] [--draws 2000] [--jobs 1]``. It prints

1. the chain from points: exact positions in simulated worlds, with normal noise of known covariance;
2. level and power of the :math:`\chi^2` test of each coefficient, the first in the elimination;
3. the complete chain, one world per seed: frame → measured marks → corrected camera.

Coefficients are compared with those of an adjustment of the *noise-free* positions with the same reduced
model, the same weights, and the same common system, fixed at the measured images of O and S. A coefficient
that was dropped is zero in both, and the effect on the remaining ones is not counted as an error. The
residuals of the reduced model for noise-free positions are its approximation error; it is listed separately,
and no sigma covers it.
"""

from __future__ import annotations

import argparse
import io
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from parts import add_options, executor_of, main_of, outcomes
from scipy.stats import ncx2, norm
from tables import ALPHA, SIZES, judged, print_power, rms

from reseau.adjust import Adjustment, adjust
from reseau.core.data import Array, ImagePoints
from reseau.designs import standard_reseau
from reseau.execution import Executor
from reseau.measure import measure_reseau
from reseau.measure.fitting import fit_mapping, mapping_problem
from reseau.optics import RationalPolynomial
from reseau.optics.composition import Similarity
from reseau.refine import CorrectionFit, FittedCamera, correct_camera
from reseau_sims import World

COEFFICIENTS = RationalPolynomial.camera().names
INVARIANT = ("a0", "b0", "d1", "d2", "k", "h1", "h2")
"""Coefficients that do not depend on errors of O and S (rotation, shift and scale of the common system)."""
NOISE_PX = 0.007
EVERYTHING = 1 - 1e-12
"""A level at which every coefficient is significant: nothing is eliminated."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One correction compared with the truth; mm in the common system unless the name has another unit."""

    seed: int
    marks: int
    point_errors: Array
    """Errors of measured marks over their own sigmas, (n, 2)."""
    coefficients: Array
    """Errors of the coefficients over their sigmas; NaN where dropped."""
    check: Array
    """Errors of corrected check marks over their sigmas, relative to the noise-free model, (c, 2)."""
    check_design: Array
    """The same relative to the design, including the approximation error."""
    check_mm: dict[str, Array]
    passed: bool
    expected: float
    """Probability of passing, from the noise-free sum of squares."""
    sigma0: float
    left: Array
    """Residuals of the model for noise-free positions, (n, 2)."""
    px_per_mm: float


def without_noise(
    points: ImagePoints, exact: dict[str, Array], mapping: Callable[[Array], Array]
) -> ImagePoints:
    """The true positions of the points, mapped, with the covariances of the points."""
    return ImagePoints(points.names, mapping(np.array([exact[name] for name in points.names])), points.cov)


def camera_without_noise(camera: FittedCamera, exact: dict[str, Array]) -> Adjustment:
    """The adjustment of noise-free positions: the same model, weights and common system."""
    assert camera.fit is not None
    used = without_noise(camera.fit.points, exact, camera.photo_system)
    return adjust(mapping_problem(camera.model, used, camera.fit.target)).required()


def coefficient_errors(camera: FittedCamera, true_fit: Adjustment) -> Array:
    """Errors of the coefficients over their sigmas, in the order of `COEFFICIENTS`; NaN where dropped."""
    sigma = np.sqrt(np.diagonal(camera.cofactor))
    errors = dict(zip(camera.model.names, (camera.model.values - true_fit.values) / sigma, strict=True))
    return np.array([errors.get(name, np.nan) for name in COEFFICIENTS])


def trial(world: World, points: ImagePoints, seed: int) -> Trial | str:
    """Correct the camera by these points and compare."""
    camera = correct_camera(points, world.design, check=world.check_marks(), trials=0)
    if not camera:
        return f"seed {seed}: {camera.reason}"
    fit, truth = camera.fit, world.truth()
    exact = dict(zip(truth.names, truth.xy, strict=True))
    true_fit = camera_without_noise(camera, exact)
    true_model = camera.model.with_values(true_fit.values)
    used, check = (without_noise(some, exact, camera.photo_system) for some in (fit.points, fit.check))
    global_test = fit.adjustment.global_test(ALPHA)
    noncentral = partial(ncx2.cdf, df=fit.adjustment.redundancy, nc=max(true_fit.cost, 1e-9))
    px = points.xy - np.array([exact[name] for name in points.names])
    return Trial(
        seed=seed,
        marks=len(points),
        point_errors=px / points.sigma,
        coefficients=coefficient_errors(camera, true_fit),
        check=(fit.check.xy - true_model(check.xy)) / fit.check.sigma,
        check_design=(fit.check.xy - fit.check_target) / fit.check.sigma,
        check_mm={
            "similarity": simpler(RationalPolynomial.similarity(), camera.photo_system, points, fit),
            "projective": simpler(RationalPolynomial.projective(), camera.photo_system, points, fit),
            "corrected": fit.check.xy - fit.check_target,
        },
        passed=global_test.passed,
        expected=float(noncentral(global_test.upper) - noncentral(global_test.lower)),
        sigma0=fit.adjustment.sigma0,
        left=true_model(used.xy) - fit.target,
        px_per_mm=1 / camera.photo_system.scale,
    )


def simpler(model: RationalPolynomial, system: Similarity, points: ImagePoints, fit: CorrectionFit) -> Array:
    """Residuals of a simpler transformation, fitted to the same marks, at the check marks."""
    found = fit_mapping(model, fit.points, fit.target).required()
    return model.with_values(found.values)(system(points.select(fit.check.names).xy)) - fit.check_target


def from_frame(seed: int) -> list[Trial | str]:
    """The whole chain."""
    world = World.standard(seed)
    measured = measure_reseau(world.photo_i(), world.design)
    return [trial(world, measured.points, seed) if measured else f"seed {seed}: {measured.reason}"]


def from_points(seed: int, draws: int) -> list[Trial | str]:
    """The chain from points, several draws of noise in one world."""
    world, rng = World.standard(seed), np.random.default_rng([seed, 1])
    truth = world.truth()
    n = len(truth.names)
    sigma = NOISE_PX * rng.uniform(0.8, 1.25, (n, 2))
    rho = rng.uniform(-0.3, 0.3, n)
    cov = np.empty((n, 2, 2))
    cov[:, 0, 0], cov[:, 1, 1] = sigma[:, 0] ** 2, sigma[:, 1] ** 2
    cov[:, 0, 1] = cov[:, 1, 0] = rho * sigma[:, 0] * sigma[:, 1]
    root = np.linalg.cholesky(cov)
    done = []
    for _ in range(draws):
        noise = (root @ rng.standard_normal((n, 2, 1)))[..., 0]
        done.append(trial(world, ImagePoints(truth.names, truth.xy + noise, cov), seed))
    return done


def in_pixels(photo: Array) -> Array:
    """A photograph of 9 px to the millimetre, y down, of 1600 × 1200 px."""
    return np.array([799.5, 599.5]) + 9.0 * photo * [1, -1]


@cache
def unit_sigmas() -> tuple[float, ...]:
    """Standard deviations of the invariant coefficients in a world without distortion."""
    design = standard_reseau()
    points = ImagePoints.with_sigma(design.ids, in_pixels(design.xy), NOISE_PX)
    full = correct_camera(points, design, alpha=EVERYTHING, trials=0).required().fit.elimination.full
    return tuple(full.sigma_of(name) for name in INVARIANT)


def tested(seed: int, size: float) -> Array:
    """Which coefficients the first tests call significant in a world that has each at `size` sigmas."""
    design, rng = standard_reseau(), np.random.default_rng([seed, round(10 * size), 2])
    model = RationalPolynomial.camera().with_values(
        {name: size * sigma for name, sigma in zip(INVARIANT, unit_sigmas(), strict=True)}
    )
    pixels = in_pixels(model.inverse(design.xy))
    points = ImagePoints.with_sigma(design.ids, pixels + rng.normal(0.0, NOISE_PX, pixels.shape), NOISE_PX)
    full = correct_camera(points, design, alpha=EVERYTHING, trials=0).required().fit.elimination.full
    return np.array([full.test_of(name, 0.0, ALPHA).significant for name in INVARIANT])


def print_trials(title: str, found: list[Trial | str]) -> None:
    """The table of a chain."""
    done = [t for t in found if isinstance(t, Trial)]
    print(f"\n{title}: {len(done)} corrections, {len({t.seed for t in done})} worlds")
    for reason in (t for t in found if isinstance(t, str)):
        print(f"  failed: {reason}")
    if not done:
        return
    coefficients = np.array([t.coefficients for t in done])
    points = np.concatenate([t.point_errors for t in done])
    print(f"  marks measured: {sum(t.marks for t in done)}, fewest in a frame {min(t.marks for t in done)}")
    print(f"  normalised errors, rms of      measured marks {rms(points, 0).round(3)} in x and y")
    for name, values in zip(COEFFICIENTS, coefficients.T, strict=True):
        dropped = np.isnan(values).mean()
        print(f"    {name:<3} {judged(float(rms(values))):<8} mean {np.nanmean(values):+.3f}", end="")
        print(f"   dropped in {100 * dropped:.1f} %" if dropped else "")
    print(f"    all {judged(float(rms(coefficients)))}")
    check, design = (np.concatenate([getattr(t, key) for t in done]) for key in ("check", "check_design"))
    print(f"  corrected check marks, normalised: {judged(float(rms(check)))}; x, y {rms(check, 0).round(3)}")
    print(f"    against the design, approximation error and all: {rms(design):.3f}")
    passed, expected = np.mean([t.passed for t in done]), np.mean([t.expected for t in done])
    print(f"  global test ({100 * ALPHA:.0f} %): {100 * passed:.1f} % pass; ", end="")
    print(f"noise and approximation error lead to expect {100 * expected:.1f} %")
    print(f"    sigma0 median {np.median([t.sigma0 for t in done]):.3f}")
    px = np.mean([t.px_per_mm for t in done])
    left = np.array([rms(t.left) for t in done])
    most = np.array([np.hypot(*t.left.T).max() for t in done])
    print("  approximation error of the model (noise-free positions):")
    for label, values in (("rms per coordinate", left), ("largest at a mark", most)):
        print(f"    {label:<19} median {np.median(values):.5f} mm = {px * np.median(values):.4f} px", end="")
        print(f", of the worst world {values.max():.5f} mm = {px * values.max():.4f} px")
    print("  check marks against the design, rms per coordinate:")
    for label in ("similarity", "projective", "corrected"):
        value = rms(np.concatenate([t.check_mm[label] for t in done]))
        print(f"    {label:<11} {value:.5f} mm = {px * value:.4f} px")


def first_tests(executor: Executor, draws: int) -> None:
    """Simulate and print level and power of the first test of each coefficient."""
    seeds = [draws] + [max(1, draws // 4)] * (len(SIZES) - 1)
    rates = [
        np.mean(list(outcomes(executor, partial(tested, size=size), range(n), together=50)), axis=0)
        for size, n in zip(SIZES, seeds, strict=True)
    ]
    threshold, sizes = norm.isf(ALPHA / 2), np.array(SIZES)
    theory = norm.sf(threshold - sizes) + norm.cdf(-threshold - sizes)
    print_power("Group A, first χ² test of each coefficient", INVARIANT, rates, seeds, theory)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=200, help="worlds through the whole chain")
    parser.add_argument("--first", type=int, default=0, help="seed of the first of these worlds")
    parser.add_argument("--draws", type=int, default=2000, help="corrections from points, and tests of level")
    add_options(parser, jobs=1)
    given = parser.parse_args()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)
    begun = time.perf_counter()
    worlds = max(1, min(200, given.draws // 10))
    with executor_of(given) as executor:

        def spread(work: Callable[[int], list[Trial | str]], seeds: Iterable[int]) -> list[Trial | str]:
            return [one for several in outcomes(executor, work, seeds, together=4) for one in several]

        if given.draws:
            each = partial(from_points, draws=-(-given.draws // worlds))
            print_trials("From points with normal noise", spread(each, range(worlds)))
            first_tests(executor, given.draws)
        if given.frames:
            print_trials("From frames", spread(from_frame, range(given.first, given.first + given.frames)))
    print(f"\n{time.perf_counter() - begun:.0f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main_of(__file__))
