"""Operations on the queue of a bench: recalibrations and sessions, which its worker carries out in turn."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Path
from pydantic import Field

from ...core.errors import UsageError
from ..accounts import Principal
from ..orders import Order, Orders
from .access import Administering, Here, Operating, Reading
from .answers import Answer, Done, Instant, refusals
from .benches import BenchName, NewSession, order_of, the_bench
from .service import Service

router = APIRouter(tags=["benches"], responses=refusals(400, 401, 403, 404, 409, 422, 503))

Number = Annotated[int, Path(ge=0, le=1 << 53, description="Number of the order.")]


class Line(Answer):
    """A line of the log of an order."""

    at: Instant
    text: str


class OrderRow(Answer):
    """An order: what, who asked, and what became of it."""

    number: int
    what: Literal["recalibration", "session"]
    name: str
    session: str
    by: str
    at: Instant
    state: Literal["waiting", "running", "blocked", "done", "failed", "withdrawn"]
    why: str
    attempts: int
    again: Instant | None = Field(description="When a blocked one is tried again.")
    log: list[Line]


class Queue(Answer):
    """The queue of a bench."""

    paused_by: str
    waiting: list[OrderRow] = Field(description="In the order in which they will be done.")
    others: list[OrderRow] = Field(description="Running and over, latest first.")
    recalibrations: list[str] = Field(description="Recalibrations of this bench.")


class Definition(
    Answer, json_schema_extra={"example": {"name": "left", "session": "monday", "configuration": "left"}}
):
    """What a recalibration repeats, and what it does besides; rules are by default the last ones."""

    name: str = Field(min_length=1, max_length=200, pattern=r"^[^/\\\x00-\x1f.][^/\\\x00-\x1f]*$")
    session: str = Field(max_length=200)
    configuration: str = Field(max_length=200)
    rules: dict[str, Any] | None = None
    warm_up_minutes: float = Field(default=0.0, ge=0, le=1440)
    self_test: bool = False
    certificate: dict[str, Any] | None = None
    notify: list[Annotated[str, Field(max_length=500)]] = Field(default_factory=list, max_length=10)
    inside: list[Annotated[str, Field(max_length=50)]] = Field(default_factory=list, max_length=10)


class NewRecalibration(Answer, json_schema_extra={"example": {"name": "left"}}):
    """A recalibration to carry out."""

    name: str = Field(min_length=1, max_length=200)


def _row(order: Order) -> OrderRow:
    log = [Line.model_validate({"at": at, "text": text}) for at, text in order.log]
    shown = {k: getattr(order, k) for k in OrderRow.model_fields if k not in ("name", "log")}
    return OrderRow(name=str(order.given["name"]), log=log, **shown)


def _queue(service: Service, bench: str) -> Orders:
    return Orders(service.archive, the_bench(service, bench).name)


def every_recalibration(service: Service) -> list[str]:
    """Return the recalibrations of the archive."""
    from ..recalibration import Recalibrations

    return service.current("recalibrations", lambda: Recalibrations(service.archive).names())


def recalibrations_of(service: Service, bench: str) -> list[str]:
    """Return the recalibrations that a bench can carry out."""
    from ..recalibration import Recalibrations

    text, known = the_bench(service, bench).text, Recalibrations(service.archive)

    def compute() -> list[str]:
        return [each for each in known.names() if known.get(each).bench == text]

    return service.current(f"recalibrations {bench}", compute)


@router.get("/recalibrations")
def recalibrations(who: Reading, service: Here) -> list[str]:
    """Recalibrations of the archive."""
    return every_recalibration(service)


@router.post("/recalibrations", status_code=201)
def define(given: Definition, who: Administering, service: Here) -> Done:
    """Define what a recalibration repeats, or change it."""
    from ..recalibration import Recalibrations
    from ..rules import AcceptanceRules
    from .calibrations import rules_of, the_configuration
    from .sessions import the_session

    the_configuration(service, given.configuration)
    rules = given.rules or rules_of(service, given.configuration)
    if rules is None:
        raise UsageError("has no rules yet", where=given.configuration, do="judge a calibration first")
    steps = given.model_dump(exclude={"name", "session", "configuration", "rules"})
    steps |= {each: tuple(steps[each]) for each in ("notify", "inside")}
    with service.audited(who, "define recalibration", given.name, {"session": given.session}):
        Recalibrations(service.archive).define(
            given.name, the_session(service, given.session), given.configuration,
            AcceptanceRules.from_content(rules, where="rules"), **steps,
        )  # fmt: skip
    return Done(done="defined")


@router.get("/benches/{bench}/orders")
def orders(bench: BenchName, who: Reading, service: Here) -> Queue:
    """The queue of a bench: what waits, runs and is over, with who asked for it, and its log."""
    found = _queue(service, bench)

    def compute() -> Queue:
        waiting = found.waiting()
        still = {each.number for each in waiting}
        return Queue(
            paused_by=found.paused, waiting=[_row(each) for each in waiting],
            others=[_row(each) for each in reversed(found.all(20)) if each.number not in still],
            recalibrations=recalibrations_of(service, bench),
        )  # fmt: skip

    return service.current(f"orders {bench}", compute)


def _asked(
    service: Service,
    bench: str,
    who: Principal,
    what: Literal["recalibration", "session"],
    given: dict[str, Any],
) -> OrderRow:
    with service.audited(who, f"ask for {what}", f"bench {bench}", {"name": given["name"]}):
        return _row(_queue(service, bench).add(what, given, who.name))


@router.post("/benches/{bench}/orders/recalibrations", status_code=201)
def recalibrate(bench: BenchName, given: NewRecalibration, who: Operating, service: Here) -> OrderRow:
    """Have a recalibration carried out as soon as its turn comes."""
    if given.name not in recalibrations_of(service, bench):
        raise UsageError("is no recalibration of this bench", where=given.name)
    return _asked(service, bench, who, "recalibration", {"name": given.name})


@router.post("/benches/{bench}/orders/sessions", status_code=201)
def session_later(bench: BenchName, given: NewSession, who: Operating, service: Here) -> OrderRow:
    """Have a session carried out as soon as its turn comes."""
    return _asked(service, bench, who, "session", order_of(service, bench, given))


@router.post("/benches/{bench}/orders/pause")
def pause_orders(bench: BenchName, who: Operating, service: Here) -> Done:
    """Begin no further order; the one that runs goes on."""
    with service.audited(who, "pause queue", f"bench {bench}"):
        _queue(service, bench).pause(who.name)
    return Done(done="paused")


@router.post("/benches/{bench}/orders/resume")
def resume_orders(bench: BenchName, who: Operating, service: Here) -> Done:
    """Begin orders again."""
    with service.audited(who, "resume queue", f"bench {bench}"):
        _queue(service, bench).pause(who.name, pause=False)
    return Done(done="goes on")


@router.post("/benches/{bench}/orders/{number}/first")
def first(bench: BenchName, number: Number, who: Operating, service: Here) -> Done:
    """Have an order done before the others."""
    with service.audited(who, "put first", f"bench {bench}", {"order": number}):
        _queue(service, bench).put_first(number, who.name)
    return Done(done="is next")


@router.post("/benches/{bench}/orders/{number}/withdraw")
def withdraw(bench: BenchName, number: Number, who: Operating, service: Here) -> Done:
    """Have an order not done."""
    with service.audited(who, "withdraw", f"bench {bench}", {"order": number}):
        _queue(service, bench).withdraw(number, who.name)
    return Done(done="withdrawn")
