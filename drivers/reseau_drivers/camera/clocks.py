"""Clocks of frames: from the clock that stamped them to UTC, and how well that is known.

All times are whole nanoseconds of the monotonic clock of this machine, until they are handed out.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

__all__ = ["BlockCounter", "ExposureTimes", "FrameCounter", "TimeInterval", "realtime_offset", "utc"]

_TRIES = 5
_SHORT, _SHORT_WITH_ZERO, _LONG = 65535, 65536, 1 << 64
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True)
class TimeInterval:
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


def utc(span: TimeInterval) -> tuple[datetime, float]:
    """The middle of a span in UTC, and how far from it the truth may be (s)."""
    offset, doubt = realtime_offset()
    middle = (span.earliest + span.latest) // 2 + offset
    half = (span.latest - span.earliest) / 2 + doubt + 1000  # datetime counts microseconds
    return _EPOCH + timedelta(microseconds=middle // 1000), half * 1e-9


class FrameCounter:
    """Frame numbers that begin anew after their highest one, and what is missing between them.

    Parameters
    ----------
    period : int
        After how many the numbers begin anew; may be changed once that is known better.

    Examples
    --------
    >>> numbers = FrameCounter(65536)
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


class BlockCounter(FrameCounter):
    """Frame numbers of GenICam: GigE Vision 1 counts 1…65535, some cameras 0…65535, all others in 64 bits.

    Examples
    --------
    >>> numbers = BlockCounter()
    >>> [numbers.next(n) for n in (65535, 0, 1)], numbers.lost
    ([65535, 65536, 65537], 0)
    """

    def __init__(self) -> None:
        super().__init__(_SHORT)

    def next(self, number: int) -> int | None:
        """As of :class:`FrameCounter`; how many there are shows by itself."""
        if number > _SHORT:
            self.period = _LONG
        elif number == 0 and self.period == _SHORT:
            self.period = _SHORT_WITH_ZERO
        return super().next(number)


class ExposureTimes:
    """When exposures began, of frames that a camera stamps by a clock of its own.

    Attributes
    ----------
    offset : (int, int) or None
        What is added to the camera's clock to have ours, and its uncertainty; None where it cannot be read.
    triggered : int or None
        When the frame that is waited for was triggered, all others having been let go.

    Examples
    --------
    >>> stamps = ExposureTimes()
    >>> stamps.restart(period=10)
    >>> stamps.began(1000, 5000, before=3, exposure=3), stamps.began(1100, 5140, before=3, exposure=3)
    (TimeInterval(earliest=4987, latest=4997), TimeInterval(earliest=5087, latest=5137))
    >>> stamps.offset = 4000, 2
    >>> stamps.began(1200, 5240, before=3, exposure=3)
    TimeInterval(earliest=5195, latest=5199)
    """

    def __init__(self) -> None:
        self.offset: tuple[int, int] | None = None
        self.triggered: int | None = None
        self._period = 0
        self._least_delay: int | None = None

    def restart(self, period: int) -> None:
        """The camera was started anew; its frames follow one another after this period."""
        self._period, self._least_delay, self.triggered = period, None, None

    def began(self, stamped: int, arrived: int, before: int, exposure: int) -> TimeInterval:
        """When an exposure began.

        Parameters
        ----------
        stamped, arrived : int
            By the camera's clock, and when its first packet came, by ours.
        before : int
            How long before its stamp it began.
        exposure : int
            How long it accepted.
        """
        if self.offset is not None:
            begun, doubt = stamped + self.offset[0] - before, self.offset[1]
            span = TimeInterval(begun - doubt, begun + doubt)
        else:
            # A frame that came later after its stamp than another did has waited for as long somewhere.
            delay = arrived - stamped
            self._least_delay = delay if self._least_delay is None else min(delay, self._least_delay)
            waited = delay - self._least_delay
            span = TimeInterval(arrived - waited - exposure - self._period, arrived - exposure)
        if self.triggered is None:
            return span
        # Everything of before was let go, so this one was exposed at the trigger, or after it.
        return TimeInterval(max(span.earliest, self.triggered), max(span.latest, arrived, self.triggered))

    def describe(self) -> str:
        """How the camera's clock stands to UTC."""
        real = realtime_offset()[0]
        if self.offset is not None:
            return f"offset {(self.offset[0] + real) / 1e9:.6f} ± {self.offset[1] / 1e9:.6f} s"
        if self._least_delay is None:
            return "offset unknown: no way to read its clock, and no frame yet"
        return f"offset at most {(self._least_delay + real) / 1e9:+.6f} s, by the arrival of frames"
