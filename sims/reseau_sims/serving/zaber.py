"""Simulated chain of Zaber devices.

Source: *Zaber ASCII Protocol Manual*, "Commands", "Settings", "Reply: rejection reasons" and "Warning Flags".
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from reseau.core.errors import ProtocolError
from reseau_drivers.codecs.stream import Damaged, LineDecoder
from reseau_drivers.codecs.zaber import Command, Reply, decode_command, encode

from .faults import Kind
from .machine import Machine
from .motion import Clock, Motor

__all__ = ["ZaberChain"]

_LONGEST = 80
_SPEED = 1.6384
_RANK = ("FS", "FE", "FD", "WR", "NI")
"""Flags in order of decreasing severity."""


class ZaberChain(Machine):
    r"""Simulated devices on one line.

    Parameters
    ----------
    axes : sequence of int
        Number of axes of each device; devices are numbered from 1.
    low, high : float
        Limits of all axes (steps).
    clock : callable
        Returns the time in seconds.

    Examples
    --------
    >>> chain = ZaberChain([2, 1])
    >>> chain.receive(b"/02 1 05 get pos:F6\n")
    [b'@02 1 05 OK IDLE WR 1234:1D\r\n']
    """

    def __init__(
        self,
        axes: Sequence[int] = (1,),
        *,
        low: float = 0.0,
        high: float = 400_000.0,
        clock: Clock = time.monotonic,
    ) -> None:
        super().__init__()
        self._lines = LineDecoder(limit=_LONGEST)
        self.motors = {
            (device, axis): Motor(low, high, 20_000.0, clock)
            for device, count in enumerate(axes, 1)
            for axis in range(1, count + 1)
        }
        self._interrupted: set[tuple[int, int]] = set()

    def position(self, device: int, axis: int) -> float:
        """Return the current position of an axis (steps), independent of queries."""
        with self.lock:
            return self.motors[device, axis].position

    def receive(self, data: bytes) -> Sequence[bytes]:
        """Return the replies to these bytes."""
        replies: list[bytes] = []
        for line in self._lines.feed(data):
            if isinstance(line, Damaged):
                self.violations.append(str(line))
                continue
            try:
                command = decode_command(line)
            except ProtocolError as error:
                self.violations.append(error.what)
                continue
            if b":" not in line:
                self.violations.append(f"a command without checksum: {line!r}")
            replies += self._obey(command)
        return replies

    def disconnected(self) -> None:
        """Discard an incomplete command."""
        self._lines.reset()

    def inject_fault(self, kind: Kind) -> None:
        """Stuck: an obstacle; wrong state: drivers off; out of range: a limit switch reached."""
        for motor in self.motors.values():
            if kind == "stuck":
                motor.stall()
            elif kind == "wrong state":
                motor.stop()
                motor.enabled = False
            elif kind == "out of range":
                motor.stop()
                motor.limit = 1
            elif kind == "power-cycled":
                motor.cut_power()

    def _obey(self, command: Command) -> list[bytes]:
        devices = sorted({device for device, _ in self.motors})
        if command.device and command.device not in devices:
            return []
        return [
            encode(self._reply(device, command))
            for device in ([command.device] if command.device else devices)
        ]

    def _reply(self, device: int, command: Command) -> Reply:
        motors = [m for (d, a), m in self.motors.items() if d == device and command.axis in (0, a)]
        keys = [key for key in self.motors if key[0] == device and command.axis in (0, key[1])]
        ok, data = (False, "BADAXIS") if not motors else self._do(command.words.split(), motors, keys)
        if not ok:
            self.violations.append(f"{command.words!r} was rejected: {data}")
        busy = any(motor.moving for motor in motors)
        flags = self._flags(motors, keys)
        return Reply(device, command.axis, command.id, ok, busy, flags[0] if flags else "--", data)

    def _flags(self, motors: list[Motor], keys: list[tuple[int, int]]) -> list[str]:
        found = set()
        for motor in motors:
            _ = motor.position
            found |= {
                flag
                for flag, is_so in (
                    ("FS", motor.stalled),
                    ("FE", bool(motor.limit)),
                    ("FD", not motor.enabled),
                    ("WR", not motor.homed and not motor.homing),
                )
                if is_so
            }
        if self._interrupted & set(keys):
            found.add("NI")
        return [flag for flag in _RANK if flag in found]

    def _do(self, words: list[str], motors: list[Motor], keys: list[tuple[int, int]]) -> tuple[bool, str]:
        match words:
            case []:
                return True, "0"
            case ["home"]:
                for motor in motors:
                    motor.enabled = True
                    motor.home()
                return True, "0"
            case ["move", ("abs" | "rel" | "vel" | "min" | "max") as how, *rest]:
                return self._move(how, rest, motors, keys)
            case ["stop"] | ["estop"]:
                self._interrupted |= {k for k, motor in zip(keys, motors, strict=True) if motor.moving}
                for motor in motors:
                    motor.stop()
                return True, "0"
            case ["warnings", *rest] if rest in ([], ["clear"]):
                flags = self._flags(motors, keys)
                if rest:
                    self._interrupted -= set(keys)
                    for motor in motors:
                        motor.stalled, motor.limit, motor.enabled = False, 0, True
                return True, " ".join([f"{len(flags):02d}", *flags])
            case ["tools", "echo", *rest]:
                return True, " ".join(rest) or "0"
            case ["get", name]:
                return self._get(name, motors)
            case ["set", "maxspeed", value]:
                if not value.isdigit() or int(value) == 0:
                    return False, "BADDATA"
                for motor in motors:
                    if motor.moving:
                        motor.go(motor.target)
                    motor.speed = int(value) / _SPEED
                return True, "0"
            case _:
                return False, "BADCOMMAND"

    def _move(
        self, how: str, rest: list[str], motors: list[Motor], keys: list[tuple[int, int]]
    ) -> tuple[bool, str]:
        try:
            value = float(rest[0]) if rest else 0.0
        except ValueError:
            return False, "BADDATA"
        if (how in ("min", "max")) == bool(rest) or len(rest) > 1:
            return False, "BADDATA"
        for motor in motors:
            if not motor.enabled:
                return False, "DRIVERDISABLED"
            if not motor.homed and how != "vel":
                self.violations.append(f"move {how} without a reference")
            target = {
                "abs": value,
                "rel": motor.position + value,
                "vel": motor.high + 1 if value > 0 else motor.low - 1,
                "min": motor.low,
                "max": motor.high,
            }[how]
            if how in ("abs", "rel") and not motor.low <= target <= motor.high:
                return False, "BADDATA"
            motor.go(target)
        self._interrupted -= set(keys)
        return True, "0"

    def _get(self, name: str, motors: list[Motor]) -> tuple[bool, str]:
        constant = {
            "device.id": "50081",
            "system.serial": "71234",
            "version": "7.38",
            "system.axiscount": "1",
        }
        per_axis: dict[str, Callable[[Motor], int]] = {
            "pos": lambda motor: round(motor.position),
            "maxspeed": lambda motor: round(motor.speed * _SPEED),
            "limit.min": lambda motor: round(motor.low),
            "limit.max": lambda motor: round(motor.high),
        }
        if name in constant:
            return True, constant[name]
        if name in per_axis:
            return True, " ".join(str(per_axis[name](motor)) for motor in motors)
        return False, "BADCOMMAND"
