"""Newport SMC100 controllers on one serial line.

Source: see :mod:`reseau_drivers.codecs.smc100`. Commands are not acknowledged: after each, the error is
queried (TE); the state (TS) shows the end of a movement.
"""

from __future__ import annotations

from collections.abc import Mapping

from reseau.core.errors import ProtocolError, RefusedError, StateError
from reseau.instruments import Deadline, Identity

from ..codecs.numbers import number
from ..codecs.smc100 import LIMIT, Line, decode, decode_status, encode
from ..codecs.stream import LineDecoder
from ..link import Link, MessageLink
from ..profiles import controller, order, told_bits
from .reference import References, Reported
from .table import AxisPlan


class Smc100:
    """Controllers on one line with one axis each; `AxisPlan.device` is the address of the controller.

    Parameters
    ----------
    link : Link
        Link to the controllers.
    answer_s : float
        Time limit of an answer (s).
    dialect : str, optional
        File of a profile of one's own.

    Examples
    --------
    >>> from reseau_drivers.link import link_to
    >>> controller = Smc100(link_to("/dev/ttyUSB0", baud=57600, xonxoff=True))
    """

    checked = False

    def __init__(self, link: Link, answer_s: float = 1.0, dialect: str | None = None) -> None:
        self._known = controller("smc100", dialect)
        self._answer_s = answer_s
        self._link: MessageLink[bytes] = MessageLink(link, LineDecoder(limit=LIMIT))
        self.references = References()

    def open(self, deadline: Deadline) -> None:
        """Open the connection; pending answers are discarded at the first query."""
        self._link.open(deadline)
        self._synchronised = False

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def identify(self, plans: Mapping[str, AxisPlan], deadline: Deadline) -> Identity:
        """Return the versions that the controllers report."""
        versions = [self._query(plan, "version", deadline).strip() for plan in plans.values()]
        return Identity("Newport", "SMC100", "", ", ".join(versions))

    def set_speed(self, plan: AxisPlan, units_per_s: float, deadline: Deadline) -> None:
        """Set the speed of an axis; without a reference it is set after homing."""
        # The controller does not accept a speed during a movement. If the axis moves, only the connection was
        # lost, and the speed is unchanged.
        if self._status(plan, deadline)[1] in ("ready", "disabled"):
            self._send(plan, deadline, "speed", speed=units_per_s * plan.per_unit)

    def begin_home(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Start the search for the reference; a homed axis stays as it is: the controller homes only once."""
        if self._status(plan, deadline)[1] == "disabled":
            self._send(plan, deadline, "enable")
        if self._status(plan, deadline)[1] == "not referenced":
            self._send(plan, deadline, "home")

    def begin_move(self, plan: AxisPlan, position: float, deadline: Deadline) -> None:
        """Start a movement."""
        self._send(plan, deadline, "move", position=position * plan.per_unit)

    def halt(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Stop the axis; one without a reference does not move."""
        if self._status(plan, deadline)[1] != "not referenced":
            self._send(plan, deadline, "stop")

    def state(self, plan: AxisPlan, deadline: Deadline) -> Reported:
        """Return what it reports of the axis."""
        errors, state = self._status(plan, deadline)
        position = number(self._query(plan, "position", deadline)) / plan.per_unit
        faults = told_bits(self._known, errors) + (("the motor is disabled",) if state == "disabled" else ())
        moving = state in ("homing", "moving", "jogging")
        return Reported(position, moving, state in ("ready", "moving", "disabled", "jogging"), faults)

    def _status(self, plan: AxisPlan, deadline: Deadline) -> tuple[int, str]:
        return decode_status(self._query(plan, "state", deadline), self._known)

    def _send(self, plan: AxisPlan, deadline: Deadline, command: str, **values: object) -> None:
        """Send a command and query whether it was accepted."""
        # Query and clear an earlier error first, so that the answer concerns this command.
        self._query(plan, "error", deadline)
        text = order(self._known, command, **values)
        self._link.send(encode(Line(plan.device, text[:2], text[2:])), deadline.part(self._answer_s))
        error = self._query(plan, "error", deadline).strip()
        if error not in self._known["errors"]:
            raise ProtocolError(f"{error!r} is not a valid answer to TE")
        if error != "@":
            kind = StateError if error in self._known["busy"] else RefusedError
            what = f"refused the command: {self._known['errors'][error]}"
            raise kind(what, command=f"{plan.device}{text}")

    def _query(self, plan: AxisPlan, command: str, deadline: Deadline) -> str:
        """Send a query and wait for the answer, which repeats its address and name."""
        if not self._synchronised:
            # Answers have no number but arrive in order: after the answer to VE no old one is left.
            self._exchange(plan, order(self._known, "version"), deadline)
            self._synchronised = True
        return self._exchange(plan, order(self._known, command), deadline)

    def _exchange(self, plan: AxisPlan, name: str, deadline: Deadline) -> str:
        head = f"{plan.device}{name}".encode()
        line = self._link.query(
            encode(Line(plan.device, name)), lambda line: line.startswith(head), deadline.part(self._answer_s)
        )
        answer = decode(line)
        if (answer.address, answer.name) != (plan.device, name):
            raise ProtocolError(f"{line!r} is not an answer to {name}")
        return answer.value
