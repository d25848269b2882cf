"""``reseau-measurement/1``: image coordinates of marks, measured by this or another program."""

from __future__ import annotations

import base64
import csv
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import model_validator

from ..core.data import Array, ImagePoints, Mask, covariances_of, sigmas_of
from ..core.errors import FormatError, UsageError
from ..core.failure import Code, Failure, Remark
from .document import Document, Strict, read_text

_COLUMNS = ("x", "y", "sx", "sy", "rho")


class MeasuredPoint(Strict):
    """One mark, measured or not; sigmas in pixels.

    Of a slanted wire, `share` is the place of the cut on its segment, 0 at its start and 1 at its end, and
    `s_share` its standard deviation.

    Examples
    --------
    >>> MeasuredPoint(id="A1", x=100.25, y=80.5, sx=0.02, sy=0.02, rho=0.0, ok=True).x
    100.25
    >>> MeasuredPoint(id="A2", ok=False, why="outside the image").x is None
    True
    """

    id: str
    x: float | None = None
    y: float | None = None
    sx: float | None = None
    sy: float | None = None
    rho: float | None = None
    ok: bool
    why: str = ""
    share: float | None = None
    s_share: float | None = None


class ReseauMeasurement(Document):
    """``reseau-measurement/1``: image coordinates of marks, and why others were not measured.

    Examples
    --------
    >>> points = ImagePoints.with_sigma(["A1", "A2"], [[100.25, 80.5], [130.0, 80.75]], 0.02)
    >>> measured = ReseauMeasurement.from_image_points(points, image="photo.tif", sha256="")
    >>> measured.found, measured.image_points().xy.tolist()
    (2, [[100.25, 80.5], [130.0, 80.75]])
    """

    SCHEMA: ClassVar[str] = "reseau-measurement/1"
    image: str
    sha256: str
    unit: Literal["px"] = "px"
    points: tuple[MeasuredPoint, ...]
    found: int
    expected: int
    notes: tuple[str, ...] = ()
    note_codes: tuple[str, ...] = ()
    candidates: tuple[str, ...] = ()
    """Points that were measured, but whose names are not certain: all of them may be shifted."""

    def to_dict(self) -> dict[str, Any]:
        """Return the content of the file; optional keys are left out where there is nothing to say."""
        content = super().to_dict()
        for key in ("notes", "note_codes", "candidates"):
            if not content[key]:
                del content[key]
        for point in content["points"]:
            if point["share"] is None:
                del point["share"], point["s_share"]
        return content

    def image_points(self, *, uncertain: bool = False) -> ImagePoints:
        """Return the marks that were measured; also those with `uncertain` names.

        A point without sigmas gets sigmas of one pixel.
        """
        more = set(self.candidates) if uncertain else set()
        ok = [p for p in self.points if (p.ok or p.id in more) and p.x is not None and p.y is not None]
        rows = [(p.x, p.y, p.sx or 1.0, p.sy or 1.0, p.rho or 0.0) for p in ok]
        x, y, *spread = np.array(rows, dtype=np.float64).reshape(-1, 5).T
        return ImagePoints(tuple(p.id for p in ok), np.stack([x, y], axis=1), covariances_of(*spread))

    @classmethod
    def from_columns(
        cls,
        image: str,
        sha256: str,
        ids: Sequence[str],
        xy: Array,
        cov: Array,
        ok: Mask,
        why: Sequence[str],
        notes: Sequence[Remark] = (),
        candidates: Mask | None = None,
    ) -> Self:
        """Create the document from columns; marks that are not `ok` have a reason.

        Coordinates are those of marks that are `ok`, and of `candidates`, whose names are not certain.
        """
        unsure = np.zeros(len(ids), dtype=bool) if candidates is None else candidates
        rows = np.column_stack([xy, *sigmas_of(cov)]).tolist()
        points = [
            MeasuredPoint(id=name, ok=bool(ok[i]), why=why[i], **dict(zip(_COLUMNS, row, strict=True)))
            if ok[i] or unsure[i]
            else MeasuredPoint(id=name, ok=False, why=why[i])
            for i, (name, row) in enumerate(zip(ids, rows, strict=True))
        ]
        return cls(
            image=image,
            sha256=sha256,
            points=tuple(points),
            found=int(ok.sum()),
            expected=len(points),
            notes=tuple(note.text for note in notes),
            note_codes=tuple(note.code.value for note in notes),
            candidates=tuple(name for name, one in zip(ids, unsure, strict=True) if one),
        )

    @classmethod
    def from_image_points(cls, points: ImagePoints, *, image: str, sha256: str) -> Self:
        """Create the document from measured points."""
        count = len(points)
        return cls.from_columns(
            image, sha256, points.names, points.xy, points.cov, np.ones(count, dtype=bool), [""] * count
        )

    @classmethod
    def read_csv(cls, path: Path | str, *, sha256: str = "") -> Self:
        """Read ``id,x,y[,sx,sy][,ok,why]``: coordinates measured by hand or by another program.

        The last columns are those that ``reseau apply`` writes of points outside the validity; points that
        have no position there are left out.

        Raises
        ------
        InputError
            When the file cannot be read.
        FormatError
            When a column or a number is missing; the message names the line.
        """
        lines = csv.reader(read_text(Path(path)).splitlines())
        header = [column.strip() for column in next(lines, [])]
        judged = header[-2:] == ["ok", "why"]
        numbers = header[1:-2] if judged else header[1:]
        if header[:1] != ["id"] or numbers not in (["x", "y"], ["x", "y", "sx", "sy"]):
            raise FormatError("the first line must be `id,x,y` or `id,x,y,sx,sy`", where=path)
        points: list[MeasuredPoint] = []
        for number, cells in enumerate(lines, start=2):
            if not cells or (judged and cells[-2:-1] == ["0"] and cells[1:3] == ["nan", "nan"]):
                continue
            try:
                x, y, *sigma = (float(cell) for cell in cells[1 : 1 + len(numbers)])
                if (
                    len(cells) != len(header)
                    or not np.isfinite([x, y, *sigma]).all()
                    or min([1.0, *sigma]) <= 0
                ):
                    raise ValueError
            except ValueError:
                raise FormatError(
                    f"line {number}: `{','.join(cells)[:60]}` is not `{','.join(header)}`", where=path
                ) from None
            name = cells[0].strip()
            if any(p.id == name for p in points):
                raise FormatError(f"line {number}: duplicate id {name!r}", where=path)
            sx, sy = sigma or (None, None)
            points.append(MeasuredPoint(id=name, x=x, y=y, sx=sx, sy=sy, ok=True))
        if not points:
            raise FormatError("contains no points", where=path)
        return cls(
            image=Path(path).name,
            sha256=sha256,
            points=tuple(points),
            found=len(points),
            expected=len(points),
        )


