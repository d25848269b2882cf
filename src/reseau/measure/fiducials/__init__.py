"""Fiducial marks of scanned aerial photographs: found by shape and pattern, measured with covariance."""

from .measure import measure_fiducials

__all__ = ["measure_fiducials"]
