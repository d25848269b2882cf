"""The certificate of a calibration: what it states, and which calibrations have none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, datetime

import numpy as np

from ...adjust.uncertainty import UncertaintyBudget
from ...calibration import Calibration, CameraMapping
from ...calibration.assessment import Use
from ...core.data import ImagePoints
from ...core.errors import UsageError
from ..decisions import Decision
from .budget import CalibrationUncertainty, measurement_budget, uncertainty_of
from .data import CertificateData, Contact, Item

_PLACES = ("centre", "upper_left", "upper_right", "lower_right", "lower_left")


@dataclass(frozen=True, eq=False)
class Certificate:
    """A certificate; made by :func:`certify`.

    Parameters
    ----------
    uncertainty : CalibrationUncertainty
        The calibration and the contributions to its uncertainty.
    data : CertificateData
        Laboratory, customer, item, standards.
    decision : Decision or None
        The decision by which it was accepted; None if nobody decided on it.
    configuration : str
        Configuration that it was decided for; empty without a decision.
    issued, begin, end : date
        When the certificate was issued, and when the calibration was performed.
    probability : float
        Coverage probability of expanded uncertainties.
    parameters : UncertaintyBudget
        Budget of the parameters.
    directions : UncertaintyBudget or None
        Of a camera: budget of the directions of pixels at the centre and the corners of the observations.
    places : ndarray (5, 2)
        These pixels.

    Examples
    --------
    >>> made = example_certificate()
    >>> made.issued.isoformat(), made.parameters.names[0]
    ('2026-03-03', 'c')
    """

    uncertainty: CalibrationUncertainty
    data: CertificateData
    decision: Decision | None
    configuration: str
    issued: date
    begin: date
    end: date
    probability: float
    parameters: UncertaintyBudget
    directions: UncertaintyBudget | None
    places: ImagePoints | None

    @property
    def calibration(self) -> Calibration:
        """The calibration."""
        return self.uncertainty.calibration

    @property
    def key(self) -> str:
        """Name of the calibration: start of its SHA-256 without clock times."""
        return self.calibration.key

    @property
    def identifier(self) -> str:
        """Unique identifier of the certificate."""
        return self.data.identifier or f"reseau-{self.key}-{self.issued:%Y%m%d}"

    @property
    def traceability(self) -> tuple[str, ...]:
        """What the scale rests on, in the first lines of the certificate."""
        if not self.data.standards:
            return (
                "The scale of this calibration is not traceable: no standard is named that it rests on "
                "(bar, ruler, or control points).",
            )
        lines = []
        for each in self.data.standards:
            named = f"{each.name} ({each.kind} {each.identification})"
            if each.certificate is None:
                lines.append(
                    f"The scale rests on {named}, which has no certificate: it is not traceable to the SI."
                )
            else:
                lines.append(
                    f"The scale rests on {named}, certificate {each.certificate.id} of "
                    f"{each.certificate.issuer}."
                )
        return tuple(lines)

    @property
    def verdict(self) -> tuple[str, ...]:
        """What the calibration is good for, by its own assessment; empty without one."""
        found = self.calibration.assessment
        return () if found is None else (f"By its own assessment the calibration is {found.short}.",)

    @property
    def conformity(self) -> str:
        """The decision in one line."""
        made = self.decision
        if made is None:
            return "No rules of acceptance were applied to this calibration."
        reviewed = f", reviewed by {made.reviewed_by}: {made.review}" if made.reviewed_by else ""
        rules = made.judgement.rules["version"]
        return f"Decision {made.key} for {self.configuration}: {made.outcome} by rules {rules}{reviewed}."


def certify(
    calibration: Calibration,
    data: CertificateData,
    *,
    issued: date,
    decision: Decision | None = None,
    configuration: str = "",
    earlier: Sequence[Calibration] = (),
    probability: float = 0.95,
) -> Certificate:
    """Create the certificate of a calibration.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    data : CertificateData
        Laboratory, customer, item, standards, conditions.
    issued : date
        Date of issue.
    decision : Decision, optional
        The decision on the calibration.
    configuration : str
        The configuration that it was decided for.
    earlier : sequence of Calibration
        Calibrations in other sessions, for the reproducibility.
    probability : float
        Coverage probability.

    Raises
    ------
    UsageError
        If the calibration was rejected or still needs a review, is usable for nothing, or dates contradict
        each other.

    Examples
    --------
    >>> from reseau.service.certificates.data import Contact, Item
    >>> from reseau.service.covariates import example_calibration
    >>> lab = Contact(name="Institute of Photogrammetry", city="Bonn", country="DE")
    >>> data = CertificateData(laboratory=lab, customer=lab, responsible=("Ada Byron",),
    ...                        item=Item(name="camera", serial="4711"), begin=date(2026, 3, 2))
    >>> certify(example_calibration(), data, issued=date(2026, 3, 3)).traceability[0]
    'The scale of this calibration is not traceable: no standard is named that it rests on (bar, ruler, ...
    """
    where = f"calibration {calibration.name}"
    if decision is not None and not decision.outcome.startswith("accepted"):
        why = [each.text for each in decision.judgement.findings if each.level != "ok"]
        raise UsageError(
            f"is {decision.outcome} ({decision.review or '; '.join(why)}) and gets no certificate",
            where=f"{configuration} {decision.key}",
            do="review it first" if decision.outcome == "needs review" else None,
        )
    if calibration.assessment is not None and calibration.assessment.use is Use.NOTHING:
        raise UsageError("is usable for nothing by its own assessment, and gets no certificate", where=where)
    if not 0.683 <= probability < 1.0:
        raise UsageError(f"{probability:g} is not from 0.683 to below 1", where="coverage probability")
    begun = calibration.times.get("begun")
    begin = data.begin or (datetime.fromisoformat(begun).date() if begun else None)
    if begin is None:
        raise UsageError("does not say when it was made", where=where, do="give `begin` in the data")
    end = data.end or begin
    if not begin <= end <= issued:
        raise UsageError(f"begin {begin}, end {end} and issue {issued} are not in this order", where="dates")
    uncertainty = uncertainty_of(calibration, earlier, data)
    places = _places(calibration)
    directions = None if places is None else measurement_budget(uncertainty, places)
    return Certificate(
        uncertainty, data, decision, configuration, issued, begin, end, probability, uncertainty.budget(),
        directions, places,
    )  # fmt: skip


def _places(calibration: Calibration) -> ImagePoints | None:
    """Centre and corners of the observations of a camera; None for other calibrations."""
    extent = calibration.validity.get("extent")
    if calibration.kind != "camera" or extent is None:
        return None
    if (dict(calibration.model).get("shutter") or {}).get("mode") == "line":  # type: ignore[attr-defined]
        return None
    left, top, right, bottom = map(float, extent)
    xy = [
        [(left + right) / 2, (top + bottom) / 2], [left, top], [right, top], [right, bottom], [left, bottom]
    ]  # fmt: skip
    known = np.isfinite(CameraMapping.from_calibration(calibration).derivatives(np.array(xy))[0]).all(axis=1)
    kept = np.flatnonzero(known)
    return ImagePoints.with_sigma([_PLACES[k] for k in kept], np.array(xy)[kept], 0.0) if len(kept) else None


def example_certificate() -> Certificate:
    """A certificate as examples use it."""
    from ..covariates import example_calibration

    lab = Contact(name="Institute of Photogrammetry", city="Bonn", country="DE")
    data = CertificateData(
        laboratory=lab, customer=lab, responsible=("Ada Byron",), item=Item(name="camera", serial="4711"),
        begin=date(2026, 3, 2),
    )  # fmt: skip
    return certify(example_calibration(), data, issued=date(2026, 3, 3))
