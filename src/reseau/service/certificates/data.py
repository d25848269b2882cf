"""What a certificate says beyond the calibration: laboratory, customer, item, standards, conditions."""

from __future__ import annotations

from datetime import date
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from ...io import Document, Strict

Text = Annotated[str, Field(pattern=r"^\S(.*\S)?$")]
Country = Annotated[str, Field(pattern=r"^[A-Z]{2}$")]
Kind = Literal["grey values", "target coordinates", "temperature", "model", "reproducibility", "other"]


class Contact(Strict):
    """A laboratory or a customer.

    Examples
    --------
    >>> Contact(name="Institute of Photogrammetry", city="Bonn", country="DE").city
    'Bonn'
    """

    name: Text
    city: Text
    country: Country
    street: Text | None = None
    post_code: Text | None = None
    email: Text | None = None
    code: Text | None = None


class Item(Strict):
    """What was calibrated.

    Examples
    --------
    >>> Item(name="camera", serial="4711").serial
    '4711'
    """

    name: Text
    serial: Text
    manufacturer: Text | None = None
    model: Text | None = None


class Reference(Strict):
    """The certificate of a standard.

    Examples
    --------
    >>> Reference(issuer="PTB", id="5.4-1234").issuer
    'PTB'
    """

    issuer: Text
    id: Text
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = None


class Standard(Strict):
    """What the scale rests on: a bar, a ruler, control points.

    Examples
    --------
    >>> Standard(name="bar 1", kind="bar", identification="SB-1").certificate is None
    True
    """

    name: Text
    kind: Literal["bar", "ruler", "control points", "target", "other"]
    identification: Text
    certificate: Reference | None = None


class Temperature(Strict):
    """Temperature during the calibration, its standard uncertainty, and what it does to the parameters.

    `coefficients` are changes of parameters per kelvin, in their units.

    Examples
    --------
    >>> Temperature(celsius=20.4, sigma=0.3, coefficients={"c": 1e-4}).sigma
    0.3
    """

    celsius: float = Field(gt=-273.15)
    sigma: float = Field(ge=0)
    coefficients: dict[str, float] = Field(default_factory=dict)
    degrees: float | None = Field(default=None, gt=0)
    distribution: Literal["normal", "rectangular", "triangular", "arcsine"] = "normal"


class Stated(Strict):
    """A further contribution: standard uncertainty of an input, and changes of parameters by it.

    Examples
    --------
    >>> Stated(name="scale", kind="target coordinates", sigma=1e-5, sensitivities={"c": 8.0}).kind
    'target coordinates'
    """

    name: Text
    kind: Kind
    sigma: float = Field(ge=0)
    sensitivities: dict[str, float] = Field(min_length=1)
    degrees: float | None = Field(default=None, gt=0)
    distribution: Literal["normal", "rectangular", "triangular", "arcsine"] = "normal"


class CertificateData(Document):
    """What a certificate says beyond the calibration, ``reseau-certificate-data/1``.

    `identifier` is by default made of the calibration and the date; `begin` and `end` of the calibration are
    by default those of its session.

    Examples
    --------
    >>> lab = Contact(name="Institute of Photogrammetry", city="Bonn", country="DE")
    >>> CertificateData(laboratory=lab, customer=lab, responsible=("Ada Byron",),
    ...                 item=Item(name="camera", serial="4711")).standards
    ()
    """

    SCHEMA: ClassVar[str] = "reseau-certificate-data/1"

    laboratory: Contact
    customer: Contact
    responsible: tuple[Text, ...] = Field(min_length=1)
    item: Item
    location: Literal["laboratory", "customer", "laboratoryBranch", "customerBranch", "other"] = "laboratory"
    standards: tuple[Standard, ...] = ()
    temperature: Temperature | None = None
    contributions: tuple[Stated, ...] = ()
    remarks: tuple[Text, ...] = ()
    identifier: Text | None = None
    begin: Annotated[date, Field(strict=False)] | None = None
    end: Annotated[date, Field(strict=False)] | None = None

    @property
    def traceable(self) -> bool:
        """Whether every standard has a certificate, and there is one."""
        return bool(self.standards) and all(each.certificate is not None for each in self.standards)
