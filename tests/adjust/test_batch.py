"""The batch: right estimates and cofactors, many at once, and none that spoils another."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.adjust import adjust_batch, weight_function
from reseau.adjust.batch import BatchOptions, BatchReason
from reseau.core.errors import UsageError

T = np.linspace(0.0, 4.0, 40)


def decay(x, rows):
    """y = a exp(-b t) + c for each problem."""
    a, b, c = (x[:, i : i + 1] for i in range(3))
    e = np.exp(-b * T)
    return a * e + c, np.stack([e, -a * T * e, np.ones_like(e)], axis=2)


def simulated(k=50, sigma=0.01, seed=1):
    rng = np.random.default_rng(seed)
    true = np.column_stack([rng.uniform(1, 3, k), rng.uniform(0.5, 2, k), rng.normal(size=k)])
    return true, decay(true, np.arange(k))[0] + rng.normal(0, sigma, (k, len(T)))


def test_exact_data_give_the_true_parameters():
    true, y = simulated(sigma=0.0)
    fit = adjust_batch(decay, true * [0.6, 1.5, 1.0], y)
    assert fit.converged.all()
    np.testing.assert_allclose(fit.estimates, true, atol=1e-9)


def test_the_sigmas_cover_the_true_errors():
    true, y = simulated(k=2000, seed=2)
    fit = adjust_batch(decay, true + 0.1, y)
    t = (fit.estimates - true) / fit.sigma
    # 2000 standardised errors: their rms is 1 ± 0.016 (1 σ), and σ0 known to √(1/74000).
    np.testing.assert_allclose(np.sqrt((t**2).mean(axis=0)), 1.0, atol=0.06)
    assert np.sqrt((fit.sigma0**2).mean()) == pytest.approx(0.01, rel=0.012)


def test_observations_of_weight_zero_have_no_effect_even_if_nan():
    true, y = simulated(k=3)
    keep = np.ones(len(T), bool)
    keep[[3, 17]] = False
    gappy = np.where(keep, y, np.nan)
    weights = np.broadcast_to(keep.astype(float), y.shape)
    fit = adjust_batch(decay, true, gappy, weights=weights, options=BatchOptions(tolerance=1e-12))

    def shortened(x, rows):
        values, jacobian = decay(x, rows)
        return values[:, keep], jacobian[:, keep]

    short = adjust_batch(shortened, true, y[:, keep], options=BatchOptions(tolerance=1e-12))
    np.testing.assert_allclose(fit.estimates, short.estimates, atol=1e-10)
    np.testing.assert_allclose(fit.cofactor, short.cofactor, rtol=1e-7)
    assert (fit.redundancy == len(T) - 2 - 3).all()


def test_a_singular_problem_is_flagged_and_does_not_affect_the_others():
    true, y = simulated(k=5)

    def with_troubles(x, rows):
        values, jacobian = (a.copy() for a in decay(x, rows))
        values[rows == 1] = np.nan
        jacobian[rows == 3, :, 2] = jacobian[rows == 3, :, 0]
        return values, jacobian

    start = true + 0.1
    fit = adjust_batch(with_troubles, start, y)
    alone = adjust_batch(decay, start, y)
    healthy = [0, 2, 4]
    np.testing.assert_array_equal(fit.estimates[healthy], alone.estimates[healthy])
    assert fit.reasons[1] == BatchReason.NOT_FINITE
    assert fit.reasons[3] == BatchReason.SINGULAR
    assert fit.converged.tolist() == [True, False, True, False, True]
    assert np.isnan(fit.cofactor[3]).all()


def test_too_few_observations_are_singular():
    true, y = simulated(k=2)
    weights = np.zeros_like(y)
    weights[0], weights[1, :2] = 1.0, 1.0
    fit = adjust_batch(decay, true, y, weights=weights)
    assert fit.reasons.tolist() == [BatchReason.CONVERGED, BatchReason.SINGULAR]
    assert np.isnan(fit.sigma0[1])


def test_only_active_problems_are_evaluated():
    true, y = simulated(k=6, sigma=0.0)
    start = true.copy()
    start[4] += [0.5, 0.3, 0.2]
    asked = []

    def recording(x, rows):
        asked.append(rows.tolist())
        return decay(x, rows)

    fit = adjust_batch(recording, start, y)
    assert asked[0] == list(range(6))
    assert all(rows == [4] for rows in asked[1:])
    assert fit.iterations.tolist() == [0, 0, 0, 0, len(asked) - 1, 0]


def test_a_prior_counts_as_an_observation():
    true, y = simulated(k=4)
    tight = np.array([np.inf, np.inf, 1e-9])
    mean = true.copy()
    mean[:, 2] += 0.05
    fit = adjust_batch(decay, true, y, prior=(mean, tight))
    assert fit.converged.all()
    np.testing.assert_allclose(fit.estimates[:, 2], mean[:, 2], atol=1e-9)
    assert (fit.redundancy == len(T) + 1 - 3).all()
    np.testing.assert_allclose(np.sqrt(fit.cofactor[:, 2, 2]), 1e-9, rtol=1e-3)


def test_badly_scaled_columns_do_not_cause_a_rank_defect():
    true, y = simulated(k=3)
    unit = np.array([1e-9, 1.0, 1e9])

    def in_other_units(x, rows):
        values, jacobian = decay(x * unit, rows)
        return values, jacobian * unit

    fit = adjust_batch(in_other_units, (true + 0.05) / unit, y)
    plain = adjust_batch(decay, true + 0.05, y)
    assert fit.converged.all()
    np.testing.assert_allclose(fit.estimates * unit, plain.estimates, atol=1e-6)


def test_reweighting_is_robust_against_a_corner_of_wrong_pixels():
    true, y = simulated(k=20)
    bad = y.copy()
    bad[:, 30:36] += 0.5

    def tukey(t):
        return np.where(np.abs(t) < 4.685, (1 - np.minimum(np.abs(t) / 4.685, 1.0) ** 2) ** 2, 0.0)

    plain = adjust_batch(decay, true, bad)
    robust = adjust_batch(decay, true, bad, options=BatchOptions(reweight=tukey, max_iterations=60))
    clean = adjust_batch(decay, true, y)
    assert robust.converged.all()
    assert (robust.factors[:, 30:36] == 0).all()
    # The robust estimates differ from those of the clean data by little more than their own noise.
    assert np.abs((robust.estimates - clean.estimates) / clean.sigma).max() < 2.0
    assert np.abs((plain.estimates - clean.estimates) / clean.sigma).max() > 10.0


def test_a_robust_problem_without_misfit_is_solved_exactly():
    design = np.stack([np.ones(5), np.arange(5.0)], axis=1)
    fit = adjust_batch(
        lambda x, rows: (x @ design.T, np.broadcast_to(design, (len(rows), *design.shape))),
        np.zeros((2, 2)),
        np.array([[1.0, 3, 5, 7, 9], [0, 0, 0, 0, 0]]),
        prior=(np.zeros((2, 2)), np.full(2, 1e6)),
        options=BatchOptions(reweight=weight_function("tukey"), max_iterations=20, tolerance=1e-9),
    )
    np.testing.assert_allclose(fit.estimates, [[1, 2], [0, 0]], rtol=0, atol=1e-8)


def test_a_problem_that_reaches_the_iteration_limit_is_reported():
    true, y = simulated(k=2)
    fit = adjust_batch(decay, true * 0.3, y, options=BatchOptions(max_iterations=1))
    assert fit.reasons.tolist() == [BatchReason.MAX_ITERATIONS] * 2
    assert not fit.converged.any()


@pytest.mark.parametrize(
    ("start", "observed", "weights", "prior"),
    [
        (np.zeros(3), np.zeros((2, 40)), None, None),
        (np.zeros((2, 3)), np.zeros((2, 40)), -np.ones((2, 40)), None),
        (np.zeros((2, 3)), np.full((2, 40), np.nan), None, None),
        (np.zeros((2, 3)), np.zeros((2, 40)), None, (np.zeros((2, 3)), np.zeros(3))),
        (np.zeros((2, 3)), np.zeros((2, 39)), None, None),
    ],
)
def test_misuse_is_an_error(start, observed, weights, prior):
    with pytest.raises(UsageError):
        adjust_batch(decay, start, observed, weights=weights, prior=prior)


def test_derivatives_of_the_wrong_sign_are_reported_as_not_converged():
    true, y = simulated(k=2)

    def wrong(x, rows):
        values, jacobian = decay(x, rows)
        return values, np.where((rows == 0)[:, None, None], -jacobian, jacobian)

    fit = adjust_batch(wrong, true + 0.2, y, options=BatchOptions(max_iterations=200, tolerance=1e-9))
    assert fit.reasons.tolist() == [BatchReason.DIVERGED, BatchReason.CONVERGED]


def test_reused_jacobians_give_nearly_the_same_estimates_with_fewer_evaluations():
    true, y = simulated(k=200, seed=4)
    asked = 0

    def counted(x, rows):
        nonlocal asked
        asked += len(rows)
        return decay(x, rows)

    start, options = true * [1.01, 0.99, 1.0], BatchOptions(share=0.01)
    kept = adjust_batch(counted, start, y, values=lambda x, rows: decay(x, rows)[0], options=options)
    few, asked = asked, 0
    renewed = adjust_batch(counted, start, y, options=options)
    assert kept.converged.all()
    assert few < 0.7 * asked
    # Jacobians a hundredth off cost about that of a standard deviation.
    off = (kept.estimates - renewed.estimates) / renewed.sigma
    assert np.sqrt((off**2).mean()) < 0.03
    np.testing.assert_allclose(kept.sigma, renewed.sigma, rtol=0.1)


def test_a_jacobian_that_does_not_reduce_the_cost_is_recomputed():
    true, y = simulated(k=50)
    fit = adjust_batch(
        decay,
        true * [0.5, 2.0, 1.0],
        y,
        values=lambda x, rows: decay(x, rows)[0],
        options=BatchOptions(share=0.01),
    )
    assert fit.converged.all()
    t = (fit.estimates - true) / fit.sigma
    # 50 standardised errors each: their rms is 1 ± 0.1 (1 σ).
    np.testing.assert_allclose(np.sqrt((t**2).mean(axis=0)), 1.0, atol=0.35)


def test_values_and_reweight_must_not_be_given_together():
    _, y = simulated(k=2)
    with pytest.raises(UsageError, match="must not be given together"):
        adjust_batch(
            decay,
            np.ones((2, 3)),
            y,
            values=lambda x, rows: decay(x, rows)[0],
            options=BatchOptions(reweight=lambda t: np.ones_like(t)),
        )
