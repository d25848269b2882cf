"""`reseau bench status|home|move|stop|set|expose|watch`, and what a session checks before it begins."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from reseau.capture import BenchLock
from reseau.cli import run

from ..capture.fieldrig import BENCH, FieldRig, Sweeper, enter, write_inputs

SWEEPER = '[instruments.sweeper]\ndriver = "sweeper"\naddress = "sim-sweeper"\n'


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FieldRig:
    """A bench whose scanner does not answer."""
    rig, sweeper = FieldRig(), Sweeper("sweeper")
    sweeper.silent = True
    enter(tmp_path, monkeypatch, rig, sweeper=sweeper)
    write_inputs()
    Path("bench.toml").write_text(BENCH.replace("[inst", "# left as it is\n[inst", 1) + SWEEPER)
    return rig


def bench(*arguments: str) -> int:
    return run(["bench", *arguments])


def test_status_has_every_instrument_and_names_the_silent_one(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    rig.table.lost = {"roll"}
    assert bench("status") == 1
    out = capsys.readouterr().out
    assert "tilt         0 deg (-5 to 360)" in out
    assert "roll         no reference (-5 to 360 deg)" in out
    assert "exposure_us 1000 µs" in out
    assert "sweeper (sweeper): sweeper (connect): does not answer; is it switched on?" in out
    assert bench("status", "--json") == 1
    rows = json.loads(capsys.readouterr().out)["instruments"]
    assert [row["name"] for row in rows] == ["table", "camera", "sweeper"]
    assert not rig.table.moves


def test_axes_are_homed_and_moved_within_their_range(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    rig.table.lost = {"tilt", "roll"}
    assert bench("move", "tilt=10") == 1
    assert "tilt: has no reference; run `reseau bench home tilt`" in capsys.readouterr().err
    assert bench("home") == 0
    assert "tilt, roll: homed" in capsys.readouterr().out
    assert bench("move", "tilt=10", "roll=-2.5") == 0
    assert bench("move", "tilt=5", "--relative") == 0
    assert rig.table.stands == {"tilt": 15.0, "roll": -2.5, "camera_roll": 0.0}
    capsys.readouterr()
    for wrong, said in (
        ("tilt=400", "table: tilt = 400 deg is out of range; use -5 to 360 deg"),
        ("lift=1", "table: the table has no axis lift; use tilt, roll, camera_roll"),
        ("tilt", "cannot interpret 'tilt'"),
    ):
        assert bench("move", wrong) == 2
        assert said in capsys.readouterr().err
    assert rig.table.stands["tilt"] == 15.0


def test_settings_are_kept_in_the_bench_file_with_its_comments(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench("set", "camera", "exposure_us=2500") == 0
    assert "camera: exposure_us 1000.0 → 2500.0 µs" in capsys.readouterr().out
    text = Path("bench.toml").read_text()
    assert "# left as it is\n" in text
    assert "settings = {exposure_us = 2500.0}" in text
    assert rig.camera.settings.exposure_us == 2500.0
    for wrong in ("exposure_us=0", "exposure_us=long", "focus=3"):
        assert bench("set", "camera", wrong) == 2
    assert Path("bench.toml").read_text() == text


def test_a_frame_is_exposed_by_hand_and_described(rig: FieldRig, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench("expose", "--out", "one.png", "--exposure-us", "50") == 0
    out = capsys.readouterr().out
    assert out.startswith("240 × 240 px: 0 % saturated, brightest ")
    assert "sharpest edges " in out
    assert Path("one.png").stat().st_size > 1000
    assert bench("watch", "--limit", "2", "--every", "0.1", "--json") == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["axes"]["tilt"] for line in lines] == [0.0, 0.0]
    assert lines[0]["camera"]["fault"] == ""


def test_stop_ends_the_process_that_uses_the_bench_and_says_what_is_silent(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    program = (
        "import sys, time\nfrom pathlib import Path\nfrom reseau.capture import BenchLock\n"
        f"with BenchLock(['sim-table'], 'session monday', Path({str(Path.cwd() / 'reseau-locks')!r})):\n"
        "    print('held', flush=True)\n    time.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        assert bench("status") == 1
        assert f"in use by session monday (process {other.pid}" in capsys.readouterr().out
        assert bench("check") == 1
        assert f"in use by session monday (process {other.pid}" in capsys.readouterr().out
        assert bench("stop") == 1
        assert other.wait(30) == -signal.SIGTERM
    said = capsys.readouterr()
    assert f"telling session monday (process {other.pid} of" in said.out
    assert "table: stopped" in said.out
    assert "sweeper: did not answer: it may still move; switch it off" in said.err
    assert rig.table.stops == 1
    assert BenchLock.holder("sim-table") is None


def test_a_session_needs_only_the_instruments_that_it_uses(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["capture", "frames", "--count", "2", "--name", "a"]) == 0
    rig.table.silent = True
    rig.table.close()
    assert run(["capture", "frames", "--name", "b"]) == 0
    with BenchLock(["sim-table"], "another session"):
        assert run(["capture", "frames", "--name", "c"]) == 0
    capsys.readouterr()
    assert run(["capture", "scan", "--name", "d"]) == 1
    assert capsys.readouterr().err.count("does not answer") == 1
    assert run(["archive", "list"]) == 0
    assert "scan" not in capsys.readouterr().out


def test_an_own_plan_starts_without_instruments_that_it_may_not_use(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("own.py").write_text(
        "from reseau.capture import Step\n\ndef plan(run):\n    yield from run.at(Step('here'))\n"
    )
    assert run(["capture", "own", "--generator", "own.py", "--name", "a"]) == 0
    assert "without sweeper: sweeper (connect): does not answer" in (out := capsys.readouterr().out)
    assert "stopped, but" not in out
    assert rig.camera.exposures == 1


@pytest.mark.slow
def test_axes_without_a_reference_are_noticed_before_the_session_begins(
    rig: FieldRig, capsys: pytest.CaptureFixture[str]
) -> None:
    rig.table.lost = {"tilt"}
    given = ["capture", "testfield", "-d", "field.json", "--poses", "poses.csv", "--pitch-mm", "0.027",
             "--free", "c", "--checks", "0", "--name", "monday"]  # fmt: skip
    assert run(given) == 1
    assert "table: tilt has no reference; home them first" in capsys.readouterr().err
    assert run(["archive", "list"]) == 0
    assert "monday" not in capsys.readouterr().out
    assert run([*given, "--home"]) == 0
    assert rig.table.moves[0] == ("tilt", 0.0)


def test_frames_record_the_positions_of_a_table_that_is_named(rig: FieldRig) -> None:
    from reseau.archive import Archive

    assert run(["capture", "frames", "--name", "a", "--table", "table", "--home"]) == 0
    with Archive.open("archive") as archive:
        (frame,) = archive.session("a").frames(kind="frame")
        assert frame.facts["position"] == {"tilt": 0.0, "roll": 0.0, "camera_roll": 0.0}
    assert os.path.exists("archive")
