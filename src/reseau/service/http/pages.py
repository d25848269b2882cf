"""The pages: rendered from the answers of the API's own operations, and nothing else."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Annotated, Any, Self
from urllib.parse import quote

import jinja2
from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse

from ...archive import Session
from ...core.errors import ReseauError
from ...core.options import Declared, Group, options_of
from ...core.vocabulary import names
from ...io.photographs import PHOTOGRAPHS
from ...report.template import environment
from ..orders import BUSY
from . import accounts, benches, calibrations, comparisons, history, operations, orders, sessions
from .access import Administering, Here, NotFound, Reading, Unknown, csrf_of, principal_of, service_of
from .forms import FormField, form_of
from .service import Service

if TYPE_CHECKING:
    from ...sessions.kinds import SessionKind

router = APIRouter(include_in_schema=False)

_STATIC = {
    "app.css": "text/css",
    "app.js": "text/javascript",
    "scene.js": "text/javascript",
    "icon.svg": "image/svg+xml",
}
NAV = (
    ("/benches", "Bench"),
    ("/sessions", "Sessions"),
    ("/calibrations", "Calibrations"),
    ("/files", "Files"),
    ("/history", "History"),
    ("/account", "Account"),
)
_SHOWN = 400
"""Frames on the page of a session."""
_RULES = {"version": 1, "image": {"warning": 0.1, "action": 0.3}}
"""Rules that are proposed where a configuration has none."""


@cache
def _templates() -> jinja2.Environment:
    found = environment("reseau.service", "pages/app")
    found.filters |= {"plain": _plain, "powers": _powers, "symbol": _symbol, "sentence": _sentence}
    found.globals["vocabulary"] = names()
    return found


def _plain(value: Any) -> str:
    """A value of JSON as people read it."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {_plain(each)}" for key, each in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_plain(each) for each in value)
    if isinstance(value, bool) or value in (None, ""):
        return {True: "yes", False: "no"}.get(value, "—")
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _powers(text: str) -> str:
    """A text with units such as mm^-2, with their powers as people write them."""
    return re.sub(r"\^(-?[0-9]+)", lambda found: found[1].translate(_RAISED), text)


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _symbol(name: str) -> str:
    """The name of a standard deviation as people write it."""
    return "σ₀" if name == "sigma0" else name.replace("sigma_", "σ of ")


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith((".", "!", "?")) else ".")


def _rendered(request: Request, template: str, status: int = 200, **content: Any) -> HTMLResponse:
    """Render a page for whoever asks for it."""
    service = service_of(request)
    who = principal_of(request)
    cookie = request.cookies.get(service.cookie, "")
    here = "/" + request.url.path.strip("/").partition("/")[0]
    page = _templates().get_template(template)
    text = page.render(
        content, who=who, csrf=csrf_of(cookie) if cookie else "", nav=NAV, here=here,
        may_operate=who is not None and who.may("operate"),
        may_administer=who is not None and who.may("administer"),
    )  # fmt: skip
    return HTMLResponse(text, status)


def rendered_error(request: Request, status: int, text: str) -> Response:
    """Return a page that says what is wrong."""
    return _rendered(request, "error.html.j2", status, text=text, code=status)


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
    schedules, configurations = history.scheduled(service), calibrations.listed(service)
    runs = [(each.name, run) for each in schedules for run in each.runs if run.state != "done"]
    kept, charted = sessions.rows(service, 10), [each for each in configurations if each.decisions > 1]
    return _rendered(
        request, "home.html.j2", alarms=[a for a in history.all_alarms(service) if not a.acknowledged],
        benches=[_card(benches.bench_answer(service, each)) for each in service.benches.values()],
        sessions=kept, configurations=configurations, charted=charted,
        runs=sorted(runs, key=lambda each: each[1].time)[-8:],
        steps=_first_steps(service, bool(kept), configurations, bool(schedules)),
    )  # fmt: skip


