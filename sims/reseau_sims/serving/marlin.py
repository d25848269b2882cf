"""Simulated Marlin controller.

Source: see :mod:`reseau_drivers.codecs.gcode`. Homing blocks: lines that come meanwhile wait, and it says
that it is busy.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Sequence

from reseau.core.errors import ProtocolError
from reseau_drivers.codecs.gcode import AXES, decode_numbered, words_of
from reseau_drivers.codecs.stream import Damaged, LineDecoder

from .faults import Kind
from .gcode import GcodeController
from .motion import Clock

_FIRMWARE = (
    "FIRMWARE_NAME:Marlin 2.1.2 (Oct 20 2022 12:00:00) SOURCE_CODE_URL:github.com/MarlinFirmware/Marlin "
    "PROTOCOL_VERSION:1.0 MACHINE_TYPE:Table EXTRUDER_COUNT:0\nCap:EEPROM:1\nCap:EMERGENCY_PARSER:1\n"
)
_BUSY_S = 2.0
_IGNORED = ("G21", "G4", "M17", "M84", "M18", "M105", "M111", "M117", "M155", "M400", "M82", "M104", "M140")


class MarlinController(GcodeController):
    r"""Simulated controller; positions in millimetres, of any number of axes.

    Parameters
    ----------
    axes : int
        Number of axes.
    low, high : float
        Travel of all axes (mm); its software endstops shorten movements.
    speed : float
        Largest speed (mm/s).
    steps : float
        Steps per millimetre.
    clock : callable
        Returns the time in seconds.

    Examples
    --------
    >>> board = MarlinController(2)
    >>> board.receive(b"M114\n")
    [b'X:0.00 Y:0.00 E:0.00 Count X:0 Y:0\nok\n']
    >>> board.receive(b"N4 M114*33\n")[0].splitlines()[-2:]
    [b'Resend: 1', b'ok']
    """

    def __init__(
        self,
        axes: int = 3,
        *,
        low: float = 0.0,
        high: float = 200.0,
        speed: float = 100.0,
        steps: float = 400.0,
        clock: Clock = time.monotonic,
    ) -> None:
        super().__init__(axes, low, high, speed, 0.0, clock)
        self._lines, self._steps = LineDecoder(limit=96), steps
        self._power_on()

    def _power_on(self) -> None:
        self._number, self._percent, self._feed = 0, 100, 20.0
        self._relative = False
        self._wanted = [0.0] * len(self._motors)
        """Where the axes are to be, as M114 reports it."""
        # Step counters start at zero wherever the axes are.
        self._zero = [motor.position for motor in self._motors]
        self._forget()
        self._homing: list[int] = []
        self._busy_at = math.inf

    def receive(self, data: bytes) -> Sequence[bytes]:
        """Return the answers to these bytes."""
        answers: list[bytes] = []
        for line in self._lines.feed(data):
            if isinstance(line, Damaged):
                self.violations.append(str(line))
                continue
            self._advance()
            answers += self._take(line)
        return answers

    @property
    def due(self) -> float | None:
        """When it reports something unasked."""
        if self._unasked:
            return self._clock()
        if not self._homing:
            return None
        ends = [end for k in self._homing if (end := self._motors[k].arrival) is not None]
        return min(max(ends, default=self._clock()), self._busy_at)

    def disconnected(self) -> None:
        """Discard an incomplete line."""
        self._lines.reset()

    def inject_fault(self, kind: Kind) -> None:
        """Stuck: motion ends early; wrong state: motors off; out of range: an endstop was hit."""
        self._advance()
        if kind == "stuck":
            self._stand()
        elif kind in ("wrong state", "out of range"):
            self._stop()
            if kind == "wrong state":
                self._percent = 100
            else:
                self._unasked.append(b"echo:endstops hit:  X:%.2f\n" % self._motors[0].position)
        elif kind == "power-cycled":
            self._cut_power()
            self._power_on()
            self._unasked = [b"start\n", b"echo:Marlin 2.1.2\n"]

    def _advance(self) -> None:
        if self._homing:
            if any(self._motors[k].moving for k in self._homing):
                if self._clock() >= self._busy_at:
                    self._busy_at += _BUSY_S
                    self._unasked.append(b"echo:busy: processing\n")
                return
            for k in self._homing:
                self._wanted[k] = self._zero[k] = 0.0
            self._homing, self._busy_at = [], math.inf
            self._report_homed(self._state() + b"ok\n")
        self._begin_queued()

    def _stand(self) -> None:
        self._queue.clear()
        super()._stand()

    def _stop(self) -> None:
        """Stop; where the axes are is where they are to be."""
        self._stand()
        self._wanted = [m.position - zero for m, zero in zip(self._motors, self._zero, strict=True)]
        if self._homing:
            self._homing, self._busy_at = [], math.inf
            self._unasked.append(b"ok\n")

    def _state(self) -> bytes:
        places = " ".join(f"{AXES[k]}:{wanted:.2f}" for k, wanted in enumerate(self._wanted))
        counts = " ".join(
            f"{AXES[k]}:{round((motor.position - zero) * self._steps)}"
            for k, (motor, zero) in enumerate(zip(self._motors, self._zero, strict=True))
        )
        return f"{places} E:0.00 Count {counts}\n".encode()

    def _take(self, line: bytes) -> list[bytes]:
        """Carry out a line; while it homes, lines wait, but for M410."""
        if self._homing and b"M410" not in line:
            self._waiting.append(line)
            return []
        try:
            number, text = decode_numbered(line)
        except ProtocolError as error:
            self.violations.append(error.what)
            return [self._again("checksum mismatch")]
        if text.startswith("M110") and (found := re.search(r"N(-?\d+)", text[4:])):
            self._number = int(found[1])
            return [b"ok\n"]
        if number is not None:
            if number != self._number + 1:
                return [self._again("Line Number is not Last Line Number+1")]
            self._number = number
        return self._obey(text)

    def _again(self, why: str) -> bytes:
        n = self._number
        return f"Error:{why}, Last Line: {n}\nResend: {n + 1}\nok\n".encode()

    def _obey(self, text: str) -> list[bytes]:
        text = text.partition(";")[0].strip()
        code, _, rest = text.partition(" ")
        words = words_of(rest) or {}
        match code:
            case "" | "G90" | "G91":
                self._relative = code == "G91" if code else self._relative
            case "M115":
                return [_FIRMWARE.encode() + b"ok\n"]
            case "M92":
                steps = " ".join(f"{letter}{self._steps:.2f}" for letter in AXES[: len(self._motors)])
                return [f"echo: M92 {steps}\nok\n".encode()]
            case "M114":
                return [self._state() + b"ok\n"]
            case "M220":
                if "S" not in words:
                    return [b"FR:%d%%\nok\n" % self._percent]
                self._percent = int(words["S"])
            case "M410":
                self._stop()
            case "G28":
                return self._home([k for k, letter in enumerate(AXES) if letter in rest.upper()])
            case "G0" | "G1":
                self._move(words)
            case "G92":
                for k, letter in enumerate(AXES[: len(self._motors)]):
                    self._wanted[k] = words.get(letter, self._wanted[k])
            case _ if code not in _IGNORED:
                self.violations.append(f"{text!r} is not known")
                return [f'echo:Unknown command: "{text}"\nok\n'.encode()]
        return [b"ok\n"]

    def _home(self, axes: list[int]) -> list[bytes]:
        self._homing = [k for k in axes if k < len(self._motors)] or list(range(len(self._motors)))
        self._queue.clear()
        for k in self._homing:
            self._motors[k].speed = self._largest
            self._motors[k].home()
        self._busy_at = self._clock() + _BUSY_S
        return []

    def _move(self, words: dict[str, float]) -> None:
        if "F" in words:
            self._feed = words["F"] / 60
        letters = [k for k, letter in enumerate(AXES[: len(self._motors)]) if letter in words]
        for k in letters:
            target = words[AXES[k]] + (self._wanted[k] if self._relative else 0.0)
            if self._motors[k].homed:
                target = min(max(target, self._limits[0]), self._limits[1])
            else:
                self.violations.append(f"{AXES[k]} moves without a reference")
            self._wanted[k] = target
        if letters:
            speed = min(self._feed * self._percent / 100, self._largest)
            targets = [want + zero for want, zero in zip(self._wanted, self._zero, strict=True)]
            self._queue.append((targets, max(speed, 1e-3)))
            self._advance()
