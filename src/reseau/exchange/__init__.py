"""Networks, calibrations, control points, marks of film, lenses: our files and those of other programs."""

from __future__ import annotations

from .bal import read_bal, write_bal
from .boards import read_board, read_target
from .bundler import read_bundler
from .calibrations import (
    any_calibration,
    export_calibration,
    export_calibrations,
    export_rig,
    import_calibration,
)
from .codev import read_codev
from .colmap import read_colmap, write_colmap
from .control import read_control
from .dbat import read_dbat
from .film import FilmMarks, film_files, metashape_script, read_film_marks, read_micmac, write_micmac
from .lenses import Lens, read_lens
from .libmv import read_libmv
from .metashape import read_metashape
from .networks import calibration_files, read_foreign, read_network, write_network
from .openptv import read_openptv
from .photomodeler import read_photomodeler
from .turntable import read_turntable
from .zemax import read_zemax

__all__ = [
    "FilmMarks",
    "Lens",
    "any_calibration",
    "calibration_files",
    "export_calibration",
    "export_calibrations",
    "export_rig",
    "film_files",
    "import_calibration",
    "metashape_script",
    "read_bal",
    "read_board",
    "read_bundler",
    "read_codev",
    "read_colmap",
    "read_control",
    "read_dbat",
    "read_film_marks",
    "read_foreign",
    "read_lens",
    "read_libmv",
    "read_metashape",
    "read_micmac",
    "read_network",
    "read_openptv",
    "read_photomodeler",
    "read_target",
    "read_turntable",
    "read_zemax",
    "write_bal",
    "write_colmap",
    "write_micmac",
    "write_network",
]
