"""Bundle adjustment: orientation, calibration and object points, with their quality."""

from __future__ import annotations

from .diagnostics.estimates import PriorInfluence
from .diagnostics.regularisation import regularised
from .diagnostics.result import Result
from .document import ResultDocument
from .explanations import explain
from .modelling.adjustment import Options, adjust_network, problem_of
from .modelling.board import choose_board
from .modelling.calibration import calibration_of
from .modelling.candidates import Candidate
from .modelling.choice import choose_model, choose_models
from .modelling.one_station import rotation_only
from .modelling.search import estimate_components, search_model
from .network.calibrated import calibrated_camera, film_camera
from .network.camera import Camera
from .network.example import example_network
from .network.network import Network
from .network.stage import Stage

__all__ = [
    "Camera",
    "Candidate",
    "Network",
    "Options",
    "PriorInfluence",
    "Result",
    "ResultDocument",
    "Stage",
    "adjust_network",
    "calibrated_camera",
    "calibration_of",
    "choose_board",
    "choose_model",
    "choose_models",
    "estimate_components",
    "example_network",
    "explain",
    "film_camera",
    "problem_of",
    "regularised",
    "rotation_only",
    "search_model",
]
