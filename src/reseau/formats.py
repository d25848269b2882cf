"""The documents that others exchange with us, and the one way they are read and written.

A document is a strict pydantic model: an unknown key is an error that names it, a missing one likewise. A
file appears whole or not at all.
"""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from .data import Array, ImagePoints, Mask
from .errors import FormatError, InputError
from .provenance import canonical_json

__all__ = [
    "Document",
    "Mark",
    "MeasuredPoint",
    "ReseauDesign",
    "ReseauMeasurement",
    "Strict",
    "read_text",
    "write_whole",
]


class Strict(BaseModel):
    """A part of a document: no unknown key, no coercion of types, no NaN."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


def read_text(path: Path) -> str:
    """Text of a UTF-8 file of less than 1 GB.

    Raises
    ------
    InputError
        When it cannot be read, is too large or is no UTF-8.
    """
    try:
        if path.stat().st_size > 1_000_000_000:
            raise InputError("is larger than 1 GB", where=path)
        return path.read_text("utf-8")
    except UnicodeDecodeError:
        raise InputError("is no UTF-8 text", where=path, do="is this the file you meant?") from None
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path) from None


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file that appears whole or not at all.

    Raises
    ------
    InputError
        When the folder does not exist or cannot be written to.
    """
    data = content.encode("utf-8") if isinstance(content, str) else content
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with draft.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        draft.replace(path)
    except OSError as error:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
        raise InputError(f"cannot be written ({error.strerror})", where=path) from None


def _one_line(error: ValidationError) -> str:
    """Say the first complaint of pydantic in one line, and how many more there are."""
    complaints = error.errors(include_url=False, include_context=False)
    first = complaints[0]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
    text = {
        "extra_forbidden": f"unknown key `{key}`",
        "missing": f"missing key `{key}`",
    }.get(first["type"])
    if text is None:
        message = first["msg"].removeprefix("Value error, ")
        text = f"`{key}`: {message}" if key else message
    more = len(complaints) - 1
    return text + (f" (and {more} more)" if more else "")


class Document(Strict):
    """A JSON file with a ``schema`` key first.

    Subclasses set `SCHEMA`, as in ``reseau-design/1``.
    """

    SCHEMA: ClassVar[str]

    @classmethod
    def parse(cls, text: str, *, where: object) -> Self:
        """Read a document from JSON text; `where` names it in messages.

        Raises
        ------
        FormatError
            When it is no JSON, or not this document.
        """
        try:
            content = json.loads(text)
        except (json.JSONDecodeError, RecursionError) as error:
            raise FormatError(f"is no JSON ({error})", where=where) from None
        found = content.pop("schema", None) if isinstance(content, dict) else None
        if found != cls.SCHEMA:
            kind = "has no key `schema`" if found is None else f"has the schema {found!r}"
            raise FormatError(f"{kind}; {cls.SCHEMA!r} was expected", where=where)
        try:
            # As JSON again: pydantic's strict mode takes a JSON array for a tuple, but not a Python list.
            return cls.model_validate_json(json.dumps(content))
        except ValidationError as error:
            raise FormatError(_one_line(error), where=where) from None

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read a document from a file.

        Raises
        ------
        InputError
            When the file cannot be read.
        FormatError
            When it is not this document.
        """
        return cls.parse(read_text(Path(path)), where=path)

    def to_dict(self) -> dict[str, Any]:
        """The content as it stands in the file, ``schema`` first."""
        return {"schema": self.SCHEMA} | self.model_dump(mode="json")

    def to_json(self) -> str:
        """The file's text: same content, same bytes."""
        return canonical_json(self.to_dict())

    def write(self, path: Path | str) -> None:
        """Write the document, whole or not at all.

        Raises
        ------
        InputError
            When the place cannot be written to.
        """
        write_whole(Path(path), self.to_json())


class Mark(Strict):
    """What every mark of a design looks like, in the unit of the design."""

    shape: Literal["cross", "disk", "square", "line-grid", "rod"]
    size: float | None = Field(default=None, gt=0)
    line_width: float | None = Field(default=None, gt=0)


class DesignPoint(Strict):
    """One mark of a design: coordinates in its plane, and where in the image it may be expected."""

    id: str = Field(min_length=1)
    x: float | None
    y: float | None
    sigma: float | None = Field(default=None, ge=0)
    nominal_px: tuple[float, float] | None = None


