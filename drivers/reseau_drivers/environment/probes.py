"""Ways to ask a sensor: SCPI queries, registers of Modbus, lines of text."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Literal

from reseau.core.errors import DeadlineError, ProtocolError, SettingError
from reseau.instruments import Deadline, Identity

from ..codecs import modbus
from ..codecs.numbers import number
from ..codecs.sentence import Sentence
from ..codecs.stream import LineDecoder
from ..link import Link, MessageLink

Framing = Literal["rtu", "tcp"]

_LONGEST = 512


class ScpiProbe:
    """Asks with a query for each quantity.

    Parameters
    ----------
    link : Link
        Link to the sensor.
    queries : mapping of str to str
        Query of each quantity, as ``MEAS:TEMP?``.
    answer_s : float
        Time limit of an answer (s).
    units : mapping of str to str
        Unit that may follow the number of a quantity; without an entry any word.

    Raises
    ------
    SettingError
        If a query is none.

    Examples
    --------
    >>> from reseau_drivers.link import TcpLink
    >>> ScpiProbe(TcpLink("127.0.0.1", 5025), {"temperature": "MEAS:TEMP"})
    Traceback (most recent call last):
        ...
    reseau.core.errors.SettingError: quantity temperature: 'MEAS:TEMP' is no query; write MEAS:TEMP?
    """

    checked = False

    def __init__(
        self,
        link: Link,
        queries: Mapping[str, str],
        answer_s: float = 1.0,
        units: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        for name, query in queries.items():
            if not query.isascii() or not query.isprintable() or "?" not in query:
                raise SettingError(f"{query!r} is no query", where=f"quantity {name}", do="write MEAS:TEMP?")
        self._link: MessageLink[bytes] = MessageLink(link, LineDecoder(limit=_LONGEST))
        self._queries, self._answer_s, self._units = dict(queries), answer_s, dict(units)
        self._synchronised = False

    def open(self, deadline: Deadline) -> None:
        """Open the connection."""
        self._link.open(deadline)
        self._synchronised = False

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def identify(self, deadline: Deadline) -> Identity:
        """Return the answer to ``*IDN?``."""
        line = self._ask("*IDN?", lambda line: line.count(b",") >= 3, deadline)
        parts = [part.strip() for part in line.decode("ascii", "replace").split(",", 3)]
        self._synchronised = True
        return Identity(*parts)

    def numbers(self, deadline: Deadline) -> dict[str, float]:
        """Return the numbers of the sensor by quantity."""
        if not self._synchronised:
            # Answers arrive in order: after that to *IDN? no answer to an earlier query is left.
            self.identify(deadline)
        return {name: self._number(name, query, deadline) for name, query in self._queries.items()}

    def _number(self, name: str, query: str, deadline: Deadline) -> float:
        said = self._ask(query, lambda line: True, deadline)
        try:
            text = said.decode("utf-8")
        except UnicodeDecodeError:
            text = said.decode("latin-1")
        return number(text, self._units.get(name), to=query)

    def _ask(self, query: str, is_answer: Callable[[bytes], bool], deadline: Deadline) -> bytes:
        return self._link.query(query.encode("ascii") + b"\n", is_answer, deadline.part(self._answer_s))


class LineProbe:
    """Reads a line that the sensor sends again and again, or upon a query.

    Parameters
    ----------
    link : Link
        Link to the sensor.
    sentence : Sentence
        The line.
    query : str
        What is sent to get the line, with ``\\r`` and ``\\n`` where they belong; empty: it comes by itself.
    checked : bool
        Whether the line has a checksum.
    answer_s : float
        Time limit of a line (s).

    Raises
    ------
    SettingError
        If the query is not ASCII.

    Examples
    --------
    >>> from reseau_drivers.link import TcpLink
    >>> LineProbe(TcpLink("127.0.0.1", 4001), Sentence(r"T=(?P<temperature>[-.0-9]+)")).checked
    False
    """

    def __init__(
        self, link: Link, sentence: Sentence, query: str = "", *, checked: bool = False, answer_s: float = 2.5
    ) -> None:
        if not query.isascii():
            raise SettingError("must be ASCII", where="query")
        self._link: MessageLink[bytes] = MessageLink(link, LineDecoder(limit=_LONGEST))
        self._sentence, self._query = sentence, query.encode("ascii")
        self.checked, self._answer_s = checked, answer_s

    def open(self, deadline: Deadline) -> None:
        """Open the connection."""
        self._link.open(deadline)

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def identify(self, deadline: Deadline) -> Identity:
        """Return the form of the lines: they do not name the sensor."""
        self.numbers(deadline)
        return Identity("sensor", "text line")

    def numbers(self, deadline: Deadline) -> Mapping[str, float]:
        """Return the numbers of the next line."""
        found: list[Mapping[str, float]] = []
        wrong: list[ProtocolError] = []

        def has_values(line: bytes) -> bool:
            try:
                found.append(self._sentence.values(line))
            except ProtocolError as error:
                wrong.append(error)
                # The first line of one that sends by itself may be the rest of one.
                return bool(self._query) or len(wrong) > 1
            return True

        try:
            self._link.query(self._query, has_values, deadline.part(self._answer_s))
        except DeadlineError:
            if wrong:
                raise wrong[-1] from None
            raise
        if not found:
            raise wrong[-1]
        return found[-1]


class Register:
    """A number in registers of a device.

    Parameters
    ----------
    register : int
        Address of the first register, from 0: the manuals' 30001 and 40001 are 0.
    function : {3, 4}
        Function that reads it: 3 holding registers, 4 input registers.
    format : str
        int16, uint16, int32, uint32, float32 or float64.
    words : {"big", "little"}
        Order of the registers of a number.

    Raises
    ------
    SettingError
        If format, order or function do not exist.

    Examples
    --------
    >>> Register(256, format="float32").count
    2
    """

    def __init__(
        self, register: int, function: int = 4, format: str = "int16", words: modbus.WordOrder = "big"
    ) -> None:
        if format not in modbus.FORMATS or words not in ("big", "little"):
            formats = ", ".join(modbus.FORMATS)
            raise SettingError(f"formats are {formats}; words big or little", where=f"register {register}")
        self.register, self.function, self.format, self.words = register, function, format, words
        self.count = len(modbus.words_of(0.0, format))
        modbus.encode_read(function, register, self.count)


class ModbusProbe:
    """Reads registers: with one request where they lie close together.

    Parameters
    ----------
    link : Link
        Link to the line, or to the device.
    registers : mapping of str to Register
        Registers of each quantity.
    unit : int
        Address of the device.
    framing : {"rtu", "tcp"}
        Frames of serial lines, or of TCP.
    answer_s : float
        Time limit of an answer (s).

    Raises
    ------
    SettingError
        If there is no such address or framing.

    Examples
    --------
    >>> from reseau_drivers.link import TcpLink
    >>> ModbusProbe(TcpLink("127.0.0.1", 502), {}, unit=300, framing="tcp")
    Traceback (most recent call last):
        ...
    reseau.core.errors.SettingError: unit: 300 is not 1…247
    """

    SPAN = 16
    """Largest distance of registers that are read together."""

    def __init__(
        self,
        link: Link,
        registers: Mapping[str, Register],
        unit: int = 1,
        framing: Framing = "rtu",
        answer_s: float = 1.0,
    ) -> None:
        if not 1 <= unit <= 247:
            raise SettingError(f"{unit} is not 1…247", where="unit")
        if framing not in ("rtu", "tcp"):
            raise SettingError(f"{framing!r} is not one of rtu, tcp", where="framing")
        self._tcp = framing == "tcp"
        decoder = modbus.TcpDecoder() if self._tcp else modbus.RtuDecoder()
        self._link: MessageLink[modbus.Frame] = MessageLink(link, decoder)
        self._registers, self._unit, self._answer_s = dict(registers), unit, answer_s
        self._blocks = _blocks(list(registers.values()), self.SPAN)
        self._transaction, self._synchronised = 0, False

    @property
    def checked(self) -> bool:
        """Whether a turned bit and a confusion of answers are noticed.

        Frames of TCP have no checksum of their own, and answers on a line no number.
        """
        return not self._tcp and len(self._blocks) == 1

    def open(self, deadline: Deadline) -> None:
        """Open the connection."""
        self._link.open(deadline)
        self._synchronised = False

    def close(self) -> None:
        """Close the connection."""
        self._link.close()

    def identify(self, deadline: Deadline) -> Identity:
        """Return the address: a device needs not tell more."""
        self.numbers(deadline)
        return Identity("Modbus", f"unit {self._unit}")

    def numbers(self, deadline: Deadline) -> dict[str, float]:
        """Return the numbers in the registers of each quantity."""
        if not self._tcp and not self._synchronised:
            self._synchronise(deadline)
        held: dict[tuple[int, int], int] = {}
        for function, first, count in self._blocks:
            answer = self._ask(modbus.encode_read(function, first, count), deadline)
            for k, word in enumerate(modbus.decode_registers(answer, function, count)):
                held[function, first + k] = word
        return {
            name: modbus.number([held[r.function, r.register + k] for k in range(r.count)], r.format, r.words)
            for name, r in self._registers.items()
        }

    def _synchronise(self, deadline: Deadline) -> None:
        """Discard late answers: on a line they have no number, but arrive in order.

        Of the diagnostic request, which only this sends, every device sends an echo or refuses it; one that
        ignores what it does not know has by then been silent for the time of an answer.
        """
        self._transaction = (self._transaction + 1) % 0x10000
        try:
            self._ask(modbus.encode_echo(self._transaction), deadline)
        except DeadlineError:
            if deadline.expired:
                raise
        self._synchronised = True

    def _ask(self, pdu: bytes, deadline: Deadline) -> bytes:
        if self._tcp:
            self._transaction = (self._transaction + 1) % 0x10000
        number = self._transaction if self._tcp else None
        asked = modbus.Frame(self._unit, pdu, number)

        def answers(frame: modbus.Frame) -> bool:
            return (frame.unit, frame.function, frame.transaction) == (self._unit, asked.function, number)

        return self._link.query(modbus.encode(asked), answers, deadline.part(self._answer_s)).pdu


def _blocks(registers: list[Register], span: int) -> list[tuple[int, int, int]]:
    """Function, first register and count of the requests for some registers."""
    found: list[tuple[int, int, int]] = []
    for each in sorted(registers, key=lambda each: (each.function, each.register)):
        end = each.register + each.count
        if found and found[-1][0] == each.function and end - found[-1][1] <= span:
            function, first, count = found[-1]
            found[-1] = function, first, max(count, end - first)
        else:
            found.append((each.function, each.register, each.count))
    return found
