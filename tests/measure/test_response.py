"""What a camera has made of the light: a kernel is found where there is one, and none in noise."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.data import Array
from reseau.measure.matching.shapes import GrownOutline, Window
from reseau.measure.response import FilteredShape, Samples, estimate_kernel
from reseau.optics.formation import Outline, PixelResponse

DISK = Outline.circle(3.0, 0.5)
SMEARED = np.array([[0, 0, 0], [0.25, 0.5, 0.25], [0, 0, 0]])


def gains(kernel: Array | None, sigma: float, half: int, count: int = 4) -> list[float]:
    """Gains with some disks in windows of 2 half + 1 pixels, with noise of that sigma and contrast 150."""
    one = np.arange(count)
    outline = Outline(np.tile(DISK.xy, (count, 1, 1)), np.tile(DISK.dxy, (count, 1, 1)))
    plain = GrownOutline(outline, np.zeros((0, 2, 2)))
    shape = plain if kernel is None else FilteredShape(plain, kernel)
    axis = np.tile(np.arange(-half, half + 1.0), (count, 1))
    window, found = Window(axis, axis, PixelResponse()), []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        xy = rng.uniform(-0.5, 0.5, (count, 2))
        images = shape.image(xy, np.full(count, 0.7), np.zeros((count, 0)), one, window)
        grey = 200 - 150 * images + rng.normal(0, sigma, images.shape)
        depth = np.full(count, -150.0)
        marks = Samples(
            plain, xy, np.full(count, 0.7), np.zeros((count, 0)), depth, window, grey, grey > -1e9
        )
        found.append(estimate_kernel(marks)[2])
    return found


@pytest.mark.parametrize("half", [4, 6, 10])
def test_noise_in_few_pixels_is_no_kernel(half: int) -> None:
    """Sixty values of a kernel leave much less of 81 pixels of four marks than their noise."""
    found = gains(None, 3.0, half)
    assert min(found) > 0.85
    assert abs(np.mean(found) - 1) < 0.07


@pytest.mark.parametrize("half", [4, 6, 10])
def test_a_smear_is_seen_in_windows_of_any_size(half: int) -> None:
    assert max(gains(SMEARED, 1.0, half)) < 0.5
