"""Controllers written from manuals and public reports, not from the drivers, and the wire to them.

Movements take a number of queries, not of seconds.
"""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Callable, Mapping
from typing import Protocol

from reseau.instruments import Deadline

__all__ = ["GrblBoard", "Lines", "Receiver", "TCube", "Wire", "ZaberStage"]


class Receiver(Protocol):
    """What answers bytes."""

    def receive(self, data: bytes) -> bytes:
        """Return the answer to these bytes."""


class Wire:
    """Link to a receiver in this process.

    Parameters
    ----------
    there : Receiver
        The other end.
    greeting : callable, optional
        What it sends when the wire is opened.
    """

    def __init__(self, there: Receiver, greeting: Callable[[], bytes] = lambda: b"") -> None:
        self.there, self._greeting, self.said = there, greeting, b""

    def open(self, deadline: Deadline) -> None:
        """Open it."""
        self.said = self._greeting()

    def close(self) -> None:
        """Close it."""

    def write(self, data: bytes, deadline: Deadline) -> None:
        """Pass the bytes on."""
        self.said += self.there.receive(data)

    def pending(self) -> bool:
        """Whether an answer waits."""
        return bool(self.said)

    def read(self, deadline: Deadline) -> bytes:
        """Return the answer; without one the time is up at once."""
        said, self.said = self.said, b""
        if not said:
            time.sleep(deadline.at_most(0.002))
        return said


class Lines:
    """Answers lines, by how they begin; other lines are not answered.

    Parameters
    ----------
    answers : mapping of str to bytes
        Answers, as they are sent.
    """

    def __init__(self, answers: Mapping[str, bytes]) -> None:
        self.answers, self.heard, self._line = dict(answers), list[str](), b""

    def receive(self, data: bytes) -> bytes:
        """Answer the lines that end in these bytes."""
        *lines, self._line = (self._line + data).split(b"\n")
        texts = [line.decode().strip() for line in lines]
        self.heard += texts
        return b"".join(
            said for text in texts for known, said in self.answers.items() if text.startswith(known)
        )


class GrblBoard:
    """A board with GRBL 1.1 or a relative of it, of one axis.

    Sources: gnea/grbl (doc/markdown/interface.md; main.c: what a reset keeps), grblHAL/core (report.c, field
    H; issue 145, banner), FluidNC issues 687 and 744 (no $22), UGS issue 3114 ($22 as a bit mask).

    Parameters
    ----------
    banner, version, settings : str
        What it says at a start, to $I and to $$.
    locks : bool
        Whether it is locked after a start until it has homed.
    tells : bool
        Whether its status has the field H.
    """

    def __init__(
        self,
        banner: str = "Grbl 1.1h ['$' for help]",
        version: str = "[VER:1.1h.20190825:]\r\n[OPT:V,15,128]",
        settings: str = "$10=1\r\n$13=0\r\n$22=1",
        *,
        locks: bool = True,
        tells: bool = False,
    ) -> None:
        self.banner, self.version, self.settings, self.locks, self.tells = (
            banner, version, settings, locks, tells,
        )  # fmt: skip
        self.place, self.homed, self.moves = 12.0, False, list[str]()
        self.ends: Callable[[], bytes] = lambda: b""
        """What happens, and is said, in the midst of the next movement."""
        self.answers: dict[str, bytes] = {}
        """Other answers to lines."""
        self.start()

    def start(self) -> bytes:
        """Switch it off and on: positions are those of the motors no more."""
        self.homed = False
        return self._begin()

    def _begin(self) -> bytes:
        self.state = "Alarm" if self.locks and not self.homed else "Idle"
        self.tool, self._left, self._target, self._line = 0, 0, self.place, b""
        lock = "[MSG:'$H'|'$X' to unlock]\r\n" if self.state == "Alarm" else ""
        return f"\r\n{self.banner}\r\n{lock}".encode()

    def receive(self, data: bytes) -> bytes:
        """Answer these bytes."""
        said = b""
        for value in data:
            match value:
                case 0x3F:
                    said += self._status()
                case 0x18:
                    said += self._begin()
                case 0x0A:
                    line, self._line = self._line.decode(), b""
                    said += self._obey(line)
                case _ if value >= 0x80 or chr(value) in "!~\r":
                    said += self._status() if value == 0x87 and self.tells else b""
                case _:
                    self._line += bytes([value])
        return said

    def _status(self) -> bytes:
        said = b""
        if self._left:
            self._left -= 1
            if self._left == 1:
                ends, self.ends = self.ends, lambda: b""
                return self._report(ends())
            if not self._left:
                if self.state == "Home":
                    self.homed, said = True, said + b"ok\r\n"
                self.place, self.state = self._target, "Idle"
        return self._report(said)

    def _report(self, said: bytes) -> bytes:
        extra = f"|H:{int(self.homed)}" if self.tells else ""
        return said + f"<{self.state}|MPos:{self.place:.3f}|FS:0,0{extra}>\r\n".encode()

    def _obey(self, line: str) -> bytes:
        if line in self.answers:
            return self.answers[line]
        modes = f"[GC:G0 G54 G17 G21 G90 G94 M5 M9 T{self.tool} F0 S0]"
        for asked, said in {"$G": modes, "$I": self.version, "$$": self.settings}.items():
            if line == asked:
                return f"{said}\r\nok\r\n".encode()
        if line == "$H":
            self.state, self._left, self._target, self.homed = "Home", 3, 0.0, False
            return b""
        if line == "$X":
            self.state = "Idle"
            return b"[MSG:Caution: Unlocked]\r\nok\r\n"
        if self.state == "Alarm" and line:
            return b"error:9\r\n"
        if found := re.fullmatch(r"T(\d+)", line):
            self.tool = int(found[1])
        if found := re.search(r"G1 X(-?[\d.]+)", line):
            self.moves.append(line)
            self.state, self._left, self._target = "Run", 3, float(found[1])
        return b"ok\r\n"


