"""The demo: the whole procedure, the same to the byte, whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from reseau.archive import Archive
from reseau.archive.verification import verify
from reseau.calibration import Calibration, InstrumentCorrection
from reseau.cli import run
from reseau.io import ReseauDesign, ReseauMeasurement
from reseau_sims import World
from reseau_sims.serving import aravis_is_installed

FILES = {
    "archive",
    "camera.json",
    "testfield.html",
    "report.html",
    "overview.png",
    "photo_i.png",
    "photo_ii.png",
    "photo_iii.png",
    "calibration.json",
    "reseau.json",
    "rods.json",
    "marks_i.json",
    "rods_ii.json",
    "points_iii.json",
    "true.csv",
    "comparison.json",
}
Run = Callable[..., tuple[int, str, str]]


pytestmark = pytest.mark.slow  # one run of the whole demo; `make demo` is a part of CI


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Its folder, and its output."""
    folder, message = tmp_path_factory.mktemp("demo") / "out", StringIO()
    with redirect_stdout(message):
        assert run(["demo", "--out", str(folder), "--seed", "2"]) == 0
    return folder, message.getvalue()


@pytest.fixture(scope="module")
def out(made: tuple[Path, str]) -> Path:
    return made[0]


def true_coordinates(path: Path) -> dict[str, tuple[float, ...]]:
    header, *lines = path.read_text("utf-8").splitlines()
    assert header == "id,x,y,sx,sy"
    rows = [line.split(",") for line in lines]
    return {row[0]: tuple(map(float, row[1:])) for row in rows}


def test_all_files_exist_and_are_consistent(out: Path) -> None:
    assert {path.name for path in out.iterdir()} == FILES
    assert [path.name for path in out.parent.iterdir()] == ["out"]
    instrument, reseau, rods = InstrumentCorrection.from_calibration(
        Calibration.read(out / "calibration.json")
    )
    assert reseau == ReseauDesign.read(out / "reseau.json")
    assert rods == ReseauDesign.read(out / "rods.json")
    marks, pins, points = (
        ReseauMeasurement.read(out / f"{name}.json") for name in ("marks_i", "rods_ii", "points_iii")
    )
    assert marks.found == marks.expected == 165
    assert 30 <= pins.found <= pins.expected == 38
    # The camera stood still, so that the stored calibration gives what was written, but for the registration.
    again, written = instrument.apply(points.image_points()), true_coordinates(out / "true.csv")
    assert list(again.names) == list(written)
    assert np.abs(again.xy - np.array(list(written.values()))[:, :2]).max() < 0.01  # millimetres


def test_every_frame_is_archived_and_can_be_used_again(out: Path) -> None:
    with Archive.open(out / "archive") as archive:
        assert [(s.name, s.status) for s in archive.sessions()] == [
            ("oscilloscope", "done"),
            ("testfield", "done"),
        ]
        assert verify(archive)
        kinds = [frame.kind for frame in archive.session("oscilloscope").frames()]
        assert kinds == ["input"] * 2 + [
            "frame",
            "screen",
            "scan",
            "frame",
            "screen",
            "scan",
            "frame",
            "screen",
        ]
        results = archive.session("testfield").results()
    camera, kept = Calibration.read(out / "camera.json"), results[0]
    assert kept.name == "calibration.json"
    assert len(kept.inputs) == 13  # the design is one of them
    truth = json.loads((out / "comparison.json").read_text())["testfield"]["parameters"]
    for name, row in truth.items():
        assert camera.parameters[name].value == row["value"]
        assert abs(row["value"] - row["true"]) < 4 * row["sigma"]


@pytest.mark.parametrize("name", ["oscilloscope", "testfield"])
def test_results_are_recomputed_from_the_archive_to_the_byte(out: Path, reseau: Run, name: str) -> None:
    with threadpool_limits(2, user_api="blas"):  # whatever the machine has
        status, message, err = reseau("archive", "rerun", name, "--archive", out / "archive")
    second = {"oscilloscope": "true.csv", "testfield": "report.html"}[name]
    assert {"calibration.json: identical", f"{second}: identical"} <= set(message.splitlines())
    assert all(line.endswith(": identical") for line in message.splitlines())
    assert (status, err) == (0, "")


def test_each_group_removes_its_part_of_the_error_and_the_sigmas_are_correct(out: Path) -> None:
    truth = json.loads((out / "comparison.json").read_text())
    check = {stage["name"]: max(stage["check"]) for stage in truth["camera"]["stages"]}
    assert check["best similarity"] > 0.05
    assert check["corrected"] < 0.003
    assert max(truth["camera"]["position_px"]) < 0.012
    left = {factor["name"]: np.hypot(*factor["ideal"]) for factor in truth["factors"]}
    assert left["groups A and B"] < 0.4 * min(left["group A"], left["group B"])
    assert max(left["group A"], left["group B"]) < left["scales and best similarity"]
    (body,) = truth["bodies"]
    assert body["strays"] == 0
    assert body["points"] > 18
    assert max(body["error"]) < 0.2  # the rods' tolerance is 0.25 mm
    assert max(body["error_normalised"]) < 2.0


def test_the_source_of_the_frames_is_reported(made: tuple[Path, str]) -> None:
    gige = aravis_is_installed()
    ways = ("Video4Linux, simulated in process (Aravis or PyGObject is not installed)", "GigE Vision")
    assert f"\n{ways[gige]}; all frames are in" in made[1]
    assert ways[not gige] not in made[1]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes_except_clock_times(
    out: Path, reseau: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("reseau.sessions.demo._gige_available", lambda: False)
    status, text, err = reseau("demo", "--out", tmp_path / "again", "--seed", 2, "--json")
    assert (status, err) == (0, "")
    assert text == (out / "comparison.json").read_text()
    for name in FILES - {"calibration.json", "archive"}:
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes(), name
    one, other = (
        json.loads((folder / "calibration.json").read_text()) for folder in (out, tmp_path / "again")
    )
    assert set(one.pop("times")) == set(other.pop("times")) == {"computed"}
    assert one == other


def test_an_error_leaves_existing_files_unchanged(
    reseau: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "mine.txt").write_text("keep")

    def dark(seed: int) -> World:
        """A world whose shutter stays shut."""
        world = World.standard(seed)
        world.screen.light *= 0
        return world

    monkeypatch.setattr("reseau_sims.serving.bench.World", SimpleNamespace(standard=dark))
    status, text, err = reseau("demo", "--out", folder)
    assert status in (1, 2)
    assert text == ""
    assert err.startswith("reseau: PHOTO I")
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "mine.txt"]


def test_an_invalid_output_folder_is_refused_at_once(reseau: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for place in (tmp_path / "file", tmp_path / "none" / "out"):
        status, _, err = reseau("demo", "--out", place)
        assert status == 2
        assert err.count("\n") == 1
