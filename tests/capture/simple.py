"""Instruments without protocols: what a device needs at least, and a frame as a camera hands it out."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from reseau.core.data import Frame
from reseau.core.errors import ConnectionLost
from reseau.instruments import Deadline, Device, Identity, Settings, quantity

__all__ = ["CameraSettings", "Simple", "Taken"]


@dataclass(frozen=True)
class CameraSettings(Settings):
    """How a frame is taken."""

    exposure_us: float = quantity(1000.0, "µs", 1.0, 1e6)


@dataclass(frozen=True, eq=False)
class Taken:
    """A frame with its metadata."""

    frame: Frame
    sequence: int
    taken: datetime
    exposure_us: float
    gain: float = 0.0
    dropped: int = 0
    pattern: str = ""
    taken_within_s: float = 1e-3
    fresh: bool = True


class Simple(Device[Any]):
    """An instrument that is always connected, unless it is silent."""

    silent = False

    def _open(self, deadline: Deadline) -> None:
        if self.silent:
            raise ConnectionLost("does not answer", do="is it switched on?")

    def _disconnect(self) -> None: ...
    def _push(self, settings: Any, deadline: Deadline) -> None: ...
    def _halt(self, deadline: Deadline) -> None: ...
    def _identify(self, deadline: Deadline) -> Identity:
        return Identity("reseau", "simulated")

    def _acquire(self) -> dict[str, Any]:
        return {}

    def _reading_format(self) -> dict[str, dict[str, Any]]:
        return {}
