"""What keeps a computer from an instrument, found by `reseau bench doctor`."""

from __future__ import annotations

import os
import pty
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from reseau.capture import Bench, BenchFile
from reseau.capture.lock import BenchLock
from reseau.instruments import Finding
from reseau_drivers import doctor
from reseau_drivers.doctor import examine
from reseau_sims import serving
from reseau_sims.serving import FaultyConnection, TcpServer


def lines(driver: str, address: str) -> list[str]:
    return [f"{each.fine}: {each}" for each in examine(driver, address, 0.3)]


@pytest.fixture
def terminal() -> Iterator[str]:
    ours, theirs = pty.openpty()
    yield os.ttyname(theirs)
    os.close(ours)
    os.close(theirs)


def test_a_port_that_is_absent_names_its_kin(tmp_path: Path) -> None:
    (tmp_path / "ttyUSB1").touch()
    (found,) = lines("grbl", f"{tmp_path}/ttyUSB0@115200")
    assert found == f"False: {tmp_path}/ttyUSB0 does not exist; plug it in; there are {tmp_path}/ttyUSB1"
    assert "reseau bench list" in lines("grbl", "/dev/none")[0]


def test_a_port_that_another_program_holds_names_it(terminal: str) -> None:
    assert lines("grbl", terminal)[0].startswith(f"True: {terminal} may be opened by")
    with open(terminal, "rb") as held, subprocess.Popen(["sleep", "60"], stdin=held) as other:
        found = lines("grbl", terminal)
        other.kill()
    assert f"False: {terminal} is held by sleep (process {other.pid}); end that program" in found


@pytest.mark.parametrize(("mode", "do"), [(0o660, "usermod -a -G"), (0o600, "udev rule")])
def test_a_port_without_permission_names_the_group(
    terminal: str, monkeypatch: pytest.MonkeyPatch, mode: int, do: str
) -> None:
    os.chmod(terminal, mode)
    monkeypatch.setattr(doctor.os, "access", lambda *_: False)
    assert do in lines("grbl", terminal)[0]


def test_a_number_that_may_change_is_noted(tmp_path: Path) -> None:
    (tmp_path / "ttyACM0").touch()
    assert "None: " in lines("grbl", f"{tmp_path}/ttyACM0")[-1]
    assert "/dev/serial/by-id" in lines("grbl", f"{tmp_path}/ttyACM0")[-1]


def test_a_port_of_the_network_is_open_closed_or_unknown() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        kinds = (f"::{port}::SOCKET", f"::hislip0,{port}::INSTR", f",{port}::inst0::INSTR")
        for address in (f"tcp://127.0.0.1:{port}", *(f"TCPIP::127.0.0.1{each}" for each in kinds)):
            taken = f"True: 127.0.0.1 takes connections on port {port}"
            assert any(taken in each for each in lines("oscilloscope", address))
    found = lines("oscilloscope", f"tcp://127.0.0.1:{port}")
    assert f"False: 127.0.0.1 is there, but nothing listens on port {port}" in found[0]
    assert "is not known" in lines("oscilloscope", "tcp://no-such-host.invalid:5025")[0]


def test_a_firewall_is_told_from_a_closed_port(monkeypatch: pytest.MonkeyPatch) -> None:
    def silent(self: Any, where: object) -> None:
        raise TimeoutError

    monkeypatch.setattr(doctor.socket.socket, "connect", silent)
    monkeypatch.setattr(doctor, "_route", lambda host: iter(()))
    assert any(
        "firewalls between pass the port" in each for each in lines("oscilloscope", "tcp://127.0.0.1:5025")
    )


@pytest.mark.parametrize(
    ("percent", "said"),
    [
        ("0", "True: 127.0.0.1 answers 20 of 20"),
        ("35", "False: 35 % of packets to 127.0.0.1 are lost; another cable"),
        ("100", "None: 127.0.0.1 answers no echo request"),
    ],
)
def test_lost_packets_are_counted(
    percent: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ping = tmp_path / "ping"
    ping.write_text(f"#!/bin/sh\necho '20 packets transmitted, 0 received, {percent}% packet loss'\n")
    ping.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    assert any(each.startswith(said) for each in lines("ping360", "udp://127.0.0.1:9092"))


def test_a_camera_is_silent_or_has_small_packets(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "False: 127.66.77.88 does not answer" in lines("aravis", "127.66.77.88")[0]
    assert "UDP from port 3956" in lines("aravis", "127.66.77.88")[0]
    monkeypatch.setattr(doctor, "require_control", lambda *_: None)
    stats = SimpleNamespace(isup=True, mtu=1500)
    monkeypatch.setattr(
        doctor.psutil, "net_if_stats", lambda: dict.fromkeys(doctor.psutil.net_if_addrs(), stats)
    )
    assert any(
        "1500 bytes at most; sudo ip link set lo mtu 9000" in each for each in lines("aravis", "127.66.77.88")
    )


def test_usb_without_the_device_says_so() -> None:
    (found,) = lines("oscilloscope", "USB0::0x1AB1::0x04CE::DS1ZA::INSTR")
    assert found.startswith("False: ")


def bench_of(address: str) -> Bench:
    text = f'schema = "reseau-bench/1"\n[instruments.scope]\ndriver = "oscilloscope"\naddress = "{address}"\n'
    return Bench(BenchFile.parse_toml(text, where="bench.toml"))


def test_an_instrument_that_works_tells_its_firmware_and_its_time() -> None:
    machine = serving.Oscilloscope("keysight")
    with TcpServer(lambda: FaultyConnection(machine)) as server:
        found = bench_of(server.address).diagnose(5.0)["scope"]
        assert [each.fine for each in found if each.fine is False] == []
        assert "firmware 07.50" in found[-1].text
        with BenchLock([server.address], "session monday"):
            (held,) = bench_of(server.address).diagnose(5.0)["scope"]
        assert held.fine is False
        assert "is used by session monday" in held.text


def test_one_that_answers_late_is_given_more_time(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = serving.Oscilloscope("keysight")
    whole = machine.execute
    monkeypatch.setattr(machine, "execute", lambda message: (time.sleep(0.2), whole(message))[1])
    with TcpServer(lambda: FaultyConnection(machine)) as server:
        found: Finding = bench_of(server.address).diagnose(0.3)["scope"][-1]
    assert found.fine is not True
    assert "seconds" in found.do or "within" in found.text
