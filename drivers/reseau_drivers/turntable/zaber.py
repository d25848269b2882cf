"""Zaber devices on one chain, in their ASCII protocol.

Source: *Zaber ASCII Protocol Manual*, "Commands" (home, move, stop, warnings, get, set) and "Warning Flags".
"""

from __future__ import annotations

from collections.abc import Mapping

from reseau.core.errors import ProtocolError, RefusedError, StateError
from reseau.instruments import AxisState, Deadline, Identity

from ..codecs.zaber import FAULTS, Command, Message, MessageDecoder, Reply, encode
from ..link import Link, MessageLink
from .table import AxisPlan

__all__ = ["Zaber"]

_SPEED = 1.6384
"""The setting maxspeed is in steps per second times this."""
_UNREFERENCED = ("WR", "WH")


class Zaber:
    """A chain of devices.

    Parameters
    ----------
    link : Link
        To the first of them.
    answer_s : float
        Within which a device answers.
    """

    def __init__(self, link: Link, answer_s: float = 1.0) -> None:
        self._answer_s = answer_s
        self._link: MessageLink[Message] = MessageLink(link, MessageDecoder())
        self._id = 0

    def open(self, deadline: Deadline) -> None:
        """Open the connection."""
        self._link.open(deadline)

    def close(self) -> None:
        """Close it."""
        self._link.close()

    def identify(self, plans: Mapping[str, AxisPlan], deadline: Deadline) -> Identity:
        """Device numbers, serial numbers and firmware of all that are needed."""
        found = []
        for device in sorted({plan.device for plan in plans.values()}):
            said = [self._query(device, 0, f"get {what}", deadline).data for what in _IDENTITY]
            found.append(said)
        models, serials, versions = (", ".join(column) for column in zip(*found, strict=True))
        return Identity("Zaber", models, serials, versions)

    def set_speed(self, plan: AxisPlan, units_per_s: float, deadline: Deadline) -> None:
        """Speed of an axis."""
        speed = max(1, round(units_per_s * plan.per_unit * _SPEED))
        self._query(plan.device, plan.axis, f"set maxspeed {speed}", deadline)

    def begin_home(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Begin to look for the reference."""
        self._query(plan.device, plan.axis, "warnings clear", deadline)
        self._query(plan.device, plan.axis, "home", deadline)

    def begin_move(self, plan: AxisPlan, position: float, deadline: Deadline) -> None:
        """Begin to move."""
        # Warnings stay until they are cleared: what is seen afterwards is of this movement.
        self._query(plan.device, plan.axis, "warnings clear", deadline)
        self._query(plan.device, plan.axis, f"move abs {round(position * plan.per_unit)}", deadline)

    def halt(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Stop."""
        self._query(plan.device, plan.axis, "stop", deadline)

    def state(self, plan: AxisPlan, deadline: Deadline) -> AxisState:
        """How the axis stands."""
        reply = self._query(plan.device, plan.axis, "warnings", deadline)
        count, *flags = reply.data.split()
        if not count.isdigit() or int(count) != len(flags):
            raise ProtocolError(f"{reply.data!r} is no list of warnings")
        # Whether it stands is asked first: a position read before could be one on the way.
        position = self._query(plan.device, plan.axis, "get pos", deadline).data
        try:
            steps = float(position)
        except ValueError:
            raise ProtocolError(f"{position!r} is no position") from None
        faults = tuple(FAULTS[flag] for flag in flags if flag in FAULTS)
        homed = not any(flag in _UNREFERENCED for flag in flags)
        return AxisState(steps / plan.per_unit, reply.busy, homed, faults)

    def _query(self, device: int, axis: int, words: str, deadline: Deadline) -> Reply:
        """Send a command and wait for its reply, which bears its number."""
        self._id = (self._id + 1) % 100
        sent = Command(device, axis, words, self._id)

        def answers(message: Message) -> bool:
            return (
                isinstance(message, Reply)
                and message.id == sent.id
                and (message.device, message.axis) == (device, axis)
            )

        reply = self._link.query(encode(sent), answers, deadline.part(self._answer_s))
        if not isinstance(reply, Reply):
            raise ProtocolError("sent no reply")
        if not reply.ok:
            command = f"device {device} axis {axis}: {words}"
            if reply.data in ("STATUSBUSY", "PARKED", "DRIVERDISABLED"):
                raise StateError(f"rejected it: {reply.data}", command=command)
            raise RefusedError(f"rejected it: {reply.data}", command=command)
        return reply


_IDENTITY = ("device.id", "system.serial", "version")
