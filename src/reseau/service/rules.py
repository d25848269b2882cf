"""Rules by which a new calibration is accepted, and the decision that follows from them.

Three kinds of rules. *Complete*: is the calibration determined well enough to be judged at all? *Practical*:
has the instrument changed by more than a tolerance, over the image and in object space, since the calibration
in force, and since the reference? What is a change, and not an error of a run, is what competing models of
all runs say. *Statistical*: is the difference significant, with the
covariances of both (congruence test)? Each has two limits, for a warning and for action.

=====================================  ======================  =======================
change since the one in force          not significant         significant
=====================================  ======================  =======================
below the warning limit                accepted                accepted with warning
below the action limit                 accepted with warning   accepted with warning
above the action limit                 needs review            rejected
=====================================  ======================  =======================

An incomplete calibration is rejected. A person must decide without one in force, where the instrument has
drifted from its reference by more than the limit, and where the tolerance is smaller than what the
calibrations can resolve.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ..calibration import Calibration
from ..calibration.conversion import in_model_of
from ..core.errors import UsageError
from ..core.numbers import measured
from ..io import Document, Strict
from .explaining import History, RunHistory, explain_runs
from .fields import change, difference

Outcome = Literal["accepted", "accepted with warning", "rejected", "needs review"]
Level = Literal["ok", "warning", "action"]
PastRun = tuple[datetime, Calibration, bool]
"""Time of a run, its calibration, and whether it was rejected."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_RESOLVED = 2.0
"""Standard deviations of the difference that a tolerance must at least have."""
_MORE_LIKELY = 0.5
_ANNOUNCED, _RUNS = 0.5, 4
"""Part of the limit from which on, and runs after which, a trend is announced."""
_MENTIONED = 0.05
"""Probability from which on another explanation of a trend is said, as the quantiles of its date are."""


class Limits(Strict):
    """A limit for a warning and one for action.

    Examples
    --------
    >>> Limits(warning=0.1, action=0.2).level(0.15)
    'warning'
    """

    warning: float = Field(gt=0)
    action: float = Field(gt=0)

    def level(self, value: float) -> Level:
        """Return which limit the value exceeds."""
        return "action" if not value <= self.action else "warning" if value > self.warning else "ok"


class AcceptanceRules(Document):
    """Rules of acceptance, ``reseau-acceptance/1``.

    Parameters
    ----------
    version : int
        Version, increased with every change: decisions keep the rules by which they were made.
    image : Limits
        Largest difference over the image (pixels, for a camera) from the calibration in force.
    total : Limits, optional
        Largest drift since the reference calibration, in the same unit; by default as `image`.
    object : Limits, optional
        Largest difference in object space at a distance from a camera (mm).
    distance_mm : float, optional
        That distance (mm).
    significance : Limits
        Levels of the congruence test; the one for action is the smaller.
    redundancy : int
        Smallest redundancy.
    coverage : float
        Smallest share of width and of height of the image that has observations.
    refused_warnings : tuple of str
        Codes of warnings with which a calibration is incomplete.
    second_person : bool
        Reviews need another person than the one who had the calibration judged.

    Examples
    --------
    >>> rules = AcceptanceRules(version=1, image=Limits(warning=0.1, action=0.3))
    >>> AcceptanceRules.parse(rules.to_json(), where="rules.json") == rules
    True
    """

    SCHEMA: ClassVar[str] = "reseau-acceptance/1"

    version: int = Field(ge=1)
    image: Limits
    total: Limits | None = None
    object: Limits | None = None
    distance_mm: float | None = Field(default=None, gt=0)
    significance: Limits = Limits(warning=0.01, action=0.001)
    redundancy: int = Field(default=10, ge=0)
    coverage: float = Field(default=0.6, ge=0, le=1)
    refused_warnings: tuple[str, ...] = (
        "camera-moved", "camera-unstable", "inconsistent", "not-identified", "unmodelled",
        "weak-geometry",
    )  # fmt: skip
    second_person: bool = False

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.significance.action > self.significance.warning:
            raise ValueError("`significance.action` is above `significance.warning`")
        if self.significance.warning >= 1:
            raise ValueError("`significance.warning` is not below 1")
        for name, limits in (("image", self.image), ("total", self.total), ("object", self.object)):
            if limits is not None and limits.action < limits.warning:
                raise ValueError(f"`{name}.action` is below `{name}.warning`")
        if (self.object is None) != (self.distance_mm is None):
            raise ValueError("`object` and `distance_mm` must be given together")
        return self