class PointColumns(Strict):
    """Image points in columns: names (n), coordinates (n, 2) and covariance matrices (n, 2, 2) in pixels.

    The numbers are text as they are in memory: float64, little endian, base64. Decimal digits of a thousand
    points take longer to write and read than a tenth of their measurement.

    Examples
    --------
    >>> points = ImagePoints.with_sigma(["A1"], [[100.25, 80.5]], 0.02)
    >>> PointColumns.of(points).xy
    'AAAAAAAQWUAAAAAAACBUQA=='
    >>> PointColumns.of(points).image_points().xy.tolist()
    [[100.25, 80.5]]
    """

    names: tuple[str, ...]
    xy: str
    cov: str

    @classmethod
    def of(cls, points: ImagePoints) -> Self:
        """Return the columns of image points."""
        return cls(names=points.names, xy=_packed(points.xy), cov=_packed(points.cov))

    def image_points(self) -> ImagePoints:
        """Return the image points.

        Raises
        ------
        UsageError
            When the columns differ in length.
        """
        n = len(self.names)
        return ImagePoints(self.names, _unpacked(self.xy, n, 2), _unpacked(self.cov, n, 2, 2))

    @model_validator(mode="after")
    def _whole(self) -> Self:
        try:
            points = self.image_points()
        except (ValueError, UsageError):
            raise ValueError("columns that are damaged or of different lengths") from None
        if not (np.isfinite(points.xy).all() and np.isfinite(points.cov).all()):
            raise ValueError("numbers that are not finite")
        return self


def _packed(values: Array) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f8").tobytes()).decode("ascii")


def _unpacked(text: str, *shape: int) -> Array:
    data = base64.b64decode(text, validate=True)
    if len(data) != 8 * math.prod(shape):
        raise UsageError(f"{len(data)} bytes for {shape} numbers")
    return np.frombuffer(data, "<f8").astype(np.float64).reshape(shape)


class PhotographPoints(Document):
    """``reseau-photograph-points/1``: what was measured in a photograph of a target, or why nothing was.

    Unlike ``reseau-measurement/1`` it gives the image points back to the last bit.

    Examples
    --------
    >>> points = ImagePoints.with_sigma(["A1"], [[100.25, 80.5]], 0.02)
    >>> PhotographPoints.of(points, size=(640, 480)).image_points().xy.tolist()
    [[100.25, 80.5]]
    """

    SCHEMA: ClassVar[str] = "reseau-photograph-points/1"
    size: tuple[int, int] | None
    points: PointColumns | None
    why: str = ""
    code: str = ""
    notes: tuple[str, ...] = ()
    certain: bool = True

    def to_json(self) -> str:
        """Return the content of the file in one line: there is one for each photograph of a large number."""
        return json.dumps(self.to_dict(), ensure_ascii=False, allow_nan=False) + "\n"

    @classmethod
    def of(
        cls,
        found: ImagePoints | Failure,
        size: tuple[int, int] | None = None,
        notes: Sequence[str] = (),
        certain: bool = True,
    ) -> Self:
        """Create the document from image points, or from the reason why there are none."""
        if isinstance(found, Failure):
            return cls(size=size, points=None, why=found.reason, code=str(found.code), notes=tuple(notes))
        return cls(size=size, points=PointColumns.of(found), notes=tuple(notes), certain=certain)

    def image_points(self, where: str = "") -> ImagePoints | Failure:
        """Return the image points, or the failure of a photograph of this name."""
        if self.points is None:
            return Failure(self.why, Code(self.code), where=where)
        return self.points.image_points()
