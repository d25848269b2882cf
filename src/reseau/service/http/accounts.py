"""Operations on logins, users and tokens."""

from __future__ import annotations

from datetime import timedelta
from typing import Annotated

from fastapi import APIRouter, Path, Request, Response
from pydantic import Field

from ..accounts import Principal, Scope, Token, User
from ..attempts import RefusedLogin
from .access import Administering, Forbidden, Here, NotFound, Operating, Reading, by_cookie, csrf_of
from .answers import Answer, Done, refusals

router = APIRouter(tags=["accounts"], responses=refusals(400, 401, 403, 422, 503))

_KNOWN_S = 365 * 86400
Named = Annotated[str, Path(max_length=80, description="Its name.")]


class Me(
    Answer, json_schema_extra={"example": {"name": "Ada", "scope": "operate", "via": "token", "csrf": None}}
):
    """Who makes the request."""

    name: str
    scope: Scope
    via: str
    csrf: str | None = Field(description="With a login: the value for X-CSRF-Token.")


class Login(Answer, json_schema_extra={"example": {"name": "Ada", "password": "correct horse battery"}}):
    """Name and password; the code only for users who need one."""

    name: str = Field(max_length=80)
    password: str = Field(max_length=1000)
    code: str = Field(default="", max_length=10)


class Confirmed(Answer):
    """My password, and my code if I need one: whoever finds a browser in which I am logged in has neither."""

    my_password: str = Field(default="", max_length=1000, description="Present password; needed in a login.")
    my_code: str = Field(default="", max_length=10, description="Of my authenticator, if I need one.")


class NewPassword(Confirmed):
    """The present password, and a new one."""

    new: str = Field(min_length=12, max_length=1000)


class Code(Answer):
    """A code of the new authenticator."""

    code: str = Field(min_length=1, max_length=10)


class NewUser(
    Confirmed,
    json_schema_extra={"example": {"name": "Ada", "password": "correct horse battery", "scope": "operate"}},
):
    """A user."""

    name: str = Field(min_length=1, max_length=80)
    password: str = Field(min_length=12, max_length=1000)
    scope: Scope = "read"


class NewToken(Confirmed, json_schema_extra={"example": {"name": "plotter", "scope": "read", "days": 90}}):
    """A token of mine, which may do at most what I may."""

    name: str = Field(min_length=1, max_length=80)
    scope: Scope = "read"
    days: int = Field(default=90, ge=1, le=731)


class Secret(Answer):
    """A secret that is shown this once."""

    name: str
    secret: str


class Entry(Answer):
    """An address that lets a browser of this machine in, once, within ten minutes."""

    path: str


def set_cookie(response: Response, service: Here, value: str) -> None:
    """Give a browser the cookie of a login: for our own pages only, and not for scripts."""
    _set(response, service, service.cookie, value, 12 * 3600)


def _set(response: Response, service: Here, name: str, value: str, lasts_s: int) -> None:
    response.set_cookie(
        name, value, max_age=lasts_s, path="/", httponly=True, samesite="strict",
        secure=service.options.encrypted,
    )  # fmt: skip


def _confirmed(request: Request, given: Confirmed, who: Principal, service: Here) -> None:
    """Refuse a change of accounts by a token, and by a login without its password.

    A program of the user of the service on this machine needs none: it has the files of the accounts.
    """
    if who.via == "token":
        raise Forbidden("changes no account: log in", where=f"token {who.token}")
    if who.via == "login":
        address = request.client.host if request.client else ""
        device = request.cookies.get(_device(service), "")
        try:
            service.accounts.check(who.name, given.my_password, given.my_code, address, device)
        except RefusedLogin as error:
            if error.wait_s:
                raise
            raise Forbidden("my_password or my_code is wrong", where=who.name) from None


def _with_password(who: Principal) -> str:
    """Name of a user who has a password."""
    if who.via != "login":
        raise Forbidden("has no password", where=who.name)
    return who.name


def _device(service: Here) -> str:
    """Name of the cookie by which a browser is known in which somebody has logged in before."""
    return f"{service.cookie}-known"


