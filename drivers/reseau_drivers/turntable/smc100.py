"""Newport SMC100 controllers on one line.

Source: see :mod:`reseau_drivers.codecs.smc100`. Commands are not acknowledged; so the error is asked
for after each (TE), and the state (TS) tells when a movement ends.
"""

from __future__ import annotations

from collections.abc import Mapping

from reseau.core.errors import ProtocolError, RefusedError, StateError
from reseau.instruments import AxisState, Deadline, Identity

from ..codecs.smc100 import ERRORS, LIMIT, Line, Phase, decode, decode_status, encode
from ..codecs.stream import LineDecoder
from ..link import Link, MessageLink
from .table import AxisPlan

__all__ = ["Smc100"]

_STATES = "DEHIJKLMP"
"""Errors that mean: not in this state."""


class Smc100:
    """Controllers on one line, one axis each: its address is `AxisPlan.device`.

    Parameters
    ----------
    link : Link
        To them.
    answer_s : float
        Within which a controller answers.
    """

    def __init__(self, link: Link, answer_s: float = 1.0) -> None:
        self._answer_s = answer_s
        self._link: MessageLink[bytes] = MessageLink(link, LineDecoder(limit=LIMIT))

    def open(self, deadline: Deadline) -> None:
        """Open the connection, and let go what may still come in answer to earlier questions."""
        self._link.open(deadline)
        self._synchronised = False

    def close(self) -> None:
        """Close it."""
        self._link.close()

    def identify(self, plans: Mapping[str, AxisPlan], deadline: Deadline) -> Identity:
        """What the controllers say of their version."""
        versions = [self._query(plan, "VE", deadline).strip() for plan in plans.values()]
        return Identity("Newport", "SMC100", "", ", ".join(versions))

    def set_speed(self, plan: AxisPlan, units_per_s: float, deadline: Deadline) -> None:
        """Speed of an axis; one without a reference does not take it, and gets it when it is homed."""
        # Nor while it moves; and as it moves, only the line was lost, and the speed is as it was set.
        phase = decode_status(self._query(plan, "TS", deadline)).phase
        if phase in (Phase.READY, Phase.DISABLED):
            self._send(plan, "VA", f"{units_per_s * plan.per_unit:.6g}", deadline)

    def begin_home(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Begin to look for the reference; one that is homed is so, as the controller homes only once."""
        status = decode_status(self._query(plan, "TS", deadline))
        if status.phase is Phase.DISABLED:
            self._send(plan, "MM", "1", deadline)
            status = decode_status(self._query(plan, "TS", deadline))
        if status.phase is Phase.NOT_REFERENCED:
            self._send(plan, "OR", "", deadline)

    def begin_move(self, plan: AxisPlan, position: float, deadline: Deadline) -> None:
        """Begin to move."""
        self._send(plan, "PA", f"{position * plan.per_unit:.6f}", deadline)

    def halt(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Stop; an axis that has no reference does not move."""
        if decode_status(self._query(plan, "TS", deadline)).phase is not Phase.NOT_REFERENCED:
            self._send(plan, "ST", "", deadline)

    def state(self, plan: AxisPlan, deadline: Deadline) -> AxisState:
        """How the axis stands."""
        status = decode_status(self._query(plan, "TS", deadline))
        answer = self._query(plan, "TP", deadline)
        try:
            position = float(answer) / plan.per_unit
        except ValueError:
            raise ProtocolError(f"{answer!r} is no position") from None
        phase, faults = status.phase, status.error_texts
        if phase is Phase.DISABLED:
            faults = (*faults, "the motor is disabled")
        moving = phase in (Phase.HOMING, Phase.MOVING, Phase.JOGGING)
        homed = phase in (Phase.READY, Phase.MOVING, Phase.DISABLED, Phase.JOGGING)
        return AxisState(position, moving, homed, faults)

    def _send(self, plan: AxisPlan, name: str, value: str, deadline: Deadline) -> None:
        """Send a command, and ask whether it was understood."""
        # An error of before is asked for first, so that the answer is about this command.
        self._query(plan, "TE", deadline)
        self._link.send(encode(Line(plan.device, name, value)), deadline.part(self._answer_s))
        error = self._query(plan, "TE", deadline).strip()
        if error not in ERRORS:
            raise ProtocolError(f"{error!r} is no answer to TE")
        if error != "@":
            kind = StateError if error in _STATES else RefusedError
            raise kind(f"refused it: {ERRORS[error]}", command=f"{plan.device}{name}{value}")

    def _query(self, plan: AxisPlan, name: str, deadline: Deadline) -> str:
        """Ask, and wait for the answer, which begins like the question."""
        if not self._synchronised:
            # Answers bear no number, but come in order: behind that to VE nothing old is left.
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
            raise ProtocolError(f"{line!r} is no answer to {name}")
        return answer.value
