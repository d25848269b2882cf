"""Bench of simulated instruments with their real protocols, all in one laboratory."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any, Literal, Self, get_args

import numpy as np
import scipy
from numpy.typing import NDArray

from reseau.core.data import Array
from reseau.core.errors import UsageError

from ..frame import DISTANCE_MM as FRAME_DISTANCE_MM
from ..frame import PROJECT_POSES, SpaceFrame, project
from ..frame import SIZE as FRAME_SIZE
from ..laboratory import AXES, Laboratory, Seat
from ..pixels import PixelSensor
from ..reflectors import Reflectors
from ..streams import stream
from ..testfield import FieldBench
from ..water import Water
from ..world import World
from .bk import BkScanner
from .compactpulser import CompactPulser
from .environment import Air, LineSensor, ModbusSensor, ScpiSensor
from .faults import FaultScript
from .gige import GigeCamera, aravis_is_installed
from .gigevision import GigeVisionCamera, loopback_addresses
from .grbl import GrblController
from .imaging import LaboratoryScene, LampScene, SimulatedCamera
from .kinesis import KinesisController
from .machine import FaultyConnection, Machine
from .marlin import MarlinController
from .oscilloscope import FAMILIES, Oscilloscope
from .person import SimulatedHands, SimulatedOperator
from .ping360 import Ping360
from .scpi import Vxi11Session
from .servers import PtyServer, Server, TcpServer
from .smc100 import Smc100Line
from .v4l2 import VideoCamera
from .zaber import ZaberChain

TableKind = Literal["zaber", "smc100", "kinesis", "grbl", "marlin", "hand"]
SensorKind = Literal["scpi", "modbus", "line", "all"]
SceneName = Literal["screen", "testfield", "frame", "sensor"]
ScannerKind = Literal["ping360", "bk", "compactpulser", "all"]
_PATIENCE_S = 120.0
"""Time to wait for the port of another simulated camera on this machine (s)."""
_DISTORTION_PX = 1.5
"""Distortion at the edge of a frame of the flat testfield (px)."""

_CHAIN = {"tilt": (1, 1), "roll": (1, 2), "camera_roll": (2, 1), "z": (3, 1)}
"""Device and axis on the Zaber chain; each axis of the Newport table has its own controller."""
_STEPS = 1000.0
"""Steps of the Zaber devices per degree or millimetre."""
_HIGH = {"tilt": 75.0, "roll": 360.0, "camera_roll": 360.0, "z": 300.0}
_LOW = -5.0
"""Below zero, so that zero can be approached from below."""
_SCREEN = (800, 480)
_SENSOR = (96, 64)
_PIXELS: dict[str, Any] = {"gain": 0.2, "read_noise": 20.0, "full_well": 11_000.0, "bits": 16}
_LAMP, _EDGE_US = 16.0, 1000.0
"""Grey values per microsecond of the lamp; exposure for the edge (µs)."""

_BENCH = """\
schema = "reseau-bench/1"
name = "simulated"
operator = "{operator}"

[instruments.table]
driver = "{kind}"
address = "{table}"
settings = {{speed = 50.0}}

{more}[instruments.table.options.axes]
{axes}{scanners}{sensors}
[instruments.oscilloscope]
driver = "oscilloscope"
address = "{oscilloscope}"
"""

_SCANNERS = {
    "ping360": "settings = {range_mm = 150.0}\n",
    "bk": "",
    "compactpulser": 'options = {digitiser = "oscilloscope", carrier = "table", axis = "z"}\n',
}
_SENSORS: dict[str, str] = {
    "scpi": """\
[instruments.{name}.options.quantities]
temperature = {{query = "MEAS:TEMP?", sigma = 0.1}}
humidity = {{query = "MEAS:HUM?", sigma = 2.0}}
pressure = {{query = "MEAS:PRES?", sigma = 0.5}}
""",
    "modbus": """\
[instruments.{name}.options.quantities]
temperature = {{register = 0, scale = 0.1, sigma = 0.1}}
humidity = {{register = 1, scale = 0.1, sigma = 2.0}}
pressure = {{register = 2, format = "float32", sigma = 0.5}}
""",
    "line": """\
[instruments.{name}.options]
pattern = '{pattern}'

