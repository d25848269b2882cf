"""Simulated Newport SMC100 controllers on one line.

Source: see :mod:`reseau_drivers.codecs.smc100`. Where the manual is ambiguous the simulator is strict: a
velocity is not accepted without a reference.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from reseau.core.errors import ProtocolError
from reseau_drivers.codecs.smc100 import LIMIT, Line, decode, encode
from reseau_drivers.codecs.stream import Damaged, LineDecoder

from .faults import Kind
from .machine import Machine
from .motion import Clock, Motor


class Smc100Line(Machine):
    r"""Simulated controllers on one line, addressed from 1.

    Parameters
    ----------
    count : int
        Number of controllers.
    low, high : float
        Software limits (units).
    speed : float
        Units per second.
    clock : callable
        Returns the time in seconds.

    Examples
    --------
    >>> Smc100Line(1).receive(b"1TS\r\n")
    [b'1TS00000A\r\n']
    """

    def __init__(
        self,
        count: int = 1,
        *,
        low: float = -180.0,
        high: float = 180.0,
        speed: float = 20.0,
        clock: Clock = time.monotonic,
    ) -> None:
        super().__init__()
        self._lines = LineDecoder(limit=LIMIT)
        self.motors = {
            address: Motor(low - 1.0, high + 1.0, speed, clock, at=1.5) for address in range(1, count + 1)
        }
        self._limits = (low, high)
        self._errors = dict.fromkeys(self.motors, "@")

    def position(self, address: int) -> float:
        """Return the current position of an axis (units), independent of queries."""
        with self.lock:
            return self.motors[address].position

    def receive(self, data: bytes) -> Sequence[bytes]:
        """Return the answers to these bytes; most commands have none."""
        answers: list[bytes] = []
        for line in self._lines.feed(data):
            if isinstance(line, Damaged):
                self.violations.append(str(line))
                continue
            try:
                command = decode(line)
            except ProtocolError as error:
                self.violations.append(error.what)
                continue
            motor = self.motors.get(command.address)
            if motor is None:
                self.violations.append(f"no controller at address {command.address}")
                continue
            said = self._obey(command, motor)
            if said is not None:
                answers.append(encode(Line(command.address, command.name, said)))
        return answers

    def disconnected(self) -> None:
        """Discard an incomplete command."""
        self._lines.reset()

    def inject_fault(self, kind: Kind) -> None:
        """Stuck: a following error; wrong state: disabled; out of range: at the end of the run."""
        for motor in self.motors.values():
            motor.inject_fault(kind)

    def _state(self, motor: Motor) -> tuple[int, int]:
        """Return error bits and state."""
        moving = motor.moving
        errors = (
            (0x01 if motor.limit < 0 else 0)
            | (0x02 if motor.limit > 0 else 0)
            | (0x20 if motor.stalled else 0)
        )
        if not motor.enabled:
            return errors, 0x3C
        if motor.homing:
            return errors, 0x1E
        if not motor.homed:
            return errors, 0x0A
        return errors, 0x28 if moving else 0x33

    def _obey(self, command: Line, motor: Motor) -> str | None:
        errors, state = self._state(motor)
        match command.name, command.value:
            case "TP", "" | "?":
                return f"{motor.position:.6f}"
            case "TS", "" | "?":
                # Errors are reported once.
                motor.stalled, motor.limit = False, 0
                return f"{errors:04X}{state:02X}"
            case "TE", "" | "?":
                said, self._errors[command.address] = self._errors[command.address], "@"
                return said
            case "VE", "" | "?":
                return " SMC_CC_1.0.1"
            case "VA", "?":
                return f"{motor.speed:g}"
            case "SL", "?":
                return f"{self._limits[0]:g}"
            case "SR", "?":
                return f"{self._limits[1]:g}"
        error = self._command(command, motor, state)
        if error != "@":
            self._errors[command.address] = error
            self.violations.append(f"{command.address}{command.name}{command.value} gave error {error}")
        return None

    def _command(self, command: Line, motor: Motor, state: int) -> str:
        """Execute a command without answer; return the error code for TE."""
        forbidden = {0x0A: "H", 0x1E: "L", 0x28: "M", 0x3C: "J"}
        try:
            value = float(command.value) if command.value else None
        except ValueError:
            return "C"
        match command.name:
            case "OR":
                if state != 0x0A:
                    return forbidden.get(state, "K")
                motor.home()
            case "ST":
                if state in (0x0A, 0x3C):
                    return forbidden[state]
                motor.stop()
            case "PA" | "PR":
                if value is None:
                    return "C"
                if state != 0x33:
                    return forbidden[state]
                target = value if command.name == "PA" else motor.position + value
                if not self._limits[0] <= target <= self._limits[1]:
                    return "G"
                motor.go(target)
            case "VA":
                if value is None or value <= 0:
                    return "C"
                if state in (0x0A, 0x1E, 0x28):
                    return forbidden[state]
                motor.speed = value
            case "MM":
                motor.enabled = value == 1
            case _:
                return "A"
        return "@"
