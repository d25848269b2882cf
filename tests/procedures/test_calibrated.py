"""The result of a calibration in Python: arrays, tables, comparison, files; the same of one that was read."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, get_type_hints

import cv2
import matplotlib as mpl
import numpy as np
import pytest

import reseau
from reseau.api import Adjusted
from reseau.bundle import Result
from reseau.calibration import Calibration
from reseau.calibration.assessment import Use
from reseau.core.data import ImagePoints
from reseau.core.errors import UsageError
from reseau.core.failure import Failure
from reseau.procedures.calibrated import Calibrated
from reseau.procedures.calibration import calibrate_camera
from reseau.procedures.calibration_options import CameraOptions
from reseau.procedures.exposures import Taken

from .test_assessment import DESIGN, MATRIX, SIZE, calibrated, measured

mpl.use("agg")
RNG = np.random.default_rng(2)
PICTURE = RNG.integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8)


@pytest.fixture(scope="module")
def done() -> Calibrated:
    return calibrated(measured())


@pytest.fixture(scope="module")
def read(done: Calibrated, tmp_path_factory: pytest.TempPathFactory) -> Calibration:
    file = tmp_path_factory.mktemp("calibrated") / "camera.json"
    done.write(file)
    return Calibration.read(file)


@pytest.fixture(autouse=True)
def _close_figures() -> Iterator[None]:
    yield
    import matplotlib.pyplot as plt

    plt.close("all")


def useless(given: Calibration) -> Calibration:
    assert given.assessment is not None
    assessed = given.assessment.model_copy(update={"use": Use.NOTHING, "corners_px": 50.0})
    return given.model_copy(update={"assessment": assessed})


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fresh", "read"])
def test_arrays_of_opencv_project_as_the_calibration_does(
    kind: str, done: Calibrated, read: Calibration
) -> None:
    found: Calibrated | Calibration = done if kind == "fresh" else read
    assert np.abs(found.camera_matrix - MATRIX).max() < 0.1
    uv = RNG.uniform(-0.4, 0.4, (20, 2))
    rays = np.column_stack([uv, np.ones(20)])
    seen = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), found.camera_matrix, found.dist_coeffs)[0][:, 0]
    np.testing.assert_allclose(read.mapping().to_pixels(uv), seen, atol=1e-9)
    covariance = np.asarray(found.covariance)
    sigma = [read.parameters[name].sigma for name in found.covariance.names]
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), sigma)
    assert found.rms == pytest.approx(done.result.rms_px())


def test_residuals_are_a_table_of_points_and_one_of_images(done: Calibrated) -> None:
    points, images = done.residuals(), done.residuals(by="image")
    v = np.column_stack([points["vx_px"], points["vy_px"]])
    assert done.rms == pytest.approx(np.sqrt((v**2).mean()))
    own = np.array(points["image"]) == images["image"][3]
    assert images["rms_px"][3] == pytest.approx(np.sqrt((v[own] ** 2).mean()))
    assert images["largest_px"][3] == pytest.approx(np.hypot(*v[own].T).max())
    assert sum(images["points"]) == len(points)
    assert repr(images).startswith("<Table: 10 images, columns image, camera, ")


def test_an_image_is_undistorted_as_by_opencv(done: Calibrated, read: Calibration) -> None:
    smooth = cv2.GaussianBlur(PICTURE, (0, 0), 6)
    ours = done.undistort(smooth)
    theirs = cv2.undistort(smooth, done.camera_matrix, done.dist_coeffs)
    inside = (slice(20, -20), slice(20, -20))
    assert np.abs(ours[inside].astype(int) - theirs[inside].astype(int)).max() <= 3
    np.testing.assert_array_equal(ours, read.undistort(smooth))
    assert done.undistort(smooth[:, :, 0]).shape == (SIZE[1], SIZE[0])
    with pytest.raises(UsageError, match=r"image: has 400×300 pixels, the calibrated images 800×600"):
        done.undistort(smooth[:300, :400])


def test_two_calibrations_of_a_camera_agree_and_those_of_two_cameras_do_not(
    done: Calibrated, read: Calibration
) -> None:
    assert done.compare(read).greatest_px < 1e-6
    other = calibrated(measured(k2=0.2))
    difference = done.compare(other)
    assert difference.p < 0.01
    assert difference.plot().get_title(loc="left").startswith("difference × ")


def test_a_stored_calibration_is_compared_and_reported_as_a_fresh_one(
    done: Calibrated, read: Calibration, tmp_path: Path
) -> None:
    done.write(tmp_path / "camera.json")
    for found in (done.compare(tmp_path / "camera.json"), read.compare(done), read.compare(read)):
        assert found.greatest_px < 1e-6
    read.report(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text("utf-8")
    assert all(line[1:] in page for line in done.assessments["camera"].lines)
    assert all(text in page for text in read.printed().values())
    first = page.split("<header>")[1].split("</header>")[0]
    assert f"{len(done.measured)} photographs" in first
    assert "the total error of the projection" in first
    with pytest.raises(UsageError, match=r"report\.txt: has the suffix"):
        read.report(tmp_path / "report.txt")
    with pytest.raises(UsageError, match="has no image points"):
        read.residuals()


@pytest.mark.slow
def test_a_model_that_is_led_astray_is_refused_in_words(reference_data: Callable[[str], Path]) -> None:
    case = reference_data("cases") / "newcomer" / "python-no-verdict"
    found = reseau.calibrate(case / "s5", case / "board.json", model="double_sphere")
    assert not found
    assert "the images do not determine fx" in found.reason


def test_a_result_is_pickled_and_copied(done: Calibrated) -> None:
    for again in (pickle.loads(pickle.dumps(done)), copy.deepcopy(done)):
        assert again.assessment == done.assessment
        np.testing.assert_array_equal(again.result.residuals, done.result.residuals)


def test_what_is_usable_for_nothing_is_neither_exported_nor_applied(
    read: Calibration, tmp_path: Path
) -> None:
    bad, file = useless(read), tmp_path / "camera.yml"
    why = r"is not usable: 0\.00\d+ px at the centre, 50 px in the corners; it is not (exported|applied); "
    with pytest.raises(UsageError, match=why):
        bad.export(file, to="opencv")
    assert not file.exists()
    with pytest.raises(UsageError, match=why):
        bad.undistort(PICTURE)
    with pytest.warns(UserWarning, match="is not usable"):
        bad.export(file, to="opencv", anyway=True)
    assert "# camera: not usable: 0.00" in file.read_text("utf-8")
    with pytest.warns(UserWarning, match="is not usable"):
        bad.undistort(PICTURE, anyway=True)
    with pytest.warns(UserWarning, match="has no verdict"):
        read.model_copy(update={"assessment": None}).export(file, to="opencv")


@pytest.mark.slow
def test_a_file_is_written_in_the_format_of_its_suffix(
    done: Calibrated, read: Calibration, tmp_path: Path
) -> None:
    for each in (done, read):
        with pytest.raises(UsageError, match=r"cam\.yml: is not \.json; export\(path, to="):
            each.write(tmp_path / "cam.yml")
    with pytest.raises(UsageError, match=r"has the suffix '\.pdf'; use \.html"):
        done.report(tmp_path / "report.pdf")
    assert not list(tmp_path.iterdir())
    done.report(tmp_path / "report.html")
    assert done.assessment is not None
    assert done.assessment.stated in (tmp_path / "report.html").read_text("utf-8")


def test_a_model_that_is_not_of_opencv_names_the_export(read: Calibration) -> None:
    other = read.model_copy(update={"model": dict(read.model) | {"model": "division"}})
    with pytest.raises(UsageError, match=r"the model division has none .* export\(path, to=\"opencv\"\)"):
        _ = other.camera_matrix


def test_maps_show_the_total_error_and_the_formal_one_beside_it(done: Calibrated, read: Calibration) -> None:
    titles = [axes.get_title(loc="left") for axes in done.plot()]
    assert titles[0].startswith("residuals × ")
    assert f"rms {done.rms:.2g} px" in titles[0]
    assert titles[1:] == ["error of the projection / px", "formal σ of the projection / px"]
    figure: Any = read.plot().figure
    # The other axes are colour bars.
    assert [title for axes in figure.axes if (title := axes.get_title(loc="left"))] == titles[1:]
    assert read.assessment is not None
    assert figure.get_suptitle() == read.assessment.short


@pytest.mark.slow
def test_several_cameras_are_asked_for_by_name(tmp_path: Path) -> None:
    images, taken = list[tuple[str, ImagePoints]](), dict[str, Taken]()
    xyz = np.column_stack([DESIGN.xy * [1, -1], np.zeros(len(DESIGN.xy))])
    for k in range(6):
        turn = cv2.Rodrigues(0.5 * np.array([np.cos(1.3 * k), np.sin(1.3 * k), 0.8 * k]))[0]
        place = np.array([0.0, 0.0, 260.0]) - turn @ xyz.mean(axis=0)
        for camera, shift in (("left", 0.0), ("right", -30.0)):
            seen = cv2.projectPoints(
                xyz, turn, place + np.array([shift, 0, 0]), MATRIX, np.array([-0.2, 0.05, 0, 0])
            )[0]
            xy = seen[:, 0] + RNG.normal(0, 0.01, (len(xyz), 2))
            images.append((f"{camera}{k}", ImagePoints.with_sigma(DESIGN.ids, xy, 0.01)))
            taken[f"{camera}{k}"] = Taken(camera, str(k))
    model = CameraOptions("opencv", ("fx", "fy", "cx", "cy", "k1", "k2"))
    rig = calibrate_camera(
        images, DESIGN, lambda frame: Failure("never"), SIZE, model, taken=taken
    ).required()
    assert np.abs(rig["right"].camera_matrix - MATRIX).max() < 0.5
    with pytest.raises(UsageError, match=r"camera_matrix: .* there are 'left', 'right'; take \['left'\]"):
        _ = rig.camera_matrix
    with pytest.raises(UsageError, match="middle: is not a camera; name one of left, right"):
        _ = rig["middle"]
    with pytest.warns(UserWarning, match="not for precise measurement: "):
        rig.export(tmp_path / "rig.yaml", to="kalibr")
    text = (tmp_path / "rig.yaml").read_text("utf-8")
    assert text.startswith("# left: usable for ")
    assert "; right: usable for " in text
    assert len(rig.plot()) == 6


def test_type_checkers_tell_a_result_from_a_failure_by_its_truth() -> None:
    for each in (Calibrated, Result, Adjusted):
        assert get_type_hints(each.__bool__)["return"] == Literal[True]
    assert get_type_hints(Failure.__bool__)["return"] == Literal[False]
