"""The operator of the simulated laboratory, who fills the tank, covers the lens, and provides light."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from .faults import Kind
from .machine import Machine


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


class SimulatedHands(Machine):
    r"""A person who moves the axes of a table, and reads their scales.

    Parameters
    ----------
    axes : iterable of str
        Names of the axes.
    error : float
        Standard deviation with which an axis is set.
    seed : int
        Seed of these errors.

    Examples
    --------
    >>> hands = SimulatedHands(["tilt"], error=0.0)
    >>> hands.receive(b'{"request": "set tilt to 30 deg, and read its scale", "unit": "deg"}\n')
    [b'{"done": true, "value": 30.0}\n']
    """

    _SET = re.compile(r"set (\w+) to (-?\d+(?:\.\d+)?(?:e-?\d+)?)")
    _READ = re.compile(r"read the scale of (\w+)")

    def __init__(self, axes: Iterable[str], *, error: float = 0.02, seed: int = 0) -> None:
        super().__init__()
        self.places = dict.fromkeys(axes, 0.0)
        self._rng, self._error, self._line = np.random.default_rng(seed), error, b""
        self._trouble: Kind | None = None

    def position(self, axis: str) -> float:
        """Return where an axis stands."""
        with self.lock:
            return self.places[axis]

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
        trouble, self._trouble = self._trouble, None
        found = self._SET.search(request) or self._READ.search(request)
        if found is None or found[1] not in self.places:
            self.violations.append(f"cannot: {request}")
            return {"error": f"cannot: {request}"}
        if trouble in ("stuck", "power-cycled"):
            return {"error": "the axis is stuck" if trouble == "stuck" else "was away"}
        if found.re is self._SET:
            error = 9.0 if trouble == "wrong state" else self._error * float(self._rng.normal())
            self.places[found[1]] = float(found[2]) + error
        read = 1e9 if trouble == "out of range" else round(self.places[found[1]], 2)
        return {"done": True, "value": read}

    def inject_fault(self, kind: Kind) -> None:
        """Stuck: cannot set the axis; wrong state: sets it wrongly; out of range: misreads it."""
        self._trouble = kind

    def disconnected(self) -> None:
        """Discard an incomplete line."""
        self._line = b""
