"""GRBL controllers: all axes behind one connection.

Source: see :mod:`reseau_drivers.codecs.gcode`. After power-on GRBL is locked until it has homed, provided
that homing is enabled (``$22=1``): the driver insists on that, because the lock is how it knows that
positions have a reference. It never unlocks by ``$X``. Positions are machine positions, which must be
reported (``$10=1``) in millimetres (``$13=0``); those of GRBL are negative as a rule, and so are the limits
of its axes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping

from reseau.core.errors import ProtocolError, RefusedError, StateError
from reseau.instruments import AxisState, Deadline, Identity

from ..codecs.gcode import Alarm, Banner, Error, Message, Ok, Report, Said, encode
from ..link import Link
from .gcode import Lines, letter_of, until
from .table import AxisPlan

__all__ = ["Grbl"]

_STATUS, _HOLD, _RESET = b"?", b"!", b"\x18"
_MOVING = ("Run", "Jog", "Home")
_STATES = ("8", "9", "13")
"""Errors that mean: not allowed in this state."""
_FAULTS = {"Door": "the safety door is open", "Check": "check mode ($C): nothing moves", "Sleep": "it sleeps"}
_BOOT_S, _BEGINS_S, _POLL_S = 4.0, 2.0, 0.01
_REQUIRED = {"$22": ("1", "homing"), "$13": ("0", "reports in millimetres")}


class Grbl:
    """Controller with GRBL 1.1, or firmware that keeps to its protocol.

    `AxisPlan.axis` is 1 for X, 2 for Y and so on; `AxisPlan.per_unit` the number of GRBL's millimetres (or
    degrees) per unit.

    Parameters
    ----------
    link : Link
        Link to the controller.
    answer_s : float
        Time limit of an answer (s).

    Examples
    --------
    >>> from reseau_drivers.link import link_to
    >>> controller = Grbl(link_to("/dev/ttyUSB0"))
    """

    checked = False

    def __init__(self, link: Link, answer_s: float = 1.0) -> None:
        self._answer_s = answer_s
        self._link = Lines(link, self._overheard)
        self._synchronised = self._suitable = False
        self._speed: dict[str, float] = {}
        self._alarm: Alarm | None = None
        self._acknowledged = False
        """Whether an `ok` came that no line waited for: that of a search for the reference."""

    def open(self, deadline: Deadline) -> None:
        """Open the connection; what is left of an earlier one is discarded at the first query."""
        self._link.open(deadline)
        self._synchronised = self._suitable = False

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def identify(self, plans: Mapping[str, AxisPlan], deadline: Deadline) -> Identity:
        """Return the version, which GRBL tells only at rest."""
        for plan in plans.values():
            letter_of(plan)
        self._ready(deadline)
        try:
            said = self._exchange("$I", deadline)
        except StateError:
            return Identity("GRBL", "")
        version = next((text for text in said if text.startswith("[VER:")), "[VER:]")[5:].rstrip("]")
        firmware, _, name = version.partition(":")
        return Identity("GRBL", name, "", firmware)

    def set_speed(self, plan: AxisPlan, units_per_s: float, deadline: Deadline) -> None:
        """Set the speed of the next movements of an axis; it is a part of each order."""
        self._speed[plan.name] = units_per_s

    def begin_home(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Start the search for the reference, of all axes that GRBL is configured to home."""
        self._ready(deadline)
        self._reset(deadline)
        self._alarm = None
        # GRBL says `ok` to $H when it has ended; a refusal comes at once, and the status shows the search.
        order, patience, self._acknowledged = encode("$H"), deadline.part(_BEGINS_S), False
        while not patience.expired:
            found = self._link.query(order + _STATUS, _report_or_refusal, deadline.part(self._answer_s))
            if isinstance(found, Error):
                raise _refusal(found, "$H")
            homes = isinstance(found, Report) and found.state == "Home"
            if homes or isinstance(found, Ok) or self._acknowledged:
                return
            order = b""
            time.sleep(patience.at_most(_POLL_S))
        raise StateError("does not begin to search its reference", command="$H")

    def begin_move(self, plan: AxisPlan, position: float, deadline: Deadline) -> None:
        """Start a movement, in machine coordinates."""
        target = f"{letter_of(plan)}{position * plan.per_unit:.4f}"
        feed = self._speed.get(plan.name, 1.0) * plan.per_unit * 60
        self._line(f"G21 G90 G53 G1 {target} F{feed:.3f}", deadline)

    def halt(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Stop all axes: a feed hold, and at rest a reset, which discards the movement, not the positions."""
        state = self._report(deadline)
        if state.state in ("Run", "Jog", "Hold"):
            self._link.send(_HOLD, deadline.part(self._answer_s))
            while _moves(state := self._report(deadline)):
                if deadline.expired:
                    raise StateError("does not stop", do="switch it off")
                time.sleep(deadline.at_most(_POLL_S))
        if state.state in ("Home", "Hold", "Door"):
            self._reset(deadline)

    def state(self, plan: AxisPlan, deadline: Deadline) -> AxisState:
        """Return the state of the axis."""
        self._ready(deadline)
        found = self._report(deadline)
        positions = found.fields.get("MPos", ())
        if not 1 <= plan.axis <= len(positions):
            what = f"reports {len(positions)} machine positions, not that of {letter_of(plan)}"
            raise ProtocolError(what, do="set $10=1")
        faults = [_FAULTS[found.state]] if found.state in _FAULTS else []
        if found.state == "Hold" and not _moves(found):
            faults.append("it is paused by a feed hold")
        if found.state == "Alarm" and self._alarm is not None:
            faults.append(self._alarm.meaning)
        homed = found.state not in ("Alarm", "Home", "Sleep")
        return AxisState(positions[plan.axis - 1] / plan.per_unit, _moves(found), homed, tuple(faults))

    def _ready(self, deadline: Deadline) -> None:
        """Make sure that answers belong to their lines, and that GRBL is set as the driver needs it."""
        if not self._synchronised:
            boot = deadline.part(_BOOT_S)
            until(lambda: self._synchronise(boot), lambda: boot.expired)
            self._synchronised = True
        # It reports its settings at rest only; while it moves it has its reference.
        if not self._suitable and self._report(deadline).state in ("Idle", "Alarm"):
            said = self._exchange("$$", deadline)
            settings = dict(text.split("=", 1) for text in said if text.startswith("$") and "=" in text)
            for name, (value, what) in _REQUIRED.items():
                if settings.get(name) != value:
                    found = settings.get(name, "not reported")
                    raise StateError(
                        f"{what}: {name} is {found}, not {value}", do=f"send {name}={value} to it"
                    )
            self._suitable = True

    def _synchronise(self, deadline: Deadline) -> None:
        """Discard answers to earlier lines: none is left after the parser's state, asked for only here."""
        heard = False

        def ends(message: Message) -> bool:
            nonlocal heard
            heard = heard or (isinstance(message, Said) and message.text.startswith("[GC:"))
            return heard and isinstance(message, Ok)

        self._link.query(b"\n" + encode("$G"), ends, deadline.part(self._answer_s))

    def _reset(self, deadline: Deadline) -> None:
        self._link.query(
            _RESET, lambda message: isinstance(message, Banner), deadline.part(max(self._answer_s, 1.0))
        )

    def _report(self, deadline: Deadline) -> Report:
        found = self._link.query(
            _STATUS, lambda message: isinstance(message, Report), deadline.part(self._answer_s)
        )
        if not isinstance(found, Report) or not all(
            math.isfinite(value) for values in found.fields.values() for value in values
        ):
            raise ProtocolError(f"sent {found}, which is no status")
        return found

    def _line(self, line: str, deadline: Deadline) -> list[str]:
        self._ready(deadline)
        return self._exchange(line, deadline)

    def _exchange(self, line: str, deadline: Deadline) -> list[str]:
        """Send a line; return what comes before its `ok`."""
        said: list[str] = []

        def ends(message: Message) -> bool:
            if isinstance(message, Said):
                said.append(message.text)
            return isinstance(message, Ok | Error | Banner)

        found = self._link.query(encode(line), ends, deadline.part(self._answer_s))
        if isinstance(found, Banner):
            raise StateError("has started anew", command=line, do="home it again")
        if isinstance(found, Error):
            raise _refusal(found, line)
        return said

    def _overheard(self, message: Message) -> None:
        if isinstance(message, Alarm):
            self._alarm = message
        self._acknowledged = self._acknowledged or isinstance(message, Ok)


def _report_or_refusal(message: Message) -> bool:
    return isinstance(message, Report | Error | Ok)


def _moves(report: Report) -> bool:
    return report.state in _MOVING or (report.state in ("Hold", "Door") and report.substate in (1, 2))


def _refusal(error: Error, line: str) -> RefusedError | StateError:
    kind = StateError if error.text in _STATES else RefusedError
    return kind(f"refused the line: {error.meaning}", command=line)
