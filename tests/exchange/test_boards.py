"""Boards of Kalibr and OpenCV, in the forms in which people keep them."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from reseau.core.errors import FormatError
from reseau.designs import board
from reseau.exchange.boards import read_board, read_target

XML = """<?xml version="1.0"?>
<opencv_storage>
<Settings>
  <!-- Number of inner corners per a item row and column. (square, circle) -->
  <BoardSize_Width> 9</BoardSize_Width>
  <BoardSize_Height>6</BoardSize_Height>
  <Square_Size>20.5</Square_Size>
  <!-- One of: CHESSBOARD CIRCLES_GRID ASYMMETRIC_CIRCLES_GRID -->
  <Calibrate_Pattern>"PATTERN"</Calibrate_Pattern>
  <ArUco_Dict_Name>DICT_4X4_50</ArUco_Dict_Name>
  <Marker_Size>15</Marker_Size>
  <Input>"images.xml"</Input>
</Settings>
</opencv_storage>
"""


def read(folder: Path, text: str, name: str) -> dict[str, object]:
    path = folder / name
    path.write_text(text)
    return {key: v for key, v in read_board(path).to_dict().items() if key not in ("schema", "name", "unit")}


@pytest.mark.parametrize("family", ["", "tagFamily: 'tag25h9'  # of our printer\n"])
def test_an_aprilgrid_of_kalibr_has_tags_with_two_bits_of_border(tmp_path: Path, family: str) -> None:
    text = "        target_type: 'aprilgrid' #gridtype\n  tagCols: 6\n  tagRows: 5\ntagSize: 0.029  # m\n"
    found = read(tmp_path, text + "tagSpacing: 0.25 #example: tagSize=2m --> 0.25[-]\n" + family, "t.yaml")
    words = "DICT_APRILTAG_25h9" if family else "DICT_APRILTAG_36h11"
    assert found == {
        "kind": "aprilgrid", "columns": 6, "rows": 5, "pitch": 36.25, "size": 29.0, "dictionary": words,
        "border_bits": 2,
    }  # fmt: skip


def test_chessboards_and_circles_of_kalibr_are_in_metres_and_inner_corners(tmp_path: Path) -> None:
    text = "target_type: 'checkerboard'\ntargetCols: 9\ntargetRows: 6\nrowSpacingMeters: 0.101\n"
    found = read(tmp_path, text + "colSpacingMeters: 0.101 \n", "c.yaml")
    assert found == {"kind": "chess", "columns": 10, "rows": 7, "pitch": 101.0}
    text = "target_type: circlegrid\ntargetCols: 4\ntargetRows: 11\nspacingMeters: 0.01\nasymmetricGrid: true"
    found = read(tmp_path, text, "o.yaml")
    assert found == {
        "kind": "circles", "columns": 4, "rows": 11, "pitch": 10.0, "size": 5.0, "asymmetric": True
    }  # fmt: skip


def test_settings_of_the_calibration_sample_of_opencv_are_read(tmp_path: Path) -> None:
    found = read(tmp_path, XML.replace("PATTERN", "CHESSBOARD"), "a.xml")
    assert found == {"kind": "chess", "columns": 10, "rows": 7, "pitch": 20.5}
    found = read(tmp_path, XML.replace("PATTERN", "ASYMMETRIC_CIRCLES_GRID"), "a.xml")
    assert (found["columns"], found["rows"], found["asymmetric"]) == (9, 6, True)
    found = read(tmp_path, XML.replace("PATTERN", "CHARUCOBOARD"), "a.xml")
    assert found == {
        "kind": "charuco", "columns": 9, "rows": 6, "pitch": 20.5, "size": 15.0, "dictionary": "DICT_4X4_50"
    }  # fmt: skip
    with pytest.raises(FormatError, match="Calibrate_Pattern"):
        read(tmp_path, XML, "a.xml")


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_a_charuco_board_that_opencv_stores_by_its_arguments_is_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"board{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    sizes: dict[str, int | float] = {"squaresX": 8, "squaresY": 6, "squareLength": 30.0, "markerLength": 22.0}
    for key, value in (sizes | {"dictionary": int(cv2.aruco.DICT_4X4_50), "legacyPattern": 1}).items():
        storage.write(key, value)
    storage.release()
    assert read_board(path) == board(
        "charuco", 8, 6, 30.0, size=22.0, dictionary="DICT_4X4_50", legacy=True, name="board"
    )
    path.write_text(path.read_text().replace("squaresX", "columns"))
    with pytest.raises(FormatError, match="squaresX"):
        read_board(path)


def test_a_target_is_a_design_or_a_board_of_another_program(tmp_path: Path) -> None:
    design = board("chess", 10, 7, 101.0, name="c")
    design.write(tmp_path / "c.json")
    text = "target_type: 'checkerboard'\ntargetCols: 9\ntargetRows: 6\nrowSpacingMeters: 0.101\n"
    (tmp_path / "c.yaml").write_text(text + "colSpacingMeters: 0.101\n")
    for name in ("c.json", "c.yaml"):
        assert read_target(tmp_path / name) == read_board(tmp_path / name) == design
