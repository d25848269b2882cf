"""Zaber devices on one chain, with their ASCII protocol.

Source: *Zaber ASCII Protocol Manual*, "Commands" (home, move, stop, warnings, get, set) and "Warning Flags".
"""

from __future__ import annotations

from collections.abc import Mapping

from reseau.core.errors import ProtocolError, RefusedError, StateError
from reseau.instruments import Deadline, Identity

from ..codecs.numbers import number
from ..codecs.zaber import Command, Message, MessageDecoder, Reply, encode
from ..link import Link, MessageLink
from ..profiles import controller, order
from .reference import References, Reported
from .table import AxisPlan


class Zaber:
    """Chain of Zaber devices.

    Parameters
    ----------
    link : Link
        Link to the first device.
    answer_s : float
        Time limit of an answer (s).
    dialect : str, optional
        File of a profile of one's own.

    Examples
    --------
    >>> from reseau_drivers.link import link_to
    >>> controller = Zaber(link_to("tcp://192.0.2.8:55550"))
    """

    checked = True

    def __init__(self, link: Link, answer_s: float = 1.0, dialect: str | None = None) -> None:
        self._known = controller("zaber", dialect)
        self._answer_s = answer_s
        self._link: MessageLink[Message] = MessageLink(link, MessageDecoder())
        self._id = 0
        self.references = References()

    def open(self, deadline: Deadline) -> None:
        """Open the connection."""
        self._link.open(deadline)

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def identify(self, plans: Mapping[str, AxisPlan], deadline: Deadline) -> Identity:
        """Return device numbers, serial numbers and firmware of all devices in use."""
        found = []
        for device in sorted({plan.device for plan in plans.values()}):
            said = [self._query(device, 0, what, deadline).data for what in self._known["identity"]]
            found.append(said)
        models, serials, versions = (", ".join(column) for column in zip(*found, strict=True))
        return Identity("Zaber", models, serials, versions)

    def set_speed(self, plan: AxisPlan, units_per_s: float, deadline: Deadline) -> None:
        """Set the speed of an axis."""
        speed = max(1, round(units_per_s * plan.per_unit * self._known["factors"]["speed"]))
        self._ask(plan, deadline, "speed", speed=speed)

    def begin_home(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Start the search for the reference."""
        self._ask(plan, deadline, "clear")
        self._ask(plan, deadline, "home")

    def begin_move(self, plan: AxisPlan, position: float, deadline: Deadline) -> None:
        """Start a movement."""
        # Clear old warnings, so that later ones concern this movement.
        self._ask(plan, deadline, "clear")
        self._ask(plan, deadline, "move", position=round(position * plan.per_unit))

    def halt(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Stop the axis."""
        self._ask(plan, deadline, "stop")

    def state(self, plan: AxisPlan, deadline: Deadline) -> Reported:
        """Return what it reports of the axis; unknown flags of the kinds F and W count as faults."""
        reply = self._ask(plan, deadline, "warnings")
        count, *flags = reply.data.split()
        if not count.isdigit() or int(count) != len(flags):
            raise ProtocolError(f"{reply.data!r} is not a list of warnings")
        # Query the movement first: a position read before it could be an intermediate one.
        position = self._ask(plan, deadline, "position").data
        known, unreferenced = self._known["flags"], self._known["unreferenced"]
        found = {
            flag: known.get(flag, f"it reports {flag}, which is not known")
            for flag in flags
            if flag[0] in "FW" and flag not in unreferenced
        }
        for flag, what in found.items():
            if flag in self._known["unreliable"] or flag not in known:
                self.references.void(what, plan.name)
        referenced = not any(flag in unreferenced for flag in flags)
        return Reported(number(position) / plan.per_unit, reply.busy, referenced, tuple(found.values()))

    def _ask(self, plan: AxisPlan, deadline: Deadline, command: str, **values: object) -> Reply:
        return self._query(plan.device, plan.axis, order(self._known, command, **values), deadline)

    def _query(self, device: int, axis: int, words: str, deadline: Deadline) -> Reply:
        """Send a command and wait for its reply, which repeats its number."""
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
            raise ProtocolError("sent a message that is not a reply")
        if not reply.ok:
            command = f"device {device} axis {axis}: {words}"
            if reply.data in self._known["busy"]:
                raise StateError(f"rejected the command: {reply.data}", command=command)
            raise RefusedError(f"rejected the command: {reply.data}", command=command)
        return reply
