"""GRBL controllers: all axes behind one connection.

Source: see :mod:`reseau_drivers.codecs.gcode`. GRBL and FluidNC do not tell whether they have homed: Idle is
no evidence, because the lock after a start is an option, and ``$X`` opens it. The driver therefore marks a
GRBL 1.1 that has homed, by the tool number T111, which every start and reset sets to 0 (`gc_init`), and which
has no other effect; by T112 before a search, so that a start during it is no end of it. grblHAL tells by the
field ``H`` of its status, with a bit for each axis where axes home
singly. Others count as homed only in the connection that has homed them. The driver never unlocks by ``$X``.
Positions are machine positions, which must be reported (``$10=1``) in millimetres (``$13=0``); those of GRBL
are negative as a rule, and so are the limits of its axes.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Mapping
from contextlib import suppress

from reseau.core.errors import ProtocolError, RefusedError, StateError
from reseau.instruments import Deadline, Identity

from ..codecs.gcode import Alarm, AnswerDecoder, Banner, Error, Message, Ok, Outdated, Report, Said, encode
from ..link import Link, MessageLink
from ..profiles import controller, order
from .gcode import letter_of, until
from .reference import References, Reported
from .table import AxisPlan

_BOOT_S, _BEGINS_S, _POLL_S = 4.0, 2.0, 0.01


class Grbl:
    """Controller with GRBL 1.1, or firmware that keeps to its protocol: grblHAL, FluidNC.

    `AxisPlan.axis` is 1 for X, 2 for Y and so on; `AxisPlan.per_unit` the number of GRBL's millimetres (or
    degrees) per unit.

    Parameters
    ----------
    link : Link
        Link to the controller.
    answer_s : float
        Time limit of an answer (s).
    dialect : str, optional
        File of a profile of one's own.

    Examples
    --------
    >>> from reseau_drivers.link import link_to
    >>> controller = Grbl(link_to("/dev/ttyUSB0"))
    """

    checked = False

    def __init__(self, link: Link, answer_s: float = 1.0, dialect: str | None = None) -> None:
        self._known = controller("grbl", dialect)
        self._answer_s = answer_s
        self._link: MessageLink[Message] = MessageLink(link, AnswerDecoder(self._known), self._overheard)
        # Bytes that are obeyed at once.
        self._status, self._hold, self._reset_, self._full_status = (
            order(self._known, name).encode("latin-1") for name in ("status", "hold", "reset", "full_status")
        )
        self._synchronised = self._suitable = False
        self._speed: dict[str, float] = {}
        self._alarm: Alarm | None = None
        self._acknowledged = False
        """Whether an `ok` came that no line waited for: that of a search for the reference."""
        self._searching = self._underway = self._announced = False
        self._tools: set[str] = set()
        """Words of the parser's state when it was last asked for."""
        self._version: list[str] = []
        self._told: tuple[float, ...] = ()
        """Field H of the last status that had one."""
        self._marked = False
        self.references = References()

    def open(self, deadline: Deadline) -> None:
        """Open the connection; what is left of an earlier one is discarded at the first query."""
        self._link.open(deadline)
        self._forget()

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def identify(self, plans: Mapping[str, AxisPlan], deadline: Deadline) -> Identity:
        """Return the version, which GRBL tells only at rest."""
        for plan in plans.values():
            letter_of(plan)
        self._ready(deadline)
        version = next((text for text in self._version if text.startswith("[VER:")), "[VER:]")[5:].rstrip("]")
        firmware, _, name = version.partition(":")
        return Identity("GRBL", name, "", firmware)

    def set_speed(self, plan: AxisPlan, units_per_s: float, deadline: Deadline) -> None:
        """Set the speed of the next movements of an axis; it is a part of each order."""
        self._speed[plan.name] = units_per_s

    def begin_home(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Start the search for the reference, of all axes that GRBL is configured to home."""
        self._ready(deadline)
        self._reset(deadline)
        self._alarm, self._announced = None, False
        if self._bears_marks and self._report(deadline).state == "Idle":  # one that is locked takes none
            with suppress(RefusedError):
                self._exchange(order(self._known, "search"), deadline)
                self._announced = True
        # GRBL says `ok` to $H when it has ended; a refusal comes at once, and the status shows the search.
        line, patience, self._acknowledged = order(self._known, "home"), deadline.part(_BEGINS_S), False
        asked = encode(line)
        while not patience.expired:
            found = self._link.query(asked + self._status, _report_or_refusal, deadline.part(self._answer_s))
            if isinstance(found, Error):
                raise self._refusal(found, line)
            if isinstance(found, Alarm):
                raise StateError(f"refused the search: {found.meaning}", command=line)
            homes = isinstance(found, Report) and found.state == "Home"
            self._searching = True
            if homes or isinstance(found, Ok) or self._acknowledged:
                return
            asked = b""
            time.sleep(patience.at_most(_POLL_S))
        raise StateError("does not begin to search its reference", command=line)

    def begin_move(self, plan: AxisPlan, position: float, deadline: Deadline) -> None:
        """Start a movement, in machine coordinates."""
        if not self._still_marked(deadline):
            raise StateError("has started anew", do=f"home {plan.name} again")
        self._underway = True
        feed = self._speed.get(plan.name, 1.0) * plan.per_unit * 60
        there = {"axis": letter_of(plan), "position": position * plan.per_unit}
        self._ready(deadline)
        self._exchange(order(self._known, "move", feed=feed, **there), deadline)

    def halt(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Stop all axes: a feed hold, and at rest a reset, which discards the movement, not the positions."""
        state = self._report(deadline)
        if state.state in ("Run", "Jog", "Hold"):
            self._link.send(self._hold, deadline.part(self._answer_s))
            while self._moves(state := self._report(deadline)):
                if deadline.expired:
                    raise StateError("does not stop", do="switch it off")
                time.sleep(deadline.at_most(_POLL_S))
        if state.state in ("Home", "Hold", "Door"):
            marked = self._marked
            self._reset(deadline)
            if marked and self._report(deadline).state == "Idle":
                self._mark(deadline)

    def state(self, plan: AxisPlan, deadline: Deadline) -> Reported:
        """Return what it reports of the axis."""
        self._ready(deadline)
        found = self._report(deadline)
        positions = found.fields.get("MPos", ())
        if not 1 <= plan.axis <= len(positions):
            what = f"reports {len(positions)} machine positions, not that of {letter_of(plan)}"
            raise ProtocolError(what, do="set $10=1")
        named = self._known["faults"]
        faults = [named[found.state]] if found.state in named else []
        if found.state not in (*self._known["working"], *named):
            faults.append(f"its state is {found.state}, which is not known")
        if found.state == "Hold" and not self._moves(found):
            faults.append("it is paused by a feed hold")
        if found.state == "Alarm" and self._alarm is not None:
            faults.append(self._alarm.meaning)
        if found.state == "Alarm" and self.references.judged(plan.name, None)[0]:
            self.references.void(self._alarm.meaning if self._alarm else "the controller is locked")
        if self._underway and found.state == "Idle":
            self._underway = False
            self._still_marked(deadline)
        if self._searching and found.state == "Idle":
            self._searching = False
            if self._announced:
                self._synchronise(deadline)
            if self._announced and order(self._known, "search") not in self._tools:
                self.references.void("the controller has started anew")
            else:
                self._mark(deadline)
        return Reported(
            positions[plan.axis - 1] / plan.per_unit,
            self._moves(found),
            self._tells(plan, found),
            tuple(faults),
        )

    def _tells(self, plan: AxisPlan, report: Report) -> bool | None:
        """Whether it says that an axis has its reference; None: it does not tell."""
        if report.state in ("Alarm", "Home", "Sleep"):
            return False
        if len(self._told) == 2:
            return bool(int(self._told[1]) >> (plan.axis - 1) & 1)
        if self._told:
            return self._told[0] == 1
        return True if self._marked else None

    @property
    def _bears_marks(self) -> bool:
        return re.search(self._known["marks"], " ".join(self._version)) is not None and not self._told

    def _mark(self, deadline: Deadline) -> None:
        """Mark a GRBL 1.1 that has homed; of others a reset is not known to remove the mark."""
        if self._bears_marks:
            with suppress(RefusedError):
                self._exchange(order(self._known, "mark"), deadline)
            self._synchronise(deadline)

    def _still_marked(self, deadline: Deadline) -> bool:
        """Whether it bears its mark as before: a start that was not heard leaves none."""
        if self._marked:
            self._synchronise(deadline)
            if not self._marked:
                self.references.void("the controller has started anew")
                return False
        return True

    def _ready(self, deadline: Deadline) -> None:
        """Make sure that answers belong to their lines, and that GRBL is set as the driver needs it."""
        if not self._synchronised:
            boot = deadline.part(_BOOT_S)
            until(lambda: self._synchronise(boot), lambda: boot.expired)
            self._synchronised = True
        # It reports version and settings at rest only.
        if not self._suitable and self._report(deadline).state in ("Idle", "Alarm"):
            self._version = self._exchange(order(self._known, "version"), deadline)
            told = self._exchange(order(self._known, "settings"), deadline)
            settings = dict(text.split("=", 1) for text in told if "=" in text)
            inches = settings.get("$13", "0").split()  # some add a description
            if inches[:1] != ["0"]:
                what = f"reports in millimetres: $13 is {' '.join(inches)}, not 0"
                raise StateError(what, do="send $13=0 to it")
            if any(re.search(self._known["tells"], text) for text in self._version) and not self._told:
                self._report(deadline, self._full_status)
            self._suitable = True

    def _forget(self) -> None:
        """Forget what is known of this connection, or of a controller that has started anew."""
        self._synchronised = self._suitable = self._searching = False
        self._marked, self._told = False, ()

    def _synchronise(self, deadline: Deadline) -> None:
        """Discard answers to earlier lines: none is left after the parser's state, asked for only here."""
        heard = False

        def ends(message: Message) -> bool:
            nonlocal heard
            if isinstance(message, Said) and message.text.startswith("[GC:"):
                heard, self._tools = True, set(message.text.rstrip("]").split())
                self._marked = order(self._known, "mark") in self._tools
            return (heard and isinstance(message, Ok)) or isinstance(message, Outdated)

        _require_current(
            self._link.query(b"\n" + encode(order(self._known, "modes")), ends, deadline.part(self._answer_s))
        )

    def _reset(self, deadline: Deadline) -> None:
        self._marked = False
        self._link.query(
            self._reset_, lambda message: isinstance(message, Banner), deadline.part(max(self._answer_s, 1.0))
        )

    def _report(self, deadline: Deadline, ask: bytes = b"") -> Report:
        found = self._link.query(
            ask or self._status,
            lambda message: isinstance(message, Report | Outdated),
            deadline.part(self._answer_s),
        )
        _require_current(found)
        if not isinstance(found, Report) or not all(
            math.isfinite(value) for values in found.fields.values() for value in values
        ):
            raise ProtocolError(f"sent {found}, which is no status")
        self._overheard(found)
        return found

    def _exchange(self, line: str, deadline: Deadline) -> list[str]:
        """Send a line; return what comes before its `ok`."""
        said: list[str] = []

        def ends(message: Message) -> bool:
            if isinstance(message, Said):
                said.append(message.text)
            return isinstance(message, Ok | Error | Banner | Alarm)

        found = self._link.query(encode(line), ends, deadline.part(self._answer_s))
        if isinstance(found, Banner | Alarm):
            self._overheard(found)
            what = "has started anew" if isinstance(found, Banner) else found.meaning
            raise StateError(what, command=line, do="home it again")
        if isinstance(found, Error):
            raise self._refusal(found, line)
        return said

    def _moves(self, report: Report) -> bool:
        stops = report.state in ("Hold", "Door") and report.substate in (1, 2)
        return stops or report.state in self._known["moving"]

    def _refusal(self, error: Error, line: str) -> RefusedError | StateError:
        kind = StateError if error.text in self._known["busy"] else RefusedError
        return kind(f"refused the line: {error.meaning}", command=line)

    def _overheard(self, message: Message) -> None:
        if isinstance(message, Alarm):
            self._alarm = message
            self.references.void(message.meaning)
        if isinstance(message, Banner):
            self._forget()
            self.references.void("the controller has started anew")
        if isinstance(message, Report):
            self._told = message.fields.get("H", self._told)
        self._acknowledged = self._acknowledged or isinstance(message, Ok)


def _report_or_refusal(message: Message) -> bool:
    return isinstance(message, Report | Error | Ok | Alarm)


def _require_current(message: Message) -> None:
    if isinstance(message, Outdated):
        raise StateError("speaks as GRBL up to 0.9 does", do="install GRBL 1.1 on it")
