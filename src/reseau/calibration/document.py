"""The calibration file ``reseau-calibration/1``: the result of every procedure."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NotRequired, Self

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Discriminator, Field, Tag, model_validator, with_config
from typing_extensions import TypedDict  # pydantic needs this one before Python 3.12

from ..core.data import Array
from ..core.display import data_frame
from ..core.errors import FormatError
from ..core.numbers import measured
from ..io import Document, Strict
from .mapping import CalibratedMapping

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "Calibration",
    "CameraModel",
    "Covariance",
    "FiducialModel",
    "FilmFrameModel",
    "Kind",
    "OscilloscopeModel",
    "Place",
    "Quantity",
    "SensorModel",
    "readable_as",
]

Kind = Literal["oscilloscope", "camera", "film_frame", "fiducials", "sensor"]
_IN_WORDS: dict[Kind, str] = {
    "oscilloscope": "an oscilloscope",
    "camera": "a camera",
    "film_frame": "a film frame",
    "fiducials": "fiducial marks",
    "sensor": "a sensor",
}
_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class Quantity(Strict):
    """A value with its standard deviation and unit; a sigma of 0 means that the value was held fixed.

    Examples
    --------
    >>> Quantity(value=8.0021, sigma=0.0004, unit="mm").value
    8.0021
    """

    value: float
    sigma: float = Field(ge=0)
    unit: str


class Covariance(Strict):
    """Covariance matrix of the named parameters, in the products of their units.

    Examples
    --------
    >>> Covariance(names=("c",), matrix=((1.6e-7,),)).names
    ('c',)
    """

    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]


class Place(Strict):
    """Place of a camera on a rig, in the axes of the `reference` camera.

    `rotation` is the vector of the rotation from these axes to those of the camera, rad; `base` its
    projection centre in them, in `unit`. `covariance` (6, 6) is that of a small rotation about the axes of
    the camera and of the base.

    Examples
    --------
    >>> Place(reference="left", rotation=(0.0, 0.1, 0.0), base=(120.0, 0.0, 0.0), unit="mm",
    ...       covariance=((1e-8,) * 6,) * 6).reference
    'left'
    """

    reference: str
    rotation: tuple[float, float, float]
    base: tuple[float, float, float]
    unit: str
    covariance: tuple[tuple[float, ...], ...]


@with_config(_STRICT)
class OscilloscopeModel(TypedDict):
    """Groups A and B of an oscilloscope's photographs; `reseau` and `instrument` belong to group B.

    `datum` holds the errors of the marks O and S, and the covariance of the coefficients without them.
    """

    name: Literal["oscilloscope group A", "oscilloscope group A and group B"]
    unit: str
    mapping: dict[str, Any]
    photo_system: dict[str, Any]
    object_system: dict[str, Any]
    datum: NotRequired[dict[str, Any]]
    reseau: NotRequired[dict[str, Any]]
    instrument: NotRequired[dict[str, Any]]


@with_config(ConfigDict(extra="allow", strict=True, allow_inf_nan=False))
class CameraModel(TypedDict):
    """A camera: the name of its model in the registry, its image, and the options of the model."""

    model: str
    width: int
    height: int
    pitch_mm: list[float]
    additional: NotRequired[dict[str, Any]]
    shutter: NotRequired[dict[str, Any]]


@with_config(_STRICT)
class FilmFrameModel(TypedDict):
    """A scanned film frame; its parameters are the pixel coordinates of its corners."""

    type: Literal["film_frame"]
    image: str
    format_mm: list[float]
    transform: dict[str, Any] | None


@with_config(_STRICT)
class FiducialModel(TypedDict):
    """A photograph oriented by fiducial marks; its parameters are those of the transformation."""

    type: Literal["fiducials"]
    image: str
    camera: str
    transform: str
    px_per_mm: float
    rotation_deg: int
    mirrored: bool


@with_config(_STRICT)
class SensorModel(TypedDict):
    """Fields and linearity of a sensor."""

    type: Literal["sensor"]
    b2: float
    b3: float
    full_scale: float
    exposure_us: float
    fields: dict[str, Any]
    mtf: NotRequired[dict[str, list[float]]]


def _tag(model: Any) -> str | None:
    """Which model this is, by the key that each has for it."""
    if not isinstance(model, dict):
        return None
    if "type" in model:
        return str(model["type"])
    return "camera" if "model" in model else "oscilloscope"


def _present(kind: Any) -> Any:
    """The kind under the name that it has now."""
    return "film_frame" if kind == "frame" else kind


Model = Annotated[
    Annotated[OscilloscopeModel, Tag("oscilloscope")]
    | Annotated[CameraModel, Tag("camera")]
    | Annotated[FilmFrameModel, Tag("film_frame")]
    | Annotated[FiducialModel, Tag("fiducials")]
    | Annotated[SensorModel, Tag("sensor")],
    Discriminator(
        _tag,
        custom_error_type="model",
        custom_error_message="is not the model of a calibration",
        custom_error_context={},
    ),
]

_READERS: dict[str, Callable[[Calibration], CalibratedMapping]] = {}


def readable_as(kind: Kind) -> Callable[[Callable[[Calibration], Any]], Callable[[Calibration], Any]]:
    """Register the function that turns a calibration of this kind into its mapping."""

    def register(reader: Callable[[Calibration], Any]) -> Callable[[Calibration], Any]:
        _READERS[kind] = reader
        return reader

    return register


def _table(calibration: Calibration) -> str:
    """The parameters as an HTML table."""
    shown = {
        name: measured(q.value, q.sigma, "" if q.unit == "1" else q.unit)
        for name, q in calibration.parameters.items()
    }
    rows = "".join(f"<tr><td>{escape(name)}</td><td>{escape(text)}</td></tr>" for name, text in shown.items())
    return f"<table><caption>{escape(calibration.kind)} {escape(calibration.name)}</caption>{rows}</table>"


class Calibration(Document):
    """A calibration: parameters with full covariance, the tests they passed, and where they hold.

    `kind` says what was calibrated, `model` what the parameters belong to; :meth:`mapping` gives both as a
    mapping of points, images or frames. `place` is that of a camera on a rig.
    `times` alone holds clock times: without it, the same inputs give the same bytes. Files of earlier
    versions are read too: the kind of a sensor was ``camera``, that of a film frame ``frame``.

    Examples
    --------
    >>> pinhole = Calibration(
    ...     kind="camera", name="ideal", model={"model": "opencv", "width": 640, "height": 480,
    ...                                         "pitch_mm": [1.0, 1.0]},
    ...     parameters={name: Quantity(value=value, sigma=0.0, unit="px")
    ...                 for name, value in {"fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5}.items()},
    ...     covariance=Covariance(names=(), matrix=()), sigma0=None, redundancy=0)
    >>> pinhole.mapping().applies_to
    ('points', 'images')
    """

    SCHEMA: ClassVar[str] = "reseau-calibration/1"
    kind: Annotated[Kind, BeforeValidator(_present)]
    name: str
    model: Model
    parameters: dict[str, Quantity]
    covariance: Covariance
    sigma0: float | None
    redundancy: int
    place: Place | None = None
    tests: tuple[dict[str, Any], ...] = ()
    validity: dict[str, Any] = Field(default_factory=dict)
    provenance: dict[str, Any] = Field(default_factory=dict)
    times: dict[str, str] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.kind, _tag(self.model)) == ("camera", "sensor"):  # as earlier versions wrote it
            object.__setattr__(self, "kind", "sensor")
        if _tag(self.model) != self.kind:
            raise ValueError(f"a calibration of the kind {self.kind!r} has a model of {_tag(self.model)!r}")
        n = len(self.covariance.names)
        if len(self.covariance.matrix) != n or any(len(row) != n for row in self.covariance.matrix):
            raise ValueError(f"`covariance` has {n} names but no {n}×{n} matrix")
        unknown = [name for name in self.covariance.names if name not in self.parameters]
        if unknown:
            raise ValueError(f"`covariance` names {unknown[0]!r}, which is not a parameter")
        return self

    def not_of(self, wanted: Kind) -> str:
        """What to report where a calibration of another kind is wanted."""
        return f"is a calibration of {_IN_WORDS[self.kind]}, not of {_IN_WORDS[wanted]}"

    def values(self) -> dict[str, float]:
        """Parameter values by name."""
        return {name: quantity.value for name, quantity in self.parameters.items()}

    def matrix(self) -> Array:
        """Covariance matrix (u, u) over *all* parameters in their order, zero for held ones."""
        row = {name: i for i, name in enumerate(self.parameters)}
        full = np.zeros((len(row), len(row)))
        where = [row[name] for name in self.covariance.names]
        full[np.ix_(where, where)] = np.array(self.covariance.matrix).reshape(len(where), len(where))
        return full

    def __repr__(self) -> str:
        estimated = f"{len(self.covariance.names)} of {len(self.parameters)} parameters estimated"
        sigma0 = "" if self.sigma0 is None else f", sigma0 {self.sigma0:.3f}"
        return f"<Calibration: {self.kind} {self.name!r}, {estimated}{sigma0}>"

    def _repr_html_(self) -> str:
        return _table(self)

    def to_dataframe(self) -> Any:
        """Return the parameters as a pandas data frame with the columns name, value, sigma, unit.

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        rows = [(name, q.value, q.sigma, q.unit) for name, q in self.parameters.items()]
        return data_frame(dict(zip(("name", "value", "sigma", "unit"), zip(*rows, strict=True), strict=True)))

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the uncertainty of the calibration over the image with matplotlib.

        See :meth:`CalibratedMapping.plot`.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Axes to draw into; by default those of a new figure.
        """
        return self.mapping().plot(axes)

    def mapping(self) -> CalibratedMapping:
        """The mapping that this calibration describes.

        Returns
        -------
        CalibratedMapping
            Of the class that belongs to `kind`; see :mod:`reseau.calibration`.

        Raises
        ------
        FormatError
            When the model is damaged, or is of a kind that has no mapping.
        """
        if self.kind not in _READERS:
            raise FormatError(f"of the kind {self.kind!r} has no mapping", where=f"calibration {self.name}")
        return _READERS[self.kind](self)
