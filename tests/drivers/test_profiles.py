"""Profiles of oscilloscopes and the fakes of ``transcripts.toml``: pictures, waveforms, faults, files."""

from __future__ import annotations

import os
import re
import tomllib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.core.errors import FormatError, InputError, InstrumentError, ProtocolError, SettingError
from reseau_drivers.link import SerialLink
from reseau_drivers.oscilloscope import DIALECTS, Oscilloscope, dialect_of, oscilloscope
from reseau_drivers.oscilloscope.dialects import Formula, described, dialect_named, read_profiles
from reseau_drivers.profiles import CONTROLLERS, FOLDER, controller
from reseau_drivers.turntable import AxisPlan, Grbl, Kinesis, Marlin, Smc100, Table, Zaber, grbl

from .behaviours import named
from .fakes import (
    GrblBoard,
    Lines,
    MarlinBoard,
    NewportStage,
    Screen,
    Spoiled,
    TCube,
    Transcript,
    Wire,
    ZaberStage,
    transcripts,
)
from .test_references import FLUID, FLUID_VERSION, HAL, HAL_VERSION

TOLD = transcripts()
PROFILES = sorted(FOLDER.glob("*.toml"))


def opened(told: dict[str, Any], wire: Wire, **options: Any) -> Oscilloscope:
    """The driver of an instrument; one that does not identify itself is named."""
    named = {} if told["identity"] else {"dialect": told["profile"]}
    return oscilloscope("scope", wire, **{"seconds": 0.5} | named | options)


@pytest.mark.parametrize(
    "told", TOLD, ids=lambda told: told["identity"].split(",")[1] if told["identity"] else "-"
)
def test_screens_and_waveforms_are_those_of_the_instrument(told: dict[str, Any]) -> None:
    fake = Transcript(told)
    with opened(told, Wire(fake)) as scope:
        for seed in (1, 2):
            fake.screen = Screen(told.get("picture", "png"), seed)
            assert fake.screen.shows(scope.screen().data)
        assert scope.dialect is not None
        assert scope.dialect.name == told["profile"]
        if "volts" in told:
            wave = scope.waveform(1)
            assert wave.volts.tolist() == pytest.approx(told["volts"], abs=1e-9)
            assert (wave.start_s, wave.step_s) == pytest.approx(told["time"], rel=1e-9)
    assert fake.violations == []


@pytest.mark.parametrize("model", named())
def test_models_that_public_packages_name_have_a_profile(model: str) -> None:
    assert dialect_of(f"{model},1,1") is not None


def test_every_profile_has_a_fake() -> None:
    assert {told["profile"] for told in TOLD} == {dialect.name for dialect in DIALECTS}


def endured(told: dict[str, Any], count: int, seed: int) -> Counter[str]:
    """Work on an instrument until so many faults befell it; no picture and no waveform is wrong."""
    fake, rng, run = Transcript(told), np.random.default_rng(seed), 0
    wire, found = Spoiled(fake, rng, 0.0), Counter[str]()
    with opened(told, wire, seconds=0.01) as scope:
        wire.rate = 0.25
        while len(wire.faults) < count:
            run += 1
            fake.screen = Screen(told.get("picture", "png"), run)
            try:
                if "volts" in told and run % 2:
                    wave = scope.waveform(1)
                    assert wave.volts.tolist() == pytest.approx(told["volts"], abs=1e-9), wire.faults[-5:]
                    assert (wave.start_s, wave.step_s) == pytest.approx(told["time"], rel=1e-9)
                else:
                    assert fake.screen.shows(scope.screen().data), wire.faults[-5:]
                found["right"] += 1
            except InstrumentError as error:
                found[type(error).__name__] += 1
        wire.rate = 0.0
        for _ in range(2):  # the first call may find what is left of the last fault
            try:
                assert fake.screen.shows(scope.screen(1.0).data)
                break
            except InstrumentError:
                fake.reset()
        else:
            raise AssertionError("does not recover")
    return found + Counter({f"fault: {kind}": n for kind, n in Counter(wire.faults).items()})


