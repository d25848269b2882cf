"""Driver of SCPI oscilloscopes: screen picture and waveforms, independent of the manufacturer."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from reseau.core.errors import DeadlineError, ProtocolError, RefusedError
from reseau.instruments import Deadline, Device, Identity, Limits, ScreenPicture, Settings, Waveform, quantity
from reseau.instruments.values import now

from ..codecs.ieee488 import LARGEST, Header, error_entry, missing_bytes, parse_block
from ..codecs.numbers import numbers
from ..codecs.stream import excerpt
from ..link import Link, SerialLink
from .dialects import MAKERS, Dialect, WaveformDialect, candidates_of, dialect_of, fields_of, samples_of

_TRIAL_S = 3.0
"""Time in which an instrument of an unknown model must send a picture."""
_LONGEST_LINE = 65536
_LINE = re.compile(rb"[\r\n\0]*(?:\xef\xbb\xbf)?([^\r\n\0]+)[\r\n\0]")
"""A line, after a byte order mark: it ends with LF, CR or NUL."""
_GREETINGS = re.compile("|".join(f"^({maker.greetings})" for maker in MAKERS if maker.greetings))


@dataclass(frozen=True)
class OscilloscopeSettings(Settings):
    """Settings of an oscilloscope: the channel of each reading.

    Examples
    --------
    >>> OscilloscopeSettings(channel=2).channel
    2
    """

    channel: int = quantity(1, "", 1, 8)


class Oscilloscope(Device[OscilloscopeSettings]):
    """Driver of an oscilloscope.

    Parameters
    ----------
    name : str
        Name on the bench.
    link : Link
        Link to the instrument.
    settings : OscilloscopeSettings
        Channel of readings.
    dialect : Dialect, optional
        By default, chosen by the answer to ``*IDN?``.
    seconds : float
        Time limit of calls that do not specify one (s); some instruments take ten seconds for a picture.
    limits : mapping, optional
        Limits of settings.

    Examples
    --------
    >>> from reseau_drivers.link import link_to
    >>> scope = Oscilloscope("scope", link_to("tcp://192.0.2.20:5025"))
    >>> scope.name, scope.dialect
    ('scope', None)
    """

    def __init__(
        self,
        name: str,
        link: Link,
        settings: OscilloscopeSettings | None = None,
        *,
        dialect: Dialect | None = None,
        seconds: float = 15.0,
        limits: Limits | None = None,
    ) -> None:
        super().__init__(name, settings or OscilloscopeSettings(), seconds=seconds, limits=limits)
        self._link, self._forced_dialect, self._dialect = link, dialect, dialect
        self._serial = isinstance(link, SerialLink)
        self._idn, self._received, self._answer_pending = "", bytearray(), False
        self._guessed = False

    @property
    def dialect(self) -> Dialect | None:
        """Dialect in use; None before the first connection."""
        return self._dialect

    def _open(self, deadline: Deadline) -> None:
        self._link.open(deadline)
        self._received.clear()
        self._dialect, self._guessed = self._forced_dialect, False
        if self._dialect is not None and not self._dialect.identifies:
            self._idn = f"{self._dialect.maker.maker},{self._dialect.name},"
            return
        self._send("*CLS", deadline)
        self._idn = self._query("*IDN?", deadline)
        if self._idn.count(",") < 2:
            raise ProtocolError(f"{self._idn!r} is not a valid answer to *IDN?")
        if self._dialect is None and (known := dialect_of(self._idn)) is None:
            self._dialect, self._guessed = self._asked(deadline), True
        elif self._dialect is None:
            self._dialect = known

    def _asked(self, deadline: Deadline) -> Dialect:
        """Find the dialect of an unknown model: that of a near relative in which it sends a picture."""
        asked = candidates_of(self._idn)
        for dialect in asked:
            if deadline.expired:
                break
            trial = deadline.part(_TRIAL_S)
            try:
                for command in dialect.setup:
                    self._send(command, trial)
                if self._picture_of(dialect, trial):
                    return dialect
            except (DeadlineError, ProtocolError):
                # What it may still say belongs to no later question.
                self._link.close()
                self._link.open(deadline)
                self._received.clear()
                self._answer_pending = False
                self._send("*CLS", deadline)
        names = ", ".join(repr(each.name) for each in asked[:3])
        raise ProtocolError(
            f"{self._idn!r} sends a picture in none of the dialects tried ({names}, …)",
            do="set the option dialect to the profile of a relative (`reseau bench profile`), or to a file",
        )

    def _disconnect(self) -> None:
        self._link.close()

    def _push(self, settings: OscilloscopeSettings, deadline: Deadline) -> None:
        for command in self._required_dialect.setup:
            self._send(command, deadline)

    def _identify(self, deadline: Deadline) -> Identity:
        maker, model, *rest = [part.strip() for part in self._idn.split(",", 3)]
        return Identity(maker, model, *rest)

    def _halt(self, deadline: Deadline) -> None:
        if self._required_dialect.halt:
            self._send(self._required_dialect.halt, deadline)

    def _acquire(self) -> dict[str, Any]:
        picture_ = self.screen()
        return {f"{self.name}_screen": picture_.frame(self.name).pixels}

    def _reading_format(self) -> dict[str, dict[str, Any]]:
        reading = self._reading.get(f"{self.name}_screen")
        shape = list(np.shape(reading["value"])) if reading else [0, 0]
        return {f"{self.name}_screen": {"dtype": "array", "shape": shape}}

    def _test(self, deadline: Deadline) -> dict[str, str]:
        found = {"dialect": self._required_dialect.name}
        if self._guessed:
            found["advice"] = f"its model has no profile; set dialect = {found['dialect']!r} to ask no more"
        if self._required_dialect.errors:
            with self._exchange("check", deadline.left) as time:
                number, text = error_entry(self._query(self._required_dialect.errors, time))
                found["error"] = f"{number} {text}".strip() if number else "none"
        return found

    def screen(self, seconds: float | None = None) -> ScreenPicture:
        """Return the picture of the screen.

        Raises
        ------
        InstrumentError
            If no complete picture arrives.
        """
        with self._exchange("screen", seconds) as deadline:
            asked = now()
            return ScreenPicture(self._picture_of(self._required_dialect, deadline), asked)

    def _picture_of(self, dialect: Dialect, deadline: Deadline) -> bytes:
        data = b""
        for step in dialect.screen:
            how, _, text = step.partition(" ")
            if how == "send":
                self._send(text.format(port="RS232" if self._serial else "GPIb"), deadline)
            elif how == "query":
                self._query(text, deadline)
            else:
                data = dialect.decode(self._fetch(text, deadline, dialect.missing))
        _verify_png(data)
        return data

    def waveform(self, channel: int = 1, seconds: float | None = None) -> Waveform:
        """Return the samples of a channel.

        Parameters
        ----------
        channel : int
            Number of the channel.
        seconds : float, optional
            Time limit (s).

        Raises
        ------
        RefusedError
            If waveforms are not supported for this family.
        InstrumentError
            If no complete waveform arrives.
        """
        self._settings.changed({"channel": channel}, self._limits)
        with self._exchange(f"waveform of channel {channel}", seconds) as deadline:
            dialect = self._required_dialect.waveform
            if dialect is None:
                raise RefusedError(f"waveforms of {self._required_dialect.name} are not supported")
            asked = now()
            for command in dialect.setup:
                self._send(command.format(n=channel), deadline)
            scale: dict[str, float] = {}
            for names, question in dialect.scale.items():
                asked_for = question.format(n=channel)
                scale |= _numbers(dialect, names, self._query(asked_for, deadline), asked_for)
            if dialect.preamble:
                scale |= fields_of(parse_block(self._fetch(dialect.preamble, deadline)), dialect)
            data = self._samples(dialect, scale, channel, deadline)
            if not data:
                raise ProtocolError(f"sent no samples of channel {channel}", do="switch the channel on")
            try:
                volts = samples_of(data, dialect, scale)
                start, step = float(dialect.start(scale)), float(dialect.step(scale))
                one, two = (dialect.volts({**scale, "code": code}) for code in (0.0, 1.0))
            except ZeroDivisionError:
                one = two = step = 0.0
            if not step > 0 or one == two:
                raise ProtocolError(f"the waveform has no extent in {'volts' if step > 0 else 'time'}")
            return Waveform(volts, start, step, channel, asked)

    def _samples(
        self, dialect: WaveformDialect, scale: dict[str, float], channel: int, deadline: Deadline
    ) -> bytes:
        """Return the samples of a waveform, from as many blocks as needed."""
        command, dtype = dialect.sampled(scale)
        if command:
            self._send(command, deadline)
        question = dialect.data.format(n=channel)
        if not dialect.piece:
            return parse_block(self._fetch(question, deadline))
        data, size = b"", np.dtype(dtype).itemsize
        wanted = size * int(scale["points"])
        if not 0 < wanted <= LARGEST:
            raise ProtocolError(f"announces {scale['points']:g} samples")
        while len(data) < wanted:
            self._send(dialect.piece.format(at=len(data) // size), deadline)
            piece = parse_block(self._fetch(question, deadline))
            if not piece:
                break
            data += piece
        return data

    def errors(self, seconds: float | None = None) -> list[str]:
        """Return and clear the entries of the error queue."""
        found: list[str] = []
        with self._exchange("errors", seconds) as deadline:
            while self._required_dialect.errors and len(found) < 100:
                number, text = error_entry(self._query(self._required_dialect.errors, deadline))
                if number == 0:
                    break
                found.append(f"{number} {text}")
        return found

    @property
    def _required_dialect(self) -> Dialect:
        if self._dialect is None:
            raise ProtocolError("has not been identified yet")
        return self._dialect

    def _send(self, text: str, deadline: Deadline) -> None:
        # Discard the rest of the last answer; the instrument would report it as interrupted.
        while self._answer_pending and self._link.pending() and not deadline.expired:
            self._link.read(deadline)
        self._answer_pending = False
        end = self._dialect.ends if self._dialect else "\n"
        self._link.write(f"{text}{end}".encode("ascii"), deadline)

    def _start_query(self, text: str, deadline: Deadline) -> None:
        self._received.clear()
        self._send(text, deadline)
        self._answer_pending = True

    def _query(self, text: str, deadline: Deadline) -> str:
        self._start_query(text, deadline)
        while True:
            line = _LINE.match(self._received)
            if line is not None:
                said, greeted = _GREETINGS.subn("", line[1].strip().decode("latin-1"))
                self._require_willing(said)
                if said or not greeted:
                    return said
                del self._received[: line.end()]
                continue
            if len(self._received) > _LONGEST_LINE:
                raise ProtocolError(f"the answer to {text} does not end: {excerpt(bytes(self._received))}")
            self._receive(deadline, text)

    def _require_willing(self, said: str) -> None:
        """Raise if an instrument answers that it does not answer."""
        for text, do in ((text, do) for maker in MAKERS for text, do in maker.refusals.items()):
            if text in said:
                raise ProtocolError(f"refuses: {excerpt(said.encode())}", do=do)

    def _fetch(
        self, text: str, deadline: Deadline, missing: Callable[[bytes, bool], int | None] | None = None
    ) -> bytes:
        """Return a block or picture, or what a function on missing bytes takes for whole."""
        self._start_query(text, deadline)
        lacking: int | None = None
        while True:
            # Parse again only when the missing bytes have arrived: a picture is large.
            if self._received and not lacking:
                start = 0 if missing else _start_of_binary(self._received)
                ended = getattr(self._link, "ended", False)
                try:
                    lacking = (missing or missing_bytes)(bytes(self._received[start:]), ended)
                except ProtocolError:
                    self._require_willing(self._received[:200].decode("latin-1"))
                    raise
                if lacking == 0:
                    return bytes(self._received[start:])
            before = len(self._received)
            self._receive(deadline, text)
            if lacking:
                lacking = max(0, lacking - (len(self._received) - before))
            if len(self._received) > LARGEST:
                raise ProtocolError(f"the answer to {text} does not end")

    def _receive(self, deadline: Deadline, text: str) -> None:
        if deadline.expired:
            if self._received:
                raise ProtocolError(f"the answer to {text} broke off after {len(self._received)} bytes")
            silent = self._dialect.silent if self._dialect else ""
            raise DeadlineError(
                f"{text} was not answered within {deadline.seconds:g} s",
                do=f"it {silent}" if silent else "check whether it is busy or its screen is locked",
            )
        self._received += self._link.read(deadline)


def _start_of_binary(data: bytearray) -> int:
    """Return the start of the block: after newlines, or after a word such as ``DAT2,``."""
    start = len(data) - len(data.lstrip(b"\r\n"))
    sign = data.find(b"#", start, start + 40)
    word = bytes(data[start:sign]) if sign > start else b""
    return sign if word.endswith(b",") and word.isascii() else start


def _numbers(dialect: WaveformDialect, names: str, answer: str, question: str) -> dict[str, float]:
    """Parse an answer, which may repeat the header of its question, into numbers by name."""
    wanted = names.split()
    header, space, rest = answer.partition(" ")
    if space and header[:1].isalpha() and Header(question).matches(f"{header}?"):
        answer = rest
    counts = (len(wanted) + each for each in dialect.more)
    found = numbers(answer, *counts, unit=dialect.units.get(names, ""), to=question)
    return {name: value for name, value in zip(wanted, found, strict=True) if name != "-"}


def _verify_png(data: bytes) -> None:
    """Raise ProtocolError if the checksum of a PNG chunk is wrong (ISO 15948, 5.3)."""
    at = 8
    while data[:2] != b"BM" and at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        end = at + 8 + length
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise ProtocolError("the picture was damaged in transmission")
        at = end + 4