@router.get("/me")
def me(request: Request, who: Reading, service: Here) -> Me:
    """Who I am, and what I may do."""
    cookie = request.cookies.get(service.cookie, "")
    csrf = csrf_of(cookie) if by_cookie(request) else None
    return Me(name=who.name, scope=who.scope, via=who.via, csrf=csrf)


@router.post("/login", responses=refusals(429))
def login(request: Request, response: Response, given: Login, service: Here) -> Done:
    """Log in with a password; the answer sets a cookie."""
    # Without a cookie there is no token against forged requests: a page of ours sends its origin.
    if "origin" not in request.headers and "sec-fetch-site" not in request.headers:
        raise Forbidden("needs the header Origin", where="login")
    address = request.client.host if request.client else ""
    device = request.cookies.get(_device(service), "")
    try:
        cookie = service.accounts.log_in(given.name, given.password, given.code, address, device)
    except RefusedLogin as error:
        service.meters.logins.labels("wait" if error.wait_s else "refused").inc()
        service.audit.record(given.name[:80], "login", "login refused", "service", {"address": address})
        raise
    service.meters.logins.labels("done").inc()
    set_cookie(response, service, cookie)
    if not service.accounts.remembers(given.name, device):
        device = service.accounts.remember(given.name)
        _set(response, service, _device(service), device, _KNOWN_S)
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
    name = _with_password(who)
    _confirmed(request, given, who, service)
    with service.audited(who, "change password", f"user {name}"):
        service.accounts.set_password(name, given.new)
    return Done(done="changed; log in again")


@router.post("/me/one-time", responses=refusals(429))
def require_code(request: Request, given: Confirmed, who: Reading, service: Here) -> Secret:
    """Prepare one-time passwords; the secret, an address for an authenticator, counts when confirmed."""
    name = _with_password(who)
    _confirmed(request, given, who, service)
    with service.audited(who, "prepare one-time password", f"user {name}"):
        return Secret(name=name, secret=service.accounts.require_code(name))


@router.post("/me/one-time/confirm")
def confirm_code(given: Code, who: Reading, service: Here) -> Done:
    """Require one-time passwords for my logins from now on, of the authenticator that shows this code."""
    name = _with_password(who)
    with service.audited(who, "require one-time password", f"user {name}"):
        service.accounts.confirm_code(name, given.code)
    return Done(done="required; log in again")


@router.get("/users")
def users(who: Administering, service: Here) -> list[User]:
    """All users."""
    return service.accounts.users()


@router.post("/users", status_code=201, responses=refusals(429))
def add_user(request: Request, given: NewUser, who: Administering, service: Here) -> Done:
    """Add a user."""
    _confirmed(request, given, who, service)
    with service.audited(who, "add user", f"user {given.name}", {"scope": given.scope}):
        service.accounts.add_user(given.name, given.password, given.scope)
    return Done(done="added")


@router.post("/users/{name}/removal", responses=refusals(429))
def remove_user(request: Request, name: Named, given: Confirmed, who: Administering, service: Here) -> Done:
    """Remove a user, end their logins, and revoke their tokens."""
    _confirmed(request, given, who, service)
    with service.audited(who, "remove user", f"user {name}"):
        service.accounts.remove_user(name)
    return Done(done="removed")


@router.get("/tokens")
def tokens(who: Reading, service: Here) -> list[Token]:
    """My tokens, also those that have ended; without their secrets. Administrators see all."""
    return [each for each in service.accounts.tokens() if each.user == who.name or who.may("administer")]


@router.post("/tokens", status_code=201, responses=refusals(429))
def create_token(request: Request, given: NewToken, who: Reading, service: Here) -> Secret:
    """Create a token of mine for a program; its secret is shown this once."""
    if not who.may(given.scope):
        raise Forbidden(f"may {who.scope} and have no token to {given.scope}", where=who.name)
    _confirmed(request, given, who, service)
    with service.audited(
        who, "create token", f"token {given.name}", {"scope": given.scope, "days": given.days}
    ):
        made = service.accounts.create_token(given.name, given.scope, timedelta(days=given.days), who.name)
    return Secret(name=given.name, secret=made)


@router.delete("/tokens/{name}", responses=refusals(404))
def revoke_token(name: Named, who: Reading, service: Here) -> Done:
    """Revoke a token of mine; administrators revoke any."""
    if name not in {each.name for each in tokens(who, service)}:
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
