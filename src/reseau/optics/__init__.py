"""Image formation: cameras, distortions, displays, sensors and target images."""

from .cameras import Brown, OpenCV, PixelGrid
from .composition import Chain, Identity, Inverted, Similarity
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

__all__ = [
    "Brown",
    "BrownDistortion",
    "Chain",
    "Derivatives",
    "Identity",
    "Inverted",
    "Mapping",
    "OpenCV",
    "PixelGrid",
    "PlaneMapping",
    "Pose",
    "Projection",
    "RationalPolynomial",
    "Similarity",
    "angles_to_matrix",
    "matrix_to_angles",
    "matrix_to_vector",
    "project",
    "rotate",
    "rotation_matrix",
]
