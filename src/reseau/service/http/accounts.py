"""Operations on logins, users and tokens."""

from __future__ import annotations

from datetime import timedelta
from typing import Annotated

from fastapi import APIRouter, Path, Request, Response
from pydantic import ConfigDict, Field

from ..accounts import RefusedLogin, Scope
from .access import Administering, Forbidden, Here, NotFound, Operating, Reading, csrf_of
from .answers import Answer, Done, refusals

__all__ = ["router", "set_cookie"]

router = APIRouter(tags=["accounts"], responses=refusals(400, 401, 403, 422, 503))

Named = Annotated[str, Path(max_length=80, description="Its name.")]


class Me(Answer):
    """Who makes the request."""

    name: str
    scope: Scope
    via: str
    csrf: str | None = Field(description="With a login: the value for X-CSRF-Token.")

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={"example": {"name": "Ada", "scope": "operate", "via": "token", "csrf": None}},
    )


class Login(Answer):
    """Name and password; the code only for users who need one."""

    name: str = Field(max_length=80)
    password: str = Field(max_length=1000)
    code: str = Field(default="", max_length=10)

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"example": {"name": "Ada", "password": "correct horse battery"}}
    )


class NewPassword(Answer):
    """The present password, and a new one."""

    password: str = Field(max_length=1000)
    new: str = Field(min_length=12, max_length=1000)
    code: str = Field(default="", max_length=10)


class NewUser(Answer):
    """A user."""

    name: str = Field(min_length=1, max_length=80)
    password: str = Field(min_length=12, max_length=1000)
    scope: Scope = "read"

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "example": {"name": "Ada", "password": "correct horse battery", "scope": "operate"}
        },
    )


class UserAnswer(Answer):
    """A user, without secrets."""

    name: str
    scope: Scope
    one_time: bool
    created: str


class NewToken(Answer):
    """A token."""

    name: str = Field(min_length=1, max_length=80)
    scope: Scope = "read"
    days: int = Field(default=90, ge=1, le=731)

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"example": {"name": "plotter", "scope": "read", "days": 90}}
    )


class TokenAnswer(Answer):
    """A token, without its secret."""

    name: str
    scope: Scope
    made_by: str
    created: str
    expires: str
    revoked: str | None


class Secret(Answer):
    """A secret that is shown this once."""

    name: str
    secret: str


class Entry(Answer):
    """An address that lets a browser of this machine in, once, within ten minutes."""

    path: str


def set_cookie(response: Response, service: Here, value: str) -> None:
    """Give a browser the cookie of a login: for our own pages only, and not for scripts."""
    response.set_cookie(
        service.cookie, value, max_age=12 * 3600, path="/", httponly=True, samesite="strict",
        secure=service.options.encrypted,
    )  # fmt: skip


@router.get("/me")
def me(request: Request, who: Reading, service: Here) -> Me:
    """Who I am, and what I may do."""
    cookie = request.cookies.get(service.cookie, "")
    bearer = "authorization" in request.headers
    return Me(name=who.name, scope=who.scope, via=who.via, csrf=None if bearer else csrf_of(cookie))


@router.post("/login", responses=refusals(429))
def login(request: Request, response: Response, given: Login, service: Here) -> Done:
    """Log in with a password; the answer sets a cookie."""
    # Without a cookie there is no token against forged requests: a page of ours sends its origin.
    if "origin" not in request.headers and "sec-fetch-site" not in request.headers:
        raise Forbidden("needs the header Origin", where="login")
    address = request.client.host if request.client else ""
    try:
        cookie = service.accounts.log_in(given.name, given.password, given.code, address)
    except RefusedLogin as error:
        service.meters.logins.labels("wait" if error.wait_s else "refused").inc()
        service.audit.record(given.name[:80], "login", "login refused", "service", {"address": address})
        raise
    service.meters.logins.labels("done").inc()
    set_cookie(response, service, cookie)
    return Done(done="logged in")


@router.post("/logout")
def logout(request: Request, response: Response, who: Reading, service: Here) -> Done:
    """Log out."""
    service.accounts.log_out(request.cookies.get(service.cookie, ""))
    response.delete_cookie(service.cookie, path="/")
    return Done(done="logged out")


@router.put("/me/password", responses=refusals(429))
def change_password(request: Request, given: NewPassword, who: Reading, service: Here) -> Done:
    """Change my password; all my logins end."""
    if who.via != "login":
        raise Forbidden("has no password", where=who.name)
    address = request.client.host if request.client else ""
    service.accounts.log_in(who.name, given.password, given.code, address)
    with service.audited(who, "change password", f"user {who.name}"):
        service.accounts.set_password(who.name, given.new)
    return Done(done="changed; log in again")


@router.post("/me/one-time")
def require_code(who: Reading, service: Here) -> Secret:
    """Require a one-time password for my logins; the secret is an address for an authenticator."""
    if who.via != "login":
        raise Forbidden("has no password", where=who.name)
    with service.audited(who, "require one-time password", f"user {who.name}"):
        return Secret(name=who.name, secret=service.accounts.require_code(who.name))


@router.get("/users")
def users(who: Administering, service: Here) -> list[UserAnswer]:
    """All users."""
    return [
        UserAnswer(name=u.name, scope=u.scope, one_time=u.one_time, created=u.created.isoformat())
        for u in service.accounts.users()
    ]


@router.post("/users", status_code=201)
def add_user(given: NewUser, who: Administering, service: Here) -> Done:
    """Add a user."""
    with service.audited(who, "add user", f"user {given.name}", {"scope": given.scope}):
        service.accounts.add_user(given.name, given.password, given.scope)
    return Done(done="added")


@router.delete("/users/{name}")
def remove_user(name: Named, who: Administering, service: Here) -> Done:
    """Remove a user, and end their logins."""
    with service.audited(who, "remove user", f"user {name}"):
        service.accounts.remove_user(name)
    return Done(done="removed")


@router.get("/tokens")
def tokens(who: Administering, service: Here) -> list[TokenAnswer]:
    """All tokens, also those that have ended; without their secrets."""
    return [
        TokenAnswer(
            name=t.name, scope=t.scope, made_by=t.made_by, created=t.created.isoformat(),
            expires=t.expires.isoformat(), revoked=None if t.revoked is None else t.revoked.isoformat(),
        )
        for t in service.accounts.tokens()
    ]  # fmt: skip


@router.post("/tokens", status_code=201)
def create_token(given: NewToken, who: Administering, service: Here) -> Secret:
    """Create a token for a program; its secret is shown this once."""
    with service.audited(
        who, "create token", f"token {given.name}", {"scope": given.scope, "days": given.days}
    ):
        made = service.accounts.create_token(given.name, given.scope, timedelta(days=given.days), who.name)
    return Secret(name=given.name, secret=made)


@router.delete("/tokens/{name}", responses=refusals(404))
def revoke_token(name: Named, who: Administering, service: Here) -> Done:
    """Revoke a token."""
    if name not in {each.name for each in service.accounts.tokens()}:
        raise NotFound("is no token", where=name)
    with service.audited(who, "revoke token", f"token {name}"):
        service.accounts.revoke_token(name)
    return Done(done="revoked")


@router.post("/entries", status_code=201)
def entry(who: Operating, service: Here) -> Entry:
    """An address with which a browser of this machine is let in, for programs of the user of the service."""
    if who.via != "local":
        raise Forbidden("is for programs of the user of the service", where="entries")
    return Entry(path=f"/enter?code={service.entry_code()}")
