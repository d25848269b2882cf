"""Adjustment of a network, search for a model, calibrations of the cameras."""

from .adjustment import Options, adjust_network, problem_of
from .calibration import calibration_of
from .search import (
    Kind,
    Selection,
    cross_validation,
    eliminate_parameters,
    estimate_components,
    reweighted,
    search_model,
)

__all__ = [
    "Kind",
    "Options",
    "Selection",
    "adjust_network",
    "calibration_of",
    "cross_validation",
    "eliminate_parameters",
    "estimate_components",
    "problem_of",
    "reweighted",
    "search_model",
]
