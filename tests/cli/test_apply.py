"""`reseau apply` with each kind of calibration, on points and on images, against the truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile

from reseau.calibration import Calibration, read_calibration
from reseau.calibration.assessment import Assessment, Use
from reseau.calibration.document import Covariance, Quantity
from reseau.calibration.sensor import Fields, SensorCorrection
from reseau.core.data import Array
from reseau.io import CORNERS
from reseau.io.images import read_image, write_image
from reseau.optics import OpenCV

Run = Callable[..., tuple[int, str, str]]

WIDTH, HEIGHT = 320, 240
LENS = {"fx": 300.0, "fy": 300.0, "cx": 161.0, "cy": 118.0, "k1": -0.25, "k2": 0.06}
LINE_PX = 2.0  # width of a line, one sigma
LINES = (-90.0, -30.0, 30.0, 90.0)  # from the principal point, undistorted pixels


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    """A calibrated camera with strong barrel distortion."""
    calibration = Calibration(
        kind="camera",
        name="lens",
        model={"model": "opencv", "width": WIDTH, "height": HEIGHT, "pitch_mm": [1.0, 1.0]},
        parameters={
            key: Quantity(value=value, sigma=0.1 if key == "fx" else 0.0, unit="px")
            for key, value in LENS.items()
        },
        covariance=Covariance(names=("fx",), matrix=((0.01,),)),
        sigma0=1.0,
        redundancy=50,
        validity={"extent": [60.0, 40.0, 260.0, 200.0], "unit": "px"},
        assessment=Assessment(use=Use.MEASUREMENT, lines=(), centre_px=0.01, corners_px=0.03),
    )
    calibration.write(tmp_path / "cam.json")
    return tmp_path / "cam.json"


def directions() -> Array:
    """Ideal directions of all pixels, (h, w, 2)."""
    x, y = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))
    uv = OpenCV.from_parameters(LENS).inverse(np.column_stack([x.ravel(), y.ravel()]))
    return uv.reshape(HEIGHT, WIDTH, 2)


def photograph(axis: int) -> np.ndarray:
    """Straight lines across one axis, as the camera images them; 16 bit."""
    at = directions()[..., axis] * 300.0
    light = sum(np.exp(-0.5 * ((at - line) / LINE_PX) ** 2) for line in LINES)
    return np.rint(1000 + 60000 * light).astype(np.uint16)


@pytest.mark.parametrize("axis", [0, 1], ids=["columns", "rows"])
def test_straight_lines_are_straight_in_an_undistorted_image(
    camera: Path, tmp_path: Path, reseau: Run, axis: int
) -> None:
    write_image(tmp_path / "photo.tif", photograph(axis))
    out = tmp_path / "flat.tif"
    status, text, err = reseau("apply", camera, tmp_path / "photo.tif", "-o", out, "--json")
    assert (status, err) == (0, "")
    flat = read_image(out).pixels.astype(float) - 1000.0
    found = read_calibration(out.with_suffix(".json"))
    assert found.to_json() == text
    assert (found.model["width"], found.model["height"]) == (WIDTH, HEIGHT)  # type: ignore[typeddict-item]
    centre = found.values()["cx" if axis == 0 else "cy"]
    lines = flat if axis == 0 else flat.T
    for line in LINES:
        place = centre + line
        first = int(place) - 7
        window = lines[20:-20, first : first + 16]
        # Rows in which the line is whole: the image of the distorted one may end.
        whole = window[window.max(axis=1) > 50000]
        assert len(whole) > 150
        centroid = (np.clip(whole, 0, None) @ np.arange(first, first + 16.0)) / np.clip(whole, 0, None).sum(
            axis=1
        )
        assert np.abs(centroid - place).max() < 0.02


def test_points_of_a_camera_agree_with_its_undistorted_image_and_include_both_covariances(
    camera: Path, tmp_path: Path, reseau: Run
) -> None:
    lens = OpenCV.from_parameters(LENS)
    uv = np.array([[0.1, -0.2], [-0.25, 0.1]])
    (x1, y1), (x2, y2) = lens(uv).tolist()
    (tmp_path / "p.csv").write_text(
        f"id,x,y,sx,sy\na,{x1:.9f},{y1:.9f},0.1,0.1\nb,{x2:.9f},{y2:.9f},0.1,0.1\n"
    )
    status, out, err = reseau("apply", camera, tmp_path / "p.csv", "--json")
    assert (status, err) == (0, "")
    found = json.loads(out)
    assert (found["unit"], found["system"]) == ("px", "undistorted")
    assert set(found["points"]) == {"id", "x", "y", "sx", "sy", "rho"}
    np.testing.assert_allclose(found["points"]["x"], uv[:, 0] * 300 + 161, atol=1e-6)
    np.testing.assert_allclose(found["points"]["y"], uv[:, 1] * 300 + 118, atol=1e-6)
    exact = json.loads(reseau("apply", camera, tmp_path / "p.csv", "--directions", "--json")[1])
    assert (exact["unit"], exact["system"]) == ("1", "direction")
    np.testing.assert_allclose(np.transpose([exact["points"]["x"], exact["points"]["y"]]), uv, atol=1e-9)
    # An error of fx by 0.1 px moves u by u·0.1/300 on the axis; distortion changes that little here.
    alone = 0.1 / 300 / lens.derivatives(uv).d_xy[:, 0, 0] * 300
    both = np.hypot(alone, 0.1 * np.abs(uv[:, 0]) / 300)
    np.testing.assert_allclose(exact["points"]["sx"], both, rtol=0.1)


def test_points_outside_the_validity_are_flagged_in_the_output_and_in_a_warning(
    camera: Path, tmp_path: Path, reseau: Run
) -> None:
    (tmp_path / "p.csv").write_text("id,x,y,sx,sy\nin,150,100,0.1,0.1\nfar,310,100,0.1,0.1\n")
    status, out, err = reseau("apply", camera, tmp_path / "p.csv")
    assert status == 0
    head, inside, far = out.splitlines()
    assert head == "id,x,y,sx,sy,ok,why"
    assert inside.endswith(",1,")
    assert far.endswith(
        ",0,lies 25 % of the extent beyond the observations: the correction is unreliable there"
    )
    assert err.startswith("warning: point far lies 25 % of the extent")
    reseau("apply", camera, tmp_path / "p.csv", "-o", tmp_path / "out.json")
    table = json.loads((tmp_path / "out.json").read_text("utf-8"))["points"]
    assert table["ok"] == [True, False]
    assert table["why"][0] == ""


def test_a_photograph_of_another_size_than_photo_i_is_refused(
    calibration: Path, photo: object, tmp_path: Path, reseau: Run
) -> None:
    assert Calibration.read(calibration).validity["size"] == [360, 300]
    write_image(tmp_path / "small.png", np.zeros((100, 120), np.uint8))
    status, _, err = reseau("apply", calibration, tmp_path / "small.png")
    assert status == 2
    assert "the calibrated images 360×300" in err
    # A calibration without a size, as earlier versions wrote it, is applied to what there is.
    content = json.loads(calibration.read_text("utf-8"))
    del content["validity"]["size"]
    (tmp_path / "old.json").write_text(json.dumps(content))
    image = photo.image  # type: ignore[attr-defined]
    assert reseau("apply", tmp_path / "old.json", image, "-o", tmp_path / "c.png")[0] == 0


# Film frames

TURN = np.deg2rad(1.5)
ROTATION = np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])
SPOTS = np.array([[-12.0, 8.0], [0.0, 0.0], [10.0, -7.0]])


def to_scan(mm: Array) -> Array:
    """Pixels of the scan at 10 px/mm, y up in the frame."""
    return np.asarray(mm * [10.0, -10.0] @ ROTATION.T + [205.0, 150.0])


@pytest.fixture
def orientation(tmp_path: Path) -> Path:
    corners = to_scan(np.array([[-18.0, 12.0], [18.0, 12.0], [18.0, -12.0], [-18.0, -12.0]])).tolist()
    spread = {"sx": 0.1, "sy": 0.1, "rho": 0.0}
    content = {
        "schema": "reseau-orientation/1", "image": "scan.tif", "status": "oriented", "why": "",
        "format_mm": [36.0, 24.0], "channel": "red",
        "corners": {name: {"x": x, "y": y} | spread for name, (x, y) in zip(CORNERS, corners, strict=True)},
        "principal_point": {"x": 205.0, "y": 150.0} | spread, "angle_deg": -1.5, "angle_sigma_deg": 0.02,
        "px_per_mm": [10.0, 10.0], "edges": {},
    }  # fmt: skip
    (tmp_path / "scan.json").write_text(json.dumps(content))
    return tmp_path / "scan.json"


def test_a_film_frame_is_resampled_to_millimetres_in_its_colours(
    orientation: Path, tmp_path: Path, reseau: Run
) -> None:
    x, y = np.meshgrid(np.arange(410.0), np.arange(300.0))
    spots = sum(np.exp(-0.5 * ((x - a) ** 2 + (y - b) ** 2) / 3.0**2) for a, b in to_scan(SPOTS))
    red = np.rint(200 * spots).astype(np.uint8)
    colours = np.stack([red, np.full_like(red, 50), 200 - red], axis=-1)
    tifffile.imwrite(tmp_path / "scan.tif", colours, photometric="rgb")
    out = tmp_path / "frame.tif"
    status, text, _ = reseau("apply", orientation, tmp_path / "scan.tif", "-o", out, "--scale", 8, "--json")
    assert status == 0
    raster, found = json.loads(text), tifffile.imread(out)
    assert (raster["unit"], raster["y"], raster["px_per_unit"]) == ("mm", "up", 8.0)
    assert found.shape == (raster["height"], raster["width"], 3)
    assert found[..., 1].min() == found[..., 1].max() == 50
    for spot in SPOTS:
        at = (spot - raster["first_pixel"]) * [8, -8]
        column, row = np.rint(at).astype(int)
        window = found[row - 12 : row + 13, column - 12 : column + 13, 0].astype(float)
        offset = np.arange(-12.0, 13.0)
        centroid = np.array([(window * offset).sum(), (window * offset[:, None]).sum()]) / window.sum()
        np.testing.assert_allclose(centroid + np.array([column, row]), at, atol=0.02)
    with tifffile.TiffFile(out) as tiff:
        numerator, denominator = tiff.pages.first.tags["XResolution"].value
    assert numerator / denominator == pytest.approx(80.0)  # pixels per centimetre


def test_points_of_a_scan_become_photo_coordinates(orientation: Path, tmp_path: Path, reseau: Run) -> None:
    lines = [f"{k},{x:.6f},{y:.6f},0.1,0.1" for k, (x, y) in enumerate(to_scan(SPOTS))]
    (tmp_path / "p.csv").write_text("\n".join(["id,x,y,sx,sy", *lines, "out,-40,-40,0.1,0.1"]) + "\n")
    status, out, err = reseau("apply", orientation, tmp_path / "p.csv", "--json")
    assert status == 0
    assert "point out lies" in err
    assert "beyond the frame: the correction is unreliable there" in err
    found = json.loads(out)
    assert (found["unit"], found["system"]) == ("mm", "photo")
    table = found["points"]
    np.testing.assert_allclose(np.transpose([table["x"], table["y"]])[:3], SPOTS, atol=1e-6)
    # 0.1 px are 0.01 mm; the corners add to that.
    assert all(0.01 < s < 0.03 for s in table["sx"][:3])


def test_a_scan_that_does_not_contain_the_frame_is_refused(
    orientation: Path, tmp_path: Path, reseau: Run
) -> None:
    write_image(tmp_path / "small.png", np.zeros((60, 80), np.uint8))
    status, _, err = reseau("apply", orientation, tmp_path / "small.png")
    assert status == 2
    assert "does not contain the frame; use the scan that was oriented" in err


# Sensors


@pytest.fixture
def sensor(tmp_path: Path) -> Path:
    """A sensor with bias, shading and one dead pixel; written with the kind of earlier versions."""
    y, x = np.mgrid[0:30, 0:40].astype(np.float32)
    bias, response = 8 + 0.1 * x, 1 + 0.005 * (y - 14.5)
    defects = np.zeros((30, 40), dtype=bool)
    defects[10, 20] = True
    fields = Fields(bias, 0 * bias, response.astype(np.float32), defects)
    correction = SensorCorrection(fields, 0.0, 0.0, 255.0, 1000.0)
    content = {
        "schema": "reseau-calibration/1", "kind": "camera", "name": "sensor", "model": correction.to_model(),
        "parameters": {}, "covariance": {"names": [], "matrix": []}, "sigma0": None, "redundancy": 0,
    }  # fmt: skip
    (tmp_path / "sensor.json").write_text(json.dumps(content))
    light = 100 * response
    write_image(tmp_path / "frame.png", np.rint(bias + np.where(defects, 0, light)).astype(np.uint8))
    return tmp_path / "sensor.json"


def test_a_frame_is_corrected_for_its_sensor(sensor: Path, tmp_path: Path, reseau: Run) -> None:
    assert reseau("apply", sensor, tmp_path / "frame.png", "-o", tmp_path / "c.tif")[0] == 0
    flat = tifffile.imread(tmp_path / "c.tif")
    assert flat.dtype == np.float32
    # Grey values were rounded: half a unit over a response of at least 0.92.
    assert np.abs(flat - 100).max() < 0.6
    status, out, _ = reseau("apply", sensor, tmp_path / "frame.png", "-o", tmp_path / "c.png", "--json")
    assert status == 0
    step = json.loads(out)["dn_per_step"]
    assert np.abs(read_image(tmp_path / "c.png").pixels * step - flat).max() <= step


def test_a_sensor_refuses_points_and_other_sizes(sensor: Path, tmp_path: Path, reseau: Run) -> None:
    (tmp_path / "p.csv").write_text("id,x,y\na,1,1\n")
    write_image(tmp_path / "large.png", np.zeros((50, 50), np.uint8))
    for source, message in (("p.csv", "corrects images, not points"), ("large.png", "has 50×50 pixels")):
        status, _, err = reseau("apply", sensor, tmp_path / source)
        assert status == 2
        assert message in err
        assert err.count("\n") == 1
