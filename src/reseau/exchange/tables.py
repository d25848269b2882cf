"""Tables: control points with known object coordinates, and angles of a turntable."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from ..bundle.network.network import ControlPoints
from ..core.errors import FormatError
from ..io import read_text
from ..io.network import TurntableEntry
from .lines import is_number

_COLUMNS = ["id", "x", "y", "z", "sx", "sy", "sz"]


def read_control(path: Path | str) -> ControlPoints:
    r"""Read control points from a table ``id,x,y,z[,sx,sy,sz]``.

    Fields are separated by commas, semicolons or blanks; a header may be left out; what follows ``#`` or
    ``%`` is a comment. Without standard deviations, or where they are 0, coordinates are held. An empty
    field leaves its coordinate free.

    Parameters
    ----------
    path : Path or str
        The file.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When the header is wrong, a point appears twice, a field is not a number, or a sigma is negative.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "control.csv"
    ...     _ = path.write_text("id,x,y,z,sx,sy,sz\nA,0,0,0,0,0,0\nB,100,0,,0.1,0.1,\n")
    ...     control = read_control(path)
    >>> control.names, control.sigma
    (('A', 'B'), array([[0. , 0. , 0. ],
           [0.1, 0.1, nan]]))
    """
    path = Path(path)
    lines = table_rows(read_text(path))
    header = [word.lower() for word in lines[0][1]] if lines else []
    if lines and header not in (_COLUMNS[:4], _COLUMNS) and len(header) in (4, 7) and is_number(header[1]):
        header = _COLUMNS[: len(header)]
    elif header in (_COLUMNS[:4], _COLUMNS):
        lines = lines[1:]
    else:
        raise FormatError(
            "is not a table of control points", where=path, do="start with the header id,x,y,z[,sx,sy,sz]"
        )
    names, rows = list[str](), list[list[float]]()
    for where, line in full_rows(lines, header, path):
        name = line[0].strip()
        if name in names:
            raise FormatError(f"point {name} appears twice", where=where)
        names.append(name)
        rows.append([number_of(word, where) for word in line[1:]])
    if not names:
        raise FormatError("contains no points", where=path)
    values = np.array(rows, dtype=np.float64)
    sigma = values[:, 3:] if len(header) == len(_COLUMNS) else np.zeros_like(values)
    sigma = np.where(np.isnan(values[:, :3]), np.nan, sigma)
    if (sigma < 0).any():
        name = names[int(np.flatnonzero((sigma < 0).any(axis=1))[0])]
        raise FormatError(f"the sigma of point {name} is negative", where=path)
    return ControlPoints(tuple(names), values[:, :3], sigma)


def full_rows(
    lines: list[tuple[int, list[str]]], header: list[str], path: Path
) -> Iterator[tuple[str, list[str]]]:
    """Rows of a table with their places; each must have as many fields as the header.

    Raises
    ------
    FormatError
        When one has not.
    """
    for number, line in lines:
        where = f"{path}, line {number}"
        if len(line) != len(header):
            raise FormatError(f"has {len(line)} fields, not {len(header)}", where=where)
        yield where, line


def table_rows(text: str) -> list[tuple[int, list[str]]]:
    """Return line numbers and fields; separated by commas, semicolons or blanks, without comments."""
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.split("#")[0].split("%")[0]
        if not line.strip():
            continue
        mark = "," if "," in line else ";" if ";" in line else None
        fields = next(csv.reader([line], delimiter=mark)) if mark else line.split()
        if any(field.strip() for field in fields):
            rows.append((number, [field.strip() for field in fields]))
    return rows


def number_of(word: str, where: str) -> float:
    """Return the number of a field of a table; NaN where it is empty."""
    if not word.strip():
        return float("nan")
    try:
        value = float(word)
    except ValueError:
        raise FormatError(f"{word.strip()!r} is not a number", where=where) from None
    if not np.isfinite(value):
        raise FormatError(f"{word.strip()!r} is not a number", where=where)
    return value


_ANGLES = ["image", "angle_deg", "sigma_deg", "pose"]


def read_turntable(path: Path | str) -> TurntableEntry:
    r"""Read angles of a turntable from a table ``image,angle_deg[,sigma_deg[,pose]]``.

    Fields are separated by commas, semicolons or blanks; what follows ``#`` or ``%`` is a comment. The angle
    of an image is known where its sigma is 0, observed where it is above, and approximate only where it is
    empty or not in the table. Images with the same pose differ by their angles only; by default all have one.

    Parameters
    ----------
    path : Path or str
        The file.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When the header is wrong, an image appears twice, a field is not a number, or a sigma is negative.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "angles.csv"
    ...     _ = path.write_text("image,angle_deg,sigma_deg\na.png,0,0.01\nb.png,30,0.01\n")
    ...     read_turntable(path).angle_deg
    (0.0, 30.0)
    """
    path = Path(path)
    lines = table_rows(read_text(path))
    header = [word.strip().lower() for word in lines[0][1]] if lines else []
    if header[:2] != _ANGLES[:2] or header != [name for name in _ANGLES if name in header]:
        raise FormatError(
            "is not a table of angles", where=path,
            do="start with the header image,angle_deg[,sigma_deg][,pose]",
        )  # fmt: skip
    columns: dict[str, list[str | float | None]] = {name: [] for name in header}
    for where, line in full_rows(lines[1:], header, path):
        for name, word in zip(header, line, strict=True):
            if name in ("image", "pose"):
                columns[name].append(word.strip())
                continue
            value = number_of(word, where)
            columns[name].append(None if np.isnan(value) else value)
    columns.setdefault("sigma_deg", [None] * len(columns["image"]))
    try:
        return TurntableEntry.model_validate({name: tuple(column) for name, column in columns.items()})
    except ValidationError as error:
        raise FormatError(error.errors()[0]["msg"].removeprefix("Value error, "), where=path) from None
