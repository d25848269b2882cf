"""Clients and codecs by others against the simulated tables and the codecs of their drivers."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from typing import Any

import pytest

from reseau_drivers.codecs import apt, gcode
from reseau_sims.serving import (
    FaultyConnection,
    GrblController,
    KinesisController,
    MarlinController,
    PtyServer,
)


def _eventually(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_messages_of_the_apt_protocol_are_those_of_another_implementation() -> None:
    theirs = pytest.importorskip("thorlabs_apt_protocol", reason="thorlabs-apt-protocol is not installed")
    to = {"dest": apt.USB, "source": apt.HOST}
    Message = apt.Message
    at = (apt.USB, apt.HOST)
    assert apt.encode(Message("REQUEST_INFO", *at)) == theirs.hw_req_info(**to)
    for id_, function in (
        ("HOME", theirs.mot_move_home),
        ("REQUEST_VELOCITIES", theirs.mot_req_velparams),
        ("REQUEST_STATUS", theirs.mot_req_statusupdate),
        ("REQUEST_DC_STATUS", theirs.mot_req_dcstatusupdate),
        ("IDENTIFY", theirs.mod_identify),
    ):
        assert apt.encode(Message(id_, *at, (2, 0))) == function(**to, chan_ident=2)
    assert apt.encode(Message("STOP", *at, (1, 2))) == theirs.mot_move_stop(**to, chan_ident=1, stop_mode=2)
    assert apt.encode(Message("SET_ENABLED", *at, (1, 1))) == theirs.mod_set_chanenablestate(
        **to, chan_ident=1, enable_state=1
    )
    for position in (0, 1, -1, 200_000, -(1 << 31), (1 << 31) - 1):
        order = theirs.mot_move_absolute(**to, chan_ident=1, position=position)
        assert apt.encode(apt.move(apt.USB, 1, position)) == order
        by = theirs.mot_move_relative(**to, chan_ident=1, distance=position)
        assert apt.encode(apt.move(apt.USB, 1, position, name="MOVE_RELATIVE")) == by
    wanted = apt.Velocities(1, acceleration=263, maximum=767_367, minimum=5)
    assert apt.encode(Message("SET_VELOCITIES", *at, data=apt.encode_velocities(wanted))) == (
        theirs.mot_set_velparams(**to, chan_ident=1, min_velocity=5, acceleration=263, max_velocity=767_367)
    )


def test_what_the_simulated_controller_says_is_understood_by_another_implementation() -> None:
    theirs = pytest.importorskip("thorlabs_apt_protocol", reason="thorlabs-apt-protocol is not installed")
    now = 0.0
    cube = KinesisController(clock=lambda: now)
    to = {"dest": apt.USB, "source": apt.HOST}
    unpacker = theirs.Unpacker(on_error="raise")

    def said(query: bytes) -> Any:
        (answer,) = cube.receive(query)
        unpacker.feed(answer)
        return next(unpacker)

    info = said(theirs.hw_req_info(**to))
    assert (info.msg, info.serial_number, info.model_number.strip(b"\0"), info.nchs) == (
        "hw_get_info", 27_001_234, b"KDC101", 1,
    )  # fmt: skip
    cube.receive(theirs.mot_move_home(**to, chan_ident=1))
    status = said(theirs.mot_req_dcstatusupdate(**to, chan_ident=1))
    assert (status.homing, status.homed, status.moving_reverse) == (True, False, True)
    now = 10.0
    cube.receive(theirs.mot_move_absolute(**to, chan_ident=1, position=-70_000))
    now = 11.0
    status = said(theirs.mot_req_dcstatusupdate(**to, chan_ident=1))
    assert (status.position, status.moving_reverse, status.moving_forward, status.homed) == (
        -20_000, True, False, True,
    )  # fmt: skip
    assert status.channel_enabled
    assert not status.motion_error
    stopped = said(theirs.mot_move_stop(**to, chan_ident=1, stop_mode=2))
    assert (stopped.msg, stopped.position) == ("mot_move_stopped", -20_000)
    wanted = {"min_velocity": 0, "acceleration": 7, "max_velocity": 44_739}
    cube.receive(theirs.mot_set_velparams(**to, chan_ident=1, **wanted))
    found = said(theirs.mot_req_velparams(**to, chan_ident=1))
    assert (found.acceleration, found.max_velocity) == (7, 44_739)
    cube.inject_fault("stuck")
    assert said(theirs.mot_req_dcstatusupdate(**to, chan_ident=1)).motion_error
    asked = apt.encode(apt.Message("REQUEST_STATUS_BITS", apt.USB, apt.HOST, (1, 0)))
    assert said(asked).motion_error
    assert cube.violations == []


def test_thorlabs_apt_device_homes_and_moves_the_simulated_cube() -> None:
    devices = pytest.importorskip("thorlabs_apt_device.devices", reason="no thorlabs-apt-device")
    cube = KinesisController()
    cube.motors[1].speed = 200_000.0
    with PtyServer(lambda: FaultyConnection(cube)) as server, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its event loop at the end
        stage = devices.KDC101(
            serial_port=server.address, home=True, invert_direction_logic=False, swap_limit_switches=False
        )
        try:
            _eventually(lambda: stage.status["homed"] and not stage.status["homing"])
            assert cube.position() == 0.0
            stage.move_absolute(90_000)
            _eventually(lambda: stage.status["position"] == 90_000)
            _eventually(lambda: not stage.status["moving_forward"])
            stage.move_relative(-30_000)
            _eventually(lambda: stage.status["position"] == 60_000)
            stage.set_velocity_params(acceleration=263, max_velocity=round(1_000 * 22.3696))
            stage.move_absolute(100_000)
            _eventually(lambda: stage.status["position"] > 60_000)
            stage.stop()
            _eventually(lambda: not stage.status["moving_forward"])
            assert 60_000 < cube.position() < 100_000
        finally:
            stage.close()
            _eventually(lambda: stage._port is None)
    assert cube.violations == []


def test_grbl_streamer_homes_streams_and_holds_the_simulated_board() -> None:
    streamer = pytest.importorskip("grbl_streamer", reason="grbl-streamer is not installed")
    board = GrblController(3, speed=400.0)
    told: list[tuple[Any, ...]] = []
    client = streamer.GrblStreamer(lambda event, *data: told.append((event, *data)))
    with PtyServer(lambda: FaultyConnection(board)) as server:
        client.cnect(server.address, 115200)
        try:
            client.softreset()
            _eventually(lambda: any(event == "on_boot" for event, *_ in told))
            client.poll_start()
            client.homing()
            _eventually(lambda: board.motors[1].homed and client.cmode == "Idle")
            client.job_new()
            client.write("G21\nG90\nG1 X-10 Y-5 F6000\nG1 X-12.5\nG91\nG1 Z-3 F3000\nG90")
            # Its threads skip a line where an answer arrives while it is still sending.
            with board.lock:
                client.job_run()
            _eventually(lambda: any(event == "on_job_completed" for event, *_ in told))
            _eventually(lambda: client.cmode == "Idle" and client.cmpos[2] == -3.0)
            assert tuple(client.cmpos) == (-12.5, -5.0, -3.0)
            assert [board.position(axis) for axis in (1, 2, 3)] == [-12.5, -5.0, -3.0]
            client.send_immediately("G1 X-100 F600")
            _eventually(lambda: board.position(1) < -13.0)
            client.hold()
            _eventually(lambda: str(client.cmode).startswith("Hold"))
            stands = board.position(1)
            client.softreset()
            _eventually(lambda: client.cmode == "Idle")
            assert board.position(1) == stands > -100.0
        finally:
            client.poll_stop()
            client.disconnect()
    assert board.violations == []


def test_printcore_homes_and_prints_on_the_simulated_board() -> None:
    printrun = pytest.importorskip("printrun.printcore", reason="printrun is not installed")
    gcoder = pytest.importorskip("printrun.gcoder")
    board = MarlinController(3, speed=400.0)
    said: list[str] = []
    with PtyServer(lambda: FaultyConnection(board)) as server:
        client = printrun.printcore()
        client.recvcb = lambda line: said.append(line.strip())
        client.connect(server.address, 115200)
        try:
            _eventually(lambda: client.online)
            client.startprint(gcoder.LightGCode(["G28", "G21", "G90", "G1 X50 Y20 F6000", "G1 Z7.5", "M114"]))
            _eventually(lambda: not client.printing and board.position(3) == 7.5)
            assert [board.position(axis) for axis in (1, 2, 3)] == [50.0, 20.0, 7.5]
            client.send_now("M114")
            _eventually(lambda: any(line.startswith("X:50.00 Y:20.00 Z:7.50") for line in said))
        finally:
            client.disconnect()
    assert board.violations == []


@pytest.mark.parametrize("line", ["M110 N0", "G28 X", "G1 X10.5000 F6000", "M220 S101"])
def test_checksums_of_lines_are_those_of_printcore(line: str) -> None:
    printrun = pytest.importorskip("printrun.printcore", reason="printrun is not installed")
    prefix = f"N7 {line}"
    assert gcode.encode_numbered(line, 7) == f"{prefix}*{printrun.printcore()._checksum(prefix)}\n".encode()
