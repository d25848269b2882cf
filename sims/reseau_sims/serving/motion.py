"""An axis that moves: what controllers of any make have in common."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

__all__ = ["Motor"]

Clock = Callable[[], float]


@dataclass
class Motor:
    """A motor with its gear; positions in steps.

    Parameters
    ----------
    low, high : float
        Where its limit switches are.
    speed : float
        Steps per second.
    clock : callable
        Seconds.
    """

    low: float
    high: float
    speed: float
    clock: Clock = time.monotonic
    homed: bool = False
    homing: bool = False
    stalled: bool = False
    limit: int = 0
    """-1 and 1: the switch that was met."""
    enabled: bool = True
    at: float = 1234.0
    """Where it stands when it is switched on."""
    _start: float = field(default=0.0, init=False, repr=False)
    _target: float = field(default=0.0, init=False, repr=False)
    _began: float = field(default=0.0, init=False, repr=False)

    def __post_init__(self) -> None:
        self._stand(self.at)

    @property
    def position(self) -> float:
        """Where it is now."""
        way = self._target - self._start
        gone = min(abs(way), (self.clock() - self._began) * self.speed)
        now = self._start + (gone if way > 0 else -gone)
        if not self.low <= now <= self.high:
            self.limit = -1 if now < self.low else 1
            self._stand(min(max(now, self.low), self.high))
            now = self._start
        elif gone >= abs(way):
            if self.homing:
                self.homing, self.homed = False, True
            self._stand(self._target)
        return now

    @property
    def target(self) -> float:
        """Where it goes, or stands."""
        return self._target

    @property
    def moving(self) -> bool:
        """Whether it is on its way."""
        position = self.position
        return position != self._target

    def go(self, target: float) -> None:
        """Begin to move."""
        self._start, self._target, self._began = self.position, target, self.clock()
        self.limit, self.stalled = 0, False

    def home(self) -> None:
        """Begin to look for the reference, at 0."""
        self.go(0.0)
        self.homing, self.homed = True, False

    def stop(self) -> None:
        """Stand still; a search that was not finished has found nothing."""
        self._stand(self.position)
        self.homing = False

    def stall(self) -> None:
        """Something is in its way."""
        self.stop()
        self.stalled = True

    def cut_power(self) -> None:
        """It stands where it stood, and nobody knows where that is."""
        self.stop()
        self.homed, self.stalled, self.limit, self.enabled = False, False, 0, True

    def _stand(self, position: float) -> None:
        self._start = self._target = position
