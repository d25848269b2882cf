"""Marlin controllers, of printers and of tables built from their parts.

Source: see :mod:`reseau_drivers.codecs.gcode`. Lines carry numbers and checksums. The position is that of the
step counters (``Count`` of M114, steps per unit of M92): what M114 reports before it is where the controller
wants to go, and an axis stands where both agree. Marlin does not tell which axes have homed. The driver
therefore marks them by the feed rate (M220), which is 100 % after every start: 1 % more for X, 2 % for Y,
4 % for Z and so on; it takes this into account in the speed. M410 stops without deceleration, after which
steppers are expected to be out of position (G-code reference): what it stopped has no reference.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from reseau.core.errors import DeadlineError, InstrumentError, ProtocolError, RefusedError, StateError
from reseau.instruments import Deadline, Identity

from ..codecs.gcode import (
    AXES,
    AnswerDecoder,
    Banner,
    Busy,
    Error,
    Message,
    Ok,
    Resend,
    Said,
    encode,
    encode_numbered,
)
from ..codecs.numbers import number
from ..link import Link, MessageLink
from ..profiles import controller, order
from .gcode import letter_of, until
from .reference import References, Reported
from .table import AxisPlan

_FRESH = 100
"""Feed rate (%) of a controller that has just started."""
_BOOT_S, _SILENT_S, _STANDS_S, _POLL_S = 6.0, 4.0, 1.0, 0.01
_RESENDS = 3
_ROUNDED = 0.006
"""M114 reports positions with two decimals."""
_PAIR = re.compile(r"([A-Z]):\s*(-?\d+(?:\.\d+)?)(?=\s|$)")


@dataclass
class _Homing:
    """A search for the reference that has not been acknowledged."""

    letter: str
    heard: float


class Marlin:
    """Controller with Marlin 2, Cartesian: each motor moves one axis.

    `AxisPlan.axis` is 1 for X, 2 for Y and so on; `AxisPlan.per_unit` the number of Marlin's millimetres (or
    degrees) per unit.

    Parameters
    ----------
    link : Link
        Link to the controller.
    answer_s : float
        Time limit of an answer (s); while Marlin says that it is busy, the time begins anew.
    dialect : str, optional
        File of a profile of one's own.

    Examples
    --------
    >>> from reseau_drivers.link import link_to
    >>> controller = Marlin(link_to("/dev/ttyACM0", baud=250000))
    """

    checked = False

    def __init__(self, link: Link, answer_s: float = 1.0, dialect: str | None = None) -> None:
        self._known = controller("marlin", dialect)
        self._answer_s = answer_s
        self._link: MessageLink[Message] = MessageLink(link, AnswerDecoder(self._known), self._overheard)
        self._number = 0
        self._synchronised = False
        self._steps: dict[str, float] = {}
        self._speed: dict[str, float] = {}
        self._homing: _Homing | None = None
        self._counts: dict[str, tuple[float, float]] = {}
        self._endstop = ""
        self._underway: set[str] = set()
        self._percent = _FRESH
        self.references = References()

    def open(self, deadline: Deadline) -> None:
        """Open the connection; what is left of an earlier one is discarded at the first query."""
        self._link.open(deadline)
        self._synchronised, self._homing = False, None

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def identify(self, plans: Mapping[str, AxisPlan], deadline: Deadline) -> Identity:
        """Return the names of firmware and machine."""
        for plan in plans.values():
            letter_of(plan)
        said = " ".join(self._line(deadline, "identity"))
        firmware = self._found("firmware", said)
        machine = self._found("machine", said)
        return Identity("Marlin", machine[1] if machine else "", "", firmware[1] if firmware else "")

    def set_speed(self, plan: AxisPlan, units_per_s: float, deadline: Deadline) -> None:
        """Set the speed of the next movements of an axis; it is a part of each order."""
        self._speed[plan.name] = units_per_s

    def begin_home(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Start the search for the reference of an axis; motors stay on from then on."""
        self._line(deadline, "hold")
        letter = letter_of(plan)
        self._mark(self._marks(deadline) & ~_bit(letter), deadline)
        self._endstop = ""
        # Its `ok` comes when it has ended.
        self._ready(deadline)
        self._number += 1
        self._link.send(
            encode_numbered(order(self._known, "home", axis=letter), self._number),
            deadline.part(self._answer_s),
        )
        self._homing = _Homing(letter, time.monotonic())

    def begin_move(self, plan: AxisPlan, position: float, deadline: Deadline) -> None:
        """Start a movement."""
        letter, feed = letter_of(plan), self._speed.get(plan.name, 1.0) * plan.per_unit * 60
        self._endstop = ""
        self._counts.pop(letter, None)
        for name in ("units", "absolute"):
            self._line(deadline, name)
        feed *= _FRESH / max(1, self._percent)
        self._underway.add(letter)
        said = self._line(deadline, "move", axis=letter, position=position * plan.per_unit, feed=feed)
        if any(self._found("unhomed", text) for text in said):
            raise StateError("is not homed", do=f"home {plan.name} first")

    def halt(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Stop all axes at once.

        During a search for the reference only a controller with its emergency parser obeys.
        """
        if self._homing is not None:
            self._homing, self._synchronised = None, False
            self._link.send(encode(order(self._known, "stop")), deadline.part(self._answer_s))
        else:
            self._line(deadline, "stop")
        if self._underway:
            self._underway.clear()
            self.references.void("it was stopped without deceleration, where steps are lost")
            self._mark(0, deadline)
        while self._state(plan, deadline).moving:
            if deadline.expired:
                raise StateError("does not stop", do="switch it off")
            time.sleep(deadline.at_most(_POLL_S))

    def state(self, plan: AxisPlan, deadline: Deadline) -> Reported:
        """Return the state of the axis."""
        if self._homing is not None and not self._homed(self._homing, deadline):
            return Reported(float("nan"), moving=True, referenced=False)
        return self._state(plan, deadline)

    def _state(self, plan: AxisPlan, deadline: Deadline) -> Reported:
        letter = letter_of(plan)
        target, count = self._positions(letter, deadline)
        position = count / self._steps[letter]
        moving = abs(position - target) > _ROUNDED + 1.5 / self._steps[letter]
        faults = (f"an endstop was reached: {self._endstop}",) if self._endstop else ()
        if moving:
            now = time.monotonic()
            before, since = self._counts.get(letter, (count, now))
            self._counts[letter] = (count, since if before == count else now)
            if now - self._counts[letter][1] > _STANDS_S:
                stands = f"{letter} stands at {position:g}, not at {target:g}"
                faults, moving = (*faults, stands), False
        else:
            self._counts.pop(letter, None)
        marks = self._marks(deadline)
        if faults:
            self.references.void(faults[0], plan.name)
            if marks & _bit(letter):
                self._mark(marks := marks & ~_bit(letter), deadline)
        if not moving:
            self._underway.discard(letter)
        return Reported(position / plan.per_unit, moving, bool(marks & _bit(letter)), faults)

    def _homed(self, homing: _Homing, deadline: Deadline) -> bool:
        """Whether the search for the reference has ended; its end is marked."""
        try:
            found = self._link.receive(
                lambda message: isinstance(message, Ok | Error | Busy | Banner), deadline.part(0.05)
            )
        except DeadlineError:
            if time.monotonic() - homing.heard > _SILENT_S:
                self._homing = None
                raise
            return False
        homing.heard = time.monotonic()
        if isinstance(found, Busy):
            return False
        self._homing = None
        if isinstance(found, Ok):
            self._mark(self._marks(deadline) | _bit(homing.letter), deadline)
            return True
        self._synchronised = False
        what = found.meaning if isinstance(found, Error) else "has started anew"
        raise StateError(what, command=order(self._known, "home", axis=homing.letter))

    def _mark(self, axes: int, deadline: Deadline) -> None:
        """Mark which axes have homed."""
        self._line(deadline, "mark", percent=_FRESH + axes)

    def _marks(self, deadline: Deadline) -> int:
        """Which axes have homed, a bit for each; none where the feed rate is no such mark."""
        said = self._line(deadline, "rate")
        found = next((each for each in map(re.compile(r"FR:\s*(\d+)%").search, said) if each), None)
        if found is None:
            raise ProtocolError(f"does not tell its feed rate: {said}")
        self._percent = int(found[1])
        axes = self._percent - _FRESH
        return axes if 0 < axes < 1 << len(AXES) else 0

    def _positions(self, letter: str, deadline: Deadline) -> tuple[float, float]:
        """Where an axis is to be (mm), and its step counter."""
        for text in self._line(deadline, "position"):
            wanted, count, counted = text.partition(" Count ")
            if count:
                there, steps = dict(_PAIR.findall(wanted)), dict(_PAIR.findall(counted))
                if letter in there and letter in steps and letter in self._steps:
                    return number(there[letter]), number(steps[letter])
        raise ProtocolError(f"does not tell position and steps of {letter}", do="is it Cartesian Marlin?")

    def _ready(self, deadline: Deadline) -> None:
        """Make sure that answers belong to their lines, and learn the steps per unit."""
        if self._synchronised:
            return
        boot = deadline.part(_BOOT_S)
        until(lambda: self._synchronise(boot), lambda: boot.expired)
        self._synchronised = True
        try:
            # Without a checksum one answer is not believed.
            first = self._steps_per_unit(deadline)
            if self._steps_per_unit(deadline) != first:
                raise ProtocolError("gives contradictory steps per unit", do="check cable and shielding")
        except InstrumentError:
            self._synchronised = False
            raise
        self._steps = first

    def _synchronise(self, deadline: Deadline) -> None:
        """Begin to count lines, and discard answers to earlier ones: none is left after that to M115."""
        self._number = 1
        heard = False

        def ends(message: Message) -> bool:
            nonlocal heard
            heard = heard or (isinstance(message, Said) and "FIRMWARE_NAME" in message.text)
            return heard and isinstance(message, Ok)

        asked = (order(self._known, "first"), order(self._known, "identity"))
        lines = b"\n" + b"".join(encode_numbered(line, k) for k, line in enumerate(asked))
        self._link.query(lines, ends, deadline.part(self._answer_s))

    def _steps_per_unit(self, deadline: Deadline) -> dict[str, float]:
        for text in self._exchange(line := order(self._known, "steps"), deadline):
            if found := dict(re.findall(r"([XYZABC])(\d+(?:\.\d+)?)(?=\s|$)", text.partition(line)[2])):
                return {letter: number(steps) for letter, steps in found.items() if number(steps) > 0}
        raise ProtocolError(f"does not tell its steps per unit ({line})")

    def _line(self, deadline: Deadline, command: str, **values: object) -> list[str]:
        self._ready(deadline)
        return self._exchange(order(self._known, command, **values), deadline)

    def _exchange(self, line: str, deadline: Deadline) -> list[str]:
        """Send a line, again if Marlin wants it again; return what comes before its `ok`."""
        self._number += 1
        for _ in range(_RESENDS):
            heard = self._answer(encode_numbered(line, self._number), deadline)
            again = [each.number for each in heard if isinstance(each, Resend)]
            if again and again[-1] != self._number:
                self._synchronised = False
                raise ProtocolError(f"wants line {again[-1]}, not {self._number}", command=line)
            if again:
                continue
            for each in heard:
                if isinstance(each, Error):
                    raise RefusedError(f"refused the line: {each.meaning}", command=line)
            said = [each.text for each in heard if isinstance(each, Said)]
            if any(self._found("unknown", text) for text in said):
                raise RefusedError("does not know the command", command=line)
            return said
        raise ProtocolError(f"wanted the line {_RESENDS} times", command=line, do="check cable and baud rate")

    def _answer(self, data: bytes, deadline: Deadline) -> list[Message]:
        """Send a line and collect its answer, however long Marlin says that it is busy."""
        heard: list[Message] = []

        def ends(message: Message) -> bool:
            heard.append(message)
            return isinstance(message, Ok | Busy | Banner)

        ask: Callable[[], Message] = lambda: self._link.query(data, ends, deadline.part(self._answer_s))  # noqa: E731
        while isinstance(found := ask(), Busy):
            ask = lambda: self._link.receive(ends, deadline.part(max(self._answer_s, _SILENT_S)))  # noqa: E731
        if isinstance(found, Banner):
            self._overheard(found)
            self._synchronised = False
            raise StateError("has started anew", do="home it again")
        return heard

    def _overheard(self, message: Message) -> None:
        if isinstance(message, Banner):
            self.references.void("the controller has started anew")
        if isinstance(message, Said) and (found := self._found("endstops", message.text)):
            self._endstop = found[1].strip()

    def _found(self, reply: str, text: str) -> re.Match[str] | None:
        """Whether a text is a reply of the profile."""
        return re.search(self._known["replies"][reply], text)


def _bit(letter: str) -> int:
    """The mark of an axis."""
    return 1 << AXES.index(letter)
