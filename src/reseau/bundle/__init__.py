"""Bundle adjustment: orientation, calibration and object points, with their quality."""

from __future__ import annotations

from .adjustment import Options, adjust_network, problem_of
from .approximate import Approximate, approximate
from .calibrated import calibration_of
from .components import estimate_components, reweighted
from .document import to_document
from .fields import (
    FieldDifference,
    ProjectionField,
    calibration_difference,
    projection_field,
    projection_field_at,
)
from .lens import Lens
from .network import Additional, Camera, Network
from .patterns import CommonPattern, by_place, by_point, common_pattern
from .problem import BundleFit, BundleProblem
from .result import Result

__all__ = [
    "Additional",
    "Approximate",
    "BundleFit",
    "BundleProblem",
    "Camera",
    "CommonPattern",
    "FieldDifference",
    "Lens",
    "Network",
    "Options",
    "ProjectionField",
    "Result",
    "adjust_network",
    "approximate",
    "by_place",
    "by_point",
    "calibration_difference",
    "calibration_of",
    "common_pattern",
    "estimate_components",
    "problem_of",
    "projection_field",
    "projection_field_at",
    "reweighted",
    "to_document",
]