class Finding(Strict):
    """What one rule found.

    Examples
    --------
    >>> Finding(rule="redundancy", level="ok", value=210.0, limit=10.0, text="redundancy 210").level
    'ok'
    """

    rule: str
    level: Level
    value: float
    limit: float
    text: str


class Judgement(Document):
    """How a calibration was judged, ``reseau-judgement/1``: outcome, findings, and the rules used.

    Examples
    --------
    >>> rules = AcceptanceRules(version=1, image=Limits(warning=0.1, action=0.3))
    >>> Judgement(outcome="accepted", findings=(), rules=rules.to_dict()).outcome
    'accepted'
    """

    SCHEMA: ClassVar[str] = "reseau-judgement/1"

    outcome: Outcome
    findings: tuple[Finding, ...]
    rules: dict[str, object]


def judge(
    new: Calibration,
    in_force: Calibration | None,
    rules: AcceptanceRules,
    history: Sequence[PastRun] = (),
    at: datetime | None = None,
) -> Judgement:
    """Judge a new calibration by the rules.

    Parameters
    ----------
    new : Calibration
        The new calibration.
    in_force : Calibration or None
        The one in force, if there is one.
    rules : AcceptanceRules
        The rules.
    history : sequence of (datetime, Calibration, bool)
        Runs from the reference on, in the order of their times, with the calibration in force among them;
        and whether each was rejected.
    at : datetime, optional
        Time of the new calibration, after them.

    Raises
    ------
    UsageError
        If the calibrations are of different instruments, or the rules do not apply to their kind.

    Examples
    --------
    >>> from reseau.service.covariates import example_calibration
    >>> rules = AcceptanceRules(version=1, image=Limits(warning=0.1, action=0.3), coverage=0.0)
    >>> old = example_calibration(8.0)
    >>> [judge(example_calibration(c), old, rules).outcome for c in (8.00005, 8.001, 8.1)]
    ['accepted', 'accepted with warning', 'rejected']
    >>> judge(old, None, rules).outcome
    'needs review'
    """
    if rules.object is not None and new.kind != "camera":
        raise UsageError(f"applies to cameras, not to {new.kind}", where="rule `object`")
    findings = _complete(new, in_force, rules)
    if any(each.level == "action" for each in findings):
        return _judged("rejected", findings, rules)
    if in_force is None:
        text = "no calibration is in force to compare with"
        first = Finding(rule="in force", level="warning", value=0.0, limit=1.0, text=text)
        return _judged("needs review", [*findings, first], rules)
    if new.kind == "camera" and new.model != in_force.model:
        findings.append(_of_models(new, in_force, rules))
    found = difference(new, in_force)
    runs = [*history] if history and at else [(_EPOCH, in_force, False)]
    now = at if history and at else _EPOCH + timedelta(weeks=1)
    total = rules.total or rules.image
    own = next(k for k, (_, each, _) in enumerate(runs) if each == in_force)
    known = _history(new, runs, now)
    said = explain_runs(known, total.action, own)
    sizes = [_step(said, known.outside, found.greatest, found.unit, rules.image)]
    if rules.object is not None and found.by_distance is not None:
        assert rules.distance_mm is not None
        part = min(1.0, sizes[0].value / found.greatest) if found.greatest > 0 else 0.0
        size = part * found.by_distance * rules.distance_mm
        text = f"change of {size:.3g} mm, limits {rules.object.warning:g} and {rules.object.action:g} mm"
        sizes.append(_finding("object", rules.object.level(size), size, rules.object, text))
    practical = _worst(*(each.level for each in sizes))
    findings += [*sizes, _significance(said.p, rules.significance)]
    significant = findings[-1].level != "ok"
    if len(runs) > 1:
        findings += _since_reference(said, runs[0][0], now, len(runs) + 1, found.unit, total)
    drifted = any(each.rule == "drift" and each.level == "action" for each in findings)
    unresolved = found.sigma * _RESOLVED > rules.image.action
    if unresolved:
        text = f"the tolerance of {rules.image.action:g} {found.unit} is below the resolution of the "
        text += f"comparison, σ {found.sigma:.2g} {found.unit}"
        limit = rules.image.action
        findings.append(
            Finding(rule="resolution", level="warning", value=found.sigma, limit=limit, text=text)
        )
    if practical == "action" and significant:
        outcome: Outcome = "rejected"
    elif practical == "action" or unresolved or drifted:
        outcome = "needs review"
    else:
        outcome = "accepted" if all(each.level == "ok" for each in findings) else "accepted with warning"
    return _judged(outcome, findings, rules)


