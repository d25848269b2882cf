"""Image formation: cameras, distortions, displays, sensors and target images."""

from .arcs import Arcs
from .cameras import (
    Brown,
    BrownDistortion,
    CameraModel,
    EbnerCorrection,
    OpenCV,
    PixelGrid,
    additional_model,
    additional_models,
    camera_model,
    camera_models,
    convert,
)
from .composition import Chain, Identity, Inverted, Similarity
from .displays import DecenteredDisplay, wong_display
from .equidistant import Equidistant
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
from .refraction import RefractedRays, Refraction, RefractiveIndex, Window, window_parameters
from .sensor import Sensor, illumination, jpeg, sigma_of_snr, snr_db

__all__ = [
    "Arcs",
    "Brown",
    "BrownDistortion",
    "CameraModel",
    "Chain",
    "DecenteredDisplay",
    "Derivatives",
    "EbnerCorrection",
    "Equidistant",
    "Identity",
    "Inverted",
    "Mapping",
    "OpenCV",
    "PixelGrid",
    "PlaneMapping",
    "Pose",
    "Projection",
    "RationalPolynomial",
    "RefractedRays",
    "Refraction",
    "RefractiveIndex",
    "Sensor",
    "Similarity",
    "Window",
    "additional_model",
    "additional_models",
    "angles_to_matrix",
    "camera_model",
    "camera_models",
    "convert",
    "illumination",
    "jpeg",
    "matrix_to_angles",
    "matrix_to_vector",
    "project",
    "rotate",
    "rotation_matrix",
    "sigma_of_snr",
    "snr_db",
    "window_parameters",
    "wong_display",
]
