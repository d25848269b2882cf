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

_LONGEST = 80
_SPEED = 1.6384
_STORED = {
    "accel": "205",
    "motion.accelonly": "205",
    "motion.decelonly": "205",
    "limit.approach.maxspeed": "50000",
    "limit.home.pos": "0",
    "resolution": "64",
    "peripheral.id": "0",
    "peripheralid": "0",
    "peripheral.serial": "0",
    "peripheral.hw.modified": "0",
}
"""Settings of an axis that do not change its simulated motion, which has a constant speed."""
_OF_DEVICE = {"comm.alert": "0", "knob.enable": "1", "system.access": "1"}
_FIXED = (
    "limit.home.pos", "resolution", "peripheral.id", "peripheralid", "peripheral.serial",
    "peripheral.hw.modified",
)  # fmt: skip
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
        self._parked: set[tuple[int, int]] = set()
        self._stored = {key: dict(_STORED) for key in self.motors}
        self._of_device = {device: dict(_OF_DEVICE) for device in {device for device, _ in self.motors}}

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
            motor.inject_fault(kind)
        if kind == "power-cycled":
            self._parked.clear()

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
            case ["tools", "parking", "park"]:
                if any(motor.moving for motor in motors):
                    return False, "STATUSBUSY"
                self._parked |= set(keys)
                return True, "0"
            case ["tools", "parking", "unpark"]:
                self._parked -= set(keys)
                return True, "0"
            case ["driver", ("enable" | "disable") as how]:
                for motor in motors:
                    motor.stop()
                    motor.enabled = how == "enable"
                return True, "0"
            case ["system", "reset"]:
                self.inject_fault("power-cycled")
                return True, "0"
            case ["home" | "move", *_] if self._parked & set(keys):
                return False, "PARKED"
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
                return self._get(name, motors, keys)
            case ["set", name, value]:
                return self._set(name, value, motors, keys)
            case _:
                return False, "BADCOMMAND"

    def _move(
        self, how: str, rest: list[str], motors: list[Motor], keys: list[tuple[int, int]]
    ) -> tuple[bool, str]:
        try:
            value = float(rest[0]) if rest else 0.0
        except ValueError:
            return False, "BADDATA"
        # Speed and acceleration may follow a distance.
        speeds = rest[0 if how in ("min", "max") else 1 :]
        if (how in ("abs", "rel", "vel") and not rest) or len(speeds) > 2:
            return False, "BADDATA"
        if not all(text.isdigit() and int(text) for text in speeds):
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

    def _set(
        self, name: str, value: str, motors: list[Motor], keys: list[tuple[int, int]]
    ) -> tuple[bool, str]:
        try:
            number = float(value)
        except ValueError:
            return False, "BADDATA"
        if name in ("maxspeed", "accel", "motion.accelonly", "motion.decelonly") and not number > 0:
            return False, "BADDATA"
        if name in _OF_DEVICE:
            for device, _ in keys:
                self._of_device[device][name] = value
            return True, "0"
        if name in _STORED and name not in _FIXED:
            for key in keys:
                changed = ("accel", "motion.accelonly", "motion.decelonly") if name == "accel" else (name,)
                self._stored[key] |= dict.fromkeys(changed, value)
            return True, "0"
        for motor in motors:
            if name == "maxspeed":
                if motor.moving:
                    motor.go(motor.target)
                motor.speed = number / _SPEED
            elif name == "limit.min":
                motor.low = number
            elif name == "limit.max":
                motor.high = number
            else:
                return False, "BADCOMMAND"
        return True, "0"

    def _get(self, name: str, motors: list[Motor], keys: list[tuple[int, int]]) -> tuple[bool, str]:
        device = keys[0][0]
        constant = {
            "device.id": "50081",
            "deviceid": "50081",
            "system.serial": "71234",
            "version": "7.38",
            "version.build": "15000",
            "system.platform": "3",
            "system.voltage": "48.0",
            "system.temperature": "30.1",
            "comm.address": str(device),
            "comm.packet.size.max": str(_LONGEST),
            "comm.command.packets.max": "1",
            "comm.word.size.max": "50",
            "get.settings.max": "1",
            "device.hw.modified": "0",
            "system.axiscount": str(sum(1 for d, _ in self.motors if d == device)),
            **self._of_device[device],
        }
        per_axis: dict[str, Callable[[Motor], int]] = {
            "pos": lambda motor: round(motor.position),
            "encoder.pos": lambda motor: round(motor.position),
            "maxspeed": lambda motor: round(motor.speed * _SPEED),
            "limit.min": lambda motor: round(motor.low),
            "limit.max": lambda motor: round(motor.high),
        }
        if name in constant:
            return True, constant[name]
        if name in per_axis:
            return True, " ".join(str(per_axis[name](motor)) for motor in motors)
        if name == "parking.state":
            return True, " ".join(str(int(key in self._parked)) for key in keys)
        if name in _STORED:
            return True, " ".join(self._stored[key][name] for key in keys)
        return False, "BADCOMMAND"
