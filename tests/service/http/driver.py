"""A camera before a testfield on the table of its bench, as a driver that a worker process finds."""

from __future__ import annotations

import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from reseau.core.data import Frame
from reseau.instruments import Instrument, Turntable
from reseau_sims import FieldBench, Station

from ... import kept
from ...capture.fieldrig import AXES
from ...capture.simple import CameraSettings, Simple, Taken

_INFO = {
    "METADATA": "Metadata-Version: 2.1\nName: fieldcamera\nVersion: 1\n",
    "entry_points.txt": "[reseau.instruments]\nfieldcamera = tests.service.http.driver:FieldCamera\n",
}


DEFECT_US, CRASH_US = 4321.0, 4322.0
"""Exposures at which the driver has a defect, and at which it ends its process."""


class FieldCamera(Simple):
    """Its frames follow the axes of the instrument `table`."""

    def __init__(self, name: str, address: str, settings: Any = None, limits: Any = None) -> None:
        super().__init__(name, CameraSettings(**(settings or {})), limits=limits)
        self._field = FieldBench(seed=3, bend_mm=0.0)
        self._table: Turntable | None = None
        self._number = 0

    def combine(self, instruments: Mapping[str, Instrument]) -> None:
        found = instruments["table"]
        assert isinstance(found, Turntable)
        self._table = found

    def expose(self, seconds: float | None = None) -> Taken:
        assert self._table is not None
        if self.settings.exposure_us == DEFECT_US:
            raise ZeroDivisionError("a defect of the driver")
        if self.settings.exposure_us == CRASH_US:
            os.abort()
        self._number += 1
        at = [self._table.state(axis).position for axis in AXES]
        frame = kept.once(FieldBench.record, self._field, Station(*at))
        pixels = (frame.pixels * min(1.0, self.settings.exposure_us / 1000.0)).astype(frame.pixels.dtype)
        return Taken(Frame(pixels, 255.0), self._number, datetime.now(UTC), self.settings.exposure_us)

    def frames(self, count: int, seconds: float | None = None) -> Any:
        return (self.expose(seconds) for _ in range(count))


def install(folder: Path) -> None:
    """Make the driver known to processes that have the folder in PYTHONPATH."""
    info = folder / "fieldcamera-1.dist-info"
    info.mkdir(parents=True)
    for name, text in _INFO.items():
        (info / name).write_text(text)


def bench_of(toml: str) -> str:
    """The table of a simulated bench with this camera."""
    table = toml[: toml.index("[instruments.scanner]")]
    camera = '[instruments.camera]\ndriver = "fieldcamera"\naddress = "field"\n'
    camera += "limits = {exposure_us = [10.0, 5000.0]}\n"
    return (
        table.replace('name = "simulated"', 'name = "cellar"').replace("speed = 50.0", "speed = 50.0")
        + camera
    )
