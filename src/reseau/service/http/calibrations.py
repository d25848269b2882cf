"""Operations on configurations and their calibrations: verdicts, decisions, certificates."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from datetime import UTC, date, datetime
from typing import TYPE_CHECKING, Annotated, Any, Literal

from fastapi import APIRouter, Path, Request, Response
from pydantic import AwareDatetime, Field

from ...calibration.assessment import Assessment
from ...core.errors import ReseauError, UsageError
from ..rules import Finding
from .access import Administering, Here, NotFound, Operating, Reading
from .answers import Answer, Done, Instant, refusals
from .service import Service
from .sessions import the_session
from .stored import FILE_ANSWERS, file_answer, picture_answer

if TYPE_CHECKING:
    from ...calibration import Calibration
    from ..decisions import Decision
    from ..inforce import Configurations


router = APIRouter(tags=["calibrations"], responses=refusals(400, 401, 403, 404, 409, 422, 503))

Name = Annotated[str, Path(max_length=200, description="Name of the configuration.")]
Key = Annotated[str, Path(max_length=100, description="Decision, by its name or the start of its key.")]
SVG: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/svg+xml": {}}, "description": "The figure"}
}  # fmt: skip


_KINDS = {"pdf": "application/pdf", "xml": "application/xml", "html": "text/html; charset=utf-8"}


class InForce(Answer):
    """The calibration that applies."""

    key: str
    name: str
    since: Instant
    why: str


class ConfigurationRow(Answer):
    """A configuration of an instrument."""

    name: str
    parts: dict[str, str]
    in_force: InForce | None
    decisions: int
    to_review: int


class EarlierRow(Answer):
    """A judgement by an earlier version of the rules."""

    at: Instant
    by: str
    outcome: str
    rules: int


class DecisionRow(Answer):
    """A decision on a calibration; `session` is the one of the archive that has it among its results.

    Without a name that somebody gave it, `name` is that of its session, or says when it began.
    """

    key: str
    name: str
    outcome: str
    since: Instant
    at: Instant
    by: str
    comment: str
    compared_with: str | None
    findings: list[Finding]
    reviewed_by: str
    review: str
    comments: list[tuple[str, str]]
    session: str | None
    earlier: list[EarlierRow]


class EventRow(Answer):
    """A service event."""

    at: Instant
    what: str


class ConfigurationDetail(ConfigurationRow):
    """A configuration with its history, latest decision first."""

    history: list[DecisionRow]
    events: list[EventRow]


class ParameterRow(Answer):
    """A parameter with its standard deviation; 0: it was held."""

    name: str
    value: float
    sigma: float
    unit: str
    text: str


class CorrelationRow(Answer):
    """Two parameters and their correlation."""

    first: str
    second: str
    correlation: float


class CalibrationDetail(Answer):
    """A calibration and the decision on it; `verdict` says what it is good for."""

    verdict: list[str]
    assessment: Assessment | None
    configuration: str
    decision: DecisionRow
    kind: str
    name: str
    sigma0: float | None
    redundancy: int
    parameters: list[ParameterRow]
    correlations: list[CorrelationRow]
    tests: list[dict[str, Any]]
    validity: dict[str, Any]
    provenance: dict[str, Any]
    figures: list[str]


class NewConfiguration(
    Answer, json_schema_extra={"example": {"name": "left", "parts": {"camera": "DMK 33", "lens": "8 mm"}}}
):
    """A configuration by its parts."""

    name: str = Field(min_length=1, max_length=200, pattern=r"^[^/\\\x00-\x1f]+$")
    parts: dict[str, str] = Field(min_length=1, max_length=50)


class NewDecision(
    Answer,
    json_schema_extra={
        "example": {
            "session": "monday",
            "rules": {
                "schema": "reseau-acceptance/1",
                "version": 1,
                "image": {"warning": 0.1, "action": 0.3},
            },
        }
    },
):
    """A calibration of a session, or a document, to be judged by rules (`reseau-acceptance/1`)."""

    session: str | None = Field(default=None, max_length=200)
    calibration: dict[str, Any] | None = None
    rules: dict[str, Any]
    since: AwareDatetime | None = None
    name: str = Field(default="", max_length=100, description="Name of the calibration.")
    comment: str = Field(default="", max_length=2000)


class Review(Answer):
    """The outcome of a review, and the reason."""

    outcome: Literal["accepted", "rejected"]
    comment: str = Field(min_length=1, max_length=2000)


class Comment(Answer):
    """A comment."""

    comment: str = Field(min_length=1, max_length=2000)


class NewName(Answer, json_schema_extra={"example": {"name": "after the new lens"}}):
    """The name of a calibration."""

    name: str = Field(min_length=1, max_length=100, pattern=r"^[^/\\\x00-\x1f]+$")


class Return(Answer):
    """From when on an earlier calibration applies again; by default from now on."""

    since: AwareDatetime | None = None
    comment: str = Field(default="", max_length=2000)


class ServiceEvent(Answer, json_schema_extra={"example": {"what": "lens changed"}}):
    """What happened to the instrument."""

    what: str = Field(min_length=1, max_length=500)
    at: AwareDatetime | None = None


class CertificateOrder(Answer):
    """What a certificate says besides (`reseau-certificate-data/1`), and its form."""

    data: dict[str, Any]
    form: Literal["pdf", "xml", "html"] = "pdf"
    issued: date | None = None
    probability: float = Field(default=0.95, gt=0.5, lt=1)


class BulkReview(Answer):
    """Several decisions, reviewed with one outcome and one reason."""

    decisions: list[tuple[str, str]] = Field(
        min_length=1, max_length=200, description="Configuration and key of each."
    )
    outcome: Literal["accepted", "rejected"]
    comment: str = Field(min_length=1, max_length=2000)


class Reviewed(Answer):
    """What became of each decision; empty: it was reviewed."""

    outcome: str
    failed: dict[str, str]


def known_configurations(service: Service) -> Configurations:
    """Return the configurations of the archive."""
    from ..inforce import Configurations

    return Configurations(service.archive)


def the_configuration(service: Service, name: str) -> Configurations:
    """Return the configurations of the archive, one of which has this name.

    Raises
    ------
    NotFound
        If none has.
    """
    known = known_configurations(service)
    if name not in known.names():
        raise NotFound("is not a configuration of this archive", where=name)
    return known


def the_decision(known: Configurations, name: str, key: str) -> Decision:
    """Return a decision by its name or the start of its key; raise NotFound if there is none."""
    try:
        return known.decision(name, key)
    except UsageError as error:
        raise NotFound(error.what, where=error.where) from None


def decision_row(decision: Decision) -> DecisionRow:
    """Return a decision as it is answered."""
    shown = {key: value for key, value in vars(decision).items() if key != "judgement"}
    return DecisionRow.model_validate(
        shown
        | {
            "name": decision.name or decision.session or f"{decision.since:%-d %B %Y %H:%M} UTC",
            "findings": decision.judgement.findings,
            "earlier": [
                {"at": at, "by": by, "outcome": each.outcome, "rules": int(str(each.rules["version"]))}
                for by, at, each in decision.earlier
            ],
        }
    )


def _row(service: Service, known: Configurations, name: str, history: list[Decision]) -> dict[str, Any]:
    """What a list shows of a configuration."""
    applied, in_force = known.applied(name, service.archive.clock()), None
    if applied is not None:
        row = decision_row(known.decision(name, applied.key))
        in_force = InForce(key=applied.key, name=row.name, since=applied.since.isoformat(), why=applied.why)
    return {
        "name": name, "parts": known.parts(name), "in_force": in_force, "decisions": len(history),
        "to_review": sum(each.outcome == "needs review" for each in history),
    }  # fmt: skip


def listed(service: Service) -> list[ConfigurationRow]:
    """Return all configurations."""

    def compute() -> list[ConfigurationRow]:
        known = known_configurations(service)
        return [ConfigurationRow(**_row(service, known, name, known.history(name))) for name in known.names()]

    return service.current("configurations", compute)


def configuration_detail(service: Service, name: str) -> ConfigurationDetail:
    """Return a configuration with its history."""
    known = the_configuration(service, name)
    history = known.history(name)
    return ConfigurationDetail(
        **_row(service, known, name, history), history=[decision_row(each) for each in reversed(history)],
        events=[EventRow(at=at.isoformat(), what=what) for at, what in known.events(name)],
    )  # fmt: skip


def verdict_of(calibration: Calibration) -> list[str]:
    """Return what a calibration is good for, in words; nothing if it does not say."""
    return [] if calibration.assessment is None else list(calibration.assessment.lines)


def rules_of(service: Service, name: str) -> dict[str, Any] | None:
    """Return the rules by which a configuration was judged last."""
    history = the_configuration(service, name).history(name)
    return dict(history[-1].judgement.rules) if history else None


def calibration_detail(service: Service, name: str, key: str) -> CalibrationDetail:
    """Return a calibration and the decision on it."""
    from ...core.numbers import measured

    known = the_configuration(service, name)
    decision = the_decision(known, name, key)
    found = known.calibration(name, decision.key)
    matrix, names = found.covariance.matrix, found.covariance.names
    pairs = []
    for i, first in enumerate(names):
        for j in range(i):
            scale = (matrix[i][i] * matrix[j][j]) ** 0.5
            if scale > 0:
                pairs.append((names[j], first, matrix[i][j] / scale))
    pairs.sort(key=lambda pair: -abs(pair[2]))
    return CalibrationDetail(
        verdict=verdict_of(found), assessment=found.assessment,
        configuration=name, decision=decision_row(decision), kind=found.kind, name=found.name,
        sigma0=found.sigma0, redundancy=found.redundancy,
        parameters=[
            ParameterRow(
                name=each, value=q.value, sigma=q.sigma, unit=q.unit,
                text=measured(q.value, q.sigma, q.unit),
            )
            for each, q in found.parameters.items()
        ],
        correlations=[CorrelationRow(first=a, second=b, correlation=r) for a, b, r in pairs],
        tests=list(found.tests), validity=found.validity, provenance=found.provenance,
        figures=["uncertainty", "distortion"] if found.kind == "camera" else [],
    )  # fmt: skip


@router.get("/configurations")
def configurations(who: Reading, service: Here) -> list[ConfigurationRow]:
    """Configurations of instruments, with the calibration in force of each."""
    return listed(service)


@router.post("/configurations", status_code=201)
def define(given: NewConfiguration, who: Administering, service: Here) -> Done:
    """Define a configuration by its parts."""
    with service.audited(who, "define configuration", given.name, {"parts": given.parts}):
        known_configurations(service).define(given.name, given.parts)
    return Done(done="defined")


@router.get("/configurations/{name}")
def configuration(name: Name, who: Reading, service: Here) -> ConfigurationDetail:
    """A configuration with all decisions, latest first, and its service events."""
    return configuration_detail(service, name)


@router.post("/configurations/{name}/decisions", status_code=201)
def decide(name: Name, given: NewDecision, who: Administering, service: Here) -> DecisionRow:
    """Judge a calibration by rules, and put it in force if they accept it."""
    from ...calibration import Calibration
    from ...sessions import conducting
    from ..rules import AcceptanceRules

    known = the_configuration(service, name)
    if (given.session is None) == (given.calibration is None):
        raise UsageError("give one of them", where="session, calibration")
    rules = AcceptanceRules.from_content(dict(given.rules), where="rules")
    since = given.since
    if given.session is not None:
        session = the_session(service, given.session)
        calibration, since = conducting.calibration_of(session), since or session.begun
    else:
        assert given.calibration is not None
        calibration = Calibration.from_content(dict(given.calibration), where="calibration")
    facts = {"session": given.session, "rules": rules.version, "calibration": calibration.name}
    with service.audited(who, "decide", name, facts):
        made = known.decide(
            name, calibration, rules, since=since, by=who.name, comment=given.comment, session=given.session
        )
        if given.name.strip():
            made = known.rename(name, made.key, given.name, by=who.name)
    return decision_row(made)


@router.get("/configurations/{name}/decisions/{key}")
def decision(name: Name, key: Key, who: Reading, service: Here) -> CalibrationDetail:
    """A calibration: parameters, tests, correlations, and the decision on it."""
    return calibration_detail(service, name, key)


@router.get(
    "/configurations/{name}/decisions/{key}/calibration.json", response_class=Response, responses=FILE_ANSWERS
)
def document(request: Request, name: Name, key: Key, who: Reading, service: Here) -> Response:
    """The calibration as a document, `reseau-calibration/1`."""
    known = the_configuration(service, name)
    found = known.calibration(name, the_decision(known, name, key).key)
    content = found.to_json().encode("utf-8")
    return file_answer(
        request, io.BytesIO(content), f"{name} {key}.json", hashlib.sha256(content).hexdigest()
    )


@router.get(
    "/configurations/{name}/decisions/{key}/figures/{figure}.svg", response_class=Response, responses=SVG
)
def figure(
    request: Request,
    name: Name,
    key: Key,
    figure: Annotated[Literal["uncertainty", "distortion"], Path(description="Which figure.")],
    who: Reading,
    service: Here,
) -> Response:
    """The uncertainty of the projection over the image, or the distortion."""
    known = the_configuration(service, name)
    decision = the_decision(known, name, key)
    calibration = known.calibration(name, decision.key)
    return picture_answer(
        request, lambda: _drawn(calibration, figure), "image/svg+xml", f"{decision.key}-{figure}"
    )


def _drawn(calibration: Calibration, figure: str) -> str:
    from ...calibration import CameraMapping, projection_field
    from ...report.bundle_figures import distortion_figure
    from ...report.fields import errors_figure, uncertainty_figure

    lens = CameraMapping.from_calibration(calibration)
    errors = None if calibration.assessment is None else calibration.assessment.errors
    if figure == "uncertainty":
        return uncertainty_figure(projection_field(lens)) if errors is None else errors_figure(errors)
    drawn = distortion_figure(lens, errors)
    if drawn is None:
        raise NotFound("has no distortion", where=calibration.name)
    return drawn[0]


def _audited(
    service: Service, who: Any, action: str, name: str, key: str, facts: dict[str, Any],
    do: Callable[[Configurations, str], object],
) -> DecisionRow:  # fmt: skip
    """Do something about a decision, recorded, and return the decision."""
    known = the_configuration(service, name)
    full = the_decision(known, name, key).key
    with service.audited(who, action, f"{name} {full}", facts):
        do(known, full)
    return decision_row(known.decision(name, full))


@router.post("/configurations/{name}/decisions/{key}/review")
def review(name: Name, key: Key, given: Review, who: Administering, service: Here) -> DecisionRow:
    """Accept or reject a calibration that needs a review."""
    return _audited(
        service, who, "review", name, key, {"outcome": given.outcome, "comment": given.comment},
        lambda known, full: known.review(name, full, given.outcome, by=who.name, comment=given.comment),
    )  # fmt: skip


@router.post("/reviews")
def bulk_review(given: BulkReview, who: Administering, service: Here) -> Reviewed:
    """Review several calibrations at once; what fails is named, the others are done."""
    failed = {}
    one = Review(outcome=given.outcome, comment=given.comment)
    for name, key in given.decisions:
        try:
            review(name, key, one, who, service)
        except ReseauError as error:
            failed[f"{name} {key}"] = str(error)
    return Reviewed(outcome=given.outcome, failed=failed)


@router.post("/configurations/{name}/decisions/{key}/comments", status_code=201)
def comment(name: Name, key: Key, given: Comment, who: Operating, service: Here) -> DecisionRow:
    """Add a comment; the outcome stays."""
    return _audited(
        service, who, "comment", name, key, {"comment": given.comment},
        lambda known, full: known.comment(name, full, given.comment, by=who.name),
    )  # fmt: skip


@router.post("/configurations/{name}/decisions/{key}/name")
def rename(name: Name, key: Key, given: NewName, who: Administering, service: Here) -> DecisionRow:
    """Give a calibration a name, by which people call it."""
    return _audited(
        service, who, "name", name, key, {"name": given.name},
        lambda known, full: known.rename(name, full, given.name, by=who.name),
    )  # fmt: skip


@router.post("/configurations/{name}/decisions/{key}/return")
def roll_back(name: Name, key: Key, given: Return, who: Administering, service: Here) -> DecisionRow:
    """Return to an earlier accepted calibration."""
    return _audited(
        service, who, "return", name, key, {"since": given.since, "comment": given.comment},
        lambda known, full: known.roll_back(
            name, full, since=given.since, by=who.name, comment=given.comment
        ),
    )  # fmt: skip


@router.post("/configurations/{name}/events", status_code=201)
def service_event(name: Name, given: ServiceEvent, who: Operating, service: Here) -> Done:
    """Note a service event: from then on no calibration applies, and a run is due at once."""
    known = the_configuration(service, name)
    with service.audited(who, "service event", name, {"what": given.what, "at": given.at}):
        known.event(name, given.what, at=given.at, by=who.name)
    return Done(done="noted")


@router.post(
    "/configurations/{name}/decisions/{key}/certificate", response_class=Response,
    responses={200: {"content": {kind: {} for kind in _KINDS.values()}, "description": "The certificate"}},
)  # fmt: skip
def certificate(name: Name, key: Key, given: CertificateOrder, who: Administering, service: Here) -> Response:
    """Create the certificate of an accepted calibration: PDF with its XML, DCC or HTML.

    The XML, also that in the PDF, is signed if the service was given a key to sign with.
    """
    from ...core.optional import optional

    with optional():
        from ..certificates import CertificateData, certify
        from ..certificates.page import contents_of

    known, options = the_configuration(service, name), service.options
    decision = the_decision(known, name, key)
    facts = {"form": given.form, "signed": given.form != "html" and options.signing_key is not None}
    with service.audited(who, "certificate", f"{name} {decision.key}", facts), optional():
        data = CertificateData.from_content(dict(given.data), where="data")
        made = certify(
            known.calibration(name, decision.key), data,
            issued=given.issued or datetime.now(UTC).date(), decision=decision, configuration=name,
            earlier=known.earlier(name, decision), probability=given.probability,
        )  # fmt: skip
        keys = options.signing_key, options.signing_certificate
        content = contents_of(made, [given.form], *keys)[given.form]
    from .stored import SANDBOX

    headers = {
        "Content-Disposition": f'attachment; filename="certificate.{given.form}"',
        "Content-Security-Policy": SANDBOX,
    }
    return Response(content, 200, headers, _KINDS[given.form])
