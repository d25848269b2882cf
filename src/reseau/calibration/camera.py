"""A calibrated camera: its mapping from directions to pixels, and its uncertainty over the image.

A shift of the principal point and a small tilt of the camera move an image in the same way, up to the squares
of directions. The standard deviations of single parameters contain this common part, which no ray shows.
The uncertainty is therefore referred to the rotation that fits best over the image: with the derivatives G by
a rotation, the derivatives J by the parameters become (I − G(GᵀG)⁻¹Gᵀ) J (an S-transformation, Baarda 1973).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self, cast

import numpy as np

from ..core.data import Array, Mask, Rows
from ..core.errors import FormatError, UsageError
from ..optics import PixelGrid
from ..optics.cameras.registry import additional_model, camera_model
from ..optics.mapping import PlaneMapping
from .document import Calibration, readable_as
from .mapping import CalibratedMapping, Target, extent_of, reasons

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_KEYS = ("model", "width", "height", "pitch_mm", "additional", "shutter")
"""Keys of the model in a file; the others are options of the camera model."""
_CIRCULAR_DEG = 75.0
"""Angle of rays to the axis from which corners without rays are dark; below, the model has no image there."""


def options_of(model: Mapping[str, Any]) -> dict[str, Any]:
    """Options of the camera model of a calibration.

    Examples
    --------
    >>> options_of({"model": "brown", "width": 640, "height": 480, "pitch_mm": [0.01, 0.01]})
    {}
    """
    return {key: value for key, value in model.items() if key not in _KEYS}


@dataclass(frozen=True, eq=False)
class CameraMapping(CalibratedMapping):
    """A calibrated camera.

    As a calibration it maps pixels to ideal directions u = xc/zc, v = yc/zc, free of distortion.

    Parameters
    ----------
    mapping : PlaneMapping
        From ideal directions to pixels, with the estimates.
    width, height : int
        Size of the image in pixels.
    rows : ndarray of int (u,)
        Parameters of the mapping that were estimated.
    covariance : ndarray (u, u)
        Their covariance matrix, a posteriori.
    extent : tuple of float, optional
        Left, top, right and bottom of the observations that it was estimated from, in pixels.
    dof : float
        Degrees of freedom of the covariance.
    rivals : tuple of Rival
        The camera by models of other kinds, which predict images about as well.

    Examples
    --------
    >>> brown = camera_model("brown").mapping([8.0, *9 * [0.0]], PixelGrid(640, 480, (0.01, 0.01)))
    >>> camera = CameraMapping(brown, 640, 480, np.array([0]), np.array([[1e-6]]))
    >>> camera.names
    ('c',)
    >>> from reseau.core.data import ImagePoints
    >>> camera.apply(ImagePoints.with_sigma(["corner"], [[639.5, 479.5]], 0.1)).xy
    array([[0.4, 0.3]])
    """

    applies_to: ClassVar[tuple[Target, ...]] = ("points", "images")
    system: ClassVar[str] = "direction"
    unit: ClassVar[str] = "1"

    mapping: PlaneMapping
    width: int
    height: int
    rows: Rows
    covariance: Array
    extent: tuple[float, ...] | None = None
    dof: float = float("inf")
    rivals: tuple[Rival, ...] = ()

    @property
    def models(self) -> list[tuple[float, CameraMapping]]:
        """The camera by each model, with its probability; the chosen one first."""
        others = [(each.probability, each.lens) for each in self.rivals]
        own = replace(self, covariance=self.within, rivals=())
        return [(1.0 - sum(p for p, _ in others), own), *others]

    @property
    def within(self) -> Array:
        """Covariance (u, u) of the parameters if the model is the right one."""
        between = [each.probability * np.outer(moves, moves) for each, moves in self._described]
        return self.covariance - np.sum(between, axis=0) if between else self.covariance

    @property
    def _described(self) -> list[tuple[Rival, Array]]:
        """Models of other kinds of which is known what they change of the parameters, and these changes."""
        return [(each, each.moves) for each in self.rivals if each.moves is not None]

    def by_models(self, uv: Array) -> Array:
        """Displacements (n, 2, m) of the images of rays by models of other kinds, weighted.

        The sum of their squares is what the choice of the model adds to the variance, the covariance being
        :attr:`within`. Where a model has no image of a ray, it says nothing.
        """
        found = np.zeros((len(uv), 2, len(self._described)))
        if not found.size:
            return found
        own = self.mapping.derivatives(uv)
        turn = own.d_xy @ by_rotation(uv, self.mapping.parallel)
        for k, (each, _) in enumerate(self._described):
            off = each.lens.mapping(uv) - own.value - turn @ each.rotation
            found[:, :, k] = np.sqrt(each.probability) * np.nan_to_num(off)
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that were estimated."""
        return tuple(self.mapping.names[k] for k in self.rows)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image."""
        return self.width, self.height

    @property
    def parameter_covariance(self) -> Array:
        """That of the parameters that were estimated, and of the displacements by other models."""
        u, m = len(self.rows), len(self._described)
        found = np.eye(u + m)
        found[:u, :u] = self.within
        return found

    def derivatives(self, xy: Array) -> tuple[Array, Array, Array]:
        """Directions of pixels; see :meth:`CalibratedMapping.derivatives`."""
        uv = self.mapping.inverse(xy)
        known = np.isfinite(uv).all(axis=1)
        seen = self.mapping.derivatives(uv[known])
        moved = np.concatenate([seen.d_parameters[:, :, self.rows], self.by_models(uv[known])], axis=2)
        slope, by_parameters = np.full((len(xy), 2, 2), np.nan), np.full((len(xy), *moved.shape[1:]), np.nan)
        slope[known] = np.linalg.inv(seen.d_xy)
        by_parameters[known] = -slope[known] @ moved
        return uv, slope, by_parameters

    def to_pixels(self, xy: Array) -> Array:
        """Pixels (n, 2) of directions (n, 2); NaN where the model has no image of them."""
        inside = self.mapping.one_to_one(xy)
        return np.where(inside[:, None], self.mapping(xy), np.nan)

    def _why(self, xy: Array, mapped: Array) -> list[str]:
        inside: Mask = np.asarray(((xy >= -0.5) & (xy <= np.array(self.size) - 0.5)).all(axis=1))
        found = reasons(self.extent, xy, mapped, "the observations")
        return [
            why if here or why == "has no image under the model" else "lies outside the image"
            for here, why in zip(inside.tolist(), found, strict=True)
        ]

    def plot(self, axes: Axes | None = None, across: int = 45) -> Axes:
        """Draw the uncertainty of the projection over the image; see :func:`projection_field`."""
        return projection_field(self, across).plot(axes)

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> Self:
        """Read a camera from its calibration.

        Raises
        ------
        FormatError
            When the calibration is of another kind or of an unknown camera model, or is damaged.
        """
        where = f"calibration {calibration.name}"
        if calibration.kind != "camera":
            raise FormatError(calibration.not_of("camera"), where=where)
        model = cast(dict[str, Any], calibration.model)
        extra: dict[str, Any] | None = model.get("additional")
        values = calibration.values()
        rivals: list[dict[str, Any]] = calibration.validity.get("rivals", [])
        names, n = calibration.covariance.names, len(calibration.covariance.names)
        if (model.get("shutter") or {}).get("mode") == "line":
            raise FormatError("is that of a line camera: its images have no directions", where=where)
        if extra is not None and extra["per"] != "camera":
            raise FormatError("has several sets of additional parameters", where=where)
        try:
            mapping = _mapping(model, values)
            others = tuple(Rival.from_entry(each) for each in rivals)
            if not 0 <= sum(each.probability for each in others) <= 1 + 1e-9:
                raise ValueError("probabilities of models are none")
            if any(each.lens.size != (model["width"], model["height"]) for each in others):
                raise ValueError("models are of images of different sizes")
            if any(each.moves is not None and each.moves.shape != (n,) for each in others):
                raise ValueError("models change other parameters")
        except (UsageError, KeyError, IndexError, TypeError, ValueError) as error:
            raise FormatError(f"has a damaged or unknown model: {error}", where=where) from None
        unknown = [name for name in values if name not in mapping.names]
        if unknown:
            raise FormatError(f"the model {model['model']!r} has no parameter {unknown[0]!r}", where=where)
        matrix = np.array(calibration.covariance.matrix).reshape(n, n)
        size, extent = (model["width"], model["height"]), extent_of(calibration.validity)
        dof = calibration.validity.get("degrees_of_freedom")
        dof = float(dof) if isinstance(dof, int | float) and dof > 0 else float("inf")
        return cls.of_estimates(mapping, size, values, names, matrix, extent, dof, others)

    @classmethod
    def of_estimates(
        cls,
        mapping: PlaneMapping,
        size: tuple[int, int],
        values: dict[str, float],
        names: tuple[str, ...],
        covariance: Array,
        extent: tuple[float, ...] | None = None,
        dof: float = float("inf"),
        rivals: tuple[Rival, ...] = (),
    ) -> Self:
        """A camera with these values of its parameters, of which those named were estimated."""
        mapping = mapping.with_values({name: values[name] for name in mapping.names if name in values})
        rows = np.array([mapping.names.index(name) for name in names], dtype=np.intp)
        return cls(mapping, *size, rows, covariance, extent, dof, rivals)


readable_as("camera")(CameraMapping.from_calibration)


@dataclass(frozen=True, eq=False)
class Rival:
    """A camera by a model of another kind than the chosen one.

    Parameters
    ----------
    probability : float
        Probability that it is the right model, by what each predicts of images that are left out.
    lens : CameraMapping
        The camera with this model.
    model : mapping
        The model as in a calibration.
    moves : ndarray (u,), optional
        Changes of the estimated parameters of the chosen model which describe it best where points were seen;
        they are in the covariance of these parameters. None: the covariance contains all that it does.
    rotation : ndarray (3,)
        Rotation of the rays between the chosen model and this one, which orientations contain.
    """

    probability: float
    lens: CameraMapping
    model: Mapping[str, Any] = field(default_factory=dict)
    moves: Array | None = None
    rotation: Array = field(default_factory=lambda: np.zeros(3))

    def entry(self) -> dict[str, Any]:
        """What a calibration says of it."""
        mapping = self.lens.mapping
        found = {
            "probability": self.probability,
            "model": dict(self.model),
            "parameters": dict(zip(mapping.names, np.asarray(mapping.values).tolist(), strict=True)),
            "estimated": list(self.lens.names),
            "covariance": self.lens.covariance.tolist(),
        }
        if self.moves is not None:
            found |= {"moves": self.moves.tolist(), "rotation": self.rotation.tolist()}
        return found

    @classmethod
    def from_entry(cls, entry: Mapping[str, Any]) -> Self:
        """Read what a calibration says of it."""
        model, values = entry["model"], entry["parameters"]
        lens = CameraMapping.of_estimates(
            _mapping(model, values), (model["width"], model["height"]), values, tuple(entry["estimated"]),
            np.array(entry["covariance"], dtype=np.float64).reshape(2 * (len(entry["estimated"]),)),
        )  # fmt: skip
        moves, rotation = entry.get("moves"), np.array(entry.get("rotation", np.zeros(3)), dtype=np.float64)
        own = None if moves is None else np.array(moves, dtype=np.float64)
        return cls(float(entry["probability"]), lens, model, own, rotation.reshape(3))


def _mapping(model: Mapping[str, Any], values: Mapping[str, float]) -> PlaneMapping:
    """The mapping of a model as in a calibration."""
    registered, extra, more = camera_model(model["model"]), model.get("additional"), None
    if extra is not None:
        additional = additional_model(extra["model"])
        more = additional.build(np.zeros(len(additional.names)), extra["base_mm"])
    return registered.mapping(
        registered.column(values),
        PixelGrid(model["width"], model["height"], (model["pitch_mm"][0], model["pitch_mm"][1])),
        options_of(model),
        more,
    )


@dataclass(frozen=True, eq=False)
class ProjectionField:
    """Uncertainty of the projection over the image.

    Parameters
    ----------
    xy : ndarray (rows, columns, 2)
        Places, pixels.
    cov : ndarray (rows, columns, 2, 2)
        Covariances (px²) of the image of the ray that is imaged there; NaN where there is no ray.
    reach_deg : float
        Largest angle between rays of these places and the axis; 0 for parallel rays.

    Examples
    --------
    >>> field = ProjectionField(np.zeros((1, 1, 2)), np.array([[[[0.04, 0.0], [0.0, 0.01]]]]))
    >>> field.sigma
    array([[0.2]])
    """

    xy: Array
    cov: Array
    reach_deg: float = 0.0

    @property
    def circular(self) -> bool:
        """Whether no corner of the image has a ray, as of a fisheye whose image is a circle."""
        return self.reach_deg > _CIRCULAR_DEG and not np.isfinite(corners_of(self.sigma)).any()

    @property
    def worst_px(self) -> float:
        """Standard deviation in the worst corner, or place of a circular image, px; infinite without rays.

        Examples
        --------
        >>> field = ProjectionField(np.zeros((1, 1, 2)), np.array([[[[0.04, 0.0], [0.0, 0.01]]]]))
        >>> field.worst_px
        0.2
        """
        sigma = self.sigma if self.circular else corners_of(self.sigma)
        known = sigma[np.isfinite(sigma)]
        return float(known.max()) if len(known) else float("inf")

    @property
    def sigma(self) -> Array:
        """Standard deviation in the worst direction (rows, columns), px."""
        return worst(self.cov)

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw contours of the standard deviation with matplotlib.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Axes to draw into; by default those of a new figure.
        """
        from ..core.figures import draw_contours

        return draw_contours(axes, self.xy, self.sigma, "σ of the projection, worst direction / px")


