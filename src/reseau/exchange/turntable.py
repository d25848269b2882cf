"""Angles of a turntable as a table, CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import ValidationError

from ..core.errors import FormatError
from ..io import read_text
from ..io.network import TurntableEntry
from .control import full_rows, number_of, table_rows

_COLUMNS = ["image", "angle_deg", "sigma_deg", "pose"]


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
    if header[:2] != _COLUMNS[:2] or header != [name for name in _COLUMNS if name in header]:
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
