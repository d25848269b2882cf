"""One time limit for a whole call, whatever the number of exchanges it takes."""

from __future__ import annotations

import math
import time
from typing import Self

from ..core.errors import UsageError


class _Remaining(float):
    """What is left of a time limit (s), which messages name as a whole."""

    whole: float

    def __new__(cls, seconds: float, whole: float) -> Self:
        found = super().__new__(cls, seconds)
        found.whole = whole
        return found


class Deadline:
    """Time limit of a call.

    Parameters
    ----------
    seconds : float
        Time from now (s). Of what another deadline has left, messages name the whole: that is what the caller
        has set; it may be 0.

    Raises
    ------
    UsageError
        If the time is not positive and finite.

    Examples
    --------
    >>> deadline = Deadline(10.0)
    >>> deadline.expired, deadline.at_most(0.5)
    (False, 0.5)
    >>> Deadline(deadline.left).seconds
    10.0
    """

    def __init__(self, seconds: float) -> None:
        if not (0 < seconds < math.inf or isinstance(seconds, _Remaining)):
            raise UsageError(
                f"{seconds} s is not a valid time limit: give a positive, finite time", where="deadline"
            )
        self.seconds = getattr(seconds, "whole", seconds)
        """The time limit that messages name (s)."""
        self._at = time.monotonic() + seconds

    @property
    def left(self) -> float:
        """Remaining time (s); 0 after the deadline. A further call within it names the whole."""
        return _Remaining(max(0.0, self._at - time.monotonic()), self.seconds)

    @property
    def expired(self) -> bool:
        """Whether the deadline has passed."""
        return self.left == 0.0

    def at_most(self, seconds: float) -> float:
        """Return the given time (s), or the remaining time if that is shorter."""
        return min(seconds, self.left)

    def part(self, seconds: float) -> Deadline:
        """Return a deadline for a part of the call; it is never later than this one."""
        return Deadline(self.at_most(seconds))
