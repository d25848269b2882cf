"""Networks in files of other programs."""

from __future__ import annotations

from pathlib import Path

from ..bundle import Network
from ..core.errors import FormatError, InputError
from ..io import read_text
from .bal import read_bal
from .colmap import read_colmap
from .control import read_control
from .photomodeler import read_photomodeler

__all__ = ["read_bal", "read_colmap", "read_control", "read_foreign", "read_photomodeler"]


def read_foreign(path: Path | str) -> Network:
    """A network of another program, told apart by what the file holds.

    Parameters
    ----------
    path : Path or str
        Text export of PhotoModeler, a BAL file, or a folder of COLMAP's text files.

    Raises
    ------
    InputError
        When it cannot be read.
    FormatError
        When it is none of these.
    """
    path = Path(path)
    if path.is_dir():
        return read_colmap(path)
    if not path.exists():
        raise InputError("does not exist", where=path)
    lines = read_text(path).splitlines()
    first = lines[0].split() if lines else []
    if len(first) == 3 and all(word.isdigit() for word in first):
        return read_bal(path)
    if len(lines) > 4 and len(lines[1].split()) == 4 and len(lines[3].split()) == 10:
        return read_photomodeler(path)
    raise FormatError(
        "is no network of a program known here",
        where=path,
        do="give reseau-network/1, PhotoModeler, BAL, COLMAP",
    )
