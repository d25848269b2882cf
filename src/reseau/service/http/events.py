"""Events of the service: numbered, kept for a while, and resumed where a client lost its connection."""

from __future__ import annotations

import asyncio
import json
import secrets
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ...archive import Archive


_KEPT, _WAITING, _BEAT_S = 5000, 1000, 10.0
_MOST_CLIENTS, _PART = 500, 100
BLUESKY = ("start", "descriptor", "event", "stop")
"""Kinds of bluesky's documents."""


@dataclass(frozen=True, eq=False, slots=True)
class Event:
    """An event, as it is sent to all clients: thousands are kept, each as one text.

    Parameters
    ----------
    number : int
        Increases from event to event of one start of the service.
    kind, about : str
        What happened, and to what: ``archive`` and the name of a table, ``bench`` and its name.
    text : str
        The server-sent event; its id names the start of the service, too.

    Examples
    --------
    >>> Events().publish("archive", "frames", {"last": 7}).text.splitlines()[1]
    'event: change'
    """

    number: int
    kind: str
    about: str
    text: str


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
            document = {"kind": kind, "about": about, "at": at, "facts": dict(facts or {})}
            data = json.dumps(document, default=str)
            text = f"id: {self.start}-{self._number}\nevent: change\ndata: {data}\n\n"
            event = Event(self._number, kind, about, text)
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
        with self._client() as (queue, kept, sent):
            missed, complete = self._after(kept, last)
            yield "retry: 1000\n\n"
            if not complete or not last:
                kind = "start" if complete else "reset"
                yield f"id: {self.start}-{sent}\nevent: {kind}\ndata: {{}}\n\n"
            check = time.monotonic() + _BEAT_S
            for event in missed:
                yield event.text
            while not self._closed:
                if time.monotonic() >= check:
                    check = time.monotonic() + _BEAT_S
                    if not await asyncio.to_thread(valid):
                        yield "event: end\ndata: {}\n\n"
                        return
                    yield "event: beat\ndata: {}\n\n"  # a client that hears nothing is cut off
                try:
                    next_one = await asyncio.wait_for(queue.get(), check - time.monotonic())
                except TimeoutError:
                    continue
                if next_one is None:
                    return
                if next_one.number > sent:
                    sent = next_one.number
                    yield next_one.text

    async def documents(self, archive: Archive, last: int, valid: Callable[[], bool]) -> AsyncIterator[str]:
        """Yield bluesky's documents as server-sent events, those after a number, then new ones.

        Their ids are their numbers in the archive: a stream is resumed whatever happened to the service.
        """
        with self._client() as (queue, _, _):
            yield "retry: 1000\n\n"
            check = time.monotonic() + _BEAT_S
            while not self._closed:
                while found := await asyncio.to_thread(archive.notes, last, _PART):
                    last = found[-1].number
                    for each in found:
                        if each.kind in BLUESKY:
                            content = {"session": each.session, "name": each.kind, "document": each.document}
                            yield f"id: {each.number}\nevent: {each.kind}\ndata: {json.dumps(content)}\n\n"
                while not any(about == "events" for about in await _all_of(queue, check)):
                    if self._closed:
                        return
                    if time.monotonic() >= check:
                        check = time.monotonic() + _BEAT_S
                        if not await asyncio.to_thread(valid):
                            yield "event: end\ndata: {}\n\n"
                            return
                        yield "event: beat\ndata: {}\n\n"

    @contextmanager
    def _client(self) -> Iterator[tuple[_Queue, list[Event], int]]:
        """The queue of a client; the events that are kept, and the number of the last one."""
        queue: _Queue = asyncio.Queue(_WAITING)
        client = asyncio.get_running_loop(), queue
        with self._lock:  # later events are in the queue, earlier ones among those that are kept
            self._clients.add(client)
            kept, sent = list(self._kept), self._number
        try:
            yield queue, kept, sent
        finally:
            with self._lock:
                self._clients.discard(client)


async def _all_of(queue: _Queue, until: float) -> list[str]:
    """What the events of a queue are about, as soon as there is one; nothing when it is late."""
    found = list[str]()
    try:
        event = await asyncio.wait_for(queue.get(), max(0.0, until - time.monotonic()))
    except TimeoutError:
        return found
    while True:
        found.append("events" if event is None else event.about)  # None: events were left out, or it ends
        if queue.empty():
            return found
        event = queue.get_nowait()
