"""Bundle adjustment: orientation, calibration and object points, with their quality."""

from __future__ import annotations

from .diagnostics.between import sigma_between_images
from .diagnostics.fields import (
    FieldDifference,
    ProjectionField,
    calibration_difference,
    projection_field,
    projection_field_at,
)
from .diagnostics.lens import Lens
from .diagnostics.patterns import CommonPattern, by_place, by_point, common_pattern
from .diagnostics.result import Result
from .document import searched_document, to_document
from .modelling.adjustment import Options, adjust_network, problem_of
from .modelling.calibrated import UNITS, calibration_of
from .modelling.components import Kind, estimate_components, reweighted
from .modelling.model_search import Searched, search_model
from .network import Additional, Camera, ControlPoints, Network
from .network.stage import Stage
from .solver.approximate import Approximate, approximate
from .solver.problem import BundleFit, BundleProblem

__all__ = [
    "UNITS",
    "Additional",
    "Approximate",
    "BundleFit",
    "BundleProblem",
    "Camera",
    "CommonPattern",
    "ControlPoints",
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
