"""`reseau measure fiducials`: from a scan to its orientation, and to a picture in millimetres."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reseau.io import FiducialDesign
from reseau.io.images import read_image, write_image

from ..measure.photographs import UNEVEN, camera, photograph

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A scan and its camera."""
    folder = tmp_path_factory.mktemp("photo")
    write_image(folder / "photo.tif", photograph(UNEVEN, rotation=90)[0])
    camera(UNEVEN).write(folder / "camera.json")
    return folder / "photo.tif", folder / "camera.json"


def test_a_scan_is_oriented_and_resampled_to_millimetres(files, tmp_path: Path, reseau: Run) -> None:
    photo, design = files
    status, out, _ = reseau(
        "measure",
        "fiducials",
        photo,
        "-d",
        design,
        "-o",
        tmp_path / "photo.json",
        "--overlay",
        tmp_path / "o.png",
    )
    assert status == 0
    assert "4 of 4 fiducial marks, rotated by 90°" in out
    assert (tmp_path / "o.png").exists()
    status, out, _ = reseau(
        "apply", tmp_path / "photo.json", photo, "--scale", 8, "-o", tmp_path / "frame.tif", "--json"
    )
    assert status == 0
    left, top = json.loads(out)["first_pixel"]
    frame = read_image(tmp_path / "frame.tif").pixels.astype(float)
    for x, y in UNEVEN.values():
        column, row = int(np.rint((x - left) * 8)), int(np.rint((top - y) * 8))
        assert frame[row, column] > 120  # the dot of the mark
        assert frame[row + 3, column + 3] < 80  # beside it


def test_an_oriented_scan_is_exported_to_micmac_and_metashape(files, tmp_path: Path, reseau: Run) -> None:
    photo, design = files
    reseau("measure", "fiducials", photo, "-d", design, "-o", tmp_path / "photo.json")
    script = tmp_path / "marks.py"
    status, _, _ = reseau("export", tmp_path / "photo.json", "--micmac", tmp_path, "--metashape", script)
    assert status == 0
    root = ET.parse(tmp_path / "Ori-InterneScan" / "MeasuresCamera.xml").getroot()
    mm = np.array([each.text.split() for each in root.iter("PtIm")], dtype=float)
    expected = camera(UNEVEN)
    assert tuple(each.text for each in root.iter("NamePt")) == expected.ids
    assert np.abs(mm - (expected.xy - [-20.0, 15.0]) * [1, -1]).max() < 1e-4
    assert "Marker.Type.Fiducial" in script.read_text()
    status, _, err = reseau("export", tmp_path / "photo.json")
    assert status == 2
    assert "--micmac" in err


def test_marks_are_learnt_from_a_scan_and_a_block_is_oriented(files, tmp_path: Path, reseau: Run) -> None:
    photo, _ = files
    table, own, block = tmp_path / "report.csv", tmp_path / "own.json", tmp_path / "block"
    rows = "".join(f"{name},{x},{y}\n" for name, (x, y) in UNEVEN.items())
    table.write_text("id,x,y\n" + rows)
    x, y = np.rint(photograph(UNEVEN, rotation=90)[1][0])
    status, out, _ = reseau(
        "design", "fiducials", table, "--learn", photo, "--mark-at", f"1={x:g},{y:g}", "--mark-px", 46,
        "-o", own, "--overlay", tmp_path / "learnt.png",
    )  # fmt: skip
    assert status == 0
    assert "photo.tif: 4 of 4 marks, rotated by 90°" in out
    block.mkdir()
    write_image(block / "negative.tif", 255 - photograph(UNEVEN, seed=3)[0])
    write_image(block / "other.tif", photograph(UNEVEN, without=tuple(UNEVEN))[0])
    status, out, err = reseau("measure", "fiducials", block, photo, "-d", own, "-o", tmp_path / "oriented")
    assert (status, out.splitlines()[-1]) == (1, "2 of 3 photographs oriented")
    assert "negative.tif: 4 of 4 fiducial marks, rotated by 0°, negative" in out
    assert "other.tif" in err
    assert {path.name for path in (tmp_path / "oriented").iterdir()} == {"negative.json", "photo.json"}


@pytest.mark.slow
def test_a_camera_is_known_by_its_name_and_written_to_be_edited(files, tmp_path: Path, reseau: Run) -> None:
    status, out, _ = reseau("design", "fiducials")
    assert status == 0
    assert "zeiss-rmk-top      Zeiss RMK TOP" in out
    assert reseau("design", "fiducials", "wild-rc10", "-o", tmp_path / "rc10.json")[0] == 0
    assert FiducialDesign.read(tmp_path / "rc10.json").ids == tuple("12345678")
    # The test's own camera has none of its marks.
    status, _, err = reseau("measure", "fiducials", files[0], "-d", "zeiss-rmk-top")
    assert status == 1
    assert "'Zeiss RMK TOP: dots in circles with crosses'" in err
    status, _, err = reseau("measure", "fiducials", files[0], "-d", "wild-rc11")
    assert (status, err.count("\n")) == (2, 1)
    assert "no camera has the name 'wild-rc11'; known are" in err
