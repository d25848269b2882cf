"""Fiducial marks of scanned aerial photographs: found by shape and pattern, measured with covariance."""

from .measure import FiducialOptions, measure_fiducials
from .result import FiducialResult
from .search import Attitude

__all__ = ["Attitude", "FiducialOptions", "FiducialResult", "measure_fiducials"]