TABLES: dict[str, tuple[Callable[[], Any], Callable[[Any], Any], float]] = {
    "GRBL": (GrblBoard, lambda wire: Grbl(wire, 0.02), 1.0),
    "GRBL without lock": (lambda: GrblBoard(locks=False), lambda wire: Grbl(wire, 0.02), 1.0),
    "grblHAL": (
        lambda: GrblBoard(HAL, HAL_VERSION, locks=False, tells=True),
        lambda wire: Grbl(wire, 0.02),
        1.0,
    ),
    "FluidNC": (lambda: GrblBoard(FLUID, FLUID_VERSION, locks=False), lambda wire: Grbl(wire, 0.02), 1.0),
    "Zaber": (ZaberStage, lambda wire: Zaber(wire, 0.02), 1000.0),
    "T-Cube": (TCube, lambda wire: Kinesis([wire], answer_s=0.02), 1919.64),
    "SMC100": (NewportStage, lambda wire: Smc100(wire, 0.02), 1.0),
    "Marlin": (MarlinBoard, lambda wire: Marlin(wire, 0.02), 1.0),
}


def moved(name: str, count: int, seed: int) -> Counter[str]:
    """Move an axis until so many faults befell its controller; it is never elsewhere than it says."""
    make, controller, per_unit = TABLES[name]
    fake, rng, found = make(), np.random.default_rng(seed), Counter[str]()
    wire = Spoiled(fake, rng, 0.0)
    plan = AxisPlan(low=-90.0, high=90.0, per_unit=per_unit)
    table = Table("table", controller(wire), {"tilt": plan}, seconds=0.25)
    table.connect()
    wire.rate = 0.05
    while len(wire.faults) < count:
        target = float(rng.integers(-80, 80))
        try:
            if not table.state("tilt").homed:
                table.home("tilt")
            position = table.move("tilt", target).position
            assert (fake.place + fake.off) / per_unit == pytest.approx(target, abs=0.01), wire.faults[-5:]
            assert position == pytest.approx(target, abs=0.01)
            found["right"] += 1
        except InstrumentError as error:
            found[type(error).__name__] += 1
    table.close()
    return found + Counter({f"fault: {kind}": n for kind, n in Counter(wire.faults).items()})


@pytest.mark.slow
def test_no_fault_gives_a_wrong_picture_or_waveform() -> None:
    for k, told in enumerate(TOLD):
        endured(told, 12, k)


