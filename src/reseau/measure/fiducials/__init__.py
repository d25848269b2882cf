"""Fiducial marks of scanned photographs: found by shape and pattern, learnt, measured with covariance."""

from .learning import learn_marks
from .measure import measure_fiducials

__all__ = ["learn_marks", "measure_fiducials"]
