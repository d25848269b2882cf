"""What every request passes first: names and origins that are allowed, sizes, headers, counters and the log.

A request for another name than ours comes from a page whose site lets its name resolve to this machine (DNS
rebinding); a request with another origin comes from a page of another site. Both are refused before anything
else is looked at, also where a browser would send a cookie.
"""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
import time
from collections.abc import Awaitable, Callable, MutableMapping
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from starlette.exceptions import HTTPException

from .options import ServeOptions

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]

_LOG = logging.getLogger("reseau.service")
ARRIVED: ContextVar[float] = ContextVar("arrived")
"""When the present request arrived (`time.monotonic`), however long it waits for a thread or a record."""
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
    "manifest-src 'self'; frame-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    b"content-security-policy": _POLICY.encode(),
    b"x-content-type-options": b"nosniff",
    b"x-frame-options": b"DENY",
    b"referrer-policy": b"no-referrer",
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
    b"permissions-policy": b"camera=(), microphone=(), geolocation=(), payment=(), usb=()",
    b"cache-control": b"no-store",
}
_STRICT = b"max-age=31536000"
SMALL_BODY, LARGE_BODY = 1 << 20, 1 << 30
"""Largest body of a request, and of an upload (bytes)."""
_LOGIN_BODY = 16 << 10
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
UPLOADS, LOGIN = "/api/1/uploads", "/api/1/login"
_BODY_S, _BODY_PER_S = 20.0, 8192
"""Time that a body may take, besides that at the least rate (bytes/s)."""


class Meters:
    """Counters of the service, for Prometheus.

    Examples
    --------
    >>> Meters().registry.get_sample_value("reseau_event_clients")
    0.0
    """

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        named = ("method", "route", "status")
        self.requests = Counter("reseau_requests", "Requests.", named, registry=self.registry)
        bounds = (0.005, 0.01, 0.025, 0.05, 0.1, 0.2, 0.5, 1.0, 2.5, 10.0)
        self.seconds = Histogram(
            "reseau_request_seconds", "Time to answer.", ("route",), buckets=bounds, registry=self.registry
        )
        self.refused = Counter(
            "reseau_refused", "Requests refused before they were looked at.", ("why",), registry=self.registry
        )
        self.clients = Gauge("reseau_event_clients", "Open streams of events.", registry=self.registry)
        self.events = Counter("reseau_events", "Events.", ("kind",), registry=self.registry)
        self.logins = Counter("reseau_logins", "Logins.", ("outcome",), registry=self.registry)
        self.workers = Gauge(
            "reseau_worker_up", "Whether the worker of a bench answers.", ("bench",), registry=self.registry
        )
        self.restarts = Counter(
            "reseau_worker_restarts", "Restarts of workers.", ("bench",), registry=self.registry
        )
        self.alarms = Gauge("reseau_alarms_open", "Open alarms.", registry=self.registry)


def log(event: str, **facts: Any) -> None:
    """Write a line of JSON to the log; facts must not contain secrets.

    Examples
    --------
    >>> log("started", port=8480)
    """
    at = datetime.now(UTC).isoformat(timespec="milliseconds")
    _LOG.info(json.dumps({"at": at, "event": event, **facts}, default=str))


