"""`reseau capture` and `reseau archive`, as a user has them, on a bench without protocols."""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau import designs
from reseau.cli import run
from reseau.errors import StateError

from ..capture.fieldrig import DESIGN, FieldRig

BENCH = """\
schema = "reseau-bench/1"
name = "field"
[instruments.table]
driver = "table"
address = "sim-table"
[instruments.camera]
driver = "camera"
address = "sim-camera"
"""
POSES = "tilt,roll,camera_roll\n0,0,0\n30,90,90\n30,180,180\n30,270,270\n30,0,0\n"
TESTFIELD = ("--design", "field.json", "--poses", "poses.csv", "--pitch", "0.027", "--free", "c,x0,y0,K1",
             "--row-jitter", "0.0086", "--fill", "0.8")  # fmt: skip


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FieldRig:
    """A folder with a bench, a design and poses; and what stands behind the bench."""
    rig = FieldRig()
    made = {"table": rig.table, "camera": rig.camera}
    monkeypatch.setattr("reseau.capture.bench.plugin", lambda group, name: lambda *args, **more: made[name])
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))  # locks of parallel tests are apart
    monkeypatch.chdir(tmp_path)
    Path("bench.toml").write_text(BENCH)
    Path("poses.csv").write_text(POSES)
    DESIGN.write("field.json")
    return rig


def capture(*arguments: str) -> int:
    return run(["capture", *arguments])