def projection_field(lens: CameraMapping, across: int = 25, down: int | None = None) -> ProjectionField:
    """Uncertainty of the projection over the image.

    Parameters
    ----------
    lens : CameraMapping
        A calibrated camera.
    across, down : int
        Places along the axes, from edge to edge; `down` by default in proportion.

    Notes
    -----
    It covers the noise of the observations only, not what the model cannot follow. In corners without points
    it is an extrapolation by the model.

    Examples
    --------
    >>> from reseau.optics import OpenCV
    >>> lens = OpenCV.from_parameters({"fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5, "k1": -0.1})
    >>> camera = CameraMapping(lens, 640, 480, np.array([0]), np.array([[0.25]]))
    >>> projection_field(camera, 3).sigma.shape
    (2, 3)
    """
    xy, shape = places(lens, across, down)
    slope, reach_deg = _slopes(lens, xy)
    cov = slope @ lens.parameter_covariance @ np.swapaxes(slope, 1, 2)
    return ProjectionField(xy.reshape(*shape, 2), cov.reshape(*shape, 2, 2), reach_deg)


def projection_slopes(lens: CameraMapping, xy: Array) -> tuple[Array, float]:
    """Derivatives of the images of rays by the parameters that were estimated.

    Parameters
    ----------
    lens : CameraMapping
        A calibrated camera.
    xy : ndarray (g, 2)
        Where the rays are imaged, pixels.

    Returns
    -------
    slopes : ndarray (g, 2, u)
        Without the part that a rotation explains over these places; NaN where there is no ray.
    reach_deg : float
        See :class:`ProjectionField`.

    Examples
    --------
    >>> from reseau.optics import OpenCV
    >>> lens = OpenCV.from_parameters({"fx": 800.0, "fy": 800.0, "cx": 319.5, "cy": 239.5, "k1": -0.1})
    >>> camera = CameraMapping(lens, 640, 480, np.array([0]), np.array([[0.25]]))
    >>> projection_slopes(camera, np.array([[0.0, 0.0], [639.0, 0.0], [0.0, 479.0]]))[0].shape
    (3, 2, 1)
    """
    slope, reach_deg = _slopes(lens, xy)
    return slope[:, :, : len(lens.rows)], reach_deg