@pytest.mark.parametrize("name", TABLES)
def test_no_fault_moves_an_axis_elsewhere(name: str) -> None:
    moved(name, 25, 3)


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_ten_thousand_faults_give_no_wrong_value(
    record_property: Callable[[str, object], None], capsys: pytest.CaptureFixture[str]
) -> None:
    total = Counter[str]()
    each = -(-int(os.environ.get("RESEAU_FAULTS", "10000")) // (len(TOLD) + len(TABLES)))
    seed = int(os.environ.get("RESEAU_SEED", "1000"))
    for k, told in enumerate(TOLD):
        total += endured(told, each, seed + k)
    for k, name in enumerate(TABLES):
        total += moved(name, each, seed + 1000 + k)
    for name, number in sorted(total.items()):
        record_property(name, number)
    with capsys.disabled():
        faults = sum(number for name, number in total.items() if name.startswith("fault"))
        print(f"\n{faults} faults over {len(TOLD) + len(TABLES)} instruments: {dict(sorted(total.items()))}")


@pytest.mark.parametrize("path", PROFILES, ids=lambda path: path.stem)
def test_every_line_of_a_profile_names_a_source(path: Path) -> None:
    text = path.read_text("utf-8")
    used, sources = set[str](), tomllib.loads(text)["sources"]
    for line in text.splitlines():
        if (
            not line
            or line.startswith(("[", "#", "name = ", "schema = ", "maker = "))
            or re.match(r'\d+ = "', line)
        ):
            continue
        found = re.findall(r"\[(\d+)\]", line.rpartition("#")[2])
        assert found, line
        used.update(found)
    assert used == set(sources)


def test_a_file_of_ones_own_is_a_dialect(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    own = described("Rigol 1000Z").replace('"Rigol 1000Z"', '"Rigol mine"')
    path.write_text(own + 'ends = "\\r\\n"\n')
    fake = Transcript(next(told for told in TOLD if told["profile"] == "Rigol 1000Z"))
    wire, said = Wire(fake), list[bytes]()
    wire.write = lambda data, deadline: (said.append(data), Wire.write(wire, data, deadline))[1]  # type: ignore[method-assign]
    with oscilloscope("scope", wire, dialect=str(path), seconds=0.5) as scope:
        assert fake.screen.shows(scope.screen().data)
        assert {data[-2:] for data in said} == {b"\r\n"}
        assert scope.dialect is not None
        assert scope.dialect.name == "Rigol mine"
    assert read_profiles(described(f"{path}#Rigol mine"), where=path)[1][0].ends == "\r\n"
    assert dialect_named(f"{path}#Rigol mine").models == r"(DS|MSO)1\d{3}Z"
    with pytest.raises(SettingError, match="choose from Rigol mine"):
        dialect_named(f"{path}#other")
    with pytest.raises(InputError, match="cannot be read"):
        dialect_named(str(tmp_path / "none.toml"))


OWN = described("Rigol 1000Z")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("schema = 3", "schema 3 is not reseau-instrument-profile/1"),
        ("x", "is not TOML"),
        (OWN.replace("screen =", "scren ="), r"`screen`: Field required"),
        (OWN.replace('waveform = "preamble"', 'waveform = "none"'), r"there are no \[waveforms.none\]"),
        (OWN.replace("fetch :DISP", "send :DISP"), "needs one step that fetches"),
        (OWN.replace("fetch :DISP", "grab :DISP"), r"`screen.0`: String should match"),
        (OWN.replace("(code - y0 - yref) * dy", "code ** 2"), r"has more than \+ - \* /"),
        (OWN.replace("(code - y0 - yref) * dy", "(code"), "is not a formula"),
        (OWN.replace("(code - y0 - yref) * dy", "code * gain"), "no query gives gain"),
        (OWN.replace('dtype = "u1"', 'dtype = "u9"'), "'u9' is no data type"),
        (OWN.replace("fetch :DISPlay", "fetch {name}:DISPlay"), r"`screen.0`: String should match"),
        (
            OWN.replace(
                'examples = ["RIGOL TECHNOLOGIES,DS1104Z', 'examples = ["DS1104Z", "RIGOL TECHNOLOGIES,'
            ),
            "`examples.0`",
        ),
        (OWN.replace("(code - y0 - yref) * dy", "__import__('os')"), r"has more than \+ - \* /"),
    ],
)
def test_a_file_that_is_no_profile_is_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(FormatError, match=message) as caught:
        read_profiles(text, where="mine.toml")
    assert "\n" not in str(caught.value)


