"""``frame-corners/1``, ``reseau-orientation/1``, ``reseau-roll/1``: the frame of a camera, the orientation of
a scan, and what became of the frames of a roll."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ..core.data import Array, ImagePoints, covariances_of
from .document import Document, Strict

CORNERS = ("ul", "ur", "lr", "ll")
"""Upper left, upper right, lower right, lower left: clockwise, as the frame is seen."""
EDGES = ("upper", "right", "lower", "left")
"""In the same order: edge k begins at corner k of `CORNERS`."""

Pair = tuple[float, float]


class CornerPositions(Strict):
    """Millimetres in the photo-coordinate system, x right, y up."""

    ul: Pair
    ur: Pair
    lr: Pair
    ll: Pair


class FrameCorners(Document):
    """``frame-corners/1``: the corners of a camera's frame as calibrated.

    Examples
    --------
    >>> frame = FrameCorners.from_xy([[-18, 12], [18, 12], [18, -12], [-18, -12]])
    >>> frame.corners.ur, frame.xy().shape
    ((18.0, 12.0), (4, 2))
    """

    SCHEMA: ClassVar[str] = "frame-corners/1"
    LEFT_OUT: ClassVar[dict[str, Any]] = {"exclude_none": True}
    unit: Literal["mm"] = "mm"
    corners: CornerPositions
    sigma: Pair | None = None

    @model_validator(mode="after")
    def _around(self) -> Self:
        xy = self.xy()
        side, following = np.roll(xy, -1, axis=0) - xy, np.roll(xy, -2, axis=0) - np.roll(xy, -1, axis=0)
        # With y up, upper left to upper right to lower right turns clockwise at each corner.
        if not (side[:, 0] * following[:, 1] - side[:, 1] * following[:, 0] < 0).all():
            raise ValueError("`corners` must run clockwise with y up: ul, ur, lr, ll")
        if self.sigma is not None and min(self.sigma) < 0:
            raise ValueError("`sigma` must not be negative")
        return self

    def xy(self) -> Array:
        """Return the corners in the order of `CORNERS`, (4, 2)."""
        return np.array([getattr(self.corners, name) for name in CORNERS], dtype=np.float64)

    @classmethod
    def from_xy(cls, xy: Array, sigma: Pair | None = None) -> Self:
        """Create the document from corners (4, 2) in the order of `CORNERS`."""
        named = {name: (float(x), float(y)) for name, (x, y) in zip(CORNERS, xy, strict=True)}
        return cls(corners=CornerPositions(**named), sigma=sigma)


class MeasuredCorner(Strict):
    """A point in the scan, pixels, with its standard deviations and correlation.

    Examples
    --------
    >>> MeasuredCorner.from_columns(np.array([10.5, 20.25]), np.diag([0.01, 0.04]))
    MeasuredCorner(x=10.5, y=20.25, sx=0.1, sy=0.2, rho=0.0)
    """

    x: float
    y: float
    sx: float = Field(ge=0)
    sy: float = Field(ge=0)
    rho: float = Field(ge=-1, le=1)

    @classmethod
    def from_columns(cls, xy: Array, cov: Array) -> Self:
        """Create a corner from coordinates (2,) and covariance (2, 2)."""
        sx, sy = (float(s) for s in np.sqrt(np.maximum(np.diagonal(cov), 0.0)))
        rho = float(np.clip(cov[0, 1] / (sx * sy), -1, 1)) if sx * sy > 0 else 0.0
        return cls(x=float(xy[0]), y=float(xy[1]), sx=sx, sy=sy, rho=rho)


def points_of(measured: Mapping[str, MeasuredCorner]) -> ImagePoints:
    """Measured points of a scan by name, with their covariances.

    Examples
    --------
    >>> points_of({"ul": MeasuredCorner(x=10.5, y=20.25, sx=0.1, sy=0.2, rho=0.0)}).sigma
    array([[0.1, 0.2]])
    """
    rows = [(c.x, c.y, c.sx, c.sy, c.rho) for c in measured.values()]
    x, y, *spread = np.array(rows, dtype=np.float64).reshape(-1, 5).T
    return ImagePoints(tuple(measured), np.stack([x, y], axis=1), covariances_of(*spread))


class FormatCandidate(Strict):
    """A format that a frame can be, width and height as it lies in the scan, with its probability.

    Examples
    --------
    >>> FormatCandidate(format_mm=(36.0, 24.0), probability=0.5).probability
    0.5
    """

    format_mm: Pair
    probability: float


class CurveCandidate(Strict):
    """A curve that grey values can have, its probability, and how far inwards it puts the edges (px).

    Inwards of their mean over all curves. It is decided by the edges of all frames of a roll.

    Examples
    --------
    >>> str(CurveCandidate(what="those of sRGB", probability=0.93, moved_px=0.02))
    'those of sRGB (probability 0.93)'
    """

    what: str
    probability: float
    moved_px: float

    def __str__(self) -> str:
        return f"{self.what} (probability {self.probability:.2f})"


class RivalEdge(Strict):
    """Second best explanation of what is seen at an edge: its probability, and what it moves inwards (px).

    Examples
    --------
    >>> RivalEdge(what="a line of the picture beside it", probability=0.07, moved_px=-0.6).probability
    0.07
    """

    what: str
    probability: float
    moved_px: float


class MeasuredEdge(Strict):
    """Quality of an edge: profiles used and rejected, their scatter, its bow, and what else it may be.

    Examples
    --------
    >>> MeasuredEdge(found=True, points=200, rejected=3, rms_px=0.21, curvature_px=0.4).why
    ''
    """

    found: bool
    points: int
    rejected: int
    rms_px: float | None
    curvature_px: float | None
    why: str = ""
    rival: RivalEdge | None = None


class FrameTransform(Strict):
    """Transformation of the scan to calibrated corners.

    `sigma_mm` and the parameters' sigmas are null where four corners leave no redundancy.

    Examples
    --------
    >>> shift = {"a": {"value": 0.0212, "sigma": None}}
    >>> left = {"ul": (0.001, -0.002)}
    >>> FrameTransform(kind="affine", parameters=shift, residuals_mm=left, sigma_mm=None).kind
    'affine'
    """

    kind: Literal["similarity", "affine", "projective", "bilinear"]
    parameters: dict[str, dict[str, float | None]]
    residuals_mm: dict[str, Pair]
    sigma_mm: Pair | None


class FrameOrientation(Document):
    """``reseau-orientation/1``: the inner orientation of a scanned frame, or why it was declined.

    The numbers of a declined frame are null. `angle_deg` is the direction of the photo x-axis, which
    runs along the lower edge, against the rows of the scan, positive counter-clockwise as seen.
    `roll_frames` is the number of frames of a roll whose shape was used; `frame` the number of the frame in a
    scan of several, in reading order; `formats` are those that it can be, if none was given; `curves` those
    that its grey values can have, if the file states none and they are not proportional to the light.

    Examples
    --------
    >>> FrameOrientation(
    ...     image="roll-07.tif", status="declined", why="the upper edge was not found", format_mm=None,
    ...     channel=None, corners=None, principal_point=None, angle_deg=None, angle_sigma_deg=None,
    ...     px_per_mm=None, edges={},
    ... ).image_points()
    <ImagePoints: points 0>
    """

    SCHEMA: ClassVar[str] = "reseau-orientation/1"
    image: str
    status: Literal["oriented", "three-edges", "declined"]
    why: str
    format_mm: Pair | None
    channel: str | None
    corners: dict[Literal["ul", "ur", "lr", "ll"], MeasuredCorner] | None
    principal_point: MeasuredCorner | None
    angle_deg: float | None
    angle_sigma_deg: float | None
    px_per_mm: Pair | None
    edges: dict[Literal["upper", "right", "lower", "left"], MeasuredEdge]
    transform: FrameTransform | None = None
    roll_frames: int | None = None
    frame: int | None = None
    formats: tuple[FormatCandidate, ...] = ()
    curves: tuple[CurveCandidate, ...] = ()

    @property
    def said(self) -> str:
        """What was wrong, and what grey values are taken as."""
        grey = f"grey values are taken as {' or '.join(map(str, self.curves))}" if self.curves else ""
        return "; ".join(part for part in (self.why, grey) if part)

    @model_validator(mode="after")
    def _whole(self) -> Self:
        numbers = (self.corners, self.principal_point, self.angle_deg, self.angle_sigma_deg)
        if self.status == "declined":
            if not self.why:
                raise ValueError("a declined frame needs a reason in `why`")
        elif any(n is None for n in numbers) or set(self.corners or ()) != set(CORNERS):
            raise ValueError(f"status {self.status!r} requires four corners, principal point and angle")
        return self

    def image_points(self) -> ImagePoints:
        """Return the corners in the scan with their covariances; empty for a declined frame."""
        corners = self.corners or {}
        return points_of({name: corners[name] for name in CORNERS if name in corners})

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the file; what is missing of the last fields is left out."""
        content = super().to_dict()
        for edge in content["edges"].values():
            if edge["rival"] is None:
                del edge["rival"]
        missing = [
            key for key in ("transform", "roll_frames", "frame", "formats", "curves") if not content[key]
        ]
        return {key: value for key, value in content.items() if key not in missing}


