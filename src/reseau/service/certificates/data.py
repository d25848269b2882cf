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

    Parameters
    ----------
    name : str
        Name.
    city : str
        City.
    country : str
        Code of its country, such as DE.
    street : str, optional
        Street.
    post_code : str, optional
        Post code.
    email : str, optional
        Address for mail.
    code : str, optional
        Number of its accreditation, or of the customer.

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

    Parameters
    ----------
    name : str
        What it is, such as camera.
    serial : str
        Serial number.
    manufacturer : str, optional
        Manufacturer.
    model : str, optional
        Model.

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

    Parameters
    ----------
    issuer : str
        Who issued it.
    id : str
        Its number.
    sha256 : str, optional
        SHA-256 of its file.

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

    Parameters
    ----------
    name : str
        Name.
    kind : str
        What it is.
    identification : str
        Its inventory number.
    certificate : Reference, optional
        Its certificate.

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

    Parameters
    ----------
    celsius : float
        Temperature (°C).
    sigma : float
        Its standard uncertainty (K).
    coefficients : dict
        Changes of parameters per kelvin, in their units.
    degrees : float, optional
        Degrees of freedom of the uncertainty.
    distribution : str
        Its distribution.

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

    Parameters
    ----------
    name : str
        Name.
    kind : str
        What it is about.
    sigma : float
        Its standard uncertainty.
    sensitivities : dict
        Changes of parameters by a unit of it.
    degrees : float, optional
        Degrees of freedom of the uncertainty.
    distribution : str
        Its distribution.

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

    Parameters
    ----------
    laboratory : Contact
        Laboratory.
    customer : Contact
        Customer.
    responsible : tuple of str
        Persons who are responsible for it.
    item : Item
        What was calibrated.
    location : str
        Where it was calibrated.
    standards : tuple of Standard
        What the scale rests on.
    temperature : Temperature, optional
        Temperature during the calibration.
    contributions : tuple of Stated
        Further contributions to the uncertainty.
    remarks : tuple of str
        Remarks.
    identifier : str, optional
        Number of the certificate; by default made of the calibration and the date.
    begin : date, optional
        First day of the calibration; by default that of its session.
    end : date, optional
        Last day of the calibration; by default that of its session.

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
