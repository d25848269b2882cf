"""Blunders: rejection, snooping, robust weights, consensus."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.adjust import GaussMarkov, Parameters, adjust, adjust_batch, data_snooping, weight_function
from reseau.adjust.batch import BatchOptions
from reseau.adjust.outliers import robust
from reseau.adjust.problem import GaussHelmert
from reseau.core.errors import UsageError
from reseau.core.failure import Code

T = np.linspace(0.0, 10.0, 50)
A = np.stack([np.ones_like(T), T], axis=1)


def line(y, sigma=0.1, **more):
    return GaussMarkov(lambda x: A @ x, y, sigma, Parameters("ab", [0.0, 0.0]), lambda x: A, **more)


def clean(seed=0):
    return 2.0 + 0.3 * T + np.random.default_rng(seed).normal(0, 0.1, len(T))


def spoilt(seed=0, rows=(3, 20, 44), size=3.0):
    y = clean(seed)
    y[list(rows)] += size
    return y


def marks(seed=0, rows=()):
    rng = np.random.default_rng(seed)
    xy = np.column_stack([T, 2.0 + 0.3 * T]) + rng.normal(0, 0.1, (50, 2))
    for row in rows:
        xy[row, 1] += 3.0

    def conditions(p, x):
        return (x[0] + x[1] * p[:, 0] - p[:, 1])[:, None]

    def jacobians(p, x):
        a = np.stack([np.ones(len(p)), p[:, 0]], axis=1)
        return a[:, None], np.tile([x[1], -1.0], (len(p), 1, 1))

    return GaussHelmert(conditions, xy, 0.1, Parameters("ab", [0.0, 0.0]), jacobians)


def test_snooping_finds_the_blunders_and_nothing_else():
    found = data_snooping(line(spoilt()), alpha=0.0001).required()
    assert np.flatnonzero(found.rejected).tolist() == [3, 20, 44]
    without = np.ones(50)
    without[[3, 20, 44]] = 0
    direct = adjust(line(spoilt(), weights=without)).required()
    np.testing.assert_allclose(found.adjustment.values, direct.values, atol=1e-10)
    assert [step.restored for step in found.steps] == [False] * 3
    assert all(step.statistic > step.critical for step in found.steps)


def test_snooping_in_groups_finds_the_same_in_fewer_rounds():
    """One of each group leaves in a round; good ones that left with them come back."""
    alone = data_snooping(line(spoilt()), alpha=0.0001).required()
    groups = np.arange(len(T)) // 10
    together = data_snooping(line(spoilt()), alpha=0.0001, groups=groups).required()
    np.testing.assert_array_equal(together.rejected, alone.rejected)
    assert together.rounds < alone.rounds
    assert together.adjustment.sigma0 == pytest.approx(alone.adjustment.sigma0, rel=1e-12)


def test_snooping_by_tau_needs_no_true_sigmas():
    found = data_snooping(line(spoilt(), sigma=None), alpha=0.001, test="tau").required()
    assert np.flatnonzero(found.rejected).tolist() == [3, 20, 44]


def test_snooping_leaves_good_observations_alone_at_its_level():
    """Over n observations some are rejected with probability ≈ 1 − (1 − α)ⁿ."""
    alpha, trials = 0.001, 200
    some = sum(
        bool(data_snooping(line(clean(seed)), alpha).required().rejected.any()) for seed in range(trials)
    )
    expected = trials * (1 - (1 - alpha) ** len(T))
    assert abs(some - expected) < 4 * np.sqrt(expected)


def test_snooping_restores_good_observations_rejected_because_of_larger_blunders():
    """Two blunders on the same lever hide each other, and good observations look worst at first."""
    x = np.append(np.arange(0.0, 5.5, 0.5), [12.0, 12.5])
    design = np.stack([np.ones_like(x), x], axis=1)
    restored = 0
    for seed in range(100):
        y = np.random.default_rng(seed).normal(0, 0.1, len(x))
        y[-2:] += 1.5
        problem = GaussMarkov(lambda p: design @ p, y, 0.1, Parameters("ab", [0.0, 0.0]), lambda p: design)
        found = data_snooping(problem, alpha=0.01, max_fraction=0.6)
        back = [step for step in found.steps if step.restored] if found else []
        for step in back:
            assert step.statistic <= step.critical
            assert step.index in [other.index for other in found.steps if not other.restored]
        restored += bool(back)
    assert restored > 2


def test_too_many_blunders_are_a_failure_that_names_the_model_as_possible_cause():
    y = 2.0 + 0.3 * T + np.sin(T) * 3
    found = data_snooping(line(y))
    assert not found
    assert found.code is Code.TOO_MANY_OUTLIERS
    assert "model" in found.reason


def test_initially_excluded_observations_stay_excluded_and_are_not_counted_as_rejected():
    weights = np.ones(50)
    weights[7] = 0.0
    y = spoilt()
    y[7] = 1e9
    found = data_snooping(line(y, weights=weights), 0.0001).required()
    assert np.flatnonzero(found.rejected).tolist() == [3, 20, 44]
    assert found.adjustment.rejected[7]


def test_a_mark_is_rejected_with_both_coordinates():
    rejected = data_snooping(marks(rows=[5, 30]), 0.0001).required().rejected
    assert np.flatnonzero(rejected[:, 0]).tolist() == [5, 30]
    np.testing.assert_array_equal(rejected[:, 0], rejected[:, 1])


@pytest.mark.parametrize("name", ["huber", "tukey", "danish"])
@pytest.mark.parametrize("scale", ["mad", "a-priori"])
def test_robust_weights_limit_the_effect_of_blunders(name, scale):
    found = robust(line(spoilt(size=20.0)), name, scale=scale).required()
    good = adjust(line(clean())).required()
    plain = adjust(line(spoilt(size=20.0))).required()
    error = np.abs(found.adjustment.values - good.values) / np.sqrt(np.diag(good.cofactor))
    worse = np.abs(plain.values - good.values) / np.sqrt(np.diag(good.cofactor))
    assert error.max() < 1.0
    assert worse.max() > 10.0
    assert found.factors[[3, 20, 44]].max() < 0.1
    if scale == "mad":
        assert found.scale == pytest.approx(1.0, abs=0.35)


def test_huber_estimates_solve_hubers_equation():
    """Σ ψ(v/σs) a = 0 with ψ bounded at 1.345."""
    found = robust(line(spoilt()), "huber", tolerance=1e-10).required()
    v = found.adjustment.residuals / 0.1 / found.scale
    psi = np.clip(v, -1.345, 1.345)
    assert np.abs(A.T @ psi).max() < 1e-5 * np.abs(A).sum()


def test_robust_marks_share_one_factor():
    found = robust(marks(rows=[5, 30]), "tukey").required()
    np.testing.assert_array_equal(found.factors[:, 0], found.factors[:, 1])
    assert (found.factors[[5, 30]] == 0).all()
    assert found.scale == pytest.approx(1.0, abs=0.35)


@pytest.mark.parametrize("name", ["huber", "tukey", "danish"])
def test_weight_functions_are_one_at_zero_even_and_falling(name):
    function = weight_function(name)
    t = np.linspace(0, 60, 601)
    w = function(t)
    assert w[0] == 1.0
    assert (np.diff(w) <= 0).all()
    assert (w >= 0).all()
    assert w[-1] < 0.05
    np.testing.assert_array_equal(function(-t), w)


def test_weight_functions_work_in_a_batch():
    y = spoilt(size=20.0)[None]

    def function(x, rows):
        return x @ A.T, np.broadcast_to(A, (len(rows), 50, 2))

    options = BatchOptions(reweight=weight_function("huber"), max_iterations=100, tolerance=1e-9)
    batch = adjust_batch(function, np.zeros((1, 2)), y, weights=np.full((1, 50), 100.0), options=options)
    single = robust(line(y[0]), "huber", tolerance=1e-9).required()
    np.testing.assert_allclose(batch.estimates[0], single.adjustment.values, atol=1e-6)


def test_misuse_is_an_error():
    for call in (
        lambda: weight_function("cauchy"),
        lambda: weight_function("huber", -1.0),
        lambda: robust(line(clean()), scale="mean"),
        lambda: data_snooping(line(clean()), test="t"),
    ):
        with pytest.raises(UsageError):
            call()
