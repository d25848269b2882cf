"""Rules by which a new calibration is accepted, and the decision that follows from them.

Three kinds of rules. *Complete*: is the calibration determined well enough to be judged at all? *Practical*:
does it differ from the one in force by more than a tolerance, over the image and in object space?
*Statistical*: is the difference significant, with the covariances of both (congruence test)? Each has two
limits, for a warning and for action.

========================  ======================  =======================
difference                not significant         significant
========================  ======================  =======================
below the warning limit   accepted                accepted with warning
below the action limit    accepted with warning   accepted with warning
above the action limit    needs review            rejected
========================  ======================  =======================

An incomplete calibration is rejected. Without one in force, or where the tolerance is smaller than what the
calibrations can resolve, a person must decide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import numpy as np
import scipy
from pydantic import Field, model_validator

from ..calibration import Calibration, CameraMapping, calibration_difference, in_model_of
from ..core.data import Array
from ..core.errors import UsageError
from ..io import Document, Strict

__all__ = [
    "AcceptanceRules",
    "Difference",
    "Finding",
    "Judgement",
    "Limits",
    "Outcome",
    "difference",
    "judge",
]

Outcome = Literal["accepted", "accepted with warning", "rejected", "needs review"]
Level = Literal["ok", "warning", "action"]

_PLACES = 17
_RESOLVED = 2.0
"""Standard deviations of the difference that a tolerance must at least have."""
_RANK = 1e-6


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
        Increased with every change; decisions keep the rules they were made by.
    image : Limits
        Largest difference over the image, in the unit of `unit` (pixels, for a camera).
    object : Limits, optional
        Largest difference in object space at `distance_mm` from a camera, mm.
    significance : Limits
        Levels of the congruence test; the one for action is the smaller.
    redundancy : int
        Smallest redundancy.
    coverage : float
        Smallest share of width and of height of the image that has observations.
    refused_warnings : tuple of str
        Codes of warnings with which a calibration is incomplete.

    Examples
    --------
    >>> rules = AcceptanceRules(version=1, image=Limits(warning=0.1, action=0.3))
    >>> AcceptanceRules.parse(rules.to_json(), where="rules.json") == rules
    True
    """

    SCHEMA: ClassVar[str] = "reseau-acceptance/1"

    version: int = Field(ge=1)
    image: Limits
    object: Limits | None = None
    distance_mm: float | None = Field(default=None, gt=0)
    significance: Limits = Limits(warning=0.01, action=0.001)
    redundancy: int = Field(default=10, ge=0)
    coverage: float = Field(default=0.6, ge=0, le=1)
    refused_warnings: tuple[str, ...] = (
        "camera-moved", "camera-unstable", "inconsistent", "not-identified", "unmodelled",
        "weak-geometry",
    )  # fmt: skip

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.significance.action > self.significance.warning:
            raise ValueError("`significance.action` is above `significance.warning`")
        if self.significance.warning >= 1:
            raise ValueError("`significance.warning` is not below 1")
        for name, limits in (("image", self.image), ("object", self.object)):
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


@dataclass(frozen=True, eq=False)
class Difference:
    """Difference of two calibrations over image and object space.

    Parameters
    ----------
    greatest, sigma : float
        Largest difference, and the largest standard deviation of the difference.
    unit : str
        Their unit.
    by_distance : float or None
        Largest difference of directions (rad) of a camera.
    p : float
        Probability of a difference at least as large between calibrations of the same instrument.

    Examples
    --------
    >>> Difference(0.02, 0.01, "px", 1e-5, 0.4).greatest
    0.02
    """

    greatest: float
    sigma: float
    unit: str
    by_distance: float | None
    p: float


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


def difference(new: Calibration, old: Calibration) -> Difference:
    """Compare two calibrations of one instrument as fields, with the covariances of both.

    Calibrations of a camera may be of different models, and are compared after the rotation that brings their
    rays together. Of an oscilloscope or a film frame the corrected positions are compared.

    Raises
    ------
    UsageError
        If they are of different kinds, image sizes or units, or have no common field.

    Examples
    --------
    >>> from reseau.service.covariates import example_calibration
    >>> found = difference(example_calibration(8.001), example_calibration(8.0))
    >>> round(found.greatest, 3), found.unit
    (0.05, 'px')
    """
    if new.kind != old.kind:
        raise UsageError(f"is of the kind {new.kind}, {old.name} of {old.kind}", where=new.name)
    if new.kind == "camera":
        return _of_cameras(CameraMapping.from_calibration(new), CameraMapping.from_calibration(old))
    if new.kind == "sensor":
        raise UsageError("has no field of positions to compare", where=new.name)
    return _of_positions(new, old)


