"""``fiducial-design/1`` and ``reseau-fiducials/1``: fiducial marks of a camera, orientation of a scan."""

from __future__ import annotations

import csv
from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from ..core.data import Array, ImagePoints, twice
from ..core.errors import FormatError
from .document import Document, Strict, read_text
from .frame import FrameTransform, MeasuredCorner, points_of

Length = Annotated[float, Field(gt=0, le=1e4)]
Place = tuple[float, float]
_NEEDS = {
    "cross": ("size", "line_width"),
    "bar": ("size", "line_width"),
    "disk": ("size",),
    "square": ("size",),
    "ring": ("size", "line_width"),
    "arc": ("size", "from_deg", "to_deg"),
    "wedge": ("size", "width"),
    "notch": ("size", "width"),
    "polygon": ("corners",),
}
"""Entries that each shape needs."""
_MAY = {"cross": ("gap", "arms_deg"), "arc": ("line_width",), "notch": ("form",)}
"""Entries that a shape may have."""
_ENTRIES = ("size", "line_width", "gap", "arms_deg", "width", "form", "from_deg", "to_deg", "corners")


class MarkPart(Strict):
    """One part of a fiducial mark, in the unit of the design, with y up and the mark's point at (0, 0).

    Parameters
    ----------
    shape : str
        ``cross``: `size` from tip to tip, arms `line_width` wide in the directions `arms_deg` (by default
        0, 90, 180 and 270), without its centre up to a diameter of `gap`. ``bar``: `size` long along x,
        `line_width` wide. ``disk``: `size` is the diameter. ``square``: `size` is the side. ``ring``: `size`
        is the outer diameter, `line_width` its width. ``arc``: the part of a ring `from_deg` `to_deg`;
        without `line_width` the sector of a disk, as a half disk. ``wedge``: a triangle with its tip at the
        point, `size` high and `width` wide, which opens towards -y. ``notch``: the border of the picture,
        whose edge runs along x at y = -`size`, with a tooth of `width` at the edge; its tip (`form` V), or
        the centre of its half circle of diameter `width` (`form` round; the centre lies on the edge, and
        `size` is not used), is the point. ``polygon``: any outline by its `corners`.
    at : (float, float)
        Centre of the part.
    turn_deg : float
        Rotation of the part about its centre, counter-clockwise.
    use : {"mark", "cut", "ignore"}
        Whether the part belongs to the mark, is taken away from the parts before it, or shows an area, such
        as that of a number, whose content is not known and not used.

    Examples
    --------
    An arrow that points down, of a wedge and its stem:

    >>> head = MarkPart(shape="wedge", size=1.0, width=0.8, turn_deg=180.0)
    >>> stem = MarkPart(shape="bar", size=2.0, line_width=0.2, at=(0.0, 2.0), turn_deg=90.0)
    >>> FiducialMark(polarity="bright", parts=(head, stem)).parts[1].use
    'mark'
    """

    shape: Literal["cross", "bar", "disk", "square", "ring", "arc", "wedge", "notch", "polygon"]
    size: Length | None = None
    line_width: Length | None = None
    gap: Length | None = None
    arms_deg: tuple[float, ...] | None = Field(default=None, min_length=2, max_length=24)
    width: Length | None = None
    form: Literal["V", "round"] | None = None
    from_deg: float | None = Field(default=None, ge=-360, le=360)
    to_deg: float | None = Field(default=None, ge=-360, le=720)
    corners: tuple[Place, ...] | None = Field(default=None, min_length=3, max_length=500)
    at: Place = (0.0, 0.0)
    turn_deg: float = 0.0
    use: Literal["mark", "cut", "ignore"] = "mark"

    @model_validator(mode="after")
    def _complete(self) -> Self:
        needed, may = _NEEDS[self.shape], _MAY.get(self.shape, ())
        for name in _ENTRIES:
            given = getattr(self, name) is not None
            if given and name not in needed + may:
                raise ValueError(f"a part of shape {self.shape!r} has no `{name}`")
            if not given and name in needed:
                raise ValueError(f"a part of shape {self.shape!r} needs `{name}`")
        size = self.size or 0.0
        if self.shape in ("ring", "arc") and 2 * (self.line_width or 0) >= size:
            raise ValueError("`line_width` must be less than half of `size`")
        if self.shape == "cross" and max(self.line_width or 0, self.gap or 0) >= size:
            raise ValueError("`line_width` and `gap` must be less than `size`")
        if self.shape == "arc" and not 0 < (self.to_deg or 0) - (self.from_deg or 0) < 360:
            raise ValueError("`to_deg` must be larger than `from_deg`, by less than 360")
        turns = np.sort(np.array(self.arms_deg or (0.0, 90.0)) % 360)
        if np.diff(turns, append=turns[0] + 360).min() < 1:
            raise ValueError("`arms_deg` must differ by 1 degree at least")
        x, y = np.array(self.corners or ((0, 0), (1, 0), (0, 1)), dtype=np.float64).T
        if abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) < 1e-9:
            raise ValueError("`corners` enclose no area")
        return self


