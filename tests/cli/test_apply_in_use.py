"""`reseau apply` in use: folders, videos, tables for other programs, and points in both directions."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from reseau.calibration import Calibration
from reseau.calibration.assessment import Assessment, Use
from reseau.calibration.document import Covariance, Quantity

Run = Callable[..., tuple[int, str, str]]

VALUES = {"fx": 210.0, "fy": 209.0, "cx": 82.0, "cy": 57.5, "k1": -0.2, "k2": 0.05}
MATRIX = np.array([[210.0, 0, 82.0], [0, 209.0, 57.5], [0, 0, 1]])
DISTORTION = np.array([-0.2, 0.05, 0, 0])
SIZE = (160, 120)


def camera(model: str, values: dict[str, float], size: tuple[int, int]) -> Calibration:
    """A camera with an uncertain fx."""
    return Calibration(
        kind="camera", name="lens", sigma0=1.0, redundancy=9,
        model={"model": model, "width": size[0], "height": size[1], "pitch_mm": [1.0, 1.0]},
        parameters={
            k: Quantity(value=v, sigma=0.1 if k == "fx" else 0.0, unit="px" if k[0] in "fc" else "")
            for k, v in values.items()
        },
        covariance=Covariance(names=("fx",), matrix=((0.01,),)),
        assessment=Assessment(use=Use.MEASUREMENT, lines=(), centre_px=0.01, corners_px=0.03),
    )  # fmt: skip


@pytest.fixture
def lens(tmp_path: Path) -> Path:
    camera("opencv", VALUES, SIZE).write(tmp_path / "lens.json")
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
    assert reseau("apply", lens, "--tables", tmp_path / "maps.npz", "--opencv-alpha", alpha)[0] == 0
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
    status, said, _ = reseau("apply", lens, "--tables", tmp_path / "m.pgm")
    assert status == 0
    names = {"video.mp4": str(tmp_path / "in.png"), "undistorted.mp4": str(tmp_path / "out.png")}
    command = [names.get(word, word) for word in said.splitlines()[-1].split()]
    assert command.count("image2") == 2  # the contents of some tables look like other formats
    subprocess.run(["ffmpeg", "-v", "error", *command[1:]], check=True)
    new = cv2.imread(str(tmp_path / "out.png"), cv2.IMREAD_GRAYSCALE).astype(float)
    own = cv2.undistort(scene(), MATRIX, DISTORTION)
    # Whole pixels: the slope of the scene is at most 7 grey values in a pixel.
    assert np.abs(new[8:-8, 8:-8] - own[8:-8, 8:-8]).max() < 9


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
def test_frames_of_a_video_are_those_of_the_sensor_whatever_players_turn(
    reseau: Run, lens: Path, tmp_path: Path
) -> None:
    cv2.imwrite(str(tmp_path / "in.png"), scene())
    for given, name, how in (
        ("in.png", "plain.mov", ["-c:v", "mjpeg", "-q:v", "2"]),
        ("plain.mov", "turned.mov", ["-c", "copy", "-metadata:s:v", "rotate=180"]),
    ):
        command = ["ffmpeg", "-v", "error", "-i", str(tmp_path / given), *how, str(tmp_path / name)]
        subprocess.run(command, check=True)
        assert reseau("apply", lens, tmp_path / name, "-o", tmp_path / f"{name}.avi")[0] == 0
    played = cv2.VideoCapture(str(tmp_path / "turned.mov")).read()[1]
    assert np.abs(played[::-1, ::-1, 0].astype(float) - scene())[8:-8, 8:-8].mean() < 4
    plain, turned = (cv2.VideoCapture(str(tmp_path / f"{n}.mov.avi")).read()[1] for n in ("plain", "turned"))
    assert np.array_equal(plain, turned)


def test_no_input_is_written_over(reseau: Run, lens: Path, tmp_path: Path) -> None:
    photograph, video = tmp_path / "p.png", tmp_path / "v.avi"
    cv2.imwrite(str(photograph), scene())
    written = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10, SIZE)
    written.write(cv2.cvtColor(scene(), cv2.COLOR_GRAY2BGR))
    written.release()
    (tmp_path / "p.csv").write_text("id,x,y\na,20.5,30.25\n")
    beside = lens.with_suffix(".png")  # the camera of the undistorted image would be the calibration
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for source, out in ((photograph, photograph), (video, video), (tmp_path / "p.csv", tmp_path / "p.csv"),
                        (photograph, beside), (tmp_path / "p.csv", lens)):  # fmt: skip
        status, _, err = reseau("apply", lens, source, "-o", out)
        assert status == 2
        assert "is an input of this command; choose another name" in err
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_folder_of_which_no_image_can_be_corrected_is_an_error(
    reseau: Run, lens: Path, tmp_path: Path
) -> None:
    (tmp_path / "photos").mkdir()
    cv2.imwrite(str(tmp_path / "photos" / "a.png"), np.zeros((50, 60), np.uint8))
    status, out, err = reseau("apply", lens, tmp_path / "photos")
    assert (status, out) == (2, "")
    assert "left out: " in err
    assert "none of its 1 images could be corrected" in err


def test_points_outside_the_validity_come_back_too(reseau: Run, tmp_path: Path) -> None:
    lens = tmp_path / "wide.json"
    camera("fisheye", {"fx": 80.0, "fy": 80.0, "cx": 79.5, "cy": 59.5}, SIZE).write(lens)
    (tmp_path / "p.csv").write_text("id,x,y,sx,sy\na,20.5,30.25,0.1,0.1\nb,-1,-2,0.1,0.1\nc,9e5,9e5,1,1\n")
    assert reseau("apply", lens, tmp_path / "p.csv", "-o", tmp_path / "flat.csv")[0] == 0
    head, *rows = (tmp_path / "flat.csv").read_text().splitlines()
    assert head == "id,x,y,sx,sy,ok,why"
    assert "nan" in rows[-1]
    assert reseau("apply", lens, tmp_path / "flat.csv", "-o", tmp_path / "q.csv", "--inverse")[0] == 0
    found = {
        row[0]: row[1:3] for row in (r.split(",") for r in (tmp_path / "q.csv").read_text().splitlines())
    }
    assert np.array([found["a"], found["b"]], float) == pytest.approx(
        np.array([[20.5, 30.25], [-1, -2]]), abs=2e-5
    )
    assert "c" not in found


def test_points_with_covariances_come_back_from_their_own_undistorted_image_only(
    reseau: Run, lens: Path, tmp_path: Path
) -> None:
    (tmp_path / "p.csv").write_text("id,x,y,sx,sy\na,20.5,30.25,0.1,0.1\nb,140,100,0.1,0.1\n")
    flat, back = tmp_path / "flat.json", tmp_path / "q.json"
    assert reseau("apply", lens, tmp_path / "p.csv", "-o", flat, "--fov", "40")[0] == 0
    assert reseau("apply", lens, flat, "-o", back, "--inverse", "--fov", "40")[0] == 0
    there, here = (json.loads(path.read_text())["points"] for path in (flat, back))
    assert here["x"] == pytest.approx([20.5, 140.0], abs=1e-6)
    assert here["y"] == pytest.approx([30.25, 100.0], abs=1e-6)
    assert abs(there["rho"][0]) > 1e-3
    # By the derivatives of OpenCV's projection, with the covariance of the points and that of fx.
    camera = json.loads(flat.read_text())["camera"]
    ideal = [(there["x"][0] - camera["cx"]) / camera["fx"], (there["y"][0] - camera["cy"]) / camera["fy"]]
    step = np.eye(2) * 1e-5

    def seen(uv: np.ndarray, fx: float = 210.0) -> np.ndarray:  # type: ignore[type-arg]
        matrix = MATRIX.copy()
        matrix[0, 0] = fx
        point = np.array([[*uv, 1.0]])
        return cv2.projectPoints(point, np.zeros(3), np.zeros(3), matrix, DISTORTION)[0][0, 0]

    slope = np.stack([(seen(ideal + s) - seen(ideal - s)) / 2e-5 for s in step], axis=1)
    slope = slope / [camera["fx"], camera["fy"]]
    of_fx = (seen(np.array(ideal), 210.5) - seen(np.array(ideal), 209.5)) * 0.1
    sx, sy, rho = (there[key][0] for key in ("sx", "sy", "rho"))
    cov = slope @ [[sx * sx, rho * sx * sy], [rho * sx * sy, sy * sy]] @ slope.T + np.outer(of_fx, of_fx)
    own = [here["sx"][0], here["sy"][0], here["rho"][0]]
    sigma = np.sqrt(np.diag(cov))
    assert own == pytest.approx([*sigma, cov[0, 1] / sigma.prod()], rel=1e-3, abs=1e-4)
    status, _, err = reseau("apply", lens, flat, "--inverse")
    assert status == 2
    assert "has points of another undistorted image; repeat --fov" in err
    status, _, err = reseau("apply", lens, flat)
    assert status == 2
    assert "has points of the system undistorted, not image" in err
    flat.write_text('{"schema": "reseau-points/1", "system": "image"}')
    assert "is not a complete reseau-points/1" in reseau("apply", lens, flat)[2]


def test_the_whole_field_of_a_fisheye_is_declined_with_what_to_do(reseau: Run, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((240, 320), np.uint8))
    for f in (80.0, 127.01):  # directions beyond 90°, and one of 90°, which is too far out
        wide = camera("fisheye", {"fx": f, "fy": f, "cx": 159.5, "cy": 119.5}, (320, 240))
        wide.write(tmp_path / "wide.json")
        status, _, err = reseau("apply", tmp_path / "wide.json", tmp_path / "a.png", "--fov", "all")
        assert status == 2
    assert "more than a plane image can show of this lens; give an angle" in err


@pytest.mark.parametrize("options", [(), ("--directions",), ("--opencv-alpha", "0.5")])
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
