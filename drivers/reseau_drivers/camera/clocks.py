"""Start of exposures in UTC, from the time stamps of frames, with their uncertainty.

All times are integer nanoseconds of the computer's monotonic clock until they are returned to the caller.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

_TRIES = 5
_SHORT, _SHORT_WITH_ZERO, _LONG = 65535, 65536, 1 << 64
_DRIFT = 10_000
"""A quartz clock drifts by less than one part in so many."""
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True)
class TimeInterval:
    """Interval that contains the start of an exposure (ns)."""

    earliest: int
    latest: int

    @property
    def middle(self) -> int:
        """The most probable start."""
        return (self.earliest + self.latest) // 2


def realtime_offset() -> tuple[int, int]:
    """Return the offset from the monotonic clock to UTC and its uncertainty (ns).

    The uncertainty is half of the time that reading both clocks took.
    """
    best = (0, 1 << 62)
    for _ in range(_TRIES):
        before, real, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        if after - before < best[1]:
            best = real - (before + after) // 2, after - before
    return best[0], (best[1] + 1) // 2


def utc(span: TimeInterval) -> tuple[datetime, float]:
    """Return the middle of an interval in UTC, and half of its width (s)."""
    offset, doubt = realtime_offset()
    middle = span.middle + offset
    half = (span.latest - span.earliest) / 2 + doubt + 1000  # datetime counts microseconds
    return _EPOCH + timedelta(microseconds=middle // 1000), half * 1e-9


class FrameCounter:
    """Count frames whose numbers wrap around, and the numbers that are missing.

    Parameters
    ----------
    period : int
        Period of the frame numbers; it may be changed when it becomes known.

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
        """Number of missing frames."""

    def restart(self) -> None:
        """Accept any number next; no frame counts as missing before it."""
        self._number = -1

    def next(self, number: int) -> int | None:
        """Return the number without wrapping; None if the frame is not newer than the last."""
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
    """Count GenICam frames: numbers 1…65535 (GigE Vision 1), 0…65535 (some cameras), or 64 bits (all others).

    Examples
    --------
    >>> numbers = BlockCounter()
    >>> [numbers.next(n) for n in (65535, 0, 1)], numbers.lost
    ([65535, 65536, 65537], 0)
    """

    def __init__(self) -> None:
        super().__init__(_SHORT)

    def next(self, number: int) -> int | None:
        """As :meth:`FrameCounter.next`; the period is inferred from the numbers."""
        if number > _SHORT:
            self.period = _LONG
        elif number == 0 and self.period == _SHORT:
            self.period = _SHORT_WITH_ZERO
        return super().next(number)


class ExposureTimes:
    """Start of exposures of frames that the camera stamps with its own clock.

    Attributes
    ----------
    offset : (int, int) or None
        Offset from the camera's clock to the computer's, and its uncertainty (ns); None if the camera's clock
        cannot be read.
    read_at : int
        When the camera's clock was read (ns); since then it may have drifted from the computer's.
    triggered : int or None
        Time of the software trigger of the expected frame; all earlier frames were discarded.

    Examples
    --------
    >>> times = ExposureTimes()
    >>> times.restart(period=10)
    >>> times.began(1000, 5000, before=3, exposure=3), times.began(1100, 5140, before=3, exposure=3)
    (TimeInterval(earliest=4987, latest=4997), TimeInterval(earliest=5087, latest=5137))
    >>> times.offset, times.read_at = (4000, 2), 5000
    >>> times.began(1200, 5240, before=3, exposure=3)
    TimeInterval(earliest=5194, latest=5200)
    """

    def __init__(self) -> None:
        self.offset: tuple[int, int] | None = None
        self.read_at = 0
        self.triggered: int | None = None
        self._period, self._last = 0, 0
        self._least_delay: int | None = None

    def restart(self, period: int) -> None:
        """Start a new acquisition with the given frame period (ns)."""
        self._period, self._last, self._least_delay, self.triggered = period, 0, None, None

    def began(self, stamped: int, arrived: int, before: int, exposure: int) -> TimeInterval:
        """Return the interval that contains the start of the exposure.

        Parameters
        ----------
        stamped, arrived : int
            Time stamp of the camera, and arrival of the first packet by the computer's clock (ns).
        before : int
            Time from the start of the exposure to the stamp (ns).
        exposure : int
            Exposure time (ns).
        """
        if stamped < self._last:  # the camera's clock began anew: what was known of it is void
            self.offset = self._least_delay = None
        self._last = stamped
        if self.offset is not None:
            start, doubt = stamped + self.offset[0] - before, self.offset[1]
            doubt += max(0, arrived - self.read_at) // _DRIFT + 1
            span = TimeInterval(start - doubt, start + doubt)
        else:
            # The longest possible wait of a frame is its delay beyond the shortest delay of all frames.
            delay = arrived - stamped
            self._least_delay = delay if self._least_delay is None else min(delay, self._least_delay)
            waited = delay - self._least_delay
            span = TimeInterval(arrived - waited - exposure - self._period, arrived - exposure)
        if self.triggered is None:
            return span
        # All earlier frames were discarded: this one was exposed between the trigger and its arrival.
        earliest, latest = max(span.earliest, self.triggered), min(span.latest, arrived)
        if self.offset is None or earliest > latest:  # the stamp does not say more, or is wrong
            return TimeInterval(max(span.earliest, self.triggered), max(span.latest, arrived, self.triggered))
        return TimeInterval(earliest, latest)

    def describe(self) -> str:
        """Describe the offset of the camera's clock to UTC."""
        real = realtime_offset()[0]
        if self.offset is not None:
            return f"offset {(self.offset[0] + real) / 1e9:.6f} ± {self.offset[1] / 1e9:.6f} s"
        if self._least_delay is None:
            return "offset unknown: the clock cannot be read, and no frame has arrived yet"
        return f"offset at most {(self._least_delay + real) / 1e9:+.6f} s, from the arrival of frames"
