"""Simulated sensors of the environment, which all measure the same air: SCPI, Modbus, lines of text.

Sources: see :mod:`reseau_drivers.codecs.modbus` and :mod:`reseau_drivers.codecs.sentence`; SCPI 1999.0,
volume 1, section 7.2 (not a number is 9.91E37).
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from reseau.core.errors import ProtocolError
from reseau_drivers.codecs import modbus
from reseau_drivers.codecs.sentence import with_checksum
from reseau_drivers.codecs.stream import Damaged, LineDecoder

from .faults import Kind
from .machine import Machine
from .motion import Clock

_NAN = 9.91e37
_TROUBLE_S = 0.4
"""How long a fault of a sensor lasts (s)."""


@dataclass
class Air:
    """The air of a laboratory: slow waves about usual values, each run of them drawn.

    Parameters
    ----------
    seed : int
        Seed.
    clock : callable
        Returns the time in seconds.
    steady : bool
        Whether it does not change.

    Examples
    --------
    >>> air = Air(seed=3, clock=lambda: 0.0)
    >>> sorted(air()), 19.0 < air()["temperature"] < 23.0
    (['humidity', 'pressure', 'temperature'], True)
    """

    seed: int = 0
    clock: Clock = time.monotonic
    steady: bool = False
    _waves: dict[str, tuple[float, float, float, float]] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        for name, mean, size in (
            ("temperature", 21.0, 0.6),
            ("humidity", 45.0, 4.0),
            ("pressure", 1005.0, 6.0),
        ):
            phase, hours = rng.uniform(0.0, 2 * np.pi), rng.uniform(1.0, 4.0)
            self._waves[name] = mean, size, float(phase), float(hours)

    def __call__(self) -> dict[str, float]:
        """Return the present values."""
        hours = 0.0 if self.steady else self.clock() / 3600.0
        return {
            name: mean + size * float(np.sin(phase + 2 * np.pi * hours / period))
            for name, (mean, size, phase, period) in self._waves.items()
        }


class _Sensor(Machine):
    """A sensor that is in trouble for a while after a fault.

    Stuck: it does not answer; wrong state: it cannot measure; out of range: its element is broken;
    power-cycled: it does not answer while it starts.
    """

    def __init__(self, conditions: Callable[[], Mapping[str, float]], clock: Clock = time.monotonic) -> None:
        super().__init__()
        self.conditions, self._clock = conditions, clock
        self._trouble: tuple[Kind, float] | None = None

    def inject_fault(self, kind: Kind) -> None:
        """Be in trouble."""
        self._trouble = kind, self._clock() + _TROUBLE_S

    @property
    def trouble(self) -> Kind | None:
        """The present trouble."""
        if self._trouble is None or self._clock() > self._trouble[1]:
            return None
        return self._trouble[0]

    @property
    def silent(self) -> bool:
        """Whether it does not answer."""
        return self.trouble in ("stuck", "power-cycled")

    def values(self) -> dict[str, float]:
        """Return what it measures; a broken element gives impossible values."""
        found = dict(self.conditions())
        return dict.fromkeys(found, 1.0e4) if self.trouble == "out of range" else found

    @abstractmethod
    def disconnected(self) -> None: ...


class ScpiSensor(_Sensor):
    r"""Simulated sensor that answers SCPI queries.

    Parameters
    ----------
    conditions : callable
        Returns the present values by quantity.

    Examples
    --------
    >>> sensor = ScpiSensor(lambda: {"temperature": 21.53, "humidity": 45.2, "pressure": 1004.8})
    >>> sensor.receive(b"MEAS:TEMP?\n*IDN?\n")
    [b'+2.15300E+01\n', b'Reseau,THP-1,42,1.3\n']
    """

    QUERIES: Mapping[str, str] = {
        "MEAS:TEMP?": "temperature", "MEAS:HUM?": "humidity", "MEAS:PRES?": "pressure",
    }  # fmt: skip

    def __init__(self, conditions: Callable[[], Mapping[str, float]], clock: Clock = time.monotonic) -> None:
        super().__init__(conditions, clock)
        self._lines = LineDecoder(limit=256)

    def receive(self, data: bytes) -> Sequence[bytes]:
        """Return the answers to these bytes."""
        answers = []
        for line in self._lines.feed(data):
            answer = None if isinstance(line, Damaged) else self.execute(line)
            if answer is not None:
                answers.append(answer)
        return answers

    def execute(self, message: bytes) -> bytes | None:
        """Carry out a message; return the answer, or None if there is none."""
        query = message.decode("ascii", "replace").strip().upper().lstrip(":")
        if self.silent:
            return None
        if query == "*IDN?":
            return b"Reseau,THP-1,42,1.3\n"
        if query not in self.QUERIES:
            self.violations.append(f"{query!r} is not known")
            return None
        value = _NAN if self.trouble == "wrong state" else self.values()[self.QUERIES[query]]
        return f"{value:+.5E}\n".encode()

    def disconnected(self) -> None:
        """Discard an incomplete message."""
        self._lines.reset()


class ModbusSensor(_Sensor):
    """Simulated sensor with input registers.

    Temperature and humidity are in tenths in registers 0 and 1, pressure as float32 in registers 2 and 3; the
    same values are in holding registers 100 and following.

    Parameters
    ----------
    conditions : callable
        Returns the present values by quantity.
    unit : int
        Address.
    tcp : bool
        Whether frames are those of TCP.

    Examples
    --------
    >>> sensor = ModbusSensor(lambda: {"temperature": 21.5, "humidity": 45.0, "pressure": 1004.0}, unit=7)
    >>> sensor.receive(modbus.encode(modbus.Frame(7, modbus.encode_read(modbus.INPUT, 0, 2))))[0].hex(" ")
    '07 04 04 00 d7 01 c2 ad bd'
    """

    def __init__(
        self,
        conditions: Callable[[], Mapping[str, float]],
        *,
        unit: int = 1,
        tcp: bool = False,
        clock: Clock = time.monotonic,
    ) -> None:
        super().__init__(conditions, clock)
        self._unit, self._tcp = unit, tcp
        self._decoder = modbus.TcpDecoder() if tcp else modbus.RtuDecoder(requests=True)

    def registers(self) -> tuple[int, ...]:
        """Return the words of the registers."""
        now = self.values()
        tenths = (round(10 * min(now[name], 3000.0)) for name in ("temperature", "humidity"))
        return (*tenths, *modbus.words_of(now["pressure"], "float32"))

    def receive(self, data: bytes) -> Sequence[bytes]:
        """Return the answers to these bytes."""
        answers = []
        for frame in self._decoder.feed(data):
            if isinstance(frame, Damaged):
                self.violations.append(str(frame))
            elif frame.unit == self._unit and not self.silent:
                answer = modbus.Frame(frame.unit, self._answer(frame.pdu), frame.transaction)
                answers.append(modbus.encode(answer))
        return answers

    def _answer(self, pdu: bytes) -> bytes:
        if pdu[0] == modbus.DIAGNOSTICS and pdu[1:3] == b"\0\0":
            return pdu
        if self.trouble == "wrong state":
            return modbus.encode_exception(pdu[0] & 0x7F, 6)
        try:
            function, first, count = modbus.decode_read(pdu)
        except ProtocolError as error:
            self.violations.append(error.what)
            return modbus.encode_exception(pdu[0] & 0x7F, 1)
        base = 0 if function == modbus.INPUT else 100
        words = self.registers()
        if not 0 <= first - base <= first - base + count <= len(words):
            self.violations.append(f"registers {first}…{first + count - 1} do not exist")
            return modbus.encode_exception(function, 2)
        return modbus.encode_registers(function, words[first - base : first - base + count])

    def disconnected(self) -> None:
        """Discard an incomplete frame."""
        self._decoder.reset()


class LineSensor(_Sensor):
    r"""Simulated sensor that sends lines: by itself, or when it is asked with ``?``.

    Parameters
    ----------
    conditions : callable
        Returns the present values by quantity.
    every_s : float
        Time from line to line (s); 0: only when it is asked.
    checksum : bool
        Whether lines have the checksum of NMEA 0183.

    Examples
    --------
    >>> air = {"temperature": 21.53, "humidity": 45.2, "pressure": 1004.8}
    >>> LineSensor(lambda: air, every_s=0.0).receive(b"?\n")
    [b'T=21.53 C RH=45.2 % P=1004.8 hPa\r\n']
    """

    PATTERN = r"T=(?P<temperature>\S+) C RH=(?P<humidity>\S+) % P=(?P<pressure>\S+) hPa"

    def __init__(
        self,
        conditions: Callable[[], Mapping[str, float]],
        *,
        every_s: float = 1.0,
        checksum: bool = False,
        clock: Clock = time.monotonic,
    ) -> None:
        super().__init__(conditions, clock)
        self._every, self._checksum = every_s, checksum
        self._lines, self._next = LineDecoder(limit=64), clock()

    def _line(self) -> bytes:
        if self.trouble == "wrong state":
            return b"ERR 3\r\n"
        now = self.values()
        text = f"T={now['temperature']:.2f} C RH={now['humidity']:.1f} % P={now['pressure']:.1f} hPa"
        return (with_checksum(text.encode()) if self._checksum else text.encode()) + b"\r\n"

    def receive(self, data: bytes) -> Sequence[bytes]:
        """Return the lines that these bytes ask for."""
        answers = []
        for line in self._lines.feed(data):
            if line != b"?":
                self.violations.append(f"{line!r} is not known")
            elif not self.silent:
                answers.append(self._line())
        return answers

    @property
    def due(self) -> float | None:
        """When the next line is sent."""
        return self._next if self._every else None

    def emit(self) -> Sequence[bytes]:
        """Return the line that is due."""
        now = self._clock()
        while self._next <= now:
            self._next += self._every
        return [] if self.silent else [self._line()]

    def disconnected(self) -> None:
        """Discard an incomplete query."""
        self._lines.reset()
