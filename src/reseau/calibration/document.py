"""The calibration file ``reseau-calibration/1``: the result of every procedure."""

from __future__ import annotations

from collections.abc import Callable
from hashlib import sha256
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NoReturn, NotRequired, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, ConfigDict, Discriminator, Field, Tag, model_validator, with_config
from typing_extensions import TypedDict  # pydantic needs this one before Python 3.12

from ..core.data import Array
from ..core.display import data_frame
from ..core.errors import FormatError, UsageError
from ..core.files import writable, write_whole
from ..core.lazy import above
from ..core.numbers import measured
from ..core.warned import warn_user
from ..io import Document, Strict
from ..optics.cameras.opencv import opencv_coefficients
from .assessment import Assessment, required_use
from .mapping import CalibratedMapping

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..exchange.calibrations.formats import Exported
    from .compare import FieldDifference


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
    >>> found = Covariance(names=("c",), matrix=((1.6e-7,),))
    >>> found.names, np.sqrt(np.diag(found))
    (('c',), array([0.0004]))
    """

    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]

    def __repr__(self) -> str:
        return f"<Covariance of {', '.join(self.names)}; numpy.asarray() is its matrix>"

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        """The matrix (u, u), for ``numpy.asarray``."""
        return np.array(self.matrix, dtype=dtype).reshape(len(self.names), len(self.names))

    def to_dataframe(self) -> Any:
        """Return the matrix as a pandas data frame with the names of the parameters on both sides.

        Raises
        ------
        UsageError
            When pandas is not installed.
        """
        frame = data_frame(dict(zip(self.names, np.asarray(self).T.tolist(), strict=True)))
        return frame.set_axis(list(self.names), axis=0)


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
    shown = calibration.printed().items()
    rows = "".join(f"<tr><td>{escape(name)}</td><td>{escape(text)}</td></tr>" for name, text in shown)
    table = f"<table><caption>{escape(calibration.kind)} {escape(calibration.name)}</caption>{rows}</table>"
    return table if calibration.assessment is None else calibration.assessment._repr_html_() + table


class Calibration(Document):
    """A calibration: parameters with full covariance, the tests they passed, and where they hold.

    `kind` says what was calibrated, `model` what the parameters belong to; :meth:`mapping` gives both as a
    mapping of points, images or frames. `place` is that of a camera on a rig.
    `assessment` is the verdict on that of a camera; imported ones have none.
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
    assessment: Assessment | None = None
    provenance: dict[str, Any] = Field(default_factory=dict)
    times: dict[str, str] = Field(default_factory=dict)

    @classmethod
    def from_content(cls, content: Any, *, where: object) -> Self:
        """As for every document; earlier versions had the assessment, with other keys, in the validity."""
        validity = content.get("validity") if isinstance(content, dict) else None
        if isinstance(validity, dict) and isinstance(validity.get("assessment"), dict):
            found = validity["assessment"]
            kept = {key: found[key] for key in Assessment.model_fields if key in found}
            content = content | {
                "validity": {key: value for key, value in validity.items() if key != "assessment"},
                "assessment": kept,
            }
        return super().from_content(content, where=where)

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

    @property
    def key(self) -> str:
        """Its name in archives: start of its SHA-256 without clock times."""
        text = self.model_copy(update={"times": {}}).to_json()
        return sha256(text.encode("utf-8")).hexdigest()[:12]

    def __repr__(self) -> str:
        formal = self.validity.get("sigma_formal", {})
        count = sum(formal.get(name, 1.0) != 0 for name in self.covariance.names)
        estimated = f"{count} of {len(self.parameters)} parameters estimated"
        sigma0 = "" if self.sigma0 is None else f", sigma0 {self.sigma0:.3f}"
        verdict = "" if self.assessment is None else f", {self.assessment.short}"
        return f"<Calibration: {self.kind} {self.name!r}{verdict}, {estimated}{sigma0}>"

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

    def summary(self) -> str:
        """What it is good for, and its parameters with their standard deviations, in lines of text."""
        verdict = (
            ("no verdict",) if self.assessment is None else self.assessment.lines or (self.assessment.short,)
        )
        rows = (
            f"  {name:8} {text}"
            for (name, text), q in zip(self.printed().items(), self.parameters.values(), strict=True)
            if q.value or q.sigma
        )
        return "\n".join((f"{self.kind} {self.name!r}", *verdict, *rows))

    def printed(self) -> dict[str, str]:
        """Return the parameters as text, with as many digits as their standard deviations support."""
        return {name: measured(q.value, q.sigma, q.unit) for name, q in self.parameters.items()}

    def residuals(self) -> NoReturn:
        """Refuse: residuals are those of :class:`reseau.Calibrated`, a calibration has no image points.

        Raises
        ------
        UsageError
            Always.
        """
        raise UsageError(
            "has no image points", where=f"calibration {self.name}",
            do="calibrate the photographs again, or see the report of that run",
        )  # fmt: skip

    def report(self, path: Path | str) -> None:
        """Write verdict, errors over the image and parameters as an HTML page.

        Parameters
        ----------
        path : path
            File to write, ``.html``.

        Raises
        ------
        UsageError
            When the suffix is another one.
        InputError
            When the file cannot be written.
        """
        write_whole(
            writable(Path(path), ".html"), above("reseau.report.calibration:calibration_report")(self)
        )

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the error of the projection over the image with matplotlib.

        With a verdict that has a map, it is the total error; in a new figure the formal standard deviation
        is drawn beside it. Otherwise it is the standard deviation, see :meth:`CalibratedMapping.plot`.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Axes to draw into; by default those of a new figure.

        Returns
        -------
        matplotlib Axes
            Those of the first map.
        """
        if self.assessment is None or self.assessment.errors is None:
            return self.mapping().plot(axes)
        return self.assessment.plot(axes)

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

    @property
    def camera_matrix(self) -> Array:
        """OpenCV's camera matrix (3, 3).

        Raises
        ------
        UsageError
            When the model is not one of OpenCV.
        """
        fx, fy, cx, cy = (self._of_opencv("camera_matrix")[name] for name in ("fx", "fy", "cx", "cy"))
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def dist_coeffs(self) -> Array:
        """OpenCV's coefficients of distortion: 5, 8, 12 or 14; of a ``fisheye`` the 4 of ``cv2.fisheye``.

        Raises
        ------
        UsageError
            When the model is not one of OpenCV.
        """
        values = self._of_opencv("dist_coeffs")
        if self._named_model == "fisheye":
            return np.array([values.get(f"k{i}", 0.0) for i in range(1, 5)])
        return np.array(opencv_coefficients(values))

    @property
    def _named_model(self) -> str:
        return str(self.model.get("model", self.kind))

    def _of_opencv(self, asked: str) -> dict[str, float]:
        """The values of a model of OpenCV."""
        if self.kind != "camera":
            raise UsageError(self.not_of("camera"), where=f"calibration {self.name}")
        if self._named_model not in ("opencv", "opencv_full", "fisheye") or "additional" in self.model:
            raise UsageError(
                f"the model {self._named_model} has none in the sense of OpenCV",
                where=f"{asked} of calibration {self.name}",
                do='export(path, to="opencv") converts it, and states the difference',
            )
        return self.values()

    @property
    def rms(self) -> float:
        """Root mean square of the residuals of an image coordinate, px; NaN where it is not known."""
        return float(self.validity.get("rms_px", float("nan")))

    def undistort(
        self,
        image: NDArray[Any],
        fov: Literal["keep", "all"] | float = "keep",
        *,
        scale: float = 1.0,
        alpha: float | None = None,
        anyway: bool = False,
    ) -> NDArray[Any]:
        """Return an image of the camera without distortion.

        Parameters
        ----------
        image : ndarray (h, w) or (h, w, channels)
            The image, with channels in any order.
        fov, scale, alpha
            Field of view and resolution, as for :meth:`reseau.calibration.CorrectedImage.undistorted`.
        anyway : bool
            Whether to go on with a calibration that is usable for nothing.

        Raises
        ------
        UsageError
            When the calibration is not that of a camera or, unless `anyway`, usable for nothing, or the image
            has another size.
        """
        self._usable("applied", anyway)
        done: NDArray[Any] = above("reseau.calibration.raster:undistort")(
            image, self, fov, scale=scale, alpha=alpha
        )
        return done

    def compare(self, other: Calibration | Path | str) -> FieldDifference:
        """Return the difference of another, independent calibration of the camera over the image.

        Parameters
        ----------
        other : Calibration or path
            Calibration of images of the same size, or its file; its model may be another one.

        Raises
        ------
        UsageError
            When one is not that of a camera, or the images differ in size.
        """
        second: Any = Calibration.read(Path(other)) if isinstance(other, str | Path) else other
        if callable(made := getattr(second, "calibration", None)):  # that of a result
            second = made()
        for each in (self, second):
            if not isinstance(each, Calibration):
                raise UsageError(
                    f"is of type {type(each).__name__}", where="other", do="use reseau.read_calibration"
                )
            if each.kind != "camera":
                raise UsageError(each.not_of("camera"), where=f"calibration {each.name}")
        found: FieldDifference = above("reseau.calibration.compare:calibration_difference")(
            self.mapping(), second.mapping()
        )
        return found

    def export(self, path: Path | str, *, to: str, anyway: bool = False) -> Exported:
        """Write the calibration of a camera for another program.

        Parameters
        ----------
        path : path
            File to write.
        to : str
            Name of the format, as ``opencv``, ``ros`` or ``colmap``; see
            :func:`reseau.exchange.calibrations.calibration_formats`.
        anyway : bool
            Whether to go on with a calibration that is usable for nothing.

        Returns
        -------
        Exported
            The camera as it was written, and how much that differs from the calibration.

        Raises
        ------
        UsageError
            When the format is not known, the calibration is not that of a camera or, unless `anyway`, usable
            for nothing.
        InputError
            When the file cannot be written.
        """
        done: Exported = above("reseau.exchange.calibrations:export_calibration")(
            self, to, path, anyway=anyway
        )
        warn_user(done.notes)
        return done

    def _usable(self, doing: str, anyway: bool) -> None:
        """Refuse what is usable for nothing; warn of what is usable for less than measurement."""
        warn_user(required_use([(self.name, self.assessment)], doing, anyway=anyway))

    def write(self, path: Path | str) -> None:
        """Write the calibration, ``reseau-calibration/1``.

        Raises
        ------
        UsageError
            When the suffix is that of another format; :meth:`export` writes those.
        InputError
            When the file cannot be written.
        """
        if Path(path).suffix.lower() not in ("", ".json"):
            raise UsageError(
                "is not .json", where=path, do='export(path, to="opencv") writes the files of other programs'
            )
        super().write(path)