def _first_steps(
    service: Service, captured: bool, configurations: list[calibrations.ConfigurationRow], scheduled: bool
) -> list[tuple[bool, str, str]]:
    """What leads from an empty archive to scheduled recalibrations: whether it is done, what, and where."""
    bench = f"/benches/{quote(next(iter(service.benches)))}" if service.benches else "/files"
    steps = [
        (captured, "Begin a session on a bench, or drop photographs of a target", bench),
        (bool(configurations), "Define the configuration: camera, lens, …", "/calibrations"),
        (any(each.decisions for each in configurations), "Judge the calibration of the session by rules",
         f"/calibrations/{quote(configurations[0].name)}" if configurations else "/calibrations"),
        (any(each.in_force for each in configurations), "Accept it as the reference, from which drift counts",
         "/history"),
        (bool(orders.every_recalibration(service)), "Define the recalibration that repeats it", "/history"),
        (scheduled, "Add its schedule", "/history"),
    ]  # fmt: skip
    return [] if all(done for done, _, _ in steps) else steps


def _card(found: benches.BenchAnswer) -> dict[str, str]:
    """A bench in a line."""
    text = found.error or found.moving or ("its worker starts" if found.state == "starting" else "idle")
    if found.session is not None and found.state in BUSY:
        text = f"{found.session.name}: {found.session.good}"
        text += "" if found.session.expected is None else f" of {found.session.expected} poses"
    return {"name": found.name, "state": found.state, "text": text}


@router.get("/benches")
def benches_page(request: Request, who: Reading, service: Here) -> Response:
    """The bench, or all of them."""
    if len(service.benches) == 1:
        return RedirectResponse(f"/benches/{quote(next(iter(service.benches)))}", 303)
    cards = [_card(benches.bench_answer(service, each)) for each in service.benches.values()]
    return _rendered(request, "benches.html.j2", benches=cards)


@router.get("/benches/{bench}")
def bench_page(request: Request, bench: str, who: Reading, service: Here) -> Response:
    """A bench: live picture, axes, settings, session."""
    from ...sessions import kinds

    link = benches.the_bench(service, bench)
    found = benches.bench_answer(service, link)
    settings: dict[str, Any] = {}
    axes: dict[str, Any] = {}
    if found.state in ("ready", "paused", "moving"):
        try:
            settings = benches.settings(bench, who, service)
            axes = benches.axes(bench, who, service) if found.has_table else {}
        except ReseauError:  # the worker ended meanwhile; the next event shows it
            pass
    busy = found.session is not None and found.state in BUSY
    return _rendered(
        request,
        "bench.html.j2",
        b=found,
        settings=settings,
        axes=axes,
        busy=busy,
        queue=orders.orders(bench, who, service),
        plans={
            plan: _PlanForm.of(kind)
            for plan, kind in reversed(list(kinds.KINDS.items()))
            if plan not in ("own", *kinds.OF_FILES)
        },
    )


@dataclass(frozen=True)
class _PlanForm:
    """Form of a session of a plan: its input files, what it needs, and the rest of its options."""

    inputs: dict[str, Declared]
    first: dict[str, tuple[Declared, Any]]
    more: dict[str, tuple[Declared, Any]]

    @classmethod
    def of(cls, kind: SessionKind) -> Self:
        from ...sessions.kinds import input_option

        fields = kind.parameters.model_fields
        found = {
            name: (each, None if fields[name].is_required() else fields[name].default)
            for name, each in options_of(kind.parameters).items()
        }
        later = {name for name, (each, _) in found.items() if each.option.group is Group.EXECUTION}
        return cls(
            {name: names()[input_option(name)] for name in kind.inputs},
            {name: each for name, each in found.items() if name not in later},
            {name: each for name, each in found.items() if name in later},
        )


@router.get("/sessions")
def all_sessions(
    request: Request,
    who: Reading,
    service: Here,
    like: Annotated[str, Query(max_length=200)] = "",
    before: Annotated[str | None, Query(max_length=200)] = None,
) -> Response:
    """All sessions, latest first."""
    found = sessions.sessions(who, service, 50, before, like)
    return _rendered(request, "sessions.html.j2", sessions=found.sessions, before=found.before, like=like)


