"""Calibrations of cameras in the files of other programs, written and read.

A format is one module: which registered camera models it holds, how it is written, recognised and read. A
camera whose model a format lacks is converted, with the differences over the image stated.
"""

from .formats import (
    CalibrationFormat,
    Exported,
    any_calibration,
    calibration_formats,
    export_calibration,
    export_calibrations,
    export_rig,
    exported_lens,
    formats_holding,
    import_calibration,
)
from .plain import Mounted, PlainCamera

__all__ = [
    "CalibrationFormat",
    "Exported",
    "Mounted",
    "PlainCamera",
    "any_calibration",
    "calibration_formats",
    "export_calibration",
    "export_calibrations",
    "export_rig",
    "exported_lens",
    "formats_holding",
    "import_calibration",
]
