"""Newport SMC100 controllers on one serial line.

Source: see :mod:`reseau_drivers.codecs.smc100`. Commands are not acknowledged: after each, the error is
queried (TE); the state (TS) shows the end of a movement.
"""

from __future__ import annotations

from collections.abc import Mapping

from reseau.core.errors import ProtocolError, RefusedError, StateError
from reseau.instruments import Deadline, Identity

from ..codecs.numbers import number
from ..codecs.smc100 import LIMIT, Line, Phase, decode, decode_status, encode
from ..codecs.stream import LineDecoder
from ..link import Link, MessageLink
from ..profiles import controller, told_bits
from .reference import References, Reported
from .table import AxisPlan

__all__ = ["Smc100"]

_STATES = "DEHIJKLMP"
"""Errors that mean: not allowed in this state."""


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
        versions = [self._query(plan, "VE", deadline).strip() for plan in plans.values()]
        return Identity("Newport", "SMC100", "", ", ".join(versions))

    def set_speed(self, plan: AxisPlan, units_per_s: float, deadline: Deadline) -> None:
        """Set the speed of an axis; without a reference it is set after homing."""
        # The controller does not accept a speed during a movement. If the axis moves, only the connection was
        # lost, and the speed is unchanged.
        phase = decode_status(self._query(plan, "TS", deadline)).phase
        if phase in (Phase.READY, Phase.DISABLED):
            self._send(plan, "VA", f"{units_per_s * plan.per_unit:.6g}", deadline)

    def begin_home(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Start the search for the reference; a homed axis stays as it is: the controller homes only once."""
        status = decode_status(self._query(plan, "TS", deadline))
        if status.phase is Phase.DISABLED:
            self._send(plan, "MM", "1", deadline)
            status = decode_status(self._query(plan, "TS", deadline))
        if status.phase is Phase.NOT_REFERENCED:
            self._send(plan, "OR", "", deadline)

    def begin_move(self, plan: AxisPlan, position: float, deadline: Deadline) -> None:
        """Start a movement."""
        self._send(plan, "PA", f"{position * plan.per_unit:.6f}", deadline)

    def halt(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Stop the axis; one without a reference does not move."""
        if decode_status(self._query(plan, "TS", deadline)).phase is not Phase.NOT_REFERENCED:
            self._send(plan, "ST", "", deadline)

    def state(self, plan: AxisPlan, deadline: Deadline) -> Reported:
        """Return what it reports of the axis."""
        status = decode_status(self._query(plan, "TS", deadline))
        position = number(self._query(plan, "TP", deadline)) / plan.per_unit
        phase = status.phase
        faults = told_bits(self._known, status.errors)
        if phase is Phase.DISABLED:
            faults = (*faults, "the motor is disabled")
        moving = phase in (Phase.HOMING, Phase.MOVING, Phase.JOGGING)
        homed = phase in (Phase.READY, Phase.MOVING, Phase.DISABLED, Phase.JOGGING)
        return Reported(position, moving, homed, faults)

    def _send(self, plan: AxisPlan, name: str, value: str, deadline: Deadline) -> None:
        """Send a command and query whether it was accepted."""
        # Query and clear an earlier error first, so that the answer concerns this command.
        self._query(plan, "TE", deadline)
        self._link.send(encode(Line(plan.device, name, value)), deadline.part(self._answer_s))
        error = self._query(plan, "TE", deadline).strip()
        if error not in self._known["errors"]:
            raise ProtocolError(f"{error!r} is not a valid answer to TE")
        if error != "@":
            kind = StateError if error in _STATES else RefusedError
            raise kind(
                f"refused the command: {self._known['errors'][error]}", command=f"{plan.device}{name}{value}"
            )

    def _query(self, plan: AxisPlan, name: str, deadline: Deadline) -> str:
        """Send a query and wait for the answer, which repeats its address and name."""
        if not self._synchronised:
            # Answers have no number but arrive in order: after the answer to VE no old one is left.
            self._exchange(plan, "VE", deadline)
            self._synchronised = True
        return self._exchange(plan, name, deadline)

    def _exchange(self, plan: AxisPlan, name: str, deadline: Deadline) -> str:
        head = f"{plan.device}{name}".encode()
        line = self._link.query(
            encode(Line(plan.device, name)), lambda line: line.startswith(head), deadline.part(self._answer_s)
        )
        answer = decode(line)
        if (answer.address, answer.name) != (plan.device, name):
            raise ProtocolError(f"{line!r} is not an answer to {name}")
        return answer.value
