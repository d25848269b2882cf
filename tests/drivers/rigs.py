"""Rigs of a driver with its simulator: every driver passes the same battery on every transport."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import pytest

from reseau.core.errors import DeadlineError
from reseau.instruments import Device, RemoteOperator
from reseau_drivers.camera import CameraDriver, aravis, v4l2
from reseau_drivers.camera import rig as camera_rig
from reseau_drivers.environment import (
    EnvironmentSensor,
    environment_line,
    environment_modbus,
    environment_scpi,
)
from reseau_drivers.link import link_to
from reseau_drivers.oscilloscope import Oscilloscope
from reseau_drivers.scanner import BkScanner, CompactPulser, Ping360, Ping360Settings
from reseau_drivers.turntable import AxisPlan, ByHand, Grbl, HandTable, Kinesis, Marlin, Smc100, Table, Zaber
from reseau_drivers.visa import scpi_link
from reseau_sims import serving
from reseau_sims.serving import (
    FaultScript,
    FaultyConnection,
    GrblController,
    InProcess,
    KinesisController,
    LineSensor,
    Machine,
    MarlinController,
    ModbusSensor,
    PtyServer,
    ScpiSensor,
    Server,
    SimulatedHands,
    Smc100Line,
    TcpServer,
    UdpServer,
    ZaberChain,
)
from reseau_sims.serving.gige import GigeCamera
from reseau_sims.serving.gigevision import GigeVisionCamera, loopback_addresses
from reseau_sims.serving.imaging import SimulatedCamera, StripeScene, View
from reseau_sims.serving.usbtmc import UsbInstrument, plugged_in
from reseau_sims.serving.v4l2 import VideoCamera

TRANSPORTS = ("pty", "tcp", "in process")
ANSWER_S, LATE_S, WORK_S = 0.5, 0.6, 3.0
"""Time limits of an answer, also on a busy machine, and of work; when an answer comes that is late."""
_ATTEMPTS = 3
_SERVERS: dict[str, Callable[..., Server]] = {"pty": PtyServer, "tcp": TcpServer, "udp": UdpServer}


def _patiently(ready: Callable[[], object]) -> None:
    """Make an instrument ready: on a loaded machine its first answer may come later than an answer may."""
    for _ in range(_ATTEMPTS - 1):
        with suppress(DeadlineError):
            ready()
            return
    ready()


@dataclass
class Rig:
    """A driver, what it drives, and what to do with it.

    Parameters
    ----------
    device : Device
        The driver.
    machine : Machine or SimulatedCamera
        What it drives.
    script : FaultScript
        What goes wrong between them.
    work : callable
        Takes the number of a run; does something that is different from run to run, and asserts that what
        came out is right.
    recover : callable
        Brings the instrument back after any fault, as a user would.
    """

    device: Device[Any]
    machine: Machine | SimulatedCamera
    script: FaultScript
    work: Callable[[int], None]
    recover: Callable[[], object]
    server: Server | GigeCamera | GigeVisionCamera | None = None
    extra: dict[str, Any] = field(default_factory=dict)


def aravis_is_missing() -> str:
    """What lacks for GigE Vision on this machine; empty when nothing does."""
    try:
        import gi  # type: ignore[import-untyped, import-not-found, unused-ignore]

        gi.require_version("Aravis", "0.8")
    except (ImportError, ValueError) as error:
        return f"no Aravis ({error}): apt-get install gir1.2-aravis-0.8, pip install reseau[aravis]"
    return ""


def left_open() -> tuple[int, int, int]:
    """File descriptors, sockets among them, and threads of this process."""
    fds = os.listdir("/proc/self/fd")
    sockets = 0
    for fd in fds:
        try:
            sockets += os.readlink(f"/proc/self/fd/{fd}").startswith("socket:")
        except OSError:
            continue
    return len(fds), sockets, threading.active_count()


def _wired(
    stack: ExitStack, transport: str, machine: Machine, script: FaultScript
) -> tuple[Any, Server | None]:
    """Address or link by which a driver reaches a machine."""

    def session() -> FaultyConnection:
        return FaultyConnection(machine, script)

    if transport == "in process":
        return InProcess(session), None
    server: Server = stack.enter_context(_SERVERS[transport](session))
    return server.address, server


SimulatedTable = ZaberChain | Smc100Line | KinesisController | GrblController | MarlinController


def _table_rig(device: Table, machine: SimulatedTable, script: FaultScript, server: Server | None) -> Rig:
    def work(run: int) -> None:
        for axis, plan in device.plans.items():
            target = 10.0 + (7 * run + plan.axis) % 60
            state = device.move(axis, target, 8.0)
            key: Any = (plan.device, plan.axis) if isinstance(machine, ZaberChain) else plan.device
            if isinstance(machine, GrblController | MarlinController):
                key = plan.axis
            assert abs(state.position - target) < 0.01
            assert abs(machine.motors[key].position / plan.per_unit - target) < 0.01

    def recover() -> None:
        for axis in device.plans:
            device.home(axis, 8.0)

    return Rig(device, machine, script, work, recover, server)


def zaber_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    machine = ZaberChain([2, 1])
    address, server = _wired(stack, transport, machine, script)
    plans = {
        "tilt": AxisPlan(1, 1, per_unit=1000.0, high=100.0, backlash=0.5),
        "roll": AxisPlan(2, 1, per_unit=500.0, high=100.0),
    }
    device = Table("table", Zaber(link_to(address), ANSWER_S), plans, seconds=WORK_S)
    _patiently(lambda: device.configure(speed=800.0))
    return _table_rig(device, machine, script, server)


def smc100_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    machine = Smc100Line(1, low=0.0, high=100.0, speed=800.0)
    address, server = _wired(stack, transport, machine, script)
    device = Table(
        "roll", Smc100(link_to(address), ANSWER_S), {"roll": AxisPlan(1, high=100.0)}, seconds=WORK_S
    )
    _patiently(lambda: device.configure(speed=800.0))
    return _table_rig(device, machine, script, server)


def kinesis_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    """A cube on its own port; a rack with two bays in process."""
    rack = transport == "in process"
    machine = KinesisController(2 if rack else 0)
    address, server = _wired(stack, transport, machine, script)
    plans = {"tilt": AxisPlan(1, per_unit=1919.64, high=100.0, backlash=0.5)}
    if rack:
        plans["roll"] = AxisPlan(2, per_unit=1000.0, high=100.0)
    device = Table("table", Kinesis([link_to(address)], rack=rack, answer_s=ANSWER_S), plans, seconds=WORK_S)
    _patiently(lambda: device.configure(speed=800.0))
    return _table_rig(device, machine, script, server)


def grbl_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    machine = GrblController(2, low=-1.0, high=200.0, speed=1600.0)
    return _lines_rig(stack, transport, script, machine, Grbl)


def marlin_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    machine = MarlinController(2, high=200.0, speed=1600.0)
    return _lines_rig(stack, transport, script, machine, Marlin)


def _lines_rig(
    stack: ExitStack,
    transport: str,
    script: FaultScript,
    machine: GrblController | MarlinController,
    controller: type[Grbl] | type[Marlin],
) -> Rig:
    address, server = _wired(stack, transport, machine, script)
    plans = {
        "tilt": AxisPlan(axis=1, per_unit=2.0, high=100.0, backlash=0.5),
        "z": AxisPlan(axis=2, unit="mm", high=100.0),
    }
    device = Table("table", controller(link_to(address, keep_up=True), ANSWER_S), plans, seconds=WORK_S)
    _patiently(lambda: device.configure(speed=800.0))
    return _table_rig(device, machine, script, server)


def hand_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    """A table moved by hand: each request to the person is a connection of its own."""
    machine = SimulatedHands(["tilt"])
    server = stack.enter_context(TcpServer(lambda: FaultyConnection(machine, script)))
    person = RemoteOperator(server.address, 0.4)
    plan = AxisPlan(high=100.0, tolerance=0.2)
    device = HandTable("table", ByHand(person, {}), {"tilt": plan}, seconds=2.0)

    def work(run: int) -> None:
        for k in range(5):
            target = 10.0 + (7 * run + 3 * k) % 60
            state = device.move("tilt", target, 4.0)
            assert abs(state.position - target) <= 0.2
            assert abs(machine.position("tilt") - state.position) <= 0.01

    return Rig(device, machine, script, work, lambda: device.home("tilt", 4.0), server)


def ping360_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    machine = serving.Ping360()
    address, server = _wired(stack, transport, machine, script)
    device = Ping360(
        "sonar", link_to(address), Ping360Settings(half_sector=2), seconds=WORK_S, answer_s=ANSWER_S
    )

    def work(run: int) -> None:
        for angle in ((37 * run + 11 * k) % 200 - 100 for k in range(5)):
            assert set(device.line(angle)) == {(200 + angle) % 256}

    return Rig(device, machine, script, work, device.stop, server)


def scope_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    machine = serving.Oscilloscope("keysight")
    server: Server | None = None
    extra: dict[str, Any] = {}
    if transport in ("tcp", "in process"):
        address, server = _wired(stack, transport, machine, script)
    elif transport == "vxi-11":
        session = partial(serving.Vxi11Session, machine, machine.execute, script)
        server = tcp = stack.enter_context(TcpServer(session))
        address = f"TCPIP::127.0.0.1,{tcp.port}::inst0::INSTR"
    elif transport == "usbtmc":
        plugged = stack.enter_context(plugged_in(UsbInstrument(machine, machine.execute, script)))
        address, extra = plugged.resource, {"usb": plugged}
    else:
        both = serving.HislipInstrument(machine, machine.execute, script)
        server = tcp = stack.enter_context(TcpServer(both.channel))
        address = f"TCPIP::127.0.0.1::hislip0,{tcp.port}::INSTR"
    device = Oscilloscope("scope", scpi_link(address), seconds=0.7)

    def work(run: int) -> None:
        shown = np.roll(machine_picture, run, axis=1)
        machine.screen = lambda: shown
        for _ in range(5):
            assert (device.screen().frame().pixels == shown).all()

    machine_picture = machine.screen()
    return Rig(device, machine, script, work, device.screen, server, extra)


def bk_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    machine = serving.BkScanner(
        announces_wrongly=transport == "in process", acknowledges_off=transport != "in process"
    )
    address, server = _wired(stack, transport, machine, script)
    device = BkScanner("bk", link_to(address), seconds=0.5)
    picture = machine.section()

    def work(run: int) -> None:
        shown = np.roll(picture, run, axis=0)
        machine.section = lambda: shown
        scan = device.scan()
        wrong = int((scan.pixels != shown).sum())
        # The protocol has no checksum of its own (TCP has): a bit that turns in a pixel cannot be seen.
        assert wrong == 0 or (wrong == 1 and script.happened[-1].kind == "corrupted")
        assert scan.mm_per_px == pytest.approx((0.2, 0.25))
        assert scan.origin_px == (39.5, 0.0)

    return Rig(device, machine, script, work, device.scan, server)


def pulser_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    machine = serving.CompactPulser()
    address, server = _wired(stack, transport, machine, script)
    device = CompactPulser("pulser", link_to(address), seconds=WORK_S, answer_s=ANSWER_S)

    def work(run: int) -> None:
        width = 20.0 + run % 900
        device.configure(width_ns=width, repetition_hz=100.0)
        if (machine.values["W"], machine.values["P"]) != (width, 10):
            # Its power went off behind the last answer: that is found by asking, and said.
            device.verify()
            raise AssertionError(machine.values)

    return Rig(device, machine, script, work, device.stop, server)


_AIR = {"temperature": 20.0, "humidity": 50.0, "pressure": 1000.0}
_SENSED: dict[str, dict[str, Any]] = {name: {} for name in _AIR}


def environment_scpi_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    machine = ScpiSensor(lambda: _AIR)
    asked = {name: {"query": query} for query, name in ScpiSensor.QUERIES.items()}
    if transport == "vxi-11":
        session = partial(serving.Vxi11Session, machine, machine.execute, script)
        server: Server | None = stack.enter_context(TcpServer(session))
        assert isinstance(server, TcpServer)
        address: Any = f"TCPIP::127.0.0.1,{server.port}::inst0::INSTR"
    else:
        address, server = _wired(stack, transport, machine, script)
    device = environment_scpi("air", address, quantities=asked, answer_s=ANSWER_S, seconds=WORK_S)
    return _sensor_rig(device, machine, script, server)


def environment_modbus_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    """RTU on a line, in process with two requests; frames of TCP on TCP."""
    machine = ModbusSensor(lambda: _AIR, unit=7, tcp=transport == "tcp")
    address, server = _wired(stack, transport, machine, script)
    far = {"register": 102, "function": 3} if transport == "in process" else {"register": 2}
    registers: dict[str, dict[str, Any]] = {
        "temperature": {"register": 0, "scale": 0.1},
        "humidity": {"register": 1, "scale": 0.1},
        "pressure": {"format": "float32", **far},
    }
    device = environment_modbus(
        "air", address, quantities=registers, unit=7, answer_s=ANSWER_S, seconds=WORK_S
    )
    return _sensor_rig(device, machine, script, server)


def environment_line_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    """Lines that come by themselves on a line; asked for on TCP, and in process with a checksum."""
    asked, checked = transport != "pty", transport != "tcp"
    machine = LineSensor(lambda: _AIR, every_s=0.0 if asked else 0.05, checksum=checked)
    address, server = _wired(stack, transport, machine, script)
    device = environment_line(
        "air", address, pattern=LineSensor.PATTERN, quantities=_SENSED, query="?\n" if asked else "",
        checksum="xor" if checked else "none", answer_s=ANSWER_S, seconds=WORK_S,
    )  # fmt: skip
    return _sensor_rig(device, machine, script, server)


def _sensor_rig(
    device: EnvironmentSensor,
    machine: ScpiSensor | ModbusSensor | LineSensor,
    script: FaultScript,
    server: Server | None,
) -> Rig:
    def work(run: int) -> None:
        # Each quantity changes from run to run, by more than what is believed without a checksum.
        temperature, humidity = 20.0 + 2.5 * (run % 8), 30.0 + 5.0 * (run % 9)
        now = {"temperature": temperature, "humidity": humidity, "pressure": 900.0 + 20.0 * (run % 7)}
        machine.conditions = lambda: now
        if machine.due is not None:
            device.environment()  # its line may be under way from before
        # Five answers: a reading takes one of these, of SCPI at least six.
        for _ in range(1 if isinstance(machine, ScpiSensor) else 5):
            found = device.environment().conditions
            for name, value in now.items():
                # What has no checksum is believed if it comes twice: as exactly as it is asked to agree.
                assert abs(found[name].value - value) <= device.quantities[name].least, (name, found)

    return Rig(device, machine, script, work, device.environment, server)


def v4l2_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    body = SimulatedCamera(script=script)
    camera = VideoCamera(body, first=(1 << 32) - 20)
    device = v4l2("camera", camera.open, settings={"exposure_us": 2000.0, "gain": 3}, seconds=0.5)

    def work(run: int) -> None:
        for k in range(5):
            pattern = StripeScene(shift=5 * run + k)
            body.point_at(pattern)
            shot = device.expose()
            # A frame that began before the camera was turned would show the pattern of before.
            assert shot.fresh
            assert (shot.pixels == pattern(camera.view)).all()
            assert (shot.exposure_us, camera.view.exposure_us, camera.view.gain_db) == (2000.0, 2000.0, 3.0)

    return Rig(device, body, script, work, device.expose, extra={"camera": camera})


def gige_camera(stack: ExitStack, body: SimulatedCamera, features: str = "") -> GigeCamera:
    """A simulated camera on GigE Vision, once no other test has one; without Aravis the test is skipped."""
    missing = aravis_is_missing()
    if missing:
        pytest.skip(missing)
    return stack.enter_context(GigeCamera(body, features=features, wait_s=240.0))


def gige_rig(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    body = SimulatedCamera(script=script)
    camera = gige_camera(stack, body)
    light = {"exposure_us": 2000.0, "gain": 3.0, "rate": 100.0}
    device = aravis("camera", camera.address, settings=light | {"width": 96, "height": 64}, seconds=1.0)

    def work(run: int) -> None:
        for k in range(5):
            pattern = StripeScene(shift=5 * run + k)
            body.point_at(pattern)
            shot = device.expose()
            assert shot.fresh
            assert (shot.pixels == pattern(View(2000.0, 3.0, 0.0, 0, 0, 96, 64, 255.0))).all()

    return Rig(device, body, script, work, device.expose, camera)


def vision_cameras(stack: ExitStack, *bodies: SimulatedCamera, **more: Any) -> list[GigeVisionCamera]:
    """Simulated GigE Vision cameras at addresses of this process; without Aravis the test is skipped."""
    missing = aravis_is_missing()
    if missing:
        pytest.skip(missing)
    return [
        stack.enter_context(GigeVisionCamera(body, address=address, serial=f"RS{k}", **more))
        for k, (body, address) in enumerate(zip(bodies, loopback_addresses(len(bodies)), strict=True))
    ]


def own_key() -> int:
    """Device key of this process: action commands are broadcast, also to cameras of other tests."""
    return os.getpid()


class CameraPair:
    """A rig of two cameras, which is closed with them."""

    def __init__(self, rig: Any, cameras: dict[str, CameraDriver[Any]]) -> None:
        self.rig, self.cameras, self.name = rig, cameras, rig.name
        rig.combine(cameras)

    @property
    def reconnections(self) -> int:
        """Of the camera with the faults."""
        return self.cameras["left"].reconnections

    def connect(self, seconds: float | None = None) -> Any:
        for each in self.cameras.values():
            each.connect(seconds)
        return self.rig.connect(seconds)

    def close(self) -> None:
        for each in (self.rig, *self.cameras.values()):
            each.close()


def _pair_rig(pair: CameraPair, bodies: list[SimulatedCamera], script: FaultScript, view: View) -> Rig:
    def work(run: int) -> None:
        for k in range(3):
            patterns = [StripeScene(shift=10 * run + 3 * k + side) for side in range(2)]
            for body, pattern in zip(bodies, patterns, strict=True):
                body.point_at(pattern)
            taken = pair.rig.expose_all()
            # A frame of another exposure, or of the other camera, would show another pattern.
            for shot, pattern in zip(taken.exposures.values(), patterns, strict=True):
                assert shot.fresh
                assert (shot.pixels == pattern(view)).all()

    device: Any = pair
    return Rig(device, bodies[0], script, work, pair.rig.expose_all)


def gige_pair(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    bodies = [SimulatedCamera(script=script), SimulatedCamera()]
    served = vision_cameras(stack, *bodies)
    how = {"trigger": "action", "action_device_key": own_key(), "exposure_us": 2000.0, "gain": 3.0}
    cameras = {
        name: aravis(name, each.address, settings=how | {"width": 96, "height": 64}, seconds=2.0)
        for name, each in zip(("left", "right"), served, strict=True)
    }
    pair = CameraPair(camera_rig("pair", "left, right", settings={"trigger": "action"}, seconds=2.0), cameras)
    made = _pair_rig(pair, bodies, script, View(2000.0, 3.0, 0.0, 0, 0, 96, 64, 255.0))
    made.server = served[0]
    return made


def v4l2_pair(stack: ExitStack, transport: str, script: FaultScript) -> Rig:
    bodies = [SimulatedCamera(script=script), SimulatedCamera()]
    videos = [VideoCamera(body) for body in bodies]
    cameras = {
        name: v4l2(name, each.open, settings={"exposure_us": 2000.0, "gain": 3}, seconds=0.5)
        for name, each in zip(("left", "right"), videos, strict=True)
    }
    pair = CameraPair(camera_rig("pair", "left, right", seconds=0.5), cameras)
    for each in cameras.values():
        each.connect()
    return _pair_rig(pair, bodies, script, videos[0].view)


Maker = Callable[[ExitStack, str, FaultScript], Rig]
RIGS: dict[tuple[str, str], Maker] = {
    **{("zaber", transport): zaber_rig for transport in TRANSPORTS},
    **{("smc100", transport): smc100_rig for transport in TRANSPORTS},
    **{("kinesis", transport): kinesis_rig for transport in TRANSPORTS},
    **{("grbl", transport): grbl_rig for transport in TRANSPORTS},
    **{("marlin", transport): marlin_rig for transport in TRANSPORTS},
    ("hand", "request"): hand_rig,
    **{("ping360", transport): ping360_rig for transport in (*TRANSPORTS, "udp")},
    **{("bk", transport): bk_rig for transport in ("tcp", "in process")},
    **{("compactpulser", transport): pulser_rig for transport in TRANSPORTS},
    **{("environment_scpi", transport): environment_scpi_rig for transport in (*TRANSPORTS, "vxi-11")},
    **{("environment_modbus", transport): environment_modbus_rig for transport in TRANSPORTS},
    **{("environment_line", transport): environment_line_rig for transport in TRANSPORTS},
    **{
        ("oscilloscope", transport): scope_rig
        for transport in ("tcp", "vxi-11", "hislip", "usbtmc", "in process")
    },
    ("v4l2", "in process"): v4l2_rig,
    ("aravis", "gige"): gige_rig,
    ("rig", "in process"): v4l2_pair,
    ("rig", "gige"): gige_pair,
}


@contextmanager
def rig(driver: str, transport: str, script: FaultScript | None = None) -> Iterator[Rig]:
    """A rig, connected and ready; nothing of it is left afterwards."""
    with ExitStack() as stack:
        made = RIGS[driver, transport](stack, transport, script or FaultScript())
        stack.callback(made.device.close)
        _patiently(made.device.connect)
        _patiently(made.recover)
        yield made
