"""Bundle adjustment: orientation, calibration and object points, with their quality."""

from __future__ import annotations

from .diagnostics import (
    CameraEstimate,
    CommonPattern,
    Eliminated,
    ImageEstimates,
    PointEstimates,
    Result,
    by_place,
    by_point,
    camera_mapping,
    common_pattern,
    projection_field_at,
    sigma_between_images,
)
from .document import ResultDocument, model_search_entries
from .modelling import (
    Kind,
    Options,
    Selection,
    adjust_network,
    calibration_of,
    cross_validation,
    eliminate_parameters,
    estimate_components,
    problem_of,
    reweighted,
    search_model,
)
from .network import Additional, Camera, ControlPoints, Network, Stage, example_network
from .solver import Approximate, BundleFit, BundleProblem, approximate

__all__ = [
    "Additional",
    "Approximate",
    "BundleFit",
    "BundleProblem",
    "Camera",
    "CameraEstimate",
    "CommonPattern",
    "ControlPoints",
    "Eliminated",
    "ImageEstimates",
    "Kind",
    "Network",
    "Options",
    "PointEstimates",
    "Result",
    "ResultDocument",
    "Selection",
    "Stage",
    "adjust_network",
    "approximate",
    "by_place",
    "by_point",
    "calibration_of",
    "camera_mapping",
    "common_pattern",
    "cross_validation",
    "eliminate_parameters",
    "estimate_components",
    "example_network",
    "model_search_entries",
    "problem_of",
    "projection_field_at",
    "reweighted",
    "search_model",
    "sigma_between_images",
]