def test_a_testfield_from_poses_to_a_calibration_that_can_be_rerun(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    assert capture("testfield", *TESTFIELD, "--name", "monday", "--park", "tilt=10") == 0
    out = capsys.readouterr().out
    assert "checks: good" in out
    assert "5/5 tilt 30 roll 0 camera_roll 0" in out
    assert "sigma_c 0.0" in out
    assert "monday: done, 5 frames in archive\n  calibration.json\n  report.html\n" in out
    assert rig.table.stands["tilt"] == 10

    assert run(["archive", "list"]) == 0
    assert "testfield" in (out := capsys.readouterr().out)
    assert "done       monday" in out
    assert run(["archive", "show", "monday", "--out", "results"]) == 0
    assert capsys.readouterr().out.count("good") == 5
    calibration = json.loads(Path("results/calibration.json").read_text())
    assert abs(calibration["parameters"]["c"]["value"] - 57.5) < 4 * calibration["parameters"]["c"]["sigma"]
    assert Path("results/report.html").read_text().startswith("<!DOCTYPE html>")

    assert run(["archive", "rerun", "monday", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["same"]
    assert [row["name"] for row in document["results"]] == ["calibration.json", "report.html"]
    assert run(["archive", "export", "monday", "--out", "monday.zip"]) == 0
    with zipfile.ZipFile("monday.zip") as made:
        assert sum(name.endswith(".tif") for name in made.namelist()) == 8  # three were checks
    assert run(["archive", "verify"]) == 0
    assert "sound" in capsys.readouterr().out
    file = next(Path("archive/objects").rglob("*.tif"))
    file.write_bytes(file.read_bytes()[:-1] + b"?")
    assert run(["archive", "verify"]) == 1
    assert "damaged" in capsys.readouterr().out


def test_options_come_from_a_toml_file_and_the_command_line_wins(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("plan.toml").write_text('count = 3\nname = "toml"\n')
    assert capture("frames", "--plan", "plan.toml", "--count", "2", "--json") == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event["event"] for event in events] == ["frame", "frame", "end"]
    assert events[-1]["status"] == "done"
    Path("plan.toml").write_text("cuont = 3\n")
    assert capture("frames", "--plan", "plan.toml") == 2
    assert "plan.toml: unknown key `cuont`; there are" in capsys.readouterr().err


def test_a_session_that_failed_is_resumed_where_it_stood(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    def stall(axis: str, position: float) -> None:
        if position == 180:
            raise StateError("stalled", where="table", command="move", do="free the axis")

    rig.table.before = stall
    assert capture("testfield", *TESTFIELD, "--name", "monday", "--checks", "0") == 1
    assert capsys.readouterr().err.strip().endswith("reseau: table (move): stalled; free the axis")
    rig.table.before = lambda axis, position: None
    assert capture("testfield", "--resume") == 0
    assert "monday: done, 5 frames" in capsys.readouterr().out
    assert rig.camera.exposures == 5
    assert capture("testfield", "--resume") == 2
    assert "none can be resumed; name one with --name" in capsys.readouterr().err
    assert capture("frames", "--resume", "--name", "monday") == 2
    assert "is a session of testfield; use `capture testfield`" in capsys.readouterr().err


def test_poses_are_chosen_until_the_goal_is_met(rig: FieldRig, capsys: pytest.CaptureFixture[str]) -> None:
    options = [*TESTFIELD[:2], *TESTFIELD[4:], "--checks", "0"]
    assert capture("testfield", *options, "--until", "sigma_c < 6 um", "--name", "a", "--json") == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    reached = [event["sigma_c"] for event in events if event["event"] == "precision"]
    assert reached[-1] < 6e-3 <= min(reached[:-1])
    assert 5 <= rig.camera.exposures < 12
    options[1] = "field.json"
    Path("few.csv").write_text(POSES)
    why = capture("testfield", *TESTFIELD, "--checks", "0", "--until", "sigma_c < 1 nm", "--name", "b")
    assert why == 1
    assert "b: no pose is left that would help to reach sigma_c < 1e-06 mm" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["testfield"], "--design: is needed"),
        (["testfield", "--design", "none.json"], "none.json: cannot be read"),
        (["testfield", "--design", "bench.toml"], "bench.toml: is no JSON"),
        (["frames", "--bench", "none.toml"], "none.toml: cannot be read"),
        (["frames", "--name", "a/b"], "is no name of a session"),
        (["frames", "--resume"], "is no archive"),
        (["testfield", *TESTFIELD, "--until", "c < 1"], "is no goal"),
        (["testfield", *TESTFIELD, "--park", "tilt"], "--park: is 'tilt'"),
        (["scan"], "has none for a UltrasonicScanner"),
        (["frames", "--camera", "table"], "table: is no Camera"),
        (["frames", "--archive", "poses.csv"], "cannot be made"),
    ],
)
def test_what_cannot_be_done_is_told_in_one_line(
    rig: FieldRig, capsys: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    assert capture(*arguments) in (1, 2)
    err = capsys.readouterr().err.strip()
    assert says in err.splitlines()[-1]
    assert "Traceback" not in err
    assert rig.camera.exposures == 0


def test_a_bench_in_use_is_refused(rig: FieldRig, capsys: pytest.CaptureFixture[str]) -> None:
    from reseau.capture import BenchLock

    with BenchLock(["sim-camera"], "session other"):
        assert capture("frames", "--name", "a") == 1
    assert "sim-camera: is in use by session other" in capsys.readouterr().err


def test_bad_frames_are_told_and_kept(rig: FieldRig, capsys: pytest.CaptureFixture[str]) -> None:
    rig.camera.spoil = lambda number, pixels: np.zeros_like(pixels) if number == 1 else pixels
    assert capture("frames", "--count", "2", "--retakes", "1", "--name", "a") == 0
    assert "0/2 00000: reaches 0 % of full scale only; expose more" in capsys.readouterr().out
    assert run(["archive", "show", "a", "--json"]) == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert [(f["take"], f["ok"]) for f in document["frames"]] == [(0, False), (1, True), (0, True)]


def test_the_operator_is_asked_and_a_photograph_that_shows_no_reseau_ends_it(
    rig: FieldRig, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    designs.standard_reseau().write("reseau.json")
    designs.test_object().write("rods.json")
    given = ["--reseau", "reseau.json", "--object", "rods.json", "--retakes", "0"]
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    assert capture("oscilloscope", *given, "--name", "a") == 1
    err = capsys.readouterr().err.splitlines()
    assert err[0] == "blank the screen; nothing but the reseau is photographed, then press Enter"
    assert err[-1].startswith("reseau: PHOTO I: ")
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    assert capture("oscilloscope", *given, "--name", "b") == 2
    assert "nobody answers; run it where someone can" in capsys.readouterr().err
    assert rig.camera.exposures == 1
