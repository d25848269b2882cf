"""Connections that somebody holds without using them are closed: slow heads, slow readers, and too many."""

from __future__ import annotations

import asyncio
from typing import Any, ClassVar

from uvicorn.protocols.http.h11_impl import H11Protocol

_HEAD_S, _READ_S = 10.0, 30.0
"""Time in which the head of a request must arrive, and how long a client may not read."""
_MOST_WAITING = 250
"""Connections without a request that is being answered; beyond these the oldest is closed."""


class PatientProtocol(H11Protocol):
    """HTTP/1.1 of uvicorn with limits on time."""

    _all_waiting: ClassVar[dict[PatientProtocol, None]] = {}
    _head: asyncio.TimerHandle | None = None
    _reading: asyncio.TimerHandle | None = None
    _closing: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Wait for the first request."""
        super().connection_made(transport)
        self._wait()

    def data_received(self, data: bytes) -> None:
        """Take what arrived; what is no whole head yet must become one in time."""
        super().data_received(data)
        if self.cycle is not None and not self.cycle.response_complete:
            self._no_longer()
        elif self._head is None:
            self._wait()

    def on_response_complete(self) -> None:
        """Wait for the next request, or for the client to read the answer: it may be on its way."""
        super().on_response_complete()
        if self.cycle is None or self.cycle.response_complete:
            self._count()

    def timeout_keep_alive_handler(self) -> None:
        """Close a connection without requests, also where the client does not read the end of it."""
        super().timeout_keep_alive_handler()
        if self._closing is None:
            self._closing = self.loop.call_later(_READ_S, self.transport.abort)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        self._no_longer()
        for timer in (self._reading, self._closing):
            if timer is not None:
                timer.cancel()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Wait for a client that does not read, for a while."""
        super().pause_writing()
        self._reading = self.loop.call_later(_READ_S, self.transport.abort)

    def resume_writing(self) -> None:
        """Go on writing."""
        if self._reading is not None:
            self._reading.cancel()
            self._reading = None
        super().resume_writing()

    def _wait(self) -> None:
        self._head = self.loop.call_later(_HEAD_S, self._late)
        self._count()

    def _count(self) -> None:
        """Count this connection among those that wait, as the youngest."""
        self._all_waiting.pop(self, None)
        self._all_waiting[self] = None
        if len(self._all_waiting) > _MOST_WAITING:
            next(iter(self._all_waiting))._late()

    def _no_longer(self) -> None:
        self._all_waiting.pop(self, None)
        if self._head is not None:
            self._head.cancel()
            self._head = None

    def _late(self) -> None:
        self._no_longer()
        self.transport.abort()
