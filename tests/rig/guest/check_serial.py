"""Every serial driver at a real terminal of the kernel: works, survives faults, unplugged and plugged in."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from reseau.core.errors import InstrumentError
from reseau_drivers.environment import environment_line, environment_modbus, environment_scpi
from reseau_drivers.link import serial_ports
from reseau_drivers.scanner import compact_pulser, ping360
from reseau_drivers.turntable import grbl, kinesis, marlin, smc100, zaber
from reseau_sims.serving import LineSensor, ScpiSensor

from .gadget import settle
from .lab import steer, value

PORT = "/dev/ttyACM0"
TILT = {"tilt": {"per_unit": 1000.0, "high": 100.0}}
_LINES = {"tilt": {"high": 100.0}}
_SENSED: dict[str, dict[str, Any]] = {"temperature": {}, "humidity": {}, "pressure": {}}
_REGISTERS = {
    "temperature": {"register": 0, "scale": 0.1},
    "humidity": {"register": 1, "scale": 0.1},
    "pressure": {"register": 2, "format": "float32"},
}


def _table(device: Any, run: int) -> None:
    target = 10.0 + 7 * run % 60
    assert abs(device.move("tilt", target, 20.0).position - target) < 0.01


def _sonar(device: Any, run: int) -> None:
    for angle in (run, run + 11):
        assert set(device.line(angle)) == {(200 + angle) % 256}


def _pulser(device: Any, run: int) -> None:
    device.configure(width_ns=20.0 + run, repetition_hz=100.0)
    assert value("machine.values")["W"] == 20.0 + run


def _sensor(device: Any, run: int) -> None:
    air = steer("machine.values")
    for name, each in device.environment().conditions.items():
        assert abs(each.value - air[name]) < 0.3


def _home(device: Any) -> None:
    device.home("tilt", 20.0)


def _stop(device: Any) -> None:
    device.stop()


DRIVERS: dict[str, tuple[Callable[[], Any], Callable[[Any, int], None], Callable[[Any], None]]] = {
    "zaber": (lambda: zaber("table", PORT, axes=TILT, settings={"speed": 500.0}), _table, _home),
    "smc100": (
        lambda: smc100("table", PORT, axes={"tilt": {"high": 100.0}}, settings={"speed": 500.0}),
        _table,
        _home,
    ),
    "ping360": (lambda: ping360("sonar", PORT, answer_s=1.0), _sonar, _stop),
    "compactpulser": (lambda: compact_pulser("pulser", PORT), _pulser, _stop),
    "kinesis": (
        lambda: kinesis(
            "table", PORT, axes={"tilt": {"per_unit": 1920.0, "high": 100.0}}, settings={"speed": 500.0}
        ),
        _table,
        _home,
    ),
    "grbl": (lambda: grbl("table", PORT, axes=_LINES, settings={"speed": 500.0}), _table, _home),
    "marlin": (lambda: marlin("table", PORT, axes=_LINES, settings={"speed": 500.0}), _table, _home),
    "environment_modbus": (lambda: environment_modbus("air", PORT, quantities=_REGISTERS), _sensor, _stop),
    "environment_line": (
        lambda: environment_line("air", PORT, pattern=LineSensor.PATTERN, quantities=_SENSED),
        _sensor,
        _stop,
    ),
    "environment_scpi": (
        lambda: environment_scpi(
            "air", PORT, quantities={name: {"query": query} for query, name in ScpiSensor.QUERIES.items()}
        ),
        _sensor,
        _stop,
    ),
}


def _recovered(device: Any, recover: Callable[[Any], None]) -> None:
    """Brought back, as soon as it can be: a plug takes its time."""
    until = time.monotonic() + 20.0
    while True:
        try:
            recover(device)
            return
        except InstrumentError:
            if time.monotonic() > until:
                raise


def test_the_port_is_found_and_named_by_udev() -> None:
    settle()
    assert PORT in serial_ports()
    links = [path.name for path in Path("/dev/serial/by-id").iterdir()]
    assert links == ["usb-reseau_simulated_instrument_LINE1-if00"]


@pytest.mark.parametrize("name", DRIVERS)
def test_a_driver_works_at_the_port(name: str) -> None:
    make, work, recover = DRIVERS[name]
    steer("connect", name)
    with make() as device:
        recover(device)
        for run in range(3):
            work(device, run)
    assert value("machine.violations") == []


@pytest.mark.parametrize("kind", ["late", "dropped", "truncated", "repeated", "corrupted", "disconnected"])
@pytest.mark.parametrize("name", DRIVERS)
def test_a_fault_gives_the_right_result_or_an_error(name: str, kind: str) -> None:
    make, work, recover = DRIVERS[name]
    steer("connect", name)
    with make() as device:
        recover(device)
        work(device, 0)
        steer("befall", "line", kind)
        said = None
        try:
            work(device, 1)
        except InstrumentError as error:
            said = error
        assert said is None or (said.instrument, bool(said.command)) == (device.name, True)
        _recovered(device, recover)
        work(device, 2)
    assert value("machine.violations") == []


@pytest.mark.parametrize("name", DRIVERS)
def test_reconnection_after_unplugging(name: str) -> None:
    make, work, recover = DRIVERS[name]
    steer("connect", name)
    with make() as device:
        recover(device)
        steer("line.gadget.unplug")
        try:
            with pytest.raises(InstrumentError) as caught:
                work(device, 1)
            assert caught.value.instrument == device.name
            assert not Path(PORT).exists()
        finally:
            steer("line.gadget.plug_in")
        _recovered(device, recover)
        work(device, 2)
        assert device.reconnections >= 2