class ReseauDesign(Document):
    """``reseau-design/1``: a reseau, or the rods of a test object."""

    SCHEMA: ClassVar[str] = "reseau-design/1"
    name: str
    unit: str
    mark: Mark
    polarity: Literal["dark", "bright"]
    origin: str | None = None
    axis: str | None = None
    points: tuple[DesignPoint, ...]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.points:
            raise ValueError("the design has no points")
        names = set()
        for point in self.points:
            if point.id in names:
                raise ValueError(f"the id {point.id!r} stands twice among the points")
            names.add(point.id)
            if (point.x is None) != (point.y is None):
                raise ValueError(f"point {point.id!r} has only one of its two coordinates")
        for role in ("origin", "axis"):
            named = getattr(self, role)
            if named is not None and named not in names:
                raise ValueError(f"`{role}` names {named!r}, which is none of the points")
        if self.origin is not None and self.origin == self.axis:
            raise ValueError(f"`origin` and `axis` both name {self.origin!r}; they must differ")
        return self

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the points."""
        return tuple(point.id for point in self.points)

    @property
    def xy(self) -> Array:
        """Coordinates in the plane of the design, (n, 2); NaN where unknown."""
        return np.array([(p.x, p.y) for p in self.points], dtype=np.float64).reshape(-1, 2)

    @property
    def nominal_px(self) -> Array:
        """Prior positions in the image, (n, 2); NaN where there is none."""
        return np.array([p.nominal_px or (np.nan, np.nan) for p in self.points], dtype=np.float64)


class MeasuredPoint(Strict):
    """One mark as it was, or was not, measured; sigmas in pixels."""

    id: str
    x: float | None = None
    y: float | None = None
    sx: float | None = None
    sy: float | None = None
    rho: float | None = None
    ok: bool
    why: str = ""


class ReseauMeasurement(Document):
    """``reseau-measurement/1``: image coordinates of marks, and why some have none."""

    SCHEMA: ClassVar[str] = "reseau-measurement/1"
    image: str
    sha256: str
    unit: Literal["px"] = "px"
    points: tuple[MeasuredPoint, ...]
    found: int
    expected: int

    def image_points(self) -> ImagePoints:
        """The marks that were measured.

        A point without sigmas gets those of a coordinate known to one pixel.
        """
        ok = [p for p in self.points if p.ok and p.x is not None and p.y is not None]
        xy = np.array([(p.x, p.y) for p in ok], dtype=np.float64).reshape(-1, 2)
        s = np.array([(p.sx or 1.0, p.sy or 1.0) for p in ok], dtype=np.float64).reshape(-1, 2)
        cov = np.zeros((len(ok), 2, 2))
        cov[:, 0, 0], cov[:, 1, 1] = s[:, 0] ** 2, s[:, 1] ** 2
        cov[:, 0, 1] = cov[:, 1, 0] = np.array([p.rho or 0.0 for p in ok]) * s[:, 0] * s[:, 1]
        return ImagePoints(tuple(p.id for p in ok), xy, cov)

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
    ) -> Self:
        """Marks as columns: those that are not `ok` have the reason and no coordinates."""
        points = []
        for i, name in enumerate(ids):
            if not ok[i]:
                points.append(MeasuredPoint(id=name, ok=False, why=why[i]))
                continue
            sx, sy = np.sqrt(np.diagonal(cov[i]))
            points.append(
                MeasuredPoint(
                    id=name,
                    x=float(xy[i, 0]),
                    y=float(xy[i, 1]),
                    sx=float(sx),
                    sy=float(sy),
                    rho=float(cov[i, 0, 1] / (sx * sy)),
                    ok=True,
                )
            )
        return cls(
            image=image, sha256=sha256, points=tuple(points), found=int(ok.sum()), expected=len(points)
        )

    @classmethod
    def from_image_points(cls, points: ImagePoints, *, image: str, sha256: str) -> Self:
        """Points that were all measured, by us or by another."""
        s = points.sigma
        rho = points.cov[:, 0, 1] / (s[:, 0] * s[:, 1])
        measured = tuple(
            MeasuredPoint(id=name, x=float(x), y=float(y), sx=float(a), sy=float(b), rho=float(r), ok=True)
            for name, (x, y), (a, b), r in zip(points.names, points.xy, s, rho, strict=True)
        )
        return cls(image=image, sha256=sha256, points=measured, found=len(measured), expected=len(measured))

    @classmethod
    def read_csv(cls, path: Path | str, *, sha256: str = "") -> Self:
        """Read ``id,x,y[,sx,sy]``: coordinates measured by hand or by another program.

        Raises
        ------
        InputError
            When the file cannot be read.
        FormatError
            When a column or a number is missing; the message names the line.
        """
        lines = csv.reader(read_text(Path(path)).splitlines())
        header = [column.strip() for column in next(lines, [])]
        if header not in (["id", "x", "y"], ["id", "x", "y", "sx", "sy"]):
            raise FormatError("the first line must be `id,x,y` or `id,x,y,sx,sy`", where=path)
        points: list[MeasuredPoint] = []
        for number, cells in enumerate(lines, start=2):
            if not cells:
                continue
            try:
                x, y, *sigma = (float(cell) for cell in cells[1:])
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
                raise FormatError(f"line {number}: the id {name!r} stands twice", where=path)
            sx, sy = sigma or (None, None)
            points.append(MeasuredPoint(id=name, x=x, y=y, sx=sx, sy=sy, ok=True))
        if not points:
            raise FormatError("holds no points", where=path)
        return cls(
            image=Path(path).name,
            sha256=sha256,
            points=tuple(points),
            found=len(points),
            expected=len(points),
        )
