"""Stored coefficients tested with a new photograph of the test object."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from reseau.calibration import Calibration, InstrumentCorrection
from reseau.core.data import ImagePoints
from reseau.core.failure import Failure
from reseau.refine import correct_camera, correct_instrument, still_standard

from .oscilloscope import RESEAU, RODS, SIGMA_PX, displayed, measured, reseau_marks

TOLERANCE = 0.05


@pytest.fixture(scope="module")
def stored() -> tuple[InstrumentCorrection, np.ndarray]:
    """A correction, and the true positions of its rods."""
    rng = np.random.default_rng(1)
    real = RODS.xy + rng.normal(0, TOLERANCE, RODS.xy.shape)
    camera = correct_camera(reseau_marks(rng), RESEAU, trials=0).required()
    return correct_instrument(measured(RODS.ids, displayed(real), rng), RODS, camera).required(), real


@pytest.mark.slow
def test_an_unchanged_instrument_is_rejected_at_the_level_of_the_test(stored):
    correction, real = stored
    rng, trials = np.random.default_rng(2), 300
    tests = []
    for _ in range(trials):
        # The images of then had errors of their own.
        then = measured(RODS.ids, displayed(real), rng)
        before = InstrumentCorrection(
            correction.camera,
            correction.model,
            correction.plane,
            correction.covariance,
            correction.unit,
            then,
        )
        tests.append(still_standard(before, measured(RODS.ids, displayed(real), rng), RODS))
    rejected = sum(not test.holds for test in tests)
    low, high = binom.ppf([0.005, 0.995], trials, 0.05)
    assert low <= rejected <= high
    assert all(test.degrees == 2 * len(RODS.ids) for test in tests)


def test_other_rods_add_their_tolerance_and_the_stored_covariance(stored):
    correction, _ = stored
    rng = np.random.default_rng(3)
    other = RODS.xy + rng.normal(0, TOLERANCE, RODS.xy.shape)
    pins = measured(RODS.ids, displayed(other), rng)
    assert still_standard(correction, pins, RODS, same_object=False).holds
    assert not still_standard(correction, pins, RODS, same_object=True).holds


def test_a_shifted_and_a_deformed_display_are_distinguished(stored):
    correction, real = stored
    rng = np.random.default_rng(4)
    aside = np.array([0.03, -0.02])
    shifted = still_standard(correction, measured(RODS.ids, displayed(real + aside), rng), RODS)
    assert not shifted.holds
    assert np.abs(shifted.shift - aside).max() < 4 * shifted.shift_sigma.max()
    assert shifted.p_shift < 1e-6
    assert shifted.p_rest > 0.001
    middle = real.mean(axis=0)
    bent = real + 2e-5 * (real - middle) * np.hypot(*(real - middle).T)[:, None]
    drawn = still_standard(correction, measured(RODS.ids, displayed(bent), rng), RODS)
    assert drawn.p_rest < 1e-6
    assert drawn.largest[1] > 0.02


def test_a_calibration_contains_the_image_coordinates_it_was_computed_from(stored):
    correction, _ = stored
    text = correction.calibration(RESEAU, RODS, name="bench").to_json()
    back, _, rods = InstrumentCorrection.from_calibration(Calibration.parse(text, where="test"))
    assert back.pins.names == correction.pins.names
    assert np.abs(back.pins.xy - correction.pins.xy).max() == 0
    assert np.abs(back.pins.cov - correction.pins.cov).max() < 1e-12 * SIGMA_PX**2
    assert still_standard(back, correction.pins, rods).statistic < 1e-9


def test_three_rods_are_too_few(stored):
    correction, _ = stored
    few: ImagePoints = correction.pins.select(correction.pins.names[:3])
    found = still_standard(correction, few, RODS)
    assert isinstance(found, Failure)
    assert "four are needed" in found.reason
