"""Operations on sessions: frames with overlays, results, reruns."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Query, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse

from ...archive import Session
from ...archive.records import ArchivedFrame, ArchivedResult, SessionSummary
from ...core.errors import ArchiveError, ReseauError, UsageError
from ...report.scene import Scene
from ..decoding import PHOTOGRAPH
from .access import Here, NotFound, Reading, principal_of
from .answers import TOO_MANY, Answer, Instant, refusals
from .events import BLUESKY
from .service import Service
from .stored import FILE_ANSWERS, file_answer, marks_of, picture_answer, preview_jpeg, result_named

router = APIRouter(tags=["sessions"], responses=refusals(400, 401, 403, 404, 422, 503))

SessionName = Annotated[str, Path(max_length=200, description="Name of the session.")]
Number = Annotated[int, Path(ge=1, le=1 << 62, description="Its number in the archive.")]


class SessionPage(
    Answer,
    json_schema_extra={
        "example": {
            "sessions": [
                {
                    "name": "monday",
                    "plan": "testfield",
                    "begun": "2026-03-02T08:00:00+00:00",
                    "frames": 36,
                    "results": 2,
                    "status": "done",
                }
            ],
            "before": None,
        }
    },
):
    """Sessions, latest first; `before` leads to the earlier ones."""

    sessions: list[SessionSummary]
    before: str | None


class FrameRow(Answer):
    """A frame: the step it belongs to, its verdict, its file."""

    id: int
    step: str
    kind: str
    take: int
    ok: bool | None
    why: str
    facts: dict[str, Any]
    measured: dict[str, Any]
    sha256: str
    suffix: str
    size: int


class ResultRow(Answer):
    """A result with its inputs by SHA-256."""

    id: int
    name: str
    size: int
    sha256: str
    software: str
    inputs: dict[str, str]


class SessionDetail(Answer):
    """A session: what it was told to do, what it has, what is to come, and up to 100 rejected frames."""

    name: str
    plan: str
    begun: Instant
    status: str
    why: str
    software: str
    parameters: dict[str, Any]
    inputs: dict[str, str]
    expected: int | None
    good: int
    taken: int
    to_come: list[str]
    rejected: list[FrameRow]
    results: list[ResultRow]


class BlueskyDocument(Answer):
    """A document of bluesky: its kind, and content."""

    name: str
    document: dict[str, Any]


_MOST_REJECTED = 100


class MarkRow(Answer):
    """Marks that are found in a frame, in pixels."""

    width: int
    height: int
    names: list[str]
    xy: list[list[float]]
    why: str


def the_session(service: Service, name: str) -> Session:
    """Return a session.

    Raises
    ------
    NotFound
        If there is none.
    """
    try:
        return service.archive.session(name)
    except ArchiveError as error:
        if "is not a session" in error.what:
            raise NotFound(error.what, where=name) from None
        raise


def new_name(service: Service, name: str) -> None:
    """Check that no session has a name.

    Raises
    ------
    UsageError
        If one has.
    """
    try:
        service.archive.session(name)
    except ArchiveError:  # not there, or the archive says why it cannot be used when it is
        return
    raise UsageError("is the name of another session", where=name, do="give another name")


def the_frame(session: Session, number: int) -> ArchivedFrame:
    """Return a frame of a session.

    Raises
    ------
    NotFound
        If there is none.
    """
    found = session.frame(number)
    if found is None or found.kind == "input":
        raise NotFound("has no such frame", where=f"{session.name}: {number}")
    return found


def _measurable(frame: ArchivedFrame) -> ArchivedFrame:
    """Return the frame, if it is one, and no file of another kind.

    Raises
    ------
    UsageError
        If it is none.
    """
    if frame.suffix != ".tif" or frame.kind == PHOTOGRAPH:
        raise UsageError("is a file, not a frame", where=frame.name)
    return frame


def rows(service: Service, count: int, before: str | None = None, like: str = "") -> list[SessionSummary]:
    """Return lines of the list, latest first."""
    return service.archive.sessions(last=count, before=before, like=like)[::-1]


def _row(frame: ArchivedFrame) -> FrameRow:
    verdict = frame.verdict
    return FrameRow(
        id=frame.id, step=frame.step, kind=frame.kind, take=frame.take,
        ok=None if verdict is None else verdict.ok, why="" if verdict is None else verdict.why,
        facts=frame.facts, measured={} if verdict is None else verdict.facts, sha256=frame.sha256,
        suffix=frame.suffix, size=frame.size,
    )  # fmt: skip


def latest_frames(session: Session, count: int) -> list[FrameRow]:
    """Return the latest frames and other pictures of a session."""
    return [_row(each) for each in session.frames(inputs=False, last=count)]


def session_detail(service: Service, session: Session) -> SessionDetail:
    """Return a session with what it has and what is to come."""
    from ...sessions import conducting

    taken, good = session.counts()
    expected, steps = None, list[str]()
    try:
        given = conducting.parameters_of(session)
        expected = given.expected
        poses = getattr(given, "poses", None)
        steps = [each.name for each in poses()] if poses is not None and expected is not None else []
    except ReseauError:  # a plan of another version: its frames and results are shown all the same
        pass
    status, why = session.last_end
    to_come = []
    if status != "done" and steps:
        have = {each.step for each in session.frames(kind="frame", ok=True)}
        to_come = [each for each in steps if each not in have]
    return SessionDetail(
        name=session.name, plan=session.plan, begun=session.begun.isoformat(), status=status, why=why,
        software=session.software, parameters=session.parameters,
        inputs={name: each.sha256 for name, each in session.inputs().items()}, expected=expected, good=good,
        taken=taken, to_come=to_come,
        rejected=[_row(each) for each in session.frames(kind="frame", ok=False, last=_MOST_REJECTED)],
        results=[ResultRow.model_validate(each) for each in session.results()],
    )  # fmt: skip


@router.get("/sessions")
def sessions(
    who: Reading,
    service: Here,
    count: Annotated[int, Query(ge=1, le=500)] = 50,
    before: Annotated[str | None, Query(max_length=200, description="Only earlier ones than this.")] = None,
    like: Annotated[str, Query(max_length=200, description="Part of the name or the plan.")] = "",
) -> SessionPage:
    """Sessions, latest first."""
    found = rows(service, count, before, like)
    return SessionPage(sessions=found, before=found[-1].name if len(found) == count else None)


@router.get("/sessions/{session}")
def session_(session: SessionName, who: Reading, service: Here) -> SessionDetail:
    """A session."""
    return session_detail(service, the_session(service, session))


@router.get("/sessions/{session}/frames")
def frames(
    session: SessionName,
    who: Reading,
    service: Here,
    after: Annotated[int, Query(ge=0, le=1 << 62, description="Only frames with larger numbers.")] = 0,
    count: Annotated[int, Query(ge=1, le=2000)] = 500,
) -> list[FrameRow]:
    """Frames and other pictures of a session, in the order in which they were stored."""
    found = the_session(service, session).frames(inputs=False, after=after, first=count)
    return [_row(each) for each in found]


@router.get("/sessions/{session}/frames/{number}/file", response_class=Response, responses=FILE_ANSWERS)
def frame_file(
    request: Request, session: SessionName, number: Number, who: Reading, service: Here
) -> Response:
    """The file of a frame, checked against its SHA-256 when it is first read; ranges are answered."""
    kept = the_session(service, session)
    frame = the_frame(kept, number)
    content = kept.objects.open(frame.sha256, frame.suffix)
    return file_answer(
        request, content, f"{kept.name} {frame.name}{frame.suffix}".replace("/", " "), frame.sha256
    )


@router.get(
    "/sessions/{session}/frames/{number}/preview.jpg", response_class=Response,
    responses={200: {"content": {"image/*": {}}, "description": "The picture"}},
)  # fmt: skip
def preview(
    request: Request,
    session: SessionName,
    number: Number,
    who: Reading,
    service: Here,
    width: Annotated[int, Query(ge=16, le=2400)] = 640,
) -> Response:
    """A frame with 8 bits, reduced to a width."""
    kept = the_session(service, session)
    frame = the_frame(kept, number)
    if frame.suffix in (".png", ".jpg", ".jpeg"):
        return frame_file(request, session, number, who, service)
    _measurable(frame)
    tag = f"{frame.sha256[:32]}-{width}"
    return picture_answer(request, lambda: preview_jpeg(kept, frame, width), "image/jpeg", tag)


@router.get("/sessions/{session}/frames/{number}/marks")
def marks(session: SessionName, number: Number, who: Reading, service: Here) -> MarkRow:
    """Marks that are found in a frame; they are measured again."""
    kept = the_session(service, session)
    frame, found, why = marks_of(kept, _measurable(the_frame(kept, number)))
    xy = [[round(float(x), 3), round(float(y), 3)] for x, y in found.xy]
    return MarkRow(width=frame.width, height=frame.height, names=list(found.ids), xy=xy, why=why)


@router.get(
    "/sessions/{session}/frames/{number}/overlay.svg", response_class=Response,
    responses={200: {"content": {"image/svg+xml": {}}, "description": "The picture"}},
)  # fmt: skip
def overlay(request: Request, session: SessionName, number: Number, who: Reading, service: Here) -> Response:
    """A frame with the marks that are found in it."""
    from ...report.overlay import frame_overlay

    kept = the_session(service, session)
    archived = _measurable(the_frame(kept, number))

    def draw() -> str:
        frame, found, _ = marks_of(kept, archived)
        return frame_overlay(frame, found).replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)

    return picture_answer(request, draw, "image/svg+xml", f"{archived.sha256[:32]}-marks")


@router.get("/sessions/{session}/results/{number}/file", response_class=Response, responses=FILE_ANSWERS)
def result_file(
    request: Request, session: SessionName, number: Number, who: Reading, service: Here
) -> Response:
    """The file of a result, checked against its SHA-256; reports have no scripts and no origin."""
    kept = the_session(service, session)
    result = result_named(kept, number)
    if result is None:
        raise NotFound("has no such result", where=f"{session}: {number}")
    content = kept.objects.open(result.sha256, result.suffix)
    return file_answer(request, content, result.name, result.sha256)


@router.get("/sessions/{session}/scene")
def scene(session: SessionName, who: Reading, service: Here) -> Scene:
    """Cameras and target in space, as the calibration of the session found them."""
    kept = the_session(service, session)
    found = scene_result(kept)
    if found is None:
        raise NotFound("has no cameras in space", where=session)
    return Scene.parse(kept.content(found).decode("utf-8"), where=f"{session}: {found.name}")


def scene_result(session: Session) -> ArchivedResult | None:
    """Return the result of a session with cameras and target in space, or None."""
    from ...sessions import kinds

    found = [each for each in session.results() if each.name == kinds.SCENE]
    return found[-1] if found else None


@router.get("/sessions/{session}/documents")
def documents(
    session: SessionName,
    who: Reading,
    service: Here,
    after: Annotated[int, Query(ge=0, le=1 << 31, description="Leave out so many.")] = 0,
) -> list[BlueskyDocument]:
    """Bluesky's documents of a session, in their order: start, descriptor, event, stop."""
    found = the_session(service, session).notes()
    known = [(kind, document) for kind, document in found if kind in BLUESKY]
    return [BlueskyDocument(name=kind, document=document) for kind, document in known[after:]]


