"""What simulated controllers of G-code have in common: axes, queued movements, lines that wait for homing.

Movements are carried out one after the other, with constant speed.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import deque
from collections.abc import Sequence

from .machine import Machine
from .motion import Clock, Motor

_BEYOND_MM = 50.0
"""Distance of the switches from the soft limits."""


class GcodeController(Machine):
    """Base of the controllers; positions in millimetres, of any number of axes.

    Parameters
    ----------
    axes : int
        Number of axes.
    low, high : float
        Travel of all axes within the soft limits (mm).
    speed : float
        Largest speed (mm/s).
    at : float
        Position of all axes at the beginning (mm).
    clock : callable
        Returns the time in seconds.

    Examples
    --------
    >>> from reseau_sims.serving import MarlinController
    >>> board = MarlinController(2)
    >>> sorted(board.motors), board.position(2)
    ([1, 2], 0.0)
    """

    def __init__(self, axes: int, low: float, high: float, speed: float, at: float, clock: Clock) -> None:
        super().__init__()
        self._clock, self._largest, self._limits = clock, speed, (low, high)
        self._motors = [Motor(low - _BEYOND_MM, high + _BEYOND_MM, speed, clock, at=at) for _ in range(axes)]
        self._forget()

    def _forget(self) -> None:
        """Discard movements, lines and reports that are to come."""
        self._queue: deque[tuple[list[float], float]] = deque()
        self._waiting: list[bytes] = []
        self._unasked: list[bytes] = []

    @property
    def motors(self) -> dict[int, Motor]:
        """Motors by the number of the axis, from 1."""
        return dict(enumerate(self._motors, 1))

    def position(self, axis: int = 1) -> float:
        """Return the current position of an axis (mm), independent of queries."""
        with self.lock:
            self._advance()
            return self._motors[axis - 1].position

    def emit(self) -> Sequence[bytes]:
        """Return what is due."""
        self._advance()
        reports, self._unasked = self._unasked, []
        return reports

    @abstractmethod
    def _advance(self) -> None:
        """Begin what is queued, and end what has ended."""

    @abstractmethod
    def _take(self, line: bytes) -> list[bytes]:
        """Carry out a line; while it homes, lines wait."""

    def _report_homed(self, answer: bytes) -> None:
        """Answer the line that asked for homing, and carry out those that have waited for its end."""
        self._unasked.append(answer)
        waiting, self._waiting = self._waiting, []
        for line in waiting:
            self._unasked += self._take(line)

    def _begin_queued(self) -> None:
        """Begin the next movement where none is under way: all axes arrive at once."""
        while self._queue and not any(motor.moving for motor in self._motors):
            targets, speed = self._queue.popleft()
            ways = [abs(t - motor.position) for t, motor in zip(targets, self._motors, strict=True)]
            seconds = math.hypot(*ways) / speed
            for motor, target, way in zip(self._motors, targets, ways, strict=True):
                if way:
                    motor.speed = way / seconds
                    motor.go(target)

    def _stand(self) -> None:
        for motor in self._motors:
            motor.stop()

    def _cut_power(self) -> None:
        for motor in self._motors:
            motor.cut_power()
