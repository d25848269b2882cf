"""Two models of the same points: the one that is true predicts better."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.data import ImagePoints
from reseau.core.failure import Failure
from reseau.measure.fitting import fit_mapping
from reseau.optics import RationalPolynomial
from reseau.optics.displays import wong_display
from reseau.refine import leave_one_out, rivals

_SIGMA = 0.05


def _points(model, seed: int, n: int = 60) -> tuple[ImagePoints, np.ndarray]:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-60, 60, (n, 2))
    noisy = xy + rng.normal(0, _SIGMA, xy.shape)
    return ImagePoints.with_sigma([f"p{i}" for i in range(n)], noisy, _SIGMA), model(xy)


def test_leave_one_out_equals_the_prediction_of_a_fit_without_the_point():
    points, target = _points(RationalPolynomial.ultrasonic(), 0, n=20)
    fit = fit_mapping(RationalPolynomial.ultrasonic(), points, target).required()
    model = RationalPolynomial.ultrasonic().with_values(fit.values)
    error, _ = leave_one_out(model, fit, points, target)
    for i in (0, 7, 19):
        others = np.arange(20) != i
        without = fit_mapping(
            RationalPolynomial.ultrasonic(), points.select(others), target[others]
        ).required()
        predicted = RationalPolynomial.ultrasonic().with_values(without.values)(points.xy[[i]])[0]
        # The weights follow the slope of the model, which hardly changes with one point.
        np.testing.assert_allclose(error[i], predicted - target[i], atol=2e-3)


def test_wongs_display_is_preferred_if_it_is_the_true_model():
    true = wong_display().with_values({"k1": 2e-6, "k2": 8e-10, "k3": -2e-13, "m1": 0.01})
    points, target = _points(true, 1)
    found = rivals(RationalPolynomial.ultrasonic(), wong_display(), points, target)
    assert found.verdict == "second"
    assert (found.rms[1] < found.rms[0]).all()


def test_the_polynomials_are_preferred_if_they_are_the_true_model():
    true = RationalPolynomial.ultrasonic().with_values({"A4": 3e-4, "A5": -2e-4, "B6": 3e-6, "A6": -1e-6})
    points, target = _points(true, 2)
    assert rivals(RationalPolynomial.ultrasonic(), wong_display(), points, target).verdict == "first"


@pytest.mark.slow
def test_if_both_are_true_neither_is_preferred_more_often_than_the_level():
    true = wong_display().with_values({"k1": 1e-6, "P2": 1e-5, "P3": 0.005})
    verdicts = [
        rivals(RationalPolynomial.ultrasonic(), wong_display(), *_points(true, 10 + s)).verdict
        for s in range(60)
    ]
    # At level 0.05 more than 10 of 60 have a probability of 3e-4.
    assert sum(verdict != "undecided" for verdict in verdicts) <= 10


def test_too_few_points_are_a_failure():
    points, target = _points(RationalPolynomial.ultrasonic(), 3, n=8)
    assert isinstance(rivals(RationalPolynomial.ultrasonic(), wong_display(), points, target), Failure)
