"""Cameras of a network: their models, values, and what is estimated of them."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Self, cast

import numpy as np
from numpy.typing import ArrayLike

from ...core.data import Array
from ...core.errors import UsageError
from ...io.network import CameraEntry
from ...optics import PixelGrid, camera_model
from ...optics.cameras.registry import CameraModel, additional_model, distortion_names, unit_of
from ...optics.mapping import PlaneMapping
from .shutter import Shutter


@dataclass(frozen=True, eq=False)
class Additional:
    """Additional parameters of a camera, in one set or in several.

    Parameters
    ----------
    base_mm : float
        Base b: of the grid over which they are orthogonal, or half of the longer side of the format.
    free : bool
        Whether they are estimated; otherwise they are zero.
    per : {"camera", "group", "image"}
        Whether the camera, each group or each image has its own set.
    dropped : frozenset of str
        Parameters held at zero, as named in results: ``b3``, or ``b3 of group G`` for a set per group.
    model : str
        Name in the registry, :func:`reseau.optics.additional_models`.

    Examples
    --------
    >>> Additional(9.0, per="group").name(2, "group A")
    'b3 of group A'
    """

    base_mm: float
    free: bool = True
    per: Literal["camera", "group", "image"] = "camera"
    dropped: frozenset[str] = frozenset()
    model: str = "ebner12"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters of a set."""
        return additional_model(self.model).names

    @property
    def base(self) -> tuple[float, float]:
        """Base and degree, for the kernels."""
        return self.base_mm, float(additional_model(self.model).degree)

    def name(self, k: int, label: str) -> str:
        """Name of the k-th parameter, from 0, of the set with this label."""
        return self.names[k] if self.per == "camera" else f"{self.names[k]} of {label}"

    def mapping(self, values: ArrayLike | None = None) -> PlaneMapping:
        """Return the correction of photo-coordinates (mm) by a set; all values are zero by default."""
        given = np.zeros(len(self.names)) if values is None else np.asarray(values, dtype=np.float64)
        return additional_model(self.model).build(given, self.base_mm)


