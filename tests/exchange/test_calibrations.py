"""Calibrations of cameras in the files of other programs: written, read, and read by these programs."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy
import yaml

from reseau.calibration import Calibration
from reseau.calibration.document import Covariance, Place, Quantity
from reseau.core.data import Array
from reseau.core.errors import FormatError, UsageError
from reseau.exchange import export_calibration
from reseau.exchange.calibrations import calibration_formats
from reseau.exchange.calibrations.formats import export_rig, import_calibration
from reseau.optics.cameras.registry import unit_of
from reseau.optics.poses import rotation_matrix

SIZE = (1280, 960)
CENTRE = {"fx": 1010.0, "fy": 1008.0, "cx": 652.3, "cy": 470.8}
PLAIN = CENTRE | {"k1": -0.21, "k2": 0.07, "p1": 8e-4, "p2": -6e-4}
CAMERAS = {
    "radial": ("opencv", PLAIN),
    "five": ("opencv", PLAIN | {"k3": -0.01}),
    "rational": ("opencv", PLAIN | {"k3": 0.02, "k4": 0.05, "k5": 0.01, "k6": 0.004}),
    "prism": (
        "opencv_full",
        PLAIN | {"k3": 0.02, "k4": 0.05, "s1": 1e-3, "s2": 2e-4, "s3": -7e-4, "s4": 1e-4},
    ),
    "tilted": ("opencv_full", PLAIN | {"tau_x": 0.02, "tau_y": -0.01}),
    "fisheye": ("fisheye", CENTRE | {"k1": 0.03, "k2": -0.004, "k3": 1e-3, "k4": -2e-4}),
    "omni": ("omni", CENTRE | {"fx": 1700.0, "fy": 1698.0, "xi": 0.7, "k1": -0.08, "k2": 0.03}),
    "photo": ("brown", {"c": 8.1, "x0": 0.05, "y0": -0.08, "K1": 3e-3, "K2": -2e-5, "P1": 9e-5, "P2": -5e-5}),
    "tracking": (
        "openptv",
        {"c": 8.1, "x0": 0.05, "y0": -0.08, "K1": -3e-3, "P2": 4e-5, "B1": 2e-4, "she": 1e-4},
    ),
    "ellipsoid": ("eucm", CENTRE | {"alpha": 0.6, "beta": 1.1}),
    "spheres": ("double_sphere", CENTRE | {"xi": -0.2, "alpha": 0.56}),
}
# Which cameras each format holds without conversion.
HELD = {
    "opencv": ("radial", "five", "rational", "prism", "tilted", "fisheye"),
    "ros": ("radial", "five", "rational", "fisheye"),
    "kalibr": ("radial", "fisheye", "omni", "spheres", "ellipsoid"),
    "basalt": ("radial", "five", "rational", "fisheye", "spheres", "ellipsoid"),
    "colmap": ("radial", "rational", "fisheye"),
    "mrcal": ("radial", "five", "rational", "prism"),
    "metashape": ("radial", "five", "fisheye"),
    "photomodeler": ("photo",),
    "dbat": ("photo",),
    "matlab": ("radial", "five"),
    "openptv": ("tracking",),
}
PITCH = {"brown": [0.008, 0.0081], "openptv": [0.008, 0.0081]}
MRCALS = "/usr/bin/python3"
"""The Python that has Debian's mrcal."""
PAIRS = [(form, camera) for form, cameras in HELD.items() for camera in cameras]


def calibration(camera: str) -> Calibration:
    model, values = CAMERAS[camera]
    return Calibration(
        kind="camera", name=camera, sigma0=None, redundancy=0, covariance=Covariance(names=(), matrix=()),
        model={
            "model": model, "width": SIZE[0], "height": SIZE[1], "pitch_mm": PITCH.get(model, [1.0, 1.0]),
            **({"side": "image", "balance_radius_mm": 0.0} if model == "brown" else {}),
        },
        parameters={k: Quantity(value=v, sigma=0.0, unit=unit_of(k, model)) for k, v in values.items()},
    )  # fmt: skip


