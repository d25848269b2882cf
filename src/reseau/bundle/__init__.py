"""Bundle adjustment: orientation, calibration and object points, with their quality."""

from __future__ import annotations

from .adjustment import Options, adjust_network, problem_of
from .approximate import Approximate, approximate
from .calibrated import calibration_of
from .document import to_document
from .network import Additional, Camera, Network
from .problem import BundleFit, BundleProblem
from .result import Result

__all__ = [
    "Additional",
    "Approximate",
    "BundleFit",
    "BundleProblem",
    "Camera",
    "Network",
    "Options",
    "Result",
    "adjust_network",
    "approximate",
    "calibration_of",
    "problem_of",
    "to_document",
]
