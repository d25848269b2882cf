"""Sheets of disks with coded rings, formed at any rotation and tilt, and in photographs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from reseau.cli import run
from reseau.core.data import Array, Frame
from reseau.core.errors import FormatError
from reseau.core.failure import Code
from reseau.designs import coded_sheet
from reseau.io import ReseauDesign, ReseauMeasurement
from reseau.io.images import read_image, write_image
from reseau.measure import measure_reseau
from reseau.measure.reseau.measure import ReseauResult

from . import camcal, sheets


def measured(formed: sheets.Formed, design: ReseauDesign | None = None) -> ReseauResult:
    result = measure_reseau(formed.frame, design or sheets.DESIGN)
    assert isinstance(result, ReseauResult), result.reason
    return result


@pytest.mark.slow
@pytest.mark.parametrize(("roll", "tilt"), [(0.0, 0.0), (100.0, 30.0), (200.0, 45.0), (300.0, 45.0)])
def test_every_disk_has_its_number_and_its_centre_at_any_rotation_and_tilt(roll: float, tilt: float) -> None:
    formed = sheets.form(sheets.Camera(roll, tilt))
    result = measured(formed)
    error = result.xy - formed.truth
    assert result.ok.all(), result.why
    # The centre of its ellipse is up to 0.1 px off the image of a disk's centre here.
    assert np.abs(error.mean(axis=0)).max() < 0.006
    assert np.sqrt((error**2).mean()) < 0.02
    # The covariances are from the residuals of 56 disks each.
    assert 0.8 < np.sqrt((error**2).sum() / np.trace(result.cov, axis1=1, axis2=2).sum()) < 1.25


def test_a_sheet_found_at_half_the_size_of_a_large_frame_is_measured_at_its_full_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("reseau.measure.reseau.sheet._LARGE_PX", 1000)
    formed = sheets.form(sheets.Camera(100.0, 30.0))
    result = measured(formed)
    assert result.ok.all(), result.why
    assert np.sqrt(((result.xy - formed.truth) ** 2).mean()) < 0.02


def test_disks_outside_the_frame_are_declined_and_the_others_keep_their_numbers() -> None:
    formed = sheets.form(sheets.Camera(20.0, 30.0, (330.0, 0.0)))
    result = measured(formed)
    inside = ((formed.truth > 12) & (formed.truth < np.array([787, 587]))).all(axis=1)
    assert 30 < inside.sum() < 50
    assert result.ok[inside].all()
    assert np.abs((result.xy - formed.truth)[result.ok]).max() < 0.1
    assert all(result.why[k] for k in np.flatnonzero(~result.ok))


def test_a_disk_that_is_half_hidden_is_declined_with_a_reason() -> None:
    formed = sheets.form(sheets.Camera(10.0, 20.0))
    x, y = np.rint(formed.truth[12]).astype(int)
    formed.frame.pixels[y - 30 : y + 30, x : x + 60] = 190
    result = measured(formed)
    assert not result.ok[12]
    assert result.why[12]
    # Its neighbours are none the worse.
    assert np.abs((result.xy - formed.truth)[result.ok]).max() < 0.1


def errors_over_sigmas(result: ReseauResult, truth: Array) -> Array:
    """Lengths (n,) of errors in units of their standard deviations; 0 where a disk was declined."""
    error = np.where(result.ok[:, None], result.xy - truth, 0.0)
    weight = np.linalg.inv(np.where(result.ok[:, None, None], result.cov, np.eye(2)))
    return np.asarray(np.sqrt(np.einsum("ki,kij,kj->k", error, weight, error)))


def test_the_blurred_light_of_a_ring_does_not_shift_the_disk_inside() -> None:
    formed = sheets.form(sheets.Camera(25.0, 50.0, blur_px=2.0))
    result = measured(formed)
    assert sheets.DESIGN.rings is not None
    coded = [sheets.DESIGN.ids.index(name) for name in sheets.DESIGN.rings.sectors]
    assert result.ok[coded].all(), [result.why[k] for k in coded]
    assert errors_over_sigmas(result, formed.truth)[coded].max() < 4


@pytest.mark.slow
@pytest.mark.parametrize("grey", [30, 120, 240])
def test_disks_are_measured_by_what_an_object_in_front_leaves_of_them(grey: int) -> None:
    formed = sheets.form(sheets.Camera(10.0, 20.0))
    x, y = np.rint(formed.truth[[20, 31]]).astype(int).T
    radius = 9
    for k, share in enumerate((0.3, 0.45)):
        formed.frame.pixels[y[k] - 25 : y[k] + 25, x[k] + radius - round(2 * radius * share) : x[k] + 35] = (
            grey
        )
    result = measured(formed)
    assert result.ok[20]
    assert errors_over_sigmas(result, formed.truth).max() < 4.5


def test_a_sheet_with_hidden_rings_cannot_be_numbered() -> None:
    result = measure_reseau(sheets.form(sheets.Camera(10.0, 20.0), rings=False).frame, sheets.DESIGN)
    assert not result
    assert result.code is Code.AMBIGUOUS
    assert "no coded ring identifies them" in result.reason


def test_a_mirrored_sheet_is_reported_as_mirrored() -> None:
    formed = sheets.form(sheets.Camera(10.0, 20.0))
    turned = Frame(np.ascontiguousarray(formed.frame.pixels[:, ::-1]), 255.0)
    result = measure_reseau(turned, sheets.DESIGN)
    assert not result
    assert result.code is Code.MIRRORED


def test_a_frame_without_a_sheet_is_a_failure_with_a_reason() -> None:
    noise = np.random.default_rng(1).normal(128, 6, (600, 800)).clip(0, 255).astype(np.uint8)
    result = measure_reseau(Frame(noise, 255.0), sheets.DESIGN)
    assert not result
    assert result.code is Code.NOT_FOUND
    assert result.reason


def test_the_file_contains_rings_only_if_present_and_they_name_points_of_the_design() -> None:
    design = sheets.DESIGN
    assert ReseauDesign.parse(design.to_json(), where="file") == design
    plain = design.model_copy(update={"rings": None})
    assert "rings" not in plain.to_dict()
    content = design.to_dict()
    content["rings"]["sectors"]["no such disk"] = [[0.0, 90.0]]
    with pytest.raises(FormatError, match="not the id of a point"):
        ReseauDesign.parse(json.dumps(content), where="file")


def test_the_command_measures_one_colour_channel(tmp_path: Path) -> None:
    formed = sheets.form(sheets.Camera(30.0, 20.0))
    green = formed.frame.pixels
    # The red image lies two pixels beside the green one.
    write_image(tmp_path / "photo.png", np.stack([np.roll(green, 2, axis=1), green, green], axis=2))
    sheets.DESIGN.write(tmp_path / "sheet.json")
    files = [str(tmp_path / name) for name in ("photo.png", "sheet.json", "marks.json")]
    arguments = ["measure", "reseau", files[0], "--design", files[1], "--out", files[2]]
    for channel, beside in (("green", 0.0), ("red", 2.0)):
        assert run([*arguments, "--channel", channel]) == 0
        found = ReseauMeasurement.read(files[2])
        assert found.found == len(formed.truth)
        error = found.image_points().xy - formed.truth
        assert np.abs(error.mean(axis=0) - [beside, 0.0]).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 7, 10, 18])
def test_every_disk_found_by_another_program_is_measured_with_the_same_number(
    reference_data: Callable[[str], Path], number: int
) -> None:
    folder = reference_data("testfield_camcal")
    design, theirs = camcal.design(folder), camcal.marks(folder)[number - 1]
    result = measure_reseau(read_image(camcal.photographs(folder)[number - 1], "green"), design)
    assert isinstance(result, ReseauResult)
    rows = [design.ids.index(name) for name in theirs]
    assert result.ok[rows].all()
    difference = result.xy[rows] - np.array(list(theirs.values())) + 0.5
    # A wrong number would be 60 px off at least; theirs are centres of ellipses, in all colours.
    assert np.abs(difference).max() < 0.6


@pytest.mark.slow
def test_a_designed_sheet_is_numbered_at_any_rotation() -> None:
    design = coded_sheet(8, 7, 10.0)
    for roll in (15.0, 105.0, 195.0, 285.0):
        formed = sheets.form(sheets.Camera(roll, 35.0), design)
        result = measured(formed, design)
        assert result.ok.all(), result.why
        assert np.abs(result.xy - formed.truth).max() < 0.1


def test_reflections_in_disks_do_not_shift_them() -> None:
    camera = sheets.Camera(20.0, 30.0)
    x, y = np.meshgrid(np.arange(800.0), np.arange(600.0))
    # Its contrast changes by a fifth from the middle of a disk to its edge, where it changes most.
    glare = 0.5 * np.exp(-0.5 * ((x - 400) ** 2 + (y - 300) ** 2) / 25.0**2)
    formed = sheets.form(camera, glare=glare)
    result = measured(formed)
    near = np.hypot(*(formed.truth - [400, 300]).T) < 75
    error = (result.xy - formed.truth)[result.ok & near]
    assert (result.ok & near).sum() >= 3
    assert np.abs(error).max() < 0.06


@pytest.mark.slow
@pytest.mark.parametrize("kept", [(0,), (1,), (2,), (3,)])
def test_one_visible_ring_suffices_to_number_a_sheet(kept: tuple[int]) -> None:
    design = coded_sheet(8, 7, 10.0)
    assert design.rings is not None
    names = list(design.rings.sectors)
    only = {names[kept[0]]: design.rings.sectors[names[kept[0]]]}
    shown = design.model_copy(update={"rings": design.rings.model_copy(update={"sectors": only})})
    formed = sheets.form(sheets.Camera(50.0 + 90 * kept[0], 25.0), shown)
    result = measured(formed, design)
    assert result.ok.sum() >= 52
    assert np.abs(result.xy - formed.truth)[result.ok].max() < 0.2


def test_grey_values_of_a_curve_are_linearised_with_a_note() -> None:
    formed = sheets.form(sheets.Camera(10.0, 40.0), light=220)
    coded = 255 * (formed.frame.pixels / 255.0) ** (1 / 2.2)
    result = measure_reseau(Frame(coded.round().astype(np.uint8), 255.0), sheets.DESIGN)
    assert isinstance(result, ReseauResult)
    assert [note.code for note in result.notes] == [Code.NONLINEAR]
    found = errors_over_sigmas(result, formed.truth)
    assert 0.75 < np.sqrt((found**2).mean() / 2) < 1.25


def test_smear_by_motion_is_modelled_with_a_note() -> None:
    formed = sheets.form(sheets.Camera(10.0, 30.0))
    kernel = np.zeros((5, 5))
    kernel[range(5), range(5)] = [0.125, 0.25, 0.25, 0.25, 0.125]
    light = cv2.filter2D(formed.frame.pixels.astype(float), -1, kernel)
    noise = np.random.default_rng(2).normal(0, 2, light.shape)
    result = measure_reseau(Frame((light + noise).clip(0, 254).astype(np.uint8), 255.0), sheets.DESIGN)
    assert isinstance(result, ReseauResult)
    assert [note.code for note in result.notes] == [Code.FILTERED]
    found = errors_over_sigmas(result, formed.truth)
    assert 0.7 < np.sqrt((found**2).mean() / 2) < 1.25
