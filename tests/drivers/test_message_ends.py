"""Where answers end: at a newline, at NUL, at the end of a message of HiSLIP, VXI-11 and USBTMC."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest

from reseau.core.errors import ConnectionLost, ProtocolError
from reseau_drivers.codecs.ieee488 import block, missing_bytes, parse_block, picture
from reseau_drivers.codecs.stream import LineDecoder
from reseau_drivers.oscilloscope import Oscilloscope, oscilloscope
from reseau_sims import serving
from reseau_sims.serving import FaultScript, TcpServer
from reseau_sims.serving.usbtmc import UsbInstrument, plugged_in

from .fakes import Lines, Wire

TRANSPORTS = ("hislip", "vxi-11", "usbtmc")


@contextmanager
def scope_that_sends(
    transport: str, change: Callable[[bytes], bytes], seconds: float = 3.0
) -> Iterator[tuple[Oscilloscope, serving.Oscilloscope]]:
    machine, script = serving.Oscilloscope("keysight"), FaultScript()

    def execute(message: bytes) -> bytes | None:
        answer = machine.execute(message)
        return None if answer is None else change(answer)

    with ExitStack() as stack:
        if transport == "usbtmc":
            address = stack.enter_context(plugged_in(UsbInstrument(machine, execute, script))).resource
        elif transport == "vxi-11":
            server = stack.enter_context(TcpServer(lambda: serving.Vxi11Session(machine, execute, script)))
            address = f"TCPIP::127.0.0.1,{server.port}::inst0::INSTR"
        else:
            both = serving.HislipInstrument(machine, execute, script)
            server = stack.enter_context(TcpServer(both.channel))
            address = f"TCPIP::127.0.0.1::hislip0,{server.port}::INSTR"
        yield stack.enter_context(oscilloscope("scope", address, seconds=seconds)), machine


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_the_end_of_a_message_ends_an_answer_at_once(transport: str) -> None:
    began = time.monotonic()
    with scope_that_sends(transport, lambda answer: answer.rstrip(b"\n")) as (scope, machine):
        assert (scope.screen().frame().pixels == machine.screen()).all()
        assert len(scope.waveform(1).volts) == len(machine.samples())
        assert scope.errors() == []
    assert time.monotonic() - began < 2.0


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_an_instrument_that_ends_with_newlines_is_not_believed_without(transport: str) -> None:
    def cut(answer: bytes) -> bytes:
        return answer if answer[:1] == b"#" or b"KEYSIGHT" in answer else answer[:-9]

    with (
        scope_that_sends(transport, cut, 0.5) as (scope, _),
        pytest.raises(ProtocolError, match="broke off"),
    ):
        scope.waveform(1)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_block_of_indefinite_length_ends_with_its_message(transport: str) -> None:
    def indefinite(answer: bytes) -> bytes:
        return b"#0" + parse_block(answer) + b"\n" if answer[:1] == b"#" else answer

    with scope_that_sends(transport, indefinite) as (scope, machine):
        assert (scope.screen().frame().pixels == machine.screen()).all()
        assert len(scope.waveform(1).volts) == len(machine.samples())


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r", b"\0", b"\n\0", b"\0\n"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"], ids=["", "BOM"])
def test_lines_on_a_socket_end_with_what_instruments_send(mark: bytes, end: bytes) -> None:
    names = {"*IDN?": b"KEITHLEY INSTRUMENTS,DSOX1204G,CN1,01.20", ":SYSTem:ERRor?": b'+0,"No error"'}
    there = Lines({query: mark + said + end for query, said in names.items()})
    with oscilloscope("scope", Wire(there), dialect="Keysight InfiniiVision X", seconds=0.5) as scope:
        for _ in range(2):
            assert scope.errors() == []
    assert LineDecoder(end=b"\n").feed(mark + b"23.5\0\r\n") == [b"23.5"]


def test_blocks_with_their_length_in_parentheses_and_without_one() -> None:
    png = serving.Oscilloscope("keysight").execute(b":DISP:DATA? PNG, COL\n")
    assert png is not None
    content = parse_block(png)
    long = f"#({len(content)})".encode() + content
    assert parse_block(long) == picture(b"#0" + content + b"\n") == content
    assert [missing_bytes(long[:k]) for k in (1, 2, 4)] == [None, None, None]
    assert missing_bytes(long[:-5]) == missing_bytes(block(content)[:-5]) == 5
    assert missing_bytes(b"#0" + content[:-5]) is None
    assert missing_bytes(b"#0abc") is None
    assert missing_bytes(b"#0abc\n", ended=True) == 0


def test_a_protocol_that_is_not_installed_is_named() -> None:
    with pytest.raises(ConnectionLost, match="needs the package pyvicp; pip install pyvicp; or set"):
        oscilloscope("scope", "VICP::192.0.2.7::INSTR").connect(1.0)