def file(folder: Path, form: str) -> Path:
    return folder / f"camera{calibration_formats()[form].suffixes[0]}"


def directions() -> Array:
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.4, 0.4, 7))
    return np.stack([u.ravel(), v.ravel()], axis=1)


def projected(found: Calibration) -> Array:
    mapping = found.mapping()
    return mapping.to_pixels(directions())  # type: ignore[attr-defined, no-any-return]


@pytest.mark.parametrize(("form", "camera"), PAIRS)
def test_a_camera_that_a_format_holds_comes_back_unchanged(form: str, camera: str, tmp_path: Path) -> None:
    given, path = calibration(camera), file(tmp_path, form)
    done = export_calibration(given, form, path)
    assert (done.rms_px, done.greatest_px) == (0.0, 0.0)
    again = import_calibration(path)
    assert again.model["model"] == CAMERAS[camera][0]  # type: ignore[typeddict-item]
    assert np.abs(projected(again) - projected(given)).max() < 1e-9
    assert again.provenance["inputs"].keys() == {path.name}


@pytest.mark.parametrize(
    ("form", "camera", "off"),
    [
        ("metashape", "rational", 0.05),
        ("matlab", "prism", 1.5),
        ("ros", "tilted", 9.0),
        ("mrcal", "fisheye", 0.05),
        ("photomodeler", "radial", 0.7),
        ("dbat", "radial", 0.7),
        ("openptv", "radial", 1.5),
        ("openptv", "photo", 0.9),
        ("opencv", "photo", 0.1),
    ],
)
def test_a_model_that_a_format_lacks_is_converted_with_its_differences(
    form: str, camera: str, off: float, tmp_path: Path
) -> None:
    given, path = calibration(camera), file(tmp_path, form)
    done = export_calibration(given, form, path)
    assert 0 < done.rms_px <= done.greatest_px < off
    again = import_calibration(path)
    inside = (np.abs(projected(given) - np.array(SIZE) / 2) < np.array(SIZE) / 2).all(axis=1)
    difference = np.linalg.norm(projected(again) - projected(given), axis=1)
    assert difference[inside].max() < 1.1 * done.greatest_px


def basalt(kind: str, **intrinsics: float) -> str:
    cameras = [
        {"camera_type": kind, "intrinsics": {"fx": 194.3, "fy": 194.2, "cx": 251.8, "cy": 191.7} | intrinsics}
    ]
    content = {"T_imu_cam": [], "intrinsics": cameras * 2, "resolution": [[512, 384]] * 2, "vignette": []}
    return json.dumps({"value0": content})


