"""A peer that talks without end costs every driver bounded time and memory."""

from __future__ import annotations

import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import pytest

from reseau.core.errors import InstrumentError
from reseau.instruments import Deadline
from reseau_drivers.environment import environment_line, environment_modbus, environment_scpi
from reseau_drivers.oscilloscope import oscilloscope
from reseau_drivers.scanner import bk_oem, compact_pulser, ping360
from reseau_drivers.turntable import grbl, kinesis, marlin, smc100, zaber
from reseau_sims import serving
from reseau_sims.serving import (
    FaultyConnection,
    InProcess,
    Machine,
    PtyServer,
    Server,
    UdpServer,
)
from reseau_sims.serving.faults import Output

TABLES = {"zaber": zaber, "smc100": smc100, "kinesis": kinesis, "grbl": grbl, "marlin": marlin}
SENSORS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "environment_scpi": (environment_scpi, {"quantities": {"temperature": {"query": "MEAS:TEMP?"}}}),
    "environment_modbus": (environment_modbus, {"quantities": {"temperature": {"register": 0}}}),
    "environment_line": (
        environment_line,
        {"pattern": r"(?P<temperature>[-+.0-9]+) C", "quantities": {"temperature": {}}},
    ),
}
DRIVERS: dict[str, Callable[..., Any]] = {
    **{name: partial(make, axes={"tilt": {}}) for name, make in TABLES.items()},
    **{name: partial(make, **given) for name, (make, given) in SENSORS.items()},
    "ping360": ping360,
    "bk": bk_oem,
    "compactpulser": compact_pulser,
    "oscilloscope": oscilloscope,
}
NOISE = {
    "zeros": bytes(65536),
    "newlines": b"\n" * 65536,
    "short lines": b"1TS28\r\n" * 9000,
    "one line": b"x" * 65536,
    "every byte": bytes(range(256)) * 256,
    "heads of frames": b"BR\xff\x07\x00\x00" * 10000,
    "starts of messages": b"\x01" * 65536,
    "blocks": b"#9999999999" * 6000,
}


def noisy(*drivers: str) -> list[Any]:
    """Every driver with a third of the noises, others in turn; with all of them as slow ones."""
    return [
        pytest.param(driver, noise, marks=() if (k + j) % 3 == 0 else pytest.mark.slow)
        for k, driver in enumerate(sorted(drivers))
        for j, noise in enumerate(NOISE)
    ]


@contextmanager
def flood(noise: bytes) -> Iterator[str]:
    """A server that sends noise as fast as it is taken."""
    listener = socket.create_server(("127.0.0.1", 0))
    listener.settimeout(0.1)
    over = threading.Event()

    def serve() -> None:
        while not over.is_set():
            try:
                connection, _ = listener.accept()
            except TimeoutError:
                continue
            with connection:
                connection.settimeout(0.1)
                while not over.is_set():
                    try:
                        connection.sendall(noise)
                    except TimeoutError:
                        continue
                    except OSError:
                        break

    thread = threading.Thread(target=serve)
    thread.start()
    yield f"tcp://127.0.0.1:{listener.getsockname()[1]}"
    over.set()
    thread.join(5.0)
    listener.close()


class Talker:
    """A session that never stops once it was spoken to."""

    def __init__(self, noise: bytes) -> None:
        self._noise = noise

    def receive(self, data: bytes) -> list[Output]:
        return [(0.0, self._noise)] * 100

    def disconnected(self) -> None:
        """It does not mind."""


@pytest.mark.parametrize(
    ("driver", "noise"), noisy(*(set(DRIVERS) - {"bk", "oscilloscope", "environment_scpi"}))
)
def test_unsolicited_bytes_on_a_serial_line_or_in_datagrams(driver: str, noise: str) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    doors: list[type[Server]] = [PtyServer, UdpServer] if driver == "ping360" else [PtyServer]
    for door in doors:
        with door(lambda: Talker(NOISE[noise])) as server:
            device = DRIVERS[driver]("victim", server.address, seconds=0.2)
            began = time.monotonic()
            with pytest.raises(InstrumentError, match="victim"):
                device.connect()
            assert time.monotonic() - began < 10.0  # endless, without a bound
            device.close()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