@router.get(
    "/documents",
    response_class=StreamingResponse,
    responses={200: {"content": {"text/event-stream": {}}, "description": "Documents"}, **refusals(429)},
)
async def all_documents(
    request: Request,
    who: Reading,
    service: Here,
    last_event_id: Annotated[str, Header(max_length=40, description="Resume after this document.")] = "",
    after: Annotated[int | None, Query(ge=0, le=1 << 62, description="As Last-Event-ID; 0: all.")] = None,
) -> Response:
    """Bluesky's documents of all sessions as server-sent events; by default those from now on.

    The id of each is its number in the archive: with `Last-Event-ID` a stream is resumed without a gap, also
    after a restart of the service.
    """
    if service.events.full:
        return JSONResponse(TOO_MANY, 429, {"Retry-After": "10"})
    last = int(last_event_id) if last_event_id.isdigit() else after
    if last is None or last >= 1 << 63:
        last = (await asyncio.to_thread(service.archive.heads))["events"]
    stream = service.events.documents(service.archive, last, lambda: principal_of(request) is not None)
    return StreamingResponse(stream, media_type="text/event-stream", headers={"X-Accel-Buffering": "no"})


@router.get("/sessions/{session}/inputs/{name}/file", response_class=Response, responses=FILE_ANSWERS)
def input_file(
    request: Request,
    session: SessionName,
    name: Annotated[str, Path(max_length=200, description="Name of the input.")],
    who: Reading,
    service: Here,
) -> Response:
    """An input file of a session, such as a design."""
    kept = the_session(service, session)
    found = kept.inputs().get(name)
    if found is None:
        raise NotFound("has no such input", where=f"{session}: {name}")
    return file_answer(request, kept.objects.open(found.sha256, found.suffix), name, found.sha256)
