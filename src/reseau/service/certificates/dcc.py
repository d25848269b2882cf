"""A certificate as digital calibration certificate: DCC 3.3.0 with D-SI 2.2.1, both of PTB.

Deprecated elements of D-SI (``expandedUnc…``, ``coverageInterval…``) are not used. Each vector of results has
its whole covariance matrix in ``measurementUncertaintyMultivariateXMLList``; its coverage factor is that of
the ellipsoid.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from ...adjust.uncertainty import UncertaintyBudget
from ...core.errors import UsageError
from ...core.version import __version__
from .certificate import Certificate
from .data import Contact
from .vocabulary import NAMESPACE, vocabulary, vocabulary_text

DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
_XSI = "http://www.w3.org/2001/XMLSchema-instance"
_SOURCE = {
    "grey values": "reseau_greyValues",
    "target coordinates": "reseau_targetCoordinates",
    "temperature": "reseau_temperature",
    "model": "reseau_model",
    "reproducibility": "reseau_reproducibility",
    "other": "reseau_other",
}
_STANDARD = {
    "bar": "reseau_scaleBar",
    "ruler": "reseau_ruler",
    "control points": "reseau_controlPoints",
    "target": "reseau_target",
    "other": "reseau_other",
}
_CONFORMITY = {"accepted": "pass", "accepted with warning": "conditionalPass"}


def dcc_of(certificate: Certificate, pages: str = "") -> bytes:
    """Return the certificate as XML.

    Parameters
    ----------
    certificate : Certificate
        The certificate.
    pages : str
        Digest of the pages of its PDF; see :func:`~reseau.service.certificates.page.pdf_of`.

    Raises
    ------
    UsageError
        If lxml is missing, or a unit has no form in D-SI.

    Examples
    --------
    >>> from reseau.service.certificates.certificate import example_certificate
    >>> dcc_of(example_certificate())[:38]  # doctest: +SKIP
    b"<?xml version='1.0' encoding='UTF-8'?>"
    """
    from ...core.optional import optional

    with optional():
        from lxml import etree

    root = etree.Element(_d("digitalCalibrationCertificate"), nsmap={"dcc": DCC, "si": SI, "xsi": _XSI})
    root.set("schemaVersion", "3.3.0")
    root.set(f"{{{_XSI}}}schemaLocation", f"{DCC} {DCC}/v3.3.0/dcc.xsd")
    _administrative(_sub(root, "administrativeData"), certificate, pages)
    _results(_sub(_sub(root, "measurementResults"), "measurementResult"), certificate)
    etree.indent(root, "  ")
    found: bytes = etree.tostring(root, xml_declaration=True, encoding="UTF-8")
    return found + b"\n"


def _d(name: str) -> str:
    return f"{{{DCC}}}{name}"


def _sub(parent: Any, name: str, text: str | None = None, **attributes: str) -> Any:
    """A child in the namespace of the parent's prefix ``dcc`` or, with ``si:``, of D-SI."""
    from lxml import etree

    space, _, local = name.rpartition(":")
    child = etree.SubElement(parent, f"{{{SI if space == 'si' else DCC}}}{local}", **attributes)
    if text is not None:
        child.text = text
    return child


def _text(parent: Any, name: str, text: str, **attributes: str) -> Any:
    """A child with one text in English."""
    child = _sub(parent, name, **attributes)
    _sub(child, "content", text, lang="en")
    return child


def _software(parent: Any, name: str) -> None:
    software = _sub(_sub(parent, name), "software")
    _text(software, "name", "reseau")
    # The rules take a letter and at most four numbers.
    _sub(software, "release", "v" + ".".join(re.findall(r"\d+", __version__)[:3]))
    _sub(software, "type", "application")


