"""Sensors of the environment: what is believed, and clients and servers by others."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from reseau.core.errors import InstrumentError, ProtocolError, RefusedError, SettingError, StateError
from reseau.instruments import EnvironmentSensor
from reseau_drivers.codecs import modbus
from reseau_drivers.environment import environment_line, environment_modbus, environment_scpi
from reseau_sims.serving import (
    Fault,
    FaultScript,
    FaultyConnection,
    InProcess,
    LineSensor,
    ModbusSensor,
    PtyServer,
    ScpiSensor,
    TcpServer,
)

AIR = {"temperature": 21.5, "humidity": 45.0, "pressure": 1004.25}
REGISTERS: dict[str, dict[str, Any]] = {
    "temperature": {"register": 0, "scale": 0.1, "sigma": 0.2},
    "humidity": {"register": 1, "scale": 0.1},
    "pressure": {"register": 2, "format": "float32"},
}
QUERIES = {name: {"query": query} for query, name in ScpiSensor.QUERIES.items()}
LINE: dict[str, dict[str, Any]] = {name: {} for name in AIR}


def test_a_sensor_is_an_instrument_that_says_unit_and_uncertainty() -> None:
    machine = ModbusSensor(lambda: AIR)
    with environment_modbus("air", InProcess(lambda: FaultyConnection(machine)), quantities=REGISTERS) as air:
        assert isinstance(air, EnvironmentSensor)
        found = air.environment().conditions
        assert {name: each.value for name, each in found.items()} == AIR
        assert (found["temperature"].sigma, found["humidity"].sigma) == (0.2, None)
        assert air.read()["air_pressure"]["value"] == 1004.25
        assert air.describe()["air_pressure"]["units"] == "hPa"
        assert air.check()["temperature"] == "21.5 °C ± 0.2"
    assert machine.violations == []


def test_a_turned_bit_of_a_protocol_without_checksum_is_outvoted() -> None:
    for kind, at in (("corrupted", 0), ("corrupted", 1), ("repeated", 0), ("repeated", 3)):
        machine, script = ScpiSensor(lambda: AIR), FaultScript()
        link = InProcess(lambda m=machine, s=script: FaultyConnection(m, s))  # type: ignore[misc]
        with environment_scpi("air", link, quantities=QUERIES, answer_s=0.1) as air:
            script.fault_at(script.count + at, Fault(kind))  # type: ignore[arg-type]
            try:
                found = air.environment().conditions
            except ProtocolError:
                found = air.environment().conditions
            assert {name: each.value for name, each in found.items()} == AIR


@pytest.mark.parametrize("value", [86.0, -41.0, float("nan"), 9.91e37])
def test_impossible_values_are_refused(value: float) -> None:
    machine = ScpiSensor(lambda: AIR | {"temperature": value})
    with (
        environment_scpi("air", InProcess(lambda: FaultyConnection(machine)), quantities=QUERIES) as air,
        pytest.raises(InstrumentError, match=r"temperature|TEMP"),
    ):
        air.environment()


def test_a_device_that_refuses_its_registers_is_reported() -> None:
    machine = ModbusSensor(lambda: AIR)
    far = {"temperature": {"register": 40}}
    sensor = environment_modbus("air", InProcess(lambda: FaultyConnection(machine)), quantities=far)
    with pytest.raises(RefusedError, match="illegal data address"):
        sensor.connect()
    machine = ModbusSensor(lambda: AIR)
    machine.inject_fault("wrong state")
    sensor = environment_modbus("air", InProcess(lambda: FaultyConnection(machine)), quantities=REGISTERS)
    with pytest.raises(RefusedError, match="device busy"):
        sensor.connect()


def test_lines_that_are_no_measurement_are_reported() -> None:
    machine = LineSensor(lambda: AIR, every_s=0.02)
    link = InProcess(lambda: FaultyConnection(machine))
    with environment_line("air", link, pattern=LineSensor.PATTERN, quantities=LINE) as air:
        assert air.environment().conditions["temperature"].value == 21.5
        machine.inject_fault("wrong state")
        with pytest.raises(ProtocolError, match="ERR 3"):
            air.environment()
        machine.inject_fault("out of range")
        with pytest.raises(StateError, match="outside"):
            air.environment()


def test_wrong_descriptions_are_refused() -> None:
    for make in (
        lambda: environment_line("air", "/dev/null", pattern="(", quantities=LINE),
        lambda: environment_line("air", "/dev/null", pattern="T", quantities=LINE),
        lambda: environment_line("air", "/dev/null", pattern="(?P<dew>.)", quantities=LINE),
        lambda: environment_line("air", "/dev/null", pattern="(?P<dew>.)", quantities={"dew": {}}),
        lambda: environment_scpi("air", "/dev/null", quantities={"temperature": {}}),
        lambda: environment_scpi("air", "/dev/null", quantities={"temperature": {"query": "X"}}),
        lambda: environment_scpi("air", "/dev/null", quantities={}),
        lambda: environment_modbus("air", "/dev/null", quantities={"temperature": {}}),
        lambda: environment_modbus("air", "/dev/null", quantities={"temperature": {"register": 70_000}}),
        lambda: environment_modbus("air", "/dev/null", quantities=REGISTERS, unit=0),
        lambda: environment_modbus(
            "air", "/dev/null", quantities={"temperature": {"register": 1, "format": "bcd"}}
        ),
    ):
        with pytest.raises(SettingError):
            make()


@pytest.mark.parametrize(("framing", "tcp"), [("rtu", False), ("tcp", True)])
def test_pymodbus_reads_the_simulated_sensor(framing: str, tcp: bool) -> None:
    client_module = pytest.importorskip("pymodbus.client", reason="pymodbus is not installed")
    machine = ModbusSensor(lambda: AIR, unit=5, tcp=tcp)
    served: Any = TcpServer if tcp else PtyServer
    with served(lambda: FaultyConnection(machine)) as server:
        client = (
            client_module.ModbusTcpClient(server.HOST, port=server.port)
            if tcp
            else client_module.ModbusSerialClient(server.address, baudrate=19200)
        )
        assert client.connect()
        try:
            answer = client.read_input_registers(0, count=4, device_id=5)
            assert not answer.isError()
            assert answer.registers[:2] == [215, 450]
            assert client.convert_from_registers(answer.registers[2:], client.DATATYPE.FLOAT32) == 1004.25
            held = client.read_holding_registers(100, count=2, device_id=5)
            assert held.registers == [215, 450]
            refused = client.read_input_registers(3, count=2, device_id=5)
            assert refused.exception_code == 2
            assert client.diag_query_data(b"\x12\x34", device_id=5).message in (b"\x12\x34", [0x1234], 0x1234)
        finally:
            client.close()
    assert [text for text in machine.violations if "do not exist" not in text] == []


@contextmanager
def _pymodbus_server(port: int) -> Iterator[int]:
    """A server of pymodbus with the registers of a sensor, on the loopback interface."""
    server_module = pytest.importorskip("pymodbus.server", reason="pymodbus is not installed")
    simulator = pytest.importorskip("pymodbus.simulator")
    words = [215, 450, *modbus.words_of(1004.25, "float32")]
    data = [simulator.SimData(0, values=words, datatype=simulator.DataType.REGISTERS)]
    loop, ready, made = asyncio.new_event_loop(), threading.Event(), []

    async def serve() -> None:
        device = simulator.SimDevice(5, simdata=data)
        server = server_module.ModbusTcpServer(device, address=("127.0.0.1", port))
        made.append(server)
        await server.listen()
        ready.set()

    def run() -> None:
        asyncio.set_event_loop(loop)
        loop.run_until_complete(serve())
        loop.run_forever()

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        assert ready.wait(20.0)
        yield made[0].transport.sockets[0].getsockname()[1]
    finally:
        asyncio.run_coroutine_threadsafe(made[0].shutdown(), loop).result(10.0)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(10.0)
        loop.close()


def test_the_driver_reads_a_server_of_pymodbus() -> None:
    with (
        _pymodbus_server(0) as port,
        environment_modbus("air", f"tcp://127.0.0.1:{port}", quantities=REGISTERS, unit=5) as air,
    ):
        found = air.environment().conditions
        assert {name: each.value for name, each in found.items()} == AIR


def test_checksums_and_frames_are_those_of_pymodbus() -> None:
    framers = pytest.importorskip("pymodbus.framer", reason="pymodbus is not installed")
    for content in (
        bytes.fromhex("0207"),
        bytes.fromhex("1103006b0003"),
        bytes(range(250)),
    ):
        theirs = framers.FramerRTU.compute_CRC(content)
        assert modbus.crc(content) == theirs.to_bytes(2, "big")