class FrameOutcome(Strict):
    """What became of one frame of a roll, or of a file that could not be read (status ``failed``).

    `name` is the stem of its output files, `sigma_px` the largest sigma of a corner's coordinate.

    Examples
    --------
    >>> FrameOutcome(image="07.tif", name="07", status="oriented").by_roll
    False
    """

    image: str
    name: str
    status: Literal["oriented", "three-edges", "declined", "failed"]
    why: str = ""
    by_roll: bool = False
    sigma_px: float | None = None

    @classmethod
    def of(cls, found: FrameOrientation, name: str) -> Self:
        """Create the outcome of a frame with an orientation, or of a declined one."""
        largest = max((max(c.sx, c.sy) for c in (found.corners or {}).values()), default=None)
        return cls(
            image=found.image, name=name, status=found.status, why=found.said, sigma_px=largest,
            by_roll=bool(found.roll_frames),
        )  # fmt: skip


class RollSummary(Document):
    """``reseau-roll/1``: what became of the frames of a roll.

    Examples
    --------
    >>> rows = [
    ...     FrameOutcome(image="07.tif", name="07", status="oriented", sigma_px=0.02),
    ...     FrameOutcome(image="08.tif", name="08", status="oriented", by_roll=True, sigma_px=0.1),
    ...     FrameOutcome(image="09.tif", name="09", status="declined", why="is of one tone"),
    ... ]
    >>> [count for count in RollSummary.of(rows).counts() if count[1]]
    [('oriented', 1), ('oriented with the help of the roll', 1), ('declined', 1)]
    """

    SCHEMA: ClassVar[str] = "reseau-roll/1"
    oriented: int
    helped: int
    three_edges: int
    declined: int
    failed: int
    frames: tuple[FrameOutcome, ...]

    @classmethod
    def of(cls, rows: Sequence[FrameOutcome]) -> Self:
        """Create the summary of outcomes."""
        number = {
            status: sum(row.status == status and not row.by_roll for row in rows) for status in _OUTCOMES
        }
        return cls(
            oriented=number["oriented"],
            helped=sum(row.status == "oriented" and row.by_roll for row in rows),
            three_edges=sum(row.status == "three-edges" for row in rows),
            declined=number["declined"],
            failed=number["failed"],
            frames=tuple(rows),
        )

    def counts(self) -> list[tuple[str, int]]:
        """Return what became of the frames in words, and of how many."""
        return [
            ("oriented", self.oriented),
            ("oriented with the help of the roll", self.helped),
            ("with three edges", self.three_edges),
            ("declined", self.declined),
            ("not read", self.failed),
        ]


_OUTCOMES = ("oriented", "declined", "failed")
