"""Control points in a table: known object coordinates."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from ..bundle import ControlPoints
from ..core.errors import FormatError
from ..io import read_text

__all__ = ["read_control"]

_COLUMNS = ["id", "x", "y", "z", "sx", "sy", "sz"]


def read_control(path: Path | str) -> ControlPoints:
    r"""Read control points from a CSV file ``id,x,y,z[,sx,sy,sz]`` with a header.

    Without standard deviations, or where they are 0, coordinates are held. An empty field leaves its
    coordinate free.

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
    lines = [line for line in csv.reader(read_text(path).splitlines()) if any(word.strip() for word in line)]
    header = [word.strip().lower() for word in lines[0]] if lines else []
    if header not in (_COLUMNS[:4], _COLUMNS):
        raise FormatError(
            "is not a table of control points", where=path, do="start with the header id,x,y,z[,sx,sy,sz]"
        )
    names, rows = list[str](), list[list[float]]()
    for number, line in enumerate(lines[1:], start=2):
        where = f"{path}, line {number}"
        if len(line) != len(header):
            raise FormatError(f"has {len(line)} fields, not {len(header)}", where=where)
        name = line[0].strip()
        if name in names:
            raise FormatError(f"point {name} appears twice", where=where)
        names.append(name)
        rows.append([_number(word, where) for word in line[1:]])
    if not names:
        raise FormatError("contains no points", where=path)
    values = np.array(rows, dtype=np.float64)
    sigma = values[:, 3:] if len(header) == len(_COLUMNS) else np.zeros_like(values)
    sigma = np.where(np.isnan(values[:, :3]), np.nan, sigma)
    if (sigma < 0).any():
        name = names[int(np.flatnonzero((sigma < 0).any(axis=1))[0])]
        raise FormatError(f"the sigma of point {name} is negative", where=path)
    return ControlPoints(tuple(names), values[:, :3], sigma)


def _number(word: str, where: str) -> float:
    if not word.strip():
        return float("nan")
    try:
        value = float(word)
    except ValueError:
        raise FormatError(f"{word.strip()!r} is not a number", where=where) from None
    if not np.isfinite(value):
        raise FormatError(f"{word.strip()!r} is not a number", where=where)
    return value
