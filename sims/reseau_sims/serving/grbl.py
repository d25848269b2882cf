"""Simulated GRBL controller.

Source: see :mod:`reseau_drivers.codecs.gcode`. The end of homing and alarms are reported unasked.
"""

from __future__ import annotations

import re
import time
from collections.abc import Sequence

from reseau.core.errors import ProtocolError
from reseau_drivers.codecs.gcode import AXES, decode_numbered, words_of

from .faults import Kind
from .gcode import GcodeController
from .motion import Clock

_BANNER = b"\r\nGrbl 1.1h ['$' for help]\r\n"
_LOCKED = b"[MSG:'$H'|'$X' to unlock]\r\n"
_GROUPS = (0, 1, 4, 17, 20, 21, 28, 53, 54, 55, 90, 91, 92, 94)
"""Numbers of G that it knows; those that do not concern motion are accepted."""
_LONGEST = 80
_RAPID = 80.0
"""Speed of G0 (mm/s)."""


class GrblController(GcodeController):
    r"""Simulated controller; positions in millimetres, of any number of axes.

    Parameters
    ----------
    axes : int
        Number of axes.
    low, high : float
        Travel of all axes (mm), with soft limits.
    speed : float
        Largest speed (mm/s).
    settings : dict of str to str, optional
        Settings other than these of a table.
    clock : callable
        Returns the time in seconds.

    Examples
    --------
    >>> board = GrblController(2)
    >>> board.receive(b"?")
    [b'<Alarm|MPos:12.340,12.340|FS:0,0>\r\n']
    >>> board.receive(b"G1 X5 F600\n")
    [b'error:9\r\n']
    """

    def __init__(
        self,
        axes: int = 3,
        *,
        low: float = -200.0,
        high: float = 0.0,
        speed: float = 100.0,
        settings: dict[str, str] | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        # The reference is at zero.
        super().__init__(axes, low, high, speed, 12.34, clock)
        self.settings = {"$10": "1", "$13": "0", "$20": "1", "$21": "1", "$22": "1"} | (settings or {})
        self._line = bytearray()
        self._power_on()

    def _power_on(self) -> None:
        self._state = "Alarm" if self.settings["$22"] == "1" else "Idle"
        self._homing = self._held = False
        self._relative, self._feed, self._tool = False, 0.0, 0
        self._forget()
        self._line.clear()

    def receive(self, data: bytes) -> Sequence[bytes]:
        """Return the answers to these bytes."""
        answers: list[bytes] = []
        for value in data:
            byte = bytes([value])
            self._advance()
            if byte == b"?":
                answers.append(self._report())
            elif byte == b"!":
                self._hold()
            elif byte == b"~":
                self._held = False
            elif byte == b"\x18":
                answers.append(self._soft_reset())
            elif byte == b"\x85":
                self._queue.clear()
                self._stand()
            elif byte == b"\n":
                line, self._line = bytes(self._line), bytearray()
                answers += self._take(line)
            elif byte != b"\r" and len(self._line) <= _LONGEST:
                self._line += byte
        return answers

    @property
    def due(self) -> float | None:
        """When it reports something unasked: an alarm, or the end of homing."""
        if self._unasked:
            return self._clock()
        ends = [motor.arrival for motor in self._motors] if self._homing else []
        return max((end for end in ends if end is not None), default=self._clock() if self._homing else None)

    def disconnected(self) -> None:
        """Discard an incomplete line."""
        self._line.clear()

    def inject_fault(self, kind: Kind) -> None:
        """Stuck: a feed hold by hand; wrong state: the door opened; out of range: a limit switch reached."""
        self._advance()
        if kind == "stuck":
            self._hold()
        elif kind == "wrong state":
            self._hold()
            self._state = "Door"
        elif kind == "out of range":
            self._alarm(1)
        elif kind == "power-cycled":
            self._cut_power()
            self._power_on()
            self._unasked = [_BANNER, _LOCKED]

    def _advance(self) -> None:
        if self._homing and not any(motor.moving for motor in self._motors):
            self._homing, self._state = False, "Idle"
            self._report_homed(b"ok\r\n")
        if not self._held:
            self._begin_queued()

    def _moves(self) -> bool:
        return bool(self._queue) or any(motor.moving for motor in self._motors)

    def _hold(self) -> None:
        if self._homing:
            return
        if self._moves():
            self._held = True
        self._stand()

    def _report(self) -> bytes:
        state = self._state
        if self._homing:
            state = "Home"
        elif state == "Door":
            state = "Door:0"
        elif self._held:
            state = "Hold:0"
        elif state == "Idle" and self._moves():
            state = "Run"
        places = ",".join(f"{motor.position:.3f}" for motor in self._motors)
        kind = "MPos" if int(self.settings["$10"]) & 1 else "WPos"
        return f"<{state}|{kind}:{places}|FS:{60 * self._feed:.0f},0>\r\n".encode()

    def _soft_reset(self) -> bytes:
        if self._homing:
            self._alarm(6)
        elif self._moves() and not self._held:
            self._alarm(3)
        self._queue.clear()
        self._stand()
        self._held = self._homing = False
        self._waiting.clear()
        self._tool = 0
        if self._state == "Door":
            self._state = "Idle"
        reports, self._unasked = b"".join(self._unasked), []
        self._line.clear()
        return reports + _BANNER + (_LOCKED if self._state == "Alarm" else b"")

    def _alarm(self, code: int) -> None:
        self._queue.clear()
        self._stand()
        for motor in self._motors:
            motor.homed = False
        self._state, self._homing, self._held = "Alarm", False, False
        self._unasked.append(b"ALARM:%d\r\n" % code)

    def _take(self, line: bytes) -> list[bytes]:
        if self._homing:
            self._waiting.append(line)
            return []
        try:
            _, text = decode_numbered(line)
        except ProtocolError as error:
            self.violations.append(error.what)
            return [b"error:1\r\n"]
        code, said = self._obey(re.sub(r"\([^)]*\)|;.*", "", text).strip())
        if code is None:
            return []
        if code:
            self.violations.append(f"{text!r} gave error {code}")
            return [said + b"error:%d\r\n" % code]
        return [said + b"ok\r\n"]

    def _obey(self, text: str) -> tuple[int | None, bytes]:
        """Return an error code, 0 for `ok` or None for neither yet, and what is said before it."""
        if not text:
            return 0, b""
        if text.startswith("$"):
            return self._system(text)
        if self._state == "Alarm":
            return 9, b""
        if self._state == "Door":
            return 13, b""
        words = words_of(text)
        if words is None:
            return 1, b""
        numbers = [float(number) for number in re.findall(r"G\s*(\d+\.?\d*)", text)]
        if not set(numbers) <= set(map(float, _GROUPS)):
            return 20, b""
        return self._motion(numbers, words), b""

    def _system(self, text: str) -> tuple[int | None, bytes]:
        idle = not self._moves() and not self._held
        if text == "$G":
            mode = "G91" if self._relative else "G90"
            words = f"G0 G54 G17 G21 {mode} G94 M5 M9 T{self._tool} F{60 * self._feed:.0f} S0"
            return 0, f"[GC:{words}]\r\n".encode()
        if text == "$X":
            if self._state == "Alarm":
                self._state = "Idle"
            return 0, b"[MSG:Caution: Unlocked]\r\n"
        if not idle:
            return 8, b""
        if text == "$H":
            if self.settings["$22"] != "1":
                return 5, b""
            for motor in self._motors:
                motor.speed = self._largest
                motor.home()
            self._state, self._homing = "Alarm", True
            return None, b""
        if text == "$I":
            return 0, b"[VER:1.1h.20190825:table]\r\n[OPT:VL,15,128]\r\n"
        if text == "$$":
            return 0, "".join(f"{name}={value}\r\n" for name, value in self.settings.items()).encode()
        if text == "$#":
            return 0, b"[G54:0.000,0.000,0.000]\r\n"
        if found := re.fullmatch(r"(\$\d+)=([\d.]+)", text):
            self.settings[found[1]] = found[2]
            return 0, b""
        return 3, b""

    def _motion(self, numbers: list[float], words: dict[str, float]) -> int:
        if 90.0 in numbers or 91.0 in numbers:
            self._relative = 91.0 in numbers
        self._tool = int(words.get("T", self._tool))
        if "F" in words:
            if words["F"] <= 0:
                return 22
            self._feed = min(words["F"] / 60, self._largest)
        letters = [each for each in AXES[: len(self._motors)] if each in words]
        if not letters or 92.0 in numbers or 4.0 in numbers:
            return 0
        rapid = 0.0 in numbers
        if not rapid and not self._feed:
            return 22
        from_ = self._queue[-1][0] if self._queue else [motor.target for motor in self._motors]
        targets = list(from_)
        for each in letters:
            k = AXES.index(each)
            relative = self._relative and 53.0 not in numbers
            targets[k] = words[each] + (targets[k] if relative else 0.0)
            if self.settings["$20"] == "1" and not self._limits[0] <= targets[k] <= self._limits[1]:
                self._alarm(2)
                return 0
        if not all(motor.homed for motor in self._motors) and self.settings["$22"] == "1":
            self.violations.append("a movement without a reference")
        self._queue.append((targets, min(_RAPID, self._largest) if rapid else self._feed))
        self._advance()
        return 0
