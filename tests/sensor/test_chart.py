"""Edges of a chart: found, bounded and measured; what is not an edge is declined."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from reseau.cli import run
from reseau.core.data import Array, Frame
from reseau.core.failure import Code, Failure
from reseau.io.images import write_image
from reseau.sensor import EdgeSpread, measure_edges
from reseau.sensor.chart import find_edges

FINE = 8


def chart(angle_deg: float, psf: float, rng: np.random.Generator, size: int = 260) -> Array:
    """Two by two dark squares of 80 px on white, formed by eight by eight points to a pixel."""
    angle = np.deg2rad(angle_deg)
    y, x = (np.mgrid[: size * FINE, : size * FINE].astype(np.float32) + 0.5) / FINE - 0.5 - size / 2
    u, v = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    dark = (np.abs(np.abs(u) - 58) < 40) & (np.abs(np.abs(v) - 58) < 40)
    light = cv2.GaussianBlur(np.where(dark, 0.1, 1.0).astype(np.float32), (0, 0), psf * FINE)
    grey = 20 + 200 * light.reshape(size, FINE, size, FINE).mean(axis=(1, 3))
    return np.clip(np.rint(grey + rng.normal(0, 1.0, grey.shape)), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def squares() -> Array:
    return chart(6.0, 0.8, np.random.default_rng(2))


@pytest.mark.slow
def test_the_edges_of_a_chart_are_found_and_true_within_their_sigmas(squares: Array) -> None:
    found = measure_edges(Frame(squares, 255.0))
    assert not isinstance(found, Failure)
    assert len(found) == 16
    errors = []
    for edge in found:
        assert isinstance(edge.found, EdgeSpread)
        errors.append((abs(edge.found.fit["psf"]) - 0.8) / edge.found.fit.sigma_of("psf"))
        middle = edge.at.centre - 129.5
        turned = np.array([[np.cos(0.1047), np.sin(0.1047)], [-np.sin(0.1047), np.cos(0.1047)]]) @ middle
        away = np.abs(np.abs(turned) - [[18.0], [98.0]]).min()
        assert away < 0.8
    # rms of 16 normalised errors: 1 ± 0.18.
    assert 0.4 < np.sqrt(np.mean(np.square(errors))) < 1.7


def test_edges_that_are_not_slanted_are_declined_with_the_reason() -> None:
    found = measure_edges(Frame(chart(0.0, 0.8, np.random.default_rng(1)), 255.0))
    assert isinstance(found, Failure)
    assert found.code is Code.SLANT
    assert "rotate the chart" in found.reason


def test_lines_noise_and_gradients_are_no_edges() -> None:
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:200, :200].astype(float)
    line = np.where(np.abs(x - 100 - 0.1 * y) < 1.5, 20.0, 200.0)
    for pixels in (rng.normal(100, 5, (200, 200)), 0.8 * x + 20, line, np.full((200, 200), 7.0)):
        assert not [edge for edge in find_edges(Frame(pixels, 255.0)) if edge.why is None]


def test_neighbours_closer_than_ten_pixels_are_declined() -> None:
    y, x = np.mgrid[:200, :200] - 99.5
    stripes = np.where(np.mod(x - 0.1 * y, 16) < 8, 40.0, 180.0)
    found = measure_edges(Frame(stripes + np.random.default_rng(1).normal(0, 1, x.shape), 255.0))
    assert isinstance(found, Failure)


@pytest.mark.slow
def test_the_command_writes_documents_and_pictures(
    squares: Array, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = tmp_path / "chart.png"
    write_image(image, squares[:140, :140])
    files = [tmp_path / name for name in ("e.json", "e.png", "e.html")]
    command = ["measure", "edge", str(image)]
    assert run([*command, "-o", str(files[0]), "--overlay", str(files[1]), "--report", str(files[2])]) == 0
    printed = capsys.readouterr()
    assert "edges measured" in printed.out
    document = json.loads(files[0].read_text())
    assert document["schema"] == "reseau-edges/1"
    assert document["found"] >= 4
    good = next(edge for edge in document["edges"] if edge["ok"])
    assert good["mtf"]["frequency"][16] == 0.5
    assert cv2.imread(str(files[1])).shape[1] >= 1200
    assert "least sharp" in files[2].read_text()
    left, top, width, height = good["region"]
    assert run([*command, "--region", f"{left},{top},{width},{height}", "-o", str(tmp_path / "e.csv")]) == 0
    rows = (tmp_path / "e.csv").read_text().splitlines()
    assert len(rows) == 2
    assert float(rows[1].split(",")[6]) == pytest.approx(good["psf"], abs=0.02)
    for wrong in (["--region", "1,2,3"], ["--region", "900,900,40,40"], ["--overlay", str(image)]):
        assert run([*command, *wrong]) in (1, 2)
        assert capsys.readouterr().err.count("\n") == 1