class ZaberStage:
    """One axis of a Zaber device; source: Zaber ASCII protocol, message format and warning flags."""

    def __init__(self) -> None:
        self.place = self._target = 0
        self.flags, self.then, self._left = ["WR"], list[str](), 0

    def receive(self, data: bytes) -> bytes:
        """Answer a command."""
        found = re.fullmatch(r"/(\d+) (\d) (\d\d) ?(.*):..\n", data.decode())
        assert found is not None, data
        words, said = found[4], "0"
        self._left = max(0, self._left - 1)
        if not self._left and self.place != self._target:
            self.place, self.flags, self.then = self._target, self.flags + self.then, []
        if words == "home":
            self.flags, self._target, self.place, self._left = [], 0, 1, 3
        elif words.startswith("move abs"):
            self._target, self._left = int(words.split()[2]), 3
        elif words.startswith("warnings"):
            said = " ".join([f"{len(self.flags):02d}", *self.flags])
            if words == "warnings clear":
                self.flags = [flag for flag in self.flags if flag in ("WR", "WH")]
        elif words == "get pos":
            said = str(self.place)
        elif words.startswith("get"):
            said = "7.28"
        state, flag = "BUSY" if self._left else "IDLE", self.flags[0] if self.flags else "--"
        content = f"{found[1]} {found[2]} {found[3]} OK {state} {flag} {said}"
        return f"@{content}:{-sum(content.encode()) & 0xFF:02X}\r\n".encode()


class TCube:
    """A TDC001, which gives 0 as its address (thorpy issue 10); messages as in the APT protocol, issue 25."""

    def __init__(self) -> None:
        self.place, self._target, self._left, self._speed = 5, 5, 0, 1000
        self.homed = self._homing = False

    def receive(self, data: bytes) -> bytes:
        """Answer messages."""
        said = b""
        while data:
            kind, length, to, _ = struct.unpack("<HHBB", data[:6])
            size = 6 + (length if to & 0x80 else 0)
            said, data = said + self._answer(kind, data[6:size]), data[size:]
        return said

    def _answer(self, kind: int, data: bytes) -> bytes:
        said = b""
        match kind:
            case 0x0005:
                said = struct.pack("<I8sH3Bx60sHHH", 83001234, b"TDC001", 44, 3, 0, 2, b"", 1, 0, 1)
            case 0x0443:
                self._target, self._left, self.homed, self._homing = 0, 3, False, True
            case 0x0453:
                self._target, self._left, self._homing = struct.unpack("<Hi", data)[1], 3, False
            case 0x0413:
                self._speed = struct.unpack("<Hiii", data)[3]
            case 0x0414:
                said = struct.pack("<Hiii", 1, 0, 1000, self._speed)
            case 0x0490:
                self._left = max(0, self._left - 1)
                if not self._left:
                    self.homed, self.place = self.homed or self._homing, self._target
                bits = 0x80000000 | (0x400 if self.homed else 0) | (0x10 if self._left else 0)
                said = struct.pack("<HihhI", 1, self.place, 0, 0, bits)
        return struct.pack("<HHBB", kind + 1, len(said), 0x81, 0) + said if said else b""
