"""Packets of GigE Vision: as Wireshark reads them, decoded as encoded, and against garbage."""

from __future__ import annotations

import shutil
import struct
import subprocess
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from reseau.core.errors import ProtocolError
from reseau_drivers.codecs.gige import Action, Command, Kind, Leader, acknowledgement, data_packet, trailer

words = st.integers(0, 0xFFFFFFFF)


@given(st.integers(0, 0xFFFF), st.binary(max_size=540), st.integers(1, 0xFFFF), st.booleans())
def test_commands_are_decoded_as_they_were_encoded(
    kind: int, data: bytes, number: int, acknowledge: bool
) -> None:
    command = Command(kind, data, number, acknowledge)
    assert Command.decode(command.encode()) == command


@given(words, words, words)
def test_actions_are_decoded_as_they_were_encoded(device: int, group: int, mask: int) -> None:
    action = Action(device, group, mask)
    assert Action.decode(action.encode()) == action
    # A scheduled action has its time behind.
    assert Action.decode(action.encode() + bytes(8)) == action


@given(st.binary(max_size=64))
def test_noise_raises_nothing_but_a_protocol_error(noise: bytes) -> None:
    for decode in (Command.decode, Action.decode):
        with suppress(ProtocolError):
            decode(noise)
    with suppress(ProtocolError):
        Command.decode(b"\x42" + noise)


def dissected(packets: list[tuple[int, bytes]], folder: Path, *fields: str) -> list[list[str]]:
    """Fields that Wireshark finds in UDP packets with these destination ports."""
    tshark = shutil.which("tshark")
    if tshark is None:
        pytest.skip("no tshark: apt-get install tshark")
    # pcap, version 2.4, link type 101: raw IP.
    content = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 101)
    for port, payload in packets:
        udp = struct.pack(">HHHH", 50000, port, 8 + len(payload), 0) + payload
        header = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0)
        packet = header + bytes((127, 0, 0, 1)) * 2 + udp
        content += struct.pack("<IIII", 0, 0, len(packet), len(packet)) + packet
    file = folder / "packets.pcap"
    file.write_bytes(content)
    options = ["-r", str(file), "-d", "udp.port==3956,gvcp", "-d", "udp.port==50005,gvsp", "-T", "fields"]
    options += [each for field in fields for each in ("-e", field)]
    done = subprocess.run([tshark, *options], capture_output=True, text=True, check=True, timeout=120)
    return [line.split("\t") for line in done.stdout.splitlines()]


def test_wireshark_reads_an_action_command(tmp_path: Path) -> None:
    packet = Command(Kind.ACTION, Action(0x11, 0x22, 0x33).encode(), 9).encode()
    fields = ("gvcp.cmd.command", "gvcp.cmd.req_id", "gvcp.cmd.action.devicekey",
              "gvcp.cmd.action.groupkey", "gvcp.cmd.action.groupmask")  # fmt: skip
    (found,) = dissected([(3956, packet)], tmp_path, *fields)
    assert [int(value, 0) for value in found] == [0x100, 9, 0x11, 0x22, 0x33]


def test_wireshark_reads_an_image(tmp_path: Path) -> None:
    packets = [
        Leader(0x123456789, 0x01080001, 640, 480, 8, 16).packet(7),
        data_packet(7, 1, bytes(100)),
        trailer(7, 2, 480),
    ]
    fields = ("gvsp.blockid16", "gvsp.format", "gvsp.packetid24", "gvsp.pixel", "gvsp.sizex", "gvsp.sizey",
              "gvsp.offsetx", "gvsp.offsety")  # fmt: skip
    leader, data, last = dissected([(50005, each) for each in packets], tmp_path, *fields)
    assert [int(value, 0) for value in leader] == [7, 1, 0, 0x01080001, 640, 480, 8, 16]
    assert [int(value, 0) for value in data[:3]] == [7, 3, 1]
    assert [int(value, 0) for value in last[:3]] == [7, 2, 2]


def test_an_acknowledgement_repeats_kind_and_number() -> None:
    answer = acknowledgement(Command(Kind.READ_REGISTER, bytes(4), 77), b"\1\2\3\4", 0x8003)
    assert answer == bytes.fromhex("8003 0081 0004 004d 01020304")
