"""Motor of an axis, common to the simulated controllers of all makers."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from .faults import Kind

Clock = Callable[[], float]


@dataclass
class Motor:
    """Motor with its gear; positions in steps.

    Parameters
    ----------
    low, high : float
        Positions of the limit switches.
    speed : float
        Steps per second.
    clock : callable
        Returns the time in seconds.

    Examples
    --------
    >>> seconds = 0.0
    >>> motor = Motor(0.0, 1000.0, 100.0, lambda: seconds, at=0.0)
    >>> motor.go(500.0)
    >>> seconds = 2.0
    >>> motor.position, motor.moving
    (200.0, True)
    """

    low: float
    high: float
    speed: float
    clock: Clock = time.monotonic
    homed: bool = False
    homing: bool = False
    stalled: bool = False
    limit: int = 0
    """-1 or 1 if the lower or upper limit switch was reached."""
    enabled: bool = True
    at: float = 1234.0
    """Position after switching on."""
    _start: float = field(default=0.0, init=False, repr=False)
    _target: float = field(default=0.0, init=False, repr=False)
    _began: float = field(default=0.0, init=False, repr=False)

    def __post_init__(self) -> None:
        self._stand(self.at)

    @property
    def position(self) -> float:
        """Current position."""
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
        """Target of the movement, or the current position."""
        return self._target

    @property
    def moving(self) -> bool:
        """Whether the motor moves."""
        position = self.position
        return position != self._target

    @property
    def arrival(self) -> float | None:
        """When the movement ends, on the motor's clock; None if there is none."""
        if not self.moving:
            return None
        return self._began + abs(self._target - self._start) / self.speed

    def go(self, target: float) -> None:
        """Start a movement."""
        self._start, self._target, self._began = self.position, target, self.clock()
        self.limit, self.stalled = 0, False

    def home(self) -> None:
        """Start the search for the reference at 0."""
        self.go(0.0)
        self.homing, self.homed = True, False

    def stop(self) -> None:
        """Stop; an unfinished search for the reference is cancelled."""
        self._stand(self.position)
        self.homing = False

    def cut_power(self) -> None:
        """Stop and lose the reference."""
        self.stop()
        self.homed, self.stalled, self.limit, self.enabled = False, False, 0, True

    def inject_fault(self, kind: Kind) -> None:
        """Stuck: an obstacle; wrong state: the driver is off; out of range: a limit switch was reached."""
        if kind == "stuck":
            self.stop()
            self.stalled = True
        elif kind == "wrong state":
            self.stop()
            self.enabled = False
        elif kind == "out of range":
            self.stop()
            self.limit = 1
        elif kind == "power-cycled":
            self.cut_power()

    def _stand(self, position: float) -> None:
        self._start = self._target = position
