"""Networks, calibrations, control points, marks of film, lenses: our files and those of other programs."""

from __future__ import annotations

from .calibrations import export_calibration
from .lenses import read_lens
from .networks import read_network

__all__ = ["export_calibration", "read_lens", "read_network"]
