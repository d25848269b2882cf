"""The engine: estimates, covariances, constraints, priors, datum, failures, of both kinds of problem."""

from __future__ import annotations

import itertools
from decimal import Decimal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reseau.adjust import GaussMarkov, Options, Parameters, adjust
from reseau.adjust.differences import differences
from reseau.adjust.engine import AdjustmentFailure
from reseau.adjust.parameters import Prior
from reseau.adjust.problem import GaussHelmert
from reseau.core.errors import EstimationError, UsageError

T = np.linspace(0.0, 4.0, 30)
TRUE = np.array([2.0, 0.8, 0.5])


def decay(x):
    return x[0] * np.exp(-x[1] * T) + x[2]


def decay_jacobian(x):
    e = np.exp(-x[1] * T)
    return np.stack([e, -x[0] * T * e, np.ones_like(T)], axis=1)


def noisy(sigma=0.01, seed=3):
    return decay(TRUE) + np.random.default_rng(seed).normal(0, sigma, len(T))


def decay_problem(y=None, covariance=0.01, **more):
    parameters = more.pop("parameters", Parameters("abc", [1.0, 1.0, 0.0]))
    more.setdefault("jacobian", decay_jacobian)
    return GaussMarkov(decay, noisy() if y is None else y, covariance, parameters, **more)


def spd(rng, n):
    a = rng.normal(size=(n, n + 3))
    return a @ a.T / n * 1e-4


def test_exact_observations_give_the_true_parameters():
    fit = adjust(decay_problem(decay(TRUE))).required()
    np.testing.assert_allclose(fit.values, TRUE, atol=1e-11)


@pytest.mark.parametrize("jacobian", [decay_jacobian, None])
def test_linear_theory_holds_at_the_minimum(jacobian):
    """v ⟂ columns, Q = (AᵀPA)⁻¹, sigma0² = vᵀPv / r with a full covariance."""
    covariance = spd(np.random.default_rng(1), len(T))
    fit = adjust(decay_problem(covariance=covariance, jacobian=jacobian)).required()
    a, p = decay_jacobian(fit.values), np.linalg.inv(covariance)
    normal = a.T @ p @ a
    gradient = a.T @ p @ fit.residuals
    # The correction still to come, in standard deviations.
    assert np.sqrt(gradient @ np.linalg.solve(normal, gradient)) < 1e-7
    np.testing.assert_allclose(fit.cofactor, np.linalg.inv(normal), rtol=1e-6)
    assert fit.redundancy == len(T) - 3
    assert fit.sigma0**2 == pytest.approx(fit.residuals @ p @ fit.residuals / fit.redundancy, rel=1e-9)
    np.testing.assert_allclose(fit.adjusted, decay(fit.values), atol=1e-13)


def test_sigmas_full_matrix_blocks_and_lists_of_blocks_are_equivalent():
    sigma = np.linspace(0.01, 0.03, len(T))
    given = [
        sigma,
        np.diag(sigma**2),
        np.stack([np.diag(pair**2) for pair in sigma.reshape(-1, 2)]),
        [sigma[:10], np.diag(sigma[10:] ** 2)],
    ]
    fits = [adjust(decay_problem(covariance=c)).required() for c in given]
    for fit in fits[1:]:
        np.testing.assert_allclose(fit.values, fits[0].values, atol=1e-10)
        np.testing.assert_allclose(fit.covariance, fits[0].covariance, rtol=1e-8)
        np.testing.assert_allclose(fit.w, fits[0].w, atol=1e-6)
        np.testing.assert_allclose(fit.redundancy_numbers, fits[0].redundancy_numbers, atol=1e-9)