[instruments.{name}.options.quantities]
temperature = {{sigma = 0.1}}
humidity = {{sigma = 2.0}}
pressure = {{sigma = 0.5}}
""",
}
"""Quantities of the sensors of the environment, as a ``bench.toml`` describes them."""
_NAMES = {"ping360": "scanner", "bk": "bmode", "compactpulser": "pulser"}
"""Names of the scanners, where there are several."""

_CAMERA = """
[instruments.camera]
driver = "aravis"
address = "{address}"
options = {{seconds = 30.0}}

[instruments.camera.settings]
format = "{format}"
trigger = "software"
width = {width}
height = {height}
exposure_us = {exposure}
gain = 0.0
"""


_RIG_CAMERA = """
[instruments.{name}]
driver = "aravis"
address = "{address}"
options = {{seconds = 30.0}}

[instruments.{name}.settings]
format = "Mono8"
trigger = "action"
action_device_key = {key}
width = {width}
height = {height}
exposure_us = 10000.0
gain = 0.0
"""
_RIG = """
[instruments.rig]
driver = "rig"
address = "{cameras}"
settings = {{trigger = "action"}}
options = {{seconds = 30.0}}
"""
SEATS = {
    "left": Seat(),
    "right": Seat(1, (600.0, 0.0, 0.0), 0.01),
    "lower": Seat(2, (0.0, 500.0, 0.0), -0.008),
    "far": Seat(3, (580.0, 520.0, 30.0), 0.004),
}
"""Cameras of a rig before the testfield."""
_LATENCY_US = 40.0
"""Each camera of a rig starts later than the one before, by so much."""


class SimulatedBench:
    """Servers on pseudo-terminals and the loopback interface; see :attr:`toml`.

    Parameters
    ----------
    seed : int
        Seed of the world.
    table : {"zaber", "smc100", "kinesis", "grbl", "marlin", "hand"}
        Controllers of the table; `hand`: the simulated operator moves it.
    family : str
        Oscilloscope, one of :data:`~reseau_sims.serving.FAMILIES`.
    camera : {"screen", "testfield", "frame", "sensor"}, optional
        Object in front of a camera; `sensor`: a lamp, a cover or an edge in front of a camera without a lens,
        whatever the operator is asked for.
        The camera uses GigE Vision if Aravis is installed; otherwise it is a
        Video4Linux camera in this process (`video`) and not part of the ``bench.toml``.
    scanner : {"ping360", "bk", "compactpulser", "all"}
        The scanner, called ``scanner``; of all three the others are called ``bmode`` and ``pulser``.
    environment : {"scpi", "modbus", "line", "all"}, optional
        Sensor of the environment, called ``air``; all three are called ``air_scpi``, ``air_modbus`` and
        ``air_line``.
    repeatable : bool
        See :class:`~reseau_sims.laboratory.Laboratory`.
    flat : bool
        Whether the testfield is a plane in front of a lens with distortion.
    water : Water, optional
        Puts the testfield under water and the camera in a housing, with another lens and closer; the port as
        designed. As made, it differs from this by tolerances that are drawn from the seed.
    in_process : bool
        Whether the camera is in this process even if Aravis is installed.
    cameras : int
        Number of cameras before the testfield; several are the instrument ``rig``, triggered by action
        commands of GigE Vision.

    Attributes
    ----------
    toml : str
        ``bench.toml`` for the instruments.
    documents : dict of str to str
        The files that a session with this camera needs: designs, and for a frame of targets also a lens, a
        network and poses.
    refraction : str
        The part of a ``bench.toml`` about the port and the water before the camera; empty in air.
    laboratory : Laboratory
        Common simulated world.
    scripts : dict
        Faults by instrument; initially none.
    video : VideoCamera or None
        Camera in this process, if any.
    vision : dict of str to GigeVisionCamera
        Cameras of a rig, by name.

    Raises
    ------
    UsageError
        If the table, oscilloscope or scene does not exist, or there is water before another scene.

    Examples
    --------
    >>> with SimulatedBench(seed=3) as bench:  # doctest: +SKIP
    ...     print(bench.toml.splitlines()[1])
    name = "simulated"
    """

    def __init__(
        self,
        seed: int = 0,
        *,
        table: TableKind = "zaber",
        family: str = "keysight",
        camera: SceneName | None = None,
        scanner: ScannerKind = "ping360",
        environment: SensorKind | None = None,
        repeatable: bool = False,
        flat: bool = False,
        water: Water | None = None,
        in_process: bool = False,
        cameras: int = 1,
    ) -> None:
        if not 1 <= cameras <= len(SEATS):
            raise UsageError(f"is not from 1 to {len(SEATS)}", where=f"{cameras} cameras")
        if cameras > 1 and (camera != "testfield" or water is not None or in_process):
            raise UsageError("look at the testfield in air only", where=f"{cameras} cameras")
        for what, known, asked in (
            ("table", get_args(TableKind), table),
            ("oscilloscope", tuple(FAMILIES), family),
            ("scene for a camera", get_args(SceneName), camera),
            ("scanner", get_args(ScannerKind), scanner),
            ("sensor of the environment", get_args(SensorKind), environment),
        ):
            if asked is not None and asked not in known:
                raise UsageError(
                    f"is not a simulated {what}", where=asked, do=f"choose from {', '.join(known)}"
                )
        if water is not None and camera in ("screen", "sensor"):
            raise UsageError("there is water before testfield and frame only", where="water")
        field = FieldBench(seed=seed)
        self.refraction = ""
        if water is not None:
            field = field.submerged(water.made(stream(seed, "water")))
            self.refraction = water.toml()
        if camera == "frame":
            frame = SpaceFrame(seed)
            width, height = FRAME_SIZE
            sensor = replace(field.sensor, width=width, height=height, row_jitter_px=0.0)
            field = replace(field, frame=frame, sensor=sensor, distance_mm=FRAME_DISTANCE_MM)
        if flat:
            field = replace(field, bend_mm=0.0).distorted(_DISTORTION_PX)
        self.laboratory = laboratory = Laboratory(World.standard(seed), field, repeatable=repeatable)
        self.documents = self._documents(camera, water)
        pixels = PixelSensor.drawn(stream(seed, "sensor"), *_SENSOR, **_PIXELS)
        self._lamp = LampScene(pixels, _LAMP, seed)
        self._pulser = CompactPulser()
        scope = Oscilloscope(family, lambda: laboratory.picture(*_SCREEN), self._channel)
        kinds = tuple(_NAMES) if scanner == "all" else (scanner,)
        self._scanners = {(_NAMES[kind] if scanner == "all" else "scanner"): kind for kind in kinds}
        made: dict[str, Callable[[], Machine]] = {
            "ping360": lambda: Ping360(laboratory.line),
            "bk": lambda: BkScanner(laboratory.section, laboratory.SECTION_MM),
            "compactpulser": lambda: self._pulser,
        }
        self.air = Air(seed, steady=repeatable)
        self._sensors = _sensors(environment)
        sensed: dict[str, Callable[[], Machine]] = {
            "scpi": lambda: ScpiSensor(self.air),
            "modbus": lambda: ModbusSensor(self.air),
            "line": lambda: LineSensor(self.air),
        }
        self.machines: dict[str, Machine] = {
            "table": self._table(table),
            **{name: sensed[kind]() for name, kind in self._sensors.items()},
            **{name: made[kind]() for name, kind in self._scanners.items()},
            "oscilloscope": scope,
        }
        self.scripts = {name: FaultScript() for name in self.machines}
        self._servers = ExitStack()
        self.video: VideoCamera | None = None
        self.vision: dict[str, GigeVisionCamera] = {}
        with ExitStack() as stack:
            addresses = {}
            for name, machine in self.machines.items():
                if name != "oscilloscope":
                    of_tcp = "bk" in self._scanners.get(name, "") or self._sensors.get(name) == "scpi"
                    of_tcp = of_tcp or isinstance(machine, SimulatedHands)
                    server: type[Server] = TcpServer if of_tcp else PtyServer
                    connected = partial(FaultyConnection, machine, self.scripts[name])
                    addresses[name] = stack.enter_context(server(connected)).address
            person = stack.enter_context(TcpServer(partial(FaultyConnection, self._operator())))
            addresses["operator"] = person.address
            core = stack.enter_context(
                TcpServer(partial(Vxi11Session, scope, scope.execute, self.scripts["oscilloscope"]))
            )
            addresses["oscilloscope"] = f"TCPIP::{core.HOST},{core.port}::inst0::INSTR"
            if cameras > 1:
                entry = self._rig(cameras, stack)
            else:
                entry = "" if camera is None else self._camera(camera, in_process, stack)
            self._servers = stack.pop_all()
        axes = "".join(_axis_entry(table, name) for name in AXES)
        scanners = "".join(
            f'\n[instruments.{name}]\ndriver = "{kind}"\naddress = "{addresses[name]}"\n{_SCANNERS[kind]}'
            for name, kind in self._scanners.items()
        )
        sensors = "".join(
            f'\n[instruments.{name}]\ndriver = "environment_{kind}"\naddress = "{addresses[name]}"\n\n'
            + _SENSORS[kind].format(name=name, pattern=LineSensor.PATTERN)
            for name, kind in self._sensors.items()
        )
        more = "[instruments.table.options]\nrack = true\n\n" if table == "kinesis" else ""
        parts = {"more": more, "axes": axes, "scanners": scanners, "sensors": sensors}
        self.toml = _BENCH.format(kind=table, **parts, **addresses) + entry

    def _documents(self, camera: SceneName | None, water: Water | None) -> dict[str, str]:
        """The files that a session with a camera needs."""
        world, field = self.laboratory.world, self.laboratory.field
        if camera == "screen":
            return {"reseau.json": world.design.to_json(), "rods.json": world.test_object.to_json()}
        if camera == "testfield":
            return {"field.json": field.design.to_json()}
        if camera != "frame" or field.frame is None:
            return {}
        poses = {name: self.laboratory.pose_at(position) for name, position in PROJECT_POSES.items()}
        axes = tuple(next(iter(PROJECT_POSES.values())))
        rows = (f"{name},{','.join(f'{at[a]:g}' for a in axes)}\n" for name, at in PROJECT_POSES.items())
        return field.frame.documents | {
            "project.json": project(field.frame, poses, water),
            "poses.csv": f"name,{','.join(axes)}\n" + "".join(rows),
        }

    def _operator(self) -> SimulatedOperator:
        """The person in the laboratory; what is asked for last is what the camera without a lens sees."""
        laboratory, lamp = self.laboratory, self._lamp

        def fill(reflectors: Callable[[], Reflectors]) -> None:
            laboratory.tank = reflectors()

        def light(light: Array | float) -> None:
            lamp.light = light

        def blank() -> None:
            laboratory.tank = laboratory.tank  # nothing has been swept

        return SimulatedOperator({
            "blank the screen": blank,
            "test object": lambda: fill(lambda: laboratory.world.rods),
            "body": lambda: fill(laboratory.world.body),
            "cover the lens": lambda: light(0.0),
            "even light": lambda: light(_LAMP),
            "edge": lambda: light(_edge()),
        })  # fmt: skip

    def _camera(self, scene: SceneName, in_process: bool, stack: ExitStack) -> str:
        """Create the camera; return its part of the ``bench.toml`` if it can be reached from outside."""
        if scene == "sensor":
            body = SimulatedCamera(self._lamp, *_SENSOR)
        else:
            sight: Literal["screen", "testfield"] = "screen" if scene == "screen" else "testfield"
            first = self.laboratory.expose(sight)  # do the long computations now
            body = SimulatedCamera(LaboratoryScene(self.laboratory, sight), first.width, first.height)
        self.scripts["camera"] = body.script
        if in_process or not aravis_is_installed():
            self.video = VideoCamera(body)
            return ""
        served = GigeCamera(body, wait_s=_PATIENCE_S)
        stack.callback(served.close)
        pixels = "Mono16" if scene == "sensor" else "Mono8"
        entry = _CAMERA.format(
            address=served.address, width=body.width, height=body.height, format=pixels,
            exposure=_EDGE_US if scene == "sensor" else 10_000.0,
        )  # fmt: skip
        return entry + self.refraction

    def _rig(self, count: int, stack: ExitStack) -> str:
        """Create the cameras of a rig; return their part of the ``bench.toml``."""
        if not aravis_is_installed():
            raise UsageError(
                "needs Aravis and PyGObject", where=f"{count} cameras", do="install reseau[aravis]"
            )
        entries, key = "", os.getpid()
        for k, (name, seat) in enumerate(list(SEATS.items())[:count]):
            first = self.laboratory.expose("testfield", seat=seat)  # do the long computations now
            body = SimulatedCamera(
                LaboratoryScene(self.laboratory, "testfield", seat), first.width, first.height
            )
            self.scripts[name] = body.script
            address = loopback_addresses(count)[k]
            self.vision[name] = stack.enter_context(
                GigeVisionCamera(body, address=address, serial=f"RS{k}", latency_us=_LATENCY_US * k)
            )
            entries += _RIG_CAMERA.format(
                name=name, address=address, width=body.width, height=body.height, key=key
            )
        return entries + _RIG.format(cameras=", ".join(self.vision))

    def _table(self, kind: TableKind) -> Machine:
        """Create the controllers of the table, and connect them to the axes of the laboratory."""
        if kind == "smc100":
            line = Smc100Line(len(AXES), low=_LOW, high=400.0, speed=20.0)
            for address, name in enumerate(AXES, 1):
                self.laboratory.attach(name, partial(line.position, address))
            return line
        if kind == "hand":
            hands = SimulatedHands(AXES)
            for name in AXES:
                self.laboratory.attach(name, partial(hands.position, name))
            return hands
        if kind in _OF_ONE_BOARD:
            board: Machine = _OF_ONE_BOARD[kind]()
            for number, name in enumerate(AXES, 1):
                self.laboratory.attach(name, partial(_place, board, number))
            return board
        chain = ZaberChain([2, 1, 1], low=_LOW * _STEPS)
        for name, key in _CHAIN.items():
            self.laboratory.attach(name, partial(_units, chain, *key))
        return chain

    def _channel(self) -> NDArray[np.uint8]:
        """Channel 1 of the oscilloscope: echoes of the pulser while it sends, otherwise of the scanner."""
        if not self._pulser.values["P"]:
            return self.laboratory.echoes
        return self.laboratory.pulse(self.laboratory.axes["z"])

    @property
    def violations(self) -> dict[str, list[str]]:
        """Protocol violations of clients, by instrument."""
        return {name: list(machine.violations) for name, machine in self.machines.items()}

    def close(self) -> None:
        """Close all connections."""
        self._servers.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _edge() -> Array:
    """Light on the sensor from a straight edge, slanted by six degrees."""
    width, height = _SENSOR
    y, x = np.mgrid[:height, :width]
    share: Array = scipy.special.ndtr((x - width / 2 - 0.1 * (y - height / 2)) / 0.6)
    return np.asarray(_LAMP * (0.2 + 1.8 * share))


def _units(chain: ZaberChain, device: int, axis: int) -> float:
    """Position of an axis, in degrees or millimetres."""
    return chain.position(device, axis) / _STEPS


def _sensors(kind: SensorKind | None) -> dict[str, str]:
    """Kinds of the sensors of the environment by their names."""
    if kind is None:
        return {}
    return {f"air_{each}": each for each in _SENSORS} if kind == "all" else {"air": kind}


_OF_ONE_BOARD: dict[str, Callable[[], Any]] = {
    "kinesis": lambda: KinesisController(len(AXES), low=_LOW * _STEPS, high=400.0 * _STEPS),
    "grbl": lambda: GrblController(len(AXES), low=_LOW, high=400.0),
    "marlin": lambda: MarlinController(len(AXES), low=_LOW, high=400.0),
}
"""Controllers that have all axes."""


def _place(board: Any, number: int) -> float:
    """Position of an axis, in degrees or millimetres."""
    place: float = board.position(number)
    return place / _STEPS if isinstance(board, KinesisController) else place


def _axis_entry(kind: TableKind, name: str) -> str:
    """Line of ``bench.toml`` for an axis."""
    device, axis = _CHAIN[name]
    where = f"device = {device}, axis = {axis}, per_unit = {_STEPS}"
    number = AXES.index(name) + 1
    where = {
        "smc100": f"device = {number}",
        "kinesis": f"device = {number}, per_unit = {_STEPS}",
        "grbl": f"axis = {number}",
        "marlin": f"axis = {number}",
        "hand": "tolerance = 0.1",
    }.get(kind, where)
    unit = ', unit = "mm"' if name == "z" else ", backlash = 0.2"
    return f"{name} = {{{where}, low = {_LOW}, high = {_HIGH[name]}{unit}}}\n"


def serve(seed: int = 0, *, water: Mapping[str, Any] | None = None, **options: Any) -> SimulatedBench:
    """Create a simulated bench; entry point ``bench``.

    Parameters
    ----------
    seed : int
        Seed of the world.
    water : mapping, optional
        Arguments of :class:`~reseau_sims.water.Water`: testfield under water.
    **options
        Further arguments of :class:`SimulatedBench`.
    """
    return SimulatedBench(seed, water=None if water is None else Water(**water), **options)
