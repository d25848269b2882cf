"""Simulated Kinesis controllers of Thorlabs: a cube with its own connection, or a rack with bays.

Source: see :mod:`reseau_drivers.codecs.apt`.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass

from reseau_drivers.codecs.apt import (
    HOST,
    USB,
    Info,
    Message,
    MessageDecoder,
    Velocities,
    bay,
    decode_velocities,
    encode,
    encode_info,
    encode_status,
    encode_velocities,
)
from reseau_drivers.codecs.stream import Damaged

from .faults import Kind
from .machine import Machine
from .motion import Clock, Motor

_VELOCITY = 65536 * 2048 / 6e6
"""Velocity in the units of a controller of DC motors, for one count per second."""
_STOP_IMMEDIATE, _STOP_PROFILED = 1, 2
_OF_ALL = ("DISCONNECT", "NO_FLASH", "START_UPDATES", "STOP_UPDATES")


@dataclass
class _Channel:
    motor: Motor
    acceleration: int = 263
    ends: str | None = None
    """Message that tells the end of the present movement."""


class KinesisController(Machine):
    r"""Simulated controllers of DC motors behind one connection.

    Parameters
    ----------
    bays : int
        Number of bays of a rack, with a channel each; 0: a cube.
    low, high : float
        Positions of the limit switches (counts).
    clock : callable
        Returns the time in seconds.

    Examples
    --------
    >>> cube = KinesisController()
    >>> cube.receive(bytes.fromhex("90 04 01 00 50 01"))[0].hex(" ")
    '91 04 0e 00 81 50 01 00 d2 04 00 00 00 00 00 00 00 01 00 80'
    """

    def __init__(
        self,
        bays: int = 0,
        *,
        low: float = -500_000.0,
        high: float = 800_000.0,
        clock: Clock = time.monotonic,
    ) -> None:
        super().__init__()
        self._decoder, self._clock = MessageDecoder(), clock
        self._bays = bays
        addresses = [bay(number) for number in range(1, bays + 1)] or [USB]
        self._channels = {at: _Channel(Motor(low, high, 20_000.0, clock)) for at in addresses}

    @property
    def motors(self) -> dict[int, Motor]:
        """Motors by bay; 1 is that of a cube."""
        return {number: channel.motor for number, channel in enumerate(self._channels.values(), 1)}

    def position(self, number: int = 1) -> float:
        """Return the current position of an axis (counts), independent of queries."""
        with self.lock:
            return self.motors[number].position

    def receive(self, data: bytes) -> Sequence[bytes]:
        """Return the answers to these bytes."""
        answers: list[bytes] = []
        for message in self._decoder.feed(data):
            if isinstance(message, Damaged):
                self.violations.append(str(message))
                continue
            channel = self._channels.get(message.destination)
            if channel is None:
                if message.name not in _OF_ALL:
                    self.violations.append(f"{message.name} to {message.destination:#04x}: nothing is there")
                continue
            said = self._obey(message, channel)
            if said is not None:
                answers.append(encode(said))
        return answers

    @property
    def due(self) -> float | None:
        """When the next movement ends: it is reported unasked."""
        ends = [channel.motor.arrival for channel in self._channels.values() if channel.ends is not None]
        now = self._clock()
        return min((now if end is None else end for end in ends), default=None)

    def emit(self) -> Sequence[bytes]:
        """Return the messages on movements that have ended."""
        reports = []
        for address, channel in self._channels.items():
            if channel.ends is not None and not channel.motor.moving:
                reports.append(encode(self._end(address, channel, channel.ends)))
                channel.ends = None
        return reports

    def disconnected(self) -> None:
        """Discard an incomplete message."""
        self._decoder.reset()

    def inject_fault(self, kind: Kind) -> None:
        """Stuck: a position error; wrong state: motors off; out of range: a limit switch reached."""
        for channel in self._channels.values():
            motor, channel.ends = channel.motor, None
            motor.inject_fault(kind)
            if kind == "power-cycled":
                channel.acceleration = 263
                motor.speed = 20_000.0

    def _end(self, address: int, channel: _Channel, end: str) -> Message:
        if end == "HOMED":
            return Message(end, HOST, address, (1, 0))
        return Message(end, HOST, address, data=self._status(channel))

    @staticmethod
    def _bits(channel: _Channel) -> int:
        """The status bits, as MGMSG_MOT_GET_STATUSBITS lists them."""
        motor = channel.motor
        before, going = motor.position, motor.target
        return 0x100 | sum(
            bit
            for bit, is_so in (
                (0x1, motor.limit > 0),
                (0x2, motor.limit < 0),
                (0x10, motor.moving and going > before),
                (0x20, motor.moving and going < before),
                (0x200, motor.homing),
                (0x400, motor.homed),
                (0x4000, motor.stalled),
                (0x80000000, motor.enabled),
            )
            if is_so
        )

    def _status(self, channel: _Channel) -> bytes:
        return encode_status(1, round(channel.motor.position), self._bits(channel))

    def _obey(self, message: Message, channel: _Channel) -> Message | None:
        address, motor = message.destination, channel.motor
        if message.source != HOST:
            self.violations.append(f"{message.name} came from {message.source:#04x}, not the host")
        if message.name not in ("REQUEST_INFO", *_OF_ALL) and message.channel != 1:
            self.violations.append(f"{message.name} to channel {message.channel}: there is one")
            return None

        def answer(name: str, data: bytes) -> Message:
            return Message(name, HOST, address, data=data)

        match message.name:
            case "REQUEST_INFO":
                return answer("INFO", encode_info(self._info(address)))
            case "REQUEST_STATUS" | "REQUEST_DC_STATUS":
                return answer(message.name.removeprefix("REQUEST_"), self._status(channel))
            case "REQUEST_STATUS_BITS":
                return answer("STATUS_BITS", struct.pack("<HI", 1, self._bits(channel)))
            case "REQUEST_ENABLED":
                return Message("ENABLED", HOST, address, (1, 1 if motor.enabled else 2))
            case "REQUEST_VELOCITIES":
                speed = round(motor.speed * _VELOCITY)
                return answer("VELOCITIES", encode_velocities(Velocities(1, channel.acceleration, speed)))
            case "SET_VELOCITIES":
                self._set_velocities(channel, decode_velocities(message))
            case "SET_ENABLED":
                motor.enabled = message.parameters[1] == 1
                if not motor.enabled:
                    motor.stop()
            case "HOME":
                if motor.enabled:
                    motor.home()
                    channel.ends = "HOMED"
                else:
                    self.violations.append("HOME while the motor is off")
            case "MOVE_ABSOLUTE" | "MOVE_RELATIVE":
                self._move(message, channel)
            case "STOP":
                if message.parameters[1] not in (_STOP_IMMEDIATE, _STOP_PROFILED):
                    self.violations.append(f"STOP with mode {message.parameters[1]}")
                if motor.moving:
                    motor.stop()
                    channel.ends = None
                    return self._end(address, channel, "STOPPED")
            case _:
                pass
        return None

    def _info(self, address: int) -> Info:
        model = "BSC203" if self._bays else "KDC101"
        return Info(27_001_234 + address - USB, model, (2, 1, 3))

    def _set_velocities(self, channel: _Channel, wanted: Velocities) -> None:
        if wanted.maximum <= 0 or wanted.acceleration <= 0:
            self.violations.append(f"velocities must be positive: {wanted}")
            return
        motor, channel.acceleration = channel.motor, wanted.acceleration
        if motor.moving:
            homing = motor.homing
            motor.go(motor.target)
            motor.homing = homing
        motor.speed = wanted.maximum / _VELOCITY

    def _move(self, message: Message, channel: _Channel) -> None:
        motor = channel.motor
        if not message.data:
            self.violations.append("a move without a position: the stored one is not simulated")
            return
        target = float(struct.unpack("<i", message.data[2:])[0])
        if not motor.enabled:
            self.violations.append("a move while the motor is off")
            return
        here = motor.position  # brings the motor up to date
        if not motor.homed:
            self.violations.append("a move without a reference")
        motor.go(target if message.name == "MOVE_ABSOLUTE" else here + target)
        channel.ends = "MOVED"