def test_correlated_blocks_are_equivalent_to_the_full_matrix():
    rng = np.random.default_rng(5)
    blocks = np.stack([spd(rng, 3) for _ in range(10)])
    full = np.zeros((30, 30))
    for i, block in enumerate(blocks):
        full[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = block
    a = adjust(decay_problem(covariance=blocks)).required()
    b = adjust(decay_problem(covariance=full)).required()
    np.testing.assert_allclose(a.values, b.values, atol=1e-10)
    np.testing.assert_allclose(a.w, b.w, atol=1e-6)
    np.testing.assert_allclose(a.minimal_detectable_errors(), b.minimal_detectable_errors(), rtol=1e-7)


@given(st.sets(st.sampled_from("abc"), min_size=1))
@settings(max_examples=8)
def test_fixing_parameters_is_equivalent_to_the_smaller_problem(free):
    start = Parameters("abc", TRUE, free=free)
    fit = adjust(decay_problem(parameters=start)).required()
    fixed = [name for name in "abc" if name not in free]
    for name in fixed:
        assert fit[name] == start[name]
        assert fit.sigma_of(name) == 0.0
    assert fit.redundancy == len(T) - len(free)
    a = decay_jacobian(fit.values)[:, start.mask] / 0.01
    np.testing.assert_allclose(
        fit.covariance_of(*sorted(free), scaled=False), np.linalg.inv(a.T @ a), rtol=1e-7
    )


def test_an_unknown_name_is_an_error():
    with pytest.raises(UsageError, match="d: is not among the parameters"):
        Parameters("abc", [0, 0, 0], free=["d"])


def test_a_prior_is_an_observation_of_the_parameter():
    prior = Prior(["c", "a"], [0.6, 1.9], np.array([[0.02**2, 1e-4], [1e-4, 0.03**2]]))
    fit = adjust(decay_problem(parameters=Parameters("abc", [1, 1, 0], prior=prior))).required()
    whole = np.zeros((32, 32))
    whole[:30, :30], whole[30:, 30:] = np.eye(30) * 1e-4, prior.covariance
    extended = GaussMarkov(
        lambda x: np.concatenate([decay(x), x[[2, 0]]]),
        np.concatenate([noisy(), prior.values]),
        whole,
        Parameters("abc", [1.0, 1.0, 0.0]),
    )
    other = adjust(extended).required()
    np.testing.assert_allclose(fit.values, other.values, atol=1e-9)
    np.testing.assert_allclose(fit.cofactor, other.cofactor, rtol=1e-5)
    assert fit.redundancy == other.redundancy
    np.testing.assert_allclose(fit.standardised.w, other.w, atol=1e-5)
    np.testing.assert_allclose(fit.standardised.redundancy_numbers, other.redundancy_numbers, atol=1e-7)
    assert fit.standardised.redundancy_numbers.sum() == pytest.approx(fit.redundancy, abs=1e-8)


def test_the_prior_of_a_fixed_parameter_does_not_count():
    free = Parameters("abc", TRUE, free="ab")
    with_prior = Parameters("abc", TRUE, free="ab", prior_sigma={"c": 0.1})
    a, b = (adjust(decay_problem(parameters=p)).required() for p in (free, with_prior))
    assert a.redundancy == b.redundancy
    assert a.cost == b.cost


def test_an_observation_of_weight_zero_is_equivalent_to_no_observation():
    keep = np.ones(len(T), dtype=bool)
    keep[[4, 5, 20]] = False
    covariance = spd(np.random.default_rng(8), len(T))
    y = noisy()
    spoilt = np.where(keep, y, 1e6)
    fit = adjust(decay_problem(spoilt, covariance, weights=keep.astype(float))).required()
    shorter = GaussMarkov(
        lambda x: decay(x)[keep], y[keep], covariance[np.ix_(keep, keep)], Parameters("abc", [1.0, 1.0, 0.0])
    )
    other = adjust(shorter).required()
    np.testing.assert_allclose(fit.values, other.values, atol=1e-9)
    np.testing.assert_allclose(fit.cofactor, other.cofactor, rtol=1e-5)
    assert fit.redundancy == other.redundancy
    np.testing.assert_allclose(fit.w[keep], other.w, atol=1e-5)
    assert np.isnan(fit.w[~keep]).all()
    np.testing.assert_array_equal(fit.rejected, ~keep)


def test_badly_scaled_parameters_do_not_cause_a_rank_defect():
    unit = np.array([1e12, 1.0, 1e-12])
    scaled = GaussMarkov(
        lambda x: decay(x * unit), noisy(), 0.01, Parameters("abc", np.array([1.0, 1.0, 0.1]) / unit)
    )
    fit, plain = adjust(scaled).required(), adjust(decay_problem()).required()
    np.testing.assert_allclose(fit.values * unit, plain.values, atol=1e-8)
    np.testing.assert_allclose(fit.sigma * unit, plain.sigma, rtol=1e-5)


def test_a_rank_defect_names_the_parameters_of_its_null_space():
    def function(x):
        return decay(np.array([x[0] + 2 * x[3], x[1], x[2]]))

    names = ["a", "b", "c", "shift", "idle"]
    failed = adjust(GaussMarkov(function, noisy(), 0.01, Parameters(names, [1.0, 1.0, 0.0, 0.5, 7.0])))
    assert not failed
    assert isinstance(failed, AdjustmentFailure)
    assert "rank defect 2" in failed.reason
    found = {frozenset(vector) for vector in failed.null_space}
    assert found == {frozenset({"a", "shift"}), frozenset({"idle"})}
    pair = next(vector for vector in failed.null_space if "a" in vector)
    assert pair["a"] / pair["shift"] == pytest.approx(-2.0, abs=1e-6)
    with pytest.raises(EstimationError, match="shift"):
        failed.required()


def test_a_function_that_is_not_finite_at_the_start_is_a_failure_with_the_reason():
    failed = adjust(GaussMarkov(lambda x: np.log(x[0]) * T, noisy(), 0.01, Parameters("a", [-1.0])))
    assert not failed
    assert "approximate values" in failed.reason


def test_too_few_iterations_are_a_failure_not_an_estimate():
    failed = adjust(decay_problem(), Options(max_iterations=1))
    assert not failed
    assert "1 iterations" in failed.reason
    assert len(failed.costs) >= 1


def test_a_problem_without_redundancy_has_a_covariance_a_priori_only():
    fit = adjust(GaussMarkov(lambda x: x * 2.0, [2.0, 6.0], 0.1, Parameters("ab", [0.0, 0.0]))).required()
    np.testing.assert_allclose(fit.values, [1.0, 3.0], atol=1e-12)
    assert fit.redundancy == 0
    assert np.isnan(fit.sigma0)
    assert fit.scale == "a-priori"
    np.testing.assert_allclose(fit.sigma, 0.05, atol=1e-12)
    with pytest.raises(UsageError):
        fit.covariance_of(scaled=True)


def test_scale_chooses_between_the_variance_factors():
    y = decay(TRUE) + np.random.default_rng(3).normal(0, 0.05, len(T))
    posterior = adjust(decay_problem(y)).required()
    prior = adjust(decay_problem(y), Options(scale="a-priori")).required()
    np.testing.assert_allclose(posterior.sigma, prior.sigma * posterior.sigma0, rtol=1e-12)
    np.testing.assert_array_equal(prior.covariance, prior.cofactor)


# --- a levelling net without a datum: heights known but for a constant

PAIRS = list(itertools.combinations(range(4), 2))
HEIGHTS = np.array([10.0, 12.0, 9.0, 15.0])
START = HEIGHTS + np.array([0.1, -0.2, 0.3, 0.2])
ERRORS = np.array([0.01, -0.02, 0.01, 0.0, 0.02, -0.01])
LEVELLED = np.array([HEIGHTS[j] - HEIGHTS[i] for i, j in PAIRS]) + ERRORS


def net(start=START):
    names = ["H1", "H2", "H3", "H4"]
    return GaussMarkov(
        lambda x: np.array([x[j] - x[i] for i, j in PAIRS]),
        LEVELLED,
        0.01,
        Parameters(names, start),
    )


def test_a_net_without_datum_names_all_heights():
    failed = adjust(net())
    assert not failed
    assert set(failed.null_space[0]) == {"H1", "H2", "H3", "H4"}


# --- Gauss–Helmert


def line_conditions(xy, x):
    """Points on y = a + b x, both coordinates observed: (m, 1) conditions."""
    return (x[0] + x[1] * xy[:, 0] - xy[:, 1])[:, None]


def line_jacobians(xy, x):
    m = len(xy)
    a = np.stack([np.ones(m), xy[:, 0]], axis=1)[:, None, :]
    b = np.broadcast_to(np.array([[x[1], -1.0]]), (m, 1, 2))
    return a, b


def line_points(m=40, seed=0, sigma=(0.05, 0.02)):
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 10, m)
    return np.column_stack([t, 1.0 + 0.5 * t]) + rng.normal(size=(m, 2)) * sigma


