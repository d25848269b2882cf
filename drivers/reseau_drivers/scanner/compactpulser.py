"""US Ultratek's CompactPulser: sends pulses and amplifies their echoes; an oscilloscope digitises them.

Source: see :mod:`reseau_drivers.codecs.compactpulser`. Commands are not acknowledged; so values are asked for
after they were set. That ``G?`` is answered is known of all; where the other letters are silent the gain
vouches for them: it is set one step off before them, and right behind them. A sample at the time t after the
pulse lies at c·t/2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from reseau.data import Array
from reseau.errors import DeadlineError, StateError
from reseau.instruments import Deadline, Device, Identity, Limits, Oscilloscope, Settings, Waveform, quantity

from ..codecs.compactpulser import LIMIT, Setting, decode, encode
from ..codecs.stream import LineDecoder
from ..link import Conversation, Link

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
        self._told = "G"

    def _open(self, deadline: Deadline) -> None:
        self._talk.open(deadline)
        # Ends what may have been begun on the line. The first answer only shows that somebody is there.
        self._talk.tell(b"\r", deadline)
        self._value("G", deadline)
        self._told = "".join(_letters(self.settings)) if self._tells("W", deadline) else "G"

    def _shut(self) -> None:
        self._talk.close()

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

    def check(self, seconds: float | None = None) -> dict[str, str]:
        """Who it is, and whether its settings are those that were pushed."""
        found = {"identity": str(self.connect(seconds))}
        self.verify(seconds)
        alone = len(self._told) == 1
        return found | {"settings": "gain as pushed; it tells no other" if alone else "as pushed"}

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

    def _set(self, letter: str, value: int, deadline: Deadline) -> None:
        self._talk.tell(encode(Setting(letter, value)), deadline)
        self._verify({letter: value}, deadline)

    def _verify(self, wanted: Mapping[str, int], deadline: Deadline) -> None:
        for letter, value in wanted.items():
            if letter in self._told and (found := self._value(letter, deadline)) != value:
                raise StateError(
                    f"has {letter} = {found} and not {value}", do="is it in local mode, or was it off?"
                )

    def _tells(self, letter: str, deadline: Deadline) -> bool:
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
        line = self._talk.ask(
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
