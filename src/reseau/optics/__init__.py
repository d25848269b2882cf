"""Image formation: cameras, distortions, displays, sensors and target images."""

from .additional import EbnerCorrection
from .arcs import Arcs
from .cameras import Brown, OpenCV, PixelGrid
from .composition import Chain, Identity, Inverted, Similarity
from .displays import DecenteredDisplay, wong_display
from .distortions import BrownDistortion
from .mapping import Derivatives, Mapping, PlaneMapping
from .polynomials import RationalPolynomial
from .poses import (
    Pose,
    Projection,
    angles_to_matrix,
    matrix_to_angles,
    matrix_to_vector,
    project,
    rotate,
    rotation_matrix,
)
from .sensor import Sensor, illumination, jpeg, sigma_of_snr, snr_db

__all__ = [
    "Arcs",
    "Brown",
    "BrownDistortion",
    "Chain",
    "DecenteredDisplay",
    "Derivatives",
    "EbnerCorrection",
    "Identity",
    "Inverted",
    "Mapping",
    "OpenCV",
    "PixelGrid",
    "PlaneMapping",
    "Pose",
    "Projection",
    "RationalPolynomial",
    "Sensor",
    "Similarity",
    "angles_to_matrix",
    "illumination",
    "jpeg",
    "matrix_to_angles",
    "matrix_to_vector",
    "project",
    "rotate",
    "rotation_matrix",
    "sigma_of_snr",
    "snr_db",
    "wong_display",
]
