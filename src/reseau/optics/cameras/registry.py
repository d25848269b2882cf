"""The registry of camera models: their definition for files, commands, adjustments and reports.

A new camera model is one module that defines its mapping and registers a :class:`CameraModel`; where the
bundle adjustment needs speed, the module also has a kernel (see :mod:`reseau.optics.cameras.kernels`).
Without a kernel the adjustment uses the mapping and its derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ...core.compiled import Kernel
from ...core.data import Array
from ...core.errors import UsageError
from ...core.plugins import CAMERAS, plugin, plugins
from ..mapping import PlaneMapping
from .grid import PixelGrid

Options = Mapping[str, Any]
T = TypeVar("T")


@dataclass(frozen=True)
class Parameter:
    """One parameter of a camera model.

    Parameters
    ----------
    name : str
        As in files.
    unit : str
        As in files: ``mm``, ``px``, ``mm^-2``; empty for none.
    role : {"scale", "centre", "shape", "distortion"}
        Principal distance or focal length, principal point, shape of the projection (which is not dropped
        where it is not significant), or distortion. A scale is above zero.
    usual : bool
        Whether a calibration estimates it by default.
    required : bool
        Whether files must give it; otherwise it is zero where it is not given.
    prior : float
        Standard deviation of an observation of its start value, with which a calibration estimates it; 0 for
        none.

    Examples
    --------
    >>> Parameter("K1", "mm^-2", usual=True).role
    'distortion'
    """

    name: str
    unit: str = ""
    role: Literal["scale", "centre", "shape", "distortion"] = "distortion"
    usual: bool = False
    required: bool = False
    prior: float = 0.0


@dataclass(frozen=True)
class Option:
    """A choice within a camera model that is not a parameter: a key of its entry in files.

    Parameters
    ----------
    name : str
        Key in files.
    default : str or float
        Its type is the type of the option; a number is at least zero.
    choices : tuple of str
        The values that a text can have.
    required : bool
        Whether files must give it.

    Examples
    --------
    >>> Option("side", "object", ("object", "image")).checked("image")
    'image'
    """

    name: str
    default: str | float
    choices: tuple[str, ...] = ()
    required: bool = False

    def checked(self, value: Any) -> str | float:
        """The value, if the option can have it.

        Raises
        ------
        UsageError
            When it cannot.
        """
        if isinstance(self.default, str):
            if value not in self.choices:
                raise UsageError(
                    f"`{self.name}` is {value!r}", do="write " + " or ".join(f"`{c}`" for c in self.choices)
                )
            return str(value)
        try:
            number = float(value)
        except (TypeError, ValueError):
            number = np.nan
        if not 0 <= number < np.inf:
            raise UsageError(f"`{self.name}` is {value!r}", do="write a number that is not negative")
        return number


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A camera model: its parameters and options, its mapping, and its compiled kernel.

    Parameters
    ----------
    name : str
        As in files and on the command line.
    parameters : tuple of Parameter
        In the order of the values.
    build : callable
        ``build(values, grid, options)`` is the mapping from ideal directions to pixels.
    start : callable
        ``start(f, grid)`` gives approximate values by name, for a focal length of f pixels along the rows.
    options : tuple of Option
        In the order in which they are written.
    needs_pitch : bool
        Whether the parameters are in millimetres, so that the size of a pixel must be known.
    combine : callable, optional
        For a model that supports additional parameters, also in its kernel: ``combine(mapping, additional)``
        is the mapping with the parameters of both, or None where this has no closed form.
    kernel : Kernel, optional
        For the compiled loops of the bundle adjustment.
    constants : callable
        ``constants(options)`` is what the kernel finds in `CameraColumns.constants`.
    parallel : bool
        Whether the rays are parallel to the optical axis: the mapping then begins with xc, yc in the unit of
        object space, and its scale is a magnification.

    Examples
    --------
    >>> model = camera_model("brown")
    >>> model.names[:4], model.usual[:4], model.units["K1"]
    (('c', 'x0', 'y0', 'K1'), ('c', 'x0', 'y0', 'K1'), 'mm^-2')
    >>> grid = PixelGrid(640, 480, (0.01, 0.01))
    >>> model.mapping(model.start_values(800.0, grid), grid)([[0.1, 0.0]]).round(6)
    array([[399.5, 239.5]])
    """

    name: str
    parameters: tuple[Parameter, ...]
    build: Callable[[Array, PixelGrid, Options], PlaneMapping]
    start: Callable[[float, PixelGrid], Mapping[str, float]]
    options: tuple[Option, ...] = ()
    needs_pitch: bool = False
    combine: Callable[[Any, PlaneMapping], PlaneMapping | None] | None = None
    kernel: Kernel[..., Any] | None = None
    constants: Callable[[Options], ArrayLike] = lambda options: ()
    parallel: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in order."""
        return tuple(p.name for p in self.parameters)

    @property
    def usual(self) -> tuple[str, ...]:
        """Parameters that a calibration estimates by default."""
        return tuple(p.name for p in self.parameters if p.usual)

    @property
    def required(self) -> tuple[str, ...]:
        """Parameters that files must give."""
        return tuple(p.name for p in self.parameters if p.required)

    @property
    def units(self) -> dict[str, str]:
        """Unit of each parameter, as in files."""
        return {p.name: p.unit for p in self.parameters}

    def priors(self, free: Iterable[str]) -> dict[str, float]:
        """Standard deviations of the observations that regularise some of the parameters."""
        own = {p.name: p.prior for p in self.parameters if p.prior > 0}
        return {name: own[name] for name in free if name in own}

    def of_role(self, *roles: str) -> tuple[str, ...]:
        """Parameters of some roles: ``scale``, ``centre``, ``shape``, ``distortion``."""
        return tuple(p.name for p in self.parameters if p.role in roles)

    def checked_options(self, given: Options | None = None) -> dict[str, str | float]:
        """All options: the given ones, and the defaults of the others.

        Raises
        ------
        UsageError
            When one is unknown, or has a value that it cannot have.
        """
        given = given or {}
        known = {option.name: option for option in self.options}
        for name in given:
            if name not in known:
                have = f"it has {', '.join(known)}" if known else "it has none"
                raise UsageError(f"has no option `{name}`; {have}", where=f"camera model {self.name}")
        return {
            name: option.checked(given[name]) if name in given else option.default
            for name, option in known.items()
        }

    def mapping(
        self,
        values: ArrayLike,
        grid: PixelGrid,
        options: Options | None = None,
        additional: PlaneMapping | None = None,
    ) -> PlaneMapping:
        """The mapping from ideal directions u = xc/zc, v = yc/zc to pixels.

        Parameters
        ----------
        values : array_like (parameters,)
            All parameters, in order.
        grid : PixelGrid
            Pixels of the image.
        options : mapping, optional
            Options by name; others have their defaults.
        additional : PlaneMapping, optional
            Correction of photo-coordinates by additional parameters; these follow those of the model.

        Raises
        ------
        UsageError
            When an option is unknown, or there is no closed form with these additional parameters.
        """
        own = self.build(np.asarray(values, dtype=np.float64), grid, self.checked_options(options))
        if additional is None:
            return own
        both = None if self.combine is None else self.combine(own, additional)
        if both is None:
            raise UsageError(
                "has no closed form with these additional parameters", where=f"camera model {self.name}"
            )
        return both

    def column(self, values: Mapping[str, float]) -> Array:
        """Values (parameters,) by name, zero where they are missing."""
        return np.array([values.get(name, 0.0) for name in self.names], dtype=np.float64)

    def undistorted(self, values: ArrayLike) -> Array:
        """The same values with all distortion parameters zero."""
        bent = [p.role == "distortion" for p in self.parameters]
        return np.where(bent, 0.0, np.asarray(values, dtype=np.float64))

    def start_values(self, f: float, grid: PixelGrid) -> Array:
        """Approximate values (parameters,) for a focal length of f pixels along the rows."""
        return self.column(self.start(f, grid))

    def rescaled(self, values: ArrayLike, f: float, grid: PixelGrid) -> Array:
        """The same values with the scale parameters for a focal length of f pixels."""
        scale = np.array([p.role == "scale" for p in self.parameters])
        given = np.where(scale, self.start_values(f, grid), np.asarray(values, dtype=np.float64))
        if not self.of_role("shape"):
            return given
        # The focal length on the axis depends on the shape too.
        plain = self.mapping(self.undistorted(given), grid)
        slope = float(plain.derivatives([[0.0, 0.0]]).d_xy[0, 0, 0])
        return np.where(scale, given * (f / slope), given) if 0 < slope < np.inf else given


@dataclass(frozen=True, eq=False)
class AdditionalModel:
    """Additional parameters of self-calibration: corrections of photo-coordinates without a physical reason.

    Parameters
    ----------
    name : str
        As in files.
    names : tuple of str
        Names of the parameters, in order.
    build : callable
        ``build(values, base_mm)`` is the mapping of photo-coordinates (mm) to corrected ones.
    kernel : Kernel
        For the slot :func:`reseau.optics.cameras.kernels.additional`.
    degree : int
        Degree of a series, for the kernel.

    Examples
    --------
    >>> additional_model("ebner12").names[:3]
    ('b1', 'b2', 'b3')
    """

    name: str
    names: tuple[str, ...]
    build: Callable[[Array, float], PlaneMapping]
    kernel: Kernel[..., Any]
    degree: int = 0


# Names under which other programs and publications know the models.
_OTHER_NAMES = {
    "equidistant": "fisheye", "kannala_brandt": "fisheye", "kb4": "fisheye", "mei": "omni", "ucm": "omni",
    "unified": "omni", "ds": "double_sphere", "enhanced_unified": "eucm", "radtan": "opencv",
    "affine": "telecentric",
}  # fmt: skip
_CAMERAS: dict[str, CameraModel] = {}
_FAMILIES: dict[str, Callable[[str], CameraModel | None]] = {}
_ADDITIONAL: dict[str, AdditionalModel] = {}


def register_camera(model: CameraModel) -> CameraModel:
    """Register a camera model under its name.

    Raises
    ------
    UsageError
        When the name is taken, or the model is not complete.

    Examples
    --------
    >>> register_camera(camera_model("opencv"))
    Traceback (most recent call last):
    reseau.core.errors.UsageError: camera model opencv: is registered already
    """
    if model.name in _CAMERAS or model.name == "mapping":
        raise UsageError("is registered already", where=f"camera model {model.name}")
    if not model.of_role("scale"):
        raise UsageError("has no parameter of the role `scale`", where=f"camera model {model.name}")
    if model.combine is not None and model.kernel is None:
        raise UsageError("takes additional parameters and has no kernel", where=f"camera model {model.name}")
    _CAMERAS[model.name] = model
    return model


def register_additional(model: AdditionalModel) -> AdditionalModel:
    """Register additional parameters under their name.

    Raises
    ------
    UsageError
        When the name is taken.

    Examples
    --------
    >>> register_additional(additional_model("ebner12"))
    Traceback (most recent call last):
    reseau.core.errors.UsageError: additional parameters ebner12: is registered already
    """
    if model.name in _ADDITIONAL:
        raise UsageError("is registered already", where=f"additional parameters {model.name}")
    _ADDITIONAL[model.name] = model
    return model


def register_family(prefix: str, member: Callable[[str], CameraModel | None]) -> None:
    """Register models that differ by numbers in their names.

    Parameters
    ----------
    prefix : str
        Of their names.
    member : callable
        ``member(name)`` is the model of a name; None where there is none.
    """
    _FAMILIES[prefix] = member


def camera_models() -> tuple[CameraModel, ...]:
    """All camera models, in the order of their registration.

    Examples
    --------
    >>> [model.name for model in camera_models()][:2]
    ['brown', 'brown_higher']
    """
    return tuple(_CAMERAS.values())


def additional_models() -> tuple[AdditionalModel, ...]:
    """All models of additional parameters, in the order of their registration.

    Examples
    --------
    >>> [model.name for model in additional_models()][:2]
    ['ebner12', 'chebyshev2']
    """
    return tuple(_ADDITIONAL.values())


def camera_model(name: str) -> CameraModel:
    """A camera model by its name, also of an installed package (group ``reseau.cameras`` of entry points).

    Raises
    ------
    UsageError
        When there is none.

    Notes
    -----
    Derived in ``docs/mathematics/models.md``.

    Examples
    --------
    >>> camera_model("pinhole")
    Traceback (most recent call last):
    reseau.core.errors.UsageError: camera model 'pinhole': is unknown; use one of brown, brown_higher...
    """
    known = name in _CAMERAS or name in _OTHER_NAMES
    if not known and _member(name) is None and name in plugins(CAMERAS):
        added: CameraModel = plugin(CAMERAS, name)
        if added.name not in _CAMERAS:  # where importing its module has not registered it
            register_camera(added)
    return _member(name) or _found(_CAMERAS, name, "camera model")


def additional_model(name: str) -> AdditionalModel:
    """A model of additional parameters by its name.

    Raises
    ------
    UsageError
        When there is none.

    Examples
    --------
    >>> len(additional_model("ebner12").names)
    12
    """
    return _found(_ADDITIONAL, name, "additional parameters")


def default_camera_model(pitch_known: bool) -> CameraModel:
    """The default model of a calibration: the first one that does not need an unknown pixel size.

    Parameters
    ----------
    pitch_known : bool
        Whether the size of a pixel is given.

    Examples
    --------
    >>> default_camera_model(pitch_known=True).name, default_camera_model(pitch_known=False).name
    ('brown', 'opencv')
    """
    return next(model for model in _CAMERAS.values() if model.needs_pitch == pitch_known)


def distortion_names(names: Iterable[str], model: str = "mapping") -> tuple[str, ...]:
    """Names of parameters that do not belong to the interior orientation (scale, centre and shape).

    Parameters
    ----------
    names : iterable of str
        Of parameters, of the model or additional.
    model : str
        Name of the model; ``mapping`` for any other mapping, whose parameters are named after all models.

    Examples
    --------
    >>> distortion_names(["c", "x0", "K1", "b3"], "brown")
    ('K1', 'b3')
    """
    interior = {name for each in _own(model) for name in each.of_role("scale", "centre", "shape")}
    return tuple(name for name in names if name not in interior)


def unit_of(name: str, model: str = "mapping") -> str:
    """Unit of a parameter as in files; empty for none.

    Parameters
    ----------
    name : str
        Of the parameter.
    model : str
        Name of the model; ``mapping`` for any other mapping, whose parameters are named after all models.

    Examples
    --------
    >>> unit_of("K1", "brown"), unit_of("b1", "brown"), unit_of("fx")
    ('mm^-2', '', 'px')
    """
    return next((each.units[name] for each in _own(model) if name in each.units), "")


@cache
def _member(name: str) -> CameraModel | None:
    """A model of a family; None for a model of its own."""
    if name in _CAMERAS:
        return None
    found = (member(name) for prefix, member in _FAMILIES.items() if name.startswith(prefix))
    return next((model for model in found if model is not None), None)


def _own(name: str) -> tuple[CameraModel, ...]:
    """The model of a name; all models for any other mapping."""
    member = _member(name)
    if member is not None:
        return (member,)
    return (_CAMERAS[name],) if name in _CAMERAS else camera_models()


def _found(table: Mapping[str, T], name: str, what: str) -> T:
    if name not in table:
        if name in _OTHER_NAMES:
            raise UsageError(
                "has another name here", where=f"{what} {name!r}", do=f"use {_OTHER_NAMES[name]}"
            )
        raise UsageError("is unknown", where=f"{what} {name!r}", do=f"use one of {', '.join(table)}")
    return table[name]
