"""`reseau design testfield`: output and refused input."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from reseau.designs import coded_testfield
from reseau.io import ReseauMeasurement, TestfieldDesign
from reseau.io.images import write_image
from reseau_sims import FieldBench, Station

Run = Callable[..., tuple[int, str, str]]


def test_a_testfield_is_written_with_its_drawings(reseau: Run, tmp_path: Path) -> None:
    files = [tmp_path / f"field{suffix}" for suffix in (".svg", ".pdf", ".json")]
    svg, pdf, json = files
    status, out, err = reseau("design", "testfield", "--svg", svg, "--pdf", pdf, "--out", json)
    assert (status, err) == (0, "")
    assert out.split() == [str(path) for path in files]
    assert TestfieldDesign.read(json) == coded_testfield(pitch=20.0)  # fills a sheet of A4
    assert svg.read_text().startswith("<svg")
    assert pdf.read_bytes().startswith(b"%PDF")


def test_the_design_is_printed_on_request(reseau: Run) -> None:
    status, out, _ = reseau("design", "testfield", "--columns", 2, "--rows", 1, "--pitch", 125, "--out", "-")
    assert status == 0
    assert TestfieldDesign.parse(out, where="stdout") == coded_testfield(2, 1)


def test_a_simulated_recording_is_measured(reseau: Run, tmp_path: Path) -> None:
    bench = FieldBench()
    write_image(tmp_path / "frame.png", bench.record(Station(30)).pixels)
    bench.design.write(tmp_path / "field.json")
    arguments = ("measure", "testfield", tmp_path / "frame.png", "-d", tmp_path / "field.json", "--fill", 0.8)
    status, out, err = reseau(*arguments, "-o", tmp_path / "marks.json")
    assert (status, err) == (0, "")
    assert "of 1024 targets measured" in out
    found = ReseauMeasurement.read(tmp_path / "marks.json")
    truth = bench.truth(Station(30))
    at = dict(zip(truth.names, truth.xy, strict=True))
    points = found.image_points()
    assert len(points) == found.found > 340
    error = points.xy - np.array([at[name] for name in points.names])
    assert np.abs(error).max() < 0.05  # px