class LearntMark(Strict):
    """The image of a mark in a scan, which serves as its model.

    Parameters
    ----------
    values : tuple of tuple of int
        Grey values above those of the surroundings, in thousandths of the mark's contrast: one tuple a row.
    at : (float, float)
        The mark's point in the image: column and row of its first pixel are 0.
    covariance : (float, float, float)
        Variances in x and y and covariance of that point, px², which all marks of the kind share.
    linear : ((float, float), (float, float))
        From the plane of the mark (mm, y up) to pixels of the image (y down).
    reach : float
        Radius around the point within which the image is used, pixels.
    noise : float
        Standard deviation of a pixel of the image, in thousandths.
    source : str
        The scan.

    Examples
    --------
    >>> spot = LearntMark(values=((0, 0, 0), (0, 1000, 0), (0, 0, 0)), at=(1.0, 1.0),
    ...     covariance=(0.01, 0.01, 0.0), linear=((10.0, 0.0), (0.0, -10.0)), reach=1.5, noise=10.0,
    ...     source="7.tif")
    >>> round(spot.px_per_mm, 6)
    10.0
    """

    values: tuple[tuple[int, ...], ...] = Field(min_length=3, max_length=1000)
    at: Place
    covariance: tuple[float, float, float]
    linear: tuple[Place, Place]
    reach: Length
    noise: float = Field(ge=0)
    source: str

    @model_validator(mode="after")
    def _rectangular(self) -> Self:
        if len({len(row) for row in self.values}) != 1 or len(self.values[0]) < 3:
            raise ValueError("`values` need rows of one length, of 3 at least")
        if not self.px_per_mm > 0:
            raise ValueError("`linear` has no inverse")
        if min(self.covariance[0], self.covariance[1]) < 0 or self.covariance[2] ** 2 > (
            self.covariance[0] * self.covariance[1]
        ):
            raise ValueError("`covariance` must be positive semidefinite")
        return self

    @property
    def px_per_mm(self) -> float:
        """Scale of the image."""
        return float(np.sqrt(abs(np.linalg.det(np.array(self.linear)))))


class FiducialMark(Strict):
    """A kind of mark: the union of its parts, brighter or darker in the scan than what is around it.

    Parameters
    ----------
    polarity : {"bright", "dark"}
        As a scan shows it; in a negative of it the other way round.
    parts : tuple of MarkPart
        Parts, which may overlap.
    margin : float, optional
        Width around the mark in which its background is even, in the unit of the design; by default 0.3 of
        its size.
    learnt : LearntMark, optional
        The image of a mark in a scan, in place of parts.

    Examples
    --------
    A dot in a ring:

    >>> parts = (MarkPart(shape="disk", size=0.1), MarkPart(shape="ring", size=1.0, line_width=0.08))
    >>> FiducialMark(polarity="bright", parts=parts).margin is None
    True
    """

    polarity: Literal["bright", "dark"]
    parts: tuple[MarkPart, ...] = ()
    margin: Length | None = None
    learnt: LearntMark | None = None

    @model_validator(mode="after")
    def _one_model(self) -> Self:
        if (self.learnt is None) != any(part.use == "mark" for part in self.parts):
            raise ValueError("a mark needs either `parts`, one at least of use 'mark', or `learnt`")
        return self

    def reversed(self) -> FiducialMark:
        """The mark as a negative shows it."""
        return self.model_copy(update={"polarity": "dark" if self.polarity == "bright" else "bright"})


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

    @classmethod
    def read_csv(cls, path: Path | str, shown: Collection[str] = ()) -> Self:
        """Read a camera from a table ``id,x,y[,sigma][,mark][,turn_deg]``, to learn its marks.

        Parameters
        ----------
        path : Path or str
            The table, mm.
        shown : collection of str
            Marks from which kinds will be learnt. Without the column ``mark`` each of them is a kind of its
            own, and all others are of the kind of the first.

        Returns
        -------
        FiducialDesign
            The camera, with dots for marks.

        Raises
        ------
        InputError
            When the file cannot be read.
        FormatError
            When a column or a number is missing; the message names the line.
        """
        lines = csv.DictReader(read_text(Path(path)).splitlines(), strict=True)
        columns = [column.strip() for column in lines.fieldnames or []]
        lines.fieldnames = columns
        may = ["sigma", "mark", "turn_deg"]
        if columns[:3] != ["id", "x", "y"] or not set(columns[3:]) <= set(may):
            raise FormatError("the first line must be `id,x,y[,sigma][,mark][,turn_deg]`", where=path)
        first, points = next(iter(shown), "mark"), []
        for row in lines:
            try:
                numbers = {key: float(row[key]) for key in columns if key not in ("id", "mark")}
                name = row["id"].strip()
                kind = row["mark"].strip() if "mark" in columns else name if name in shown else first
                points.append(FiducialPoint(id=name, mark=kind, **numbers))
            except (ValueError, TypeError, AttributeError):
                text = ",".join(str(value) for value in row.values())[:60]
                raise FormatError(
                    f"line {lines.line_num}: `{text}` is not `{','.join(columns)}`", where=path
                ) from None
        dot = FiducialMark(polarity="bright", parts=(MarkPart(shape="disk", size=1.0),))
        try:
            marks = {point.mark: dot for point in points}
            return cls(name=Path(path).stem, marks=marks, points=tuple(points))
        except ValidationError as error:
            raise FormatError(error.errors()[0]["msg"].removeprefix("Value error, "), where=path) from None

    def reversed(self) -> FiducialDesign:
        """The design as negatives show it."""
        marks = {name: mark.reversed() for name, mark in self.marks.items()}
        return self.model_copy(update={"marks": marks})

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
    negative : bool, optional
        Whether the scan shows bright marks of the design dark, and dark ones bright.
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
    negative: bool | None = None
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
