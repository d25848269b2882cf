"""Marks of film for MicMac and Metashape, and back."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

from reseau.core.errors import FormatError, UsageError
from reseau.exchange.film import FilmMarks, metashape_script, read_film_marks, read_micmac, write_micmac
from reseau.io import DesignPoint, Mark, ReseauDesign, ReseauMeasurement

MM = np.array([[-106.0, 106.0], [106.0, 106.0], [106.0, -106.0], [-106.0, -106.0]])
XY = np.array([[101.25, 99.5], [2221.0, 100.75], [2220.0, 2220.5], [100.0, 2219.25]])


def scan(image: str = "7.tif", mm=MM) -> FilmMarks:
    return FilmMarks(image, ("1", "2", "3", "4"), XY, mm)


def test_files_of_micmac_are_read_as_they_were_written(tmp_path) -> None:
    write_micmac(tmp_path, [scan(), scan("8.tif")])
    found = read_micmac(tmp_path)
    assert [each.image for each in found] == ["7.tif", "8.tif"]
    assert found[0].names == scan().names
    assert np.abs(found[0].xy - XY).max() < 1e-5
    # MicMac's origin is the upper left corner of the marks.
    assert np.abs(found[0].mm - (MM - [-106.0, 106.0])).max() < 1e-5
    assert (tmp_path / "id_fiducial.txt").read_text() == "1\n2\n3\n4\n"


def test_coordinates_of_the_camera_run_down_from_the_upper_left_in_micmac(tmp_path) -> None:
    write_micmac(tmp_path, [scan()])
    text = (tmp_path / "Ori-InterneScan" / "MeasuresCamera.xml").read_text()
    assert "<NamePt>3</NamePt>\n      <PtIm>212.00000 212.00000</PtIm>" in text
    assert "<NameIm>Glob</NameIm>" in text


def test_a_file_of_micmac_without_its_set_is_read(tmp_path) -> None:
    write_micmac(tmp_path, [scan()])
    path = tmp_path / "Ori-InterneScan" / "MeasuresCamera.xml"
    bare = (
        path.read_text()
        .replace("<SetOfMesureAppuisFlottants>", "")
        .replace("</SetOfMesureAppuisFlottants>", "")
    )
    path.write_text(bare)
    assert len(read_micmac(tmp_path)) == 1


@pytest.mark.parametrize("text", ["", "<a/>", '<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>'])
def test_other_files_are_refused(tmp_path, text: str) -> None:
    write_micmac(tmp_path, [scan()])
    (tmp_path / "Ori-InterneScan" / "MeasuresCamera.xml").write_text(text)
    with pytest.raises(FormatError):
        read_micmac(tmp_path)


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
