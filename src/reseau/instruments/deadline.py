"""One time for a whole call, however many exchanges it takes."""

from __future__ import annotations

import math
import time

from ..core.errors import UsageError

__all__ = ["Deadline"]


class Deadline:
    """A moment by which a call has to be done.

    Parameters
    ----------
    seconds : float
        From now.

    Raises
    ------
    UsageError
        When the time is not positive and finite.

    Examples
    --------
    >>> deadline = Deadline(10.0)
    >>> deadline.over, deadline.at_most(0.5)
    (False, 0.5)
    """

    def __init__(self, seconds: float) -> None:
        if not 0 < seconds < math.inf:
            raise UsageError(f"{seconds} s is no time that one can wait", where="deadline")
        self.seconds = seconds
        self._at = time.monotonic() + seconds

    @property
    def left(self) -> float:
        """Seconds that are left, 0 when it is over."""
        return max(0.0, self._at - time.monotonic())

    @property
    def over(self) -> bool:
        """Whether it has passed."""
        return self.left == 0.0

    def at_most(self, seconds: float) -> float:
        """These seconds, or what is left when that is less."""
        return min(seconds, self.left)

    @property
    def rest(self) -> float:
        """What is left, as the deadline of a next call: never nothing, which no call takes."""
        return max(1e-3, self.left)

    def part(self, seconds: float) -> Deadline:
        """An earlier deadline for a part of the call; never later than this one."""
        return Deadline(max(1e-3, self.at_most(seconds)))
