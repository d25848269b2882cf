"""Adjustment of a network, search for a model, calibrations of the cameras."""

from .adjustment import Options, adjust_network, problem_of
from .board import BoardChoice, BoardModel, choose_board, held_as_designed
from .calibration import calibration_of, with_estimates
from .candidates import Candidate, camera_candidates
from .choice import Compared, ModelChoice, choose_model, choose_models
from .one_station import RotationOnly, rotation_only
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
    "BoardChoice",
    "BoardModel",
    "Candidate",
    "Compared",
    "Kind",
    "ModelChoice",
    "Options",
    "RotationOnly",
    "Selection",
    "adjust_network",
    "calibration_of",
    "camera_candidates",
    "choose_board",
    "choose_model",
    "choose_models",
    "cross_validation",
    "eliminate_parameters",
    "estimate_components",
    "held_as_designed",
    "problem_of",
    "reweighted",
    "rotation_only",
    "search_model",
    "with_estimates",
]
