"""The field through measured points: its predictions, its test, and the effect of the local model."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.optics.field import SmoothField, trend_degree


def grid(side: int, pitch: float = 1.0) -> np.ndarray:
    return pitch * np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2).astype(
        float
    )


def bent(xy: np.ndarray) -> np.ndarray:
    """A deformation that no low-degree polynomial follows: points around a small disc pushed outwards."""
    from_centre = xy - 4.3
    return 50 * xy + 1.5 * from_centre * np.exp(-0.5 * (from_centre**2).sum(axis=1, keepdims=True) / 1.2**2)


def noisy(xy: np.ndarray, sigma: float, seed: int = 0) -> np.ndarray:
    return bent(xy) + np.random.default_rng(seed).normal(0, sigma, xy.shape)


def matern(distance: np.ndarray, length: float) -> np.ndarray:
    z = np.sqrt(5) * distance / length
    return (1 + z + z**2 / 3) * np.exp(-z)


def test_leave_one_out_of_a_polynomial_equals_refits_without_each_point():
    source, sigma = grid(6), np.random.default_rng(1).uniform(0.5, 2.0, 36)
    target = noisy(source, 0.1)
    whole, _ = SmoothField.fit(source, target, sigma=sigma, degree=3, local=False).leave_one_out()
    for i in range(36):
        rest = np.arange(36) != i
        field = SmoothField.fit(source[rest], target[rest], sigma=sigma[rest], degree=3, local=False)
        predicted = field(source[i : i + 1])[0]
        assert whole[i] == pytest.approx(target[i] - predicted, abs=1e-8)


def test_leave_one_out_of_collocation_equals_kriging_without_each_point():
    source = grid(7)
    target = noisy(source, 0.05)
    field = SmoothField.fit(source, target, degree=1)
    deviation, sigma = field.leave_one_out()
    assert field.ratio.min() > 0
    distance = np.hypot(*(source[:, None] - source[None]).transpose(2, 0, 1))
    trend = np.column_stack([np.ones(49), source])
    for axis in range(2):
        kernel = field.ratio[axis] * matern(distance, field.length)
        for i in (0, 6, 24, 31):
            rest = np.arange(49) != i
            inverse = np.linalg.inv(kernel[np.ix_(rest, rest)] + np.eye(48))
            a = trend[rest]
            normal = np.linalg.inv(a.T @ inverse @ a)
            beta = normal @ a.T @ inverse @ target[rest, axis]
            k = kernel[i, rest]
            predicted = trend[i] @ beta + k @ inverse @ (target[rest, axis] - a @ beta)
            short = trend[i] - k @ inverse @ a
            variance = kernel[i, i] + 1 - k @ inverse @ k + short @ normal @ short
            assert deviation[i, axis] == pytest.approx(target[i, axis] - predicted, abs=1e-7)
            assert sigma[i, axis] == pytest.approx(field.noise[axis] * np.sqrt(variance), rel=1e-6)


def test_leave_one_out_deviations_agree_with_their_sigmas():
    normalised = []
    for seed in range(8):
        source = np.random.default_rng(seed).uniform(0, 8, (120, 2))
        deviation, sigma = SmoothField.fit(source, noisy(source, 0.05, seed)).leave_one_out()
        normalised.append(deviation / sigma)
    # 1920 deviations, correlated with their neighbours': four standard errors of a standard deviation.
    assert np.std(normalised) == pytest.approx(1.0, abs=0.12)


def test_white_noise_rarely_requires_a_local_model():
    source = grid(7)
    need = np.concatenate(
        [
            SmoothField.fit(source, rng.normal(0, 1, source.shape), degree=1, trials=99, seed=k).need
            for k, rng in enumerate(np.random.default_rng(3).spawn(60))
        ]
    )
    # 120 probabilities, uniform if the level is exact: 12 ± 3.3 below a tenth, 60 ± 5.5 below half.
    assert 2 <= (need <= 0.1).sum() <= 24
    assert (need <= 0.5).mean() == pytest.approx(0.5, abs=0.2)


def test_a_bent_field_requires_a_local_model_which_predicts_it_better():
    source = grid(10)
    target = noisy(source, 0.02)
    field = SmoothField.fit(source, target, trials=99)
    between = grid(9) + 0.5
    assert field.need.max() <= 0.02
    off = np.abs(field(between) - bent(between)).max()
    polynomial = SmoothField.fit(source, target, degree=5, local=False)
    assert off < 0.35 * np.abs(polynomial(between) - bent(between)).max()


def test_a_field_without_signal_is_its_polynomial():
    source = grid(8)
    target = source @ np.array([[50.0, 1.0], [-1.0, 50.0]]) + 7
    field = SmoothField.fit(source, target, degree=2)
    assert field(source + 0.3) == pytest.approx((source + 0.3) @ [[50.0, 1.0], [-1.0, 50.0]] + 7, abs=1e-7)
    assert field.jacobian(source[:3]) == pytest.approx(
        np.tile([[50.0, -1.0], [1.0, 50.0]], (3, 1, 1)), abs=1e-5
    )


def test_a_given_correlation_length_is_kept():
    source = grid(8)
    assert SmoothField.fit(source, noisy(source, 0.02), length=2.5).length == pytest.approx(2.5)


def test_the_derivatives_include_the_signal():
    source = grid(10)
    field = SmoothField.fit(source, noisy(source, 0.01))
    at, step = np.array([[4.1, 5.2], [3.0, 6.6]]), 1e-3
    numeric = np.stack([(field(at + d) - field(at - d)) / (2 * step) for d in step * np.eye(2)], axis=2)
    assert field.jacobian(at) == pytest.approx(numeric, abs=1e-3)


def test_points_of_low_weight_have_little_effect():
    source, sigma = grid(6), np.ones(36)
    target = 50 * source
    target[14] += 3.0
    sigma[14] = 100.0
    pulled = SmoothField.fit(source, target, degree=1, local=False)(source)
    spared = SmoothField.fit(source, target, sigma=sigma, degree=1, local=False)(source)
    assert np.abs(pulled - 50 * source).max() > 0.05
    assert np.abs(spared - 50 * source).max() < 1e-4


def test_too_few_points_for_a_trend_are_refused_in_one_line():
    with pytest.raises(UsageError, match="7 points are too few for a trend of degree 2") as raised:
        SmoothField.fit(grid(3)[:7], grid(3)[:7], degree=2)
    assert "\n" not in str(raised.value)


def test_the_degree_of_a_trend_grows_with_the_number_of_points():
    degrees = [trend_degree(n) for n in range(3, 300)]
    assert degrees == sorted(degrees)
    assert all((d + 1) * (d + 2) // 2 + 2 <= n for n, d in zip(range(3, 300), degrees, strict=True))
