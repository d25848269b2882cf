"""US Ultratek's CompactPulser: sends pulses and amplifies their echoes; an oscilloscope digitises them.

Source: *CompactPulser Instruction Manual*. Commands are not acknowledged; so every value is asked for after
it was set, and read back. A sample at the time t after the pulse lies at c·t/2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from reseau.data import Array
from reseau.errors import StateError
from reseau.instruments import Deadline, Device, Identity, Limits, Oscilloscope, Settings, Waveform, quantity

from ..codecs.compactpulser import LIMIT, Setting, decode, encode
from ..codecs.stream import LineDecoder
from ..link import Conversation, Link

__all__ = ["CompactPulser", "CompactPulserSettings"]

_ROUNDED = 0.51


@dataclass(frozen=True)
class CompactPulserSettings(Settings):
    """How pulses are sent and echoes amplified; nothing is sent at 0 Hz."""

    repetition_hz: float = quantity(0.0, "Hz", 0.0, 5000.0)
    width_ns: float = quantity(100.0, "ns", 10.0, 1000.0)
    voltage: float = quantity(300.0, "V", 40.0, 300.0)
    gain_db: float = quantity(0.0, "dB", -20.0, 80.0)
    damping: int = quantity(1, "", 0, 15)
    mode: int = quantity(0, "", 0, 1)
    trigger: int = quantity(0, "", 0, 1)
    speed_m_s: float = quantity(1540.0, "m/s", 1000.0, 7000.0)
    channel: int = quantity(1, "", 1, 8)


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
    digitiser : Oscilloscope, optional
        Sees its echoes.
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
        digitiser: Oscilloscope | None = None,
        seconds: float = 5.0,
        answer_s: float = 0.5,
        limits: Limits | None = None,
    ) -> None:
        super().__init__(name, settings or CompactPulserSettings(), seconds=seconds, limits=limits)
        self._talk: Conversation[bytes] = Conversation(link, LineDecoder(end=b"\r", limit=LIMIT))
        self._digitiser, self._answer_s = digitiser, answer_s

    def _open(self, deadline: Deadline) -> None:
        self._talk.open(deadline)
        # Ends what may have been begun on the line. The first answer only shows that somebody is there.
        self._talk.tell(b"\r", deadline)
        self._value("M", deadline)

    def _shut(self) -> None:
        self._talk.close()

    def _push(self, settings: CompactPulserSettings, deadline: Deadline) -> None:
        wanted = _letters(settings)
        for letter, value in wanted.items():
            self._set(letter, value, deadline)
        # It may have lost its power in between, and all that was set before.
        self._verify(wanted, deadline)

    def verify(self, seconds: float | None = None) -> None:
        """Read all settings back.

        Raises
        ------
        StateError
            When one is not as it was set: someone turned a knob, or the power was off.
        """
        with self._exchange("verify", seconds) as deadline:
            self._verify(_letters(self.settings), deadline)

    def check(self, seconds: float | None = None) -> dict[str, str]:
        """Who it is, and whether its settings are those that were pushed."""
        found = {"identity": str(self.connect(seconds))}
        self.verify(seconds)
        return found | {"settings": "as pushed"}

    def _identify(self, deadline: Deadline) -> Identity:
        self._value("G", deadline)
        return Identity("US Ultratek", "CompactPulser")

    def _halt(self, deadline: Deadline) -> None:
        self._set("P", 0, deadline)

    def _acquire(self) -> dict[str, Any]:
        return {f"{self.name}_volts": self.line().volts}

    def _kinds(self) -> dict[str, dict[str, Any]]:
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
        if self._digitiser is None:
            raise StateError(
                "has no digitiser", where=self.name, command="line", do="give it an oscilloscope"
            )
        if not s.repetition_hz:
            raise StateError("sends no pulses", where=self.name, command="line", do="set repetition_hz")
        return self._digitiser.waveform(s.channel, seconds)

    def depths_mm(self, line: Waveform) -> Array:
        """Where the samples of a line lie (n,)."""
        depths: Array = self.settings.speed_m_s * 1e3 * line.seconds / 2
        return depths

    def _set(self, letter: str, value: float, deadline: Deadline) -> None:
        self._talk.tell(encode(Setting(letter, value)), deadline)
        self._verify({letter: value}, deadline)

    def _verify(self, wanted: Mapping[str, float], deadline: Deadline) -> None:
        for letter, value in wanted.items():
            found = self._value(letter, deadline)
            # The instrument rounds.
            if not abs(found - value) <= _ROUNDED:
                raise StateError(
                    f"has {letter} = {found:g} and not {value:g}", do="is it in local mode, or was it off?"
                )

    def _value(self, letter: str, deadline: Deadline) -> float:
        head = f"{letter}=".encode()
        line = self._talk.ask(
            encode(Setting(letter, None)), lambda line: line.startswith(head), deadline.part(self._answer_s)
        )
        setting, _ = decode(line)
        return float("nan") if setting.value is None else setting.value


def _letters(s: CompactPulserSettings) -> dict[str, float]:
    """Values by letter; pulses last: they begin when all else is set."""
    return {
        "W": s.width_ns,
        "V": s.voltage,
        "G": s.gain_db,
        "D": s.damping,
        "M": s.mode,
        "T": s.trigger,
        "P": round(s.repetition_hz / 10),
    }
