"""Fiducial marks of scanned aerial photographs: found by shape and pattern, measured with covariance."""

from .measure import FiducialOptions, FiducialResult, measure_fiducials
from .search import Attitude

__all__ = ["Attitude", "FiducialOptions", "FiducialResult", "measure_fiducials"]
