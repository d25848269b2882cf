"""Sensors of the environment and the newer tables in sessions: recorded, in provenance, and under faults."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from reseau.archive import Archive, Session
from reseau.capture import Bench, BenchFile, InstrumentEntry, Step, carry_out, plans
from reseau.capture.engine import rerun
from reseau.core.data import Frame
from reseau.core.errors import InstrumentError
from reseau.instruments import Device
from reseau_drivers.environment import environment_line, environment_modbus, environment_scpi
from reseau_drivers.turntable import AxisPlan, Grbl, Kinesis, Marlin, Table
from reseau_sims.serving import (
    LINE_KINDS,
    FaultScript,
    FaultyConnection,
    GrblController,
    InProcess,
    KinesisController,
    LineSensor,
    Machine,
    MarlinController,
    ModbusSensor,
    ScpiSensor,
)

from .fieldrig import FieldRig

AIR = {"temperature": 21.5, "humidity": 45.0, "pressure": 1004.25}
REGISTERS: dict[str, dict[str, Any]] = {
    "temperature": {"register": 0, "scale": 0.1, "sigma": 0.2},
    "pressure": {"register": 2, "format": "float32"},
}
STEPS = [Step(f"tilt {tilt}", {"tilt": float(tilt)}) for tilt in (0, 30, -30, 20, -20, 10)]


def _plain_rig(axes: tuple[str, ...] = ("tilt",)) -> FieldRig:
    """A rig whose camera sees the same wedge everywhere, which costs no time."""
    rig, wedge = FieldRig(axes=axes), np.tile(np.arange(20, 220, dtype=np.uint8), (60, 1))
    rig.camera.field = SimpleNamespace(record=lambda station: Frame(wedge, 255.0))  # type: ignore[assignment]
    return rig


def _with(rig: FieldRig, **more: Device[Any]) -> Bench:
    """The bench of a rig, with further instruments or others in their place."""
    made: dict[str, Any] = {"table": rig.table, "camera": rig.camera, **more}
    entries = {name: InstrumentEntry(driver="sim", address=f"sim-{name}") for name in made}
    rig.bench = Bench(BenchFile(name="field", instruments=entries), lambda name, entry: made[name])
    return rig.bench


def _modbus(machine: ModbusSensor, script: FaultScript | None = None) -> Device[Any]:
    link = InProcess(lambda: FaultyConnection(machine, script))
    return environment_modbus("air", link, quantities=REGISTERS, answer_s=0.5)


@pytest.mark.slow
def test_conditions_are_stored_with_every_frame_and_summarised_in_the_provenance(tmp_path: Path) -> None:
    rig = FieldRig()
    _with(rig, air=_modbus(ModbusSensor(lambda: AIR | {"temperature": 20.0 + 0.5 * rig.camera.exposures})))
    with Archive.open(tmp_path / "archive", create=True) as archive:
        session = archive.begin("monday", "own", {})
        run = rig.acquisition(session, rig.procedure())
        carry_out(run, plans.poses(run, STEPS, 1, 0))
        frames = session.frames(kind="frame")
        taken = [frame.facts["environment"]["air"]["temperature"] for frame in frames]
        assert taken == [{"value": 20.5 + 0.5 * k, "unit": "°C", "sigma": 0.2} for k in range(6)]
        (result,) = session.results()
        around = json.loads(session.content(result))["provenance"]["environment"]
        assert around["air.temperature"] == {
            "mean": 21.75, "low": 20.5, "high": 23.0, "unit": "°C", "sigma": 0.2, "frames": 6,
        }  # fmt: skip
        assert around["air.pressure"]["mean"] == 1004.25
        assert [each.same for each in rerun(session, rig.procedure())] == [True]


def test_a_sensor_that_fails_is_reported_and_does_not_end_the_session(tmp_path: Path) -> None:
    now = 0.0
    rig, machine = _plain_rig(), ModbusSensor(lambda: AIR, clock=lambda: now)
    _with(rig, air=_modbus(machine))

    def during(number: int) -> None:
        nonlocal now
        now = float(number)
        if number in (2, 3):
            machine.inject_fault("wrong state")

    rig.camera.during = during
    with Archive.open(tmp_path / "archive", create=True) as archive:
        session = archive.begin("monday", "own", {})
        run = rig.acquisition(session)
        carry_out(run, plans.poses(run, STEPS, 1, 0))
        found = [frame.facts["environment"]["air"] for frame in session.frames(kind="frame")]
    assert [("error" in each) for each in found] == [False, True, True, False, False, False]
    assert "device busy" in found[1]["error"]
    assert [facts["instrument"] for kind, facts in rig.events if kind == "without"] == ["air"]


SENSORS: dict[str, Callable[[], tuple[Machine, Callable[[InProcess], Device[Any]]]]] = {
    "scpi": lambda: (
        ScpiSensor(lambda: AIR),
        lambda link: environment_scpi(
            "air", link, quantities={name: {"query": query} for query, name in ScpiSensor.QUERIES.items()},
            answer_s=0.2,
        ),
    ),
    "modbus": lambda: (
        ModbusSensor(lambda: AIR),
        lambda link: environment_modbus("air", link, quantities=REGISTERS, answer_s=0.2),
    ),
    "line": lambda: (
        LineSensor(lambda: AIR, every_s=0.0),
        lambda link: environment_line(
            "air", link, pattern=LineSensor.PATTERN, quantities={name: {} for name in AIR}, query="?\n",
            answer_s=0.2,
        ),
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["modbus", *(pytest.param(k, marks=pytest.mark.slow) for k in SENSORS if k != "modbus")]
)
def test_with_faults_in_a_sensor_no_frame_is_lost_or_doubled(name: str, tmp_path: Path) -> None:
    rig, script = _plain_rig(), FaultScript()
    machine, make = SENSORS[name]()
    _with(rig, air=make(InProcess(lambda: FaultyConnection(machine, script))))
    script.at_random(0.05, seed=11, seconds=0.05)
    found = _captured(rig, tmp_path, [Step(f"pose {k}") for k in range(120)])
    assert script.happened
    for frame in found:
        for quantity, each in frame["environment"]["air"].items():
            if quantity != "error":
                assert each["value"] == pytest.approx(AIR[quantity], rel=0.02)


TABLES: dict[str, Callable[[], tuple[Any, Callable[[InProcess], Any]]]] = {
    "kinesis": lambda: (KinesisController(), lambda link: Kinesis([link], answer_s=0.3)),
    "grbl": lambda: (GrblController(1, low=-100.0, high=100.0, speed=900.0), lambda link: Grbl(link, 0.3)),
    "marlin": lambda: (
        MarlinController(1, low=-100.0, high=100.0, speed=900.0),
        lambda link: Marlin(link, 0.3),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["kinesis", *(pytest.param(k, marks=pytest.mark.slow) for k in TABLES if k != "kinesis")]
)
def test_with_faults_in_a_table_no_frame_is_lost_or_doubled_and_all_are_where_they_should_be(
    name: str, tmp_path: Path
) -> None:
    rig, script = _plain_rig(), FaultScript()
    machine, make = TABLES[name]()
    per_unit = 1919.64 if name == "kinesis" else 1.0
    plan = AxisPlan(per_unit=per_unit, low=-60.0, high=60.0)
    controller = make(InProcess(lambda: FaultyConnection(machine, script)))
    table = Table("table", controller, {"tilt": plan}, seconds=3.0)
    table.configure(speed=900.0)
    table.home("tilt")
    _with(rig, table=table)
    stood: list[float] = []
    rig.camera.during = lambda number: stood.append(machine.motors[1].position / per_unit)
    script.at_random(0.01, seed=11, seconds=0.05)
    script._kinds = LINE_KINDS  # after a loss of power a table must be homed, by hand
    steps = [Step(f"pose {k}", {"tilt": float((7 * k) % 40 - 20)}) for k in range(80)]
    found = _captured(rig, tmp_path, steps)
    assert script.happened
    for frame, step, at in zip(found, steps, stood, strict=True):
        assert frame["position"]["tilt"] == pytest.approx(step.position["tilt"], abs=0.01)
        assert at == pytest.approx(step.position["tilt"], abs=0.01)
    table.close()


def _captured(rig: FieldRig, folder: Path, steps: list[Step]) -> list[dict[str, Any]]:
    """Facts of the frames of a session, continued when it fails; each step has one frame, in order."""
    with Archive.open(folder / "archive", create=True) as archive:
        session: Session = archive.begin("monday", "own", {})
        for _ in range(20):
            run = rig.acquisition(session)
            try:
                carry_out(run, plans.poses(run, steps, 1, 0))
                break
            except InstrumentError:
                continue
        frames = session.frames(kind="frame")
        assert session.status == "done"
        assert [frame.step for frame in frames] == [step.name for step in steps]
        assert {frame.take for frame in frames} == {0}
        assert len({frame.id for frame in frames}) == len(steps) == rig.camera.exposures
        return [frame.facts for frame in frames]
