"""The reference of an axis: how it was obtained, when, in which connection, and what has voided it since."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime


@dataclass(frozen=True)
class Reported:
    """What a controller reports of an axis.

    Parameters
    ----------
    position : float
        Position in the unit of the axis.
    moving : bool
        Whether the axis moves.
    referenced : bool or None
        Whether the controller says that the position has a reference; None: it does not tell.
    faults : tuple of str
        Reported faults.

    Examples
    --------
    >>> Reported(30.0, moving=False, referenced=None).faults
    ()
    """

    position: float
    moving: bool
    referenced: bool | None
    faults: tuple[str, ...] = ()


class References:
    """What is known of the references of the axes of one controller.

    An axis has a reference if the controller says so, or if its search has ended well in this connection; and
    nothing has happened since that voids it. What is not known is no reference.

    Examples
    --------
    >>> known = References()
    >>> known.connected()
    >>> known.judged("tilt", None)
    (False, 'it was not homed in this connection, and the controller does not tell')
    >>> known.searching("tilt")
    >>> known.found("tilt")
    >>> known.judged("tilt", None)[0]
    True
    >>> known.void("the controller has started anew")
    >>> known.judged("tilt", True)
    (False, 'the controller has started anew')
    """

    def __init__(self) -> None:
        self._connection = self._events = 0
        self._searched: dict[str, int] = {}
        self._found: dict[str, tuple[datetime, int]] = {}
        self._voided: dict[str | None, tuple[int, str]] = {}

    def connected(self) -> None:
        """Note a new connection: what only an earlier one has seen is no evidence in it."""
        self._connection += 1

    def searching(self, axis: str) -> None:
        """Note that a search for the reference begins: there is none until it has ended."""
        self._events += 1
        self._searched[axis] = self._events
        self._found.pop(axis, None)

    def found(self, axis: str) -> None:
        """Note that the search has ended as the controller's protocol says."""
        self._found[axis] = (datetime.now(UTC), self._connection)

    def void(self, why: str, axis: str | None = None) -> None:
        """Note what makes the positions of an axis, or of all, unreliable until the next search."""
        self._events += 1
        self._voided[axis] = (self._events, why)

    def judged(self, axis: str, referenced: bool | None) -> tuple[bool, str]:
        """Return whether an axis has a reference, and how that is known.

        Parameters
        ----------
        axis : str
            Name of the axis.
        referenced : bool or None
            What the controller says.
        """
        searched = self._searched.get(axis, 0)
        when, why = max(self._voided.get(axis, (0, "")), self._voided.get(None, (0, "")))
        if when > searched:
            return False, why
        if referenced is False:
            return False, "the controller reports none"
        if axis in self._found:
            at, connection = self._found[axis]
            if connection == self._connection:
                return True, f"homed at {at:%Y-%m-%d %H:%M:%S} UTC, in this connection"
            if referenced:
                return True, f"homed at {at:%Y-%m-%d %H:%M:%S} UTC, and the controller still reports it"
        elif searched:
            return False, "the search for it has not ended"
        if referenced:
            return True, "reported by the controller"
        return False, "it was not homed in this connection, and the controller does not tell"
