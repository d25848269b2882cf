"""`reseau calibrate photos/`: without any option, from photographs to a folder of results."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from reseau.calibration import Calibration, CameraMapping
from reseau.designs import board
from reseau.exchange import import_calibration
from reseau.io.images import write_image

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
