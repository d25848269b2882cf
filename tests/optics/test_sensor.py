"""Sensors: their noise as predicted, their grey values as specified."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.optics import Sensor, illumination, snr_db
from reseau.optics.sensor import sigma_of_snr

SIZE = 300  # 90 000 pixels: a variance is known to 0.5 %, a mean to σ/300


def exposed(sensor: Sensor, level: float) -> tuple[float, float, float]:
    """Mean and variance of a flat exposure, and the predicted variance."""
    flat = np.full((SIZE, SIZE), level)
    pixels = sensor.expose(flat, np.random.default_rng(12)).astype(float)
    return float(pixels.mean()), float(pixels.var()), float(sensor.variance(flat)[0, 0])


@pytest.mark.parametrize("level", [20.0, 77.3, 180.0])
@pytest.mark.parametrize(
    "sensor",
    [
        Sensor(SIZE, SIZE, gain=40.0, read_noise=1.0),
        Sensor(SIZE, SIZE, gain=5.0),
        Sensor(SIZE, SIZE, shot_noise=False, read_noise=1.8, offset=4.0),
        Sensor(SIZE, SIZE, gain=2.0, quantise=False),
        Sensor(SIZE, SIZE, bits=12, gain=8.0, read_noise=2.0, offset=16.0),
    ],
    ids=["shot-and-read", "shot", "read-and-offset", "not-quantised", "12-bit"],
)
def test_exposures_have_the_predicted_mean_and_variance(sensor: Sensor, level: float) -> None:
    mean, variance, predicted = exposed(sensor, level)
    n = SIZE**2
    assert abs(mean - level - sensor.offset) < 4 * (predicted / n) ** 0.5
    assert abs(variance / predicted - 1) < 4 * (2 / n) ** 0.5


def test_quantisation_adds_a_twelfth() -> None:
    kwargs = {"shot_noise": False, "read_noise": 0.8}
    coarse, fine = Sensor(SIZE, SIZE, **kwargs), Sensor(SIZE, SIZE, quantise=False, **kwargs)
    flat = np.full((SIZE, SIZE), 100.25)
    np.testing.assert_allclose(coarse.variance(flat) - fine.variance(flat), 1 / 12, rtol=1e-14)
    _, variance, _ = exposed(coarse, 100.25)
    assert abs(variance - 0.8**2 - 1 / 12) < 4 * (0.8**2 + 1 / 12) * (2 / SIZE**2) ** 0.5


def test_a_sensor_without_noise_rounds_and_saturates() -> None:
    sensor = Sensor(4, 2, shot_noise=False)
    pixels = sensor.expose([[0.4, 0.6, 254.6, 900.0], [1.5, 2.5, 100.0, 0.0]], np.random.default_rng(0))
    np.testing.assert_array_equal(pixels, np.array([[0, 1, 255, 255], [2, 2, 100, 0]], dtype=np.uint8))
    assert pixels.dtype == np.uint8
    deep = Sensor(2, 2, bits=16, shot_noise=False)
    assert deep.expose(np.full((2, 2), 1e5), np.random.default_rng(0)).tolist() == 2 * [2 * [65535]]
    assert deep.dtype == np.uint16
    assert Sensor(2, 2, quantise=False).dtype == np.float64


def test_dark_noise_is_clipped_at_black_unless_there_is_an_offset() -> None:
    dark = np.zeros((SIZE, SIZE))
    clipped = Sensor(SIZE, SIZE, read_noise=2.0).expose(dark, np.random.default_rng(1))
    raised = Sensor(SIZE, SIZE, read_noise=2.0, offset=12.0).expose(dark, np.random.default_rng(1))
    assert clipped.min() == 0
    assert raised.std() == pytest.approx((2.0**2 + 1 / 12) ** 0.5, rel=0.01)


def test_the_same_generator_state_gives_the_same_image() -> None:
    sensor = Sensor(40, 30, read_noise=1.0)
    flat = np.full((30, 40), 100.0)
    first, second = (sensor.expose(flat, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_exposing_does_not_change_the_light() -> None:
    flat = np.full((30, 40), 100.0)
    Sensor(40, 30, shot_noise=False, read_noise=1.0, offset=3.0).expose(flat, np.random.default_rng(5))
    np.testing.assert_array_equal(flat, 100.0)


def test_rows_jitter_as_specified() -> None:
    shifts = Sensor(10, 20000, row_jitter_px=0.05).row_shifts(np.random.default_rng(3))
    assert shifts.shape == (20000,)
    assert shifts.std() == pytest.approx(0.05, rel=0.02)
    assert abs(shifts.mean()) < 4 * 0.05 / 20000**0.5
    assert not Sensor(10, 20).row_shifts(np.random.default_rng(3)).any()


def test_decibels_are_of_255_over_sigma() -> None:
    assert snr_db(255.0) == 0.0
    assert snr_db(2.55) == pytest.approx(40.0)
    assert sigma_of_snr(46.0) == pytest.approx(1.278, abs=5e-4)
    assert snr_db(sigma_of_snr(33.3)) == pytest.approx(33.3)


def test_impossible_sensors_and_light_are_refused() -> None:
    for wrong in ({"bits": 17}, {"gain": 0.0}, {"read_noise": -1.0}, {"width": 1}, {"offset": float("nan")}):
        with pytest.raises(UsageError):
            Sensor(**({"width": 4, "height": 4} | wrong))  # type: ignore[arg-type]
    sensor, rng = Sensor(4, 4), np.random.default_rng(0)
    for light in (np.zeros((4, 5)), np.full((4, 4), -1.0), np.full((4, 4), np.nan), np.full((4, 4), np.inf)):
        with pytest.raises(UsageError, match="irradiance"):
            sensor.expose(light, rng)
    assert not sensor.expose(np.full((4, 4), -1e-9), rng).any()  # rounding error of a formed image


def test_illumination_is_one_at_the_centre_and_follows_its_coefficients() -> None:
    assert np.array_equal(illumination(5, 3), np.ones((3, 5)))
    light = illumination(201, 101, gradient=(0.1, -0.2), curvature=(-0.05, 0.02, 0.04))
    assert light[50, 100] == 1.0
    assert light[50, 200] == pytest.approx(1 + 0.1 - 0.05)
    assert light[100, 100] == pytest.approx(1 - 0.1 + 0.04 / 4)
    assert light[100, 200] == pytest.approx(1 + 0.1 - 0.1 - 0.05 + 0.01 + 0.01)


def test_light_falls_off_by_the_fourth_power_of_the_cosine() -> None:
    alpha = 0.5
    light = illumination(401, 301, corner_angle=alpha)
    assert light[0, 0] == pytest.approx(np.cos(alpha) ** 4)
    half_way = np.arctan(np.tan(alpha) / 2)
    assert light[225, 300] == pytest.approx(np.cos(half_way) ** 4)
    with pytest.raises(UsageError, match="without light"):
        illumination(10, 10, gradient=(-1.5, 0.0))