def test_a_line_with_errors_in_both_coordinates_is_that_of_total_least_squares():
    points = line_points(sigma=(0.05, 0.05))
    problem = GaussHelmert(line_conditions, points, 0.05, Parameters("ab", [0.0, 0.0]), line_jacobians)
    fit = adjust(problem).required()
    centred = points - points.mean(axis=0)
    direction = np.linalg.svd(centred)[2][0]
    slope = direction[1] / direction[0]
    assert fit["b"] == pytest.approx(slope, abs=1e-9)
    assert fit["a"] == pytest.approx(points[:, 1].mean() - slope * points[:, 0].mean(), abs=1e-8)
    smallest = np.linalg.svd(centred, compute_uv=False)[1]
    assert fit.cost == pytest.approx((smallest / 0.05) ** 2, rel=1e-9)
    assert np.abs(line_conditions(fit.adjusted, fit.values)).max() < 1e-10
    assert fit.redundancy == len(points) - 2


def test_standard_deviations_and_blocks_of_marks_are_the_same_covariance():
    points, sigma = line_points(m=12), np.tile([0.05, 0.02], (12, 1))
    blocks = sigma[:, :, None] ** 2 * np.eye(2)
    start = Parameters("ab", [0.0, 0.0])
    a, b = (
        adjust(GaussHelmert(line_conditions, points, cov, start, line_jacobians)).required()
        for cov in (sigma, blocks)
    )
    np.testing.assert_allclose(a.values, b.values, rtol=1e-12)
    np.testing.assert_allclose(a.cofactor, b.cofactor, rtol=1e-12)
    whole = np.diag(sigma.ravel() ** 2)
    with pytest.raises(UsageError, match="one mark into another"):
        adjust(GaussHelmert(line_conditions, points, whole, start, line_jacobians))


