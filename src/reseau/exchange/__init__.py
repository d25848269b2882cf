"""Read networks and control points from files of this project and of other programs."""

from __future__ import annotations

from .bal import read_bal
from .colmap import read_colmap
from .control import read_control
from .networks import calibration_files, read_foreign, read_network
from .photomodeler import read_photomodeler

__all__ = [
    "calibration_files",
    "read_bal",
    "read_colmap",
    "read_control",
    "read_foreign",
    "read_network",
    "read_photomodeler",
]
