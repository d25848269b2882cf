"""Calibrations of cameras in the files of other programs, written and read.

A format is one module: which registered camera models it holds, how it is written, recognised and read. A
camera whose model a format lacks is converted, with the differences over the image stated.
"""

from .formats import calibration_formats, export_calibration

__all__ = ["calibration_formats", "export_calibration"]
