"""Bundle adjustment: orientation, calibration and object points, with their quality."""

from __future__ import annotations

from .adjustment import Options, adjust_network, problem_of
from .approximate import Approximate, approximate
from .between import sigma_between_images
from .calibrated import UNITS, calibration_of
from .components import Kind, estimate_components, reweighted
from .document import searched_document, to_document
from .fields import (
    FieldDifference,
    ProjectionField,
    calibration_difference,
    projection_field,
    projection_field_at,
)
from .lens import Lens
from .model_search import Searched, search_model
from .network import Additional, Camera, Network
from .patterns import CommonPattern, by_place, by_point, common_pattern
from .problem import BundleFit, BundleProblem
from .result import Result
from .stage import Stage

__all__ = [
    "UNITS",
    "Additional",
    "Approximate",
    "BundleFit",
    "BundleProblem",
    "Camera",
    "CommonPattern",
    "FieldDifference",
    "Kind",
    "Lens",
    "Network",
    "Options",
    "ProjectionField",
    "Result",
    "Searched",
    "Stage",
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
    "search_model",
    "searched_document",
    "sigma_between_images",
    "to_document",
]
