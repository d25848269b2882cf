"""Program messages of IEEE 488.2 and SCPI as an instrument reads them: headers, parameters, registers.

Source: IEEE 488.2-1992, sections 7.7 (program data) and 11 (status reporting); SCPI 1999.0, volume 1,
sections 6.2 (headers, and the path that a semicolon keeps) and 7 (numbers with suffixes, MINimum, booleans).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from reseau_drivers.codecs.ieee488 import Header, split_message

Parameter = Callable[[str], str]
"""Reads a parameter, returns it as the query reports it; raises ValueError with an error entry."""
_NUMBER = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:\s*E\s*[+-]?\d+)?)\s*([A-Z%]*)")
_POWERS = {
    "EX": 1e18, "PE": 1e15, "T": 1e12, "G": 1e9, "MA": 1e6, "K": 1e3, "": 1.0, "M": 1e-3, "U": 1e-6,
    "N": 1e-9, "P": 1e-12, "F": 1e-15, "A": 1e-18,
}  # fmt: skip
_BASES = {"H": 16, "Q": 8, "B": 2}
_ESB, _MAV, _MSS, _ERROR = 0x20, 0x10, 0x40, 0x04
_DEEP, _OVERFLOW = 30, '-350,"Queue overflow"'
_POWER_ON, _COMPLETE, _QUERY = 0x80, 0x01, 0x04


def units_of(text: str) -> Iterator[tuple[str, str]]:
    """Headers, from the root, and arguments of a program message.

    After a semicolon a header without a leading colon continues the path of the one before; common commands
    (``*OPC?``) leave the path as it is.

    Examples
    --------
    >>> list(units_of(":WAV:SOUR CHAN1;FORM BYTE;*OPC?;DATA?;:STOP"))
    [('WAV:SOUR', 'CHAN1'), ('WAV:FORM', 'BYTE'), ('*OPC?', ''), ('WAV:DATA?', ''), ('STOP', '')]
    """
    path = ""
    for header, arguments in split_message(text):
        if header.startswith("*"):
            yield header, arguments
            continue
        whole = header[1:] if header.startswith(":") else path + header
        path = whole[: whole.rfind(":") + 1]
        yield whole, arguments


def choice(*written: str) -> Parameter:
    """A parameter of some keywords, in their short or long form; others are refused.

    Examples
    --------
    >>> choice("NORMal", "RAW")("normal")
    'NORM'
    """

    def read(text: str) -> str:
        for each in written:
            if Header(each).matches(text.strip()):
                return "".join(c for c in each if not c.islower())
        raise ValueError('-224,"Illegal parameter value"')

    return read


def boolean(text: str) -> str:
    """ON, OFF, or a number that is rounded.

    Examples
    --------
    >>> boolean("on"), boolean("0")
    ('1', '0')
    """
    upper = text.strip().upper()
    if upper in ("ON", "OFF"):
        return str(int(upper == "ON"))
    try:
        return str(int(round(float(upper)) != 0))
    except ValueError:
        raise ValueError('-224,"Illegal parameter value"') from None


def numeric(unit: str = "", low: float = -1e30, high: float = 1e30, default: float = 0.0) -> Parameter:
    """A number with an optional suffix, or MINimum, MAXimum, DEFault, within limits.

    Examples
    --------
    >>> volts = numeric("V", 1e-3, 10.0, 1.0)
    >>> volts("100 mV"), volts("MAX"), volts(".5"), volts("#H2")
    ('1.000000E-01', '1.000000E+01', '5.000000E-01', '2.000000E+00')
    """
    named = {"MINimum": low, "MAXimum": high, "DEFault": default}

    def value(text: str) -> float:
        for written, number in named.items():
            if Header(written).matches(text):
                return number
        if text[:1] == "#" and text[1:2] in _BASES:
            return float(int(text[2:], _BASES[text[1]]))
        found = _NUMBER.fullmatch(text)
        if found is None:
            raise ValueError('-104,"Data type error"')
        suffix = found[2]
        if suffix and not (unit and suffix.endswith(unit)):
            raise ValueError('-131,"Invalid suffix"')
        power = suffix[: len(suffix) - len(unit)] if suffix else ""
        # A megahertz is MHZ, against the rule that M is a thousandth.
        scale = 1e6 if power == "M" and unit in ("HZ", "OHM") else _POWERS.get(power)
        if scale is None:
            raise ValueError('-131,"Invalid suffix"')
        return float(found[1].replace(" ", "")) * scale

    def read(text: str) -> str:
        try:
            number = value(text.strip().upper())
        except ValueError as error:
            raise ValueError(str(error) if str(error)[:1] == "-" else '-104,"Data type error"') from None
        if not low <= number <= high:
            raise ValueError('-222,"Data out of range"')
        return f"{number:.6E}"

    return read


def string(text: str) -> str:
    """Text in single or double quotes.

    Examples
    --------
    >>> string("'C:/a;b.png'")
    'C:/a;b.png'
    """
    found = re.fullmatch(r"\s*(?:\"([^\"]*)\"|'([^']*)')\s*", text)
    if found is None:
        raise ValueError('-151,"Invalid string data"')
    return found[1] if found[1] is not None else found[2]


@dataclass(frozen=True)
class Setting:
    """A setting that is sent, and asked with a question mark.

    Parameters
    ----------
    written : str
        Header as in a manual.
    read : callable
        Reads its parameter.
    value : str
        Value after a reset.

    Examples
    --------
    >>> Setting(":TIMebase:SCALe", numeric("S"), "1.000000E-03").matches("tim:scal?")
    True
    """

    written: str
    read: Parameter
    value: str

    def matches(self, header: str) -> bool:
        """Whether a received header is the command or the query."""
        return Header(self.written).matches(header.removesuffix("?"))


@dataclass
class Status:
    """Registers and error queue of IEEE 488.2.

    Examples
    --------
    >>> status = Status()
    >>> status.error('-113,"Undefined header"')
    >>> status.common("*ESR?", ""), status.common("*ESR?", ""), status.next_error()
    ('160', '0', '-113,"Undefined header"')
    """

    esr: int = _POWER_ON
    ese: int = 0
    sre: int = 0
    errors: list[str] = field(default_factory=list)
    _requested: int = 0

    def error(self, entry: str) -> None:
        """Add an entry to the queue, and set its bit: command, execution, device or query error."""
        self.errors = [*self.errors, entry] if len(self.errors) < _DEEP else [*self.errors[:-1], _OVERFLOW]
        kind = int(entry.split(",")[0]) // -100
        self.esr |= {1: 0x20, 2: 0x10, 3: 0x08, 4: _QUERY}.get(kind, 0x08)

    def next_error(self) -> str:
        """Return the oldest entry, and remove it."""
        return self.errors.pop(0) if self.errors else '0,"No error"'

    def clear(self) -> None:
        """``*CLS``."""
        self.esr, self.errors, self._requested = 0, [], 0

    def byte(self, available: bool) -> int:
        """Status byte as ``*STB?`` reports it: error queue, message available, standard events; bit 6 (MSS)
        as long as one of them is enabled.
        """
        found = _ERROR * bool(self.errors) | _MAV * available | _ESB * bool(self.esr & self.ese)
        return found | _MSS * bool(found & self.sre)

    def poll(self, available: bool) -> int:
        """Status byte as a serial poll reports it: bit 6 (RQS) once for each reason (IEEE 488.2, 11.2.2)."""
        found = self.byte(available)
        reasons = found & self.sre
        requested = bool(reasons & ~self._requested)
        self._requested = reasons
        return found & ~_MSS | _MSS * requested

    def common(self, header: str, arguments: str) -> str | None:
        """Obey a common command of the registers; None if it has no answer.

        Raises
        ------
        KeyError
            If it is another.
        ValueError
            If its parameter is wrong.
        """
        name = header.upper()
        if name in ("*ESE", "*SRE"):
            mask = int(float(numeric(low=0, high=255)(arguments)))
            if name == "*ESE":
                self.ese = mask
            else:
                self.sre = mask & ~_MSS
            return None
        if name == "*OPC":
            self.esr |= _COMPLETE
            return None
        if name in ("*WAI", "*TRG"):
            return None
        if name == "*CLS":
            self.clear()
            return None
        if name == "*ESR?":
            found, self.esr = self.esr, 0
            self._requested &= ~_ESB
            return str(found)
        if name == "*STB?":
            # The answer itself is not available yet.
            return str(self.byte(False))
        answers = {"*ESE?": str(self.ese), "*SRE?": str(self.sre), "*OPC?": "1", "*TST?": "0", "*OPT?": "0"}
        return answers[name]
