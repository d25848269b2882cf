"""Values of an instrument as they change, for bluesky's `monitor`."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from ..core.errors import InstrumentError

Reading = dict[str, dict[str, Any]]
Subscriber = Callable[[Reading], None]


class Monitor:
    """Reads again and again while somebody wants to know, and tells what has changed.

    Parameters
    ----------
    read : callable
        Takes a reading.
    every_s : float
        Time between two readings (s).

    Notes
    -----
    A reading that fails is left out: a monitor must not end a run. The first reading is reported at once.

    Examples
    --------
    >>> values, seen = iter([1.0, 1.0, 2.0] + [2.0] * 99), threading.Event()
    >>> noted = []
    >>> def note(reading):
    ...     noted.append(reading["x"]["value"])
    ...     if len(noted) == 2:
    ...         seen.set()
    >>> monitor = Monitor(lambda: {"x": {"value": next(values), "timestamp": 0.0}}, every_s=0.001)
    >>> monitor.subscribe(note)
    >>> seen.wait(10.0)
    True
    >>> monitor.clear(note)
    >>> noted
    [1.0, 2.0]
    """

    def __init__(self, read: Callable[[], Reading], every_s: float = 0.1) -> None:
        self._read, self._every_s = read, every_s
        self._lock = threading.Lock()
        self._subscribers: list[Subscriber] = []
        self._over = threading.Event()

    def subscribe(self, function: Subscriber) -> None:
        """Call a function with each new reading, in a thread of the monitor."""
        with self._lock:
            self._subscribers.append(function)
            if len(self._subscribers) > 1:
                return
            self._over = threading.Event()
            threading.Thread(target=self._run, args=(self._over,), name="monitor", daemon=True).start()

    def clear(self, function: Subscriber) -> None:
        """Stop calling a function; without any, nothing is read."""
        with self._lock:
            if function in self._subscribers:
                self._subscribers.remove(function)
            if not self._subscribers:
                self._over.set()

    def _run(self, over: threading.Event) -> None:
        last: dict[str, Any] | None = None
        while not over.is_set():
            try:
                reading = self._read()
            except InstrumentError:
                over.wait(self._every_s)
                continue
            values = {name: each["value"] for name, each in reading.items()}
            with self._lock:
                subscribers = list(self._subscribers) if values != last else []
            for function in subscribers:
                function(reading)
            last = values
            over.wait(self._every_s)