@pytest.mark.parametrize(
    ("kind", "values", "plane"),
    [
        ("pinhole", {}, (0.5, 0.4)),
        # x/z (1 + k1 r² + …)/(1 + k4 r² + …), with r² = 0.41.
        ("pinhole-radtan8", {"k1": 0.3, "k4": 0.5, "rpmax": 2.7, "k2": 0.0, "k3": 0.0, "k5": 0.0, "k6": 0.0,
                             "p1": 0.0, "p2": 0.0}, (0.5 * 1.123 / 1.205, 0.4 * 1.123 / 1.205)),
        # x/(α√(β(x² + y²) + z²) + (1 − α)z), with β = 1 and 0.9.
        ("ucm", {"alpha": 0.7}, (0.5 / (0.7 * 1.41**0.5 + 0.3), 0.4 / (0.7 * 1.41**0.5 + 0.3))),
        ("eucm", {"alpha": 0.7, "beta": 0.9},
         (0.5 / (0.7 * 1.369**0.5 + 0.3), 0.4 / (0.7 * 1.369**0.5 + 0.3))),
    ],
)  # fmt: skip
def test_cameras_of_basalt_project_as_their_formulas(
    kind: str, values: dict[str, float], plane: tuple[float, float], tmp_path: Path
) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(basalt(kind, **values))
    mapping = import_calibration(path).mapping()
    expected = np.array(plane) * [194.3, 194.2] + [251.8, 191.7]
    np.testing.assert_allclose(mapping.to_pixels([[0.5, 0.4]])[0], expected, rtol=0, atol=1e-9)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (basalt("fov", w=0.9), "camera type 'fov'; known are pinhole"),
        (basalt("ds", xi=-0.2), "not all of fx, fy, cx, cy, xi, alpha"),
        (basalt("pinhole").replace("512", "[]"), "no complete intrinsics and resolution"),
    ],
)
def test_a_calibration_of_basalt_that_is_incomplete_is_refused(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(text)
    with pytest.raises(FormatError, match=said):
        import_calibration(path)


@pytest.mark.parametrize("number", ["-" * 100_000, "[" * 100_000, "1e999"])
def test_a_file_of_mrcal_that_no_parser_can_take_is_refused(tmp_path: Path, number: str) -> None:
    path = tmp_path / "c.cameramodel"
    path.write_text(f"{{'lensmodel': 'LENSMODEL_OPENCV8', 'intrinsics': [], 'imagersize': [{number}, 1]}}")
    with pytest.raises(FormatError, match="no complete lensmodel"):
        import_calibration(path)


@pytest.mark.parametrize("form", ["opencv", "kalibr", "mrcal", "dbat"])
def test_a_camera_with_parallel_rays_is_refused_by_the_name_of_the_format(form: str, tmp_path: Path) -> None:
    given = calibration("photo")
    model = given.model | {"model": "telecentric", "side": "object"}
    values = {"m": 0.2, "x0": 0.0, "y0": 0.0}
    parameters = {k: Quantity(value=v, sigma=0.0, unit=unit_of(k, "telecentric")) for k, v in values.items()}
    given = given.model_copy(update={"model": model, "parameters": parameters})
    with pytest.raises(UsageError, match=f"as {form}: its rays are parallel, which no model of the format"):
        export_calibration(given, form, file(tmp_path, form))
    assert not file(tmp_path, form).exists()


WIDE = CENTRE | {"fx": 500.0, "fy": 503.0, "k1": 0.03, "k2": -0.004, "k3": 1e-3, "k4": -2e-4}


def wide() -> Calibration:
    """A fisheye of 150° along the rows."""
    given = calibration("fisheye")
    values = {
        key: Quantity(value=value, sigma=0.0, unit=unit_of(key, "fisheye")) for key, value in WIDE.items()
    }
    return given.model_copy(update={"parameters": given.parameters | values})


def over_the_image(given: Calibration) -> tuple[Array, Array]:
    """Pixels over the image, and their directions."""
    x, y = np.meshgrid(np.linspace(0, SIZE[0] - 1, 60), np.linspace(0, SIZE[1] - 1, 45))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    return pixels, given.mapping().mapping.inverse(pixels)  # type: ignore[attr-defined]


def test_the_largest_difference_of_a_fisheye_in_a_polynomial_is_that_between_the_points_of_the_fit(
    tmp_path: Path,
) -> None:
    done = export_calibration(wide(), "photomodeler", file(tmp_path, "photomodeler"))
    assert done.greatest_px > 1
    again = import_calibration(file(tmp_path, "photomodeler"))
    pixels, uv = over_the_image(wide())
    difference = again.mapping().to_pixels(uv) - pixels  # type: ignore[attr-defined]
    assert np.linalg.norm(difference, axis=1).max() < 1.05 * done.greatest_px


@pytest.mark.slow
def test_a_fisheye_is_a_spline_surface_for_mrcal(tmp_path: Path) -> None:
    path = file(tmp_path, "mrcal")
    done = export_calibration(wide(), "mrcal", path)
    assert "LENSMODEL_SPLINED_STEREOGRAPHIC" in path.read_text()
    assert done.rms_px < 1e-3
    assert done.greatest_px < 0.02
    pixels, uv = over_the_image(wide())
    again = import_calibration(path).mapping().to_pixels(uv)  # type: ignore[attr-defined]
    assert np.abs(again - pixels).max() < 1.05 * done.greatest_px
    need_mrcal()
    assert np.abs(by_mrcal(path, uv, tmp_path) - pixels).max() < 1.05 * done.greatest_px


@pytest.mark.parametrize("form", ["openptv", "matlab"])
def test_a_fisheye_is_not_written_where_no_model_is_near(form: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=f"cannot be written as {form}.*use one of opencv, ros"):
        export_calibration(wide(), form, file(tmp_path, form))
    assert not list(tmp_path.iterdir())


def test_metashape_has_fisheyes_by_the_formula_of_its_manual(tmp_path: Path) -> None:
    path = file(tmp_path, "metashape")
    export_calibration(wide(), "metashape", path)
    text = path.read_text()
    assert "<projection>fisheye</projection>" in text
    number = {
        name: float(text.split(f"<{name}>")[1].split("<")[0])
        for name in ("width", "height", "f", "cx", "cy", "b1", "k1", "k2", "k3", "k4")
    }
    pixels, uv = over_the_image(wide())
    r = np.hypot(*uv.T)
    x, y = (uv * (np.arctan(r) / r)[:, None]).T
    r2 = x * x + y * y
    bend = 1 + sum(number[f"k{i}"] * r2**i for i in range(1, 5))
    u = 0.5 * number["width"] + number["cx"] + x * bend * (number["f"] + number["b1"])
    v = 0.5 * number["height"] + number["cy"] + y * bend * number["f"]
    assert np.abs(np.stack([u, v], axis=1) - 0.5 - pixels).max() < 1e-9
    path.write_text(text.replace(">fisheye<", ">equidistant_fisheye<"))  # as newer versions call it
    assert import_calibration(path).model["model"] == "fisheye"  # type: ignore[typeddict-item]


@pytest.mark.parametrize("camera", HELD["opencv"])
def test_opencv_reads_the_file_and_projects_the_same_points(camera: str, tmp_path: Path) -> None:
    path, given = file(tmp_path, "opencv"), calibration(camera)
    export_calibration(given, "opencv", path)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    matrix, distortion = (storage.getNode(n).mat() for n in ("camera_matrix", "distortion_coefficients"))
    points, zero = np.column_stack([directions(), np.ones(63)]), np.zeros(3)
    if storage.getNode("distortion_model").string() == "fisheye":
        seen, _ = cv2.fisheye.projectPoints(points[:, None], zero, zero, matrix, distortion)
    else:
        seen, _ = cv2.projectPoints(points, zero, zero, matrix, distortion)
    assert np.abs(seen.reshape(-1, 2) - projected(given)).max() < 1e-8


def test_what_opencv_itself_writes_is_read(tmp_path: Path) -> None:
    path = tmp_path / "calibrated.xml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_Width", 640)
    storage.write("image_Height", 480)
    storage.write("Camera_Matrix", np.array([[500.0, 0, 320.5], [0, 501.0, 240.5], [0, 0, 1]]))
    storage.write("Distortion_Coefficients", np.array([[0.1, 0.02, 0.0, 0.0]]))
    storage.release()
    found = import_calibration(path)
    assert found.values() == {"fx": 500.0, "fy": 501.0, "cx": 320.5, "cy": 240.5, "k1": 0.1, "k2": 0.02}


