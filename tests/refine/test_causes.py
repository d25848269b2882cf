"""The physical causes of group B against coefficients made of known ones."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.optics.displays import wong_display
from reseau.refine import CAUSES, COEFFICIENTS, CONDITIONS, physical_causes

_TRUE = dict(zip(CAUSES, np.linspace(-0.02, 0.03, len(CAUSES)), strict=True))


def _coefficients(causes: dict[str, float]) -> np.ndarray:
    """The paper's equations between (6) and (7), typed from its list."""
    c = causes
    a = [
        c["P0"], 1 + c["k0"] + c["m1"], c["m2"] - c["P3"], c["P1"], c["P2"] - c["h'1"], -c["h'1"], c["k1"],
        -c["h'2"]
    ]  # fmt: skip
    b = [c["P4"], 1 + c["k0"], c["P3"], c["P2"], c["P1"] + c["h'3"], c["h'3"], c["k1"], c["h'4"]]
    return np.array(a + b)


def _covariance(seed: int) -> np.ndarray:
    spread = np.random.default_rng(seed).normal(size=(16, 16))
    return (spread @ spread.T + np.eye(16)) * 1e-8


def test_causes_are_recovered_from_their_coefficients():
    found = physical_causes(COEFFICIENTS, _coefficients(_TRUE), _covariance(0))
    assert found.adjustment.redundancy == 3
    np.testing.assert_allclose(found.adjustment.values, list(_TRUE.values()), atol=1e-12)
    assert [test.condition for test in found.conditions] == list(CONDITIONS)
    assert all(test.holds and abs(test.misclosure) < 1e-14 for test in found.conditions)


def test_coefficients_of_the_causes_map_points_as_wongs_display_does():
    from reseau.optics import RationalPolynomial

    values = dict(zip(COEFFICIENTS, _coefficients(_TRUE), strict=True))
    xy = np.random.default_rng(1).uniform(-1, 1, (50, 2))
    display = wong_display().with_values({name: _TRUE[name] for name in CAUSES})
    np.testing.assert_allclose(
        RationalPolynomial.ultrasonic().with_values(values)(xy), display(xy), atol=1e-13
    )


def test_the_order_of_the_coefficients_does_not_matter():
    values, covariance = _coefficients(_TRUE), _covariance(2)
    order = np.random.default_rng(3).permutation(16)
    noisy = values + np.linalg.cholesky(covariance) @ np.random.default_rng(4).normal(size=16)
    one = physical_causes(COEFFICIENTS, noisy, covariance)
    other = physical_causes([COEFFICIENTS[i] for i in order], noisy[order], covariance[np.ix_(order, order)])
    np.testing.assert_allclose(other.adjustment.values, one.adjustment.values, atol=1e-12)


def test_predicted_sigmas_of_causes_cover_and_condition_tests_keep_their_level():
    values, covariance = _coefficients(_TRUE), _covariance(5)
    root, rng, trials = np.linalg.cholesky(covariance), np.random.default_rng(6), 400
    normalised, kept = [], []
    for _ in range(trials):
        found = physical_causes(COEFFICIENTS, values + root @ rng.normal(size=16), covariance)
        sigma = np.sqrt(np.diagonal(found.adjustment.cofactor))
        normalised.append((found.adjustment.values - list(_TRUE.values())) / sigma)
        kept.append([test.holds for test in found.conditions])
    rms = np.sqrt(np.mean(np.square(normalised), axis=0))
    assert np.abs(rms - 1).max() < 4 / np.sqrt(2 * trials)  # four standard deviations of an rms
    assert np.abs(np.mean(kept, axis=0) - 0.95).max() < 4 * np.sqrt(0.05 * 0.95 / trials)


def test_the_contradicted_condition_is_the_one_reported():
    values = _coefficients(_TRUE)
    values[COEFFICIENTS.index("A6")] += 0.01
    found = physical_causes(COEFFICIENTS, values, np.eye(16) * 1e-8)
    assert [test.condition for test in found.conditions if not test.holds] == ["A6 = B6"]
    assert not found.adjustment.global_test().passed


def test_a_dropped_coefficient_is_refused_by_name():
    with pytest.raises(UsageError, match="A2"):
        physical_causes(COEFFICIENTS[:2] + COEFFICIENTS[3:], np.zeros(15), np.eye(15))
