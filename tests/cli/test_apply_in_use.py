"""`reseau apply` in use: folders, videos, tables for other programs, and points in both directions."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from reseau.calibration import Calibration
from reseau.calibration.document import Covariance, Quantity

Run = Callable[..., tuple[int, str, str]]

VALUES = {"fx": 210.0, "fy": 209.0, "cx": 82.0, "cy": 57.5, "k1": -0.2, "k2": 0.05}
MATRIX = np.array([[210.0, 0, 82.0], [0, 209.0, 57.5], [0, 0, 1]])
DISTORTION = np.array([-0.2, 0.05, 0, 0])
SIZE = (160, 120)


@pytest.fixture
def lens(tmp_path: Path) -> Path:
    """A camera with an uncertain fx."""
    Calibration(
        kind="camera", name="lens", sigma0=1.0, redundancy=9,
        model={"model": "opencv", "width": SIZE[0], "height": SIZE[1], "pitch_mm": [1.0, 1.0]},
        parameters={
            k: Quantity(value=v, sigma=0.1 if k == "fx" else 0.0, unit="px" if k[0] in "fc" else "")
            for k, v in VALUES.items()
        },
        covariance=Covariance(names=("fx",), matrix=((0.01,),)),
    ).write(tmp_path / "lens.json")  # fmt: skip
    return tmp_path / "lens.json"


def scene() -> np.ndarray:  # type: ignore[type-arg]
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    return (128 + 60 * np.sin(x / 9.0) * np.cos(y / 7.0)).astype(np.uint8)


def test_a_folder_is_undistorted_and_a_broken_image_costs_one_line(
    reseau: Run, lens: Path, tmp_path: Path
) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(photos / name), scene())
    cv2.imwrite(str(photos / "small.png"), scene()[:50])
    (photos / "c.png").write_bytes(b"no image")
    status, _, err = reseau("apply", lens, photos, "--out", tmp_path / "flat")
    assert status == 0
    assert sorted(path.name for path in (tmp_path / "flat").glob("*.png")) == ["a.png", "b.png"]
    assert err.count("left out: ") == 2
    assert err.count("\n") == 2
    new = cv2.imread(str(tmp_path / "flat" / "a.png"), cv2.IMREAD_GRAYSCALE)
    own = cv2.undistort(scene(), MATRIX, DISTORTION)
    assert np.abs(new[5:-5, 5:-5].astype(float) - own[5:-5, 5:-5]).max() < 4


def test_tables_are_those_of_opencv(reseau: Run, lens: Path, tmp_path: Path) -> None:
    for suffix in ("npz", "yml"):
        assert reseau("apply", lens, "--tables", tmp_path / f"maps.{suffix}")[0] == 0
    maps = np.load(tmp_path / "maps.npz")
    x, y = cv2.initUndistortRectifyMap(MATRIX, DISTORTION, np.eye(3), MATRIX, SIZE, cv2.CV_32FC1)
    assert np.abs(maps["map_x"] - x).max() < 1e-3
    assert np.abs(maps["map_y"] - y).max() < 1e-3
    storage = cv2.FileStorage(str(tmp_path / "maps.yml"), cv2.FILE_STORAGE_READ)
    assert np.array_equal(storage.getNode("map_x").mat(), maps["map_x"])


@pytest.mark.parametrize("alpha", [0.0, 0.4, 1.0])
def test_alpha_shows_as_much_as_opencv_does(reseau: Run, lens: Path, tmp_path: Path, alpha: float) -> None:
    """OpenCV takes nine places along each side and their rectangle, we take 33: within a pixel."""
    assert reseau("apply", lens, "--tables", tmp_path / "maps.npz", "--alpha", alpha)[0] == 0
    matrix, _ = cv2.getOptimalNewCameraMatrix(MATRIX, DISTORTION, SIZE, alpha)
    x, y = cv2.initUndistortRectifyMap(MATRIX, DISTORTION, np.eye(3), matrix, SIZE, cv2.CV_32FC1)
    maps = np.load(tmp_path / "maps.npz")
    assert np.hypot(maps["map_x"] - x, maps["map_y"] - y).max() < 1.5
    inside = (maps["map_x"] >= -0.6) & (maps["map_y"] >= -0.6)
    inside &= (maps["map_x"] < SIZE[0]) & (maps["map_y"] < SIZE[1])
    if alpha == 0:
        assert inside.all()


def test_a_video_is_undistorted(reseau: Run, lens: Path, tmp_path: Path) -> None:
    video = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, SIZE)
    for _ in range(5):
        video.write(cv2.cvtColor(scene(), cv2.COLOR_GRAY2BGR))
    video.release()
    status, out, err = reseau("apply", lens, tmp_path / "v.avi")
    assert (status, err) == (0, "")
    assert out.endswith("v-undistorted.avi: 5 frames of 160 × 120 px\n")
    found = cv2.VideoCapture(str(tmp_path / "v-undistorted.avi"))
    good, frame = found.read()
    assert good
    _, before = cv2.VideoCapture(str(tmp_path / "v.avi")).read()
    own = cv2.undistort(before, MATRIX, DISTORTION)
    assert np.abs(frame[8:-8, 8:-8].astype(float) - own[8:-8, 8:-8]).mean() < 4  # Motion JPEG, twice
    (tmp_path / "bad.mp4").write_bytes(b"no video")
    status, out, err = reseau("apply", lens, tmp_path / "bad.mp4")
    assert (status, out) == (2, "")
    assert "bad.mp4: is no video" in err
    assert not (tmp_path / "bad-undistorted.mp4").exists()


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
def test_ffmpeg_undistorts_with_the_tables(reseau: Run, lens: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "in.png"), scene())
    assert reseau("apply", lens, "--tables", tmp_path / "m.pgm")[0] == 0
    files = ("in.png", "m-x.pgm", "m-y.pgm")
    inputs = [word for name in files for word in ("-i", str(tmp_path / name))]
    command = ["ffmpeg", "-v", "error", *inputs, "-lavfi", "remap", str(tmp_path / "out.png")]
    subprocess.run(command, check=True)
    new = cv2.imread(str(tmp_path / "out.png"), cv2.IMREAD_GRAYSCALE).astype(float)
    own = cv2.undistort(scene(), MATRIX, DISTORTION)
    # Whole pixels: the slope of the scene is at most 7 grey values in a pixel.
    assert np.abs(new[8:-8, 8:-8] - own[8:-8, 8:-8]).max() < 9


@pytest.mark.parametrize("options", [(), ("--directions",), ("--alpha", "0.5")])
def test_points_come_back_from_the_other_direction(
    reseau: Run, lens: Path, tmp_path: Path, options: tuple[str, ...]
) -> None:
    (tmp_path / "p.csv").write_text("id,x,y,sx,sy\na,20.5,30.25,0.1,0.1\nb,140,100,0.1,0.1\n")
    assert reseau("apply", lens, tmp_path / "p.csv", "-o", tmp_path / "flat.csv", *options)[0] == 0
    back = ("apply", lens, tmp_path / "flat.csv", "-o", tmp_path / "q.csv", "--inverse", *options)
    assert reseau(*back)[0] == 0
    rows = [line.split(",") for line in (tmp_path / "q.csv").read_text().splitlines()]
    found = np.array([[float(v) for v in row[1:5]] for row in rows[1:]])
    assert found[:, :2] == pytest.approx(np.array([[20.5, 30.25], [140, 100]]), abs=2e-5)
    # The calibration is uncertain in both directions: more than what was measured, by its sigma in x.
    far = np.abs(found[:, 0] - 82.0) * 0.1 / 210.0
    assert found[:, 2] == pytest.approx(np.sqrt(0.1**2 + 2 * far**2), rel=0.05)


def test_options_of_cameras_are_refused_elsewhere(reseau: Run, lens: Path, tmp_path: Path) -> None:
    status, _, err = reseau("apply", lens)
    assert status == 2
    assert "SOURCE: is missing" in err
    status, _, err = reseau("apply", lens, "--tables", tmp_path / "t.png")
    assert status == 2
    assert "use .npz" in err
