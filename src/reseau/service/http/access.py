"""Who makes a request: token, login, or a program of the same user; and what they may do."""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable
from typing import Annotated

from fastapi import Depends, Request

from ...core.errors import ReseauError
from ..accounts import LOCAL, Principal, Scope
from .options import is_loopback
from .service import Service

_UNSAFE = {"POST", "PUT", "PATCH", "DELETE"}


class Unknown(ReseauError):
    """Nobody is named in the request, or the login has ended."""


class Forbidden(ReseauError):
    """Whoever makes the request may not do this."""


class NotFound(ReseauError):
    """There is no such thing."""


def service_of(request: Request) -> Service:
    """Return the service of a request."""
    found: Service = request.app.state.service
    return found


async def _here(request: Request) -> Service:  # a coroutine needs no thread
    return service_of(request)


def csrf_of(cookie: str) -> str:
    """Return what a request with a cookie must repeat to change anything; other sites cannot know it.

    Examples
    --------
    >>> csrf_of("a") == csrf_of("b")
    False
    """
    return hashlib.sha256(b"csrf of " + cookie.encode("utf-8", "replace")).hexdigest()


def by_cookie(request: Request) -> bool:
    """Whether a request is let in, if at all, by its cookie, which browsers send without being asked."""
    return not _header(request)


def _header(request: Request) -> str:
    return request.headers.get("authorization", "").strip()


def principal_of(request: Request) -> Principal | None:
    """Return who makes a request, or None."""
    service = service_of(request)
    kind, _, secret = _header(request).partition(" ")
    if kind:
        if kind.lower() != "bearer":
            return None
        client = request.client
        local = client is not None and is_loopback(client.host) and not service.options.proxy
        if local and hmac.compare_digest(secret.encode(), service.state.local_token().encode()):
            return Principal(LOCAL, "administer", "local")
        return service.accounts.of_token(secret)
    cookie = request.cookies.get(service.cookie)
    return None if cookie is None else service.accounts.of_cookie(cookie)


def _needs(scope: Scope) -> Callable[[Request], Principal]:
    def dependency(request: Request) -> Principal:
        who = principal_of(request)
        if who is None:
            raise Unknown("needs a token or a login", where=request.url.path)
        request.state.who = who.name
        service = service_of(request)
        if request.method in _UNSAFE and by_cookie(request):
            given = request.headers.get("x-csrf-token", "")
            if not hmac.compare_digest(
                given.encode(), csrf_of(request.cookies.get(service.cookie, "")).encode()
            ):
                raise Forbidden("needs the header X-CSRF-Token of this login", where=request.url.path)
        if not who.may(scope):
            raise Forbidden(f"needs the scope {scope}; {who.name} has {who.scope}", where=request.url.path)
        return who

    return dependency


operating = _needs("operate")
Here = Annotated[Service, Depends(_here)]
Reading = Annotated[Principal, Depends(_needs("read"))]
Operating = Annotated[Principal, Depends(operating)]
Administering = Annotated[Principal, Depends(_needs("administer"))]
