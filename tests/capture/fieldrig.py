"""A testfield on a table before a camera, without protocols; the same pose gives the same frame."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.archive import Session
from reseau.capture import Acquisition, Bench, BenchFile, InstrumentEntry
from reseau.core.data import Frame
from reseau.core.errors import StateError
from reseau.designs import coded_testfield
from reseau.instruments import AxisState, BScan, Deadline, Device, Settings, Status
from reseau.io import TestfieldDesign
from reseau.measure.testfield.measure import TestfieldOptions
from reseau.procedures.calibration_options import CameraOptions
from reseau.procedures.target_measurement import measurer_of
from reseau.procedures.testfield import TestfieldProcedure
from reseau_sims import FieldBench, Station

from .. import kept
from .simple import CameraSettings, Simple, Taken

AXES = ("tilt", "roll", "camera_roll")
DESIGN = coded_testfield()
BENCH = """\
schema = "reseau-bench/1"
name = "field"
[instruments.table]
driver = "table"
address = "sim-table"
[instruments.camera]
driver = "camera"
address = "sim-camera"
"""
POSES = "tilt,roll,camera_roll\n0,0,0\n30,90,90\n30,180,180\n30,270,270\n30,0,0\n"
TESTFIELD = ("--design", "field.json", "--poses", "poses.csv", "--pitch-mm", "0.027", "--free", "c,x0,y0,K1",
             "--row-jitter-px", "0.0086", "--fill", "0.8")  # fmt: skip


class Axis:
    """One axis."""

    parent = None
    unit, limits = "deg", (-5.0, 360.0)

    def __init__(self, table: FieldTable, key: str) -> None:
        self._table, self.key, self.name = table, key, f"table_{key}"

    def set(self, value: float) -> Status:
        return Status(lambda: self._table.move(self.key, value), self.name)

    def stop(self, *, success: bool = False) -> None:
        self._table.stop()

    def read(self) -> dict[str, Any]:
        return {self.name: {"value": self._table.stands[self.key], "timestamp": 0.0}}

    def describe(self) -> dict[str, Any]:
        return {self.name: {"source": "sim", "dtype": "number", "shape": []}}


class FieldTable(Simple):
    """A table that moves at once."""

    def __init__(self, name: str, axes: tuple[str, ...] = AXES) -> None:
        super().__init__(name, Settings())
        self.stands = dict.fromkeys(axes, 0.0)
        self.moves: list[tuple[str, float]] = []
        self.stops, self.lost = 0, set[str]()
        self.before: Callable[[str, float], None] = lambda axis, position: None

    @property
    def axes(self) -> Mapping[str, Axis]:
        return {key: Axis(self, key) for key in self.stands}

    def home(self, axis: str, seconds: float | None = None) -> AxisState:
        self.lost.discard(axis)
        return self.move(axis, 0.0)

    def move(self, axis: str, position: float, seconds: float | None = None) -> AxisState:
        if self._stopping.is_set():
            raise StateError("was stopped", where=self.name, command="move")
        self.before(axis, position)
        self.moves.append((axis, position))
        self.stands[axis] = position
        return self.state(axis)

    def state(self, axis: str, seconds: float | None = None) -> AxisState:
        return AxisState(self.stands[axis], False, axis not in self.lost)

    def _halt(self, deadline: Deadline) -> None:
        self.stops += 1


class FieldCamera(Simple):
    """A camera that looks at the testfield on the table."""

    def __init__(self, name: str, table: FieldTable, field: FieldBench) -> None:
        super().__init__(name, CameraSettings())
        self.table, self.field = table, field
        self.exposures = 0
        self.spoil: Callable[[int, np.ndarray], np.ndarray] = lambda number, pixels: pixels
        self.during: Callable[[int], None] = lambda number: None

    def expose(self, seconds: float | None = None) -> Taken:
        self.exposures += 1
        self.during(self.exposures)
        station = Station(*(self.table.stands[axis] for axis in self.table.stands))
        own = isinstance(self.field, FieldBench)
        frame = kept.once(FieldBench.record, self.field, station) if own else self.field.record(station)
        pixels = self.spoil(self.exposures, frame.pixels)
        return Taken(Frame(pixels, 255.0), self.exposures, datetime.now(UTC), self.settings.exposure_us)

    def _push(self, settings: Any, deadline: Deadline) -> None:
        self._settings = settings

    def frames(self, count: int, seconds: float | None = None) -> Iterator[Taken]:
        return (self.expose(seconds) for _ in range(count))


class Sweeper(Simple):
    """A scanner that does not report its frequency."""

    def __init__(self, name: str) -> None:
        super().__init__(name, Settings())
        self.sweeps = 0

    def scan(self, seconds: float | None = None) -> BScan:
        self.sweeps += 1
        pixels = np.full((20, 30), self.sweeps, np.uint8)
        return BScan(pixels, (0.1, 0.1), (0.0, 0.0), 1480.0, math.nan, 3.0, datetime.now(UTC))


class FieldRig:
    """Bench, table and camera."""

    def __init__(self, field: FieldBench | None = None, axes: tuple[str, ...] = AXES) -> None:
        self.table = FieldTable("table", axes)
        self.camera = FieldCamera("camera", self.table, field or FieldBench(seed=3, bend_mm=0.0))
        entries = {name: InstrumentEntry(driver="sim", address=f"sim-{name}") for name in ("table", "camera")}
        made = {"table": self.table, "camera": self.camera}
        self.bench = Bench(BenchFile(name="field", instruments=entries), lambda name, entry: made[name])
        self.events: list[tuple[str, dict[str, Any]]] = []
        self.lock = threading.Lock()

    def procedure(
        self, design: TestfieldDesign = DESIGN, sigmas: tuple[float, float, float] | None = None
    ) -> TestfieldProcedure:
        """The testfield procedure with Brown's model, for the camera of the paper."""
        model = CameraOptions("brown", ("c", "x0", "y0", "K1"), (0.027, 0.027))
        measure = measurer_of(design, TestfieldOptions(row_jitter_px=0.0086, fill=0.8))
        return TestfieldProcedure(design, measure, model, name="field", sigmas=sigmas)

    def acquisition(
        self, session: Session, procedure: TestfieldProcedure | None = None, **more: Any
    ) -> Acquisition:
        """An acquisition on this bench."""
        return Acquisition(
            self.bench,
            session,
            procedure,
            watch=lambda kind, facts: self.events.append((kind, facts)),
            **more,
        )


def enter(folder: Path, monkeypatch: pytest.MonkeyPatch, rig: FieldRig, **more: Device[Any]) -> None:
    """Work in a folder, where the drivers of bench files are the instruments of a rig and others."""
    made = {"table": rig.table, "camera": rig.camera, **more}
    monkeypatch.setattr("reseau.capture.bench.plugin", lambda group, name: lambda *args, **given: made[name])
    monkeypatch.setattr("tempfile.tempdir", str(folder))  # locks of parallel tests are apart
    monkeypatch.chdir(folder)


def write_inputs(poses: str = POSES) -> None:
    """Write what a session of the testfield needs: bench file, poses and design."""
    Path("bench.toml").write_text(BENCH)
    Path("poses.csv").write_text(poses)
    DESIGN.write("field.json")
