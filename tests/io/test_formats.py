"""Documents: strict, round trip, and errors that name the key."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.core.data import ImagePoints
from reseau.core.errors import FormatError, InputError
from reseau.io import PhotographPoints, ReseauDesign, ReseauMeasurement, read_text, write_whole


def design() -> dict[str, Any]:
    return {
        "schema": "reseau-design/1",
        "name": "d",
        "unit": "mm",
        "mark": {"shape": "cross", "size": 4.0, "line_width": 0.5},
        "polarity": "dark",
        "origin": "a",
        "axis": "b",
        "points": [
            {"id": "a", "x": 0.0, "y": 0, "sigma": 0.01, "nominal_px": [10.5, 20]},
            {"id": "b", "x": 10.0, "y": 0.0},
            {"id": "c", "x": None, "y": None},
        ],
    }


def test_a_design_is_read_back_unchanged(tmp_path: Path) -> None:
    first = ReseauDesign.parse(json.dumps(design()), where="d.json")
    path = tmp_path / "d.json"
    write_whole(path, first.to_json())
    assert ReseauDesign.read(path) == first
    assert ReseauDesign.read(path).to_json() == first.to_json()
    assert next(iter(json.loads(first.to_json()))) == "schema"
    assert first.ids == ("a", "b", "c")
    np.testing.assert_array_equal(first.xy, [[0, 0], [10, 0], [np.nan, np.nan]])
    np.testing.assert_array_equal(first.nominal_px[0], [10.5, 20])
    assert np.isnan(first.nominal_px[1:]).all()


def broken(change: str) -> str:
    content = design()
    match change:
        case "unknown":
            content["colour"] = 1
        case "unknown-in-point":
            content["points"][1]["z"] = 1.0
        case "missing":
            del content["unit"]
        case "twice":
            content["points"][1]["id"] = "a"
        case "half":
            content["points"][1]["y"] = None
        case "origin":
            content["origin"] = "q"
        case "same":
            content["axis"] = "a"
        case "empty":
            content["points"] = []
        case "shape":
            content["mark"]["shape"] = "star"
        case "string":
            content["points"][0]["x"] = "0"
        case "place":
            content["points"][1]["x"] = 1e-9
            content["points"].append({"id": "e", "x": 30.0, "y": 5.0})
        case "nominal place":
            content["points"][2] |= {"nominal_px": [7.5, 8.0]}
            content["points"].append({"id": "e", "x": None, "y": None, "nominal_px": [7.5, 8.0]})
        case "tiny":
            content["points"][1]["x"] = 1e-9
        case "far":
            content["points"][1]["x"] = 1e300
        case "huge":
            content["mark"]["size"] = 4000.0
        case "segment of a cross":
            content["points"][1]["end"] = [20.0, 0.0]
        case "no segment":
            content["points"][1]["end"] = [10.0, 0.0]
        case "schema":
            content["schema"] = "reseau-design/9"
    return json.dumps(content)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ("unknown", "unknown key `colour`"),
        ("unknown-in-point", r"unknown key `points\[1\]\.z`"),
        ("missing", "missing key `unit`"),
        ("twice", "duplicate id 'a'"),
        ("half", "point 'b' has only one of its two coordinates"),
        ("origin", "`origin` is 'q'"),
        ("same", "must differ"),
        ("empty", "no points"),
        ("shape", "mark.shape"),
        ("string", "valid number"),
        ("place", r"points 'a' and 'b' lie at one place, \(0, 0\); correct or remove one of them"),
        ("nominal place", r"points 'c' and 'e' have one nominal position, \(7.5, 8\) px"),
        ("tiny", "all points lie within 1e-06 mm; check the unit"),
        ("far", r"points\[1\]\.x`: .* less than or equal to 1000000000"),
        ("huge", "marks of 4000 mm are larger than the whole design"),
        ("segment of a cross", "requires marks of shape 'rod'"),
        ("no segment", "`end` of 'b' must lie at another place"),
        ("schema", "'reseau-design/1' was expected"),
    ],
)
def test_an_invalid_design_is_refused_in_one_line(change: str, complaint: str) -> None:
    with pytest.raises(FormatError, match=complaint) as caught:
        ReseauDesign.parse(broken(change), where="bad.json")
    assert str(caught.value).startswith("bad.json: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", "3", "null", "[" * 100_000, '{"a": 1}'])
def test_text_that_is_not_a_document_is_refused(text: str) -> None:
    with pytest.raises(FormatError, match=r"x\.json: (is not JSON|has no key `schema`)"):
        ReseauDesign.parse(text, where="x.json")


def test_nan_is_refused_as_a_coordinate() -> None:
    text = json.dumps(design()).replace("10.0", "NaN", 1)
    with pytest.raises(FormatError, match="finite"):
        ReseauDesign.parse(text, where="x.json")


def test_a_slanted_wire_has_a_segment_and_no_place() -> None:
    content = design() | {"mark": {"shape": "rod", "size": 0.5}}
    # The diagonal of an N runs from one wire to the other: their ends are at one place.
    content["points"].append({"id": "n", "x": 0.0, "y": 0.0, "end": [10.0, 0.0]})
    wires = ReseauDesign.parse(json.dumps(content), where="d.json")
    np.testing.assert_array_equal(wires.xy[3], [np.nan, np.nan])
    np.testing.assert_array_equal(wires.segments[[1, 3]], [[[10, 0], [10, 0]], [[0, 0], [10, 0]]])
    assert ReseauDesign.parse(wires.to_json(), where="d.json") == wires
    assert wires.to_json().count("end") == 1


def test_missing_and_binary_files_are_named_in_the_message(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.json: cannot be read \(No such file"):
        read_text(tmp_path / "none.json")
    (tmp_path / "b.json").write_bytes(b"\xff\xfe\0")
    with pytest.raises(InputError, match=r"b\.json: is not UTF-8"):
        read_text(tmp_path / "b.json")


def test_a_file_is_written_completely_or_not_at_all(tmp_path: Path) -> None:
    write_whole(tmp_path / "a.txt", "ä")
    write_whole(tmp_path / "a.txt", b"new")
    assert (tmp_path / "a.txt").read_bytes() == b"new"
    with pytest.raises(InputError, match="cannot be written"):
        write_whole(tmp_path / "none" / "a.txt", "x")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        write_whole(tmp_path / "folder", "x")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.txt", "folder"]


def test_measured_points_keep_their_covariance() -> None:
    cov = np.array([[[0.04, 0.01], [0.01, 0.09]]])
    points = ImagePoints(("a",), np.array([[1.5, 2.5]]), cov)
    document = ReseauMeasurement.from_image_points(points, image="p.png", sha256="0")
    again = ReseauMeasurement.parse(document.to_json(), where="m.json").image_points()
    np.testing.assert_allclose(again.cov, cov, rtol=1e-14)
    np.testing.assert_array_equal(again.xy, points.xy)


def test_marks_that_were_not_measured_are_not_returned_as_points() -> None:
    document = {
        "schema": "reseau-measurement/1",
        "image": "p.png",
        "sha256": "",
        "unit": "px",
        "points": [{"id": "a", "ok": False, "why": "gone"}, {"id": "b", "x": 1.0, "y": 2.0, "ok": True}],
        "found": 1,
        "expected": 2,
    }
    points = ReseauMeasurement.parse(json.dumps(document), where="m").image_points()
    assert points.names == ("b",)
    np.testing.assert_array_equal(points.sigma, [[1.0, 1.0]])


def test_coordinates_are_read_from_csv(tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    path.write_text("id,x,y,sx,sy\n a ,1,2,0.1,0.2\n\nb,3.5,-4e1,1,1\n")
    points = ReseauMeasurement.read_csv(path).image_points()
    assert points.names == ("a", "b")
    np.testing.assert_array_equal(points.xy, [[1, 2], [3.5, -40]])
    np.testing.assert_allclose(points.sigma[0], [0.1, 0.2], rtol=1e-14)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "first line"),
        ("name,x,y\na,1,2\n", "first line"),
        ("id,x,y\n", "contains no points"),
        ("id,x,y\na,1\n", "line 2"),
        ("id,x,y\na,1,2,3\n", "line 2"),
        ("id,x,y\na,1,2\nb,1,nan\n", "line 3"),
        ("id,x,y,sx,sy\na,1,2,0,1\n", "line 2"),
        ("id,x,y\na,1,2\na,3,4\n", "line 3: duplicate id 'a'"),
    ],
)
def test_an_invalid_csv_is_refused_with_its_line(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "p.csv"
    path.write_text(text)
    with pytest.raises(FormatError, match=rf"p\.csv: .*{complaint}"):
        ReseauMeasurement.read_csv(path)


def photograph_points() -> dict[str, Any]:
    cov = np.array([[[0.1 + 0.2, 1e-17], [1e-17, 1 / 3]]])
    return PhotographPoints.of(ImagePoints(("a",), np.array([[0.1, -2e300]]), cov), (640, 480)).to_dict()


def test_points_of_a_photograph_are_read_back_to_the_last_bit() -> None:
    found = PhotographPoints.parse(json.dumps(photograph_points()), where="p.json").image_points()
    assert isinstance(found, ImagePoints)
    assert found.xy.tolist() == [[0.1, -2e300]]
    assert found.cov.tolist() == [[[0.1 + 0.2, 1e-17], [1e-17, 1 / 3]]]


@pytest.mark.parametrize(
    "change",
    [
        {"names": ["a", "b"]},
        {"names": []},
        {"xy": "AAAA"},
        {"xy": "not base64"},
        {"xy": "µµµµ"},
        {"xy": "AAAAAAAA+H8AAAAAAADwPw=="},  # NaN and 1
    ],
)
def test_damaged_points_of_a_photograph_are_refused_in_one_line(change: dict[str, Any]) -> None:
    document = photograph_points()
    document["points"] |= change
    with pytest.raises(FormatError, match=r"^p\.json: `points`: (columns|numbers) that are [a-z ]+$"):
        PhotographPoints.parse(json.dumps(document), where="p.json")
