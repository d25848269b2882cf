"""A bench of simulated instruments behind their real protocols, all in one laboratory."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from typing import Self

from ..laboratory import Laboratory
from ..world import World
from .machine import Machine, Wire
from .oscilloscope import Oscilloscope
from .ping360 import Ping360
from .scpi import Vxi11Session
from .script import Script
from .servers import PtyServer, TcpServer
from .zaber import ZaberChain

__all__ = ["SimulatedBench", "serve"]

_AXES = {"tilt": (1, 1), "roll": (1, 2), "camera_roll": (2, 1), "z": (3, 1)}
_PER_UNIT = 1000.0
_SCREEN = (800, 480)

_BENCH = """\
schema = "reseau-bench/1"
name = "simulated"

[instruments.table]
driver = "zaber"
address = "{table}"
settings = {{speed = 50.0}}

[instruments.table.options.axes]
tilt = {{device = 1, axis = 1, per_unit = 1000.0, low = 0.0, high = 75.0, backlash = 0.2}}
roll = {{device = 1, axis = 2, per_unit = 1000.0, low = 0.0, high = 360.0, backlash = 0.2}}
camera_roll = {{device = 2, axis = 1, per_unit = 1000.0, low = 0.0, high = 360.0, backlash = 0.2}}
z = {{device = 3, axis = 1, per_unit = 1000.0, unit = "mm", low = 0.0, high = 300.0}}

[instruments.scanner]
driver = "ping360"
address = "{scanner}"
settings = {{range_mm = 150.0}}

[instruments.oscilloscope]
driver = "oscilloscope"
address = "{oscilloscope}"
"""


class SimulatedBench:
    """Servers on pseudo-terminals and the loopback interface; see :attr:`toml`.

    Parameters
    ----------
    seed : int
        Of the world.

    Attributes
    ----------
    toml : str
        The ``bench.toml`` that leads to them.
    laboratory : Laboratory
        What they share.
    scripts : dict
        What goes wrong, by instrument; nothing at first.
    """

    def __init__(self, seed: int = 0) -> None:
        self.laboratory = laboratory = Laboratory(World.standard(seed))
        table = ZaberChain([2, 1, 1])
        for name, (device, axis) in _AXES.items():
            laboratory.attach(name, partial(_units, table, device, axis))
        scope = Oscilloscope("keysight", lambda: laboratory.picture(*_SCREEN), lambda: laboratory.echoes)
        self.machines: dict[str, Machine] = {
            "table": table,
            "scanner": Ping360(laboratory.line),
            "oscilloscope": scope,
        }
        self.scripts = {name: Script() for name in self.machines}
        self._servers = ExitStack()
        with ExitStack() as stack:
            addresses = {
                name: stack.enter_context(
                    PtyServer(partial(Wire, self.machines[name], self.scripts[name]))
                ).address
                for name in ("table", "scanner")
            }
            core = stack.enter_context(
                TcpServer(partial(Vxi11Session, scope, scope.execute, self.scripts["oscilloscope"]))
            )
            addresses["oscilloscope"] = f"TCPIP::{core.HOST},{core.port}::inst0::INSTR"
            self._servers = stack.pop_all()
        self.toml = _BENCH.format(**addresses)

    @property
    def violations(self) -> dict[str, list[str]]:
        """What clients did wrong, by instrument."""
        return {name: list(machine.violations) for name, machine in self.machines.items()}

    def close(self) -> None:
        """Hang up on all."""
        self._servers.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _units(table: ZaberChain, device: int, axis: int) -> float:
    """Where an axis stands, in degrees or millimetres."""
    return table.position(device, axis) / _PER_UNIT


def serve(seed: int = 0) -> SimulatedBench:
    """A simulated bench; found by its entry point."""
    return SimulatedBench(seed)