def _of_models(new: Calibration, in_force: Calibration, rules: AcceptanceRules) -> Finding:
    """How well the model of the new calibration describes the camera in force."""
    names = [str(each.model.get("model")) for each in (in_force, new)]
    try:
        _, error = in_model_of(in_force, new)
    except UsageError as refused:
        text = f"{names[0]} in force, {names[1]} now: {refused}"
        return Finding(rule="model", level="warning", value=0.0, limit=rules.image.warning, text=text)
    level: Level = "ok" if error <= rules.image.warning else "warning"
    text = f"{names[0]} in force, {names[1]} now: converted with an error of at most {error:.2g} px"
    return Finding(rule="model", level=level, value=error, limit=rules.image.warning, text=text)


def _judged(outcome: Outcome, findings: list[Finding], rules: AcceptanceRules) -> Judgement:
    return Judgement(outcome=outcome, findings=tuple(findings), rules=rules.to_dict())


def _worst(*levels: Level) -> Level:
    order: tuple[Level, ...] = ("ok", "warning", "action")
    return max(levels, key=order.index)


def _history(new: Calibration, runs: Sequence[PastRun], now: datetime) -> RunHistory:
    """The runs and the new calibration, as differences from the first."""
    reference = runs[0][1]
    changes = [change(each, reference) for each in (*(each for _, each, _ in runs), new)]
    days = np.array([(time - runs[0][0]).total_seconds() / 86400 for time in (*(t for t, _, _ in runs), now)])
    # Runs of one moment follow each other.
    days = np.maximum.accumulate(days) + 1e-6 * np.arange(len(days))
    return RunHistory.of(days, np.array([each.off for each in changes]), [each.root for each in changes],
                         np.array([*(each for _, _, each in runs), False]))  # fmt: skip


def _level(said: History, limits: Limits, *, step: bool) -> Level:
    if said.held(limits.action, step=step):
        return "action"
    return "warning" if said.beyond(limits.warning, step=step) > _MORE_LIKELY else "ok"


def _step(said: History, outside: float, greatest: float, unit: str, limits: Limits) -> Finding:
    """The change since the calibration in force."""
    size, sigma = said.size(step=True)
    level = _worst(_level(said, limits, step=True), limits.level(outside))
    text = (
        f"largest difference {greatest:.3g} {unit}, a change of {measured(max(size, outside), sigma, unit)}"
    )
    text += f", limits {limits.warning:g} and {limits.action:g} {unit}"
    return _finding("image", level, max(size, outside), limits, text)


