"""Controllers written from manuals and public reports, not from the drivers, and the wire to them.

Movements take a number of queries, not of seconds.
"""

from __future__ import annotations

import re
import struct
import time
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau.instruments import Deadline

__all__ = [
    "GrblBoard", "Lines", "MarlinBoard", "NewportStage", "Receiver", "Screen", "Spoiled", "TCube",
    "Transcript", "Wire", "ZaberStage", "transcripts"
]  # fmt: skip


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


class Screen:
    """A screen of random colours, and the bytes in which an instrument keeps it.

    Parameters
    ----------
    kind : str
        png, bmp, bytes of colours, or runs of colours.
    seed : int
        Of the colours.
    """

    def __init__(self, kind: str = "png", seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.colours: NDArray[np.uint8]
        match kind:
            case "bytes of colours":  # red in the highest two bits, green in three, blue in three
                value = rng.integers(0, 256, (234, 320), dtype=np.uint8)
                self.colours = np.stack([value << 5, (value & 0x38) << 2, value & 0xC0], axis=-1)
                self.data = value.tobytes()
            case "runs of colours":  # 5, 6 and 5 bits
                value = rng.integers(0, 1 << 16, 480).astype("<u2")
                line = np.stack([value << 3 & 0xF8, value >> 3 & 0xFC, value >> 8 & 0xF8], axis=-1)
                self.colours = np.repeat(line.astype(np.uint8)[:, None], 800, axis=1)
                self.data = np.stack([np.full(480, 800, "<u2"), value], axis=1).tobytes()
            case "words":  # red in the highest five bits, green in six, blue in five
                value = np.repeat(rng.integers(0, 1 << 16, (480, 80)).astype("<u2"), 10, axis=1)
                parts = [value << 3 & 0xF8, value >> 3 & 0xFC, value >> 8 & 0xF8]
                self.colours, self.data = np.stack(parts, axis=-1).astype(np.uint8), value.tobytes()
            case "codes":  # of four colours of the table of dsoc
                table = {0: (0, 0, 0), 35: (0, 255, 255), 131: (187, 187, 187), 255: (255, 255, 255)}
                value = rng.choice(np.array(list(table), np.uint8), (480, 800))
                self.colours = np.zeros((480, 800, 3), np.uint8)
                for code, colour in table.items():
                    self.colours[value == code] = colour
                self.data = value.tobytes()
            case _:
                self.colours = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
                self.data = bytes(cv2.imencode(f".{kind}", self.colours)[1])

    def shows(self, picture: bytes) -> bool:
        """Whether a picture is of this screen."""
        found = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
        return found is not None and found.shape == self.colours.shape and bool((found == self.colours).all())


class Transcript:
    """An oscilloscope that does what ``transcripts.toml`` says.

    Parameters
    ----------
    told : mapping
        One of its instruments.
    """

    def __init__(self, told: Mapping[str, Any]) -> None:
        self.told, self.screen = told, Screen(told.get("picture", "png"))
        self.violations = list[str]()
        self._line = b""
        self.reset()

    def reset(self) -> None:
        """Switch it off and on."""
        self._heard, self._file = set[str](), ""

    def receive(self, data: bytes) -> bytes:
        """Answer the lines that end in these bytes."""
        if self.told.get("ends") == "":
            return self._answer(data.decode("latin-1"))
        *lines, self._line = (self._line + data).split(b"\n")
        return b"".join(self._answer(line.decode().strip()) for line in lines)

    def _answer(self, line: str) -> bytes:
        identity = self.told["identity"]
        if identity and line in ("*IDN?", "*CLS", "*OPC?"):
            return {"*IDN?": f"{identity}\n".encode(), "*OPC?": b"1\n"}.get(line, b"")
        for name, heard, *rest in self.told["lines"]:
            if (found := re.fullmatch(heard, line, re.IGNORECASE)) is None:
                continue
            file = found.groupdict().get("file", self._file)
            if set(rest[1:]) - self._heard or (name == "read" and file != self._file):
                return b""
            self._heard = self._heard - {name[1:]} if name[0] == "-" else self._heard | {name}
            self._file = file
            return self._said(rest[0]) if rest else b""
        self.violations.append(line)
        return b""

    def _said(self, text: str) -> bytes:
        picture = self.screen.data
        length = str(len(picture)).encode()
        parts = {
            "picture": picture,
            "block": b"#%d%b%b" % (len(length), length, picture),
            "length": struct.pack("<I", len(picture)),
            "packets": b"".join(
                [_packet(b"\xa0\x01" + picture[k : k + 10000]) for k in range(0, len(picture), 10000)]
                + [_packet(bytes([0xA0, 2, sum(picture) & 0xFF]))]
            ),
        }
        found = b""
        for part in re.split(r"(\{[^}]+\})", text):
            inner = part[1:-1]
            if part[:1] != "{":
                found += part.encode()
            else:
                found += bytes.fromhex(inner[4:]) if inner[:4] == "hex " else parts[inner]
        return found


def _packet(content: bytes) -> bytes:
    """Das Oszi Protocol: S, length of what follows, content, sum."""
    head = b"S" + struct.pack("<H", len(content) + 1) + content
    return head + bytes([sum(head) & 0xFF])


def transcripts() -> list[dict[str, Any]]:
    """The oscilloscopes of ``transcripts.toml``."""
    told = tomllib.loads(Path(__file__).with_name("transcripts.toml").read_text("utf-8"))["instruments"]
    return list(told)


class Spoiled(Wire):
    """A wire on which answers are spoiled at random, as a protocol can reveal.

    Parameters
    ----------
    there : Transcript
        The other end.
    rng : Generator
        Chooses the faults.
    rate : float
        Fraction of answers with a fault.

    Attributes
    ----------
    faults : list of str
        What happened.
    """

    KINDS = ("truncated", "delayed", "dropped", "repeated", "stale", "reordered", "reset", "bad checksum")

    def __init__(self, there: Any, rng: np.random.Generator, rate: float) -> None:
        super().__init__(there)
        self._rng, self.rate, self.faults, self.kinds = rng, rate, list[str](), self.KINDS
        self._late, self._last, self._surplus = b"", b"", b""

    def open(self, deadline: Deadline) -> None:
        """Open it anew: what was under way is lost."""
        super().open(deadline)
        self._late = self._surplus = b""

    def write(self, data: bytes, deadline: Deadline) -> None:
        """Pass the bytes on; what was delayed arrives before the answer."""
        said = self.there.receive(data)
        late, self._late = self._late, b""
        if said and self._rng.random() < self.rate:
            said = self._spoiled(said)
        self.said += late + said
        self._last = said or self._last

    def read(self, deadline: Deadline) -> bytes:
        """Return the answer; what is stale arrives behind it."""
        said = super().read(deadline)
        self.said, self._surplus = self.said + self._surplus, b""
        return said

    def _spoiled(self, said: bytes) -> bytes:
        # A line of text has neither length nor checksum: its parts in another order may be another number.
        summed = b"IDAT" in said or said[:1] == b"@" or said[3:4] == b"\xa0"
        hidden = set() if summed or b"#" in said or b"BM" in said else {"reordered"}
        hidden |= set() if summed else {"bad checksum"}
        kinds = [kind for kind in self.kinds if kind not in hidden]
        kind = kinds[self._rng.integers(len(kinds))]
        self.faults.append(kind)
        at = int(self._rng.integers(1, max(2, len(said))))
        match kind:
            case "truncated":
                return said[:at] if at < len(said) else b""
            case "delayed":
                self._late = said
                return b""
            case "dropped":
                return b""
            case "repeated":
                return said + said
            case "stale":
                self._surplus = self._last or said
                return said
            case "reordered":
                return said[at:] + said[:at]
            case "reset":
                return self.there.reset() or b""
        start = said.index(b"IDAT") + 4 if b"IDAT" in said else 1
        at = start + int(self._rng.integers(max(1, len(said) - start - (20 if start > 1 else 6))))
        return said[:at] + bytes([said[at] ^ 1 << int(self._rng.integers(8))]) + said[at + 1 :]


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
        self.off = 0.0
        """Where the motor stands when it counts 0."""
        self.ends: Callable[[], bytes] = lambda: b""
        """What happens, and is said, in the midst of the next movement."""
        self.answers: dict[str, bytes] = {}
        """Other answers to lines."""
        self.homes = "$H"
        self.start()

    def start(self) -> bytes:
        """Switch it off and on: positions are those of the motors no more."""
        self.homed = False
        return self._begin()

    def reset(self) -> bytes:
        """Switch it off and on; it counts from 0 where it stands. Its banner is lost if a status tells."""
        self.place, self.off = 0.0, self.off + self.place
        said = self.start()
        return b"" if self.locks or self.tells or "FluidNC" not in self.version else said

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
                    self.homed, self.off, said = True, 0.0, said + b"ok\r\n"
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
        if line == self.homes:
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
        self.place = self._target = self.off = 0
        self.flags, self.then, self._left = ["WR"], list[str](), 0

    def reset(self) -> None:
        """Switch it off and on: it counts from 0 where it stands."""
        self.off, self.place, self._target, self.flags, self._left = self.off + self.place, 0, 0, ["WR"], 0

    def receive(self, data: bytes) -> bytes:
        """Answer a command."""
        found = re.fullmatch(r"/(\d+) (\d) (\d\d) ?(.*):..\n", data.decode())
        assert found is not None, data
        words, said = found[4], "0"
        self._left = max(0, self._left - 1)
        if not self._left and self.place != self._target:
            self.place, self.flags, self.then = self._target, self.flags + self.then, []
        if words == "home":
            self.flags, self._target, self.place, self._left, self.off = [], 0, 1, 3, 0
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
        self.place, self._target, self._left, self._speed, self.off = 5, 5, 0, 1000, 0
        self.homed = self._homing = False
        self.bits: int | None = None

    def reset(self) -> None:
        """Switch it off and on: it counts from 0 where it stands."""
        self.off, self.place, self._target, self._left = self.off + self.place, 0, 0, 0
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
                    self.off = 0 if self._homing else self.off
                bits = 0x80000000 | (0x400 if self.homed else 0) | (0x10 if self._left else 0)
                said = struct.pack("<HihhI", 1, self.place, 0, 0, bits if self.bits is None else self.bits)
        return struct.pack("<HHBB", kind + 1, len(said), 0x81, 0) + said if said else b""


class NewportStage:
    """One SMC100CC with a stage; positions in its unit.

    Sources: Newport, SMC100CC & SMC100PP User's Manual (commands OR, PA, ST, MM, VA, TE, TP, TS, VE: states
    0A to 3E, what is allowed in each; TE reports an error once), and its states as drivers of bliss, qmi and
    pyvisa users list them. Commands are answered only if they ask; the home position is at 0.
    """

    def __init__(self) -> None:
        self.place = self.off = 0.0
        self.start()

    def start(self) -> None:
        """Switch it on: it is not referenced."""
        self._state, self._error, self._line = 0x0A, "@", b""
        self._left, self._target, self._then = 0, self.place, 0x0A

    def reset(self) -> None:
        """Switch it off and on; it counts from 0 where it stands."""
        self.off, self.place = self.off + self.place, 0.0
        self.start()

    def receive(self, data: bytes) -> bytes:
        """Answer the lines that end in these bytes."""
        *lines, self._line = (self._line + data).split(b"\r\n")
        return b"".join(self._answer(line.decode()) for line in lines)

    def _answer(self, line: str) -> bytes:
        found = re.fullmatch(r"1([A-Z]{2})(.*)", line)
        if found is None:
            self._error = "A"
            return b""
        name, value = found[1], found[2]
        said = {"TE": self._error, "VE": " SMC_CC_01-11-02", "TP": f"{self.place:.7f}"}.get(name)
        if name == "TS":
            self._advance()
            said = f"0000{self._state:02X}"
        if name == "TE":
            self._error = "@"
        if said is not None:
            return f"1{name}{said}\r\n".encode()
        self._obey(name, value)
        return b""

    def _advance(self) -> None:
        self._left = max(0, self._left - 1)
        if not self._left and self._state in (0x1E, 0x28):
            if self._state == 0x1E:
                self.off = 0.0
            self._state, self.place = self._then, self._target

    def _obey(self, name: str, value: str) -> None:
        referenced, ready = self._state >= 0x28, 0x32 <= self._state <= 0x35
        refusals = {0x0: "H", 0x1: "H" if self._state < 0x14 else "L", 0x2: "M", 0x3: "J"}
        refused = refusals[self._state >> 4]
        match name:
            case "OR" if self._state < 0x14:
                self._state, self._left, self._target, self._then = 0x1E, 3, 0.0, 0x32
            case "PA" if ready:
                if abs(float(value)) > 180:
                    self._error = "G"
                else:
                    self._state, self._left, self._target, self._then = 0x28, 3, float(value), 0x33
            case "VA" if ready or self._state >= 0x3C:
                pass
            case "ST" if self._state == 0x28:
                self._target, self._left = (self.place + self._target) / 2, 1
            case "ST" if referenced:
                pass
            case "MM" if ready or self._state >= 0x3C:
                self._state = 0x34 if value == "1" else 0x3C
            case _:
                self._error = "K" if ready else refused


class MarlinBoard:
    """A board with Marlin 2 of one axis, with 80 steps per millimetre.

    Sources: marlinfw.org, G-code (G28, M92, M110, M114, M115, M220, M410); RepRap wiki, G-code, Checking; the
    threads and logs of OctoPrint that quote ``Error:Line Number is not Last Line Number+1``, ``Resend:``,
    ``echo:busy: processing``, and of M114 with ``Count``. What M114 says before it is the target; the
    steps are those that were made. After a start it counts from 0 where it stands.
    """

    STEPS = 80

    def __init__(self) -> None:
        self.place, self.off = 0.0, 7.0
        self.start()

    def start(self) -> bytes:
        """Switch it on."""
        self._last, self._percent, self._line = 0, 100, b""
        self._target, self._left, self._homes = self.place, 0, False
        return b"start\necho:Marlin 2.1.2\n"

    def reset(self) -> bytes:
        """Switch it off and on; its words at a start are lost."""
        self.place, self.off = 0.0, self.off + self.place
        self.start()
        return b""

    def receive(self, data: bytes) -> bytes:
        """Answer the lines that end in these bytes."""
        *lines, self._line = (self._line + data).split(b"\n")
        return b"".join(self._take(line.strip()) for line in lines if line.strip())

    def _take(self, line: bytes) -> bytes:
        content, star, told = line.rpartition(b"*")
        if not star:
            return self._obey(line.decode())
        found, check = re.match(rb"N(\d+) ?(.*)", content), 0
        for value in content:
            check ^= value
        if found is None or not told.isdigit() or int(told) != check:
            return self._again("checksum mismatch")
        number, words = int(found[1]), found[2].decode()
        if words.startswith("M110"):
            self._last = number
            return b"ok\n"
        if number != self._last + 1:
            return self._again("Line Number is not Last Line Number+1")
        self._last = number
        return self._obey(words)

    def _again(self, why: str) -> bytes:
        return f"Error:{why}, Last Line: {self._last}\nResend: {self._last + 1}\nok\n".encode()

    def _obey(self, words: str) -> bytes:
        name, *rest = words.split()
        said = ""
        match name:
            case "M114":
                self._left = max(0, self._left - 1)
                self.place = self.place if self._left else self._target
                counts = round(self.place * self.STEPS)
                said = f"X:{self._target:.2f} Y:0.00 Z:0.00 E:0.00 Count X:{counts} Y:0 Z:0\n"
            case "M115":
                said = (
                    "FIRMWARE_NAME:Marlin 2.1.2 (Jan  1 2023 00:00:00) MACHINE_TYPE:Table EXTRUDER_COUNT:1\n"
                )
            case "M92":
                said = f"echo:  M92 X{self.STEPS}.00 Y80.00 Z400.00 E93.00\n"
            case "M220" if rest:
                self._percent = int(rest[0][1:])
            case "M220":
                said = f"FR:{self._percent}%\n"
            case "G28":
                self.place = self._target = self.off = 0.0
                self._left = 0
                said = "echo:busy: processing\nX:0.00 Y:0.00 Z:0.00 E:0.00 Count X:0 Y:0 Z:0\n"
            case "G1":
                self._target, self._left = float(rest[0][1:]), 3
            case "M410":
                self._target, self._left = (self.place + self._target) / 2, 1
            case "G21" | "G90" | "M84":
                pass
            case _:
                said = f'echo:Unknown command: "{words}"\n'
        return f"{said}ok\n".encode()