@router.get("/sessions/{session}")
def session_page(request: Request, session: str, who: Reading, service: Here) -> Response:
    """A session."""
    kept = sessions.the_session(service, session)
    found = sessions.session_detail(service, kept)
    frames = sessions.latest_frames(kept, _SHOWN)
    every = [benches.bench_answer(service, each) for each in service.benches.values()]
    mine = [b for b in every if b.session is not None and b.session.name == session and b.state in BUSY]
    running = mine[0] if mine else None
    return _rendered(
        request, "session.html.j2", s=found, frames=frames[::-1], shown=_SHOWN,
        report=_report(found), scene=sessions.scene_result(kept) is not None,
        verdict=_read_verdict(kept, found), bench=running,
        reached=running.session.reached if running is not None and running.session is not None else {},
        units=running.session.units if running is not None and running.session is not None else {},
        job=service.jobs.of(session),
    )  # fmt: skip


def _read_verdict(session: Session, found: sessions.SessionDetail) -> list[str]:
    """As :func:`_verdict`; a file that is damaged or lost does not hide the session."""
    try:
        return _verdict(session, found)
    except ReseauError as error:
        return [str(error)]


def _verdict(session: Session, found: sessions.SessionDetail) -> list[str]:
    """What the results of a session are good for, in lines."""
    from ...io.frame import RollSummary
    from ...sessions import conducting

    latest = {each.name: each for each in session.results()}
    if found.plan == "film" and "summary.json" in latest:
        summary = RollSummary.parse(session.content(latest["summary.json"]).decode(), where="summary.json")
        counts = ", ".join(f"{count} {what}" for what, count in summary.counts() if count)
        return [f"{len(summary.frames)} frames: {counts}"]
    if "calibration.json" not in latest:
        return []
    calibration = conducting.calibration_of(session)
    if found.plan == "oscilloscope":
        points = {
            each.step: each.verdict.facts.get("points")
            for each in session.frames(kind="frame")
            if each.verdict is not None and each.verdict.ok
        }
        words = {"PHOTO I": "marks of the reseau", "PHOTO II": "rods", "PHOTO III": "points of the body"}
        parts = [f"{points[photo]} {what}" for photo, what in words.items() if points.get(photo)]
        sigma0 = "" if calibration.sigma0 is None else f"; σ₀ {calibration.sigma0:.2f}"
        return [f"Camera and oscilloscope are corrected: {', '.join(parts)}{sigma0}"]
    return calibrations.verdict_of(calibration)


def _report(session: sessions.SessionDetail) -> int | None:
    """Number of the latest report of a session."""
    found = [each.id for each in session.results if each.name == "report.html"]
    return found[-1] if found else None


@router.get("/sessions/{session}/frames/{number}")
def frame_page(request: Request, session: str, number: int, who: Reading, service: Here) -> Response:
    """A frame with the marks found in it."""
    kept = sessions.the_session(service, session)
    row = next((each for each in sessions.frames(session, who, service, number - 1, 1)), None)
    if row is None or row.id != number:
        raise NotFound("has no such frame", where=f"{session}: {number}")
    overlay = row.suffix == ".tif" and not {"design.json", "reseau.json"}.isdisjoint(kept.inputs())
    return _rendered(request, "frame.html.j2", f=row, session=session, overlay=overlay)


@router.get("/calibrations")
def configurations_page(request: Request, who: Reading, service: Here) -> Response:
    """All configurations."""
    return _rendered(request, "configurations.html.j2", configurations=calibrations.listed(service))


@router.get("/calibrations/{name}")
def configuration_page(request: Request, name: str, who: Reading, service: Here) -> Response:
    """A configuration with its history and control charts."""
    found = calibrations.configuration_detail(service, name)
    drift = None
    if len(found.history) > 1:
        try:
            drift = history.drift(name, who, service)
        except ReseauError:  # such as calibrations of different cameras: the alarms say so
            drift = None
    from ..rules import AcceptanceRules

    rules = calibrations.rules_of(service, name) or _RULES
    return _rendered(
        request, "configuration.html.j2", c=found, charted=drift is not None, drift=drift,
        sessions=comparisons.calibrated(service), rules=form_of(AcceptanceRules, rules, "rules."),
    )  # fmt: skip


