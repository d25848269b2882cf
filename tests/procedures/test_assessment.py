"""The verdict on a calibration: accuracy, coverage, fit, and the next photograph."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from reseau.bundle.diagnostics.fields import camera_mapping
from reseau.calibration import Calibration, CameraMapping, calibration_difference, projection_field
from reseau.calibration.assessment import Use
from reseau.core.data import ImagePoints
from reseau.core.failure import Code
from reseau.designs import coded_sheet
from reseau.optics import OpenCV
from reseau.procedures.calibrated import Calibrated
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.calibration_options import CalibrationOptions, CameraOptions

DESIGN = coded_sheet(9, 8, 20.0)
SIZE = (800, 600)
SIGMA = 0.01
MATRIX = np.array([[700.0, 0, 402.0], [0, 700.0, 297.0], [0, 0, 1]])


def measured(
    count: int = 10,
    *,
    side: float = 0.0,
    k2: float = 0.05,
    k3: float = 0.0,
    noise: float = SIGMA,
    tilt: float = 30.0,
    zoom: float = 1.0,
    bent: float = 0.0,
) -> list[tuple[str, ImagePoints]]:
    """Coordinates by OpenCV's projection; with `side` the target is in the left part of all images.

    From the middle on, images are taken with another `zoom`. The middle of the target is `bent` by some mm.
    """
    rng, found = np.random.default_rng(4), []
    across = DESIGN.xy[:, 0] - DESIGN.xy[:, 0].mean()
    xyz = np.column_stack([DESIGN.xy * [1, -1], bent * (1 - (across / across.max()) ** 2)])
    for k in range(count):
        roll = cv2.Rodrigues(np.array([0, 0, np.pi / 2 * k]))[0]
        axis = np.deg2rad(tilt) * np.array([np.cos(1.3 * k), np.sin(1.3 * k), 0])
        turn = cv2.Rodrigues(cv2.Rodrigues(axis)[0] @ roll)[0]
        place = np.array([rng.uniform(-40, 40) - side, rng.uniform(-30, 30), 170.0 + side + 10 * (k % 3)])
        matrix = MATRIX if k < count / 2 else np.diag([zoom, zoom, 1.0]) @ MATRIX
        xy = cv2.projectPoints(xyz, turn, place, matrix, np.array([-0.2, k2, 0, 0, k3]))[0][:, 0]
        inside = ((xy > 5) & (xy < np.array(SIZE) - 6)).all(axis=1)
        xy = xy + noise * rng.normal(size=xy.shape)
        names = [name for name, good in zip(DESIGN.ids, inside, strict=True) if good]
        found.append((f"{k}.png", ImagePoints.with_sigma(names, xy[inside], SIGMA)))
    return found


def calibrated(
    images: list[tuple[str, ImagePoints]],
    free: tuple[str, ...] = (),
    options: CalibrationOptions | None = None,
) -> Calibrated:
    model = CameraOptions("opencv", free or ("fx", "fy", "cx", "cy", "k1", "k2"))
    return calibrate_camera(images, DESIGN, lambda frame: None, SIZE, model, options).required()  # type: ignore[arg-type, return-value]


@pytest.fixture(scope="module")
def sound() -> Calibrated:
    return calibrated(measured())


def test_a_covered_and_accurate_calibration_is_usable_for_measurement(sound: Calibrated) -> None:
    found = sound.assessments["camera"]
    assert found.use is Use.MEASUREMENT
    assert found.fits
    assert found.uncovered == ()
    assert found.centre_px < found.corners_px < 0.05
    assert found.errors is not None
    assert found.errors.total[[0, 0, -1, -1], [0, -1, 0, -1]].max() == pytest.approx(
        found.corners_px, rel=1e-3
    )
    assert found.lines[0].startswith("usable for measurement: 0.00")
    assert 29.0 < found.tilts_deg[1] <= found.tilts_deg[0] < 31.0
    assert "straight" not in found.lines[1]
    assert found.covered > 0.8
    assert found.lines[1].startswith(f"points are in {int(100 * found.covered)} % of the image; ")
    assert "enough for measurement" in found.lines[1] or "no further" in found.lines[1]


@pytest.mark.slow
@pytest.mark.parametrize("k3", [pytest.param(0.0, marks=pytest.mark.slow), 0.02])
def test_the_error_that_is_stated_holds_for_a_lens_with_more_terms(k3: float, sound: Calibrated) -> None:
    """What k1 and k2 make of k3 is right where points are, and wrong by ten sigmas in the corners."""
    result = calibrated(measured(k3=k3)) if k3 else sound
    found = result.assessments["camera"]
    true = dict(zip(("fx", "fy", "cx", "cy"), MATRIX[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True))
    lens = OpenCV.from_parameters(true | {"k1": -0.2, "k2": 0.05, "k3": k3})
    other = CameraMapping(lens, *SIZE, np.array([0]), np.zeros((1, 1)))
    off = calibration_difference(camera_mapping(result.result, 0), other).difference
    corners = np.hypot(*off[[0, 0, -1, -1], [0, -1, 0, -1]].T).max()
    assert [cause.code for cause in found.causes] == (["lens"] if k3 else [])
    assert corners < 2.5 * found.corners_px
    assert found.corners_px < max(2.5 * corners, 0.05)
    assert found.errors is not None
    within = projection_field(camera_mapping(result.result, 0), len(found.errors.x)).sigma
    assert (found.errors.total >= 0.999 * within).all()
    if k3:
        assert corners > 0.1
        assert "; the camera model does not describe the lens (0.0" in found.lines[0]
        assert found.causes[0].code == "lens"


@pytest.mark.slow
def test_photographs_with_another_zoom_are_named_and_not_made_up_for_by_another_one() -> None:
    found = calibrated(measured(zoom=1.1)).assessments["camera"]
    assert found.causes[0].code == "other-camera"
    assert found.next_photograph is None
    assert "; some photographs have another zoom, size or crop (" in found.lines[0]


@pytest.mark.slow
def test_a_bent_target_that_is_held_flat_is_no_fault_of_the_photographs() -> None:
    bent = measured(bent=1.5)
    found = calibrated(bent, options=CalibrationOptions(target="flat")).assessments["camera"]
    assert found.causes[0].code == "target-shape"
    assert "--target free" in found.lines[0]
    assert calibrated(bent).assessments["camera"].use is Use.MEASUREMENT


@pytest.mark.slow
def test_gross_errors_are_left_out_where_nothing_explains_them_as_well_unless_told() -> None:
    images, rng, wrong = measured(), np.random.default_rng(8), set[tuple[str, str]]()
    for name, points in images[:4]:
        rows = rng.choice(len(points), 2, replace=False)
        points.xy[rows] += 0.3 * rng.choice([-1.0, 1.0], (2, 2))
        wrong |= {(name, points.names[k]) for k in rows}
    found, kept = calibrated(images), calibrated(images, options=CalibrationOptions(reject=False))
    assert kept.assessments["camera"].causes[0].code == "blunders"
    assert kept.result.rejected.sum() == 0
    network, rows = found.result.network, np.flatnonzero(found.result.rejected)
    left = {(network.images[network.image_of[k]], network.points[network.point_of[k]]) for k in rows}
    # Of 630 good points a few look wrong.
    assert wrong <= left
    assert len(left - wrong) <= 6
    said = f"{len(rows)} image points are gross errors, and are left out: in image 0.png: points"
    assert found.notes[-1].startswith(said)
    assert found.assessments["camera"].causes == ()
    assert found.sigma0 < 1.1


@pytest.mark.slow
def test_points_with_the_names_of_others_are_left_out_and_said() -> None:
    images = measured()
    name, points = images[3]
    names = list(points.names)
    names[0], names[20] = names[20], names[0]
    images[3] = name, ImagePoints(tuple(names), points.xy, points.cov)
    done = calibrated(images)
    found = done.assessments["camera"]
    assert found.causes[0].code == "names"
    assert name in found.causes[0].where
    assert done.sigma0 == pytest.approx(1.0, abs=0.05)


def test_the_part_without_points_is_named_and_the_next_photograph_shows_the_target_there() -> None:
    found = calibrated(measured(side=70.0)).assessments["camera"]
    assert {"upper right corner", "right edge", "lower right corner"} <= set(found.uncovered)
    assert found.covered < 0.8
    assert "the result is extrapolated there" in found.lines[1]
    then = found.next_photograph
    assert then is not None
    assert max(x for x, _ in then.points_px) > 0.8 * SIZE[0]
    assert then.worst_px < found.corners_px


@pytest.mark.slow
def test_the_predicted_uncertainty_is_that_after_the_photograph_was_taken() -> None:
    images = measured(5, side=40.0)
    before = calibrated(images)
    then = before.assessments["camera"].next_photograph
    assert then is not None
    # The target is photographed there, by OpenCV.
    xyz = np.column_stack([DESIGN.xy, np.zeros(len(DESIGN.xy))])
    assert then.pose is not None
    shift = -then.pose.matrix @ then.pose.x0
    xy = cv2.projectPoints(xyz, then.pose.rotation, shift, MATRIX, np.array([-0.2, 0.05, 0, 0]))[0][:, 0]
    xy += SIGMA * np.random.default_rng(1).normal(size=xy.shape)
    inside = ((xy > 6) & (xy < np.array(SIZE) - 7)).all(axis=1)
    names = [name for name, good in zip(DESIGN.ids, inside, strict=True) if good]
    after = calibrated([*images, ("next.png", ImagePoints.with_sigma(names, xy[inside], SIGMA))])
    reached = float(np.nanmax(projection_field(camera_mapping(after.result, 0), 13).sigma))
    assert then.worst_px == pytest.approx(reached, rel=0.1)


@pytest.mark.slow
def test_a_model_that_does_not_fit_is_said_so_in_pixels() -> None:
    found = calibrated(measured(k2=0.4), ("fx", "fy", "cx", "cy", "k1")).assessments["camera"]
    assert not found.fits
    assert found.causes[0].code == "lens"
    assert found.causes[0].amount_px > 0.05
    assert found.causes[0].share > 0.9
    assert "the camera model does not describe the lens (" in found.lines[0]


@pytest.mark.slow
def test_a_failed_global_test_of_small_residuals_is_no_alarm() -> None:
    done = calibrated(measured(noise=1.2 * SIGMA))
    found = done.assessments["camera"]
    assert any(remark.code is Code.SIGMAS_DOUBTFUL for remark in done.result.warnings)
    assert any(remark.code is Code.SIGMAS_DOUBTFUL for remark in done.tests)
    assert done.warnings == ()
    assert found.use is Use.MEASUREMENT
    assert [cause.code for cause in found.causes] == ["noise"]
    assert found.fits


@pytest.mark.slow
def test_frontal_photographs_are_not_usable() -> None:
    found = calibrated(measured(6, tilt=0.5)).assessments["camera"]
    assert found.use is not Use.MEASUREMENT
    assert found.next_photograph is not None
    assert "towards the camera" in found.next_photograph.text


def test_the_calibration_contains_the_verdict_and_keeps_it_in_its_file(
    tmp_path: Path, sound: Calibrated
) -> None:
    done = sound
    done.write(tmp_path / "c.json")
    again = Calibration.read(tmp_path / "c.json")
    assert again.assessment == done.assessment == done.assessments["camera"]
    assert again.assessment is not None
    assert again.assessment.short in repr(done)
    assert again.assessment.short in repr(again)
    assert again.assessment.lines[0] in again._repr_html_()
    assert again.assessment.lines[0] in done._repr_html_()
    assert again.assessment.lines[0] in again.summary()
    errors = again.assessment.errors
    assert errors is not None
    assert errors.total[-1, 0] <= again.assessment.corners_px * 1.001
    assert (errors.total >= 0.999 * errors.formal).all()


@pytest.mark.slow
def test_a_target_seen_nearly_straight_is_to_be_tilted() -> None:
    found = calibrated(measured(8, tilt=6.0)).assessments["camera"]
    assert "nearly straight, tilted by 6° at most: tilt it; " in found.lines[1]
    then = found.next_photograph
    assert then is not None
    assert "45° towards the camera" in then.text
    assert then.worst_px < 0.3 * found.corners_px


@pytest.mark.slow
def test_the_one_photograph_that_is_tilted_is_counted() -> None:
    images = measured(6, tilt=0.5)[:5] + measured(6, tilt=38.0)[5:]
    line = calibrated(images).assessments["camera"].lines[1]
    assert "nearly straight, tilted by 38° in one photograph and by 0° at most in the others: tilt" in line


@pytest.mark.slow
def test_the_verdict_on_a_circular_image_does_not_speak_of_its_dark_corners() -> None:
    size, f = (900, 560), 190.0
    rng, images = np.random.default_rng(5), []
    xyz = np.column_stack([DESIGN.xy * [1, -1], np.zeros(len(DESIGN.xy))])
    matrix = np.array([[f, 0, 452.0], [0, f, 278.0], [0, 0, 1]])
    for k in range(16):
        # The target is at 45° from the axis in all directions, and before the camera.
        away = np.deg2rad(45.0 if k % 2 else 5.0)
        turn = cv2.Rodrigues(0.5 * np.array([np.cos(1.3 * k), np.sin(1.3 * k), 0.3 * k]))[0]
        ray = np.array([np.sin(away) * np.cos(0.8 * k), np.sin(away) * np.sin(0.8 * k), np.cos(away)])
        place = 150.0 * ray - turn @ xyz.mean(axis=0)
        seen = xyz @ turn.T + place
        xy = cv2.fisheye.projectPoints(seen[:, None], np.zeros(3), np.zeros(3), matrix, np.zeros(4))[0][:, 0]
        good = (seen[:, 2] > 20) & ((xy > 5) & (xy < np.array(size) - 6)).all(axis=1)
        names = [name for name, inside in zip(DESIGN.ids, good, strict=True) if inside]
        xy = xy + SIGMA * rng.normal(size=xy.shape)
        images.append((f"{k}.png", ImagePoints.with_sigma(names, xy[good], SIGMA)))
    model = CameraOptions("fisheye", ("fx", "fy", "cx", "cy", "k1", "k2"))
    done = calibrate_camera(images, DESIGN, lambda frame: None, size, model).required()  # type: ignore[arg-type, return-value]
    found = done.assessments["camera"]
    assert 80 < found.circular_deg < 90
    assert f"up to {found.circular_deg:.0f}° from the axis" in found.lines[0]
    assert "corner" not in found.lines[0]
    assert found.use is not Use.NOTHING