def _slopes(lens: CameraMapping, xy: Array) -> tuple[Array, float]:
    """The same, and beside them the displacements by other models."""
    uv = lens.mapping.inverse(xy)
    known = np.isfinite(uv).all(axis=1)
    seen = lens.mapping.derivatives(uv[known])
    moved = np.concatenate([seen.d_parameters[:, :, lens.rows], lens.by_models(uv[known])], axis=2)
    slope = np.full((len(xy), *moved.shape[1:]), np.nan)
    slope[known] = referred(seen.d_xy @ by_rotation(uv[known], lens.mapping.parallel), moved)
    return slope, reach(uv[known], lens)


def corners_of(values: Array) -> Array:
    """The four values (4,) in the corners of a field (rows, columns)."""
    return np.asarray(values[[0, 0, -1, -1], [0, -1, 0, -1]])


def reach(uv: Array, lens: CameraMapping) -> float:
    """Largest angle between rays (n, 2) and the axis of a camera, degrees; 0 for parallel rays."""
    if lens.mapping.parallel or not len(uv):
        return 0.0
    return float(np.degrees(np.arctan(np.hypot(*uv.T).max())))


def places(lens: CameraMapping, across: int, down: int | None) -> tuple[Array, tuple[int, int]]:
    """A grid over the image (g, 2), and its rows and columns."""
    down = max(2, round(across * lens.height / lens.width)) if down is None else down
    if across < 2 or down < 2:
        raise UsageError(f"{across} × {down} places are no field", where="across, down")
    x, y = np.meshgrid(np.linspace(0, lens.width - 1, across), np.linspace(0, lens.height - 1, down))
    return np.column_stack([x.ravel(), y.ravel()]), (down, across)