def _administrative(parent: Any, made: Certificate, pages: str) -> None:
    data = made.data
    _software(parent, "dccSoftware")
    definition = _sub(_sub(parent, "refTypeDefinitions"), "refTypeDefinition")
    words = vocabulary()
    _text(definition, "name", "vocabulary of reseau")
    _text(
        definition, "description", "Types of photogrammetric results; the document is part of the software."
    )
    _sub(definition, "namespace", NAMESPACE)
    _sub(definition, "link", f"urn:reseau:reftypes:{words['release']}")
    _sub(definition, "release", words["release"])
    _sub(definition, "value", hashlib.sha256(vocabulary_text().encode("utf-8")).hexdigest())
    _sub(definition, "procedure", "SHA-256")
    core = _sub(parent, "coreData")
    _sub(core, "countryCodeISO3166_1", data.laboratory.country)
    _sub(core, "usedLangCodeISO639_1", "en")
    _sub(core, "mandatoryLangCodeISO639_1", "en")
    _sub(core, "uniqueIdentifier", made.identifier)
    _identification(core, "calibrationLaboratory", made.key, "calibration", refType="reseau_calibration")
    _sub(core, "beginPerformanceDate", made.begin.isoformat())
    _sub(core, "endPerformanceDate", made.end.isoformat())
    _sub(core, "performanceLocation", data.location)
    _sub(core, "issueDate", made.issued.isoformat())
    item = _sub(_sub(parent, "items"), "item")
    _text(item, "name", data.item.name)
    if data.item.manufacturer is not None:
        _text(_sub(item, "manufacturer"), "name", data.item.manufacturer)
    if data.item.model is not None:
        _sub(item, "model", data.item.model)
    _identification(item, "manufacturer", data.item.serial, "serial number")
    laboratory = _sub(parent, "calibrationLaboratory")
    if data.laboratory.code is not None:
        _sub(laboratory, "calibrationLaboratoryCode", data.laboratory.code)
    _contact(laboratory, "contact", data.laboratory)
    persons = _sub(parent, "respPersons")
    for k, name in enumerate(data.responsible):
        person = _sub(persons, "respPerson")
        _text(_sub(person, "person"), "name", name)
        if k == 0:
            _sub(person, "mainSigner", "true")
    _contact(parent, "customer", data.customer)
    _statements(_sub(parent, "statements"), made, pages)


def _identification(parent: Any, issuer: str, value: str, name: str, **attributes: str) -> None:
    one = _sub(_sub(parent, "identifications"), "identification", **attributes)
    _sub(one, "issuer", issuer)
    _sub(one, "value", value)
    _text(one, "name", name)


def _contact(parent: Any, name: str, contact: Contact) -> None:
    made = _sub(parent, name)
    _text(made, "name", contact.name)
    if contact.email is not None:
        _sub(made, "eMail", contact.email)
    place = _sub(made, "location")
    _sub(place, "city", contact.city)
    _sub(place, "countryCode", contact.country)
    for tag, value in (("postCode", contact.post_code), ("street", contact.street)):
        if value is not None:
            _sub(place, tag, value)


def _statements(parent: Any, made: Certificate, pages: str) -> None:
    """Traceability comes first: who reads a certificate must not miss it."""
    first = _sub(parent, "statement", refType="reseau_traceability")
    _sub(first, "traceable", "true" if made.data.traceable else "false")
    _text(first, "declaration", " ".join(made.traceability))
    decision = _sub(parent, "statement", refType="reseau_decision")
    _text(decision, "declaration", made.conformity)
    if made.decision is not None:
        _sub(decision, "conformity", _CONFORMITY[made.decision.outcome])
    for source, why in made.uncertainty.missing.items():
        one = _sub(parent, "statement", refType=f"reseau_notIncluded {_SOURCE[source]}")
        _text(one, "declaration", f"Not included in the uncertainty: {source}; {why}.")
    if pages:
        one = _sub(parent, "statement", refType="reseau_pages")
        _sub(one, "reference", pages)
        _text(one, "declaration", "SHA-256 of the pages of this certificate as PDF.")
    for remark in (*made.verdict, *made.data.remarks):
        _text(_sub(parent, "statement", refType="reseau_remark"), "declaration", remark)


def _results(parent: Any, made: Certificate) -> None:
    _text(parent, "name", f"Calibration {made.calibration.name}")
    methods = _sub(parent, "usedMethods")
    method = _sub(methods, "usedMethod", refType="reseau_expandedUncertainty")
    _text(method, "name", "Expanded uncertainty")
    _text(
        method, "description",
        "The expanded uncertainty is the standard uncertainty times the coverage factor of the t "
        "distribution with the effective degrees of freedom (Welch-Satterthwaite), for a coverage "
        f"probability of {made.probability:g}.",
    )  # fmt: skip
    _sub(method, "norm", "JCGM 100:2008")
    _sub(method, "norm", "JCGM 102:2011")
    method = _sub(methods, "usedMethod", refType="reseau_bundleAdjustment")
    _text(method, "name", f"Least-squares adjustment, calibration of the kind {made.calibration.kind}")
    _software(parent, "usedSoftware")
    if made.data.standards:
        _equipment(_sub(parent, "measuringEquipments"), made)
    _conditions(_sub(parent, "influenceConditions"), made)
    results = _sub(parent, "results")
    _parameters(_sub(results, "result", refType="reseau_parameters"), made)
    _budget(_sub(results, "result", refType="reseau_uncertaintyBudget"), made)
    if made.directions is not None:
        result = _sub(results, "result", refType="reseau_directions")
        _text(result, "name", "Directions of pixels")
        assert made.places is not None
        at = ", ".join(
            f"{name} ({x:.6g}, {y:.6g})"
            for name, (x, y) in zip(made.places.names, made.places.xy.tolist(), strict=True)
        )
        _text(result, "description", f"Directions x/z and y/z, free of distortion, of the pixels {at}.")
        quantity = _sub(_sub(result, "data"), "quantity")
        _vector(quantity, made.directions, made.probability)


