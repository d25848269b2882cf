"""Operations on the service itself: health, metrics, events, the audit log."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest

from ...core.version import __version__
from ..audit import AuditEntry, Head
from .access import Administering, Here, Reading, principal_of
from .answers import TOO_MANY, Answer, refusals
from .service import Service

router = APIRouter(tags=["service"], responses=refusals(400, 401, 403, 422, 503))
open_router = APIRouter(tags=["service"], responses=refusals(403))


class About(Answer):
    """The service."""

    software: str
    archive: str
    started: float
    uptime_s: float


class AuditState(
    Answer, json_schema_extra={"example": {"whole": True, "wrong": [], "number": 17, "head": "17 9f2c…"}}
):
    """Whether the audit log is whole, and its head."""

    whole: bool
    wrong: list[str]
    number: int
    head: str


class Health(Answer, json_schema_extra={"example": {"status": "ready", "why": ""}}):
    """Whether it lives, and why it is not ready."""

    status: str
    why: str = ""


@open_router.get("/health/live")
def live() -> Health:
    """Whether the process answers."""
    return Health(status="alive")


@open_router.get("/health/ready", responses={503: {"model": Health, "description": "It is not ready"}})
def ready(service: Here) -> Response:
    """Whether archive and accounts can be used."""
    found = Health(status="not ready" if service.failing else "ready", why=service.failing)
    return JSONResponse(found.model_dump(), 503 if service.failing else 200)


@router.get("/about")
def about(who: Reading, service: Here) -> About:
    """Version and archive of the service."""
    return About(
        software=f"reseau {__version__}", archive=service.archive.place, started=service.started,
        uptime_s=round(service.uptime_s, 1),
    )  # fmt: skip


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {}}, "description": "Metrics"}},
)
def metrics(who: Reading, service: Here) -> Response:
    """Counters, in the text format of Prometheus."""
    return Response(generate_latest(service.meters.registry), media_type=CONTENT_TYPE_LATEST)


@router.get(
    "/events",
    response_class=StreamingResponse,
    responses={200: {"content": {"text/event-stream": {}}, "description": "Events"}, **refusals(429)},
)
async def events(
    request: Request,
    who: Reading,
    service: Here,
    last_event_id: Annotated[str, Header(max_length=40, description="Resume after this event.")] = "",
    last: Annotated[str, Query(max_length=40, description="As Last-Event-ID, for programs.")] = "",
) -> Response:
    """Server-sent events: what was stored, and what happens on the benches.

    A connection that was lost is resumed with `Last-Event-ID`. If events are missing then, the first one is
    `reset`: what is shown must be fetched again.
    """
    if service.events.full:
        return JSONResponse(TOO_MANY, 429, {"Retry-After": "10"})
    stream = service.events.stream(last_event_id or last, lambda: principal_of(request) is not None)
    return StreamingResponse(stream, media_type="text/event-stream", headers={"X-Accel-Buffering": "no"})


@router.get("/audit")
def audit(
    who: Administering,
    service: Here,
    count: Annotated[int, Query(ge=1, le=1000)] = 100,
    before: Annotated[int | None, Query(ge=1, le=1 << 62)] = None,
) -> list[AuditEntry]:
    """The last entries of the audit log, newest first."""
    return list(service.audit.entries(count, before))


@router.get("/audit/state")
def audit_state(
    who: Administering,
    service: Here,
    head: Annotated[
        str | None, Query(pattern=r"^[0-9]{1,15} [0-9a-f]{64}$", description="A head that was kept.")
    ] = None,
) -> AuditState:
    """Verify the audit log, also against a head that was kept elsewhere."""
    return audited(service, [] if head is None else [Head.read_line(head)])


def audited(service: Service, heads: Sequence[Head] = (), *, again: bool = True) -> AuditState:
    """Return whether the audit log is whole; as :meth:`Audit.verify`."""
    wrong = service.audit.verify(heads, again=again)
    own = service.audit.head()
    line = "" if own is None else f"{own.number} {own.hash}"
    return AuditState(whole=not wrong, wrong=wrong, number=0 if own is None else own.number, head=line)
