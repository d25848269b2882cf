"""Acquisition and calibration of measuring cameras and imaging instruments.

The packages, from the ground up: :mod:`reseau.adjust` (least squares), :mod:`reseau.optics` (image
formation), :mod:`reseau.refine` (one frame to refined image coordinates), :mod:`reseau.procedures` (one
module per published procedure), :mod:`reseau.report` (pages and figures).
"""

from .core.version import __version__

__all__ = ["__version__"]