def _since_reference(
    said: History, begun: datetime, now: datetime, count: int, unit: str, limits: Limits
) -> list[Finding]:
    """The drift since the reference, and when a trend will reach the limit."""
    size, sigma = said.size()
    level = _level(said, limits, step=False)
    text = f"drift of {measured(size, sigma, unit)} since the reference of {begun:%Y-%m-%d}, "
    text += f"limits {limits.warning:g} and {limits.action:g} {unit}"
    found = [_finding("drift", level, size, limits, text)]
    days = said.reaches(limits.action, 0.05, 0.5, 0.95)
    if count > _RUNS and said.creeps(limits.action, _ANNOUNCED) and days[1] > 0:
        turn, most = said.turns()
        first, about, last, largest = ((now + timedelta(days=each)).date() for each in (*days, turn))
        texts = [
            f"creeps by {7 * said.rate_day:.2g} {unit} a week, and reaches the limit of "
            f"{limits.action:g} {unit} about {about} ({first} to {last})"
        ]
        if (share := said.seasonal / (said.creeping + said.seasonal)) > _MENTIONED:
            season = f"follows the seasons ({100 * share:.0f} %), and is largest about {largest}"
            texts.insert(int(share < _MORE_LIKELY), f"{season}, {most:.2g} {unit}")
        found.append(_finding("trend", "warning", size, limits, "; or ".join(texts)))
    return found


def _finding(rule: str, level: Level, value: float, limits: Limits, text: str) -> Finding:
    limit = limits.action if level == "action" else limits.warning
    return Finding(rule=rule, level=level, value=value, limit=limit, text=text)


def _significance(p: float, limits: Limits) -> Finding:
    level: Level = "action" if p < limits.action else "warning" if p < limits.warning else "ok"
    limit = limits.action if level == "action" else limits.warning
    return Finding(
        rule="significance", level=level, value=p, limit=limit, text=f"congruence test: p = {p:.2g}"
    )


def _complete(new: Calibration, in_force: Calibration | None, rules: AcceptanceRules) -> list[Finding]:
    """Findings of redundancy, coverage and warnings."""
    level: Level = "ok" if new.redundancy >= rules.redundancy else "action"
    findings = [
        Finding(
            rule="redundancy", level=level, value=float(new.redundancy), limit=float(rules.redundancy),
            text=f"redundancy {new.redundancy}, at least {rules.redundancy}",
        )
    ]  # fmt: skip
    share = _coverage(new)
    if share is not None or rules.coverage > 0:
        covered = 0.0 if share is None else share
        what = "unknown" if share is None else f"{100 * covered:.0f} %"
        findings.append(
            Finding(
                rule="coverage", level="ok" if covered >= rules.coverage else "action", value=covered,
                limit=rules.coverage, text=f"coverage {what}, at least {100 * rules.coverage:.0f} %",
            )
        )  # fmt: skip
    codes = list(dict.fromkeys(str(code) for code in new.validity.get("warning_codes", ())))
    refused = [code for code in codes if code in rules.refused_warnings]
    if codes:
        text = f"warnings: {', '.join(codes)}"
        # What the calibration in force has, too, is nothing new.
        known = () if in_force is None else in_force.validity.get("warning_codes", ())
        found: Level = "action" if refused else "warning" if set(codes) - set(known) else "ok"
        findings.append(
            Finding(rule="warnings", level=found, value=float(len(refused)), limit=0.0, text=text)
        )
    return findings


def _coverage(calibration: Calibration) -> float | None:
    """Share of width or of height of the image that has observations, the smaller one; None if unknown."""
    extent = calibration.validity.get("extent")
    model: dict[str, Any] = dict(calibration.model)
    size = (model["width"], model["height"]) if "width" in model else calibration.validity.get("size")
    if extent is None or size is None:
        return None
    return float(min((extent[2] - extent[0]) / (size[0] - 1), (extent[3] - extent[1]) / (size[1] - 1), 1.0))