@router.get("/compare")
def compare_page(
    request: Request,
    who: Reading,
    service: Here,
    first: Annotated[str, Query(max_length=300)] = "",
    second: Annotated[str, Query(max_length=300)] = "",
) -> Response:
    """Any two calibrations."""
    every = comparisons.choices(service)
    content: dict[str, Any] = {"c": None, "choices": every, "first": first, "second": second}
    if first and second:
        one, two = comparisons.chosen(service, first), comparisons.chosen(service, second)
        content |= {"one": one, "two": two}
        try:
            content["c"], field = comparisons.comparison(one, two)
            content["drawn"] = field is not None
        except ReseauError as error:  # such as an oscilloscope and a camera
            content["why"] = str(error)
    return _rendered(request, "compare.html.j2", **content)


@router.get("/calibrations/{name}/{key}")
def calibration_page(request: Request, name: str, key: str, who: Reading, service: Here) -> Response:
    """A calibration and the decision on it."""
    found = calibrations.calibration_detail(service, name, key)
    current = calibrations.configuration_detail(service, name).in_force
    report, scene = None, False
    if found.decision.session is not None:
        kept = sessions.the_session(service, found.decision.session)
        scene = sessions.scene_result(kept) is not None
        report = _report(sessions.session_detail(service, kept))
    tests = {}
    for each in found.tests:
        if {"parameter", "p"} <= each.keys():
            tests[each["parameter"]] = f"p = {each['p']:.2g}"
    from ..certificates import CertificateData

    return _rendered(
        request, "calibration.html.j2", c=found, report=report, scene=scene, tests=tests,
        certificate=form_of(CertificateData, prefix="data."),
        in_force=current is not None and current.key == found.decision.key,
    )  # fmt: skip


@router.get("/files")
def files_page(request: Request, who: Reading, service: Here) -> Response:
    """Upload of photographs."""
    return _rendered(request, "files.html.j2", accept=",".join(PHOTOGRAPHS))


@router.get("/history")
def history_page(request: Request, who: Reading, service: Here) -> Response:
    """Alarms, reviews, schedules and drift."""
    from ..alarms import Alarms
    from ..delivering import AlarmDelivery
    from ..recalibration import Recalibration

    sent_to = Alarms(service.archive).delivery.to_dict() if who.may("administer") else {}
    alarms = history.all_alarms(service)
    found = calibrations.listed(service)
    waiting = [
        (each.name, decision)
        for each in found
        if each.to_review
        for decision in calibrations.configuration_detail(service, each.name).history
        if decision.outcome == "needs review"
    ]
    return _rendered(
        request, "history.html.j2", alarms=[a for a in alarms if not a.acknowledged],
        acknowledged=[a for a in alarms if a.acknowledged], schedules=history.scheduled(service),
        configurations=found, to_review=waiting, recalibrations=orders.every_recalibration(service),
        sessions=comparisons.calibrated(service), schedule=_schedule_form(),
        repeated=form_of(Recalibration, prefix="", but=_OF_SESSION),
        delivery=form_of(AlarmDelivery, sent_to), unsent=service.unsent,
    )  # fmt: skip


_OF_SESSION = ("name", "configuration", "plan", "parameters", "inputs", "bench", "rules", "certificate")
"""Keys of a recalibration that its session determines, or that are chosen among what there is."""


def _schedule_form() -> tuple[FormField, ...]:
    """The form of a schedule, filled with one that is due each week from tomorrow on."""
    from ..schedule import Schedule

    tomorrow = f"{datetime.now(UTC) + timedelta(days=1):%Y-%m-%dT08:00}"
    values = {"rule": "FREQ=WEEKLY;COUNT=520", "start": tomorrow, "zone": "UTC"}
    return form_of(Schedule, values, but=("recalibration", "configuration", "except_for"))


@router.get("/account")
def account(request: Request, who: Reading, service: Here) -> Response:
    """My account and my tokens; for administrators all users and tokens."""
    users = accounts.users(who, service) if who.may("administer") else []
    return _rendered(request, "account.html.j2", users=users, tokens=accounts.tokens(who, service))


@router.get("/audit")
def audit(request: Request, who: Administering, service: Here) -> Response:
    """The audit log."""
    return _rendered(
        request, "audit.html.j2", entries=operations.audit(who, service, 200, None),
        # What was whole a moment ago is not verified at each event; `reseau audit verify` verifies all.
        state=operations.audited(service, again=False),
    )  # fmt: skip