def _equipment(parent: Any, made: Certificate) -> None:
    for each in made.data.standards:
        one = _sub(parent, "measuringEquipment", refType=_STANDARD[each.kind])
        _text(one, "name", each.name)
        reference = each.certificate
        if reference is None:
            _text(one, "description", "No certificate.")
        elif reference.sha256 is None:
            _text(one, "description", f"Certificate {reference.id} of {reference.issuer}.")
        else:
            certificate = _sub(one, "certificate")
            _text(certificate, "referral", f"Certificate of {reference.issuer}")
            _sub(certificate, "referralID", reference.id)
            _sub(certificate, "procedure", "SHA-256")
            _sub(certificate, "value", reference.sha256)
            _sub(certificate, "traceable", "true")
        _identification(one, "calibrationLaboratory", each.identification, "identification")


def _conditions(parent: Any, made: Certificate) -> None:
    given = made.data.temperature
    if given is None:
        one = _sub(parent, "influenceCondition", refType="reseau_conditions")
        _text(one, "name", "Ambient conditions")
        _text(_sub(one, "data"), "text", "Temperature was not recorded.")
        return
    one = _sub(parent, "influenceCondition", refType="reseau_temperature")
    _text(one, "name", "Temperature")
    quantity = _sub(_sub(one, "data"), "quantity")
    real = _sub(quantity, "si:real")
    _sub(real, "si:value", _number(round(given.celsius + 273.15, 9)))
    _sub(real, "si:unit", "\\kelvin")
    uncertainty = _sub(_sub(real, "si:measurementUncertaintyUnivariate"), "si:standardMU")
    _sub(uncertainty, "si:valueStandardMU", _number(given.sigma))


def _parameters(parent: Any, made: Certificate) -> None:
    _text(parent, "name", "Estimated parameters")
    data = _sub(parent, "data")
    _vector(_sub(data, "quantity"), made.parameters, made.probability)
    held = {name: q for name, q in made.calibration.parameters.items() if name not in made.parameters.names}
    if held:
        quantity = _sub(data, "quantity", refType="reseau_heldParameters")
        _text(quantity, "name", "Parameters that were held")
        _list(quantity, held, [q.value for q in held.values()], [q.unit for q in held.values()])


def _budget(parent: Any, made: Certificate) -> None:
    _text(parent, "name", "Uncertainty budget of the parameters")
    rows = _sub(_sub(parent, "data"), "list")
    found = made.parameters
    for each, source, u in zip(
        found.contributions, made.uncertainty.sources, found.by_contribution, strict=True
    ):
        quantity = _sub(rows, "quantity", refType=f"reseau_contribution {_SOURCE[source]}")
        _text(quantity, "name", f"Standard uncertainties by {each.name}")
        if math.isfinite(each.degrees):
            _text(quantity, "description", f"{each.degrees:g} degrees of freedom, {each.distribution}.")
        _list(quantity, found.names, u, found.units)
    quantity = _sub(rows, "quantity", refType="reseau_degreesOfFreedom")
    _text(quantity, "name", "Effective degrees of freedom")
    _list(quantity, found.names, found.degrees, ["1"] * len(found.names))


def _list(parent: Any, names: Any, values: Any, units: Sequence[str]) -> Any:
    """Values with labels and units."""
    found = _sub(parent, "si:realListXMLList")
    _sub(found, "si:labelXMLList", " ".join(str(name).replace(" ", "_") for name in names))
    digital = [digital_unit(unit) for unit in units]
    _sub(found, "si:valueXMLList", _numbers(values, units))
    texts = [unit.text for unit in digital]
    _sub(found, "si:unitXMLList", texts[0] if len(set(texts)) == 1 else " ".join(texts))
    return found


