"""Operations on benches: live picture, axes, settings, self-test, sessions; and a stop that never waits."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import APIRouter, Path, Request, Response
from pydantic import Field

from ...core.options import values_of_texts
from ..accounts import Principal
from ..orders import BUSY
from .access import Here, NotFound, Operating, Reading, operating
from .answers import Answer, refusals
from .guard import ARRIVED
from .service import Service
from .sessions import new_name

if TYPE_CHECKING:
    from ..benches import BenchLink


router = APIRouter(tags=["benches"], responses=refusals(400, 401, 403, 404, 409, 422, 503))

BenchName = Annotated[str, Path(max_length=200, description="Name of the bench.")]
_LONG_S = 300.0
"""Time that a movement or a self-test may take (s)."""


class RunningSession(Answer):
    """The session of a bench: how far it is, and what it has reached."""

    name: str
    plan: str
    by: str
    state: str
    good: int
    expected: int | None
    reached: dict[str, float]
    predicted: dict[str, Any]
    step: str
    rejected: list[str]
    units: dict[str, str]
    why: str = ""


class BenchAnswer(Answer):
    """A bench.

    `state` is ready, moving, running, pausing, paused, asking, ending, released, starting or down.
    """

    name: str
    state: str
    error: str
    session: RunningSession | None
    question: str | None
    moving: str
    instruments: dict[str, str]
    has_camera: bool
    has_table: bool
    picture: int
    interrupted: list[str] = Field(description="Sessions of this bench that can be resumed.")
    restarts: int


class AxisAnswer(Answer):
    """An axis of the table."""

    position: float
    unit: str
    limits: tuple[float, float]
    homed: bool
    moving: bool


class SettingAnswer(Answer):
    """A setting, with unit and limits."""

    value: float | int | str
    unit: str | None
    limits: tuple[float, float] | None
    options: list[str] | None


class Move(Answer, json_schema_extra={"example": {"axis": "tilt", "position": 1.0, "relative": True}}):
    """Where an axis is moved to, or by how much."""

    axis: str = Field(max_length=80)
    position: float = Field(ge=-1e6, le=1e6, allow_inf_nan=False)
    relative: bool = False


class Home(Answer):
    """Which axis finds its reference."""

    axis: str = Field(max_length=80)


class Changes(
    Answer, json_schema_extra={"example": {"instrument": "camera", "changes": {"exposure_us": 5000.0}}}
):
    """Settings of an instrument to change."""

    instrument: str = Field(max_length=80)
    changes: dict[str, float | int | str] = Field(min_length=1, max_length=50)


class Tested(Answer):
    """Outcome of the self-test of an instrument."""

    name: str
    driver: str
    found: dict[str, str]
    error: str | None


class NewSession(
    Answer, json_schema_extra={"example": {"name": "monday", "plan": "frames", "parameters": {"count": 5}}}
):
    """A session: its name, plan, parameters and input files.

    `texts` are parameters as texts, in the form that options have on the command line; forms send them.
    """

    name: str = Field(min_length=1, max_length=200, pattern=r"^[^/\\\x00-\x1f.][^/\\\x00-\x1f]*$")
    plan: str = Field(max_length=40)
    parameters: dict[str, Any] = Field(default_factory=dict)
    texts: dict[str, str] = Field(default_factory=dict)
    inputs: dict[str, str] = Field(default_factory=dict, description="Contents of files, by name.")


class Resumed(Answer):
    """Session of this bench that is resumed."""

    name: str = Field(max_length=200)


class Stopped(Answer):
    """How long the instruments took to accept the stop (ms)."""

    ms: float


class PictureFacts(Answer):
    """What the live picture shows; `edge_px` is the width of its sharpest edges, smaller is sharper.

    `histogram` counts grey values in equal intervals from black to full scale; its last number is that of
    saturated pixels.
    """

    number: int
    width: int = 0
    height: int = 0
    edge_px: float | None = None
    exposure: str = ""
    histogram: list[int] = Field(default_factory=list)
    at: str = ""
    points: list[list[float]] | None = Field(default=None, description="None: no target is known.")
    error: str = ""


def the_bench(service: Service, name: str) -> BenchLink:
    """Return the link to a bench.

    Raises
    ------
    NotFound
        If there is none of this name.
    """
    if name not in service.benches:
        raise NotFound("is not a bench of this service", where=name)
    return service.benches[name]


def bench_answer(service: Service, link: BenchLink) -> BenchAnswer:
    """Return the state of a bench."""
    status = {key: value for key, value in link.status.items() if key != "pid"}
    running = status["session"]["name"] if status["state"] in BUSY and status["session"] else None
    return BenchAnswer(
        **status, restarts=max(link.restarts, 0),
        interrupted=[each for each in _interrupted(service, link) if each != running],
    )  # fmt: skip


def _interrupted(service: Service, link: BenchLink) -> list[str]:
    def compute() -> list[str]:
        return [
            each.name
            for each in reversed(service.archive.sessions(last=100))
            if each.status != "done" and service.archive.session(each.name).bench == link.text
        ]

    return service.current(f"interrupted {link.name}", compute)


def _asked(
    service: Service, name: str, who: Principal, action: str, do: str,
    given: dict[str, Any] | None = None, seconds: float = 15.0,
) -> Any:  # fmt: skip
    """Have a bench do something that is recorded before."""
    link = the_bench(service, name)
    facts = {k: v for k, v in (given or {}).items() if k not in ("inputs", "parameters", "by")}
    with service.audited(who, action, f"bench {name}", facts):
        return link.request(do, given, seconds, ARRIVED.get())


def _after(service: Service, name: str, *asked: Any, **options: Any) -> BenchAnswer:
    """As `_asked`; return the state of the bench then."""
    _asked(service, name, *asked, **options)
    return bench_answer(service, the_bench(service, name))


def order_of(service: Service, bench: str, given: NewSession) -> dict[str, Any]:
    """Return what a bench is asked to do for a new session; raises UsageError if there is one of its name."""
    from ...sessions.kinds import kind_of

    the_bench(service, bench)
    new_name(service, given.name)
    order = given.model_dump(exclude={"texts"})
    order["parameters"] |= values_of_texts(kind_of(given.plan).parameters, given.texts, given.name)
    return order


@router.get("/benches")
def benches(who: Reading, service: Here) -> list[BenchAnswer]:
    """Benches of this service."""
    return [bench_answer(service, each) for each in service.benches.values()]


@router.get("/benches/{bench}")
def bench_(bench: BenchName, who: Reading, service: Here) -> BenchAnswer:
    """A bench: its state, its session, who began it."""
    return bench_answer(service, the_bench(service, bench))


@router.post("/benches/{bench}/stop")
async def stop(bench: BenchName, request: Request, service: Here) -> Stopped:
    """Stop everything that moves or transmits; a session pauses. It is no emergency stop."""

    arrived = ARRIVED.get()

    # Neither the threads of other requests nor the commands of the bench are waited for.
    def at_once() -> Stopped:
        who = operating(request)
        link = the_bench(service, bench)
        try:
            value = link.request("stop", seconds=5.0, at=arrived)
        finally:
            service.record_later(who, "stop", f"bench {bench}")
        return Stopped(ms=value["ms"])

    return await asyncio.get_running_loop().run_in_executor(service.urgent, at_once)


@router.get("/benches/{bench}/axes")
def axes(bench: BenchName, who: Reading, service: Here) -> dict[str, AxisAnswer]:
    """Axes of the table: positions, limits, whether they have a reference; also while they move."""
    found = the_bench(service, bench).request("axes")
    return {name: AxisAnswer(**each) for name, each in found.items()}


@router.post("/benches/{bench}/move")
def move(bench: BenchName, given: Move, who: Operating, service: Here) -> dict[str, AxisAnswer]:
    """Move an axis, and wait until it has arrived."""
    found = _asked(service, bench, who, "move", "move", given.model_dump() | {"by": who.name}, _LONG_S)
    return {name: AxisAnswer(**each) for name, each in found.items()}


@router.post("/benches/{bench}/home")
def home(bench: BenchName, given: Home, who: Operating, service: Here) -> dict[str, AxisAnswer]:
    """Have an axis find its reference, and wait until it has."""
    found = _asked(service, bench, who, "home", "home", given.model_dump() | {"by": who.name}, _LONG_S)
    return {name: AxisAnswer(**each) for name, each in found.items()}


@router.get("/benches/{bench}/settings")
def settings(bench: BenchName, who: Reading, service: Here) -> dict[str, dict[str, SettingAnswer]]:
    """Settings of all instruments, with units and limits."""
    found = the_bench(service, bench).request("settings")
    return {name: {k: SettingAnswer(**v) for k, v in rows.items()} for name, rows in found.items()}


@router.patch("/benches/{bench}/settings")
def configure(bench: BenchName, given: Changes, who: Operating, service: Here) -> dict[str, SettingAnswer]:
    """Change settings of an instrument, within their limits."""
    found = _asked(service, bench, who, "configure", "configure", given.model_dump(), 60.0)
    return {k: SettingAnswer(**v) for k, v in found.items()}


@router.post("/benches/{bench}/check")
def check(bench: BenchName, who: Operating, service: Here) -> list[Tested]:
    """Run the self-tests of all instruments."""
    return [Tested(**each) for each in _asked(service, bench, who, "self-test", "check", None, _LONG_S)]


@router.post("/benches/{bench}/take")
def take(bench: BenchName, who: Operating, service: Here) -> BenchAnswer:
    """Lock and connect the instruments."""
    return _after(service, bench, who, "take", "take", seconds=60.0)


@router.post("/benches/{bench}/release")
def release(bench: BenchName, who: Operating, service: Here) -> BenchAnswer:
    """Disconnect and release the instruments, for other programs."""
    return _after(service, bench, who, "release", "release", seconds=60.0)


@router.post("/benches/{bench}/sessions", status_code=201)
def begin(bench: BenchName, given: NewSession, who: Operating, service: Here) -> BenchAnswer:
    """Begin a session on a bench, with a plan."""
    order = order_of(service, bench, given) | {"by": who.name}
    return _after(service, bench, who, "begin session", "begin", order, 60.0)


@router.post("/benches/{bench}/sessions/resume")
def resume_session(bench: BenchName, given: Resumed, who: Operating, service: Here) -> BenchAnswer:
    """Resume a session that was interrupted or aborted; poses that have a good frame are not repeated."""
    order = {"name": given.name, "by": who.name}
    return _after(service, bench, who, "resume session", "resume_session", order, 60.0)


@router.post("/benches/{bench}/pause")
def pause(bench: BenchName, who: Operating, service: Here) -> BenchAnswer:
    """Pause the session after the present pose."""
    return _after(service, bench, who, "pause session", "pause")


@router.post("/benches/{bench}/resume")
def resume(bench: BenchName, who: Operating, service: Here) -> BenchAnswer:
    """Let a session that is paused go on."""
    return _after(service, bench, who, "continue session", "continue")


@router.post("/benches/{bench}/abort")
def abort(bench: BenchName, who: Operating, service: Here) -> BenchAnswer:
    """End the session at once; it can be resumed later."""
    return _after(service, bench, who, "abort session", "abort")


@router.post("/benches/{bench}/answer")
def answer(bench: BenchName, who: Operating, service: Here) -> BenchAnswer:
    """Say that what the session asks for is done."""
    return _after(service, bench, who, "answer session", "answer")


@router.get("/benches/{bench}/picture")
def picture_facts(bench: BenchName, who: Reading, service: Here) -> PictureFacts:
    """What the live picture shows: targets, exposure, sharpness. Asking keeps it live for five seconds."""
    facts = the_bench(service, bench).request("picture")
    return PictureFacts(**({"number": 0} | facts))


@router.get(
    "/benches/{bench}/picture.jpg", response_class=Response,
    responses={200: {"content": {"image/jpeg": {}}, "description": "The picture"}},
)  # fmt: skip
def picture(bench: BenchName, who: Reading, service: Here) -> Response:
    """The live picture; during a session its last frame."""
    facts, coded = the_bench(service, bench).asked("picture")
    if not coded:
        raise NotFound(facts.get("error", "has no picture yet"), where=bench)
    return Response(coded, media_type="image/jpeg")