def test_gauss_helmert_is_gauss_markov_when_the_conditions_are_observation_equations():
    y = noisy()

    def jacobians(observed, x):
        return decay_jacobian(x)[:, None], -np.ones((len(y), 1, 1))

    start = Parameters("abc", [1.0, 1.0, 0.0])
    helmert = GaussHelmert(lambda obs, x: decay(x)[:, None] - obs, y[:, None], 0.01, start, jacobians)
    a, b = adjust(helmert).required(), adjust(decay_problem(y)).required()
    np.testing.assert_allclose(a.values, b.values, atol=1e-9)
    np.testing.assert_allclose(a.residuals.ravel(), b.residuals, atol=1e-9)
    np.testing.assert_allclose(a.w.ravel(), b.w, atol=1e-5)
    np.testing.assert_allclose(a.redundancy_numbers.ravel(), b.redundancy_numbers, atol=1e-7)
    np.testing.assert_allclose(a.external_lengths().ravel(), b.external_lengths(), rtol=1e-5)


def test_gauss_helmert_redundancy_numbers_sum_to_the_redundancy():
    fit = adjust(
        GaussHelmert(
            line_conditions,
            line_points(),
            [0.05, 0.02] * np.ones((40, 2)),
            Parameters("ab", [0, 0]),
            line_jacobians,
        )
    ).required()
    assert fit.redundancy_numbers.sum() == pytest.approx(fit.redundancy, abs=1e-7)


def test_a_mark_of_weight_zero_is_excluded_with_both_coordinates():
    points = line_points()
    spoilt = points.copy()
    spoilt[7] += 5.0
    weights = np.ones((40, 2))
    weights[7, 0] = 0.0
    sigma = np.array([0.05, 0.02]) * np.ones((40, 2))
    fit = adjust(
        GaussHelmert(
            line_conditions, spoilt, sigma, Parameters("ab", [0, 0]), line_jacobians, weights=weights
        )
    ).required()
    rest = np.delete(points, 7, axis=0)
    other = adjust(
        GaussHelmert(line_conditions, rest, sigma[1:], Parameters("ab", [0, 0]), line_jacobians)
    ).required()
    np.testing.assert_allclose(fit.values, other.values, atol=1e-9)
    np.testing.assert_allclose(fit.cofactor, other.cofactor, rtol=1e-6)
    assert fit.redundancy == other.redundancy


@given(st.sampled_from([1e-9, 1e-4, 1.0, 1e6]), st.sampled_from([0.0, 1.0, -3.0]))
@settings(max_examples=12)
def test_differences_find_the_scale_of_a_parameter_that_is_zero(unit, offset):
    """A parameter in any unit, also if the function is zero at its value."""
    at = np.linspace(1.0, 2.0, 5)
    problem = GaussMarkov(
        lambda x: offset + np.expm1(x[0] / unit * at),
        np.zeros(5),
        0.1,
        Parameters("a", [0.0]),
        jacobian=lambda x: (at / unit * np.exp(x[0] / unit * at))[:, None],
    )
    function, jacobian = problem.function, problem.jacobian(np.zeros(1))
    np.testing.assert_allclose(differences(function, np.zeros(1)), jacobian, rtol=1e-6)


