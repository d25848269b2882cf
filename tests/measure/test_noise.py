"""Noise of grey values as a function of their size."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.measure.matching.noise import grey_variance, medians, relative_weights

A, B = 1.5, 0.08
STARTS = np.stack(np.meshgrid(np.arange(20, 380, 30), np.arange(20, 280, 30)), axis=-1).reshape(-1, 2) + 0.3


def windows(a: float, b: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A frame with a dark mark in each window, and residuals of an adjustment."""
    y, x = np.mgrid[:300, :400]
    at = np.rint(STARTS)
    distance = np.min([np.hypot(x - cx, y - cy) for cx, cy in at], axis=0)
    light = np.where(distance < 3.5, 30.0, 150.0)
    pixels = light + np.random.default_rng(seed).normal(0, np.sqrt(a + b * light))
    rows, columns = (at[:, k].astype(int)[:, None] + np.arange(-6, 7) for k in (1, 0))
    index = rows[:, :, None], columns[:, None, :]
    return pixels, light[index] - pixels[index]


def test_read_noise_and_photon_noise_are_separated():
    pixels, residuals = windows(A, B)
    a, b = grey_variance(pixels, STARTS, residuals)
    # 18 000 residuals, a fifth of them dark: the variances at both levels to two or three per cent.
    assert a + 30 * b == pytest.approx(A + 30 * B, rel=0.08)
    assert a + 150 * b == pytest.approx(A + 150 * B, rel=0.04)


@pytest.mark.parametrize("b", [0.0, -0.02])
def test_noise_that_does_not_grow_with_light_is_modelled_as_constant(b):
    assert grey_variance(*_with_starts(4.0, b)) is None


def _with_starts(a, b):
    pixels, residuals = windows(a, b)
    return pixels, STARTS, residuals


def test_excluded_pixels_are_not_used():
    pixels, residuals = windows(A, B)
    residuals[:, 0] = np.nan
    residuals[3] = np.nan
    spoilt = residuals.copy()
    pixels_spoilt = pixels.copy()
    column, row = np.rint(STARTS[3]).astype(int)
    pixels_spoilt[row - 6 : row + 7, column - 6 : column + 7] = 1e4
    assert grey_variance(pixels_spoilt, STARTS, spoilt) == pytest.approx(
        grey_variance(pixels, STARTS, residuals)
    )


def test_few_residuals_are_enough_where_their_noise_grows_visibly():
    pixels, residuals = windows(A, B)
    assert grey_variance(pixels, STARTS[:2], residuals[:2])[1] == pytest.approx(B, rel=0.5)
    even, residuals = windows(A, 0.0)
    assert grey_variance(even, STARTS[:2], residuals[:2]) is None


def test_weights_are_inverse_to_the_variances_of_a_patch_and_bounded():
    grey = np.array([[50.0, 100.0, 150.0], [0.0, 0.0, 1e6]])
    weights = relative_weights(grey, (A, B))
    assert weights[0] * (A + B * grey[0]) == pytest.approx(np.full(3, A + B * 100))
    assert weights.max() <= 20
    assert weights.min() > 0


def test_medians_use_only_the_used_values():
    values = np.array(
        [[3.0, 1.0, 2.0, 9.0], [4.0, np.nan, 1.0, 7.0], [1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]]
    )
    used = np.array([[1, 1, 1, 0], [1, 1, 1, 0], [1, 1, 1, 1], [0, 0, 0, 0]], dtype=bool)
    np.testing.assert_array_equal(medians(values, used)[:, 0], [2.0, 2.5, 2.5, 0.0])
