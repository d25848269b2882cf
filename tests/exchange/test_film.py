"""Marks of film for MicMac and Metashape."""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

from reseau.core.errors import UsageError
from reseau.exchange.film import FilmMarks, metashape_script, read_film_marks, write_micmac
from reseau.io import DesignPoint, Mark, ReseauDesign, ReseauMeasurement

MM = np.array([[-106.0, 106.0], [106.0, 106.0], [106.0, -106.0], [-106.0, -106.0]])
XY = np.array([[101.25, 99.5], [2221.0, 100.75], [2220.0, 2220.5], [100.0, 2219.25]])


def scan(image: str = "7.tif", mm=MM) -> FilmMarks:
    return FilmMarks(image, ("1", "2", "3", "4"), XY, mm)


def measures(path: Path) -> tuple[str, tuple[str, ...], np.ndarray]:
    root = ET.parse(path).getroot()
    points = [tuple(map(float, each.text.split())) for each in root.iter("PtIm")]
    return root.findtext(".//NameIm"), tuple(e.text for e in root.iter("NamePt")), np.array(points)


def test_files_of_micmac_have_the_marks_of_each_scan_and_of_the_camera(tmp_path) -> None:
    write_micmac(tmp_path, [scan(), scan("8.tif")])
    for image in ("7.tif", "8.tif"):
        name, names, xy = measures(tmp_path / "Ori-InterneScan" / f"MeasuresIm-{image}.xml")
        assert (name, names) == (image, scan().names)
        assert np.abs(xy - XY).max() < 1e-5
    _, names, mm = measures(tmp_path / "Ori-InterneScan" / "MeasuresCamera.xml")
    assert names == scan().names
    # MicMac's origin is the upper left corner of the marks, its axis y runs down.
    assert np.abs(mm - (MM - [-106.0, 106.0]) * [1, -1]).max() < 1e-5
    assert (tmp_path / "id_fiducial.txt").read_text() == "1\n2\n3\n4\n"


def test_coordinates_of_the_camera_run_down_from_the_upper_left_in_micmac(tmp_path) -> None:
    write_micmac(tmp_path, [scan()])
    text = (tmp_path / "Ori-InterneScan" / "MeasuresCamera.xml").read_text()
    assert "<NamePt>3</NamePt>\n      <PtIm>212.00000 212.00000</PtIm>" in text
    assert "<NameIm>Glob</NameIm>" in text


def test_scans_of_two_cameras_are_refused(tmp_path) -> None:
    with pytest.raises(UsageError, match=r"8\.tif"):
        write_micmac(tmp_path, [scan(), scan("8.tif", MM + 0.1)])


def test_the_script_defines_fiducial_marks_in_metashape(monkeypatch) -> None:
    sensor = SimpleNamespace(key=0, film_camera=False)
    camera = MagicMock(label="7", sensor=sensor)  # a key of the projections
    made = []

    def add_marker():
        made.append(SimpleNamespace(projections={}, reference=SimpleNamespace()))
        return made[-1]

    module = MagicMock()
    module.Vector = tuple
    module.Marker.Projection = lambda place, pinned: (place, pinned)
    module.app.document.chunk = SimpleNamespace(cameras=[camera], addMarker=add_marker)
    monkeypatch.setitem(sys.modules, "Metashape", module)
    exec(compile(metashape_script([scan()]), "script", "exec"), {})
    assert sensor.film_camera
    assert [marker.label for marker in made] == ["1", "2", "3", "4"]
    assert made[0].reference.location == (-106.0, 106.0, 0)
    assert made[0].projections[camera] == ((101.75, 100.0), True)


def test_marks_of_a_reseau_take_their_coordinates_from_its_design(tmp_path) -> None:
    points = tuple(DesignPoint(id=str(k), x=float(x), y=float(y)) for k, (x, y) in enumerate(MM))
    cross = Mark(shape="cross", size=2.0, line_width=0.1)
    design = ReseauDesign(name="KH-9", unit="mm", mark=cross, polarity="dark", points=points)
    cov, ok = np.tile(0.01 * np.eye(2), (4, 1, 1)), np.array([True, True, False, True])
    found = ReseauMeasurement.from_columns("h.tif", "", design.ids, XY, cov, ok, ("", "", "lost", ""))
    found.write(tmp_path / "h.json")
    marks = read_film_marks(tmp_path / "h.json", design)
    assert marks.names == ("0", "1", "3")
    assert np.array_equal(marks.mm, MM[[0, 1, 3]])
    with pytest.raises(UsageError, match="--design"):
        read_film_marks(tmp_path / "h.json")
