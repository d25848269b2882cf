"""What goes wrong on the way from a simulator to its client, and when."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from reseau.core.errors import UsageError

__all__ = ["DEVICE_KINDS", "KINDS", "LINE_KINDS", "Fault", "FaultScript", "Kind", "Output"]

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
"""Those that befall an answer on its way."""
DEVICE_KINDS: tuple[Kind, ...] = KINDS[6:]
"""Those that befall the instrument itself."""

Output = tuple[float, bytes | None]
"""Seconds to wait, and bytes to send then; None hangs up."""


@dataclass(frozen=True)
class Fault:
    """One of them.

    Parameters
    ----------
    kind : Kind
        What goes wrong.
    seconds : float
        How late a late answer is.
    """

    kind: Kind
    seconds: float = 0.3

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UsageError(f"is none of {', '.join(KINDS)}", where=f"fault {self.kind!r}")


class FaultScript:
    """Which answers suffer which fault.

    Parameters
    ----------
    faults : mapping
        By the number of the answer, counted from 0 over all connections.
    rate : float
        Share of answers, besides, that suffer one at random.
    seed : int
        Of these.
    kinds : iterable of Kind
        Of these.
    seconds : float
        How late late answers are among these.
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
        """What has happened so far."""

    @property
    def count(self) -> int:
        """How many answers there were."""
        return self._count

    def fault_at(self, number: int, fault: Fault) -> None:
        """Have a fault befall the answer of this number."""
        with self._lock:
            self._faults[number] = fault

    def at_random(self, rate: float, *, seed: int = 0, seconds: float = 0.3) -> None:
        """From now on, have this share of the answers suffer a fault at random."""
        with self._lock:
            self._rate, self._rng, self._seconds = rate, np.random.default_rng(seed), seconds

    def draw(self) -> Fault | None:
        """What befalls the answer that is due now."""
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
        """What arrives of an answer, and when; a fault of the instrument itself leaves it as it is."""
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