@pytest.mark.parametrize(("driver", "noise"), noisy(*DRIVERS))
def test_endless_unsolicited_bytes_use_bounded_time_and_memory(driver: str, noise: str) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with flood(NOISE[noise]) as address:
        device = DRIVERS[driver]("victim", address, seconds=0.2)
        began = time.monotonic()
        with pytest.raises(InstrumentError, match="victim"):
            device.connect()
        assert time.monotonic() - began < 10.0  # endless, without a bound
        device.close()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


MACHINES: dict[str, Callable[[], Machine]] = {
    "zaber": lambda: serving.ZaberChain([2, 1]),
    "smc100": lambda: serving.Smc100Line(2),
    "kinesis": serving.KinesisController,
    "grbl": lambda: serving.GrblController(2),
    "marlin": lambda: serving.MarlinController(2),
    "environment_scpi": lambda: serving.ScpiSensor(dict),
    "environment_modbus": lambda: serving.ModbusSensor(dict),
    "environment_line": lambda: serving.LineSensor(dict, every_s=0.0),
    "ping360": serving.Ping360,
    "bk": serving.BkScanner,
    "compactpulser": serving.CompactPulser,
    "oscilloscope": lambda: serving.Oscilloscope("keysight"),
}


@pytest.mark.slow
@pytest.mark.parametrize("machine", MACHINES)
def test_simulators_report_noise_as_violations(machine: str) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    made = MACHINES[machine]()
    link, deadline = InProcess(lambda: FaultyConnection(made)), Deadline(60.0)
    link.open(deadline)
    for noise in NOISE.values():
        for _ in range(2):
            link.write(noise, deadline)
        made.disconnected()
    link.close()
    assert made.violations
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


UNLIMITED = ("configure", "stop", "stage", "read")
"""Calls that take no time limit: that of the driver holds."""
CALLS: dict[str, list[str]] = {
    **{name: ["check", "home", "move", "state"] for name in TABLES},
    **{name: ["check", "environment"] for name in SENSORS},
    "ping360": ["check", "scan", "line"],
    "bk": ["check", "scan"],
    "compactpulser": ["check", "verify"],
    "oscilloscope": ["check", "screen", "waveform", "errors"],
}
LOCAL = {"configure": ("grbl", "marlin", *SENSORS), "stop": tuple(SENSORS)}
"""Calls that ask nothing of an instrument: the speed is part of each move, and sensors never act."""
ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "home": ("tilt",),
    "move": ("tilt", 5.0),
    "state": ("tilt",),
    "line": (0,),
    "waveform": (1,),
}


@pytest.mark.parametrize("driver", DRIVERS)
def test_every_call_of_a_silent_instrument_ends_at_its_deadline(driver: str) -> None:
    listener = socket.create_server(("127.0.0.1", 0))
    try:
        address = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
        device = DRIVERS[driver]("victim", address, seconds=0.3)
        for call in (*CALLS[driver], "connect", *UNLIMITED):
            if driver in LOCAL.get(call, ()):
                continue
            more = {} if call in UNLIMITED else {"seconds": 0.3}
            began = time.monotonic()
            with pytest.raises(InstrumentError, match="victim") as caught:
                getattr(device, call)(*ARGUMENTS.get(call, ()), **more)
            assert time.monotonic() - began < 0.3 + 1.0, call
            assert caught.value.command, call
        status = device.trigger()
        assert isinstance(status.exception(5.0), InstrumentError)
        device.close()
    finally:
        listener.close()


@pytest.mark.parametrize("driver", DRIVERS)
def test_close_never_raises_in_any_state(driver: str) -> None:
    device = DRIVERS[driver]("victim", "tcp://127.0.0.1:1", seconds=0.2)
    device.close()
    device.close()
    with flood(b"x") as address:
        device = DRIVERS[driver]("victim", address, seconds=0.2)
        caller = threading.Thread(target=lambda: _tried(device.connect))
        caller.start()
        time.sleep(0.05)
        device.close()
        caller.join(5.0)
        assert not caller.is_alive()
    device.close()


def _tried(call: Callable[[], object]) -> None:
    with suppress(InstrumentError):
        call()
