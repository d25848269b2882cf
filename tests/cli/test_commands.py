"""Commands write the requested files with correct content."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from reseau.calibration import Calibration
from reseau.io import ReseauDesign, ReseauMeasurement
from reseau.io.images import read_image, write_image

Run = Callable[..., tuple[int, str, str]]


def test_help_names_every_command(reseau: Run) -> None:
    status, out, err = reseau("--help")
    assert (status, err) == (0, "")
    for command in ("demo", "design", "measure", "refine", "apply"):
        assert command in out


def test_help_does_not_import_heavy_packages() -> None:
    heavy = ("numpy", "scipy", "cv2", "matplotlib", "pydantic")
    help_ = "import sys; from reseau.cli import run; run(['--help'])"
    code = f"{help_}; print([m for m in {heavy} if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.splitlines()[-1] == "[]"


def test_the_version_is_that_of_the_package(reseau: Run) -> None:
    from reseau import __version__

    assert reseau("--version")[:2] == (0, f"reseau {__version__}\n")
    assert f"\nversion: {__version__}\n" in (Path(__file__).parents[2] / "CITATION.cff").read_text()


def test_the_package_runs_as_the_command() -> None:
    done = subprocess.run([sys.executable, "-m", "reseau", "--version"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("reseau ")


def test_marks_are_measured_at_their_true_positions(reseau: Run, photo: Any, tmp_path: Path) -> None:
    status, out, _ = reseau("measure", "reseau", photo.image, "-d", photo.design, "-o", tmp_path / "m.json")
    assert status == 0
    assert "63 of 63 marks measured" in out
    points = ReseauMeasurement.read(tmp_path / "m.json").image_points()
    truth = photo.view(photo.grid.xy)
    assert np.sqrt(((points.xy - truth) ** 2).mean()) < 0.02
    assert np.sqrt((((points.xy - truth) / points.sigma) ** 2).mean()) == pytest.approx(1.0, abs=0.25)


@pytest.mark.slow
def test_json_on_standard_output_is_the_document(reseau: Run, photo: Any, tmp_path: Path) -> None:
    arguments = ("measure", "reseau", photo.image, "-d", photo.design)
    _, out, err = reseau(*arguments, "--json")
    assert err == ""
    document = ReseauMeasurement.parse(out, where="stdout")
    assert (document.found, document.image) == (63, "photo.png")
    reseau(*arguments, "-o", tmp_path / "m.csv")
    again = ReseauMeasurement.read_csv(tmp_path / "m.csv").image_points()
    np.testing.assert_allclose(again.xy, document.image_points().xy, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_coordinates_are_accepted_instead_of_an_image(
    reseau: Run, photo: Any, calibration: Path, tmp_path: Path
) -> None:
    reseau("measure", "reseau", photo.image, "-d", photo.design, "-o", tmp_path / "m.json")
    reseau("measure", "reseau", photo.image, "-d", photo.design, "-o", tmp_path / "m.csv")
    from_image = Calibration.read(calibration)
    for name in ("m.json", "m.csv"):
        status, out, _ = reseau("refine", "--photo-i", tmp_path / name, "--reseau", photo.design, "--json")
        assert status == 0
        from_points = Calibration.parse(out, where=name)
        assert list(from_points.parameters) == list(from_image.parameters)
        for key, quantity in from_points.parameters.items():
            other = from_image.parameters[key]
            assert abs(quantity.value - other.value) < 0.05 * other.sigma
    status, out, _ = reseau("measure", "reseau", tmp_path / "m.csv", "-d", photo.design)
    assert (status, out) == (0, "m.csv: 63 of 63 marks measured\n")


def test_a_calibration_corrects_its_own_marks(
    reseau: Run, photo: Any, calibration: Path, tmp_path: Path
) -> None:
    reseau("measure", "reseau", photo.image, "-d", photo.design, "-o", tmp_path / "m.json")
    status, out, _ = reseau("apply", calibration, tmp_path / "m.json", "--json")
    assert status == 0
    table = json.loads(out)
    assert table["unit"] == "mm"
    xy = np.stack([table["points"]["x"], table["points"]["y"]], axis=1)
    origin = photo.grid.xy[photo.grid.ids.index(photo.grid.origin)]
    assert np.abs(xy - (photo.grid.xy - origin)).max() < 0.02  # millimetres; 0.01 px are 0.0025 mm
    assert reseau("apply", calibration, tmp_path / "m.json", "-o", tmp_path / "p.csv")[0] == 0
    lines = (tmp_path / "p.csv").read_text().splitlines()
    assert lines[0] == "id,x,y,sx,sy"
    assert len(lines) == 64


@pytest.mark.parametrize(
    ("name", "dtype"), [("a.png", np.uint8), ("a.tif", np.uint8), ("b.tif", np.uint16), ("b.png", np.uint16)]
)
def test_a_corrected_image_has_its_marks_at_the_design_positions(
    reseau: Run, photo: Any, calibration: Path, tmp_path: Path, name: str, dtype: type
) -> None:
    factor = 1 if dtype is np.uint8 else 200
    write_image(tmp_path / name, np.rint(np.clip(photo.pixels, 0, 255) * factor).astype(dtype))
    out = tmp_path / f"out{Path(name).suffix}"
    status, text, _ = reseau("apply", calibration, tmp_path / name, "-o", out, "--scale", 5, "--json")
    assert status == 0
    raster, frame = json.loads(text), read_image(out)
    assert frame.pixels.dtype == dtype
    assert (frame.width, frame.height) == (raster["width"], raster["height"])
    origin = photo.grid.xy[photo.grid.ids.index(photo.grid.origin)]
    for mark in (0, 11, 30, 62):
        x, y = (photo.grid.xy[mark] - origin - raster["first_pixel"]) * [5, -5]
        column, row = round(x), round(y)
        window = frame.pixels[row - 8 : row + 9, column - 8 : column + 9].astype(float)
        dark = np.maximum(150 * factor - window, 0)
        offset = np.arange(-8.0, 9.0)
        centroid = np.array([(dark * offset).sum(), (dark * offset[:, None]).sum()]) / dark.sum()
        # A threshold's centre of gravity amid noise of 1.5 grey values.
        np.testing.assert_allclose(centroid + np.array([column, row]), [x, y], rtol=0, atol=0.06)


def test_a_corrected_tiff_contains_its_true_resolution(
    reseau: Run, photo: Any, calibration: Path, tmp_path: Path
) -> None:
    out = tmp_path / "c.tif"
    assert reseau("apply", calibration, photo.image, "-o", out, "--scale", 5)[0] == 0
    with tifffile.TiffFile(out) as tiff:
        tags = tiff.pages.first.tags
        numerator, denominator = tags["XResolution"].value
        assert numerator / denominator == pytest.approx(50.0)  # pixels per centimetre
        assert tags["ResolutionUnit"].value == 3
    assert cv2.imread(str(out), cv2.IMREAD_UNCHANGED) is not None


def test_a_design_is_written_with_its_drawings(reseau: Run, tmp_path: Path) -> None:
    files = {suffix: tmp_path / f"d.{suffix}" for suffix in ("svg", "pdf", "json")}
    options = ("--columns", 5, "--rows", 4, "--shape", "disk", "--size", 2, "--name", "five")
    status, out, _ = reseau(
        "design",
        "reseau",
        *options,
        "--svg",
        files["svg"],
        "--pdf",
        files["pdf"],
        "--out",
        files["json"],
    )
    assert status == 0
    assert out.split() == [str(path) for path in files.values()]
    status, out, _ = reseau("design", "reseau", *options, "--out", "-")
    assert ReseauDesign.parse(out, where="stdout") == ReseauDesign.read(files["json"])
    assert files["svg"].read_text().startswith("<svg")
    assert files["pdf"].read_bytes().startswith(b"%PDF")
    design = ReseauDesign.read(files["json"])
    assert (design.name, len(design.points), design.mark.size) == ("five", 20, 2.0)


def test_a_board_file_is_read_and_its_unit_is_asked_for(reseau: Run, tmp_path: Path) -> None:
    text = (
        "target_type: 'circlegrid'\ntargetCols: 7\ntargetRows: 10\nspacingMeters: 0.02\nasymmetricGrid: 0\n"
    )
    (tmp_path / "kalibr.yaml").write_text(text)
    file = tmp_path / "board.json"
    # Kalibr does not say how large the circles are.
    status, _, err = reseau("design", "board", "--from", tmp_path / "kalibr.yaml", "--size", 8, "--out", file)
    assert (status, err) == (0, "")
    written = json.loads(file.read_text())
    assert (written["pitch"], written["size"]) == (20.0, 8.0)
    # The design again, in another size.
    assert reseau("design", "board", "--from", file, "--pitch", 25, "--out", file)[0] == 0
    assert json.loads(file.read_text()) == written | {"pitch": 25.0}
    storage = "%YAML:1.0\n---\nsquaresX: 7\nsquaresY: 10\nsquareLength: 0.024\nmarkerLength: 0.018\n"
    (tmp_path / "opencv.yml").write_text(storage + "dictionary: 5\n")
    status, _, err = reseau("design", "board", "--from", tmp_path / "opencv.yml", "--out", file)
    assert status == 0
    assert "is 0.024 mm (24 µm): is it 0.024 m, which is 24 mm? Lengths depend on it: give --pitch" in err
    # A pitch of zero is no pitch that was not given.
    for target in ("board", "sheet", "testfield"):
        status, out, err = reseau("design", target, "--pitch", 0)
        assert (status, out) == (2, "")
        assert "pitch" in err or "0 mm" in err


def test_a_report_is_written_on_request(reseau: Run, photo: Any, tmp_path: Path) -> None:
    page = tmp_path / "r.html"
    arguments = ("refine", "--photo-i", photo.image, "--reseau", photo.design, "--report", page)
    status, out, _ = reseau(*arguments, "--check", "B2,E7")
    assert status == 0
    assert out.startswith("photo.png: 63 marks")
    assert "2 check marks" in page.read_text()
