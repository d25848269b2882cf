"""US Ultratek's CompactPulser: sends pulses and amplifies their echoes; an oscilloscope digitises them.

Source: see :mod:`reseau_drivers.codecs.compactpulser`. Commands are not acknowledged; so values are asked for
after they were set. That ``G?`` is answered is known of all; where the other letters are silent the gain
vouches for them: it is set one step off before them, and right behind them. A sample at the time t after the
pulse lies at c·t/2. A table that carries the transducer along makes sections of the lines.
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

__all__ = ["CompactPulser", "CompactPulserSettings"]

_MOST_GAIN = 840


@dataclass(frozen=True)
class CompactPulserSettings(Settings):
    """How pulses are sent and echoes amplified; nothing is sent at 0 Hz."""

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
    """The pulser.

    Parameters
    ----------
    name : str
        On the bench.
    link : Link
        To it.
    settings : CompactPulserSettings
        Pushed on every connection.
    digitiser : Oscilloscope or str, optional
        Sees its echoes; a name is that of one on the same bench.
    carrier : Turntable or str, optional
        Carries the transducer along for sections; likewise.
    axis : str
        Of the carrier, in millimetres.
    seconds : float
        Deadline of calls that name none.
    answer_s : float
        Within which a value is told.
    limits : mapping, optional
        Of settings.
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

    def combine(self, instruments: Mapping[str, Instrument]) -> None:
        """Find what was named among the instruments of the bench.

        Raises
        ------
        SettingError
            When there is none of this name and kind.
        """
        if isinstance(self._digitiser, str):
            found = instruments.get(self._digitiser)
            if not isinstance(found, Oscilloscope):
                raise SettingError(f"digitiser {self._digitiser!r} is no oscilloscope here", where=self.name)
            self._digitiser = found
        if isinstance(self._carrier, str):
            table = instruments.get(self._carrier)
            if not isinstance(table, Turntable) or self._axis not in table.axes:
                raise SettingError(
                    f"carrier {self._carrier!r} is no table with an axis {self._axis!r} here", where=self.name
                )
            self._carrier = table

    def _open(self, deadline: Deadline) -> None:
        self._link.open(deadline)
        # Ends what may have been begun on the line. The first answer only shows that somebody is there.
        self._link.send(b"\r", deadline)
        self._value("G", deadline)
        self._readable = "".join(_letters(self.settings)) if self._answers("W", deadline) else "G"

    def _disconnect(self) -> None:
        self._link.close()

    def _push(self, settings: CompactPulserSettings, deadline: Deadline) -> None:
        wanted = _letters(settings)
        off = wanted["G"] + (1 if wanted["G"] < _MOST_GAIN else -1)
        # Pulses last: they begin when all else is set.
        for letter, value in ({"G": off} | {k: v for k, v in wanted.items() if k != "G"}).items():
            self._set(letter, value, deadline)
        self._verify({"G": off}, deadline)
        self._set("G", wanted["G"], deadline)
        # It may have lost its power in between, and all that was set before.
        self._verify(wanted, deadline)

    def stop(self, *, success: bool = False) -> None:
        """Stop the pulses, and the carrier in the midst of a section."""
        scanning = self._scanning
        super().stop(success=success)
        if scanning and isinstance(self._carrier, Turntable):
            self._carrier.stop(success=success)

    def stage(self) -> list[Any]:
        """Connect, and send pulses again, which the end of the run before had stopped."""
        staged = super().stage()
        self.configure()
        return staged

    def verify(self, seconds: float | None = None) -> None:
        """Read settings back: all of them, or the gain where the instrument tells no other.

        Raises
        ------
        StateError
            When one is not as it was set: someone turned a knob, or the power was off.
        """
        with self._exchange("verify", seconds) as deadline:
            self._verify(_letters(self.settings), deadline)

    def _test(self, deadline: Deadline) -> dict[str, str]:
        self.verify(deadline.left_or_minimum)
        alone = len(self._readable) == 1
        return {"settings": "gain as pushed; it tells no other" if alone else "as pushed"}

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
        """Echoes of a pulse, as the oscilloscope digitised them.

        Raises
        ------
        StateError
            When no oscilloscope was given, or no pulses are sent.
        InstrumentError
            When it did not answer.
        """
        s = self.settings
        if not isinstance(self._digitiser, Oscilloscope):
            raise StateError(
                "has no digitiser", where=self.name, command="line", do="give it an oscilloscope"
            )
        if not s.repetition_hz:
            raise StateError("sends no pulses", where=self.name, command="line", do="set repetition_hz")
        return self._digitiser.waveform(s.channel, seconds)

    def scan(self, seconds: float | None = None) -> BScan:
        """A section: a line at each place that the carrier brings the transducer to.

        Raises
        ------
        StateError
            When there is no carrier, the carrier is not homed, or it was stopped.
        InstrumentError
            When a line did not come, or the time ran out.
        """
        s, asked = self.settings, now()
        if not isinstance(self._carrier, Turntable):
            raise StateError("is not carried along", where=self.name, command="scan", do="give it a carrier")
        deadline = Deadline(self._seconds * s.lines if seconds is None else seconds)
        self._stopping.clear()
        self._scanning = True
        try:
            lines = [self._line_at(self._carrier, k, deadline) for k in range(s.lines)]
        finally:
            self._scanning = False
        with self._exchange("scan", deadline.left_or_minimum):
            pixels, row, step_s = section(lines, s.full_scale_v)
        mm = (s.step_mm, s.speed_m_s * 1e3 * step_s / 2)
        return BScan(pixels, mm, ((s.lines - 1) / 2, row), s.speed_m_s, float("nan"), s.gain_db, asked)

    def _line_at(self, carrier: Turntable, number: int, deadline: Deadline) -> Waveform:
        """The line of this number of a section."""
        if self._stopping.is_set():
            raise StateError("was stopped", where=self.name, command="scan")
        if deadline.expired:
            what = f"was not done within {deadline.seconds:g} s"
            raise DeadlineError(what, where=self.name, command="scan")
        carrier.move(
            self._axis, self.settings.first_mm + number * self.settings.step_mm, deadline.left_or_minimum
        )
        return self.line(deadline.left_or_minimum)

    def depths_mm(self, line: Waveform) -> Array:
        """Where the samples of a line lie (n,)."""
        depths: Array = self.settings.speed_m_s * 1e3 * line.seconds / 2
        return depths

    def _set(self, letter: str, value: int, deadline: Deadline) -> None:
        self._link.send(encode(Setting(letter, value)), deadline)
        self._verify({letter: value}, deadline)

    def _verify(self, wanted: Mapping[str, int], deadline: Deadline) -> None:
        for letter, value in wanted.items():
            if letter in self._readable and (found := self._value(letter, deadline)) != value:
                raise StateError(
                    f"has {letter} = {found} and not {value}", do="is it in local mode, or was it off?"
                )

    def _answers(self, letter: str, deadline: Deadline) -> bool:
        """Whether a letter is told; asked twice, as an answer may get lost."""
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
    """Values by letter."""
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
    """Amplitude (n,) of an oscillation: the modulus of its analytic signal, its mean taken off."""
    count = len(volts)
    weights = np.zeros(count)
    weights[0] = 1.0
    weights[1 : (count + 1) // 2] = 2.0
    if count % 2 == 0:
        weights[count // 2] = 1.0
    amplitude: Array = np.abs(np.fft.ifft(np.fft.fft(volts - volts.mean()) * weights))
    return amplitude


def section(lines: Sequence[Waveform], full_scale_v: float) -> tuple[NDArray[np.uint8], float, float]:
    """Lines as the columns of a picture.

    Parameters
    ----------
    lines : sequence of Waveform
        Each taken at the next place; time 0 is the pulse.
    full_scale_v : float
        Amplitude that is shown as 255.

    Returns
    -------
    pixels : ndarray (samples, lines)
        From the pulse on.
    row : float
        Of the pulse: between −1 and 0.
    step_s : float
        Time from row to row.

    Raises
    ------
    ProtocolError
        When the lines are not alike, or end before the pulse.
    """
    first = lines[0]
    begin = max(0, int(np.ceil(-first.start_s / first.step_s - 1e-9)))
    for line in lines:
        same = len(line.volts) == len(first.volts) and np.allclose(
            (line.start_s, line.step_s), (first.start_s, first.step_s), rtol=1e-6, atol=1e-12
        )
        if not same:
            raise ProtocolError("its digitiser changed the time base within a section")
    if len(first.volts) - begin < 2:
        raise ProtocolError("its digitiser shows nothing behind the pulse", do="move the trigger")
    amplitudes = np.column_stack([envelope(line.volts)[begin:] for line in lines])
    pixels = np.clip(np.rint(255 * amplitudes / full_scale_v), 0, 255).astype(np.uint8)
    return pixels, -(first.start_s / first.step_s + begin), first.step_s
