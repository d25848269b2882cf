"""The normal distribution in single precision, beside that in double."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from reseau.optics.formation import Outline, coverage
from reseau.optics.normal import normal_single


def test_distribution_and_density_are_good_to_three_in_ten_million() -> None:
    z = np.linspace(-9, 9, 4001)
    step, bell = normal_single(z.astype(np.float32))
    assert step.dtype == bell.dtype == np.float32
    np.testing.assert_allclose(step, ndtr(z), rtol=0, atol=3e-7)
    np.testing.assert_allclose(bell, np.exp(-z * z / 2) / np.sqrt(2 * np.pi), rtol=0, atol=3e-7)


def test_an_image_in_single_precision_is_that_in_double() -> None:
    disk = Outline.circle(3.0, 0.5)
    pixels = np.arange(-8.0, 9.0)
    single = Outline(disk.xy.astype(np.float32), disk.dxy.astype(np.float32))
    found = coverage(single, pixels.astype(np.float32), pixels.astype(np.float32), 0.7)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, coverage(disk, pixels, pixels, 0.7), rtol=0, atol=5e-6)