def _vector(parent: Any, budget: UncertaintyBudget, probability: float) -> None:
    """Values with expanded uncertainties, and their covariance matrix with the factor of the ellipsoid."""
    found = _list(parent, budget.names, budget.values, budget.units)
    expanded = _sub(_sub(found, "si:measurementUncertaintyUnivariateXMLList"), "si:expandedMUXMLList")
    _sub(expanded, "si:valueExpandedMUXMLList", _numbers(budget.expanded(probability), budget.units))
    factors = budget.factor(probability)
    _sub(expanded, "si:coverageFactorXMLList", " ".join(_factor(k) for k in factors))
    _sub(expanded, "si:coverageProbabilityXMLList", f"{probability:.6g}")
    region = _sub(
        _sub(found, "si:measurementUncertaintyMultivariateXMLList"), "si:ellipsoidalRegionMUXMLList"
    )
    matrix = _sub(region, "si:covarianceMatrixXMLList")
    units, covariance = [digital_unit(unit) for unit in budget.units], budget.covariance
    for j, of_column in enumerate(units):
        column = _sub(matrix, "si:columnXMLList")
        for i, of_row in enumerate(units):
            unit, entry = of_row.times(of_column), _sub(column, "si:covarianceXMLList")
            _sub(entry, "si:valueXMLList", unit.number(float(covariance[i, j])))
            _sub(entry, "si:unitXMLList", unit.text)
    _sub(region, "si:coverageFactorXMLList", _factor(budget.joint_factor(probability)))
    _sub(region, "si:coverageProbabilityXMLList", f"{probability:.6g}")


def _numbers(values: Any, units: Sequence[str]) -> str:
    return " ".join(
        digital_unit(unit).number(float(value)) if math.isfinite(value) else "NaN"
        for value, unit in zip(values, units, strict=True)
    )


def _number(value: float) -> str:
    return digital_unit("1").number(value)


def _factor(value: float) -> str:
    """A coverage factor, which D-SI takes without an exponent."""
    return f"{value:.6f}" if math.isfinite(value) else "NaN"


# Name in D-SI and power of ten of the units that calibrations have. Pixels and grey values are counts.
_KNOWN = {
    "1": ("", 0), "": ("", 0), "px": ("", 0), "DN": ("", 0), "e": ("", 0), "e-": ("", 0), "%": ("", -2),
    "mm": ("metre", -3), "µm": ("metre", -6), "um": ("metre", -6), "nm": ("metre", -9), "m": ("metre", 0),
    "rad": ("radian", 0), "mrad": ("radian", -3), "deg": ("degree", 0), "°": ("degree", 0),
    "s": ("second", 0), "ms": ("second", -3), "K": ("kelvin", 0), "°C": ("degreecelsius", 0),
}  # fmt: skip
_PART = re.compile(r"(?P<name>[^\s^*·/]+)(\^(?P<power>-?\d+))?")


@dataclass(frozen=True)
class DigitalUnit:
    """A product of powers of SI units without prefixes, and the power of ten that leads to it.

    Examples
    --------
    >>> unit = digital_unit("mm^-2")
    >>> unit.text, unit.number(-4.5e-5)
    ('\\\\metre\\\\tothe{-2}', '-45')
    >>> digital_unit("px").text, digital_unit("mm").times(digital_unit("rad")).text
    ('\\\\one', '\\\\metre\\\\radian')
    """

    powers: tuple[tuple[str, int], ...]
    shift: int

    @property
    def text(self) -> str:
        """The unit as D-SI writes it."""
        parts = [f"\\{name}" + ("" if k == 1 else f"\\tothe{{{k}}}") for name, k in self.powers if k]
        return "".join(parts) or "\\one"

    def number(self, value: float) -> str:
        """A value in this unit, exactly as in the original one."""
        scaled = Decimal(repr(float(value))).scaleb(self.shift)
        return f"{scaled.normalize():.17G}".replace("E+0", "E+").replace("E-0", "E-")

    def times(self, other: DigitalUnit) -> DigitalUnit:
        """The product of both."""
        return _product([*self.powers, *other.powers], self.shift + other.shift)


def digital_unit(unit: str) -> DigitalUnit:
    """Return a unit in D-SI.

    Raises
    ------
    UsageError
        If it is not known.
    """
    powers, shift, sign, at = [], 0, 1, 0
    for found in _PART.finditer(unit):
        if "/" in unit[at : found.start()]:
            sign = -1
        at = found.end()
        if found["name"] not in _KNOWN:
            raise UsageError(f"{unit!r} has no form in D-SI", where="unit")
        name, ten = _KNOWN[found["name"]]
        power = sign * int(found["power"] or 1)
        powers.append((name, power))
        shift += ten * power
    return _product(powers, shift)


def _product(powers: Sequence[tuple[str, int]], shift: int) -> DigitalUnit:
    total: dict[str, int] = {}
    for name, power in powers:
        if name:
            total[name] = total.get(name, 0) + power
    return DigitalUnit(tuple((name, k) for name, k in total.items() if k), shift)
