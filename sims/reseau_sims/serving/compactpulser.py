"""Simulated CompactPulser: settings by single letters; only queries are answered.

Source: see :mod:`reseau_drivers.codecs.compactpulser`.
"""

from __future__ import annotations

from collections.abc import Sequence

from reseau.core.errors import ProtocolError
from reseau_drivers.codecs.compactpulser import LETTERS, LIMIT, Setting, decode, encode_answer
from reseau_drivers.codecs.stream import Damaged, LineDecoder

from .faults import Kind
from .machine import Machine

_START = {"P": 0, "W": 100, "V": 100, "D": 1, "M": 0, "T": 0, "G": 5}


class CompactPulser(Machine):
    r"""Simulated pulser; `values` contains its values by letter.

    Parameters
    ----------
    readable : str
        Letters that can be queried.

    Examples
    --------
    >>> pulser = CompactPulser()
    >>> pulser.receive(b"V120\rV?\r")
    [b'V=120\r']
    """

    def __init__(self, readable: str = "".join(LETTERS)) -> None:
        super().__init__()
        self._readable = readable
        self._lines = LineDecoder(end=b"\r", limit=LIMIT)
        self.values = dict(_START)
        self._ignore_command, self._silent, self._wrong_value = False, 0, False

    def receive(self, data: bytes) -> Sequence[bytes]:
        """Return the answers to queries."""
        answers: list[bytes] = []
        for line in self._lines.feed(data):
            try:
                if isinstance(line, Damaged):
                    raise ProtocolError(str(line))
                setting, is_answer = decode(line)
                if is_answer:
                    raise ProtocolError(f"an unexpected answer: {line!r}")
            except ProtocolError as error:
                self.violations.append(error.what)
                continue
            if setting.value is not None:
                if not self._ignore_command:
                    self.values[setting.letter] = setting.value
                self._ignore_command = False
            elif setting.letter not in self._readable:
                continue
            elif self._silent:
                self._silent -= 1
            else:
                value = self.values[setting.letter] + (1000 if self._wrong_value else 0)
                self._wrong_value = False
                answers.append(encode_answer(Setting(setting.letter, value)))
        return answers

    def disconnected(self) -> None:
        """Discard an incomplete command."""
        self._lines.reset()

    def inject_fault(self, kind: Kind) -> None:
        """Stuck: one answer is missing; wrong state: one command is ignored; out of range: a wrong value."""
        if kind == "stuck":
            self._silent = 1
        self._ignore_command = self._ignore_command or kind == "wrong state"
        self._wrong_value = self._wrong_value or kind == "out of range"
        if kind == "power-cycled":
            self.values = {letter: _START[letter] for letter in LETTERS}
