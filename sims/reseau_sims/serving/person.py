"""The operator of the simulated laboratory, who fills the tank, covers the lens, and provides light."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence

from .faults import Kind
from .machine import Machine

__all__ = ["SimulatedOperator"]


class SimulatedOperator(Machine):
    r"""Carries out requests, a line of JSON each.

    Parameters
    ----------
    acts : mapping of str to callable
        What to do if a request contains these words; the first that it contains counts.

    Examples
    --------
    >>> operator = SimulatedOperator({"cover": lambda: print("dark")})
    >>> operator.receive(b'{"request": "cover the lens"}\n')
    dark
    [b'{"done": true}\n']
    >>> operator.receive(b'{"request": "make tea"}\n')
    [b'{"error": "the simulated operator cannot: make tea"}\n']
    """

    def __init__(self, acts: Mapping[str, Callable[[], None]]) -> None:
        super().__init__()
        self._acts, self._line = dict(acts), b""

    def receive(self, data: bytes) -> Sequence[bytes]:
        """Carry out the requests in these bytes."""
        *lines, self._line = (self._line + data).split(b"\n")
        return [json.dumps(self._answer(line)).encode() + b"\n" for line in lines]

    def _answer(self, line: bytes) -> dict[str, object]:
        try:
            request = str(json.loads(line)["request"])
        except (ValueError, KeyError, TypeError):
            self.violations.append(f"no request: {line[:80]!r}")
            return {"error": "is no request"}
        for words, act in self._acts.items():
            if words in request:
                act()
                return {"done": True}
        return {"error": f"the simulated operator cannot: {request}"}

    def inject_fault(self, kind: Kind) -> None:
        """Operators make no mistakes here."""

    def disconnected(self) -> None:
        """Discard an incomplete line."""
        self._line = b""
