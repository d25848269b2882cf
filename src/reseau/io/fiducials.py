"""``fiducial-design/1`` and ``reseau-fiducials/1``: fiducial marks of a camera, orientation of a scan."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ..core.data import Array, ImagePoints, twice
from .document import Document, Strict
from .frame import FrameTransform, MeasuredCorner, points_of

Length = Annotated[float, Field(gt=0, le=1e4)]
_NEEDS = {
    "cross": ("line_width",),
    "disk": (),
    "square": (),
    "ring": ("line_width",),
    "arc": ("line_width", "from_deg", "to_deg"),
    "wedge": ("width",),
    "notch": ("width",),
}
"""Entries that each shape needs besides its size."""
_MAY = {"cross": ("gap",), "notch": ("form",)}
"""Entries that a shape may have."""


class MarkPart(Strict):
    """One part of a fiducial mark, in the unit of the design, with y up and the mark's point at (0, 0).

    Parameters
    ----------
    shape : str
        ``cross``: `size` from tip to tip, arms `line_width` wide along x and y, without its centre up to a
        diameter of `gap`. ``disk``: `size` is the diameter. ``square``: `size` is the side. ``ring``: `size`
        is the outer diameter, `line_width` its width. ``arc``: the part of a ring `from_deg` `to_deg`.
        ``wedge``: a triangle with its tip at the point, `size` high and `width` wide, which opens towards
        -y. ``notch``: the border of the picture, whose edge runs along x at y = -`size`, with a tooth of
        `width` at the edge; its tip (`form` V), or the centre of its half circle of diameter `width` (`form`
        round; the centre lies on the edge, and `size` is not used), is the point.
    at : (float, float)
        Centre of the part.
    turn_deg : float
        Rotation of the part about its centre, counter-clockwise.

    Examples
    --------
    >>> MarkPart(shape="cross", size=2.0, line_width=0.05, gap=0.4).at
    (0.0, 0.0)
    """

    shape: Literal["cross", "disk", "square", "ring", "arc", "wedge", "notch"]
    size: Length
    line_width: Length | None = None
    gap: Length | None = None
    width: Length | None = None
    form: Literal["V", "round"] | None = None
    from_deg: float | None = Field(default=None, ge=-360, le=360)
    to_deg: float | None = Field(default=None, ge=-360, le=720)
    at: tuple[float, float] = (0.0, 0.0)
    turn_deg: float = 0.0

    @model_validator(mode="after")
    def _complete(self) -> Self:
        needed, may = _NEEDS[self.shape], _MAY.get(self.shape, ())
        for name in ("line_width", "gap", "width", "form", "from_deg", "to_deg"):
            given = getattr(self, name) is not None
            if given and name not in needed + may:
                raise ValueError(f"a part of shape {self.shape!r} has no `{name}`")
            if not given and name in needed:
                raise ValueError(f"a part of shape {self.shape!r} needs `{name}`")
        if self.shape in ("ring", "arc") and 2 * (self.line_width or 0) >= self.size:
            raise ValueError("`line_width` must be less than half of `size`")
        if self.shape == "cross" and max(self.line_width or 0, self.gap or 0) >= self.size:
            raise ValueError("`line_width` and `gap` must be less than `size`")
        if self.shape == "arc" and not 0 < (self.to_deg or 0) - (self.from_deg or 0) < 360:
            raise ValueError("`to_deg` must be larger than `from_deg`, by less than 360")
        return self


class FiducialMark(Strict):
    """A kind of mark: the union of its parts, brighter or darker in the scan than what is around it.

    Parameters
    ----------
    polarity : {"bright", "dark"}
        As the scan shows it.
    parts : tuple of MarkPart
        Parts, which may overlap.
    margin : float, optional
        Width around the mark in which its background is even, in the unit of the design; by default 0.3 of
        its size.

    Examples
    --------
    A dot in a ring:

    >>> parts = (MarkPart(shape="disk", size=0.1), MarkPart(shape="ring", size=1.0, line_width=0.08))
    >>> FiducialMark(polarity="bright", parts=parts).margin is None
    True
    """

    polarity: Literal["bright", "dark"]
    parts: tuple[MarkPart, ...] = Field(min_length=1)
    margin: Length | None = None


class FiducialPoint(Strict):
    """A fiducial mark of a camera: calibrated coordinates (x right, y up), kind, and rotation of its mark.

    Examples
    --------
    >>> FiducialPoint(id="1", x=106.001, y=-106.003, sigma=0.002, mark="corner").turn_deg
    0.0
    """

    id: str = Field(min_length=1)
    x: float = Field(ge=-1e4, le=1e4)
    y: float = Field(ge=-1e4, le=1e4)
    sigma: float | None = Field(default=None, ge=0)
    mark: str
    turn_deg: float = 0.0


class FiducialDesign(Document):
    """``fiducial-design/1``: the fiducial marks of a camera, as its calibration report states them.

    Parameters
    ----------
    name : str
        The camera.
    source : str, optional
        Where the coordinates come from.
    unit : {"mm"}
        Unit of all lengths.
    marks : dict of str to FiducialMark
        Kinds of marks.
    points : tuple of FiducialPoint
        Three to 24 marks.
    extent : (float, float, float, float), optional
        Left, low, right and high end of the picture, to which images are resampled; by default all marks
        with 2 % around them.

    Examples
    --------
    >>> cross = FiducialMark(polarity="bright", parts=(MarkPart(shape="cross", size=2.0, line_width=0.05),))
    >>> places = {"1": (106, -106), "2": (-106, -106), "3": (-106, 106), "4": (106, 106)}
    >>> points = tuple(FiducialPoint(id=k, x=x, y=y, mark="cross") for k, (x, y) in places.items())
    >>> design = FiducialDesign(name="RC 10", marks={"cross": cross}, points=points)
    >>> design.xy.shape, FiducialDesign.parse(design.to_json(), where="rc10.json") == design
    ((4, 2), True)
    """

    SCHEMA: ClassVar[str] = "fiducial-design/1"
    LEFT_OUT: ClassVar[dict[str, Any]] = {"exclude_none": True}
    name: str
    source: str | None = None
    unit: Literal["mm"] = "mm"
    marks: dict[str, FiducialMark] = Field(min_length=1)
    points: tuple[FiducialPoint, ...] = Field(min_length=3, max_length=24)
    extent: tuple[float, float, float, float] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        ids = self.ids
        if (again := twice(ids)) is not None:
            raise ValueError(f"duplicate id {again!r} in `points`")
        for point in self.points:
            if point.mark not in self.marks:
                raise ValueError(f"point {point.id!r} has the mark {point.mark!r}, which is not in `marks`")
        xy = self.xy
        apart = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
        np.fill_diagonal(apart, np.inf)
        if apart.min() < 1.0:
            i, j = np.unravel_index(int(apart.argmin()), apart.shape)
            raise ValueError(f"points {ids[int(i)]!r} and {ids[int(j)]!r} are less than 1 mm apart")
        spread = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)
        if spread[1] < 0.05 * spread[0]:
            raise ValueError("`points` lie on one line, which determines no transformation")
        if self.extent is not None:
            left, low, right, high = self.extent
            if not (left < right and low < high):
                raise ValueError("`extent` must be left, low, right, high")
        return self

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the marks."""
        return tuple(point.id for point in self.points)

    @property
    def xy(self) -> Array:
        """Calibrated coordinates (n, 2)."""
        return np.array([(point.x, point.y) for point in self.points], dtype=np.float64)

    @property
    def sigma(self) -> Array:
        """Standard deviations of the calibrated coordinates (n,); 0 where the design has none."""
        return np.array([point.sigma or 0.0 for point in self.points], dtype=np.float64)


