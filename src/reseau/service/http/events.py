"""Events of the service: numbered, kept for a while, and resumed where a client lost its connection."""

from __future__ import annotations

import asyncio
import json
import secrets
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any

__all__ = ["Event", "Events"]

_KEPT, _WAITING, _BEAT_S = 5000, 1000, 10.0
_MOST_CLIENTS = 500


@dataclass(frozen=True, eq=False)
class Event:
    """An event.

    Parameters
    ----------
    number : int
        Increases from event to event of one start of the service.
    kind, about : str
        What happened, and to what: ``archive`` and the name of a table, ``bench`` and its name.
    facts : dict
        Values.
    at : str
        When, ISO 8601.

    Examples
    --------
    >>> Event(1, "archive", "frames", {"last": 7}, "2026-03-02T08:00:00+00:00").about
    'frames'
    """

    number: int
    kind: str
    about: str
    facts: dict[str, Any]
    at: str

    def text(self, start: str) -> str:
        """Return it as a server-sent event; its id names the start of the service, too."""
        return _text(self, start)


@lru_cache(maxsize=256)  # it is the same for all clients
def _text(event: Event, start: str) -> str:
    document = {"kind": event.kind, "about": event.about, "at": event.at, "facts": event.facts}
    return f"id: {start}-{event.number}\nevent: change\ndata: {json.dumps(document, default=str)}\n\n"


_Queue = asyncio.Queue[Event | None]


class Events:
    """The events of one start of the service.

    Examples
    --------
    >>> events = Events()
    >>> events.publish("archive", "frames", {"last": 7}).number
    1
    >>> found, complete = events.after(f"{events.start}-0")
    >>> len(found), complete, events.after("another-5")[1]
    (1, True, False)
    """

    def __init__(self) -> None:
        self.start = secrets.token_hex(4)
        self._kept: deque[Event] = deque(maxlen=_KEPT)
        self._lock, self._number = threading.Lock(), 0
        self._clients: set[tuple[asyncio.AbstractEventLoop, _Queue]] = set()
        self._closed = False

    @property
    def clients(self) -> int:
        """Number of clients."""
        return len(self._clients)

    @property
    def full(self) -> bool:
        """Whether there are as many clients as are served."""
        return len(self._clients) >= _MOST_CLIENTS

    def publish(self, kind: str, about: str, facts: dict[str, Any] | None = None) -> Event:
        """Publish an event, from any thread."""
        with self._lock:
            self._number += 1
            at = datetime.now(UTC).isoformat(timespec="milliseconds")
            event = Event(self._number, kind, about, dict(facts or {}), at)
            self._kept.append(event)
            # Handed over in their order, which the lock keeps.
            loops: dict[asyncio.AbstractEventLoop, list[_Queue]] = {}
            for loop, client in self._clients:
                loops.setdefault(loop, []).append(client)
            for loop, clients in loops.items():
                self._hand(loop, clients, event)
        return event

    @staticmethod
    def _hand(loop: asyncio.AbstractEventLoop, clients: list[_Queue], event: Event | None) -> None:
        def put() -> None:
            for queue in clients:
                if queue.full():  # a client that does not read: it resumes where it is
                    while not queue.empty():
                        queue.get_nowait()
                    queue.put_nowait(None)
                else:
                    queue.put_nowait(event)

        if not loop.is_closed():
            loop.call_soon_threadsafe(put)

    def after(self, last: str) -> tuple[list[Event], bool]:
        """Return the events after the one with this id, and whether none is missing."""
        with self._lock:
            kept = list(self._kept)
        return self._after(kept, last)

    def _after(self, kept: list[Event], last: str) -> tuple[list[Event], bool]:
        start, _, number = last.rpartition("-")
        if not last:
            return [], True
        if start != self.start or not number.isdigit():
            return [], False
        oldest = kept[0].number if kept else self._number + 1
        return [each for each in kept if each.number > int(number)], int(number) >= oldest - 1

    def close(self) -> None:
        """End all streams."""
        self._closed = True
        for loop, queue in list(self._clients):
            self._hand(loop, [queue], None)

    async def stream(self, last: str, valid: Callable[[], bool]) -> AsyncIterator[str]:
        """Yield server-sent events: those after `last`, then new ones while the client is `valid`.

        Where events are missing, because the service was restarted or the client was away for long, the first
        event is ``reset``: what the client shows must be fetched again.
        """
        queue: _Queue = asyncio.Queue(_WAITING)
        client = asyncio.get_running_loop(), queue
        with self._lock:  # later events are in the queue, earlier ones among those that are kept
            self._clients.add(client)
            sent = self._number
            kept = list(self._kept)
        try:
            missed, complete = self._after(kept, last)
            yield "retry: 1000\n\n"
            if not complete or not last:
                kind = "start" if complete else "reset"
                yield f"id: {self.start}-{sent}\nevent: {kind}\ndata: {{}}\n\n"
            check = time.monotonic() + _BEAT_S
            for event in missed:
                yield event.text(self.start)
            while not self._closed:
                if time.monotonic() >= check:
                    check = time.monotonic() + _BEAT_S
                    if not await asyncio.to_thread(valid):
                        yield "event: end\ndata: {}\n\n"
                        return
                    yield ": still here\n\n"
                try:
                    next_one = await asyncio.wait_for(queue.get(), check - time.monotonic())
                except TimeoutError:
                    continue
                if next_one is None:
                    return
                if next_one.number > sent:
                    sent = next_one.number
                    yield next_one.text(self.start)
        finally:
            with self._lock:
                self._clients.discard(client)
