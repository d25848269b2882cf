"""Faults of simulated instruments and of their connections, and when they occur."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from reseau.core.errors import UsageError

Kind = Literal[
    "late",
    "dropped",
    "truncated",
    "repeated",
    "corrupted",
    "disconnected",
    "stuck",
    "wrong state",
    "out of range",
    "power-cycled",
]
KINDS: tuple[Kind, ...] = get_args(Kind)
LINE_KINDS: tuple[Kind, ...] = KINDS[:6]
"""Faults of the transmission of an answer."""
DEVICE_KINDS: tuple[Kind, ...] = KINDS[6:]
"""Faults of the instrument itself."""

Output = tuple[float, bytes | None]
"""Delay in seconds, and bytes to send after it; None closes the connection."""


@dataclass(frozen=True)
class Fault:
    """One fault.

    Parameters
    ----------
    kind : Kind
        Kind of the fault.
    seconds : float
        Delay of a late answer (s).

    Raises
    ------
    UsageError
        If the kind is unknown.

    Examples
    --------
    >>> Fault("late", 0.1)
    Fault(kind='late', seconds=0.1)
    """

    kind: Kind
    seconds: float = 0.3

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UsageError(f"is not one of {', '.join(KINDS)}", where=f"fault {self.kind!r}")


class FaultScript:
    """Assignment of faults to answers.

    Parameters
    ----------
    faults : mapping
        Faults by the number of the answer, counted from 0 over all connections.
    rate : float
        Fraction of answers with an additional random fault.
    seed : int
        Seed of the random faults.
    kinds : iterable of Kind
        Kinds of the random faults.
    seconds : float
        Delay of late answers among them (s).

    Examples
    --------
    >>> script = FaultScript({1: Fault("dropped")})
    >>> script.draw(), script.draw().kind, script.count
    (None, 'dropped', 2)
    >>> FaultScript.spoil(b"answer", Fault("truncated"))
    [(0.0, b'ans')]
    """

    def __init__(
        self,
        faults: dict[int, Fault] | None = None,
        *,
        rate: float = 0.0,
        seed: int = 0,
        kinds: Iterable[Kind] = KINDS,
        seconds: float = 0.3,
    ) -> None:
        self._faults, self._rate, self._kinds = dict(faults or {}), rate, tuple(kinds)
        self._rng, self._seconds = np.random.default_rng(seed), seconds
        self._lock = threading.Lock()
        self._count = 0
        self.happened: list[Fault] = []
        """Faults that have occurred so far."""

    @property
    def count(self) -> int:
        """Number of answers so far."""
        return self._count

    def fault_at(self, number: int, fault: Fault) -> None:
        """Assign a fault to the answer with this number."""
        with self._lock:
            self._faults[number] = fault

    def at_random(self, rate: float, *, seed: int = 0, seconds: float = 0.3) -> None:
        """Inject random faults into this fraction of the following answers."""
        with self._lock:
            self._rate, self._rng, self._seconds = rate, np.random.default_rng(seed), seconds

    def draw(self) -> Fault | None:
        """Return the fault of the next answer, or None."""
        with self._lock:
            fault = self._faults.pop(self._count, None)
            self._count += 1
            if fault is None and self._rate and self._rng.random() < self._rate:
                fault = Fault(self._kinds[self._rng.integers(len(self._kinds))], self._seconds)
            if fault is not None:
                self.happened.append(fault)
            return fault

    @staticmethod
    def spoil(answer: bytes, fault: Fault) -> list[Output]:
        """Return the outputs for an answer with a fault; faults of the instrument itself do not change it."""
        middle = len(answer) // 2
        spoiled: dict[Kind, list[Output]] = {
            "late": [(fault.seconds, answer)],
            "dropped": [],
            "truncated": [(0.0, answer[:middle])],
            "repeated": [(0.0, answer), (0.0, answer)],
            "corrupted": [(0.0, answer[:middle] + bytes([answer[middle] ^ 0x08]) + answer[middle + 1 :])],
            "disconnected": [(0.0, answer[:middle]), (0.0, None)],
        }
        return spoiled.get(fault.kind, [(0.0, answer)])
