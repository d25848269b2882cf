"""The tours: every command and every line of Python, in the order of the page, in an empty folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from reseau.archive import Archive
from reseau.calibration import Calibration
from reseau.cli import run
from reseau.service import Configurations
from reseau_sims import World

from ..capture.fieldrig import BENCH, DESIGN, FieldRig, enter
from .touring import draw_demo, follow, same


def test_numbers_may_differ_in_the_last_digits_and_words_not() -> None:
    assert same("fx 689.986 ± 0.021 px", "fx 689.985 ± 0.021 px")
    assert not same("fx 689.986 ± 0.021 px", "fx 589.986 ± 0.021 px")
    assert not same("12 images", "14 images")
    assert not same("usable for measurement", "not usable")
    assert same("3 points, ...; take 10 photographs", "3 points, 4 lines; take 10 photographs")
    assert not same("3 points, ...; take 10 photographs", "3 points, 4 lines; take 20 photographs")
    assert not same("3 points, ...", "5 points, 4 lines")


@pytest.mark.slow
def test_a_bench_is_automated_and_scheduled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    enter(tmp_path, monkeypatch, FieldRig())

    def simulated(words: list[str]) -> bool:
        """The bench of the tests has other instruments: it is checked, and prints others."""
        if words[1:3] == ["bench", "check"]:
            assert run(words[1:]) == 0
        return words[1:3] in (["bench", "sim"], ["bench", "check"])

    def waiting() -> str:
        with Archive.open("archive") as archive:
            return str(Configurations(archive).history("left")[0].key)

    Path("bench.toml").write_text(BENCH, "utf-8")
    DESIGN.write("field.json")
    follow("tours/bench", tmp_path, instead=simulated, values={"KEY": waiting})
    with Archive.open("archive") as archive:
        assert len(archive.sessions()) >= 2
    assert "SUMMARY:weekly: scheduled" in Path("weekly.ics").read_text("utf-8")


@pytest.mark.slow
def test_a_camera_is_calibrated_its_report_read_and_its_certificate_issued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def waiting() -> str:
        with Archive.open("archive") as archive:
            return str(Configurations(archive).history("d1")[0].key)

    follow("tours/camera", tmp_path)
    truth = {
        "fx": 690.0,
        "fy": 689.0,
        "cx": 363.4,
        "cy": 236.8,
        "k1": -0.19,
        "k2": 0.05,
        "p1": 8e-4,
        "p2": -5e-4,
    }
    camera = Calibration.read("camera.json")
    for name, true in truth.items():
        assert abs(camera.values()[name] - true) < 4 * camera.parameters[name].sigma
    follow("tours/report", tmp_path)
    pytest.importorskip("lxml", reason="certificates need the extra `certificates`")
    follow("tours/certificate", tmp_path, values={"KEY": waiting})
    assert "R-7" in Path("certificate.html").read_text("utf-8")
    follow("tours/notebook", tmp_path)
    assert all(Path(name).stat().st_size > 5000 for name in ("result.png", "result.html", "difference.png"))


@pytest.mark.slow
def test_a_roll_of_film_is_oriented(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    follow("tours/film", tmp_path)
    assert Path("oriented/summary.html").exists()


@pytest.mark.slow
def test_a_camera_under_water_is_calibrated_without_and_with_the_water(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    follow("tours/underwater", tmp_path)
    c = Calibration.read("dry.json").parameters["c"]
    assert abs(c.value - 8.0) < 4 * c.sigma


@pytest.mark.slow
def test_blurred_targets_are_measured_by_the_rays_of_their_lens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("batoid", reason="batoid's rays draw the photograph")
    monkeypatch.chdir(tmp_path)
    follow("tours/blurred", tmp_path)
    truth = json.loads(Path("out/blurred/truth.json").read_text("utf-8"))
    points = json.loads(Path("out/blurred/targets.json").read_text("utf-8"))["points"]
    assert len(points) == len(truth) == 24
    errors = np.array([np.subtract((p["x"], p["y"]), truth[p["id"]]) for p in points])
    sigmas = np.array([(p["sx"], p["sy"]) for p in points])
    assert np.sqrt(((errors / sigmas) ** 2).mean()) < 1.4
    assert np.abs(errors).max() < 0.03


@pytest.mark.slow
def test_blurred_targets_are_measured_under_water(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("batoid", reason="batoid's rays draw the photographs")
    monkeypatch.chdir(tmp_path)
    follow("tours/blurred-under-water", tmp_path)
    assert Path("out/underwater/measured/report.html").exists()


@pytest.mark.slow
def test_an_instrument_is_corrected_in_three_photographs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the photographs of the demo's world; `make demo`, a part of CI, runs the demo itself."""
    monkeypatch.chdir(tmp_path)

    def demo(words: list[str]) -> bool:
        if words[:2] != ["reseau", "demo"]:
            return words[:3] == ["reseau", "archive", "list"]
        draw_demo()
        photos = ["--photo-i", "out/photo_i.png", "--photo-ii", "out/photo_ii.png"]
        designs = ["--reseau", "out/reseau.json", "--test-object", "out/rods.json"]
        return run(["refine", *photos, *designs, "--out", "out/calibration.json"]) == 0

    follow("tours/instrument", tmp_path, instead=demo)
    header, *points = Path("true.csv").read_text("utf-8").splitlines()
    assert header == "id,x,y,sx,sy"
    true = World.standard(seed=1).truth_iii().object_xy
    found = np.array([[float(value) for value in line.split(",")[1:]] for line in points])
    assert len(found) > 0.8 * len(true)
    error = found[:, None, :2] - true
    nearest = error[np.arange(len(found)), np.linalg.norm(error, axis=2).argmin(axis=1)]
    # Without a list of the points all echoes are measured, numbered anew.
    assert (abs(nearest) < 5 * found[:, 2:]).all()
