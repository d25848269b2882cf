"""Thorlabs' Kinesis controllers (K-Cube, T-Cube, integrated stages, racks), with the APT protocol.

Source: see :mod:`reseau_drivers.codecs.apt`. Orders are not acknowledged: what was set is read back, and a
movement is one once the status shows it. Answers have no number and no checksum: after a reconnection the
first answer that is waited for is one that no other query has, and a position at rest is asked for twice.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from serial.tools import list_ports

from reseau.core.errors import ProtocolError, SettingError, StateError
from reseau.instruments import Deadline, Identity

from ..codecs.apt import (
    HOST,
    USB,
    Message,
    MessageDecoder,
    Velocities,
    bay,
    decode_info,
    decode_status,
    decode_velocities,
    encode,
    encode_velocities,
    move,
)
from ..link import Link, MessageLink
from ..profiles import controller, known, told_bits
from .reference import References, Reported
from .table import AxisPlan

MotorKind = Literal["dc", "brushless", "stepper"]
_BEGINS_S = 2.0
"""Time in which an order must show in the status (s)."""
_POLL_S = 0.01
_OFF = "the motor is switched off"


class Kinesis:
    """Controllers of Thorlabs; each USB connection is a serial port of its own.

    Parameters
    ----------
    links : sequence of Link
        Link to each controller; `AxisPlan.device` is its number, from 1, and `AxisPlan.axis` the channel.
    motor : {"dc", "brushless", "stepper"}
        Kind of the motors, for the unit of velocities.
    rack : bool
        Whether there is one link, to a rack: `AxisPlan.device` is then the number of the bay.
    answer_s : float
        Time limit of an answer (s).
    dialect : str, optional
        File of a profile of one's own.

    Examples
    --------
    >>> from reseau_drivers.link import link_to
    >>> controller = Kinesis([link_to("/dev/ttyUSB0")])
    """

    checked = False

    def __init__(
        self,
        links: Sequence[Link],
        motor: MotorKind = "dc",
        *,
        rack: bool = False,
        answer_s: float = 1.0,
        dialect: str | None = None,
    ) -> None:
        self._known = controller("kinesis", dialect)
        if motor not in self._known["motors"]:
            raise SettingError(f"{motor!r} is not one of {', '.join(self._known['motors'])}", where="motor")
        if rack and len(links) != 1:
            raise SettingError("has one address", where="rack")
        self._links = [_Cube(link, answer_s, self._known) for link in links]
        self._motor, self._rack = motor, rack
        self._status = self._known["status"][motor]
        self._masks = {name: int(mask, 16) for name, mask in self._known["masks"].items()}
        self._targets: dict[tuple[int, int], int] = {}
        self.references = References()

    def open(self, deadline: Deadline) -> None:
        """Open all connections."""
        for each in self._links:
            each.open(deadline)

    def close(self) -> None:
        """Close all connections."""
        for each in self._links:
            each.close()

    def identify(self, plans: Mapping[str, AxisPlan], deadline: Deadline) -> Identity:
        """Return models, serial numbers and firmware of the controllers in use."""
        found = []
        for device in sorted({plan.device for plan in plans.values()}):
            cube, address = self._at(device)
            info = decode_info(cube.query(Message("REQUEST_INFO", address, HOST), "INFO", deadline))
            found.append((info.model, str(info.serial), ".".join(map(str, info.firmware))))
        models, serials, versions = (", ".join(column) for column in zip(*found, strict=True))
        return Identity("Thorlabs", models, serials, versions)

    def set_speed(self, plan: AxisPlan, units_per_s: float, deadline: Deadline) -> None:
        """Set the speed of an axis, and read it back; its acceleration stays."""
        cube, address = self._at(plan.device)
        maximum = max(1, round(units_per_s * plan.per_unit * self._known["motors"][self._motor]))
        now = self._velocities(plan, deadline)
        if now.maximum == maximum:
            return
        data = encode_velocities(Velocities(plan.axis, now.acceleration, maximum, now.minimum))
        cube.send(Message("SET_VELOCITIES", address, HOST, data=data), deadline)
        if (found := self._velocities(plan, deadline).maximum) != maximum:
            raise StateError(
                f"did not take the speed of axis {plan.name}: {found}, not {maximum}",
                do="is it below the largest speed of the stage?",
            )

    def begin_home(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Switch the motor on and start the search for the reference."""
        cube, address = self._at(plan.device)
        cube.send(Message("SET_ENABLED", address, HOST, (plan.axis, 1)), deadline)
        self._targets.pop((plan.device, plan.axis), None)
        if not self._begun(plan, Message("HOME", address, HOST, (plan.axis, 0)), "HOMED", deadline):
            raise StateError("does not begin to search its reference", do="is the stage plugged in?")

    def begin_move(self, plan: AxisPlan, position: float, deadline: Deadline) -> None:
        """Start a movement."""
        _, address = self._at(plan.device)
        target = round(position * plan.per_unit)
        self._targets[plan.device, plan.axis] = target
        # One that is not carried out is noticed by where the axis stands.
        self._begun(plan, move(address, plan.axis, target), "MOVED", deadline)

    def halt(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Stop the axis with its deceleration, and wait until it stands."""
        cube, address = self._at(plan.device)
        self._targets.pop((plan.device, plan.axis), None)
        cube.send(Message("STOP", address, HOST, (plan.axis, 2)), deadline)
        while self._ask(plan, deadline)[1] & self._masks["moving"]:
            if deadline.expired:
                raise StateError("does not stop", do="switch it off")
            time.sleep(deadline.at_most(_POLL_S))

    def state(self, plan: AxisPlan, deadline: Deadline) -> Reported:
        """Return what it reports of the axis."""
        counts, bits = self._ask(plan, deadline)
        limit, moving, homed, enabled = (
            bool(bits & self._masks[name]) for name in ("limit", "moving", "homed", "enabled")
        )
        faults = [*([] if enabled else [_OFF]), *told_bits(self._known, bits)]
        # At its reference a stage may stand on a switch: that is an end only where it was to go farther.
        target = self._targets.get((plan.device, plan.axis), counts)
        short = abs(target - counts) > plan.tolerance * plan.per_unit
        if short and limit and not moving:
            faults.append("a limit switch was reached")
        lost = [what for what in faults if what != _OFF] if self._motor in self._known["open_loop"] else []
        if lost:  # steps are counted as they are sent, whether the motor follows or not
            self.references.void(lost[0], plan.name)
        return Reported(counts / plan.per_unit, moving, homed, tuple(faults))

    def _at(self, device: int) -> tuple[_Cube, int]:
        """Connection and address of a controller."""
        if self._rack:
            return self._links[0], bay(device)
        if not 1 <= device <= len(self._links):
            raise SettingError(f"{device} is not 1…{len(self._links)}", where="device", do="give its address")
        return self._links[device - 1], USB

    def _ask(self, plan: AxisPlan, deadline: Deadline) -> tuple[int, int]:
        cube, address = self._at(plan.device)
        query = Message(f"REQUEST_{self._status}", address, HOST, (plan.axis, 0))
        return decode_status(cube.query(query, self._status, deadline))

    def _velocities(self, plan: AxisPlan, deadline: Deadline) -> Velocities:
        cube, address = self._at(plan.device)
        query = Message("REQUEST_VELOCITIES", address, HOST, (plan.axis, 0))
        return decode_velocities(cube.query(query, "VELOCITIES", deadline))

    def _begun(self, plan: AxisPlan, order: Message, end: str, deadline: Deadline) -> bool:
        """Send an order to move; return whether the axis began to move, or has arrived already."""
        cube, _ = self._at(plan.device)
        where = (plan.device if self._rack else 0, plan.axis)
        cube.ended.discard((end, *where))
        before = self._ask(plan, deadline)[0]
        cube.send(order, deadline)
        patience = deadline.part(_BEGINS_S)
        while not patience.expired:
            now, bits = self._ask(plan, deadline)
            if bits & self._masks["moving"] or now != before or (end, *where) in cube.ended:
                return True
            if self._targets.get((plan.device, plan.axis)) == now:
                return True
            time.sleep(patience.at_most(_POLL_S))
        return False


def kinesis_ports() -> tuple[str, ...]:
    """List the serial ports of Kinesis controllers; entry point ``kinesis``.

    Examples
    --------
    >>> isinstance(kinesis_ports(), tuple)
    True
    """
    usb = tuple(int(each, 16) for each in known("kinesis")["usb"])
    return tuple(sorted(port.device for port in list_ports.comports() if (port.vid, port.pid) == usb))


class _Cube:
    """Exchange of messages with one controller, or with a rack."""

    def __init__(self, link: Link, answer_s: float, profile: Mapping[str, Any]) -> None:
        self._answer_s, self._known = answer_s, profile
        self._link: MessageLink[Message] = MessageLink(link, MessageDecoder(profile), self._overheard)
        self.ended: set[tuple[str, int, int]] = set()
        """Ends of movements that were announced: message, bay (0 without a rack), channel."""
        self._synchronised = False

    def open(self, deadline: Deadline) -> None:
        self._link.open(deadline)
        self._synchronised = False

    def close(self) -> None:
        self._link.close()

    def send(self, message: Message, deadline: Deadline) -> None:
        self._link.send(encode(message, self._known), deadline.part(self._answer_s))

    def query(self, message: Message, answer: str, deadline: Deadline) -> Message:
        if not self._synchronised:
            # Answers arrive in order: after the one to this query, which is asked only here and where it is
            # known, none from before the connection is left.
            self._exchange(Message("REQUEST_INFO", message.destination, HOST), "INFO", deadline)
            self._synchronised = True
        return self._exchange(message, answer, deadline)

    def _exchange(self, message: Message, answer: str, deadline: Deadline) -> Message:
        def answers(found: Message) -> bool:
            # Some T-Cubes give 0 as their address; there is only one device at a USB connection of its own.
            sources = (message.destination, 0) if message.destination == USB else (message.destination,)
            same = found.name == answer and found.source in sources
            return same and (answer == "INFO" or found.channel == message.parameters[0])

        found = self._link.query(encode(message, self._known), answers, deadline.part(self._answer_s))
        if found.destination not in (0, HOST):
            raise ProtocolError(f"sent an answer to {found.destination:#04x}")
        return found

    def _overheard(self, message: Message) -> None:
        if message.name in ("HOMED", "MOVED"):
            where = message.source - 0x20 if 0x21 <= message.source <= 0x2A else 0
            self.ended.add((message.name, where, message.channel))