@pytest.mark.parametrize("camera", HELD["colmap"])
def test_colmap_reads_the_file_and_projects_the_same_points(camera: str, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    given = calibration(camera)
    export_calibration(given, "colmap", tmp_path / "cameras.txt")
    for name in ("images.txt", "points3D.txt"):
        (tmp_path / name).write_text("")
    (found,) = pycolmap.Reconstruction(str(tmp_path)).cameras.values()
    points = np.column_stack([directions(), np.ones(63)])
    seen = np.array([found.img_from_cam(point) for point in points]).reshape(-1, 2)
    # COLMAP counts from the corner of the first pixel.
    assert np.abs(seen - 0.5 - projected(given)).max() < 1e-8
    # What it writes itself is read.
    (tmp_path / "back").mkdir()
    pycolmap.Reconstruction(str(tmp_path)).write_text(str(tmp_path / "back"))
    back = projected(import_calibration(tmp_path / "back" / "cameras.txt"))
    assert np.abs(back - projected(given)).max() < 1e-6


def need_mrcal() -> None:
    if (
        not Path(MRCALS).exists()
        or subprocess.run([MRCALS, "-c", "import mrcal"], capture_output=True).returncode
    ):
        pytest.skip("mrcal is not installed (apt-get install python3-mrcal)")


def by_mrcal(path: Path, uv: Array, folder: Path) -> Array:
    """Directions projected by mrcal with a file, which it writes again as ``back.cameramodel``."""
    code = (
        "import sys, mrcal, numpy as np; m = mrcal.cameramodel(sys.argv[1]); "
        "np.save(sys.argv[2], mrcal.project(np.load(sys.argv[2]), *m.intrinsics())); m.write(sys.argv[3])"
    )
    points = folder / "points.npy"
    np.save(points, np.column_stack([uv, np.ones(len(uv))]))
    command = [MRCALS, "-c", code, str(path), str(points), str(folder / "back.cameramodel")]
    subprocess.run(command, check=True, capture_output=True)
    return np.asarray(np.load(points))


@pytest.mark.parametrize("camera", HELD["mrcal"])
def test_mrcal_reads_the_file_and_projects_the_same_points(camera: str, tmp_path: Path) -> None:
    need_mrcal()
    given, path = calibration(camera), file(tmp_path, "mrcal")
    export_calibration(given, "mrcal", path)
    assert np.abs(by_mrcal(path, directions(), tmp_path) - projected(given)).max() < 1e-8
    # What it writes itself is read.
    back = projected(import_calibration(tmp_path / "back.cameramodel"))
    assert np.abs(back - projected(given)).max() < 1e-6


def test_metashape_has_the_principal_point_from_the_middle_and_the_tangential_terms_exchanged(
    tmp_path: Path,
) -> None:
    """By the formulas of its manual, with its pixels."""
    given, path = calibration("five"), file(tmp_path, "metashape")
    export_calibration(given, "metashape", path)
    text = path.read_text()
    names = ("width", "height", "f", "cx", "cy", "b1", "k1", "k2", "k3", "p1", "p2")
    number = {name: float(text.split(f"<{name}>")[1].split("<")[0]) for name in names}
    f, k1, k2, k3, p1, p2 = (number[name] for name in ("f", "k1", "k2", "k3", "p1", "p2"))
    x, y = directions().T
    r2 = x * x + y * y
    bend = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    dx = x * bend + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    dy = y * bend + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
    u = 0.5 * number["width"] + number["cx"] + dx * f + dx * number["b1"]
    v = 0.5 * number["height"] + number["cy"] + dy * f
    assert np.abs(np.stack([u, v], axis=1) - 0.5 - projected(given)).max() < 1e-9


def test_openptv_reads_the_file_and_projects_the_same_points(tmp_path: Path) -> None:
    """By the formulas of liboptv (imgcoord.c, trafo.c), from the numbers of the files and of ptv.par."""
    given, path = calibration("radial"), tmp_path / "cam1.ori"
    done = export_calibration(given, "openptv", path)
    numbers = [float(word) for word in path.read_text().split("#")[0].split()]
    xh, yh, cc = numbers[15:18]
    k1, k2, k3, p1, p2, scx, she = map(float, (tmp_path / "cam1.addpar").read_text().split())
    imx, imy, pix_x, pix_y = map(float, path.read_text().split("ptv.par:")[1].split())
    u, v = directions().T
    x, y = cc * u + xh, -cc * v + yh
    r = np.hypot(x, y)
    bend = k1 * r**2 + k2 * r**4 + k3 * r**6
    dx = x + x * bend + p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y
    dy = y + y * bend + p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y
    px = (scx * dx - np.sin(she) * dy) / pix_x + imx / 2
    py = imy / 2 - np.cos(she) * dy / pix_y
    # Its pixels count from the corner of the first one.
    seen, expected = np.stack([px, py], axis=1) - 0.5, projected(given)
    inside = (np.abs(expected - np.array(SIZE) / 2) < np.array(SIZE) / 2).all(axis=1)
    off = np.linalg.norm(seen - expected, axis=1)[inside].max()
    assert off < 1.1 * done.greatest_px
    assert np.abs(seen - projected(import_calibration(path))).max() < 1e-9


def test_the_calibration_of_an_openptv_project_is_read(
    reference_data: Callable[[str], Path],
) -> None:
    path = reference_data("multimedia_cavity") / "cal" / "cam1.tif.ori"
    found = import_calibration(path)
    assert found.values()["c"] == pytest.approx(float(path.read_text().split()[17]))
    assert found.model["width"] == 1280  # type: ignore[typeddict-item]


def test_photomodeler_and_dbat_correct_what_was_measured(tmp_path: Path) -> None:
    """By their formulas: corrected coordinates of projected points are those of a central projection."""
    given = calibration("photo")
    seen = projected(given)
    export_calibration(given, "photomodeler", tmp_path / "c.txt")
    lines = (tmp_path / "c.txt").read_text().splitlines()
    width, height = (float(v) for v in lines[1].split()[2:])
    c, px, py, wide, tall, k1, k2, k3, p1, p2 = map(float, lines[3].split())
    x = (seen[:, 0] + 0.5) * wide / width - px
    y = py - (seen[:, 1] + 0.5) * tall / height
    r2 = x * x + y * y
    bend = k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = (x + x * bend + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y) / c
    v = -(y + y * bend + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y) / c
    assert np.abs(np.stack([u, v], axis=1) - directions()).max() < 1e-9


def test_ros_and_kalibr_have_their_own_names(tmp_path: Path) -> None:
    export_calibration(calibration("rational"), "ros", tmp_path / "ros.yaml")
    ros = yaml.safe_load((tmp_path / "ros.yaml").read_text())
    assert ros["distortion_model"] == "rational_polynomial"
    assert ros["projection_matrix"]["data"][:4] == [1010.0, 0.0, 652.3, 0.0]
    export_calibration(calibration("omni"), "kalibr", tmp_path / "chain.yaml")
    kalibr = yaml.safe_load((tmp_path / "chain.yaml").read_text())["cam0"]
    assert (kalibr["camera_model"], kalibr["distortion_model"]) == ("omni", "radtan")
    assert kalibr["intrinsics"] == [0.7, 1700.0, 1698.0, 652.3, 470.8]


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.txt", "hello", "is not a calibration of one of the formats"),
        ("a.txt", "1 OPENCV 640 480 1 2 3", "has not 8 numbers for OPENCV"),
        ("a.txt", "1 PINHOLE 9 9 1 1 1 1\n2 PINHOLE 9 9 1 1 1 1", "has 2 cameras, not one"),
        ("a.yaml", "cam0:\n  intrinsics: [1]\n", "has no complete camera cam0"),
        ("a.yaml", "distortion_model: x\nprojection_matrix: 1", "has no complete camera_matrix"),
        (
            "a.xml",
            "<calibration><projection>spherical</projection></calibration>",
            "has the projection 'spherical'",
        ),
        ("a.m", "fc = [ 1 ; 2 ]; cc = 1", "is not a calibration"),
        ("a.m", "fc = [1;2];\ncc = [1;2];\nkc = [0;0;0;0;0];\n", "has no complete fc"),
        ("a.cameramodel", "{'lensmodel': 'LENSMODEL_SPLINED'}", "has no complete lensmodel"),
        ("a.yml", "%YAML:1.0\n---\ncamera_matrix: 3\n", "is not a file of OpenCV"),
    ],
)
def test_broken_files_are_reported_in_one_line(name: str, text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(FormatError, match=said) as error:
        import_calibration(tmp_path / name)
    assert "\n" not in str(error.value)


TURN, BASE = np.array([0.02, 0.1, -0.01]), np.array([90.0, 2.0, -4.0])


def placed(camera: str, reference: str, turn: Array, base: Array) -> Calibration:
    place = Place(
        reference=reference, rotation=tuple(turn.tolist()), base=tuple(base.tolist()), unit="mm",
        covariance=tuple(tuple(row) for row in (1e-8 * np.eye(6)).tolist()),
    )  # fmt: skip
    return calibration(camera).model_copy(update={"place": place})


def test_opencv_reads_a_pair_and_projects_the_same_points_into_both_images(tmp_path: Path) -> None:
    pair = [placed("five", "radial", TURN, BASE), calibration("radial")]
    export_rig(pair, "opencv", tmp_path / "pair.yml")
    storage = cv2.FileStorage(str(tmp_path / "pair.yml"), cv2.FILE_STORAGE_READ)
    m2, d2, turn, shift = (storage.getNode(name).mat() for name in ("M2", "D2", "R", "T"))
    assert storage.getNode("D1").mat().ravel() == pytest.approx([-0.21, 0.07, 8e-4, -6e-4, 0.0])
    points = np.column_stack([400 * directions(), np.full(63, 800.0)])
    seen, _ = cv2.projectPoints(points, cv2.Rodrigues(turn)[0], shift, m2, d2)
    own = (points - BASE) @ rotation_matrix(TURN).T
    mapping = calibration("five").mapping()
    expected = mapping.to_pixels(own[:, :2] / own[:, 2:])  # type: ignore[attr-defined]
    assert np.abs(seen.reshape(-1, 2) - expected).max() < 1e-8


def test_a_chain_of_kalibr_leads_from_each_camera_to_the_next(tmp_path: Path) -> None:
    rig = [
        calibration("radial"), placed("fisheye", "radial", TURN, BASE),
        placed("omni", "radial", -2 * TURN, -3 * BASE),
    ]  # fmt: skip
    export_rig(rig, "kalibr", tmp_path / "chain.yaml")
    chain = yaml.safe_load((tmp_path / "chain.yaml").read_text())
    point = np.array([0.3, -0.2, 1.5])
    at = np.append(point, 1.0)
    for k, (turn, base) in enumerate(((TURN, BASE), (-2 * TURN, -3 * BASE)), start=1):
        at = np.array(chain[f"cam{k}"]["T_cn_cnm1"]) @ at
        assert np.abs(at[:3] - rotation_matrix(turn) @ (point - 1e-3 * base)).max() < 1e-12


def test_a_rig_of_colmap_leads_from_its_first_camera_to_the_others(tmp_path: Path) -> None:
    pair = [calibration("radial"), placed("fisheye", "radial", TURN, BASE)]
    export_rig(pair, "colmap", tmp_path / "rig_config.json")
    ((first, second),) = (each["cameras"] for each in json.loads((tmp_path / "rig_config.json").read_text()))
    assert (first["image_prefix"], first["ref_sensor"]) == ("radial/", True)
    assert second["camera_model_name"] == "OPENCV_FISHEYE"
    w, *axis = second["cam_from_rig_rotation"]
    turn = scipy.spatial.transform.Rotation.from_quat([*axis, w]).as_matrix()
    point = np.array([0.3, -0.2, 1.5])
    there = turn @ point + np.array(second["cam_from_rig_translation"])
    assert np.abs(there - rotation_matrix(TURN) @ (point - 1e-3 * BASE)).max() < 1e-12


@pytest.mark.parametrize(
    ("cameras", "to", "said"),
    [
        (("radial", "five"), "kalibr", "are not those of one rig: 2 have no place"),
        (("radial", "five"), "ros", "has no cameras that are fixed to each other"),
    ],
)
def test_calibrations_that_are_no_rig_are_refused(
    cameras: tuple[str, ...], to: str, said: str, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match=said):
        export_rig([calibration(camera) for camera in cameras], to, tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_an_unknown_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="is not one of opencv, ros"):
        export_calibration(calibration("five"), "nothing", tmp_path / "x")
