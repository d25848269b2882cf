"""PHOTO I of the oscilloscope procedure on the simulated bench: from a frame, and from its points."""

from __future__ import annotations

import numpy as np
import pytest

from reseau.core.data import Frame
from reseau.core.failure import Failure
from reseau.designs import regular_reseau
from reseau.io import Mark
from reseau.optics import RationalPolynomial
from reseau.procedures.oscilloscope import PhotoI, photo_i
from reseau.refine import correct_camera
from reseau_sims import World

HELD = ("B2", "D4", "F6")
RESEAU = regular_reseau(7, 7, 15.0, Mark(shape="line-grid", line_width=0.5), name="small")


@pytest.fixture(scope="module")
def world() -> World:
    return World.standard(3, design=RESEAU)


@pytest.fixture(scope="module")
def refined(world) -> PhotoI:
    photo = photo_i(world.photo_i(), world.design, check=HELD)
    assert isinstance(photo, PhotoI)
    return photo


@pytest.mark.slow
def test_a_frame_is_refined_to_a_hundredth_of_a_millimetre(world, refined):
    assert refined.measured is not None
    assert refined.measured.found == 49
    design = dict(zip(RESEAU.ids, RESEAU.xy, strict=True))
    corrected = refined.camera.apply(refined.points)
    off = corrected.xy - np.array([design[name] for name in corrected.names])
    assert np.sqrt(np.mean(off**2)) < 0.003
    raw = refined.camera.photo_system(refined.points.xy) - [design[name] for name in refined.points.names]
    assert np.sqrt(np.mean(raw**2)) > 0.05
    assert refined.camera.fit.check.names == HELD
    assert np.abs(refined.camera.fit.check.xy - refined.camera.fit.check_target).max() < 0.01


@pytest.mark.slow
def test_marks_measured_elsewhere_give_the_same_result(world, refined):
    again = photo_i(refined.points, world.design, check=HELD)
    assert isinstance(again, PhotoI)
    assert again.measured is None
    assert again.points is refined.points
    assert again.camera.model.names == refined.camera.model.names
    np.testing.assert_array_equal(again.camera.model.values, refined.camera.model.values)
    np.testing.assert_array_equal(again.camera.cofactor, refined.camera.cofactor)
    ours, theirs = (camera.calibration(name="k").to_json() for camera in (refined.camera, again.camera))
    assert ours == theirs


def test_the_steps_agree_with_reseau_refine(world, refined):
    camera = correct_camera(refined.points, world.design, check=HELD).required()
    np.testing.assert_array_equal(camera.model.values, refined.camera.model.values)
    assert refined.camera.fit.elimination.criterion == "chi2"
    assert refined.camera.fit.elimination.alpha == 0.05
    assert refined.camera.fit.elimination.full.names == RationalPolynomial.camera().names


def test_model_level_and_test_are_options(refined):
    photo = photo_i(refined.points, RESEAU, model=RationalPolynomial.projective(), alpha=0.2, criterion="t")
    assert isinstance(photo, PhotoI)
    assert set(photo.camera.model.names) <= set(RationalPolynomial.projective().names)
    assert photo.camera.fit.elimination.alpha == 0.2
    assert {step["distribution"] for step in photo.camera.fit.tests()} == {"t"}


def test_a_frame_without_the_reseau_is_a_failure_that_names_both():
    noise = np.random.default_rng(0).normal(120.0, 3.0, (400, 500)).clip(0, 255).astype(np.uint8)
    found = photo_i(Frame(noise, 255.0, "dull.png"), RESEAU)
    assert not found
    assert isinstance(found, Failure)
    assert found.where == "dull.png"
    assert "small" in found.reason


def test_too_few_marks_are_a_failure(refined):
    found = photo_i(refined.points.select(["A1", "A7", "G1", "G7"]), RESEAU)
    assert isinstance(found, Failure)
    assert "4 points give 8 coordinates" in found.reason