def _of_cameras(new: CameraMapping, old: CameraMapping) -> Difference:
    found = calibration_difference(old, new, _PLACES)
    off = found.difference.reshape(-1, 2)
    _, slope, _ = old.derivatives(found.xy.reshape(-1, 2))
    return Difference(
        greatest=float(np.nanmax(np.hypot(*off.T))),
        sigma=float(np.nanmax(found.sigma)),
        unit="px",
        by_distance=float(np.nanmax(np.linalg.norm(np.einsum("nij,nj->ni", slope, off), axis=1))),
        p=found.p,
    )


def _of_positions(new: Calibration, old: Calibration) -> Difference:
    """Differences of corrected positions over the part of the image that both cover."""
    first, second = old.mapping(), new.mapping()
    if first.unit != second.unit or first.size != second.size:
        raise UsageError(
            f"maps images of {second.size} px to {second.unit}, {old.name} {first.size} px to {first.unit}",
            where=new.name,
        )
    extents = np.array([each.validity.get("extent", [np.nan] * 4) for each in (old, new)], dtype=np.float64)
    low, high = extents[:, :2].max(axis=0), extents[:, 2:].min(axis=0)
    if not (high > low).all():
        raise UsageError(f"covers no part of the image that {old.name} covers", where=new.name)
    grid = np.meshgrid(np.linspace(low[0], high[0], _PLACES), np.linspace(low[1], high[1], _PLACES))
    xy = np.stack(grid, axis=-1).reshape(-1, 2)
    (a, _, by_a), (b, _, by_b) = first.derivatives(xy), second.derivatives(xy)
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    if not known.any():
        raise UsageError(f"maps no position that {old.name} maps", where=new.name)
    off = (b - a)[known]
    roots = [by[known] @ _root(m.parameter_covariance) for by, m in ((by_a, first), (by_b, second))]
    root = np.concatenate(roots, axis=2)
    cov = root @ np.swapaxes(root, 1, 2)
    u, s, _ = np.linalg.svd(root.reshape(2 * len(root), -1), full_matrices=False)
    keep = s > _RANK * s[0]
    statistic = float((((u.T @ off.ravel())[keep] / s[keep]) ** 2).sum())
    return Difference(
        greatest=float(np.hypot(*off.T).max()),
        sigma=float(np.sqrt(np.linalg.eigvalsh(cov)[:, -1].max())),
        unit=first.unit,
        by_distance=None,
        p=float(scipy.special.chdtrc(int(keep.sum()), statistic)),
    )


def _root(covariance: Array) -> Array:
    values, vectors = np.linalg.eigh(covariance)
    found: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    return found


def judge(new: Calibration, in_force: Calibration | None, rules: AcceptanceRules) -> Judgement:
    """Judge a new calibration by the rules.

    Parameters
    ----------
    new : Calibration
        The new calibration.
    in_force : Calibration or None
        The one in force, if there is one.
    rules : AcceptanceRules
        The rules.

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
    findings = _complete(new, rules)
    if any(each.level == "action" for each in findings):
        return _judged("rejected", findings, rules)
    if in_force is None:
        text = "no calibration is in force to compare with"
        first = Finding(rule="in force", level="warning", value=0.0, limit=1.0, text=text)
        return _judged("needs review", [*findings, first], rules)
    if new.kind == "camera" and new.model != in_force.model:
        findings.append(_of_models(new, in_force, rules))
    found = difference(new, in_force)
    sizes = [_practical("image", found.greatest, found.unit, rules.image)]
    if rules.object is not None and found.by_distance is not None:
        assert rules.distance_mm is not None
        sizes.append(_practical("object", found.by_distance * rules.distance_mm, "mm", rules.object))
    practical = _worst(*(each.level for each in sizes))
    findings += [*sizes, _significance(found.p, rules.significance)]
    significant = findings[-1].level != "ok"
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
    elif practical == "action" or unresolved:
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


def _practical(rule: str, value: float, unit: str, limits: Limits) -> Finding:
    level = limits.level(value)
    limit = limits.warning if level == "ok" else limits.action if level == "action" else limits.warning
    text = f"largest difference {value:.3g} {unit}, limits {limits.warning:g} and {limits.action:g} {unit}"
    return Finding(rule=rule, level=level, value=value, limit=limit, text=text)


def _significance(p: float, limits: Limits) -> Finding:
    level: Level = "action" if p < limits.action else "warning" if p < limits.warning else "ok"
    limit = limits.action if level == "action" else limits.warning
    return Finding(
        rule="significance", level=level, value=p, limit=limit, text=f"congruence test: p = {p:.2g}"
    )


def _complete(new: Calibration, rules: AcceptanceRules) -> list[Finding]:
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
        found: Level = "action" if refused else "warning"
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
