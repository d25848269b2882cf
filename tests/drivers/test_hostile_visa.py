"""Peers that speak VXI-11 or HiSLIP to do harm: time and memory stay bounded, errors are of the tree."""

from __future__ import annotations

import resource
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial

import pytest

from reseau.core.errors import InstrumentError
from reseau_drivers.codecs import hislip, rpc, vxi11
from reseau_drivers.oscilloscope import oscilloscope
from reseau_sims import serving
from reseau_sims.serving import FaultScript, HislipInstrument, TcpServer, Vxi11Session
from reseau_sims.serving.faults import Output
from reseau_sims.serving.usbtmc import UsbInstrument, plugged_in

from .test_hostile import NOISE, flood
from .test_oscilloscope import HOSTILE


@contextmanager
def bounded(seconds: float = 2.0, kib: int = 100_000) -> Iterator[None]:
    """What is done in here takes no longer, and no more memory (KiB)."""
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    yield
    assert time.monotonic() - began < seconds
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < kib


def address(transport: str, port: int) -> str:
    return {
        "vxi-11": f"TCPIP::127.0.0.1,{port}::inst0::INSTR",
        "hislip": f"TCPIP::127.0.0.1::hislip0,{port}::INSTR",
    }[transport]


@pytest.mark.parametrize("noise", NOISE)
@pytest.mark.parametrize("transport", ["vxi-11", "hislip"])
def test_a_flood_of_noise_instead_of_the_protocol(transport: str, noise: str) -> None:
    with flood(NOISE[noise]) as server:
        device = oscilloscope("victim", address(transport, int(server.rpartition(":")[2])), seconds=0.3)
        with bounded(), pytest.raises(InstrumentError, match="victim"):
            device.connect()
        device.close()


class Harmful:
    """A session that answers every piece it hears with the same bytes, again and again."""

    def __init__(self, answer: Callable[[bytes], list[Output]]) -> None:
        self._answer = answer

    def receive(self, data: bytes) -> list[Output]:
        return self._answer(data)

    def disconnected(self) -> None:
        pass


def record_without_end(data: bytes) -> list[Output]:
    """Fragments of an RPC record that none ends."""
    return [(0.0, struct.pack(">I", 65536) + bytes(65536))] * 400


def huge_record(data: bytes) -> list[Output]:
    """A fragment of two gigabytes; some of it comes."""
    return [(0.0, b"\xff\xff\xff\xff" + bytes(1 << 20))] + [(0.0, bytes(1 << 20))] * 30


def huge_message(data: bytes) -> list[Output]:
    """A HiSLIP message of another type than was asked for, with 8 GB that are gathered to be shown."""
    return [(0.0, struct.pack(">2sBBIQ", b"HS", 7, 0, 0, 1 << 33) + bytes(1 << 20))] + [
        (0.0, bytes(1 << 20))
    ] * 30


def impossible_message(data: bytes) -> list[Output]:
    """One of 2⁶⁴ − 1 bytes."""
    return [(0.0, b"HS\x07\x00" + bytes(4) + b"\xff" * 8)]


@pytest.mark.parametrize(
    ("transport", "answer"),
    [
        ("vxi-11", record_without_end),
        ("vxi-11", huge_record),
        ("hislip", huge_message),
        ("hislip", impossible_message),
    ],
)
def test_announced_lengths_are_not_trusted(transport: str, answer: Callable[[bytes], list[Output]]) -> None:
    with TcpServer(lambda: Harmful(answer)) as server:
        device = oscilloscope("victim", address(transport, server.port), seconds=0.5)
        with bounded(seconds=3.0, kib=150_000), pytest.raises(InstrumentError, match="victim"):
            device.connect()
        device.close()


@pytest.mark.parametrize("kind", HOSTILE)
@pytest.mark.parametrize("transport", ["vxi-11", "hislip", "usbtmc"])
def test_answers_without_end_within_the_protocol(transport: str, kind: str) -> None:
    machine, script = serving.Oscilloscope("keysight"), FaultScript()

    def execute(message: bytes) -> bytes | None:
        return HOSTILE[kind] or None if b"DATA?" in message else machine.execute(message)

    with ExitStack() as stack:
        if transport == "usbtmc":
            where = stack.enter_context(plugged_in(UsbInstrument(machine, execute, script))).resource
        else:
            session = partial(Vxi11Session, machine, execute, script)
            channel = HislipInstrument(machine, execute, script).channel
            server = stack.enter_context(TcpServer(session if transport == "vxi-11" else channel))
            where = address(transport, server.port)
        device = oscilloscope("scope", where, seconds=0.5)
        with bounded(), pytest.raises(InstrumentError, match="scope"):
            device.screen()
        device.close()


def test_simulator_sessions_limit_their_input() -> None:
    machine = serving.Oscilloscope("keysight")
    sessions = {
        "vxi-11": Vxi11Session(machine, machine.execute, FaultScript()),
        "hislip": HislipInstrument(machine, machine.execute, FaultScript()).channel(),
    }
    with bounded(seconds=60.0, kib=50_000):
        for session in sessions.values():
            for noise in NOISE.values():
                for _ in range(20):
                    session.receive(noise)
    assert machine.violations
    # The codecs' own types, so that this stays a test of them.
    assert rpc.RecordDecoder()
    assert hislip.MessageDecoder()
    assert vxi11.CORE == 0x0607AF