class MeasuredFiducial(Strict):
    """A fiducial mark in the scan, or why it was not measured.

    Examples
    --------
    >>> MeasuredFiducial(id="3", at=None, ok=False, why="covered").ok
    False
    """

    id: str
    at: MeasuredCorner | None
    ok: bool
    why: str = ""


class FiducialOrientation(Document):
    """``reseau-fiducials/1``: the inner orientation of a scanned photograph by its fiducial marks.

    The transformation maps scan coordinates (mm, origin in the centre of the scan, y up; x reversed where
    `mirrored`; turned by `rotation_deg` so that they are about parallel to those of the camera) to camera
    coordinates:  u = s·(x - x_c)/k, v = -(y - y_c)/k with k = `px_per_mm` and s = -1 where mirrored, then a
    rotation by -`rotation_deg`.

    Parameters
    ----------
    image, sha256 : str
        The scan.
    camera : str
        Name of the design.
    status : {"oriented", "declined"}
        Whether the transformation was determined.
    why : str
        What was wrong, and what would help.
    size : (int, int)
        Width and height of the scan.
    px_per_mm : float, optional
        Approximate scale, by which scan coordinates are defined.
    rotation_deg : int, optional
        0, 90, 180 or 270: rotation of the camera's x-axis in the scan, counter-clockwise as seen.
    mirrored : bool, optional
        Whether the scan shows the film from behind.
    marks : tuple of MeasuredFiducial
        All marks of the design.
    transform : FrameTransform, optional
        Transformation to the calibrated coordinates.
    covariance : tuple, optional
        Covariance matrix of its parameters.
    extent : (float, float, float, float), optional
        Left, low, right and high end of the picture, mm.
    notes, note_codes : tuple of str
        What to know about the result, and the same for programs.

    Examples
    --------
    >>> FiducialOrientation(
    ...     image="7.tif", sha256="", camera="RC 10", status="declined", why="no marks", size=(900, 900),
    ...     marks=()).image_points()
    <ImagePoints: points 0>
    """

    SCHEMA: ClassVar[str] = "reseau-fiducials/1"
    image: str
    sha256: str
    camera: str
    status: Literal["oriented", "declined"]
    why: str
    size: tuple[int, int]
    px_per_mm: float | None = None
    rotation_deg: Literal[0, 90, 180, 270] | None = None
    mirrored: bool | None = None
    marks: tuple[MeasuredFiducial, ...]
    transform: FrameTransform | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None
    extent: tuple[float, float, float, float] | None = None
    notes: tuple[str, ...] = ()
    note_codes: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _whole(self) -> Self:
        numbers = (self.px_per_mm, self.rotation_deg, self.mirrored, self.transform, self.extent)
        if self.status == "declined":
            if not self.why:
                raise ValueError("a declined photograph needs a reason in `why`")
        elif any(n is None for n in numbers):
            raise ValueError("status 'oriented' requires scale, rotation, transformation and extent")
        return self

    def image_points(self) -> ImagePoints:
        """Return the measured marks with their covariances."""
        return points_of({m.id: m.at for m in self.marks if m.ok and m.at is not None})

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the file; what is not known is left out."""
        return {name: value for name, value in super().to_dict().items() if value is not None}
