"""Answers of the API: the form of all answers, of errors, and of pages of a list."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from typing import Annotated, Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, RedirectResponse, Response
from pydantic import BaseModel, BeforeValidator
from starlette.exceptions import HTTPException

from ...core.errors import (
    ArchiveError,
    EstimationError,
    InputError,
    InstrumentError,
    ReseauError,
    UsageError,
)
from ..attempts import RefusedLogin
from .access import Forbidden, NotFound, Unknown
from .guard import log


def _as_text(time: Any) -> Any:
    return time.isoformat() if isinstance(time, datetime) else time


Instant = Annotated[str, BeforeValidator(_as_text)]
"""A time, ISO 8601."""


class Answer(BaseModel, extra="forbid", from_attributes=True):
    """Base of answers."""


class Done(Answer, json_schema_extra={"example": {"done": "revoked"}}):
    """Something was done."""

    done: str


class ErrorDetail(Answer):
    """What is wrong, where, and what to do."""

    code: str
    text: str
    what: str
    where: str | None
    do: str | None


class ErrorAnswer(
    Answer,
    json_schema_extra={
        "example": {
            "error": {
                "code": "not_found",
                "text": "monday: is not a session of this archive",
                "what": "is not a session of this archive",
                "where": "monday",
                "do": None,
            }
        }
    },
):
    """An error; the text is one line for people, the code is for programs."""

    error: ErrorDetail


_STATUS: tuple[tuple[type[ReseauError], int, str], ...] = (
    (Unknown, 401, "unknown"),
    (Forbidden, 403, "forbidden"),
    (NotFound, 404, "not_found"),
    (RefusedLogin, 401, "refused_login"),
    (UsageError, 422, "usage"),
    (InputError, 422, "input"),
    (EstimationError, 409, "estimation"),
    (InstrumentError, 409, "instrument"),
    (ArchiveError, 503, "archive"),
)
_ABOUT = {
    400: "The request is not HTTP as expected, or arrives too slowly",
    401: "Without a token or login, or with one that has ended",
    403: "Not allowed: name, origin, missing X-CSRF-Token, or scope",
    404: "There is no such thing",
    409: "The state does not allow it: an instrument, or an estimate that failed",
    413: "Too large",
    422: "A parameter or the content cannot be used",
    429: "Too many requests",
    503: "The archive cannot be used now",
}


_MANY = "too many clients"
TOO_MANY = {"error": {"code": "wait", "text": _MANY, "what": _MANY, "where": None, "do": None}}
"""Answer to one stream of events too many."""


def refusals(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the documentation of the errors of an operation."""
    return {each: {"model": ErrorAnswer, "description": _ABOUT[each]} for each in statuses}


def add_error_handlers(app: FastAPI, page: Callable[[Request, int, str], Response]) -> None:
    """Make errors answers, and those of pages pages.

    Parameters
    ----------
    app : FastAPI
        The application.
    page : callable
        Renders a page that says what is wrong.
    """

    def answered(
        request: Request, status: int, code: str, text: str, what: str = "", where: str | None = None,
        do: str | None = None, headers: dict[str, str] | None = None,
    ) -> Response:  # fmt: skip
        detail = ErrorDetail(code=code, text=text, what=what or text, where=where, do=do)
        plain = JSONResponse(ErrorAnswer(error=detail).model_dump(), status, headers)
        if request.url.path.startswith("/api/"):
            return plain
        if status == 401:
            target = request.url.path if request.method == "GET" else "/"
            return RedirectResponse(f"/login?next={target}", 303)
        try:
            return page(request, status, text)
        except ReseauError:  # such as accounts that cannot be read, which every page asks for
            return plain

    @app.exception_handler(ReseauError)
    def known(request: Request, error: ReseauError) -> Response:
        status, code = next(((s, c) for kind, s, c in _STATUS if isinstance(error, kind)), (500, "error"))
        headers = {}
        if isinstance(error, RefusedLogin) and error.wait_s:
            status, code, headers["Retry-After"] = 429, "wait", f"{error.wait_s:.0f}"
        if status == 401:
            headers["WWW-Authenticate"] = "Bearer"
        where = None if error.where is None else str(error.where)
        return answered(request, status, code, str(error), error.what, where, error.do, headers)

    @app.exception_handler(RequestValidationError)
    def invalid(request: Request, error: RequestValidationError) -> Response:
        first = error.errors()[0]
        where = ".".join(str(each) for each in first["loc"] if each not in ("body", "query", "path"))
        return answered(request, 422, "usage", f"{where}: {first['msg']}", first["msg"], where or None)

    @app.exception_handler(HTTPException)
    def http(request: Request, error: HTTPException) -> Response:
        code = {404: "not_found", 405: "method"}.get(error.status_code, "request")
        headers = dict(error.headers or {})
        return answered(request, error.status_code, code, str(error.detail), headers=headers)

    @app.exception_handler(Exception)
    def unexpected(request: Request, error: Exception) -> Response:
        log("error", path=request.url.path, kind=type(error).__name__, request=request.state.request)
        text = f"the service failed; its log has more under {request.state.request}"
        return answered(request, 500, "error", text)
