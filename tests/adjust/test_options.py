"""Each option is honoured by every function that accepts it, or refused."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.adjust import (
    GaussMarkov,
    Options,
    Parameters,
    adjust,
    adjust_batch,
    data_snooping,
    eliminate,
    variance_components,
)
from reseau.adjust.batch import BatchOptions
from reseau.adjust.outliers import robust
from reseau.adjust.problem import GaussHelmert
from reseau.core.errors import UsageError
from reseau.core.failure import Code, Failure

T = np.linspace(0.0, 4.0, 30)
NOISY = 2.0 * np.exp(-0.8 * T) + 0.5 + np.random.default_rng(3).normal(0, 0.01, len(T))


def decay(x):
    return x[0] * np.exp(-x[1] * T) + x[2]


def derivatives(x):
    e = np.exp(-x[1] * T)
    return np.stack([e, -x[0] * T * e, np.ones_like(T)], axis=1)


def markov(jacobian=derivatives):
    return GaussMarkov(decay, NOISY, 0.02, Parameters("abc", [1.0, 1.0, 0.0]), jacobian)


def helmert(jacobian=derivatives):
    def both(observed, x):
        return -jacobian(x)[:, None], np.ones((len(T), 1, 1))

    return GaussHelmert(
        lambda observed, x: observed - decay(x)[:, None],
        NOISY[:, None],
        0.02,
        Parameters("abc", [1.0, 1.0, 0.0]),
        both,
    )


def grouped(problem, options):
    half = (np.arange(len(T)) < len(T) // 2).reshape(problem.observations.shape)
    found = variance_components(problem, {"first": half, "second": ~half}, options)
    return found if isinstance(found, Failure) else found.adjustment


def adjusted(found):
    return found if isinstance(found, Failure) else found.adjustment


PATHS = {
    "adjust": adjust,
    "method": lambda problem, options: problem.adjusted(options),
    "robust": lambda problem, options: adjusted(robust(problem, options=options)),
    "snooping": lambda problem, options: adjusted(data_snooping(problem, options=options)),
    "elimination": lambda problem, options: adjusted(eliminate(problem, options=options)),
    "components": grouped,
}
path = pytest.mark.parametrize("run", PATHS.values(), ids=PATHS)
kind = pytest.mark.parametrize("problem", [markov, helmert])


@path
@kind
def test_no_iterations_give_no_result(run, problem):
    found = run(problem(), Options(max_iterations=0))
    assert isinstance(found, Failure)
    assert found.code is Code.NOT_CONVERGED
    assert found.iterations == 0


@path
@kind
def test_the_scale_option_determines_the_covariance(run, problem):
    prior, posterior = (run(problem(), Options(scale=s)) for s in ("a-priori", "a-posteriori"))
    assert (prior.scale, posterior.scale) == ("a-priori", "a-posteriori")
    np.testing.assert_array_equal(prior.values, posterior.values)
    np.testing.assert_array_equal(prior.covariance, prior.cofactor)
    np.testing.assert_allclose(posterior.covariance, posterior.cofactor * posterior.sigma0**2, rtol=1e-12)


@path
@kind
def test_the_rank_tolerance_determines_a_rank_defect(run, problem):
    found = run(problem(), Options(rank_tolerance=0.5))
    assert isinstance(found, Failure)
    assert found.code is Code.RANK_DEFECT


@pytest.mark.parametrize("problem", [markov, helmert])
def test_tolerance_and_damping_change_the_iterations(problem):
    usual = adjust(problem()).required()
    assert adjust(problem(), Options(tolerance=0.1)).required().iterations < usual.iterations
    assert adjust(problem(), Options(damping=1e3)).required().iterations > usual.iterations


def test_an_option_without_effect_is_refused():
    for call in (
        lambda: Options(damping=0.0),
        lambda: Options(rank_tolerance=-1.0),
        lambda: Options(max_iterations=-1),
        lambda: robust(markov(), max_iterations=0),
        lambda: BatchOptions(share=0.0),
        lambda: BatchOptions(max_iterations=-1),
        lambda: BatchOptions(tolerance=1e-3, share=1e-2),
    ):
        with pytest.raises(UsageError):
            call()


def test_options_of_a_batch_change_its_iterations():
    def function(x, rows):
        return np.stack([decay(p) for p in x]), np.stack([derivatives(p) for p in x])

    def run(**options):
        return adjust_batch(function, [[1.0, 1.0, 0.0]], [NOISY], options=BatchOptions(**options))

    usual = run()
    assert usual.converged.all()
    none = run(max_iterations=0)
    assert not none.converged.any()
    assert none.iterations.tolist() == [0]
    assert run(tolerance=0.5).iterations < usual.iterations
    assert run(share=0.5).iterations < usual.iterations
    assert run(damping=1e3).iterations > usual.iterations
    weighted = run(reweight=lambda t: np.where(np.abs(t) > 2.0, 0.0, 1.0))
    assert (weighted.factors == 0).any()
