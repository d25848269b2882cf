"""Networks, control points and marks of film: files of this project and of other programs."""

from __future__ import annotations

from .bal import read_bal
from .colmap import read_colmap
from .control import read_control
from .film import FilmMarks, metashape_script, read_film_marks, read_micmac, write_micmac
from .networks import calibration_files, read_foreign, read_network
from .photomodeler import read_photomodeler

__all__ = [
    "FilmMarks",
    "calibration_files",
    "metashape_script",
    "read_bal",
    "read_colmap",
    "read_control",
    "read_film_marks",
    "read_foreign",
    "read_micmac",
    "read_network",
    "read_photomodeler",
    "write_micmac",
]
