"""Bundle adjustment: orientation, calibration and object points, with their quality."""

from __future__ import annotations

from .diagnostics import (
    CommonPattern,
    Result,
    by_place,
    by_point,
    camera_mapping,
    common_pattern,
    projection_field_at,
    sigma_between_images,
)
from .document import searched_document, to_document
from .modelling.adjustment import Options, adjust_network, problem_of
from .modelling.calibration import calibration_of
from .modelling.components import Kind, estimate_components, reweighted
from .modelling.model_search import Searched, search_model
from .network import Additional, Camera, ControlPoints, Network, Stage
from .solver import Approximate, BundleFit, BundleProblem, approximate

__all__ = [
    "Additional",
    "Approximate",
    "BundleFit",
    "BundleProblem",
    "Camera",
    "CommonPattern",
    "ControlPoints",
    "Kind",
    "Network",
    "Options",
    "Result",
    "Searched",
    "Stage",
    "adjust_network",
    "approximate",
    "by_place",
    "by_point",
    "calibration_of",
    "camera_mapping",
    "common_pattern",
    "estimate_components",
    "problem_of",
    "projection_field_at",
    "reweighted",
    "search_model",
    "searched_document",
    "sigma_between_images",
    "to_document",
]
