"""US Ultratek CompactPulser: sends pulses and amplifies their echoes, which an oscilloscope digitises.

Source: see :mod:`reseau_drivers.codecs.compactpulser`. Commands are not acknowledged; values are therefore
read back. All known instruments answer ``G?``. If an instrument does not answer queries of other letters, the
gain serves as a check: it is set to a neighbouring value before the other settings and to its final value
after them. A sample at the time t after the pulse is at the depth c·t/2. Sections consist of lines that are
taken while a table moves the transducer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reseau.core.data import Array
from reseau.core.errors import DeadlineError, ProtocolError, SettingError, StateError
from reseau.instruments import (
    BScan,
    Deadline,
    Device,
    Identity,
    Instrument,
    Limits,
    Oscilloscope,
    Settings,
    Turntable,
    Waveform,
    quantity,
)
from reseau.instruments.values import now

from ..codecs.compactpulser import LIMIT, Setting, decode, encode
from ..codecs.stream import LineDecoder
from ..link import Link, MessageLink

_MOST_GAIN = 840


@dataclass(frozen=True)
class CompactPulserSettings(Settings):
    """Pulses and amplification; a repetition rate of 0 Hz sends no pulses.

    Sections have `lines` lines, `step_mm` apart, from `first_mm` on; an amplitude of `full_scale_v` is shown
    as 255.

    Examples
    --------
    >>> CompactPulserSettings(voltage=120.0, gain_db=12.5).units["gain_db"]
    'dB'
    """

    repetition_hz: float = quantity(0.0, "Hz", 0.0, 5000.0)
    width_ns: float = quantity(220.0, "ns", 10.0, 1000.0)
    voltage: float = quantity(300.0, "V", 40.0, 300.0)
    gain_db: float = quantity(0.0, "dB", -12.0, 84.0)
    damping: int = quantity(0, "", 0, 15)
    mode: int = quantity(0, "", 0, 1)
    trigger: int = quantity(0, "", 0, 1)
    speed_m_s: float = quantity(1540.0, "m/s", 1000.0, 7000.0)
    channel: int = quantity(1, "", 1, 8)
    first_mm: float = quantity(0.0, "mm", -1000.0, 1000.0)
    step_mm: float = quantity(1.0, "mm", 0.01, 100.0)
    lines: int = quantity(41, "", 2, 4096)
    full_scale_v: float = quantity(1.0, "V", 1e-3, 100.0)


class CompactPulser(Device[CompactPulserSettings]):
    """Driver of the pulser.

    Parameters
    ----------
    name : str
        Name on the bench.
    link : Link
        Link to the pulser.
    settings : CompactPulserSettings
        Sent on every connection.
    digitiser : Oscilloscope or str, optional
        Oscilloscope that digitises the echoes; a name refers to an instrument on the same bench.
    carrier : Turntable or str, optional
        Table that moves the transducer for sections; likewise.
    axis : str
        Axis of the carrier, in millimetres.
    seconds : float
        Time limit of calls that do not specify one (s).
    answer_s : float
        Time limit of an answer (s).
    limits : mapping, optional
        Limits of settings.

    Examples
    --------
    >>> from reseau_drivers.link import link_to
    >>> line = Waveform(np.zeros(3), start_s=0.0, step_s=1e-6)
    >>> CompactPulser("pulser", link_to("/dev/ttyUSB1@9600")).depths_mm(line)
    array([0.  , 0.77, 1.54])
    """

    def __init__(
        self,
        name: str,
        link: Link,
        settings: CompactPulserSettings | None = None,
        *,
        digitiser: Oscilloscope | str | None = None,
        carrier: Turntable | str | None = None,
        axis: str = "z",
        seconds: float = 5.0,
        answer_s: float = 0.5,
        limits: Limits | None = None,
    ) -> None:
        super().__init__(name, settings or CompactPulserSettings(), seconds=seconds, limits=limits)
        self._link: MessageLink[bytes] = MessageLink(link, LineDecoder(end=b"\r", limit=LIMIT))
        self._digitiser, self._carrier, self._axis = digitiser, carrier, axis
        self._answer_s = answer_s
        self._readable, self._scanning = "G", False

    @property
    def uses(self) -> tuple[str, ...]:
        """Names of digitiser and carrier, if there are any."""
        others = (self._digitiser, self._carrier)
        return tuple(each if isinstance(each, str) else each.name for each in others if each is not None)

    def combine(self, instruments: Mapping[str, Instrument]) -> None:
        """Look up the digitiser and the carrier by name among the instruments of the bench.

        Raises
        ------
        SettingError
            If there is no such instrument, or it is of another kind.
        """
        if isinstance(self._digitiser, str):
            found = instruments.get(self._digitiser)
            if not isinstance(found, Oscilloscope):
                raise SettingError(
                    f"digitiser {self._digitiser!r} is not an oscilloscope on this bench", where=self.name
                )
            self._digitiser = found
        if isinstance(self._carrier, str):
            table = instruments.get(self._carrier)
            if not isinstance(table, Turntable) or self._axis not in table.axes:
                raise SettingError(
                    f"carrier {self._carrier!r} is not a table with an axis {self._axis!r} on this bench",
                    where=self.name,
                )
            self._carrier = table

    def _open(self, deadline: Deadline) -> None:
        self._link.open(deadline)
        # End an incomplete line. The first answer only shows that the instrument is present.
        self._link.send(b"\r", deadline)
        self._value("G", deadline)
        self._readable = "".join(_letters(self.settings)) if self._answers("W", deadline) else "G"

    def _disconnect(self) -> None:
        self._link.close()

    def _push(self, settings: CompactPulserSettings, deadline: Deadline) -> None:
        wanted = _letters(settings)
        off = wanted["G"] + (1 if wanted["G"] < _MOST_GAIN else -1)
        # The repetition rate is last: pulses start when everything else is set.
        for letter, value in ({"G": off} | {k: v for k, v in wanted.items() if k != "G"}).items():
            self._set(letter, value, deadline)
        self._verify({"G": off}, deadline)
        self._set("G", wanted["G"], deadline)
        # The instrument may have lost its power in between, and with it the settings sent before.
        self._verify(wanted, deadline)

    def stop(self, *, success: bool = False) -> None:
        """Stop the pulses, and the carrier during a section."""
        scanning = self._scanning
        super().stop(success=success)
        if scanning and isinstance(self._carrier, Turntable):
            self._carrier.stop(success=success)

    def stage(self) -> list[Any]:
        """Connect and send the settings again: the end of the previous run stopped the pulses."""
        staged = super().stage()
        self.configure()
        return staged

    def verify(self, seconds: float | None = None) -> None:
        """Read back the settings: all of them, or only the gain if the instrument reports nothing else.

        Raises
        ------
        StateError
            If a value differs: a knob was turned, or the power was off.
        """
        with self._exchange("verify", seconds) as deadline:
            self._verify(_letters(self.settings), deadline)

    def _test(self, deadline: Deadline) -> dict[str, str]:
        self.verify(deadline.left)
        alone = len(self._readable) == 1
        return {"settings": "gain as sent; others are not readable" if alone else "as sent"}

    def _identify(self, deadline: Deadline) -> Identity:
        self._value("G", deadline)
        return Identity("US Ultratek", "CompactPulser")

    def _halt(self, deadline: Deadline) -> None:
        self._set("P", 0, deadline)

    def _acquire(self) -> dict[str, Any]:
        if self._carrier is None:
            return {f"{self.name}_volts": self.line().volts}
        scan = self.scan()
        return {f"{self.name}_section": scan.pixels, f"{self.name}_mm_per_px": list(scan.mm_per_px or ())}

    def _reading_format(self) -> dict[str, dict[str, Any]]:
        if self._carrier is not None:
            return {
                f"{self.name}_section": {"dtype": "array", "shape": [0, self.settings.lines]},
                f"{self.name}_mm_per_px": {"dtype": "array", "shape": [2], "units": "mm"},
            }
        reading = self._reading.get(f"{self.name}_volts")
        shape = [len(reading["value"])] if reading else [0]
        return {f"{self.name}_volts": {"dtype": "array", "shape": shape, "units": "V"}}

    def line(self, seconds: float | None = None) -> Waveform:
        """Return the echoes of a pulse, as the oscilloscope digitised them.

        Raises
        ------
        StateError
            If there is no oscilloscope, or no pulses are sent.
        InstrumentError
            If the oscilloscope does not answer.
        """
        s = self.settings
        if not isinstance(self._digitiser, Oscilloscope):
            raise StateError(
                "has no digitiser", where=self.name, command="line", do="set the option digitiser"
            )
        if not s.repetition_hz:
            raise StateError("sends no pulses", where=self.name, command="line", do="set repetition_hz")
        return self._digitiser.waveform(s.channel, seconds)

    def scan(self, seconds: float | None = None) -> BScan:
        """Return a section: one line at each position of the carrier.

        Raises
        ------
        StateError
            If there is no carrier, the carrier is not homed, or it was stopped.
        InstrumentError
            If a line is missing, or the time limit is exceeded.
        """
        s, asked = self.settings, now()
        if not isinstance(self._carrier, Turntable):
            raise StateError("has no carrier", where=self.name, command="scan", do="set the option carrier")
        deadline = Deadline(self._seconds * s.lines if seconds is None else seconds)
        self._begin("scan")
        self._scanning = True
        try:
            lines = [self._line_at(self._carrier, k, deadline) for k in range(s.lines)]
        finally:
            self._scanning = False
        with self._exchange("scan", deadline.left):
            pixels, row, step_s = section(lines, s.full_scale_v)
        mm = (s.step_mm, s.speed_m_s * 1e3 * step_s / 2)
        return BScan(pixels, mm, ((s.lines - 1) / 2, row), s.speed_m_s, float("nan"), s.gain_db, asked)

    def _line_at(self, carrier: Turntable, number: int, deadline: Deadline) -> Waveform:
        """Return one line of a section, given its index."""
        self._require_unstopped("scan")
        if deadline.expired:
            what = f"did not finish within {deadline.seconds:g} s"
            raise DeadlineError(what, where=self.name, command="scan")
        carrier.move(self._axis, self.settings.first_mm + number * self.settings.step_mm, deadline.left)
        return self.line(deadline.left)

    def depths_mm(self, line: Waveform) -> Array:
        """Return the depths of the samples of a line (n,), in millimetres."""
        depths: Array = self.settings.speed_m_s * 1e3 * line.seconds / 2
        return depths

    def _set(self, letter: str, value: int, deadline: Deadline) -> None:
        self._link.send(encode(Setting(letter, value)), deadline)
        self._verify({letter: value}, deadline)

    def _verify(self, wanted: Mapping[str, int], deadline: Deadline) -> None:
        for letter, value in wanted.items():
            if letter in self._readable and (found := self._value(letter, deadline)) != value:
                raise StateError(
                    f"has {letter} = {found} instead of {value}", do="check local mode and power"
                )

    def _answers(self, letter: str, deadline: Deadline) -> bool:
        """Whether a letter can be queried; asked twice, because an answer may be lost."""
        for _ in range(2):
            try:
                self._value(letter, deadline)
                return True
            except DeadlineError:
                continue
        return False

    def _value(self, letter: str, deadline: Deadline) -> int | None:
        head = f"{letter}=".encode()
        line = self._link.query(
            encode(Setting(letter, None)), lambda line: line.startswith(head), deadline.part(self._answer_s)
        )
        return decode(line)[0].value


def _letters(s: CompactPulserSettings) -> dict[str, int]:
    """Return the values by letter."""
    return {
        "W": round(s.width_ns),
        "V": round(s.voltage),
        "G": round(10 * s.gain_db),
        "D": s.damping,
        "M": s.mode,
        "T": s.trigger,
        "P": round(s.repetition_hz / 10),
    }


def envelope(volts: Array) -> Array:
    """Return the amplitude (n,) of an oscillation: the modulus of the analytic signal without its mean."""
    count = len(volts)
    weights = np.zeros(count)
    weights[0] = 1.0
    weights[1 : (count + 1) // 2] = 2.0
    if count % 2 == 0:
        weights[count // 2] = 1.0
    amplitude: Array = np.abs(np.fft.ifft(np.fft.fft(volts - volts.mean()) * weights))
    return amplitude


def section(lines: Sequence[Waveform], full_scale_v: float) -> tuple[NDArray[np.uint8], float, float]:
    """Arrange lines as the columns of an image.

    Parameters
    ----------
    lines : sequence of Waveform
        Lines at consecutive positions; time 0 is the pulse.
    full_scale_v : float
        Amplitude that is shown as 255 (V).

    Returns
    -------
    pixels : ndarray (samples, lines)
        Amplitudes, from the pulse on.
    row : float
        Row of the pulse, between −1 and 0.
    step_s : float
        Time step between rows (s).

    Raises
    ------
    ProtocolError
        If the lines have different time bases, or end before the pulse.
    """
    first = lines[0]
    pulse = max(0, int(np.ceil(-first.start_s / first.step_s - 1e-9)))
    for line in lines:
        same = len(line.volts) == len(first.volts) and np.allclose(
            (line.start_s, line.step_s), (first.start_s, first.step_s), rtol=1e-6, atol=1e-12
        )
        if not same:
            raise ProtocolError("the digitiser changed the time base within a section")
    if len(first.volts) - pulse < 2:
        raise ProtocolError("the digitiser recorded nothing after the pulse", do="change the trigger delay")
    amplitudes = np.column_stack([envelope(line.volts)[pulse:] for line in lines])
    pixels = np.clip(np.rint(255 * amplitudes / full_scale_v), 0, 255).astype(np.uint8)
    return pixels, -(first.start_s / first.step_s + pulse), first.step_s