def by_rotation(uv: Array, parallel: bool = False) -> Array:
    """Derivatives (n, 2, 3) of directions by a small rotation of the rays about the camera's axes.

    For parallel rays these are derivatives by a shift along two axes and a rotation about the third; one
    about the others would move them out of the plane.
    """
    u, v = uv.T
    one = np.ones_like(u)
    if parallel:
        return np.stack([np.stack([one, 0 * u, -v], axis=1), np.stack([0 * u, one, u], axis=1)], axis=1)
    return np.stack(
        [np.stack([-u * v, one + u * u, -v], axis=1), np.stack([-one - v * v, u * v, u], axis=1)], axis=1
    )


def referred(by_rotation: Array, slope: Array, root: Array | None = None) -> Array:
    """Derivatives (g, 2, u) without the part that a rotation explains, with roots of weights (g,).

    Other derivatives may stand beside those by the rotation, (g, 2, 3 and more).
    """
    g, flat = (each.reshape(2 * len(slope), each.shape[2]) for each in (by_rotation, slope))
    weight = np.ones((len(g), 1)) if root is None else np.repeat(root, 2)[:, None]
    part = np.linalg.lstsq(weight * g, weight * flat, rcond=None)[0]
    return (flat - g @ part).reshape(slope.shape)


def worst(cov: Array) -> Array:
    """Root of the larger eigenvalue of 2×2 covariances."""
    a, b, c = cov[..., 0, 0], cov[..., 0, 1], cov[..., 1, 1]
    return np.sqrt(np.maximum((a + c) / 2 + np.hypot((a - c) / 2, b), 0.0))
