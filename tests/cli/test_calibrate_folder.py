"""`reseau calibrate photos/`: without any option, from photographs to a folder of results."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from reseau import calibrate as reseau_calibrate
from reseau.calibration import Calibration, CameraMapping
from reseau.core.errors import InputError
from reseau.designs import board
from reseau.exchange.calibrations.formats import import_calibration
from reseau.io.images import write_image
from reseau.procedures.calibrated import Calibrated
from reseau.procedures.calibration_folder import write_calibrated

from ..measure.board_pictures import picture

Run = Callable[..., tuple[int, str, str]]

VIEWS = ((-30, 0), (30, 10), (-25, 90), (25, 95), (-32, 200), (28, 290))
"""Tilts and turns of a board, degrees."""


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("one-command") / "photos"
    folder.mkdir()
    design = board("charuco", 7, 10, 23.0)
    for k, (tilt, turn) in enumerate(VIEWS):
        write_image(folder / f"{k}.png", picture(design, tilt, turn, 300.0, seed=k)[0].pixels)
    return folder


@pytest.mark.slow
def test_photographs_end_in_a_folder_with_all_that_is_needed(reseau: Run, photos: Path) -> None:
    status, out, err = reseau("calibrate", photos, "--jobs", 1)
    folder = photos.with_name("photos-calibration")
    assert status == 0, err
    assert f"written: {folder}\n" in out
    names = {path.name for path in folder.iterdir()}
    assert {"report.html", "camera.json", "opencv.yml", "ros.yaml", "colmap.txt"} < names
    assert {f"undistorted-{k}.jpg" for k in (0, 2, 5)} < names
    assert all(name in out for name in names)
    lens = Calibration.read(folder / "camera.json").mapping()
    assert isinstance(lens, CameraMapping)
    uv = np.array([[0.1, 0.05], [-0.2, 0.1]])
    for name in ("opencv.yml", "ros.yaml", "colmap.txt"):
        other = import_calibration(folder / name).mapping()
        assert isinstance(other, CameraMapping)
        assert other.mapping(uv) == pytest.approx(lens.mapping(uv), abs=1e-3)
    sample = cv2.imread(str(folder / "undistorted-0.jpg"), cv2.IMREAD_UNCHANGED)
    assert sample is not None
    assert sample.shape == (400, 480)


def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_measured(
    reseau: Run, photos: Path, tmp_path: Path
) -> None:
    (tmp_path / "taken").touch()
    status, out, err = reseau("calibrate", photos, "-o", tmp_path / "taken")
    assert (status, out) == (2, "")
    assert "taken: is a file; give the name of a folder" in err
    status, _, err = reseau("calibrate", photos, "-o", tmp_path / "none" / "results")
    assert status == 2
    assert "results: its folder does not exist; create the folder first" in err
    status, _, err = reseau("calibrate", photos, "-o", tmp_path / "camera.yml")
    assert status == 2
    assert "camera.yml: has the suffix '.yml'; use .json for the calibration alone, or a name without" in err


@pytest.mark.slow
def test_where_nothing_can_be_calibrated_no_folder_is_made(reseau: Run, photos: Path, tmp_path: Path) -> None:
    few = tmp_path / "few"
    few.mkdir()
    shutil.copy(photos / "0.png", few)
    status, _, err = reseau("calibrate", few, "--jobs", 1)
    assert status != 0
    assert "0.png: 1 image (0.png) shows the target, 3 are needed" in err
    assert list(tmp_path.iterdir()) == [few]


@pytest.mark.slow
def test_a_folder_that_cannot_be_completed_is_left_as_it_was(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = calibrated(photos, tmp_path / "copy")

    def full(*_: object, **__: object) -> None:
        raise InputError("cannot be written (No space left on device)", where="opencv.yml")

    monkeypatch.setattr("reseau.procedures.calibration_folder.export_calibration", full)
    with pytest.raises(InputError, match="No space"):
        write_calibrated(tmp_path / "results", done, done.documents(), "page")
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


@pytest.mark.slow
def test_a_report_shows_the_photographs_that_are_still_there(photos: Path, tmp_path: Path) -> None:
    done = calibrated(photos, tmp_path / "copy")
    pictures = []
    for gone in (None, "0.png", "*.png"):
        for path in (tmp_path / "copy").glob(gone or "none"):
            path.unlink()
        done.report(tmp_path / "report.html")
        pictures.append((tmp_path / "report.html").read_text("utf-8").count("data:image/"))
    assert pictures[0] > pictures[1] > pictures[2]


def calibrated(photos: Path, copy: Path) -> Calibrated:
    shutil.copytree(photos, copy)
    return reseau_calibrate(copy).required()
