"""Reliability and tests of single observations, against direct formulae and by simulated blunders."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from reseau.adjust import GaussMarkov, Options, Parameters, adjust
from reseau.adjust.problem import GaussHelmert
from reseau.adjust.reliability import critical_tau, critical_w, noncentrality
from reseau.core.errors import UsageError

T = np.linspace(-1.0, 1.0, 12)
A = np.stack([np.ones_like(T), T, T**2], axis=1)


def covariance(kind, seed=0):
    rng = np.random.default_rng(seed)
    if kind == "sigmas":
        return rng.uniform(0.5, 2.0, len(T))
    k = 3 if kind == "blocks" else len(T)
    roots = rng.normal(size=(len(T) // k, k, k + 2))
    blocks = roots @ np.swapaxes(roots, 1, 2) / k
    return blocks if kind == "blocks" else blocks[0]


def full(given):
    if given.ndim == 1:
        return np.diag(given**2)
    if given.ndim == 2:
        return given
    k = given.shape[1]
    out = np.zeros((len(T), len(T)))
    for i, block in enumerate(given):
        out[i * k : (i + 1) * k, i * k : (i + 1) * k] = block
    return out


def parabola(y, given):
    return GaussMarkov(lambda x: A @ x, y, given, Parameters("abc", np.zeros(3)), jacobian=lambda x: A)


@pytest.mark.parametrize("kind", ["sigmas", "blocks", "full"])
def test_reliability_agrees_with_the_definitions(kind):
    given = covariance(kind)
    q = full(given)
    y = np.random.default_rng(1).multivariate_normal(np.zeros(len(T)), q)
    fit = adjust(parabola(y, given)).required()
    p = np.linalg.inv(q)
    qx = np.linalg.inv(A.T @ p @ A)
    qv = q - A @ qx @ A.T
    v = A @ fit.values - y
    np.testing.assert_allclose(fit.redundancy_numbers, np.diag(qv @ p), atol=1e-9)
    np.testing.assert_allclose(fit.w, (p @ v) / np.sqrt(np.diag(p @ qv @ p)), atol=1e-8)
    np.testing.assert_allclose(fit.tau, fit.w / fit.sigma0, atol=1e-12)
    mde = noncentrality(0.01, 0.7) / np.sqrt(np.diag(p @ qv @ p))
    np.testing.assert_allclose(fit.minimal_detectable_errors(0.01, 0.7), mde, rtol=1e-8)
    effects = (qx @ A.T @ p * mde).T
    length = np.sqrt(np.einsum("ni,ij,nj->n", effects, A.T @ p @ A, effects))
    np.testing.assert_allclose(fit.external_lengths(0.01, 0.7), length, atol=1e-8)
    np.testing.assert_allclose(fit.weighted_squares.sum(), fit.cost, rtol=1e-9)


@pytest.mark.parametrize("kind", ["sigmas", "blocks", "full"])
def test_external_reliability_equals_the_effect_of_the_error(kind):
    given = covariance(kind)
    y = np.zeros(len(T))
    error = adjust(parabola(y, given)).required().minimal_detectable_errors()
    fit = adjust(parabola(y, given)).required()
    lengths, normal = fit.external_lengths(), np.linalg.inv(fit.cofactor)
    for i in (0, 5, 11):
        spoilt = y.copy()
        spoilt[i] += error[i]
        effect = adjust(parabola(spoilt, given)).required().values
        assert np.sqrt(effect @ normal @ effect) == pytest.approx(lengths[i], rel=1e-6)


def test_an_uncontrolled_observation_has_no_test():
    function = lambda x: np.array([x[0], x[0], x[0] + x[1]])  # noqa: E731
    fit = adjust(GaussMarkov(function, [1.0, 1.2, 5.0], 0.1, Parameters("ab", [0.0, 0.0]))).required()
    assert np.isnan(fit.w[2])
    assert np.isinf(fit.minimal_detectable_errors()[2])
    np.testing.assert_allclose(fit.redundancy_numbers, [0.5, 0.5, 0.0], atol=1e-9)


def test_critical_values_are_those_of_the_tables():
    assert noncentrality(0.001, 0.80) == pytest.approx(4.132, abs=1e-3)
    assert noncentrality(0.05, 0.80) == pytest.approx(2.802, abs=1e-3)
    assert critical_w(0.05) == pytest.approx(1.960, abs=1e-3)
    # τ approaches w as the redundancy grows, and is bounded by √r.
    assert critical_tau(0.05, 100000) == pytest.approx(critical_w(0.05), abs=1e-3)
    assert critical_tau(1e-6, 3) < np.sqrt(3.0)
    for bad in (lambda: critical_w(0.0), lambda: critical_tau(0.05, 1), lambda: noncentrality(0.1, 0.05)):
        with pytest.raises(UsageError):
            bad()


def within(count, trials, probability, sigmas=4.0):
    """Whether a rate agrees with the expected one, within some standard deviations of a binomial variable."""
    spread = np.sqrt(trials * probability * (1 - probability))
    return abs(count - trials * probability) < sigmas * spread


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["sigmas", "blocks", "full"])
def test_blunders_of_the_minimal_detectable_size_are_found_at_the_power_of_theory(kind):
    alpha, power, trials, at = 0.01, 0.8, 1500, 4
    given = covariance(kind)
    rng = np.random.default_rng(7)
    error = adjust(parabola(np.zeros(len(T)), given)).required().minimal_detectable_errors(alpha, power)[at]
    noise = rng.multivariate_normal(np.zeros(len(T)), full(given), trials)
    found = false = 0
    for y in noise:
        false += abs(adjust(parabola(y, given)).required().w[at]) > critical_w(alpha)
        y[at] += error
        found += abs(adjust(parabola(y, given)).required().w[at]) > critical_w(alpha)
    assert within(found, trials, power)
    assert within(false, trials, alpha)


@pytest.mark.slow
def test_blunders_in_conditions_are_found_at_the_power_of_theory():
    """Gauss–Helmert: both coordinates of points on a circle observed; errors along the first."""
    alpha, power, trials, at = 0.01, 0.8, 600, 0
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False) + 0.2
    true = np.column_stack([np.cos(angle), np.sin(angle)]) * 50.0 + [3.0, -2.0]

    def conditions(xy, x):
        d = xy - x[:2]
        return ((d**2).sum(axis=1) / x[2] - x[2])[:, None] / 2

    def jacobians(xy, x):
        d = xy - x[:2]
        a = np.column_stack([-d / x[2], -((d**2).sum(axis=1) / x[2] ** 2 + 1) / 2])
        return a[:, None, :], (d / x[2])[:, None, :]

    def circle(xy):
        start = Parameters(["x", "y", "r"], [0.0, 0.0, 45.0])
        return GaussHelmert(conditions, xy, 0.1, start, jacobians)

    error = adjust(circle(true)).required().minimal_detectable_errors(alpha, power)[at, 0]
    rng = np.random.default_rng(2)
    found = false = 0
    for _ in range(trials):
        xy = true + rng.normal(0, 0.1, true.shape)
        false += abs(adjust(circle(xy)).required().w[at, 0]) > critical_w(alpha)
        xy[at, 0] += error
        found += abs(adjust(circle(xy)).required().w[at, 0]) > critical_w(alpha)
    # The circle is curved over the error of some 0.6 in 50: that changes the power by less than its spread.
    assert within(found, trials, power)
    assert within(false, trials, alpha)


@pytest.mark.slow
def test_tau_keeps_its_level_when_the_sigmas_are_unknown():
    alpha, trials = 0.05, 2000
    rng = np.random.default_rng(11)
    critical = critical_tau(alpha, len(T) - 3)
    above = 0
    for _ in range(trials):
        fit = adjust(parabola(rng.normal(0, 7.0, len(T)), None)).required()
        above += abs(fit.tau[4]) > critical
    assert within(above, trials, alpha)


def curved(y, sigma=0.01):
    def function(x):
        return x[0] * np.exp(x[1] * T) + x[2] * T

    def jacobian(x):
        e = np.exp(x[1] * T)
        return np.stack([e, x[0] * T * e, T], axis=1)

    return GaussMarkov(function, y, sigma, Parameters("abc", [1.0, 1.0, 0.0]), jacobian)


def simulate(trials, seed=5, sigma=0.01):
    true = np.array([1.5, 0.9, -0.4])
    clean = true[0] * np.exp(true[1] * T) + true[2] * T
    rng = np.random.default_rng(seed)
    for _ in range(trials):
        yield true, adjust(curved(clean + rng.normal(0, sigma, len(T)), sigma)).required()


def coverage(trials):
    sigmas = ellipses = posterior = passed = 0
    variance = 0.0
    for true, fit in simulate(trials):
        error = fit.values - true
        a_priori = np.sqrt(np.diag(fit.cofactor))
        sigmas += np.abs(error) < stats.norm.ppf(0.95) * a_priori
        posterior += np.abs(error) < stats.t.ppf(0.95, fit.redundancy) * fit.sigma
        two = error[:2]
        q = fit.covariance_of("a", "b", scaled=False)
        ellipses += two @ np.linalg.solve(q, two) < stats.chi2.ppf(0.9, 2)
        variance += fit.sigma0**2
        passed += fit.global_test(0.1).passed
    return sigmas, posterior, ellipses, variance / trials, passed


def holds(trials):
    sigmas, posterior, ellipses, variance, passed = coverage(trials)
    assert all(within(count, trials, 0.9) for count in sigmas)
    assert all(within(count, trials, 0.9) for count in posterior)
    assert within(ellipses, trials, 0.9)
    assert within(passed, trials, 0.9)
    # Variance of the variance factor: 2 / redundancy.
    assert abs(variance - 1.0) < 4.0 * np.sqrt(2.0 / (len(T) - 3) / trials)


@pytest.mark.slow
def test_predicted_sigmas_and_ellipses_cover_at_their_probability():
    holds(1500)


@pytest.mark.slow
def test_predicted_sigmas_and_ellipses_cover_at_their_probability_over_many_trials():
    holds(20000)


@pytest.mark.slow
def test_sigma0_is_one_when_the_sigmas_are_true():
    given = covariance("full")
    rng = np.random.default_rng(3)
    trials = 1000
    noise = rng.multivariate_normal(np.zeros(len(T)), full(given), trials)
    mean = np.mean([adjust(parabola(y, given)).required().sigma0 ** 2 for y in noise])
    assert abs(mean - 1.0) < 4.0 * np.sqrt(2.0 / (len(T) - 3) / trials)


def test_the_global_test_finds_sigmas_that_are_too_small():
    y = np.random.default_rng(0).normal(0, 3.0, len(T))
    test = adjust(parabola(y, np.ones(len(T)))).required().global_test()
    assert not test.passed
    assert test.p < 0.05
    assert test.statistic > test.upper


@pytest.mark.slow
def test_t_and_chi2_tests_of_a_coefficient_keep_their_level():
    trials, alpha = 1000, 0.05
    rng = np.random.default_rng(9)
    t = chi2 = 0
    for _ in range(trials):
        y = 2.0 + rng.normal(0, 0.5, len(T))
        t += adjust(parabola(y, 0.5)).required().test_of("c", alpha=alpha).significant
        chi2 += adjust(parabola(y, 0.5), Options(scale="a-priori")).required().test_of("c").significant
    assert within(t, trials, alpha)
    assert within(chi2, trials, alpha)


@pytest.mark.parametrize(("alpha", "power"), [(0.001, 0.8), (0.4, 0.5)])
def test_the_noncentrality_gives_the_power_of_the_test_on_both_sides(alpha: float, power: float) -> None:
    square = noncentrality(alpha, power) ** 2
    assert stats.ncx2.sf(critical_w(alpha) ** 2, 1, square) == pytest.approx(power, abs=1e-9)
