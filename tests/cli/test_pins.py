"""`reseau measure pins`: output and error messages."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reseau.io import ReseauDesign, ReseauMeasurement
from reseau.io.images import write_image
from reseau.optics import Arcs

Run = Callable[..., tuple[int, str, str]]

RODS = np.array([(0, 0), (0, 25), (0, 60), (30, 0), (45, 40), (70, 60), (80, 10)], dtype=float)
TRUTH = RODS * [5.0, -5.0] + [100.25, 350.4]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """An image of seven rods, the last of them not seen, and their design."""
    folder = tmp_path_factory.mktemp("pins")
    arcs = Arcs(*(np.full(6, v) for v in (7.0, 1.6, 0.012, 0.0)))
    columns, rows = (np.broadcast_to(np.arange(n, dtype=float), (6, n)) for n in (620, 420))
    canvas = 5 + 150 * arcs.image(TRUTH[:-1], columns, rows).sum(axis=0)
    canvas += 1.5 * np.random.default_rng(0).standard_normal(canvas.shape)
    write_image(folder / "photo.png", np.clip(np.rint(canvas), 0, 255).astype(np.uint8))
    points = [{"id": f"R{k}", "x": x, "y": y} for k, (x, y) in enumerate(RODS.tolist())]
    design = {"schema": "reseau-design/1", "name": "object", "unit": "mm", "polarity": "bright"}
    design |= {"mark": {"shape": "rod", "size": 0.75}, "points": points}
    (folder / "rods.json").write_text(json.dumps(design), "utf-8")
    return folder / "photo.png", folder / "rods.json"


def test_rods_are_measured_and_the_missing_one_is_named(
    reseau: Run, bench: tuple[Path, Path], tmp_path: Path
) -> None:
    image, design = bench
    status, out, _ = reseau("measure", "pins", image, "-d", design, "-o", tmp_path / "m.json")
    assert status == 0
    assert "6 of 7 rods measured" in out
    assert "R6: no echo at the predicted position" in out
    points = ReseauMeasurement.read(tmp_path / "m.json").image_points()
    assert points.names == tuple(f"R{k}" for k in range(6))
    assert np.abs(points.xy - TRUTH[:6]).max() < 0.2


def test_slanted_wires_are_measured_with_the_share_at_which_they_are_cut(reseau: Run, tmp_path: Path) -> None:
    status, out, err = reseau("design", "n-wires", "--layers", 3, "--out", tmp_path / "phantom.json")
    assert (status, err) == (0, "")
    design = ReseauDesign.read(tmp_path / "phantom.json")
    share = np.array([0.3, 0.55, 0.8])
    ends = design.segments
    slanted = np.isnan(design.xy).any(axis=1)
    plane = ends[:, 0].copy()
    plane[slanted] += share[:, None] * (ends[slanted, 1] - ends[slanted, 0])
    truth = plane * [9.0, -9.0] + [310.25, 110.4]
    arcs = Arcs(*(np.full(len(truth), v) for v in (7.0, 1.6, 0.012, 0.0)))
    columns, rows = (np.broadcast_to(np.arange(n, dtype=float), (len(truth), n)) for n in (620, 480))
    canvas = 5 + 150 * arcs.image(truth, columns, rows).sum(axis=0)
    canvas += 1.5 * np.random.default_rng(0).standard_normal(canvas.shape)
    write_image(tmp_path / "photo.png", np.clip(np.rint(canvas), 0, 255).astype(np.uint8))
    arguments = ("measure", "pins", tmp_path / "photo.png", "-d", tmp_path / "phantom.json")
    status, out, err = reseau(*arguments, "-o", tmp_path / "m.json")
    assert (status, err) == (0, "")
    assert "9 of 9 rods measured" in out
    assert "N2: cut at 0.55" in out
    found = {point.id: point for point in ReseauMeasurement.read(tmp_path / "m.json").points}
    for name, true in zip(("N1", "N2", "N3"), share, strict=True):
        assert found[name].share == pytest.approx(true, abs=0.002)
        assert 1e-5 < found[name].s_share < 0.002
    assert found["R1"].share is None


def test_json_and_csv_contain_the_same_values(reseau: Run, bench: tuple[Path, Path], tmp_path: Path) -> None:
    image, design = bench
    status, out, _ = reseau("measure", "pins", image, "-d", design, "-o", tmp_path / "m.csv", "--json")
    assert status == 0
    reported = ReseauMeasurement.parse(out, where="output").image_points()
    read = ReseauMeasurement.read_csv(tmp_path / "m.csv").image_points()
    assert reported.names == read.names
    assert np.abs(reported.xy - read.xy).max() < 1e-5


def test_unmeasurable_images_are_reported_in_one_line(
    reseau: Run, bench: tuple[Path, Path], tmp_path: Path
) -> None:
    image, design = bench
    crossed = ReseauDesign.read(design).to_json().replace('"rod"', '"disk"')
    (tmp_path / "disks.json").write_text(crossed, "utf-8")
    write_image(tmp_path / "dark.png", np.zeros((100, 120), np.uint8))
    noise = np.random.default_rng(0).integers(5, 12, (200, 300)).astype(np.uint8)
    write_image(tmp_path / "blank.png", noise)
    for arguments, expected, reason in (
        ((image, "-d", tmp_path / "disks.json"), 2, "disk"),
        ((tmp_path / "dark.png", "-d", design), 1, "is all black"),
        ((tmp_path / "blank.png", "-d", design), 1, "not found"),
        ((image, "-d", tmp_path / "none.json"), 2, "none.json"),
    ):
        status, out, err = reseau("measure", "pins", *arguments, "-o", tmp_path / "never.json")
        assert (status, out) == (expected, "")
        assert reason in err
        assert err.count("\n") == 1
        assert not (tmp_path / "never.json").exists()
