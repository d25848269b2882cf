"""Pins on a screen behind a reseau: flanks that wires hide, lines of the raster, light that falls off."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.special import ndtr

from reseau.core.data import Array, Mask
from reseau.measure import find_pins
from reseau.measure.pins.screenlight import blur_of_wires, falloff

from .test_pins import NOISE, arcs, frame, nearest, picture

_SIZE = (600, 800)
_AT = np.stack(np.meshgrid(np.arange(100.0, 720, 150), np.arange(70.0, 560, 90)), axis=-1).reshape(-1, 2)
_LINES_PX = 3.6


def _reseau(rows: Array, half: int = 4) -> Mask:
    """Wires along rows, and upright ones at the edges."""
    hidden = np.zeros(_SIZE, dtype=bool)
    for row in rows:
        hidden[round(row) - half : round(row) + half + 1] = True
    hidden[:, [2, 3, -4, -3]] = True
    return hidden


def _glowing(lines: float = 0.0, fall: float = 0.0, seed: int = 0) -> tuple[Array, Array]:
    """Echoes on a raster with a glow of 45: their positions, and the picture."""
    rng = np.random.default_rng(seed)
    truth = _AT + rng.uniform(-4, 4, _AT.shape)
    light = picture(truth, arcs(len(truth), 18.0, 3.6, 0.004), _SIZE, 120.0, noise=0.0) + 37.0
    row, column = np.indices(_SIZE)
    light *= 1 + lines * np.cos(2 * np.pi * row / _LINES_PX)
    light *= 1 - fall * ((column - 400) / 400) ** 2
    return truth, light + NOISE * rng.standard_normal(_SIZE)


@pytest.mark.slow
def test_with_one_flank_hidden_the_sigma_includes_the_raster_lines():
    normalised, unveiled = [], []
    for seed in range(3):
        truth, pixels = _glowing(lines=0.015, seed=seed)
        hidden = _reseau(np.arange(63.0, 560, 90))
        pixels[hidden] *= 0.1
        points = find_pins(frame(pixels), hidden=hidden).points
        rows = nearest(points.xy, truth)
        found = np.hypot(*(points.xy[rows] - truth).T) < 3
        at, error = rows[found], (points.xy[rows] - truth)[found]
        veiled = np.abs(np.round((truth[found, 1] - 63) / 90) * 90 + 63 - truth[found, 1]) < 8
        normalised.append((error / points.sigma[at])[veiled, 1])
        unveiled.append(points.sigma[at][~veiled, 1])
    veiled_errors = np.concatenate(normalised)
    assert len(veiled_errors) >= 20
    assert np.sqrt(np.mean(veiled_errors**2)) < 1.6
    # What is seen whole is as sure as before.
    assert np.median(np.concatenate(unveiled)) < 0.05


@pytest.mark.slow
def test_light_falloff_known_from_the_raster_does_not_shift_echoes():
    truth, pixels = _glowing(fall=0.3)
    hidden = _reseau(np.array([5.0, 595.0]))
    sides = np.sign(truth[:, 0] - 400)
    outward = []
    for known in (None, hidden):
        points = find_pins(frame(pixels), hidden=known).points
        off = (points.xy[nearest(points.xy, truth)] - truth)[:, 0]
        outward.append(float(np.mean(sides * off)))
    assert outward[0] < -0.15
    assert abs(outward[1]) < 0.04


@pytest.mark.parametrize("glow", [0.0, 6 * NOISE, 45.0])
def test_without_a_lit_raster_no_light_falloff_is_estimated(glow: float):
    ground = np.full(_SIZE, glow, dtype=np.float32)
    ground += np.linspace(0, 0.2 * glow, _SIZE[1], dtype=np.float32)
    found = falloff(ground, _reseau(np.array([5.0, 595.0])), NOISE)
    assert falloff(ground, np.zeros(_SIZE, dtype=bool), NOISE) is None
    if not glow:
        assert found is None
    else:
        assert found is not None
        np.testing.assert_allclose(found, ground / ground[300, 400], atol=2e-3)


@pytest.mark.parametrize(("blur", "noise", "slope"), [(0.9, 2.0, 0.1), (1.2, 4.0, -0.05)])
def test_the_blur_of_the_camera_follows_from_the_wires(blur, noise, slope):
    row, column = np.indices((300, 400)).astype(np.float64)
    pixels, hidden = np.full(row.shape, 70.0), np.zeros(row.shape, dtype=bool)
    width, half = np.hypot(blur, np.sqrt(1 / 12)), 2.3 * np.hypot(1, slope)
    for first, upright in itertools.product(range(40, 400, 90), (True, False)):
        across, along = (column, row) if upright else (row, -column)
        off = (across - first - slope * along) / np.hypot(1, slope)
        pixels -= 48 * (ndtr((off + half) / width) - ndtr((off - half) / width))
        hidden |= np.abs(off) < half + 2.6 * width
    pixels += np.random.default_rng(0).normal(0, noise, row.shape)
    found = blur_of_wires(pixels.astype(np.float32), hidden, noise)
    assert found is not None
    assert abs(found[0] - width) < 0.03
