"""Which pixels of a frame can be used for measurement."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.data import Frame
from reseau.core.failure import Failure
from reseau.measure.screening import quiet_noise, screen


def noise(level: float = 120.0, sigma: float = 2.0, shape: tuple[int, int] = (160, 200)) -> np.ndarray:
    grey = np.random.default_rng(0).normal(level, sigma, shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        (np.zeros((40, 50), np.uint8), "is all black"),
        (np.full((40, 50), 255, np.uint8), "is all saturated"),
        (np.full((40, 50), 77, np.uint8), "is all of one grey"),
        (np.where(np.arange(2000).reshape(40, 50) < 1900, 255, 90).astype(np.uint8), "is saturated over 95%"),
        (np.where(np.arange(2000).reshape(40, 50) < 1990, 0, 90).astype(np.uint8), "is black over 100%"),
    ],
)
def test_a_frame_without_an_image_is_refused_by_name_in_one_line(pixels, message):
    found = screen(Frame(pixels, 255.0, "lost.png"), run=15)
    assert isinstance(found, Failure)
    assert str(found).startswith(f"lost.png: {message}")
    assert "\n" not in str(found)


@pytest.mark.parametrize(("sigma", "relative"), [(1.0, 0.2), (3.0, 0.05), (10.0, 0.05)])
def test_the_noise_is_that_of_the_grey_values(sigma, relative):
    expected = np.hypot(sigma, 1 / np.sqrt(12))
    # 32 000 second differences tell it to about one per cent, but their median goes in grey steps.
    assert screen(Frame(noise(sigma=sigma), 255.0), run=15).noise == pytest.approx(expected, rel=relative)


def test_shading_and_a_scene_do_not_count_as_noise():
    pixels = noise(sigma=0.0).astype(float) + np.linspace(0, 80, 200)
    pixels[60:100, 80:120] += 40
    pixels += np.random.default_rng(1).normal(0, 2, pixels.shape)
    assert screen(Frame(pixels, 255.0), run=15).noise == pytest.approx(2.0, rel=0.1)


def test_lost_lines_and_borders_are_excluded():
    pixels = noise()
    pixels[:, :9] = 0
    pixels[40:43, 50:170] = 0
    valid = screen(Frame(pixels, 255.0), run=15).valid
    assert not valid[:, :9].any()
    assert not valid[40:43, 50:170].any()
    assert valid.sum() > 0.999 * (valid.size - 9 * 160 - 3 * 120)


def test_a_black_mark_is_not_a_lost_line():
    pixels = noise()
    pixels[50:56, 70:76] = 0
    pixels[10, 10:199] = 0  # nought is the least grey value elsewhere, too
    assert screen(Frame(pixels, 255.0), run=24).valid[50:56, 70:76].all()


def test_bit_errors_are_excluded_and_marks_are_not():
    pixels = noise()
    pixels[80:84, 90:94] = 30
    pixels[5:155:15, 5:60:9] ^= 64
    valid = screen(Frame(pixels, 255.0), run=16).valid
    assert not valid[5:155:15, 5:60:9].any()
    assert valid[80:84, 90:94].all()
    assert valid[:, 100:].mean() > 0.999


def test_uneven_border_lines_are_levelled_and_marks_in_them_preserved():
    pixels = noise().astype(float)
    pixels[0] *= 1.6
    pixels[-1] *= 0.5
    pixels[:2, 100:104] *= 0.3
    grey = screen(Frame(pixels, 255.0), run=16).grey
    assert np.median(grey[0]) == pytest.approx(120, abs=2)
    assert np.median(grey[-1]) == pytest.approx(120, abs=2)
    assert grey[:2, 100:104].max() < 60
    assert grey[20:-20] == pytest.approx(pixels[20:-20], abs=1e-4)


def test_noise_is_at_least_that_of_rounding() -> None:
    assert quiet_noise(np.full((160, 200), 77, np.float32)) == pytest.approx(1 / np.sqrt(12))
