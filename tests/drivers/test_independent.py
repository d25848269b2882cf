"""Proof by others: clients that were written elsewhere drive our simulators, bluesky's plans our drivers."""

from __future__ import annotations

from typing import Any

import numpy as np
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
        reply = connection.get_device(1).generic_command("get system.serial")
        assert reply.data == "71234"
    assert chain.violations == []


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
    assert all(np.asarray(event["data"]["sonar_section"]).ndim == 2 for event in events)
    described = next(document for kind, document in documents if kind == "descriptor")
    assert described["configuration"]["sonar"]["data"]["sonar_half_sector"] == 3
    assert documents[-1][1]["exit_status"] == "success"
    assert chain.violations == head.violations == []
