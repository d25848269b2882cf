"""From one frame to refined image coordinates."""

from .correction import CameraCorrection, CorrectionFit, correct_camera
from .field import SmoothField
from .fitting import fit_mapping, mapping_problem, reduce_mapping
from .matching import Matches, MatchOptions, match
from .reseau import ReseauOptions, ReseauResult, measure_reseau

__all__ = [
    "CameraCorrection",
    "CorrectionFit",
    "MatchOptions",
    "Matches",
    "ReseauOptions",
    "ReseauResult",
    "SmoothField",
    "correct_camera",
    "fit_mapping",
    "mapping_problem",
    "match",
    "measure_reseau",
    "reduce_mapping",
]
