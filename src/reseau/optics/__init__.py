"""Image formation: cameras, distortions, displays, sensors and target images."""

from .arcs import Arcs
from .cameras import convert
from .cameras.brown import Brown
from .cameras.grid import PixelGrid
from .cameras.opencv import OpenCV
from .cameras.registry import additional_models, camera_model, camera_models
from .equidistant import Equidistant
from .polynomials import RationalPolynomial
from .poses import Pose, matrix_to_vector, project, rotation_matrix
from .refraction.windows import Refraction
from .sensor import Sensor, illumination, snr_db

__all__ = [
    "Arcs",
    "Brown",
    "Equidistant",
    "OpenCV",
    "PixelGrid",
    "Pose",
    "RationalPolynomial",
    "Refraction",
    "Sensor",
    "additional_models",
    "camera_model",
    "camera_models",
    "convert",
    "illumination",
    "matrix_to_vector",
    "project",
    "rotation_matrix",
    "snr_db",
]