class Guard:
    """An ASGI application around another one.

    Parameters
    ----------
    app : callable
        The application.
    options : ServeOptions
        Names and origins.
    meters : Meters
        Counters.
    known : callable, optional
        Tells whether a request is that of somebody who is known: bodies of others are not read.

    Examples
    --------
    >>> Guard(None, ServeOptions("archive"), Meters()).refusal({"host": "evil.example:8480"}, "GET")
    'the name in the request is not one of this service'
    """

    def __init__(
        self, app: Any, options: ServeOptions, meters: Meters, known: Callable[[Scope], bool] | None = None
    ) -> None:
        self.app, self._options, self._meters, self._known = app, options, meters, known

    def refusal(self, headers: MutableMapping[str, str], method: str) -> str:
        """Return why a request is refused; empty if it is not."""
        if headers.get("host", "").lower() not in self._options.hosts:
            return "the name in the request is not one of this service"
        origin = headers.get("origin")
        if origin is not None and origin.lower() not in self._options.origins:
            return "the request comes from a page of another site"
        site, mode = headers.get("sec-fetch-site", "none"), headers.get("sec-fetch-mode", "navigate")
        # A link from another site may lead here; nothing else of it may.
        if site in ("cross-site", "same-site") and not (mode == "navigate" and method == "GET"):
            return "the request comes from a page of another site"
        return ""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":  # there are no WebSockets
            await receive()
            await send({"type": "websocket.close", "code": 1008})
            return
        ARRIVED.set(time.monotonic())
        headers = {k.decode("latin-1"): v.decode("latin-1") for k, v in scope["headers"]}
        hosts = [v for k, v in scope["headers"] if k == b"host"]
        request, begun = secrets.token_hex(4), time.perf_counter()
        scope.setdefault("state", {})["request"] = request
        status, streamed = 0, False

        async def answer(message: MutableMapping[str, Any]) -> None:
            nonlocal status, streamed
            if message["type"] == "http.response.start":
                status = message["status"]
                streamed = any(v.startswith(b"text/event-stream") for _, v in message["headers"])
                there = {k.lower() for k, _ in message["headers"]}
                message["headers"] = [
                    *message["headers"],
                    *((k, v) for k, v in _HEADERS.items() if k not in there),
                    (b"x-request-id", request.encode()),
                ]
                if self._options.encrypted:
                    message["headers"].append((b"strict-transport-security", _STRICT))
            await send(message)

        refusal = self.refusal(headers, scope["method"]) or ("" if len(hosts) == 1 else "several names")
        limit = {UPLOADS: LARGE_BODY, LOGIN: _LOGIN_BODY}.get(scope["path"], SMALL_BODY)
        length = headers.get("content-length", "0")
        if refusal:
            self._meters.refused.labels(refusal.partition(" ")[0]).inc()
            await _plain(answer, 403, refusal)
        elif not length.isdigit() or int(length) > limit:
            await _plain(answer, 413, "the request is too large")
        elif _has_body(scope, headers) and self._known and not await asyncio.to_thread(self._known, scope):
            await _plain(answer, 401, "needs a token or a login", "unknown")
        else:
            await self.app(scope, _limited(receive, limit), answer)
        spent = time.perf_counter() - begun
        route = getattr(scope.get("route"), "path", "other")
        # A method is any word of the client; each would be a counter that is kept.
        method = scope["method"] if scope["method"] in _METHODS else "other"
        self._meters.requests.labels(method, route, str(status)).inc()
        if not streamed:
            self._meters.seconds.labels(route).observe(spent)
        state, client = scope["state"], scope.get("client") or ("", 0)
        log(
            "request", request=request, method=scope["method"], path=scope["path"], status=status,
            ms=round(1e3 * spent, 1), who=state.get("who", ""), address=client[0],
            session=scope.get("path_params", {}).get("session", ""),
            **({"refused": refusal} if refusal else {}),
        )  # fmt: skip


def _limited(receive: Receive, limit: int) -> Receive:
    """Receive at most so many bytes, also where the length was not announced, and not too slowly."""
    total, begun, more = 0, time.monotonic(), True

    async def received() -> MutableMapping[str, Any]:
        nonlocal total, more
        if not more:  # what follows is the end of the connection
            return await receive()
        left = begun + _BODY_S + total / _BODY_PER_S - time.monotonic()
        try:
            message = await asyncio.wait_for(receive(), max(0.0, left))
        except TimeoutError:
            raise HTTPException(400, "the request arrives too slowly") from None
        more = bool(message.get("more_body"))
        total += len(message.get("body", b""))
        if total > limit:
            raise HTTPException(413, "the request is too large")
        return message

    return received


def _has_body(scope: Scope, headers: MutableMapping[str, str]) -> bool:
    there = headers.get("content-length", "0") != "0" or "transfer-encoding" in headers
    return there and scope["path"] != LOGIN


async def _plain(send: Send, status: int, text: str, code: str = "refused") -> None:
    body = json.dumps(
        {"error": {"code": code, "text": text, "what": text, "where": None, "do": None}}
    ).encode()
    headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
    if status == 401:
        headers.append((b"www-authenticate", b"Bearer"))
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