@given(st.integers(1, 5), st.integers(1, 12), st.integers(0, 2**32 - 1))
@settings(max_examples=60)
def test_a_linear_problem_is_solved_as_by_the_pseudoinverse(u, extra, seed):
    rng = np.random.default_rng(seed)
    design = rng.normal(size=(u + extra, u))
    covariance = spd(rng, u + extra)
    y = rng.normal(size=u + extra)
    names = [f"p{i}" for i in range(u)]
    problem = GaussMarkov(lambda x: design @ x, y, covariance, Parameters(names, np.zeros(u)))
    fit = adjust(problem).required()
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    direct = np.linalg.lstsq(root @ design, root @ y, rcond=None)[0]
    # In standard deviations of unit weight.
    assert np.abs((fit.values - direct) / np.sqrt(np.diag(fit.cofactor))).max() < 1e-6
    assert fit.redundancy_numbers.sum() == pytest.approx(extra, abs=1e-6)
    assert np.abs(fit.correlation).max() < 1.0 + 1e-12


@pytest.mark.parametrize("number", [np.longdouble, "decimal"])
def test_extended_precision_observations_give_digits_beyond_double_precision(number):
    """Observations 1 + a t that differ from 1 by a few rounding units of double precision only."""
    decimals = [Decimal(1) + Decimal(i) * Decimal("1e-17") for i in range(10)]
    kind = object if number == "decimal" else np.longdouble
    exact = decimals if number == "decimal" else [np.longdouble(str(d)) for d in decimals]
    t = np.arange(10.0)
    design = np.stack([np.ones(10), t], axis=1)

    def function(x):
        return np.array([x[0] + x[1] * int(i) for i in t], dtype=x.dtype)

    problem = GaussMarkov(
        function, np.array(exact, dtype=kind), None, Parameters("ab", [0, 0]), lambda x: design
    )
    fit = adjust(problem).required()
    if number == "decimal" or np.finfo(np.longdouble).eps < 1e-18:
        assert fit["b"] == pytest.approx(1e-17, rel=0.02)
    assert fit.exact_values.dtype == kind


def test_everything_public_is_exported_and_has_a_docstring():
    import reseau.adjust as adjust_package

    assert sorted(adjust_package.__all__) == adjust_package.__all__
    for name in adjust_package.__all__:
        thing = getattr(adjust_package, name)
        assert name == "Problem" or (thing.__doc__ or "").strip()


@pytest.mark.parametrize(
    ("covariance", "words"),
    [
        (np.ones(29), "shape"),
        (np.zeros(30), "above zero"),
        (np.full(30, np.nan), "finite"),
        (-np.eye(30), "positive definite"),
        (np.triu(np.ones((30, 30))), "symmetric"),
        (np.ones((10, 2, 2)), "20 observations"),
        ([np.ones(10), np.eye(10)], "20 observations"),
        ([[1.0, 2.0], [3.0]], "no array"),
    ],
)
def test_a_covariance_that_does_not_fit_is_an_error(covariance, words):
    with pytest.raises(UsageError, match=words):
        adjust(decay_problem(covariance=covariance))


@pytest.mark.parametrize(
    "misuse",
    [
        lambda: Options(scale="both"),
        lambda: Options(tolerance=0.0),
        lambda: Parameters("ab", [1.0]),
        lambda: Parameters("aa", [1.0, 2.0]),
        lambda: Parameters("ab", [1.0, np.nan]),
        lambda: Parameters("ab", [1.0, 2.0], prior_sigma={"a": 1.0}, prior=Prior("a", [1.0], [1.0])),
        lambda: Prior("ab", [1.0], [1.0, 1.0]),
        lambda: decay_problem(np.full(30, np.nan)),
        lambda: decay_problem(weights=-np.ones(30)),
        lambda: adjust(decay_problem(jacobian=lambda x: np.zeros((3, 3)))),
        lambda: adjust(GaussMarkov(lambda x: x, np.zeros(3), 1.0, Parameters("ab", [0.0, 0.0]))),
        lambda: GaussHelmert(line_conditions, np.zeros(4), 1.0, Parameters("ab", [0.0, 0.0]), line_jacobians),
        lambda: adjust(decay_problem()).required()["d"],
        lambda: adjust(decay_problem(parameters=Parameters("abc", TRUE, "ab"))).required().test_of("c"),
    ],
)
def test_misuse_is_an_error(misuse):
    with pytest.raises(UsageError):
        misuse()


def test_an_adjustment_without_free_parameters_works():
    fit = adjust(decay_problem(parameters=Parameters("abc", TRUE, free=[]))).required()
    assert fit.redundancy == len(T)
    np.testing.assert_allclose(fit.values, TRUE)
    np.testing.assert_allclose(fit.redundancy_numbers, 1.0, atol=1e-12)
