"""Sensors calibrated: truth recovered within its sigmas, frames corrected, files read."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from reseau.calibration import Calibration
from reseau.calibration.sensor import SensorCorrection
from reseau.core.data import Array, Frame
from reseau.core.errors import EstimationError, FormatError, UsageError
from reseau.core.failure import Failure
from reseau.sensor import Level, SensorSeries, calibrate_sensor
from reseau.sensor.sensor import SensorResult
from reseau_sims.pixels import PixelSensor

LIGHT = 0.25
EXPOSURES = (100, 500, 1000, 2000, 4000, 6000, 8000, 10000, 12000, 14000, 17000, 20000)
BEND = {"b2": 0.02, "b3": -0.05}


def series(sensor: PixelSensor, rng: np.random.Generator, light: Array | float = LIGHT) -> SensorSeries:
    dark = tuple(
        Level.of(t, (sensor.expose(0.0, t, rng) for _ in range(8))) for t in (100.0, 10_000.0, 20_000.0)
    )
    bright = tuple(Level.of(t, (sensor.expose(light, t, rng) for _ in range(4))) for t in EXPOSURES)
    return SensorSeries(dark, bright, sensor.full_scale)


@cache
def calibrated(seed: int) -> tuple[PixelSensor, SensorResult]:
    rng = np.random.default_rng(seed)
    sensor = PixelSensor.drawn(rng, **BEND)
    return sensor, calibrate_sensor(series(sensor, rng))


@pytest.mark.slow
def test_the_truth_is_recovered_within_its_sigmas() -> None:
    errors: dict[str, list[float]] = {}
    for seed in range(40):
        sensor, result = calibrated(seed)
        for name, found in result.quantities().items():
            errors.setdefault(name, []).append((found.value - getattr(sensor, name)) / found.sigma)
    assert set(errors) == {"gain", "read_noise", "full_well", "b2", "b3"}
    # rms of 40 normalised errors: 1 ± 0.11; the mean's bound is 3.3 of its sigma.
    for name, normalised in errors.items():
        assert 0.7 < np.sqrt(np.mean(np.square(normalised))) < 1.35, name
        assert abs(np.mean(normalised)) < 0.52, name


@pytest.mark.slow
def test_defective_pixels_are_found_with_few_false_alarms() -> None:
    found, wrong = 0, 0
    for seed in range(40):
        sensor, result = calibrated(seed)
        bad = sensor.hot | sensor.dead
        found += int((result.fields.defects & bad).sum())
        wrong += int((result.fields.defects & ~bad).sum())
    assert found == 40 * 5
    # Half a pixel for each sensor by design; Poisson's 20 ± 4.5, and the tails of the estimated widths.
    assert wrong < 45


def test_a_corrected_frame_is_flat_dark_and_straight() -> None:
    sensor, result = calibrated(3)
    rng = np.random.default_rng(99)
    means = []
    for exposure in (1000.0, 4000.0, 8000.0):
        raw = np.mean([sensor.expose(LIGHT, exposure, rng) for _ in range(200)], axis=0)
        clean = result.correction.correct(Frame(raw, sensor.full_scale), exposure).pixels
        means.append(clean.mean() / exposure)
        # 200 frames leave σ/√200 of noise; the fields' own from 8 levels comes on top.
        noise = np.sqrt(sensor.read_noise**2 + LIGHT * exposure / sensor.gain)
        assert clean.std() < 0.45 * noise
        assert raw.std() > 1.2 * clean.std()
    assert np.ptp(means) / np.mean(means) < 1.5e-3


def test_uneven_light_is_not_a_defect_and_enters_the_response() -> None:
    rng = np.random.default_rng(5)
    sensor = PixelSensor.drawn(rng)
    y, x = np.mgrid[-1:1:64j, -1:1:96j]
    light = LIGHT * (1 - 0.2 * (x**2 + y**2))
    result = calibrate_sensor(series(sensor, rng, light))
    assert (result.fields.defects & ~(sensor.hot | sensor.dead)).sum() < 6
    assert result.prnu > 0.05
    assert abs(result.transfer.fit["gain"] - sensor.gain) < 4 * result.transfer.fit.sigma_of("gain")


def test_a_correction_is_read_back_unchanged() -> None:
    sensor, result = calibrated(0)
    calibration = Calibration.parse(result.calibration("sensor", {}, {}).to_json(), where="file")
    assert calibration.kind == "sensor"
    again = SensorCorrection.from_calibration(calibration)
    frame = Frame(sensor.expose(LIGHT, 5000.0, np.random.default_rng(1)), sensor.full_scale)
    one, two = result.correction.correct(frame, 5000.0).pixels, again.correct(frame, 5000.0).pixels
    # Steps of 16 bits: of the bias 2e-4, of the response 2e-6 of up to 2000.
    assert np.abs(one - two).max() < 0.02
    assert result.calibration("sensor", {}, {}).to_json() == result.calibration("sensor", {}, {}).to_json()


def test_frames_of_another_sensor_and_files_of_another_kind_are_refused() -> None:
    _, result = calibrated(0)
    for pixels, full_scale in ((np.zeros((8, 8)), 4095.0), (np.zeros((64, 96)), 255.0)):
        with pytest.raises(UsageError, match="calibrated sensor"):
            result.correction.correct(Frame(pixels, full_scale))
    document = result.calibration("sensor", {}, {})
    with pytest.raises(FormatError, match="not of a sensor"):
        SensorCorrection.from_calibration(document.model_copy(update={"model": "brown"}))
    for damage in ({"fields": {}}, {"fields": None}, {"b2": "x"}):
        broken = document.model_copy(update={"model": {**result.correction.to_model(), **damage}})
        with pytest.raises(FormatError, match="damaged"):
            SensorCorrection.from_calibration(broken)


def test_series_that_cannot_be_calibrated_are_reported() -> None:
    rng = np.random.default_rng(0)
    sensor = PixelSensor.drawn(rng)
    dark = Level.of(100.0, [sensor.expose(0.0, 100.0, rng) for _ in range(2)])
    with pytest.raises(UsageError, match="at least one dark"):
        SensorSeries((), (dark,), 4095.0)
    with pytest.raises(UsageError, match="two frames"):
        Level.of(1.0, [np.zeros((4, 4))])
    with pytest.raises(EstimationError, match="photon transfer"):
        calibrate_sensor(SensorSeries((dark,), (dark, dark, dark), 4095.0))
    few = tuple(Level.of(t, [sensor.expose(LIGHT, t, rng) for _ in range(3)]) for t in (1e3, 2e3, 3e3))
    result = calibrate_sensor(SensorSeries((dark,), few, 4095.0))
    assert isinstance(result.linearity, Failure)
    assert result.transfer.full_well is None
    assert not result.validity()["saturated"]


def test_a_flickering_lamp_does_not_count_as_noise() -> None:
    rng = np.random.default_rng(4)
    sensor = PixelSensor.drawn(rng)
    still = Level.of(4000.0, [sensor.expose(LIGHT, 4000.0, rng) for _ in range(20)])
    flickering = Level.of(4000.0, [sensor.expose(LIGHT * f, 4000.0, rng) for f in rng.normal(1.0, 0.02, 20)])
    assert flickering.variance.mean() == pytest.approx(still.variance.mean(), rel=0.02)


def test_the_variance_of_a_corrected_frame_is_that_of_read_noise_and_electrons() -> None:
    """At the dark level and above it, with a bent response and one that is half as steep."""
    fields = SimpleNamespace(
        dark=lambda exposure_us: np.full((2, 2), 100.0), response=np.full((2, 2), 0.5, np.float32)
    )
    sensor: Any = SimpleNamespace(
        fields=fields, full_scale=1000.0, correction=SimpleNamespace(b2=0.1, b3=0.0),
        transfer=SimpleNamespace(fit={"read_noise": 2.0, "gain": 4.0}),
    )  # fmt: skip
    found = SensorResult.variance(sensor, Frame(np.array([[100.0, 300.0]] * 2), 1000.0), 3, 50.0)
    read = 4.0 + 1 / 12
    expected = [read, 1.04**2 * read + 200 * 1.02 / 4.0]
    np.testing.assert_allclose(found, np.array([expected] * 2) / (3 * 0.25), rtol=1e-6)