@dataclass(frozen=True, eq=False)
class Camera:
    """The interior orientation of one camera of a network: its model, values, and what is estimated.

    Parameters
    ----------
    id : str
        Name.
    width, height : int
        Pixels of the image.
    pitch_mm : (float, float)
        Pixel size; not used by models whose parameters are in pixels.
    model : str
        Name in the registry, :func:`reseau.optics.camera_models`; ``mapping`` for any other mapping.
    values : ndarray (u,)
        All parameters of the model, in its order; those of the mapping where there is one.
    free : tuple of str
        Parameters to estimate.
    options : mapping of str to str or float
        Options of the model, such as the side of Brown's distortion; others have their defaults.
    sigma : mapping of str to float
        Standard deviations of free parameters whose values are observations.
    additional : Additional, optional
        Additional parameters.
    mapping : PlaneMapping, optional
        From ideal directions to pixels, for a camera without a registered model.
    covariance : ndarray (u, u), optional
        Joint covariance of all parameters, for values from an earlier calibration: free parameters with a
        positive variance are observations. Replaces `sigma`.
    shutter : Shutter, optional
        For images whose lines are taken one after the other.

    Examples
    --------
    >>> camera = Camera("front", 640, 480, (0.01, 0.01), "brown", np.array([8.0] + 9 * [0.0]), ("c", "K1"))
    >>> camera.parameters["c"], camera.options["side"]
    (8.0, 'object')
    >>> camera.plane_mapping()([[0.1, 0.0]])
    array([[399.5, 239.5]])
    """

    id: str
    width: int
    height: int
    pitch_mm: tuple[float, float]
    model: str
    values: Array
    free: tuple[str, ...] = ()
    options: Mapping[str, str | float] = field(default_factory=dict)
    sigma: dict[str, float] = field(default_factory=dict)
    additional: Additional | None = None
    mapping: PlaneMapping | None = None
    covariance: Array | None = None
    shutter: Shutter | None = None

    def __post_init__(self) -> None:
        if (self.model == "mapping") != (self.mapping is not None):
            raise UsageError(
                "`mapping` must be given for the model `mapping`, and only for it", where=f"camera {self.id}"
            )
        given = {} if self.registered is None else self.registered.checked_options(self.options)
        object.__setattr__(self, "options", given)
        if self.additional is not None and (self.registered is None or self.registered.combine is None):
            raise UsageError(
                f"the model `{self.model}` does not support additional parameters", where=f"camera {self.id}"
            )
        if self.shutter is not None and self.compiled_kind is None:
            raise UsageError(
                f"the model `{self.model}` does not support a shutter", where=f"camera {self.id}"
            )
        if self.shutter is not None and self.shutter.mode == "line" and self.corrects_measured:
            raise UsageError("a line camera needs the `side` object", where=f"camera {self.id}")
        if len(self.values) != len(self.names):
            raise UsageError(
                f"has {len(self.values)} values, not {len(self.names)}", where=f"camera {self.id}"
            )
        if self.covariance is not None:
            if self.covariance.shape != (len(self.names), len(self.names)):
                raise UsageError("needs a covariance of all parameters", where=f"camera {self.id}")
            if self.sigma:
                raise UsageError("has both `sigma` and `covariance`", where=f"camera {self.id}")

    @property
    def registered(self) -> CameraModel | None:
        """The registered model; None for any other mapping."""
        return None if self.model == "mapping" else camera_model(self.model)

    @property
    def grid(self) -> PixelGrid:
        """Pixels of the image."""
        return PixelGrid(self.width, self.height, self.pitch_mm)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters."""
        if self.mapping is not None:
            return tuple(self.mapping.names)
        return camera_model(self.model).names

    @property
    def label(self) -> str:
        """Name for messages."""
        return self.id if self.id == "camera" else f"camera {self.id}"

    @property
    def in_pixels(self) -> bool:
        """Whether lengths are in pixels: with a pitch of one, where files say nothing of the pixel size."""
        model = self.registered
        return model is not None and model.needs_pitch and self.pitch_mm == (1.0, 1.0)

    def unit_of(self, name: str) -> str:
        """Unit of a parameter; pixels stand for millimetres where lengths are in pixels."""
        unit = unit_of(name, self.model)
        return unit.replace("mm", "px") if self.in_pixels else unit

    def in_millimetres(self, pitch: float) -> Camera:
        """Return a camera whose lengths are in pixels with this pixel size (mm).

        Examples
        --------
        >>> camera = Camera("a", 640, 480, (1.0, 1.0), "brown", np.array([800.0, 2, 0, 1e-8, *6 * [0.0]]))
        >>> camera.in_millimetres(0.005).values[[0, 1, 3]]
        array([4.e+00, 1.e-02, 4.e-04])
        """
        power = []
        for name in self.names:
            length, _, exponent = self.unit_of(name).partition("^")
            power.append(int(exponent or 1) if length == "px" else 0)
        factor = pitch ** np.array(power, dtype=np.float64)
        sigma = {name: s * float(factor[self.names.index(name)]) for name, s in self.sigma.items()}
        return replace(self, pitch_mm=(pitch, pitch), values=self.values * factor, sigma=sigma)

    @property
    def parameters(self) -> dict[str, float]:
        """Values by name."""
        return dict(zip(self.names, self.values.tolist(), strict=True))

    @property
    def distortions(self) -> tuple[str, ...]:
        """Names of the distortion parameters."""
        return distortion_names(self.names, self.model)

    @property
    def compiled_kind(self) -> tuple[str, str | None] | None:
        """Model and additional parameters for the compiled loops; None where the mapping is used."""
        model = self.registered
        if model is None or model.kernel is None:
            return None
        return model.name, None if self.additional is None else self.additional.model

    @property
    def mapped_alike(self) -> bool:
        """Whether the mapping alone gives what the compiled loops give."""
        alone = self.shutter is None and self.additional is None
        return alone and not self.parallel and not self.corrects_measured

    @property
    def parallel(self) -> bool:
        """Whether the rays are parallel to the optical axis."""
        model = self.registered
        return bool(self.mapping is not None and self.mapping.parallel) if model is None else model.parallel

    @property
    def corrects_measured(self) -> bool:
        """Whether the distortion is that of the measured point."""
        return self.options.get("side") == "image"

    @property
    def moving(self) -> bool:
        """Whether velocities or rotation rates of its images are estimated."""
        return self.shutter is not None and bool(self.shutter.is_free.any())

    @property
    def shutter_columns(self) -> Array:
        """The shutter for the compiled loops (4,); zero for images that are taken at one moment."""
        if self.shutter is None:
            return np.zeros(4)
        return self.shutter.columns(self.height, implicit=self.corrects_measured)

    @property
    def constants(self) -> Array:
        """Option values for the kernel of the model (q,)."""
        model = self.registered
        return np.zeros(0) if model is None else np.asarray(model.constants(self.options), dtype=np.float64)

    def bare_mapping(self, values: ArrayLike | None = None, *, distorted: bool = True) -> PlaneMapping:
        """Return the mapping from ideal directions to pixels, without additional parameters.

        Parameters
        ----------
        values : array_like (u,), optional
            Replace the values of the camera.
        distorted : bool
            Whether to include distortion; an unregistered mapping is never changed.
        """
        given = self.values if values is None else np.asarray(values, dtype=np.float64)
        model = self.registered
        if model is None:
            return cast(PlaneMapping, self.mapping).with_values(given)
        return model.mapping(given if distorted else model.undistorted(given), self.grid, self.options)

    def plane_mapping(self) -> PlaneMapping:
        """Return the mapping from ideal directions to pixels; additional parameters are zero.

        Raises
        ------
        UsageError
            When the mapping with additional parameters has no closed form.
        """
        if self.additional is None:
            return self.bare_mapping()
        return camera_model(self.model).mapping(
            self.values, self.grid, self.options, self.additional.mapping()
        )

    def rescaled(self, f: float) -> Self:
        """The same camera with the focal length f (px); any other mapping stays as it is."""
        model = self.registered
        return self if model is None else replace(self, values=model.rescaled(self.values, f, self.grid))

    @property
    def has_plane_mapping(self) -> bool:
        """Whether :meth:`plane_mapping` has an image of its own.

        Not for cameras with several sets of parameters, and not for line cameras, whose y is a time.
        """
        extra, model = self.additional, self.registered
        if self.shutter is not None and self.shutter.mode == "line":
            return False
        if extra is None or model is None or model.combine is None:
            return True
        return extra.per == "camera" and model.combine(self.bare_mapping(), extra.mapping()) is not None

    @classmethod
    def of(
        cls, name: str, size: Sequence[int], model: str, values: Mapping[str, float],
        free: Container[str] = (), *, pitch_mm: tuple[float, float] = (1.0, 1.0),
        options: Mapping[str, str | float] | None = None,
    ) -> Self:  # fmt: skip
        """Create a camera from values by name; those that are missing are zero.

        Examples
        --------
        >>> camera = Camera.of("front", (640, 480), "opencv", {"fx": 800.0, "fy": 800.0, "k1": 0.1}, ("fx",))
        >>> camera.parameters["k1"], camera.parameters["k2"], camera.free
        (0.1, 0.0, ('fx',))
        """
        registered = camera_model(model)
        return cls(
            name, size[0], size[1], pitch_mm, model, registered.column(values),
            tuple(each for each in registered.names if each in free), options or {},
        )  # fmt: skip

    @classmethod
    def from_entry(cls, entry: CameraEntry) -> Self:
        """Create the camera of an entry in ``reseau-network/1``.

        Missing parameters are zero; those that the model regularises are observed.
        """
        model, extra = camera_model(entry.model), entry.additional
        plain = cls.of(
            entry.id, (entry.width, entry.height), entry.model, entry.parameters, entry.free,
            pitch_mm=entry.pitch_mm or (1.0, 1.0), options=entry.options,
        )  # fmt: skip
        return replace(
            plain,
            sigma=model.priors(entry.free) | dict(entry.sigma or {}),
            additional=None
            if extra is None
            else Additional(extra.base_mm, extra.free, extra.per, model=extra.model),
            shutter=None if entry.shutter is None else Shutter(**entry.shutter.model_dump()),
        )
