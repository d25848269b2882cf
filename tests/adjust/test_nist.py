"""The 27 certified problems of NIST, from both starts.

Lanczos1 is the one problem whose standard deviations double precision cannot give: its residuals are 9e-14
of observations up to 2.5, so that rounding alone disturbs them by half a per cent. In decimal arithmetic it
has all digits as the others.
"""

from __future__ import annotations

from decimal import Decimal

import numpy as np
import pytest

from reseau.adjust import Options, adjust
from reseau.adjust.differences import differences

from . import nist

NAMES = nist.names()
STARTS = [(name, start) for name in NAMES for start in (0, 1)]
pytestmark = pytest.mark.skipif(not NAMES, reason=f"no NIST StRD files in {nist.data_directory()}")

DIGITS = 8.0
MEAN_DIGITS = 9.4
BEYOND_DOUBLE = {"Lanczos1"}


@pytest.fixture(scope="module")
def problems():
    return {name: nist.load(name) for name in NAMES}


@pytest.fixture(scope="module")
def fits(problems):
    return {(name, start): adjust(problems[name].problem(start)) for name, start in STARTS}


def test_all_problems_exist_and_have_a_model():
    assert set(NAMES) == set(nist.MODELS)
    assert len(NAMES) == 27


@pytest.mark.parametrize("name", NAMES)
def test_the_files_are_read_completely(problems, name):
    assert len(problems[name].table) == problems[name].stated


@pytest.mark.parametrize("name", NAMES)
def test_the_derivatives_are_those_of_the_model(problems, name):
    problem, at = problems[name].problem(1), np.array(problems[name].certified, dtype=np.float64)
    found, expected = problem.jacobian(at), differences(problem.function, at)
    assert (np.abs(found - expected).max(axis=0) <= 1e-6 * np.abs(expected).max(axis=0)).all()


@pytest.mark.parametrize("name", NAMES)
def test_the_certified_parameters_give_the_certified_residual_sum(problems, name):
    """Checks the models against the files, and the files for consistency."""
    problem = problems[name]
    y, *x = problem.columns(np.longdouble)
    y = np.log(y) if name == "Nelson" else y
    residuals = y - nist.MODELS[name][0](problem.certified.astype(np.longdouble), *x)
    # Lanczos1: 11 digits of the parameters fix its residual sum of 1e-25 no better.
    tolerance = 1e-3 if name in BEYOND_DOUBLE else 1e-8
    assert float(residuals @ residuals) == pytest.approx(problem.residual_sum, rel=tolerance)


def test_a_value_treated_as_a_misprint_contradicts_the_residual_sum_of_its_file(problems):
    for problem in problems.values():
        for printed in problem.misprinted:
            y, *x = problem.columns()
            wrong = problem.certified.copy()
            wrong[0] = printed
            residuals = y - nist.MODELS[problem.name][0](wrong, *x)
            assert residuals @ residuals > 2 * problem.residual_sum


@pytest.mark.parametrize(("name", "start"), STARTS)
def test_parameters_and_sigmas_have_eight_digits(fits, problems, name, start):
    parameters, sigmas = nist.digits_of(fits[name, start].required(), problems[name])
    assert parameters.min() >= DIGITS
    if name not in BEYOND_DOUBLE:
        assert sigmas.min() >= DIGITS


@pytest.mark.parametrize("name", NAMES)
def test_every_problem_has_as_many_digits_as_ceres_has_in_the_mean(fits, problems, name):
    """Ceres documents 9.4 digits of the parameters in the mean over these problems."""
    for start in (0, 1):
        parameters, _ = nist.digits_of(fits[name, start].required(), problems[name])
        assert parameters.min() >= MEAN_DIGITS


@pytest.mark.parametrize("name", NAMES)
def test_the_residual_sum_is_the_certified_one(fits, problems, name):
    for start in (0, 1):
        if name not in BEYOND_DOUBLE:
            found = fits[name, start].required()
            assert found.cost == pytest.approx(problems[name].residual_sum, rel=1e-10)


@pytest.mark.parametrize("start", [0, 1])
@pytest.mark.parametrize("name", sorted(BEYOND_DOUBLE & set(NAMES)))
def test_decimal_arithmetic_gives_the_digits_that_double_precision_lacks(problems, name, start):
    fit = adjust(problems[name].problem(start, Decimal)).required()
    parameters, sigmas = nist.digits_of(fit, problems[name])
    assert parameters.min() >= MEAN_DIGITS
    assert sigmas.min() >= MEAN_DIGITS


@pytest.mark.parametrize("name", sorted(BEYOND_DOUBLE & set(NAMES)))
def test_rounding_to_double_alone_costs_the_sigmas_of_lanczos1_their_digits(problems, name):
    """The residuals at the exact minimum, formed in double precision: no solver in double can do better."""
    problem = problems[name]
    exact = adjust(problem.problem(1, Decimal)).required()
    y, x = problem.columns()
    rounded = nist.MODELS[name][0](exact.values, x) - y
    sigma0 = np.sqrt(rounded @ rounded / exact.redundancy)
    assert abs(sigma0 / exact.sigma0 - 1.0) > 1e-4
    assert exact.sigma0 == pytest.approx(problem.residual_sigma, rel=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_numerical_derivatives_are_nearly_as_accurate_as_analytical_ones(problems, name):
    """From the nearer start, with the function alone."""
    fit = adjust(problems[name].problem(1, analytic=False), Options(rank_tolerance=1e-12)).required()
    parameters, sigmas = nist.digits_of(fit, problems[name])
    assert parameters.min() >= 6.0
    if name not in BEYOND_DOUBLE:
        assert sigmas.min() >= 5.0
