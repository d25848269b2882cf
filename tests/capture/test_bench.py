"""The bench: read strictly, connected at once, every failure in one tree; simulated on real protocols."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.capture import Bench, BenchFile, found_instruments, plugin
from reseau.cli import run
from reseau.core.errors import BenchError, ConnectionLost, FormatError, InputError, UsageError
from reseau.exchange import read_lens
from reseau.instruments import Oscilloscope, Turntable, UltrasonicScanner
from reseau.io.targets import SpaceTargets
from reseau_sims import Reflectors
from reseau_sims.serving import Fault, SimulatedBench
from reseau_sims.serving.bench import serve

HEAD = 'schema = "reseau-bench/1"\n'
TABLE = '[instruments.table]\ndriver = "zaber"\naddress = "tcp://127.0.0.1:1"\n'
AXES = "[instruments.table.options.axes.tilt]\nper_unit = 1000.0\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "schema"),
        ("x = ", "is not TOML"),
        (HEAD, "instruments"),
        (HEAD + TABLE + "colour = 3\n", "unknown key"),
        (HEAD + "[instruments.table]\ndriver = 'zaber'\n", "address"),
    ],
)
def test_an_invalid_bench_file_is_refused_with_its_key(text: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        BenchFile.parse_toml(text, where="bench.toml")


def test_all_instruments_that_cannot_be_created_are_named_together() -> None:
    text = (
        HEAD
        + TABLE
        + '[instruments.a]\ndriver = "nothing"\naddress = "x"\n'
        + '[instruments.b]\ndriver = "ping360"\naddress = "tcp://127.0.0.1:1"\nsettings = {gain = 9}\n'
        + '[instruments.c]\ndriver = "ping360"\naddress = "tcp://127.0.0.1:1"\noptions = {colour = 9}\n'
        + '[instruments.d]\ndriver = "ping360"\naddress = "tcp://x"\nlimits = {gain = [0, 1]}\n'
    )
    with pytest.raises(BenchError) as caught:
        Bench(BenchFile.parse_toml(text, where="bench.toml"))
    assert len(caught.value.failures) == 5
    for message in ("nothing", "gain", "colour", "tcp://x", "table"):
        assert message in str(caught.value)


def test_all_silent_instruments_are_reported_together_in_time() -> None:
    text = HEAD + TABLE + AXES + '[instruments.sonar]\ndriver = "ping360"\naddress = "tcp://127.0.0.1:1"\n'
    bench = Bench(BenchFile.parse_toml(text, where="bench.toml"))
    began = time.monotonic()
    with pytest.raises(BenchError) as caught:
        bench.connect(2.0)
    assert time.monotonic() - began < 3.0
    assert [type(each) for each in caught.value.failures] == [ConnectionLost, ConnectionLost]
    with pytest.raises(UsageError, match="not on this bench"):
        bench["camera"]


def test_limits_of_the_bench_are_respected() -> None:
    text = HEAD + TABLE + "limits = {speed = [1.0, 20.0]}\n" + AXES
    bench = Bench(BenchFile.parse_toml(text, where="bench.toml"))
    with pytest.raises(UsageError, match="1…20"):
        bench["table"].configure(speed=50.0)
    bench.close()


@pytest.mark.slow
def test_the_simulated_bench_works_over_its_real_protocols() -> None:
    with SimulatedBench(seed=2) as simulated:
        with Bench(BenchFile.parse_toml(simulated.toml, where="simulated")) as bench:
            table, scanner, scope = bench["table"], bench["scanner"], bench["oscilloscope"]
            assert isinstance(table, Turntable)
            assert isinstance(scanner, UltrasonicScanner)
            assert isinstance(scope, Oscilloscope)
            table.configure(speed=300.0)
            table.home("tilt", 20.0)
            table.move("tilt", 30.0, 20.0)
            assert simulated.laboratory.axes["tilt"] == pytest.approx(30.0, abs=1e-3)
            scanner.configure(half_sector=5)
            scanner.scan(20.0)
            assert simulated.laboratory.swept.sum() == 11
            shown = scope.screen(20.0).frame().pixels
            assert (shown == simulated.laboratory.picture(800, 480)).all()
            bench.stop()
        assert not any(simulated.violations.values())


def test_every_scanner_of_the_simulated_bench_sees_the_same_rods_in_millimetres() -> None:
    with (
        SimulatedBench(seed=2, table="smc100", scanner="all") as simulated,
        Bench(BenchFile.parse_toml(simulated.toml, where="simulated")) as bench,
    ):
        table, bmode, pulser = bench["table"], bench["bmode"], bench["pulser"]
        assert isinstance(table, Turntable)
        assert isinstance(bmode, UltrasonicScanner)
        assert isinstance(pulser, UltrasonicScanner)
        simulated.laboratory.tank = Reflectors(("a",), np.array([[-30.0, -60.0]]), np.ones(1))
        table.configure(speed=1000.0)
        table.home("z", 20.0)
        pulser.configure(
            repetition_hz=100.0, first_mm=20.0, step_mm=2.0, lines=15, full_scale_v=5.0, speed_m_s=1540.0
        )
        for scan, left in ((bmode.scan(10.0), -64.0), (pulser.scan(60.0), 20.0 - 64.0)):
            assert scan.mm_per_px is not None
            # The transducer's own face, and what the pulse left, are not looked at.
            first = round(20 / scan.mm_per_px[1])
            row, column = np.unravel_index(int(scan.pixels[first:].argmax()), scan.pixels[first:].shape)
            along = left + (column + 0.5 * (left == -64.0)) * scan.mm_per_px[0]
            depth = (row + first - scan.origin_px[1]) * scan.mm_per_px[1]
            assert (along, depth) == (pytest.approx(-30.0, abs=2.0), pytest.approx(60.0, abs=1.0))
        assert not any(simulated.violations.values())


def test_an_unknown_simulated_table_or_family_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for wrong in (["--controller", "acme"], ["--family", "acme"]):
        assert run(["bench", "sim", "--seconds", "0.01", *wrong]) == 2
        assert "acme" in capsys.readouterr().err


def test_check_reports_every_failure_and_sets_the_exit_status(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bench.toml"
    with SimulatedBench() as simulated:
        path.write_text(simulated.toml)
        assert run(["bench", "check", "--bench", str(path), "--json"]) == 0
        document = json.loads(capsys.readouterr().out)
        assert document["failed"] == 0
        found = {each["name"]: each["found"] for each in document["instruments"]}
        assert found["scanner"]["identity"] == "Blue Robotics Ping360"
        assert found["scanner"]["firmware"] == "3.1.1"
        assert found["scanner"]["line"].startswith("200 samples")
        assert found["table"]["tilt"] == "not homed: the controller reports none"
        assert found["oscilloscope"]["error"] == "none"
        assert [each["name"] for each in document["instruments"]] == list(simulated.machines)
        for script in simulated.scripts.values():
            for number in range(40):
                script.fault_at(script.count + number, Fault("dropped"))
        assert run(["bench", "check", "--bench", str(path), "--timeout-s", "0.5"]) == 1
        message = capsys.readouterr().out
    assert message.count("failed") == len(simulated.machines)
    assert "did not answer" in message
    assert "└── oscilloscope" in message
    assert run(["bench", "check", "--bench", str(tmp_path / "none.toml")]) == 2
    with pytest.raises(InputError):
        Bench.read(tmp_path / "none.toml")


def test_sim_writes_a_bench_file_that_check_accepts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bench.toml"
    assert run(["bench", "sim", "--out", str(path), "--seconds", "0.01"]) == 0
    expected = {"table", "scanner", "oscilloscope"}
    assert set(BenchFile.read(path).instruments) >= expected
    assert run(["bench", "sim", "--seconds", "0.01"]) == 0
    assert "reseau-bench/1" in capsys.readouterr().out


def test_sim_simulates_a_plane_testfield_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[SimulatedBench] = []

    def bench(seed: int, **options: Any) -> SimulatedBench:
        made.append(SimulatedBench(seed, **options))
        return made[-1]

    monkeypatch.setattr("reseau.capture.plugin", lambda group, name: bench)
    for flat in ([], ["--flat"]):
        assert run(["bench", "sim", "--seconds", "0.01", *flat]) == 0
    assert [each.laboratory.field.bend_mm > 0 for each in made] == [True, False]


def test_sim_puts_a_port_and_water_before_the_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[SimulatedBench] = []

    def bench(seed: int, **options: Any) -> SimulatedBench:
        made.append(serve(seed, **options))
        return made[-1]

    monkeypatch.setattr("reseau.capture.plugin", lambda group, name: bench)
    water = ["--water", "--port-distance", "80", "--port-tilt", "2", "--temperature", "25"]
    assert run(["bench", "sim", "--seconds", "0.01", *water]) == 0
    assert run(["bench", "sim", "--seconds", "0.01"]) == 0
    assert [each.laboratory.field.water is not None for each in made] == [True, False]
    assert made[1].refraction == ""
    text = HEAD + '[instruments.camera]\ndriver = "v4l2"\naddress = "a"\n' + made[0].refraction
    entry = BenchFile.parse_toml(text, where="bench.toml").instruments["camera"].refraction
    assert entry is not None
    port = entry.windows[0].parameters
    assert (port["distance"], port["thickness"]) == (80.0, 12.0)
    assert port["tilt_X"] == pytest.approx(np.tan(np.deg2rad(2.0)), abs=1e-6)
    with pytest.raises(FormatError, match="windows"):
        BenchFile.parse_toml(text.replace('shape = "plane"', 'shape = "cone"'), where="bench.toml")
    assert run(["bench", "sim", "--water", "--scene", "screen"]) == 2


def test_sim_with_a_frame_writes_what_a_session_needs(tmp_path: Path) -> None:
    out = tmp_path / "bench.toml"
    assert run(["bench", "sim", "--seconds", "0.01", "--scene", "frame", "--out", str(out)]) == 0
    lens = read_lens(tmp_path / "lens.toml")
    assert lens.sensor is not None
    assert lens.sensor.size_px == (640, 480)
    assert len(SpaceTargets.read(tmp_path / "targets.json").targets.id) == 28


def test_list_shows_found_instruments_and_why_a_search_failed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # No real search: it would broadcast.
    def searched(group: str, name: str) -> Any:
        if name == "visa":
            raise ConnectionLost("VISA cannot search")
        return lambda: ("/dev/ttyUSB0",)

    monkeypatch.setattr("reseau.capture.bench.plugin", searched)
    assert found_instruments()["serial"] == ("/dev/ttyUSB0",)
    assert run(["bench", "list"]) == 0
    assert "visa: VISA cannot search" in capsys.readouterr().out
    assert run(["bench", "list", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["found"]["serial"] == ["/dev/ttyUSB0"]
    assert document["found"]["visa"] == []
    assert list(document["errors"]) == ["visa"]
    assert "zaber" in document["drivers"]


def test_missing_plugins_are_reported() -> None:
    with pytest.raises(UsageError, match=r"no such entry point of reseau\.instruments; installed: aravis"):
        plugin("reseau.instruments", "none")
