"""A camera with a clock of its own, for `service.py`: whoever asks too late misses a frame."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from tests.capture.simple import CameraSettings, Simple, Taken

from reseau.core.data import Frame
from reseau.core.errors import ConnectionLost

PERIOD_S = 0.5
_ENTRIES = "[reseau.instruments]\nclocked = benchmarks.clocked:ClockedCamera\n"


class ClockedCamera(Simple):
    """Takes a frame each half second of the machine's clock, numbered from its beginning."""

    def __init__(self, name: str, address: str, settings: Any = None, limits: Any = None) -> None:
        super().__init__(name, CameraSettings(**(settings or {})), limits=limits)
        draw = np.random.default_rng(1)
        self._pixels = draw.integers(40, 200, (480, 640), dtype=np.uint8)
        self._last = 0

    def expose(self, seconds: float | None = None) -> Taken:
        """Wait for the next frame."""
        number = max(int(time.time() / PERIOD_S), self._last) + 1
        while (left := number * PERIOD_S - time.time()) > 0:
            if self._stopping.wait(left):
                raise ConnectionLost("was stopped", where=self.name)
        self._last = number
        pixels = np.roll(self._pixels, number, axis=1)
        at = datetime.fromtimestamp(number * PERIOD_S, UTC)
        return Taken(Frame(pixels, 255.0), number, at, self.settings.exposure_us)

    def frames(self, count: int, seconds: float | None = None) -> Iterator[Taken]:
        """Yield frames as they come."""
        return (self.expose(seconds) for _ in range(count))


def install(folder: Path) -> None:
    """Make the driver known to processes that have the folder in PYTHONPATH."""
    info = folder / "clocked-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: clocked\nVersion: 1\n")
    (info / "entry_points.txt").write_text(_ENTRIES)
