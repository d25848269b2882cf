"""Readers that recognise the kind of a file by its content or suffix: designs, image coordinates."""

from __future__ import annotations

from pathlib import Path

from ..core.provenance import sha256_of
from .board import BoardDesign
from .design import ReseauDesign
from .document import read_text
from .measurement import ReseauMeasurement
from .testfield import TestfieldDesign, parse_design


def read_design(path: Path | str) -> ReseauDesign | TestfieldDesign | BoardDesign:
    """Read the design of a target, of either schema.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it is not a design.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.designs import standard_reseau
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     standard_reseau().write(Path(folder) / "reseau.json")
    ...     len(read_design(Path(folder) / "reseau.json").ids)
    165
    """
    return parse_design(read_text(Path(path)), where=path)


def is_points(path: Path | str) -> bool:
    """Return whether a file contains image coordinates rather than an image, by its suffix.

    Examples
    --------
    >>> is_points("marks.json"), is_points("photo.tif")
    (True, False)
    """
    return Path(path).suffix.lower() in (".json", ".csv")


def read_measurement(path: Path | str) -> ReseauMeasurement:
    """Read image coordinates: ``reseau-measurement/1``, or a CSV ``id,x,y[,sx,sy]``.

    Raises
    ------
    InputError
        When the file cannot be read.
    FormatError
        When it contains no image coordinates.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = (Path(folder) / "marks.csv").write_text("\\n".join(["id,x,y", "A1,100.25,80.5"]))
    ...     read_measurement(Path(folder) / "marks.csv").points[0].x
    100.25
    """
    path = Path(path)
    if path.suffix.lower() == ".csv":
        return ReseauMeasurement.read_csv(path, sha256=sha256_of(path))
    return ReseauMeasurement.read(path)
