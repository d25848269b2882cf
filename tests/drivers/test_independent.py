"""Proof by others: clients that were written elsewhere drive our simulators, bluesky's plans our drivers."""

from __future__ import annotations

from typing import Any

import pytest

from reseau_drivers.scanner import ping360
from reseau_drivers.turntable import zaber
from reseau_sims import serving
from reseau_sims.serving import (
    FaultyConnection,
    InProcess,
    PtyServer,
    TcpServer,
    UdpServer,
    ZaberChain,
)

from .zaber_database import STEPS, device_database


@pytest.mark.client(
    "zaber-motion",
    "Zaber chain, TCP",
    "home, moves with their own speed, `accel`, `maxspeed`, `limit.max`, park and unpark, settings",
)
def test_zaber_motion_homes_and_moves_the_turntable() -> None:
    ascii_ = pytest.importorskip("zaber_motion.ascii", reason="zaber-motion is not installed")
    chain = ZaberChain([2, 1])
    for motor in chain.motors.values():
        motor.speed = 1e6
    with (
        TcpServer(lambda: FaultyConnection(chain)) as server,
        ascii_.Connection.open_tcp("127.0.0.1", server.port) as connection,
    ):
        for number, axis_number in chain.motors:
            axis = connection.get_device(number).get_axis(axis_number)
            axis.home()
            axis.move_absolute(30_000)
            assert axis.get_position() == 30_000
            axis.move_relative(-1_000)
            assert axis.get_position() == 29_000
            assert axis.is_homed()
        device = connection.get_device(1)
        assert device.generic_command("get system.serial").data == "71234"
        assert [
            device.generic_command(f"get {name}").data for name in ("system.axiscount", "comm.address")
        ] == [
            "2",
            "1",
        ]
        axis = device.get_axis(1)
        for name in ("accel", "maxspeed", "limit.max"):
            axis.settings.set(name, 123_456)
            assert axis.settings.get(name) == 123_456
        motion = pytest.importorskip("zaber_motion")
        axis.move_absolute(1_000, motion.Units.NATIVE, True, 100_000, motion.Units.NATIVE, 50)
        axis.park()
        assert axis.is_parked()
        with pytest.raises(motion.exceptions.CommandFailedException):
            axis.move_absolute(2_000)
        axis.unpark()
        axis.move_absolute(2_000)
        assert axis.get_position() == 2_000
    assert [said for said in chain.violations if "PARKED" not in said] == []


@pytest.mark.client(
    "zaber-motion",
    "Zaber chain, TCP",
    "`detect_devices()`, `identify()` by a device database on this machine, moves and speeds in degrees",
)
def test_zaber_motion_identifies_the_turntable_and_moves_it_in_degrees() -> None:
    motion = pytest.importorskip("zaber_motion", reason="zaber-motion is not installed")
    ascii_ = pytest.importorskip("zaber_motion.ascii")
    chain, unit = ZaberChain([2, 1]), motion.Units
    for motor in chain.motors.values():
        motor.speed = 1e6
    with (
        device_database(),
        TcpServer(lambda: FaultyConnection(chain)) as server,
        ascii_.Connection.open_tcp("127.0.0.1", server.port) as connection,
    ):
        devices = connection.detect_devices()
        assert [device.axis_count for device in devices] == [2, 1]
        found = devices[0].identify()
        assert (found.device_id, found.serial_number, found.is_modified) == (50081, 71234, False)
        axis = devices[0].get_axis(2)
        assert axis.axis_type == ascii_.AxisType.ROTARY
        axis.home()
        axis.move_absolute(10, unit.ANGLE_DEGREES)
        assert chain.position(1, 2) == 10 * STEPS
        axis.move_relative(-0.5, unit.ANGLE_DEGREES)
        assert chain.position(1, 2) == 9.5 * STEPS
        assert axis.get_position(unit.ANGLE_DEGREES) == pytest.approx(9.5)
        axis.settings.set("maxspeed", 90, unit.ANGULAR_VELOCITY_DEGREES_PER_SECOND)
        assert chain.motors[1, 2].speed == pytest.approx(90 * STEPS)
        with pytest.raises(motion.exceptions.NotSupportedException):
            axis.move_max()
    assert chain.violations == []


