"""The application: routes under one guard, and the server that carries it."""

from __future__ import annotations

import asyncio
import logging
import signal
import sys
from collections.abc import Callable
from typing import Any, ClassVar

import uvicorn
from fastapi import FastAPI, Request
from uvicorn.protocols.http.h11_impl import H11Protocol

from ...core.errors import UsageError
from ...core.memory import share_freed_memory
from ...core.version import __version__
from . import (
    accounts,
    benches,
    calibrations,
    comparisons,
    files,
    history,
    operations,
    orders,
    pages,
    sessions,
)
from .access import principal_of
from .answers import add_error_handlers
from .guard import Guard, log
from .options import ServeOptions
from .service import Service

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


API = "/api/1"
_CIPHERS = "ECDHE+AESGCM:ECDHE+CHACHA20"
"""Of TLS 1.2: with forward secrecy and authenticated; those of TLS 1.3 all are."""
_ABOUT = """Acquisition and calibration of measuring cameras and imaging instruments.

Requests need `Authorization: Bearer TOKEN`, or the cookie of a login, with `X-CSRF-Token` to change anything.
Scopes: `read`; `operate` (move, acquire, upload); `administer` (decide on calibrations, accounts)."""
_SECURITY = {"token": {"type": "http", "scheme": "bearer"}}


def create_app(service: Service) -> Any:
    """Return the ASGI application of a service.

    Parameters
    ----------
    service : Service
        The service, which is entered already.
    """
    app = FastAPI(
        title="reseau", version=__version__, description=_ABOUT, openapi_url=f"{API}/openapi.json",
        docs_url=None, redoc_url=None, redirect_slashes=False,
    )  # fmt: skip
    app.state.service = service
    add_error_handlers(app, pages.rendered_error)
    for each in (
        operations.open_router,
        operations.router,
        accounts.router,
        sessions.router,
        calibrations.router,
        comparisons.router,
        history.router,
        files.router,
        benches.router,
        orders.router,
    ):
        app.include_router(each, prefix=API)
    app.include_router(pages.router)
    plain = app.openapi

    def openapi() -> dict[str, Any]:
        document = plain()
        document.setdefault("components", {})["securitySchemes"] = _SECURITY
        document["security"] = [{"token": []}]
        return document

    app.openapi = openapi  # type: ignore[method-assign]

    def known(scope: Any) -> bool:
        return principal_of(Request({**scope, "app": app})) is not None

    return Guard(app, service.options, service.meters, known)


def serve(options: ServeOptions, said: Callable[[str], None], ready: Callable[[Service], None]) -> None:
    """Serve until a signal ends it.

    Parameters
    ----------
    options : ServeOptions
        Its options.
    said : callable
        Takes lines for the console.
    ready : callable
        Called with the service when it answers.

    Raises
    ------
    UsageError
        If the address cannot be used.
    ReseauError
        As :class:`Service`.
    """
    import dataclasses

    share_freed_memory()
    sock = _bound(options)
    options = dataclasses.replace(options, port=sock.getsockname()[1])
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    logger = logging.getLogger("reseau.service")
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(logging.INFO)
    with sock, Service(options) as service:
        config = uvicorn.Config(
            create_app(service), log_config=None, access_log=False, server_header=False, date_header=True,
            proxy_headers=bool(options.proxy), http=PatientProtocol, ssl_certfile=options.certificate,
            ssl_keyfile=options.key, timeout_keep_alive=15, timeout_graceful_shutdown=3,
            limit_concurrency=1000, lifespan="off", ssl_ciphers=_CIPHERS,
        )  # fmt: skip
        server = _Server(config, service, ready)
        log("started", port=options.port, archive=service.archive.place)
        for origin in sorted(options.origins)[:1]:
            said(f"{origin}/  (Ctrl-C ends)")
        # uvicorn raises the signal that ended it again; it has done its work then.
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: None)
        server.run(sockets=[sock])
        log("ended")


class _Server(uvicorn.Server):
    """Says when it is ready, and ends the streams of events before it ends."""

    def __init__(self, config: uvicorn.Config, service: Service, ready: Callable[[Service], None]) -> None:
        super().__init__(config)
        self._service, self._ready = service, ready

    async def startup(self, sockets: list[Any] | None = None) -> None:
        await super().startup(sockets)
        self._ready(self._service)

    async def shutdown(self, sockets: list[Any] | None = None) -> None:
        self._service.events.close()
        await super().shutdown(sockets)


def _bound(options: ServeOptions) -> Any:
    import socket

    family = socket.AF_INET6 if ":" in options.host else socket.AF_INET
    # With the protocol named, asyncio sets TCP_NODELAY; without it each answer would wait 40 ms for an ACK.
    sock = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind((options.host, options.port))
        sock.listen(512)
    except OSError as error:
        sock.close()
        raise UsageError(
            f"cannot be used ({error.strerror})", where=f"{options.host}:{options.port}"
        ) from None
    return sock
