"""Base of simulated instruments: state, answers, and a list of protocol violations of the client."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol

from .faults import DEVICE_KINDS, FaultScript, Kind, Output


class Machine(ABC):
    r"""Instrument behind a stream of bytes; may be called from several threads.

    Examples
    --------
    >>> from reseau_sims.serving import ZaberChain
    >>> chain = ZaberChain([1])
    >>> chain.receive(b"/01 0 00 tools echo:BF\n")
    [b'@01 0 00 OK IDLE WR 0:BE\r\n']
    >>> chain.violations
    []
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.violations: list[str] = []
        """Messages of the client that the protocol or the maker does not allow."""

    @abstractmethod
    def receive(self, data: bytes) -> Sequence[bytes]:
        """Return the answers to these bytes."""

    @property
    def due(self) -> float | None:
        """When it sends something unasked (of the monotonic clock); None if it does not."""
        return None

    def emit(self) -> Sequence[bytes]:
        """Return what is due."""
        return ()

    @abstractmethod
    def inject_fault(self, kind: Kind) -> None:
        """Apply one of :data:`DEVICE_KINDS`."""

    @abstractmethod
    def disconnected(self) -> None:
        """Discard an incomplete command: the client has disconnected."""


class Session(Protocol):
    r"""One connection to an instrument.

    Examples
    --------
    >>> from reseau_sims.serving import ZaberChain
    >>> session: Session = FaultyConnection(ZaberChain([1]))
    >>> session.receive(b"/01 0 00 tools echo:BF\n")
    [(0.0, b'@01 0 00 OK IDLE WR 0:BE\r\n')]
    """

    def receive(self, data: bytes) -> list[Output]:
        """Return the outputs in answer to these bytes."""

    def disconnected(self) -> None:
        """End the connection."""


class FaultyConnection:
    r"""Connection that injects faults into the answers.

    Parameters
    ----------
    machine : Machine
        Simulated instrument.
    script : FaultScript, optional
        Faults; none by default.

    Examples
    --------
    >>> from reseau_sims.serving import Fault, ZaberChain
    >>> connection = FaultyConnection(ZaberChain([1]), FaultScript({0: Fault("dropped")}))
    >>> connection.receive(b"/01 0 00 tools echo:BF\n")
    []
    """

    def __init__(self, machine: Machine, script: FaultScript | None = None) -> None:
        self.machine, self.script = machine, script or FaultScript()

    def receive(self, data: bytes) -> list[Output]:
        """Return the outputs in answer to these bytes."""
        with self.machine.lock:
            return self._sent(self.machine.receive(data))

    def _sent(self, answers: Sequence[bytes]) -> list[Output]:
        """The outputs for some answers, with their faults."""
        sent: list[Output] = []
        for answer in answers:
            fault = self.script.draw()
            if fault is None:
                sent.append((0.0, answer))
                continue
            if fault.kind in DEVICE_KINDS:
                self.machine.inject_fault(fault.kind)
            sent += self.script.spoil(answer, fault)
        return sent

    @property
    def due(self) -> float | None:
        """When the instrument sends something unasked."""
        return self.machine.due

    def emit(self) -> list[Output]:
        """Return what is due."""
        with self.machine.lock:
            return self._sent(self.machine.emit())

    def disconnected(self) -> None:
        """End the connection."""
        with self.machine.lock:
            self.machine.disconnected()
