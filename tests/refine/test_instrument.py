"""Group B: an instrument is corrected by the rods of a test object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reseau.calibration import Calibration, InstrumentCorrection
from reseau.core.data import ImagePoints
from reseau.core.errors import FormatError
from reseau.core.failure import Failure
from reseau.io import DesignPoint
from reseau.refine import correct_camera, correct_instrument

from .oscilloscope import INSTRUMENT, RESEAU, RODS, SCALE, displayed, measured, pixels, reseau_marks

_BODY = np.array([[30.0, 30.0], [60.0, 50.0], [80.0, 70.0], [20.0, 65.0]])
_ALL = 1 - 1e-9
"""A level at which every coefficient is significant: nothing is dropped."""


def _noise_free():
    marks = ImagePoints.with_sigma(RESEAU.ids, pixels(RESEAU.xy), 0.01)
    camera = correct_camera(marks, RESEAU, trials=0, alpha=_ALL).required()
    rods = ImagePoints.with_sigma(RODS.ids, displayed(RODS.xy), 0.01)
    return camera, rods


def test_without_noise_object_coordinates_are_exact():
    camera, rods = _noise_free()
    found = correct_instrument(rods, RODS, camera, alpha=_ALL).required()
    body = ImagePoints.with_sigma("abcd", displayed(_BODY), 0.01)
    # The camera's model and the instrument's, each through the other's inverse: to a micrometre.
    np.testing.assert_allclose(found.apply(body).xy, _BODY, atol=1e-3)


def test_scales_and_rotation_are_those_of_the_display():
    camera, rods = _noise_free()
    plane = correct_instrument(rods, RODS, camera).required().plane
    # λ contains the display's own scale, 1/A1 and 1/B1.
    np.testing.assert_allclose(plane.scale, SCALE / [1.01, 0.99], rtol=0.01)
    assert abs(plane.rotation) < 0.02
    np.testing.assert_allclose(plane.from_common(plane.to_common(_BODY)), _BODY, atol=1e-10)


def test_m_and_n_define_the_system():
    camera, rods = _noise_free()
    found = correct_instrument(rods, RODS, camera).required()
    m, n = (RODS.ids.index(name) for name in (RODS.origin, RODS.axis))
    refined = camera.model(camera.photo_system(rods.xy))
    ends = found.plane.to_common(RODS.xy[[m, n]])
    np.testing.assert_allclose(ends, refined[[m, n]], atol=1e-9)


@pytest.mark.slow
def test_predicted_covariances_of_true_coordinates_cover():
    trials = 80
    rng = np.random.default_rng(1)
    squares = []
    for _ in range(trials):
        camera = correct_camera(reseau_marks(rng), RESEAU, trials=0, alpha=_ALL).required()
        real = RODS.xy + rng.normal(0, 0.05, RODS.xy.shape)
        rods = measured(RODS.ids, displayed(real), rng)
        found = correct_instrument(rods, RODS, camera, alpha=_ALL).required()
        true = found.apply(measured(tuple("abcd"), displayed(_BODY), rng))
        error = np.linalg.solve(np.linalg.cholesky(true.cov), (true.xy - _BODY)[..., None])[..., 0]
        squares.append(error**2)
    rms = np.sqrt(np.mean(squares))
    # The four points share a fit, so that a trial counts for little more than two numbers.
    assert abs(rms - 1) < 4 / np.sqrt(4 * trials)


@pytest.mark.slow
def test_errors_that_rods_share_act_together_in_the_covariance():
    camera, rods = _noise_free()
    exact = RODS.model_copy(
        update={"points": tuple(p.model_copy(update={"sigma": None}) for p in RODS.points)}
    )
    cov = np.tile(0.02**2 * np.eye(2), (len(rods), 1, 1))
    rods = ImagePoints(rods.names, rods.xy, cov)
    # An error in x of some rods, which leaves the system of M and N as it is.
    some = np.setdiff1d(np.arange(3, len(rods), 4), [RODS.ids.index(RODS.axis)])
    shared = np.zeros((len(rods), 2, 1))
    shared[some, 0, 0] = 0.01

    def fitted(move=0.0, shared=None):
        moved = ImagePoints(rods.names, rods.xy + move, cov)
        found = correct_instrument(moved, exact, camera, alpha=_ALL, trials=0, shared=shared).required()
        return found.model.values, found.covariance

    values, alone = fitted()
    size = len(values)
    together = fitted(shared[..., 0])[0] - values
    one_by_one = [np.where(np.arange(len(rods))[:, None] == i, shared[..., 0], 0) for i in some]
    each = np.array([fitted(move)[0] for move in one_by_one]) - values
    expected = np.outer(together, together) - each.T @ each
    added = (fitted(shared=shared)[1] - alone)[-size:, -size:]
    scale = np.sqrt(np.diagonal(alone)[-size:])
    scale = np.outer(scale, scale)
    # As a share of the variances; the scale λ2 of the rods changes a little, too.
    np.testing.assert_allclose(added / scale, expected / scale, atol=2e-3)
    assert abs(expected / scale).max() > 0.05


def test_absent_coefficients_are_dropped_and_the_datum_is_kept():
    rng = np.random.default_rng(2)
    camera = correct_camera(reseau_marks(rng), RESEAU, trials=0).required()
    found = correct_instrument(measured(RODS.ids, displayed(RODS.xy), rng), RODS, camera).required()
    dropped = set(found.fit.elimination.dropped)
    assert dropped
    assert dropped.isdisjoint({"A0", "A1", "A2", "B0", "B1", "B2"})
    # The paper's reduced model tells monomials apart, as A6·x³ and A6·xy².
    assert found.fit.monomials.full.names == INSTRUMENT.split().names
    assert len(found.fit.monomials.dropped) > len(dropped)
    # What is applied has them all, with their covariance.
    assert found.model.names == INSTRUMENT.names
    assert found.covariance.shape == (len(camera.model.names) + len(INSTRUMENT.names),) * 2


@pytest.mark.slow
def test_a_required_local_model_is_applied_and_stored_in_the_calibration():
    rng = np.random.default_rng(8)
    camera = correct_camera(reseau_marks(rng), RESEAU, trials=0).required()
    side = np.linspace(0, 100, 9)
    grid = np.stack(np.meshgrid(side, side * 0.8), axis=-1).reshape(-1, 2)
    points = tuple(
        DesignPoint(id=f"g{k}", x=float(x), y=float(y), sigma=0.01) for k, (x, y) in enumerate(grid)
    )
    dense = RODS.model_copy(update={"points": points, "origin": "g0", "axis": "g8"})

    def bulged(xy):
        """A bright area pushes the beam away from it, by 0.2 mm at its edge."""
        off = xy - [60.0, 40.0]
        return xy + 0.02 * off * np.exp(-0.5 * (off**2).sum(axis=1, keepdims=True) / 14.0**2)

    held = tuple(f"g{k}" for k in range(4, 81, 7))
    plain, bent = (
        correct_instrument(measured(dense.ids, displayed(shape(grid)), rng), dense, camera, check=held)
        for shape in (lambda xy: xy, bulged)
    )
    assert plain.local is None
    assert bent.local is not None
    check = bent.fit.check.xy - bent.fit.check_target
    without = replace(bent, local=None).apply(bent_points(bent, dense, bulged, held))
    truth = np.array([grid[int(name[1:])] for name in held])
    assert np.sqrt((check**2).mean()) < 0.5 * np.sqrt(((without.xy - truth) ** 2).mean())
    assert (np.abs(check) < 5 * bent.fit.check.sigma).all()
    text = bent.calibration(RESEAU, dense, name="bench").to_json()
    back, _, _ = InstrumentCorrection.from_calibration(Calibration.parse(text, where="test"))
    assert np.abs(back.apply(bent.pins).xy - bent.apply(bent.pins).xy).max() < 1e-9


def bent_points(found, design, shape, names):
    """Exact images of rods."""
    xy = design.xy[[design.ids.index(name) for name in names]]
    return ImagePoints.with_sigma(names, displayed(shape(xy)), 0.01)


def test_check_rods_are_predicted():
    rng = np.random.default_rng(3)
    camera = correct_camera(reseau_marks(rng), RESEAU, trials=0).required()
    held = ("r7", "r12", "r17")
    found = correct_instrument(
        measured(RODS.ids, displayed(RODS.xy), rng), RODS, camera, alpha=_ALL, check=held
    ).required()
    assert found.fit.check.names == held
    normalised = (found.fit.check.xy - found.fit.check_target) / found.fit.check.sigma
    assert np.abs(normalised).max() < 4


@pytest.mark.parametrize(("count", "message"), [(3, "four are needed"), (6, "fewer than the 16 parameters")])
def test_too_few_rods_are_reported(count, message):
    camera, rods = _noise_free()
    found = correct_instrument(rods.select(rods.names[:count]), RODS, camera)
    assert isinstance(found, Failure)
    assert message in found.reason


def test_rods_on_one_line_leave_the_second_scale_undetermined():
    camera, rods = _noise_free()
    found = correct_instrument(rods.select(["r0", "r1", "r2", "r3", "r4"]), RODS, camera)
    assert isinstance(found, Failure)
    assert "λ2" in found.reason or "fewer" in found.reason


def test_a_calibration_of_both_groups_is_read_back_unchanged():
    rng = np.random.default_rng(4)
    camera = correct_camera(reseau_marks(rng), RESEAU, trials=0).required()
    found = correct_instrument(measured(RODS.ids, displayed(RODS.xy), rng), RODS, camera).required()
    written = found.calibration(RESEAU, RODS, name="bench")
    text = written.to_json()
    back, reseau, rods = InstrumentCorrection.from_calibration(Calibration.parse(text, where="file"))
    assert (reseau, rods) == (RESEAU, RODS)
    assert back.calibration(reseau, rods, name="bench").covariance == written.covariance
    body = measured(tuple("abcd"), displayed(_BODY), rng)
    np.testing.assert_array_equal(back.apply(body).xy, found.apply(body).xy)
    np.testing.assert_allclose(back.apply(body).cov, found.apply(body).cov, rtol=1e-12)


def test_a_calibration_without_group_b_is_refused_with_instructions():
    camera = correct_camera(reseau_marks(np.random.default_rng(5)), RESEAU, trials=0).required()
    with pytest.raises(FormatError, match="camera alone; make it with a PHOTO II"):
        InstrumentCorrection.from_calibration(camera.calibration(name="bench"))
