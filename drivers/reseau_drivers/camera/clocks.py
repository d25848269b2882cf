"""Clocks of frames: from the clock that stamped them to UTC, and how well that is known.

All times are whole nanoseconds of the monotonic clock of this machine, until they are handed out.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

__all__ = ["Span", "Wrapping", "realtime_offset", "utc"]

_TRIES = 5
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True)
class Span:
    """When an exposure began, as far as it is known: between these (ns)."""

    earliest: int
    latest: int


def realtime_offset() -> tuple[int, int]:
    """What is added to the monotonic clock to have UTC, and half the time in which both were read (ns)."""
    best = (0, 1 << 62)
    for _ in range(_TRIES):
        before, real, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after - before < best[1]:
            best = real - (before + after) // 2, after - before
    return best[0], (best[1] + 1) // 2


def utc(span: Span) -> tuple[datetime, float]:
    """The middle of a span in UTC, and how far from it the truth may be (s)."""
    offset, doubt = realtime_offset()
    middle = (span.earliest + span.latest) // 2 + offset
    half = (span.latest - span.earliest) / 2 + doubt + 1000  # datetime counts microseconds
    return _EPOCH + timedelta(microseconds=middle // 1000), half * 1e-9


class Wrapping:
    """Frame numbers that begin anew after their highest one, and what is missing between them.

    Parameters
    ----------
    period : int
        After how many the numbers begin anew; may be changed once that is known better.

    Examples
    --------
    >>> numbers = Wrapping(65536)
    >>> [numbers.next(n) for n in (65534, 65535, 1)], numbers.lost
    ([65534, 65535, 65537], 1)
    >>> numbers.next(1), numbers.next(65535)
    (None, None)
    """

    def __init__(self, period: int) -> None:
        self.period = period
        self._number, self._counted = -1, -1
        self.lost = 0
        """Numbers that were left out."""

    def restart(self) -> None:
        """Numbers begin at any one; none is missing before it."""
        self._number = -1

    def next(self, number: int) -> int | None:
        """The number counted on without wrapping; None when it is not a newer one."""
        if self._number < 0:
            self._number = number
            self._counted = max(number, self._counted + 1)
            return self._counted
        step = (number - self._number) % self.period
        if step == 0 or step > self.period // 2:
            return None
        self.lost += step - 1
        self._number = number
        self._counted += step
        return self._counted
