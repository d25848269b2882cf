"""Robust adjustment of linear problems, compared with the general one."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.adjust import BatchOptions, adjust_batch, weight_function
from reseau.adjust.reweighted import reweighted


@pytest.mark.parametrize("most", [1, 5, 30])
@pytest.mark.parametrize("outliers", [0, 6])
def test_estimates_and_residuals_are_those_of_the_general_adjustment(outliers, most):
    rng = np.random.default_rng(3)
    t = np.linspace(-1, 1, 40)
    design = np.stack([t**0, t, t**2, t**3], axis=1)
    observed = rng.normal(0, 3, (2, 4)) @ design.T + rng.normal(0, 0.1, (2, 40))
    observed[:, :outliers] += 4.0
    prior, tolerance = 1e-4, 1e-3
    estimates, residuals = reweighted(design, observed, prior, tolerance, most)
    general = adjust_batch(
        lambda x, rows: (x @ design.T, np.broadcast_to(design, (len(rows), *design.shape))),
        np.zeros((2, 4)),
        observed,
        prior=(np.zeros((2, 4)), np.full(4, prior**-0.5)),
        options=BatchOptions(reweight=weight_function("tukey"), max_iterations=most, tolerance=tolerance),
    )
    np.testing.assert_allclose(estimates, general.estimates, rtol=0, atol=1e-9)
    np.testing.assert_allclose(residuals, general.residuals, rtol=0, atol=1e-9)


def test_a_problem_without_misfit_is_solved_exactly():
    design = np.stack([np.ones(5), np.arange(5.0)], axis=1)
    estimates, _ = reweighted(design, np.array([[1.0, 3, 5, 7, 9], [0, 0, 0, 0, 0]]), 1e-12, 1e-9, 20)
    np.testing.assert_allclose(estimates, [[1, 2], [0, 0]], rtol=0, atol=1e-8)
