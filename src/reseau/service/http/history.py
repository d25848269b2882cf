"""Operations on what happens over time: control charts, schedules, alarms."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from fastapi import APIRouter, Path, Query, Request, Response
from pydantic import Field

from ...core.errors import UsageError
from ..delivering import AlarmDelivery
from .access import Administering, Here, NotFound, Operating, Reading
from .answers import Answer, Done, Instant, refusals
from .calibrations import SVG, the_configuration
from .service import Service
from .stored import picture_answer

if TYPE_CHECKING:
    from ..covariates import CovariateTable
    from ..decisions import Drift
    from ..schedule import Schedules


router = APIRouter(tags=["history"], responses=refusals(400, 401, 403, 404, 409, 422, 503))

Name = Annotated[str, Path(max_length=200, description="Its name.")]
Chart = Annotated[
    Literal["cusum", "ewma", "shewhart"], Query(alias="chart", description="Kind of the charts.")
]
Rate = Annotated[float, Query(ge=0.001, le=10, description="False alarms per year, of all charts.")]


class Signal(Answer):
    """A chart signals."""

    calibration: str
    parameter: str
    since: str
    direction: str


class SeriesRow(Answer):
    """A series: values, predictions and their standard deviations, in the order of the calibrations."""

    name: str
    values: list[float | None]
    expected: list[float | None]
    sigma: list[float | None]
    score: list[float | None]
    learning: bool


class DriftAnswer(Answer):
    """Control charts since the last service event."""

    calibrations: list[str]
    times: list[str]
    series: list[SeriesRow]
    signals: list[Signal]
    explained: list[tuple[str, str, str]] = Field(
        description="Calibration, parameter, and whether the given covariates explain its signal."
    )
    recorded: dict[str, str] = Field(
        description="Units of the conditions that sensors measured with every one of these calibrations."
    )
    limit: float | None
    single: float
    conversion_px: float


class Covariates(
    Answer,
    json_schema_extra={
        "examples": [
            {"table": {"4f2a11d09c3e": {"temperature [°C]": 20.4}}},
            {"recorded": ["air.temperature"]},
        ]
    },
):
    """Covariates of each calibration: a table of them, or what sensors measured with the calibrations."""

    table: dict[str, dict[str, float]] = Field(
        default_factory=dict,
        description="By the key of the calibration: covariates by name, such as `temperature [°C]`.",
    )
    recorded: list[str] = Field(
        default_factory=list, max_length=20, description="In place of a table: names of recorded conditions."
    )


class RunRow(Answer):
    """A run of a schedule."""

    time: Instant
    state: str
    why: str
    attempts: int


class ScheduleRow(Answer):
    """A schedule with its last and next runs."""

    name: str
    recalibration: str
    configuration: str | None
    rule: str
    start: str
    zone: str
    window_minutes: int
    runs: list[RunRow]


class NewSchedule(
    Answer,
    json_schema_extra={
        "example": {
            "name": "weekly",
            "recalibration": "left",
            "rule": "FREQ=WEEKLY;COUNT=52",
            "start": "2026-03-02T08:00",
            "zone": "Europe/Berlin",
        }
    },
):
    """When a recalibration is due: a rule of RFC 5545 in a time zone."""

    name: str = Field(min_length=1, max_length=200, pattern=r"^[^/\\\x00-\x1f]+$")
    recalibration: str = Field(min_length=1, max_length=200)
    configuration: str | None = Field(default=None, max_length=200)
    rule: str = Field(max_length=500)
    start: str = Field(max_length=40)
    zone: str = Field(max_length=60)
    window_minutes: int = Field(default=240, ge=1, le=100_000)


class AlarmRow(Answer):
    """An alarm; `key` names the event."""

    key: str
    text: str
    sent: list[Instant]
    acknowledged: str


class Acknowledged(Answer):
    """Keys of alarms."""

    keys: list[str] = Field(min_length=1, max_length=200)


def drift_of(service: Service, name: str, chart: str = "cusum", rate: float = 0.1) -> Drift:
    """Return the control charts of a configuration."""
    from ..charts import ChartOptions

    known = the_configuration(service, name)
    options = ChartOptions(kind=chart, rate=rate)  # type: ignore[arg-type]
    return service.current(f"drift {name} {chart} {rate}", lambda: known.drift(name, options))


def _plain(values: Any) -> list[float | None]:
    import math

    return [None if not math.isfinite(each) else float(each) for each in values]


def _answer(service: Service, name: str, made: Drift) -> DriftAnswer:
    import math

    charts = made.charts
    since = {each.key: each.since.isoformat() for each in the_configuration(service, name).history(name)}
    last = len(made.keys) - 1
    return DriftAnswer(
        calibrations=list(made.keys), times=[since[key] for key in made.keys],
        series=[
            SeriesRow(
                name=each, values=_plain(made.values[:, k]), expected=_plain(charts.expected[:, k]),
                sigma=_plain(charts.sigma[:, k]), score=_plain(charts.score[:, k]),
                learning=bool(charts.learning[last, k]),
            )
            for k, each in enumerate(made.names)
        ],
        signals=[Signal(**each) for each in made.signals],
        explained=[(each["calibration"], each["parameter"], each["verdict"]) for each in made.verdicts],
        recorded=service.current(
            f"conditions {name}", lambda: the_configuration(service, name).conditions(name)
        ),
        limit=charts.limits.limit if math.isfinite(charts.limits.limit) else None,
        single=charts.limits.single, conversion_px=made.conversion_px,
    )  # fmt: skip


def scheduled(service: Service) -> list[ScheduleRow]:
    """Return all schedules with their last and next runs."""
    from ..schedule import Schedules

    def compute() -> list[ScheduleRow]:
        known = Schedules(service.archive)
        found = []
        for name in known.names():
            each = known.get(name)
            runs = [RunRow.model_validate(run) for run in known.runs(name, ahead=3)[-20:]]
            shown = each.model_dump(exclude={"except_for"})
            found.append(ScheduleRow(**shown, runs=runs))
        return found

    return service.current("schedules", compute)


def all_alarms(service: Service) -> list[AlarmRow]:
    """Return all alarms."""
    from ..alarms import Alarms

    def compute() -> list[AlarmRow]:
        return [AlarmRow.model_validate(each) for each in Alarms(service.archive).all()]

    found = service.current("alarms", compute)
    service.meters.alarms.set(sum(not each.acknowledged for each in found))
    return found


@router.get("/configurations/{name}/drift")
def drift(name: Name, who: Reading, service: Here, chart: Chart = "cusum", rate: Rate = 0.1) -> DriftAnswer:
    """Control charts of all parameters and of the field, since the last service event."""
    return _answer(service, name, drift_of(service, name, chart, rate))


@router.post("/configurations/{name}/drift")
def explained(
    name: Name, given: Covariates, who: Reading, service: Here, chart: Chart = "cusum", rate: Rate = 0.1
) -> DriftAnswer:
    """Control charts that tell drift that covariates explain from drift; nothing is stored."""
    from ..charts import ChartOptions

    known = the_configuration(service, name)
    if bool(given.table) == bool(given.recorded):
        raise UsageError("are neither or twice given", where="covariates", do="give `table` or `recorded`")
    table = known.recorded(name, given.recorded) if given.recorded else _table(given)
    options = ChartOptions(kind=chart, rate=rate)
    return _answer(service, name, known.drift(name, options, table))


def _table(given: Covariates) -> CovariateTable:
    """The table of covariates in a request.

    Raises
    ------
    UsageError
        If its calibrations have not the same covariates.
    """
    import numpy as np

    from ..covariates import CovariateTable

    units = dict[str, str]()
    for key, row in given.table.items():
        found = {each.partition(" [")[0]: each.partition(" [")[2].rstrip("]") for each in row}
        if (units and found != units) or not found:
            raise UsageError("does not have the same covariates as the others", where=f"calibration {key}")
        units = found
    columns = {
        each: np.array(
            [
                value
                for row in given.table.values()
                for n, value in row.items()
                if n.partition(" [")[0] == each
            ]
        )
        for each in units
    }
    return CovariateTable(tuple(given.table), columns, units)


@router.get("/configurations/{name}/drift.svg", response_class=Response, responses=SVG)
def drift_figure(
    request: Request, name: Name, who: Reading, service: Here, chart: Chart = "cusum", rate: Rate = 0.1
) -> Response:
    """The control charts as a figure."""
    from datetime import datetime

    from ...report.control import control_figure

    made = drift_of(service, name, chart, rate)
    answer = _answer(service, name, made)
    times = [datetime.fromisoformat(each) for each in answer.times]

    def draw() -> str:
        return control_figure(
            made.names, times, made.values, made.charts.expected, made.charts.sigma, made.charts.alarm,
            the_configuration(service, name).events(name)[-1:],
        )  # fmt: skip

    return picture_answer(request, draw, "image/svg+xml", f"{made.keys[-1]}-{len(made.keys)}-{chart}-{rate}")


@router.get("/schedules")
def schedules(who: Reading, service: Here) -> list[ScheduleRow]:
    """Schedules with their last and next runs: due, overdue, missed, done."""
    return scheduled(service)


@router.post("/schedules", status_code=201)
def add_schedule(given: NewSchedule, who: Administering, service: Here) -> Done:
    """Add a schedule, or change one."""
    from ..recalibration import Recalibrations
    from ..schedule import Schedule, Schedules

    if given.recalibration not in Recalibrations(service.archive).names():
        raise NotFound("is not a recalibration of this archive", where=given.recalibration)
    made = Schedule.from_content({"schema": "reseau-schedule/1", **given.model_dump()}, where="schedule")
    with service.audited(who, "schedule", given.name, {"rule": given.rule}):
        Schedules(service.archive).add(made)
    return Done(done="added")


def _the_schedule(service: Service, name: str) -> Schedules:
    """The schedules of the archive, one of which has this name."""
    from ..schedule import Schedules

    known = Schedules(service.archive)
    if name not in known.names():
        raise NotFound("is not a schedule of this archive", where=name)
    return known


@router.delete("/schedules/{name}")
def remove_schedule(name: Name, who: Administering, service: Here) -> Done:
    """Remove a schedule; its history stays."""
    known = _the_schedule(service, name)
    with service.audited(who, "remove schedule", name):
        known.remove(name)
    return Done(done="removed")


@router.get(
    "/schedules/{name}/calendar.ics", response_class=Response,
    responses={200: {"content": {"text/calendar": {}}, "description": "The calendar"}},
)  # fmt: skip
def calendar(name: Name, who: Reading, service: Here) -> Response:
    """The runs of a schedule as an iCalendar feed."""
    return Response(_the_schedule(service, name).feed(name), media_type="text/calendar")


@router.get("/alarms")
def alarms(
    who: Reading,
    service: Here,
    everything: Annotated[bool, Query(alias="all", description="Also acknowledged ones.")] = False,
) -> list[AlarmRow]:
    """Alarms that nobody acknowledged, or all."""
    return [each for each in all_alarms(service) if everything or not each.acknowledged]


@router.put("/alarms/delivery")
def deliver(given: AlarmDelivery, who: Administering, service: Here) -> Done:
    """Set where the service sends alarms."""
    from ..alarms import Alarms

    with service.audited(who, "send alarms", "alarms", {"addresses": len(given.notify)}):
        Alarms(service.archive).deliver_to(given)
    return Done(done=f"sent to {len(given.notify)} addresses" if given.notify else "sent nowhere")


@router.post("/alarms/acknowledge")
def acknowledge(given: Acknowledged, who: Operating, service: Here) -> Done:
    """Acknowledge alarms: they are not repeated."""
    from ..alarms import Alarms

    known = Alarms(service.archive)
    there = {each.key for each in known.all()}
    for key in given.keys:
        if key not in there:
            raise NotFound("is no alarm", where=key)
    for key in given.keys:
        with service.audited(who, "acknowledge", key):
            known.acknowledge(key, who.name)
    return Done(done=f"{len(given.keys)} acknowledged")