@pytest.mark.client("bluerobotics-ping", "Ping360, serial", "`initialize()`, `control_transducer()`")
def test_bluerobotics_ping_scans() -> None:
    brping = pytest.importorskip("brping", reason="bluerobotics-ping is not installed")
    machine = serving.Ping360()
    with PtyServer(lambda: FaultyConnection(machine)) as server:
        client = brping.Ping360()
        client.connect_serial(server.address, 115200)
        try:
            assert client.initialize()
            assert client.get_device_information()["device_type"] == 2
            for angle in (0, 199, 399):
                client.control_transducer(1, 1, angle, 32, 80, 740, 200, 1, 0)
                message = client.wait_message([2300, 2], 4.0)
                assert (message.angle, message.sample_period) == (angle, 80)
                assert set(message.data) == {angle % 256}
        finally:
            client.iodev.close()
    assert machine.violations == []


@pytest.mark.client(
    "bluerobotics-ping",
    "Ping360, UDP",
    "all single settings, `transmitAngle()`, `transmit()`, automatic scan, motor off",
)
def test_bluerobotics_ping_scans_over_udp() -> None:
    brping = pytest.importorskip("brping", reason="bluerobotics-ping is not installed")
    machine = serving.Ping360()
    with UdpServer(lambda: FaultyConnection(machine)) as server:
        client = brping.Ping360()
        client.connect_udp(server.HOST, server.port)
        try:
            assert client.initialize()
            for angle in (0, 199, 399):
                client.control_transducer(1, 1, angle, 32, 80, 740, 1200, 1, 0)
                message = client.wait_message([2300, 2], 4.0)
                assert (message.angle, len(message.data)) == (angle, 1200)
                assert set(message.data) == {angle % 256}
            # The vendor's own methods: single settings, one pulse, and the automatic scan.
            for change in (client.set_mode, client.set_gain_setting, client.set_angle):
                assert change(1).message_id == 2300
            assert client.set_number_of_samples(400).number_of_samples == 400
            assert client.transmitAngle(7).angle == client.transmit().angle == 7
            client.control_auto_transmit(1, 1, 32, 80, 740, 300, 10, 20, 5, 0)
            seen = [client.wait_message([2301], 4.0) for _ in range(6)]
            assert [message.angle for message in seen] == [10, 15, 20, 15, 10, 15]
            assert all(set(message.data) == {message.angle} for message in seen)
            client.control_motor_off()
            assert client.wait_message([1], 4.0).acked_id == 2903
        finally:
            client.iodev.close()
    assert machine.violations == []


def test_bluesky_scans_over_the_turntable_with_the_sonar() -> None:
    plans = pytest.importorskip("bluesky.plans", reason="bluesky is not installed")
    protocols = pytest.importorskip("bluesky.protocols")
    engine: Any = pytest.importorskip("bluesky").RunEngine(context_managers=[], call_returns_result=True)
    chain, head = ZaberChain([1]), serving.Ping360()
    table = zaber(
        "table",
        InProcess(lambda: FaultyConnection(chain)),
        axes={"tilt": {"per_unit": 1000.0, "high": 90.0}},
        settings={"speed": 900.0},
    )
    sonar = ping360("sonar", InProcess(lambda: FaultyConnection(head)), settings={"half_sector": 3})
    for expected in ("Readable", "Triggerable", "Stageable", "Stoppable", "Configurable"):
        assert isinstance(sonar, getattr(protocols, expected)), expected
        assert isinstance(table, getattr(protocols, expected)), expected
    for expected in ("Readable", "Movable", "Stoppable", "Configurable"):
        assert isinstance(table.axes["tilt"], getattr(protocols, expected)), expected
    documents: list[tuple[str, dict[str, Any]]] = []
    with table, sonar:
        table.home("tilt")
        engine(plans.scan([sonar], table.axes["tilt"], 10.0, 30.0, 3), lambda *d: documents.append(d))
        engine(plans.count([table, sonar], 2))
    events = [document for kind, document in documents if kind == "event"]
    assert [event["data"]["table_tilt"] for event in events] == pytest.approx([10.0, 20.0, 30.0])
    described = next(document for kind, document in documents if kind == "descriptor")
    assert described["data_keys"]["sonar_section"]["external"] == "STREAM:"
    assert [d["indices"] for kind, d in documents if kind == "stream_datum"] == [
        {"start": k, "stop": k + 1} for k in range(3)
    ]
    assert described["configuration"]["sonar"]["data"]["sonar_half_sector"] == 3
    assert documents[-1][1]["exit_status"] == "success"
    assert chain.violations == head.violations == []