def test_all_profiles_are_listed_and_shown() -> None:
    listed = [line.partition(":")[0] for line in described().splitlines()]
    assert set(listed) == {dialect.name for dialect in DIALECTS} | set(CONTROLLERS)
    for name in listed:
        assert "[sources]" in described(name)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_the_profile_of_a_controller_is_one_of_ones_own(name: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(described(name))
    assert controller(name, str(path)) == controller(name)
    assert f"a controller, {name}" in described(str(path))


@pytest.mark.parametrize(
    ("name", "line", "own", "message"),
    [
        ("grbl", 'name = "grbl"', 'name = "zaber"', "is of 'zaber', not of grbl"),
        ("grbl", "[alarms]", "[alarm]", "`alarm` is missing, or not of this controller"),
        ("grbl", "banner = 'grbl", "banner = '(grbl", "is no pattern"),
        ("marlin", "unhomed", "unhoned", "`replies` is not as that of a profile: it has firmware"),
        ("kinesis", "stepper = 53.68", 'stepper = "53.68"', "`motors`: '53.68' is no number"),
        ("kinesis", '"00004000"', '"follows"', "'follows' is no hexadecimal number"),
        ("kinesis", 'HOME = "0443"', 'HOME = "443"', "`messages`: '443' is no hexadecimal number with"),
        ("kinesis", 'moving = "0', 'going = "0', "`masks` is not as that of a profile: it has limit, moving"),
        ("smc100", '"32-38"', '"32"', "`states`: '32' is no range of hexadecimal numbers"),
        ("zaber", "abs {position}", "abs {place}", "'move abs {place}' has other values than 'move abs {pos"),
        ("zaber", "abs {position}", "abs {position", "has other values than"),
        ("smc100", "controller-profile/1", "controller-profile/2", "is not reseau-controller-profile/1"),
        ("zaber", '"FQ" = "the', '"FQ" = 7 # "the', "`flags`: 7 is no text"),
    ],
)
def test_a_file_that_is_no_profile_of_a_controller_is_refused_in_one_line(
    name: str, line: str, own: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "mine.toml"
    assert line in described(name)
    path.write_text(described(name).replace(line, own))
    with pytest.raises(FormatError, match=re.escape(message)) as caught:
        controller(name, str(path))
    assert "\n" not in str(caught.value)


def test_a_table_speaks_a_dialect_of_ones_own(tmp_path: Path) -> None:
    """A board of one's own, with another banner and an error that GRBL does not have."""
    path = tmp_path / "mine.toml"
    text = described("grbl").replace("banner = 'grbl", "banner = 'millboard.*|grbl").replace('"$H"', '"$HA"')
    path.write_text(text.replace("[alarms]", '"99" = "the lid is open"\n[alarms]'))
    for dialect, message in ((None, "error 99"), (str(path), "the lid is open")):
        board = GrblBoard()
        table = grbl("table", Wire(board), axes={"tilt": {"low": -90.0, "high": 90.0}}, dialect=dialect)
        board.answers["$I"] = b"error:99\r\n"
        with pytest.raises(InstrumentError, match=message):
            table.connect()
        table.close()
    board = GrblBoard(banner="Millboard 7")
    board.homes = "$HA"
    with grbl("table", Wire(board), axes={"tilt": {"low": -90.0, "high": 90.0}}, dialect=str(path)) as table:
        table.home("tilt")
        board.ends = lambda: board.start()
        with pytest.raises(InstrumentError, match="started anew"):
            table.move("tilt", -10.0)


def test_formulas() -> None:
    numbers = {"code": np.array([1.0, 3.0]), "a": 2.0}
    assert Formula("-(code - 1) * 10 / a + .5")(numbers).tolist() == [0.5, -9.5]
    with pytest.raises(ZeroDivisionError):
        Formula("1 / b")({"b": 0.0})


@pytest.mark.parametrize(("serial", "port"), [(True, "RS232"), (False, "GPIb")])
def test_a_tds_220_prints_to_the_port_it_is_connected_by(serial: bool, port: str) -> None:
    class SerialWire(Wire, SerialLink):  # type: ignore[misc]
        pass

    told = next(told for told in TOLD if told["profile"] == "Tektronix TDS 200")
    fake = Transcript(told | {"lines": [
        [name, heard.replace(r"(GPI\w*|RS232)", port), *rest] for name, heard, *rest in told["lines"]
    ]})  # fmt: skip
    with opened(told, (SerialWire if serial else Wire)(fake)) as scope:
        assert fake.screen.shows(scope.screen().data)


def test_one_that_may_lack_a_module_is_told_of_it() -> None:
    mute = Lines({"*IDN?": b"TEKTRONIX,TDS 220,0,CF:91.1CT FV:v1.02\n"})
    with (
        oscilloscope("scope", Wire(mute), seconds=0.2) as scope,
        pytest.raises(InstrumentError, match="TDS2CM"),
    ):
        scope.screen()


def test_an_unknown_model_is_tried_by_its_nearest_relatives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reseau_drivers.oscilloscope.scope._TRIAL_S", 0.2)
    told = next(told for told in TOLD if told["profile"] == "Tektronix with a file system")
    fake = Transcript(told | {"identity": "TEKTRONIX,6-MSO,C1,CF:91.1CT"})
    with opened(told, Wire(fake), seconds=5.0) as scope:
        assert fake.screen.shows(scope.screen().data)
        assert "set dialect = 'Tektronix with a file system'" in scope.check()["advice"]
    mute = Lines({"*IDN?": b"ACME,X1,1,1\n"})
    with pytest.raises(ProtocolError, match="reseau bench profile"):
        oscilloscope("scope", Wire(mute), seconds=0.5).connect()
