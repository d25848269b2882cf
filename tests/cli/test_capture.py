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
from reseau.core.data import Frame
from reseau.core.errors import StateError
from reseau_sims import FieldBench

from ..capture.fieldrig import BENCH, POSES, TESTFIELD, FieldRig, Sweeper, enter, write_inputs


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FieldRig:
    """A folder with a bench file, a design and poses; and the simulated instruments."""
    rig = FieldRig()
    enter(tmp_path, monkeypatch, rig, near=Sweeper("near"), far=Sweeper("far"))
    write_inputs()
    return rig


def capture(*arguments: str) -> int:
    return run(["capture", *arguments])


@pytest.mark.slow
def test_a_testfield_from_poses_to_a_calibration_that_can_be_rerun(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    assert capture("testfield", *TESTFIELD, "--name", "monday", "--park", "tilt=10") == 0
    out = capsys.readouterr().out
    assert "checks: passed" in out
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
    assert [row["name"] for row in document["results"]] == ["calibration.json", "report.html", "scene.json"]
    assert run(["archive", "export", "monday", "--out", "monday.zip"]) == 0
    with zipfile.ZipFile("monday.zip") as made:
        assert sum(name.endswith(".tif") for name in made.namelist()) == 8  # three were checks
    assert run(["archive", "verify"]) == 0
    assert "intact" in capsys.readouterr().out
    file = next(Path("archive/objects").rglob("*.tif"))
    file.write_bytes(file.read_bytes()[:-1] + b"?")
    assert run(["archive", "verify"]) == 1
    assert "damaged" in capsys.readouterr().out


OWN = """\
from reseau.capture import Step

def plan(run, tilts, average=1):
    for tilt in tilts:
        yield from run.at(Step(f"tilt {tilt}", {"tilt": tilt}), average)
"""


def test_a_user_plan_is_carried_out_and_resumed_with_its_original_code(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("own.py").write_text(OWN)
    Path("own.toml").write_text('generator = "own.py"\n[set]\ntilts = [10, 20, 30]\naverage = 2\n')

    def stall(axis: str, position: float) -> None:
        if position == 30:
            raise StateError("stalled", where="table", command="move")

    rig.table.before = stall
    assert capture("own", "--options", "own.toml", "--name", "a") == 1
    assert rig.camera.exposures == 4
    Path("own.py").unlink()
    rig.table.before = lambda axis, position: None
    assert capture("own", "--resume") == 0
    assert capsys.readouterr().out.endswith("a: done, 3 frames in archive\n")
    assert rig.camera.exposures == 6
    assert rig.table.stands["tilt"] == 30
    assert run(["archive", "show", "a", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["parameters"]["set"] == {"tilts": [10, 20, 30], "average": 2}
    assert [f["facts"].get("averaged") for f in document["frames"]] == [None, 2, 2, 2]


@pytest.mark.parametrize(
    ("text", "options", "says"),
    [
        (
            OWN,
            ["--set", "tilts=[1]", "--set", "rolls=2"],
            "own.py: does not accept the arguments (got",
        ),
        (OWN, [], "own.py: does not accept the arguments (missing a required argument: 'tilts')"),
        (OWN, ["--set", "tilts"], "--set: cannot interpret 'tilts'; write name=value, as tilt=30"),
        ("def plan(run:\n", [], "own.py: line 1 is not Python"),
        ("def plan(run):\n    return 1\n", [], "own.py: has no generator `plan(run, …)`"),
    ],
)
def test_an_invalid_own_plan_is_reported_in_one_line(
    rig: FieldRig, capsys: pytest.CaptureFixture[str], text: str, options: list[str], says: str
) -> None:
    Path("own.py").write_text(text)
    assert capture("own", "--generator", "own.py", *options) == 2
    err = capsys.readouterr().err
    assert says in err
    assert err.count("\n") == 1
    assert not Path("archive").exists()


def test_impossible_requests_to_an_archive_are_reported_in_one_line(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    assert capture("frames", "--name", "a") == 0
    rig.camera.spoil = lambda number, pixels: pixels // 20
    assert capture("testfield", *TESTFIELD, "--name", "b") == 1
    capsys.readouterr()
    for arguments, says in {
        ("show", "c"): "c: is not a session of this archive",
        ("show", "a", "--out", "poses.csv"): "poses.csv: cannot be created (File exists); name a folder",
        ("show", "a", "--out", "none/deep"): "none/deep: cannot be created (No such file",
        ("rerun", "a"): "a: plan `frames` computes nothing",
        ("rerun", "b"): "b: has no results (status: failed)",
        ("export", "a", "--out", "a.tar"): "a.tar: has the suffix '.tar'; use .zip",
        ("list", "--archive", "none"): "is not an archive",
    }.items():
        assert run(["archive", *arguments]) in (1, 2)
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        assert says in err


def test_options_come_from_a_toml_file_and_the_command_line_takes_precedence(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("plan.toml").write_text('count = 3\nname = "toml"\n')
    assert capture("frames", "--options", "plan.toml", "--count", "2", "--json") == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event["event"] for event in events] == ["begin", "frame", "frame", "end"]
    assert (events[0]["session"], events[0]["archive"], events[0]["poses"]) == ("toml", "archive", 2)
    assert events[-1]["status"] == "done"
    Path("plan.toml").write_text('checks = 0\nfirst = "x"\n')
    assert capture("testfield", "--options", "plan.toml") == 2
    assert "--first" in capsys.readouterr().err
    Path("plan.toml").write_text("cuont = 3\n")
    assert capture("frames", "--options", "plan.toml") == 2
    assert "plan.toml: unknown key `cuont`; use " in capsys.readouterr().err


def test_toml_keys_are_option_names_and_values_may_be_lists_and_tables(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("monday.toml").write_text(
        'design = "field.json"\nposes = "poses.csv"\npitch-mm = 0.027\nfree = ["c", "x0", "y0", "K1"]\n'
        "row-jitter-px = 0.0086\nfill = 0.8\nchecks = 0\njson = true\n[park]\ntilt = 7\nroll = 0.5\n"
    )
    Path("poses.csv").write_text("tilt\n0\n")
    assert capture("testfield", "--options", "monday.toml", "--name", "monday") == 1
    out, failed = capsys.readouterr()
    assert '"event": "end", "status": "failed"' in out
    assert "1 image" in failed  # of one nothing can be computed
    assert (rig.table.stands["tilt"], rig.table.stands["roll"]) == (7, 0.5)
    assert run(["archive", "show", "monday", "--json"]) == 0
    given = json.loads(capsys.readouterr().out)["parameters"]
    assert (given["free"], given["row_jitter_px"], given["park"]) == (
        ["c", "x0", "y0", "K1"],
        0.0086,
        {"tilt": 7.0, "roll": 0.5},
    )
    Path("photos.toml").write_text('reseau = "none.json"\ntest-object = "none.json"\nbody = false\n')
    assert capture("oscilloscope", "--options", "photos.toml") == 2
    assert "none.json: cannot be read" in capsys.readouterr().err


def test_options_cannot_be_changed_with_resume(rig: FieldRig, capsys: pytest.CaptureFixture[str]) -> None:
    assert capture("frames", "--count", "2", "--name", "a") == 0
    capsys.readouterr()
    assert capture("frames", "--resume", "--name", "a", "--count", "3") == 2
    assert capsys.readouterr().err == "reseau: --count: cannot be changed with --resume; omit it\n"
    assert rig.camera.exposures == 2


def test_events_for_programs_are_json_lines(rig: FieldRig, capsys: pytest.CaptureFixture[str]) -> None:
    def strict(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    rig.camera.spoil = lambda number, pixels: np.full_like(pixels, 120)
    assert capture("frames", "--checks", "2", "--name", "a", "--json") == 1
    out, failed = capsys.readouterr()
    events = [json.loads(line, parse_constant=strict) for line in out.splitlines()]
    assert [event["event"] for event in events] == ["begin", "check", "end"]
    assert events[1]["edge_px"] is None
    assert events[-1]["status"] == "failed"
    assert failed == f"reseau: {events[-1]['why']}\n"


@pytest.mark.slow
def test_a_failed_session_is_resumed_where_it_stopped(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    def stall(axis: str, position: float) -> None:
        if position == 180:
            raise StateError("stalled", where="table", command="move", do="free the axis")

    rig.table.before = stall
    assert capture("testfield", *TESTFIELD, "--name", "monday", "--checks", "0", "--retreat", "tilt=3") == 1
    assert rig.table.stands["tilt"] == 3
    assert capsys.readouterr().err.strip().endswith("reseau: table (move): stalled; free the axis")
    rig.table.before = lambda axis, position: None
    assert capture("testfield", "--resume") == 0
    assert "monday: done, 5 frames" in capsys.readouterr().out
    assert rig.camera.exposures == 5
    assert capture("testfield", "--resume") == 2
    assert "testfield: no session can be resumed" in capsys.readouterr().err
    assert capture("frames", "--resume", "--name", "monday") == 2
    assert "monday: its plan is `testfield`" in capsys.readouterr().err


@pytest.mark.slow
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
    assert "b: sigma_c < 1e-06 mm not reached: no pose is left" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["testfield"], "--design: is missing"),
        (["testfield", "--design", "none.json"], "none.json: cannot be read"),
        (["testfield", "--design", "bench.toml"], "bench.toml: is no"),
        (["frames", "--bench", "none.toml"], "none.toml: cannot be read"),
        (["frames", "--name", "a/b"], "is not a valid name of a session"),
        (["frames", "--resume"], "is not an archive"),
        (["testfield", *TESTFIELD, "--until", "c < 1"], "is not a goal"),
        (["testfield", *TESTFIELD, "--park", "tilt"], "--park: cannot interpret 'tilt'"),
        (["testfield", *TESTFIELD, "--park", "z=0"], "park: the table has no axis z; use tilt, roll"),
        (
            ["testfield", *TESTFIELD, "--park", "roll=400"],
            "park: roll = 400 deg is out of range; use -5 to",
        ),
        (["testfield", *TESTFIELD, "--heights", "0,50"], "z 0: the table has no axis z"),
        (["testfield", *TESTFIELD[:-6], "--free", "c,q"], "q: is not one of c, x0"),
        (
            ["testfield", *TESTFIELD, "--until", "sigma_K2 < 1"],
            "sigma_K2: is not estimated; use c, x0",
        ),
        (["testfield", *TESTFIELD, "--until", "sigma_c < 1 px"], "sigma_c: has the unit mm, not px"),
        (["testfield", *TESTFIELD[:4], "--until", "sigma_fx < 1 um"], "sigma_fx: has the unit px, not mm"),
        (["scan"], "bench field: has no scanner"),
        (["frames", "--camera", "table"], "table: is no camera"),
        (["frames", "--archive", "poses.csv"], "cannot be created"),
    ],
)
def test_impossible_requests_are_reported_in_one_line(
    rig: FieldRig, capsys: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    assert capture(*arguments) in (1, 2)
    err = capsys.readouterr().err.strip()
    assert says in err.splitlines()[-1]
    assert "Traceback" not in err
    assert rig.camera.exposures == 0
    assert not rig.table.moves
    if Path("archive").is_dir():  # no session began that could do nothing
        assert run(["archive", "list"]) == 0
        assert capsys.readouterr().out == ""


def test_a_bench_in_use_is_refused(rig: FieldRig, capsys: pytest.CaptureFixture[str]) -> None:
    from reseau.capture import BenchLock

    with BenchLock(["sim-camera"], "session other"):
        assert capture("frames", "--name", "a") == 1
    assert "sim-camera: is in use by session other" in capsys.readouterr().err
    assert capture("frames", "--name", "a") == 0  # the name was not given away


def test_a_session_that_another_process_carries_out_is_not_resumed(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not on another bench either, and before its frames are looked through."""
    from reseau.archive import Archive, tiff_of
    from reseau.capture import BenchLock

    rig.camera.spoil = lambda number, pixels: 0 // 0
    with pytest.raises(ZeroDivisionError):
        capture("frames", "--name", "a")
    with Archive.open("archive") as archive:
        key = {"session": "a", "step": "00000", "kind": "frame", "take": 0}
        archive.objects.put(tiff_of(Frame(np.zeros((4, 4), np.uint8), 255.0), key), ".tif")
        with BenchLock([f"{archive.place}: a"], "session a"):
            assert capture("frames", "--resume") == 1
        assert "archive: a: is in use by session a (process" in capsys.readouterr().err
        assert not archive.session("a").frames()


def test_sections_come_from_the_named_scanner_also_after_resume(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    names = ("near", "far")
    Path("bench.toml").write_text(
        BENCH + "".join(f'[instruments.{n}]\ndriver = "{n}"\naddress = "sim-{n}"\n' for n in names)
    )
    assert capture("scan") == 2
    assert "has several of scanner: near, far; give `--scanner NAME`" in capsys.readouterr().err
    assert capture("scan", "--scanner", "far", "--count", "2", "--name", "a") == 0
    out = capsys.readouterr().out
    assert out == "session a\n1/2 section 000: scan\n2/2 section 001: scan\na: done, 2 scans in archive\n"
    assert capture("scan", "--resume", "--name", "a") == 0
    capsys.readouterr()
    assert run(["archive", "show", "a", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["parameters"]["scanner"] == "far"
    assert [f["facts"]["frequency_khz"] for f in document["frames"]] == [None, None]
    assert run(["archive", "list"]) == 0
    assert "2 frames   0 results  done       a" in capsys.readouterr().out


def test_bad_frames_are_reported_and_stored(rig: FieldRig, capsys: pytest.CaptureFixture[str]) -> None:
    rig.camera.spoil = lambda number, pixels: np.zeros_like(pixels) if number == 1 else pixels
    assert capture("frames", "--count", "2", "--retakes", "1", "--name", "a") == 0
    assert "0/2 00000: brightest pixels reach only 0 % of full scale: expose more" in capsys.readouterr().out
    assert run(["archive", "show", "a", "--json"]) == 0
    document: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert [(f["take"], f["ok"]) for f in document["frames"]] == [(0, False), (1, True), (0, True)]


@pytest.mark.slow
def test_the_operator_is_asked_and_a_photograph_without_a_reseau_ends_the_session(
    rig: FieldRig, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    designs.standard_reseau().write("reseau.json")
    designs.test_object().write("rods.json")
    given = ["--reseau", "reseau.json", "--test-object", "rods.json", "--retakes", "0"]
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    assert capture("oscilloscope", *given, "--name", "a") == 1
    err = capsys.readouterr().err.splitlines()
    assert err[0] == "blank the screen: only the reseau is photographed, then press Enter"
    assert err[-1].startswith("reseau: PHOTO I: ")
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    assert capture("oscilloscope", *given, "--name", "b") == 2
    assert "standard input is closed; run the command in a terminal" in capsys.readouterr().err
    assert rig.camera.exposures == 1


@pytest.mark.slow
def test_a_goal_is_not_reached_by_images_of_a_target_that_bends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    enter(tmp_path, monkeypatch, FieldRig(FieldBench(seed=1)))  # by its own weight, as in the paper
    write_inputs(
        "tilt,roll,camera_roll\n0,0,0\n45,180,180\n30,0,180\n30,180,0\n30,90,90\n30,270,90\n30,90,270\n"
    )
    given = ("--until", "sigma_c < 0.2 mm", "--first", "6", "--name", "monday")
    assert capture("testfield", *TESTFIELD, *given) == 1
    said = capsys.readouterr()
    assert "sigma_c < 0.2 mm not reached" in said.err
    assert "the images contradict each other by" in said.err
    assert "images have errors in common: sigmas are" in said.out
