"""``reseau-network/1``: cameras, images, points and their observations, for a bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

from pydantic import ConfigDict, Discriminator, Field, Tag, field_validator, model_validator

from ..core.data import twice
from ..core.errors import UsageError
from ..optics.cameras.registry import additional_models, camera_model, camera_models
from .document import Columns, Document, Strict
from .refraction import RefractionEntry

T = TypeVar("T")
Triple = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]
Motion = Literal["vx", "vy", "vz", "wx", "wy", "wz"]
MOTION: tuple[Motion, ...] = ("vx", "vy", "vz", "wx", "wy", "wz")


class AdditionalParameters(Strict):
    """Additional parameters of the images: one set per camera, group or image."""

    model: str
    base_mm: float = Field(gt=0)
    free: bool
    per: Literal["camera", "group", "image"] = "camera"

    @field_validator("model")
    @classmethod
    def _registered(cls, name: str) -> str:
        return _known(name, [model.name for model in additional_models()])


class ShutterEntry(Strict):
    """Lines of an image that follow each other while the camera moves.

    `line_s` is the time from one line to the next, `row` the row of the camera model at which a line camera
    has its sensor elements. `free` and `sigma` are about the components vx, vy, vz (along the axes of the
    camera), wx, wy, wz (rad) of the motion of each image.
    """

    mode: Literal["rolling", "line"]
    line_s: float = 1.0
    row: float = 0.0
    free: tuple[Motion, ...] = MOTION
    sigma: dict[Motion, float] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.line_s == 0:
            raise ValueError("`line_s` of a shutter must not be zero")
        if (again := twice(self.free)) is not None:
            raise ValueError(f"`free` of a shutter contains {again!r} twice")
        for name, sigma in (self.sigma or {}).items():
            if sigma <= 0:
                raise ValueError(f"the sigma of {name!r} must be above zero")
            if name not in self.free:
                raise ValueError(f"{name!r} has a sigma but is not free")
        return self


class CameraEntry(Strict):
    """One camera: its pixels, its model, and its interior orientation as far as it is known.

    The models are those of :func:`reseau.optics.camera_models`; the options of a model are keys of the entry.
    """

    model_config = ConfigDict(extra="allow")

    id: str = Field(min_length=1)
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    pitch_mm: tuple[float, float] | None = None
    model: str
    side: Literal["image", "object"] | None = None
    balance_radius_mm: float = Field(default=0.0, ge=0)
    parameters: dict[str, float]
    free: tuple[str, ...]
    sigma: dict[str, float] | None = None
    additional: AdditionalParameters | None = None
    shutter: ShutterEntry | None = None

    @field_validator("model")
    @classmethod
    def _registered(cls, name: str) -> str:
        try:
            camera_model(name)
        except UsageError as error:
            if "_order=" in name:
                raise ValueError(str(error)) from None
            raise ValueError(_not_known(name, [model.name for model in camera_models()])) from None
        return name

    @property
    def on_film(self) -> bool:
        """Whether pixel size and principal point follow from the orientation of a film frame."""
        return False

    @property
    def options(self) -> dict[str, Any]:
        """Options of the model that the entry gives."""
        given = {option.name: getattr(self, option.name, None) for option in camera_model(self.model).options}
        return {name: value for name, value in given.items() if value is not None}

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        model, who = camera_model(self.model), f"camera {self.id!r}"
        if self.pitch_mm is not None and min(self.pitch_mm) <= 0:
            raise ValueError(f"{who}: `pitch_mm` must be above zero")
        needed = ["pitch_mm"] if model.needs_pitch and not self.on_film else []
        for key in [*needed, *(option.name for option in model.options if option.required)]:
            if getattr(self, key, None) is None:
                raise ValueError(f"{who}: missing key `{key}`")
        for key in self.model_extra or {}:
            if key not in [option.name for option in model.options]:
                raise ValueError(f"{who}: unknown key `{key}`")
        try:
            model.checked_options(self.options)
        except UsageError as error:
            raise ValueError(f"{who}: {error}") from None
        for key, names in (("parameters", self.parameters), ("free", self.free), ("sigma", self.sigma or {})):
            for name in names:
                if name not in model.names:
                    raise ValueError(
                        f"{who}: `{key}` contains {name!r}, which is not a parameter of {self.model!r}"
                    )
        for name in model.required:
            if name not in self.parameters:
                raise ValueError(f"{who}: parameter {name!r} is missing")
        for name in model.of_role("scale"):
            if name in self.parameters and self.parameters[name] <= 0:
                raise ValueError(f"{who}: parameter {name!r} must be above zero")
        if (again := twice(self.free)) is not None:
            raise ValueError(f"{who}: `free` contains {again!r} twice")
        for name, sigma in (self.sigma or {}).items():
            if sigma <= 0:
                raise ValueError(f"{who}: the sigma of {name!r} must be above zero")
            if name not in self.free:
                raise ValueError(f"{who}: {name!r} has a sigma but is not free")
        if self.additional is not None and model.combine is None:
            raise ValueError(f"{who}: the model {self.model!r} does not support `additional` parameters")
        return self


class CalibratedCameraEntry(Strict):
    """A camera whose interior orientation is that of a calibration file.

    `calibration` is the path of a ``reseau-calibration/1`` of a camera, relative to the network file. With
    `use` "observed" its parameters are observations with their joint covariance, with "held" they are held.
    """

    id: str = Field(min_length=1)
    calibration: str = Field(min_length=1)
    use: Literal["observed", "held"] = "observed"

    @property
    def additional(self) -> None:
        """None: additional parameters are part of the calibration."""
        return


class FilmCameraEntry(CameraEntry):
    """A film camera with the pixel size and the principal point of a scanned frame.

    `calibration` is the path of a ``reseau-orientation/1``, or of the ``reseau-calibration/1`` of a film
    frame, relative to the network file; `width` and `height` are the pixels of the scan. With `use`
    "observed" the principal point is an observation with its covariance, with "held" it is held. All other
    parameters are given as for any camera.
    """

    model: str = "brown"
    side: Literal["image", "object"] | None = "object"
    calibration: str = Field(min_length=1)
    use: Literal["observed", "held"] = "observed"

    @property
    def on_film(self) -> bool:
        """Whether pixel size and principal point follow from the orientation of a film frame."""
        return True

    @model_validator(mode="after")
    def _of_the_frame(self) -> Self:
        model, who = camera_model(self.model), f"camera {self.id!r}"
        if not model.needs_pitch:
            raise ValueError(f"{who}: the model {self.model!r} has no pixel size and cannot use a film frame")
        if self.pitch_mm is not None:
            raise ValueError(f"{who}: `pitch_mm` follows from the film frame: leave it out")
        for name in model.of_role("centre"):
            if name in {*self.parameters, *self.free, *(self.sigma or {})}:
                raise ValueError(f"{who}: {name!r} follows from the film frame: leave it out")
        return self


def _kind_of_camera(entry: Any) -> str:
    if not isinstance(entry, dict):
        if isinstance(entry, FilmCameraEntry):
            return "<film>"
        return "<calibrated>" if isinstance(entry, CalibratedCameraEntry) else "<camera>"
    if "calibration" not in entry:
        return "<camera>"
    return "<film>" if "parameters" in entry or {"width", "height"} <= set(entry) else "<calibrated>"


AnyCamera = Annotated[
    Annotated[CameraEntry, Tag("<camera>")]
    | Annotated[CalibratedCameraEntry, Tag("<calibrated>")]
    | Annotated[FilmCameraEntry, Tag("<film>")],
    Discriminator(_kind_of_camera),
]


class ImageColumns(Columns):
    """Images: the camera of each, and its pose where it is known.

    Images with the same `exposure` were taken at once, by cameras that are fixed to each other (a rig).
    `motion` is the motion of cameras with a shutter, vx, vy, vz, wx, wy, wz per second: observed, held, or
    approximate values; zero where it is null.
    """

    id: tuple[str, ...]
    camera: tuple[str, ...]
    X0: tuple[Triple | None, ...]
    rotation: tuple[Triple | None, ...]
    file: tuple[str | None, ...] | None = None
    group: tuple[str | None, ...] | None = None
    exposure: tuple[str | None, ...] | None = None
    motion: tuple[Six | None, ...] | None = None


class PointColumns(Columns):
    """Object points: coordinates where they are known, with their standard deviations."""

    id: tuple[str, ...]
    xyz: tuple[Triple | None, ...]
    sigma: tuple[tuple[float | None, float | None, float | None] | None, ...]
    role: tuple[Literal["tie", "control", "check"], ...]


class ObservationColumns(Columns):
    """Image coordinates in pixels."""

    image: tuple[str, ...]
    point: tuple[str, ...]
    x: tuple[float, ...]
    y: tuple[float, ...]
    sx: tuple[float, ...]
    sy: tuple[float, ...]
    rho: tuple[float, ...] | None = None


class DistanceColumns(Columns):
    """Observed distances between points, such as scale bars."""

    model_config = ConfigDict(populate_by_name=True)

    from_: tuple[str, ...] = Field(alias="from")
    to: tuple[str, ...]
    length: tuple[float, ...]
    sigma: tuple[float, ...]


class BaseColumns(DistanceColumns):
    """Known distances between the projection centres of cameras that are fixed to each other."""


class TurntableEntry(Columns):
    """A turntable that carries the object, or the camera, with the angles of images.

    Images with the same `pose` differ by their angles only; without the column all do. The angle of an image
    is known where `sigma_deg` is 0, observed where it is above, and approximate (or null) where it is null.
    The `direction` of the axis and the `position` of a point on it, in the system of the object, are
    approximate values, observed with their sigmas, or known with 0.
    """

    carries: Literal["object", "camera"] = "object"
    image: tuple[str, ...] = Field(min_length=1)
    angle_deg: tuple[float | None, ...]
    sigma_deg: tuple[float | None, ...]
    pose: tuple[str, ...] | None = None
    direction: Triple | None = None
    direction_sigma_deg: float | None = Field(default=None, ge=0)
    position: Triple | None = None
    position_sigma: float | None = Field(default=None, ge=0)

    @classmethod
    def _column_names(cls) -> tuple[str, ...]:
        return "image", "angle_deg", "sigma_deg", "pose"

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (again := twice(self.image)) is not None:
            raise ValueError(f"image {again!r} has two angles of the turntable")
        for name, angle, sigma in zip(self.image, self.angle_deg, self.sigma_deg, strict=True):
            if sigma is not None and sigma < 0:
                raise ValueError(f"the sigma of the angle of image {name!r} is negative")
            if sigma is not None and angle is None:
                raise ValueError(f"image {name!r} has a sigma, but no angle of the turntable")
        for what, value, spread in (
            ("direction", self.direction, self.direction_sigma_deg),
            ("position", self.position, self.position_sigma),
        ):
            if value is None and spread is not None:
                raise ValueError(f"the {what} of the axis of the turntable has a sigma, but no value")
        if self.direction is not None and not any(self.direction):
            raise ValueError("the direction of the axis of the turntable is zero")
        if self.position_sigma is not None and self.direction is None:
            raise ValueError(
                "the position of the axis of the turntable has a sigma, but no direction is given"
            )
        return self

    def pose_of(self, row: int) -> str:
        """Pose of an image by its row."""
        return "" if self.pose is None else self.pose[row]


class Network1(Document):
    """``reseau-network/1``: the input of a bundle adjustment.

    Unknown coordinates and poses are null; `sigma` of a coordinate is 0 where it is held, null where it is
    free, and otherwise that of an observation.
    """

    SCHEMA: ClassVar[str] = "reseau-network/1"
    LEFT_OUT: ClassVar[dict[str, Any]] = {"exclude_none": True}
    unit: str
    cameras: tuple[AnyCamera, ...]
    images: ImageColumns
    points: PointColumns
    observations: ObservationColumns
    distances: DistanceColumns | None = None
    bases: BaseColumns | None = None
    datum: Literal["control", "minimal", "free"]
    datum_points: tuple[str, ...] | None = None
    refraction: RefractionEntry | None = None
    turntable: TurntableEntry | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        cameras = [camera.id for camera in self.cameras]
        for what, ids in (("cameras", cameras), ("images", self.images.id), ("points", self.points.id)):
            if (again := twice(ids)) is not None:
                raise ValueError(f"duplicate id {again!r} in `{what}`")
            if not ids:
                raise ValueError(f"the network has no {what}")
        images, points = set(self.images.id), set(self.points.id)
        _named("images.camera", self.images.camera, set(cameras), "cameras")
        _named("observations.image", self.observations.image, images, "images")
        _named("observations.point", self.observations.point, points, "points")
        if self.distances is not None:
            _named("distances.from", self.distances.from_, points, "points")
            _named("distances.to", self.distances.to, points, "points")
        if self.bases is not None:
            _named("bases.from", self.bases.from_, set(cameras), "cameras")
            _named("bases.to", self.bases.to, set(cameras), "cameras")
            if not any(self.images.exposure or ()):
                raise ValueError("`bases` require the exposures of the images")
        _named("datum_points", self.datum_points or (), points, "points")
        if self.turntable is not None:
            _named("turntable.image", self.turntable.image, images, "images")
        self._check_motion()
        self._check_points()
        self._check_observations()
        self._check_groups()
        if self.refraction is not None:
            try:
                self.refraction.refraction(self.images.id, self.images.camera)
            except UsageError as error:
                raise ValueError(str(error)) from None
        return self

    def _check_motion(self) -> None:
        moving = {c.id for c in self.cameras if isinstance(c, CameraEntry) and c.shutter is not None}
        columns = zip(self.images.id, self.images.camera, self.images.motion or (), strict=False)
        for image, camera, motion in columns:
            if motion is not None and camera not in moving:
                raise ValueError(f"image {image!r} has a motion, but camera {camera!r} has no `shutter`")

    def _check_points(self) -> None:
        for name, xyz, sigma, role in zip(
            self.points.id, self.points.xyz, self.points.sigma, self.points.role, strict=True
        ):
            if sigma is not None and any(s is not None and s < 0 for s in sigma):
                raise ValueError(f"point {name!r} has a negative sigma")
            if xyz is None and sigma is not None and any(s is not None for s in sigma):
                raise ValueError(f"point {name!r} has sigmas but no coordinates")
            if role == "check" and xyz is None:
                raise ValueError(f"check point {name!r} has no coordinates")

    def _check_observations(self) -> None:
        table = self.observations
        for k, (image, point, sx, sy) in enumerate(
            zip(table.image, table.point, table.sx, table.sy, strict=True)
        ):
            if sx <= 0 or sy <= 0:
                raise ValueError(f"point {point!r} in image {image!r}: its sigmas must be above zero")
            if table.rho is not None and not -1 < table.rho[k] < 1:
                raise ValueError(f"point {point!r} in image {image!r}: rho must be between -1 and 1")
        if (again := twice(zip(table.image, table.point, strict=True))) is not None:
            raise ValueError(f"point {again[1]!r} is observed twice in image {again[0]!r}")
        for columns, ends in ((self.distances, "points"), (self.bases, "cameras")):
            if columns is None:
                continue
            for a, b, length, sigma in zip(
                columns.from_, columns.to, columns.length, columns.sigma, strict=True
            ):
                if a == b or length <= 0 or sigma <= 0:
                    raise ValueError(
                        f"the distance from {a!r} to {b!r} needs two {ends}, a length and a sigma above zero"
                    )

    def _check_groups(self) -> None:
        per_group = {c.id for c in self.cameras if c.additional is not None and c.additional.per == "group"}
        groups = self.images.group or (None,) * len(self.images.id)
        for image, camera, group in zip(self.images.id, self.images.camera, groups, strict=True):
            if camera in per_group and group is None:
                raise ValueError(
                    f"image {image!r} has no group, but camera {camera!r} has parameters per group"
                )


def _known(name: str, names: Sequence[str]) -> str:
    if name not in names:
        raise ValueError(_not_known(name, names))
    return name


def _not_known(name: str, names: Sequence[str]) -> str:
    return f"{name!r} is not one of the models {', '.join(names)}"


def _named(column: str, names: Sequence[str], known: set[str], what: str) -> None:
    for name in names:
        if name not in known:
            raise ValueError(f"`{column}` contains {name!r}, which is not in `{what}`")
