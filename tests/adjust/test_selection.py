"""Choosing parameters and weights: nested models, elimination, variance components."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.adjust import GaussMarkov, Parameters, adjust, eliminate, variance_components
from reseau.adjust.engine import AdjustmentFailure
from reseau.adjust.fitted import compare
from reseau.adjust.problem import GaussHelmert
from reseau.core.errors import UsageError

from ..montecarlo import slowly

T = np.linspace(-1.0, 1.0, 40)
POWERS = np.stack([T**i for i in range(6)], axis=1)
NAMES = [f"a{i}" for i in range(6)]


def polynomial(y, sigma=0.05, **more):
    parameters = more.pop("parameters", Parameters(NAMES, np.zeros(6)))
    return GaussMarkov(lambda x: POWERS @ x, y, sigma, parameters, jacobian=lambda x: POWERS, **more)


def cubic(seed=0, sigma=0.05):
    return 1.0 - 2.0 * T + 3.0 * T**3 + np.random.default_rng(seed).normal(0, sigma, len(T))


@pytest.mark.parametrize("criterion", ["t", "chi2", "F"])
def test_elimination_keeps_the_terms_of_the_simulated_model(criterion):
    found = eliminate(polynomial(cubic()), alpha=0.001, criterion=criterion).required()
    assert set(found.adjustment.free) == {"a0", "a1", "a3"}
    assert set(found.dropped) == {"a2", "a4", "a5"}
    for step in found.steps:
        assert not step.test.significant
        assert step.test.statistic <= step.test.critical
    assert all(test.significant for test in found.kept)
    assert found.full.free == tuple(NAMES)
    for name in found.dropped:
        assert found.adjustment[name] == 0.0


def test_the_weakest_parameter_is_dropped_first_and_its_test_is_recorded():
    fit = adjust(polynomial(cubic())).required()
    weakest = min(NAMES, key=lambda name: fit.test_of(name).statistic)
    first = eliminate(polynomial(cubic())).required().steps[0]
    assert first.name == weakest
    assert first.test == fit.test_of(weakest)
    assert first.parameters == 6
    assert first.sigma0_before == fit.sigma0


def test_the_f_test_of_one_parameter_is_the_square_of_its_t():
    t = eliminate(polynomial(cubic()), criterion="t").required().steps[0].test
    f = eliminate(polynomial(cubic()), criterion="F").required().steps[0].test
    assert f.name == t.name
    assert f.statistic == pytest.approx(t.statistic**2, rel=1e-6)
    assert f.p == pytest.approx(t.p, rel=1e-6)


def test_parameters_to_be_kept_are_kept():
    found = eliminate(polynomial(cubic()), alpha=0.001, keep=["a2", "a5"]).required()
    assert {"a2", "a5"} <= set(found.adjustment.free)
    with pytest.raises(UsageError, match="a9"):
        eliminate(polynomial(cubic()), keep=["a9"])


def test_elimination_returns_the_failure_of_the_adjustment():
    twice = GaussMarkov(lambda x: T * (x[0] + x[1]), cubic(), 0.1, Parameters("ab", [0.0, 0.0]))
    found = eliminate(twice)
    assert not found
    assert isinstance(found, AdjustmentFailure)
    assert "a with b" in found.reason


def test_elimination_drops_at_its_level():
    """A term that is not there survives with probability alpha."""
    alpha, trials = 0.1, 400
    rng = np.random.default_rng(4)
    survived = 0
    start = Parameters(NAMES, np.zeros(6), free=["a0", "a1"])
    for _ in range(trials):
        y = 1.0 + rng.normal(0, 0.05, len(T))
        found = eliminate(polynomial(y, parameters=start), alpha=alpha, keep=["a0"]).required()
        survived += "a1" in found.adjustment.free
    assert abs(survived - alpha * trials) < 4 * np.sqrt(trials * alpha * (1 - alpha))


@pytest.mark.slow
def test_the_f_test_of_nested_models_keeps_its_level_and_finds_what_is_missing():
    alpha, trials = 0.05, 600
    rng = np.random.default_rng(5)
    start = Parameters(NAMES, np.zeros(6))
    false = 0
    for _ in range(trials):
        y = 1.0 + rng.normal(0, 0.05, len(T))
        full = adjust(polynomial(y)).required()
        nested = adjust(polynomial(y, parameters=start.fix("a3", "a4", "a5"))).required()
        test = compare(nested, full, alpha)
        assert test.degrees == (3, len(T) - 6)
        false += test.significant
    assert abs(false - alpha * trials) < 4 * np.sqrt(trials * alpha * (1 - alpha))
    nested = adjust(polynomial(cubic(), parameters=start.fix("a3", "a4", "a5"))).required()
    assert compare(nested, adjust(polynomial(cubic())).required()).significant


GROUPS = {"fine": np.arange(40) % 2 == 0, "coarse": np.arange(40) % 2 == 1}


@pytest.mark.slow
def test_variance_components_are_the_true_ones_in_the_mean():
    trials = 150
    rng = np.random.default_rng(6)
    squares = np.zeros(2)
    for _ in range(trials):
        sigma = np.where(GROUPS["fine"], 0.02, 0.3)
        found = variance_components(polynomial(rng.normal(0, sigma), 0.1), GROUPS).required()
        squares += found.factors**2
        assert found.redundancy.sum() == pytest.approx(found.adjustment.redundancy, abs=1e-6)
        assert found.adjustment.sigma0 == pytest.approx(1.0, abs=1e-4)
    # 150 variances with some 17 degrees of freedom each: known to 3 %.
    np.testing.assert_allclose(squares / trials / [0.04, 9.0], 1.0, atol=0.12)


def test_variance_components_of_two_kinds_of_observations_in_marks():
    rng = np.random.default_rng(8)
    t = np.linspace(0, 10, 60)
    xy = np.column_stack([t, np.sin(t)]) + rng.normal(size=(60, 2)) * 0.05

    def conditions(p, x):
        return (x[0] * np.sin(p[:, 0]) + x[1] - p[:, 1])[:, None]

    def jacobians(p, x):
        a = np.stack([np.sin(p[:, 0]), np.ones(len(p))], axis=1)
        b = np.stack([x[0] * np.cos(p[:, 0]), -np.ones(len(p))], axis=1)
        return a[:, None], b[:, None]

    problem = GaussHelmert(conditions, xy, 0.01, Parameters("ab", [1.0, 0.0]), jacobians)
    every = {"all": np.ones((60, 2), bool)}
    found = variance_components(problem, every).required()
    assert found["all"] == pytest.approx(5.0, abs=4 * found.sigma[0])
    assert found["all"] == pytest.approx(adjust(problem).required().sigma0, rel=1e-6)


def test_one_group_of_all_is_the_variance_factor():
    y = cubic()
    found = variance_components(polynomial(y), {"all": np.ones(40, bool)}).required()
    assert found["all"] == pytest.approx(adjust(polynomial(y)).required().sigma0, rel=1e-9)


@pytest.mark.parametrize(
    ("groups", "words"),
    [
        ({"a": np.ones(40, bool), "b": GROUPS["fine"]}, "overlaps"),
        ({"a": np.zeros(40, bool)}, "mask"),
        ({"a": np.ones(39, bool)}, "mask"),
    ],
)
def test_invalid_groups_are_errors(groups, words):
    with pytest.raises(UsageError, match=words):
        variance_components(polynomial(cubic()), groups)


@pytest.mark.slow
@pytest.mark.parametrize("rho", [*slowly(0.3), -0.85])
def test_variance_components_of_correlated_groups_are_the_true_ones_in_the_mean(rho):
    """Pairs of x and y whose sigmas are 2 and 0.5 times those given, their correlation as given."""
    rng, squares, factors = np.random.default_rng(9), np.zeros(2), []
    t, true = np.linspace(-1, 1, 60), np.array([2.0, 0.5])
    given = np.tile(0.1**2 * np.array([[1.0, rho], [rho, 1.0]]), (60, 1, 1))
    root = np.linalg.cholesky(given[0])

    def function(x):
        return np.column_stack([x[0] + x[1] * t, x[2] + x[1] * t**2])

    x = np.tile([True, False], (60, 1))
    trials = 80
    for _ in range(trials):
        y = true * (rng.normal(size=(60, 2)) @ root.T)
        problem = GaussMarkov(function, y, given, Parameters("abc", [0.0, 0.0, 0.0]))
        found = variance_components(problem, {"x": x, "y": ~x}).required()
        squares += found.factors**2
        factors.append(found.factors)
        assert found.redundancy.sum() == pytest.approx(117, abs=1e-6)
        assert found.adjustment.sigma0 == pytest.approx(1.0, abs=1e-4)
    # 80 variances with some 58 degrees of freedom each: known to 2 %.
    np.testing.assert_allclose(squares / trials / true**2, 1.0, atol=0.08)
    # The sigma said of a factor is no smaller than its scatter, and hardly larger.
    scatter = np.std(factors, axis=0) / true
    assert (scatter < 1.25 / np.sqrt(2 * 58)).all()
    assert (scatter > 0.55 / np.sqrt(2 * 58)).all()


def test_a_group_without_redundancy_is_a_failure_that_names_it():
    y = np.array([0.0, 0.1, -0.1, 0.2, 0.0, 3.0])

    def function(x):
        return np.append(np.full(5, x[0]), x[0] + x[1])

    problem = GaussMarkov(function, y, 0.1, Parameters("ab", [0.0, 0.0]))
    found = variance_components(problem, {"many": np.arange(6) < 5, "lonely": np.arange(6) == 5})
    assert not found
    assert "lonely" in found.reason
