"""A driver in one module: a dimmable lamp that takes lines of text, ``LEVEL 40`` and ``LEVEL?``.

Entry point: ``[project.entry-points."reseau.instruments"] lamp = "instrument:lamp"``. On a bench::

    [instruments.lamp]
    driver = "lamp"
    address = "tcp://192.0.2.7:4000"    # or a serial device, "/dev/ttyUSB0@9600"
    settings = {level = 40.0}
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from reseau.core.errors import ProtocolError, RefusedError
from reseau.instruments import Deadline, Device, Identity, Limits, Settings, quantity
from reseau_drivers.codecs.stream import LineDecoder
from reseau_drivers.link import Link, MessageLink, link_to


@dataclass(frozen=True)
class LampSettings(Settings):
    """What the lamp can be set to."""

    level: float = quantity(0.0, "%", 0.0, 100.0)


class Lamp(Device[LampSettings]):
    """The lamp. `Device` brings locks, time limits, reconnection, settings with limits, and bluesky."""

    def __init__(self, name: str, link: Link, settings: LampSettings, **options: Any) -> None:
        super().__init__(name, settings, **options)
        self._link: MessageLink[bytes] = MessageLink(link, LineDecoder(limit=80))

    def _open(self, deadline: Deadline) -> None:
        self._link.open(deadline)

    def _disconnect(self) -> None:
        self._link.close()

    def _push(self, settings: LampSettings, deadline: Deadline) -> None:
        self._ask(f"LEVEL {settings.level:.1f}", deadline)

    def _identify(self, deadline: Deadline) -> Identity:
        return Identity("Example", self._ask("IDN?", deadline))

    def _halt(self, deadline: Deadline) -> None:
        """A lamp does not move; nothing has to be stopped."""

    def _acquire(self) -> dict[str, Any]:
        answer = self._ask("LEVEL?", Deadline(2.0))
        try:
            return {"level": float(answer)}
        except ValueError:
            raise ProtocolError(f"answered {answer!r}, not a level", where=self.name) from None

    def _reading_format(self) -> dict[str, dict[str, Any]]:
        return {"level": {"dtype": "number", "shape": [], "units": "%"}}

    def _ask(self, line: str, deadline: Deadline) -> str:
        answer = self._link.query(line.encode("ascii") + b"\n", lambda message: True, deadline)
        text = answer.decode("ascii", "replace")
        if text.startswith("ERR"):
            raise RefusedError(text, where=self.name, command=line)
        return text


def lamp(
    name: str,
    address: str | Link,
    *,
    settings: Mapping[str, Any] | None = None,
    limits: Limits | None = None,
    **options: Any,
) -> Lamp:
    """Create the driver from an entry of ``bench.toml``."""
    start = LampSettings().changed(settings or {}, limits)
    return Lamp(name, link_to(address, baud=9600), start, limits=limits, **options)
