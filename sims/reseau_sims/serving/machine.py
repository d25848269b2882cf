"""What every simulated instrument has: a state, answers, and a list of what its client did wrong."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol

from .faults import DEVICE_KINDS, FaultScript, Kind, Output

__all__ = ["FaultyConnection", "Machine", "Session"]


class Machine(ABC):
    """An instrument behind a stream of bytes; may be called from several threads."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.violations: list[str] = []
        """What the client sent that the protocol, or the maker, forbids."""

    @abstractmethod
    def receive(self, data: bytes) -> Sequence[bytes]:
        """Answers to these bytes, one by one."""

    @abstractmethod
    def inject_fault(self, kind: Kind) -> None:
        """Have one of :data:`DEVICE_KINDS` happen."""

    @abstractmethod
    def disconnected(self) -> None:
        """The client went away: a command that was begun is forgotten."""


class Session(Protocol):
    """One connection to an instrument."""

    def receive(self, data: bytes) -> list[Output]:
        """What is sent in answer."""

    def disconnected(self) -> None:
        """The connection is over."""


class FaultyConnection:
    """A connection on which answers suffer faults.

    Parameters
    ----------
    machine : Machine
        Answers.
    script : FaultScript
        Says which answers suffer.
    """

    def __init__(self, machine: Machine, script: FaultScript | None = None) -> None:
        self.machine, self.script = machine, script or FaultScript()

    def receive(self, data: bytes) -> list[Output]:
        """What is sent in answer."""
        sent: list[Output] = []
        with self.machine.lock:
            for answer in self.machine.receive(data):
                fault = self.script.draw()
                if fault is None:
                    sent.append((0.0, answer))
                    continue
                if fault.kind in DEVICE_KINDS:
                    self.machine.inject_fault(fault.kind)
                sent += self.script.spoil(answer, fault)
        return sent

    def disconnected(self) -> None:
        """The connection is over."""
        with self.machine.lock:
            self.machine.disconnected()
