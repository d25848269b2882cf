"""The pages: rendered from the answers of the API's own operations, and nothing else."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Annotated, Any

import jinja2
from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse

from . import accounts, operations
from .access import Administering, Here, NotFound, Reading, Unknown, csrf_of, principal_of, service_of

__all__ = ["rendered_error", "router"]

router = APIRouter(include_in_schema=False)

_STATIC = {
    "app.css": "text/css",
    "app.js": "text/javascript",
    "icon.svg": "image/svg+xml",
}
NAV = (("/account", "Account"),)


@cache
def _templates() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.PackageLoader("reseau.service", "pages/app"), autoescape=True, trim_blocks=True,
        lstrip_blocks=True, undefined=jinja2.StrictUndefined,
    )  # fmt: skip


def _rendered(request: Request, template: str, status: int = 200, **content: Any) -> HTMLResponse:
    """Render a page for whoever asks for it."""
    service = service_of(request)
    who = principal_of(request)
    cookie = request.cookies.get(service.cookie, "")
    here = "/" + request.url.path.strip("/").partition("/")[0]
    page = _templates().get_template(template)
    text = page.render(content, who=who, csrf=csrf_of(cookie) if cookie else "", nav=NAV, here=here)
    return HTMLResponse(text, status)


def rendered_error(request: Request, status: int, text: str) -> Response:
    """Return a page that says what is wrong."""
    return _rendered(request, "error.html.j2", status, text=text)


def _inside(path: str) -> str:
    """A path of ours; anything else leads to the overview."""
    inside = path.startswith("/") and not path.startswith(("//", "/\\")) and path.isprintable()
    return path if inside else "/"


@router.get("/static/{name}")
def static(name: str) -> Response:
    """A file of the pages."""
    if name not in _STATIC:
        raise NotFound("is no file of the pages", where=name)
    content = files("reseau.service").joinpath("pages", "app", name).read_bytes()
    return Response(content, media_type=_STATIC[name], headers={"Cache-Control": "no-cache"})


@router.get("/enter")
def enter(service: Here, code: Annotated[str, Query(max_length=100)] = "") -> Response:
    """Let a browser of this machine in."""
    cookie = service.enter(code)
    if cookie is None:
        raise Unknown("this address was used, or is too old", where="enter")
    response = RedirectResponse("/", 303)
    accounts.set_cookie(response, service, cookie)
    return response


@router.get("/login")
def login(request: Request, service: Here, next: Annotated[str, Query(max_length=500)] = "/") -> Response:
    """The login."""
    users = bool(service.accounts.users())
    return _rendered(
        request, "login.html.j2", next=_inside(next), users=users, local=not service.options.open_to_others
    )


@router.get("/")
def home(request: Request, who: Reading, service: Here) -> Response:
    """The overview."""
    return _rendered(request, "home.html.j2", alarms=[], benches=[], sessions=[], configurations=[])


@router.get("/account")
def account(request: Request, who: Reading, service: Here) -> Response:
    """My account; for administrators all users and tokens."""
    found: dict[str, Any] = {"users": [], "tokens": []}
    if who.may("administer"):
        found = {"users": accounts.users(who, service), "tokens": accounts.tokens(who, service)}
    return _rendered(request, "account.html.j2", **found)


@router.get("/audit")
def audit(request: Request, who: Administering, service: Here) -> Response:
    """The audit log."""
    return _rendered(
        request, "audit.html.j2", entries=operations.audit(who, service, 200, None),
        state=operations.audit_state(who, service, None),
    )  # fmt: skip
