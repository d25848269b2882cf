"""Cameras: from the ideal direction of a ray to its image point, and back.

A camera is a plane mapping whose first plane is that of the ideal directions u = xc/zc, v = yc/zc (camera
axes: x right, y down, z along the view) and whose second is the image. :mod:`reseau.optics.poses` puts it in
space.

Each model is one module: its parameters with units, its mapping with derivatives and inverse, a kernel for
the bundle adjustment, and its registration. Files, commands, adjustments and reports know the models by the
registry.
"""

# The order of the imports is the order of the registry.
from .brown import Brown, BrownDistortion, BrownWithAdditional  # isort: skip
from .opencv import OpenCV, opencv_coefficients  # isort: skip
from .projections import (  # isort: skip
    Division,
    DoubleSphere,
    EnhancedUnified,
    Equisolid,
    Fisheye,
    Omni,
    Orthographic,
    Stereographic,
)
from .telecentric import Telecentric  # isort: skip
from .openptv import OpenPtv  # isort: skip
from .line_scan import LineScan  # isort: skip
from .splined import SplinedStereographic, SplineGrid  # isort: skip
from .convert import Converted, convert, roughly
from .ebner import EbnerCorrection
from .grid import PixelGrid
from .registry import (
    AdditionalModel,
    CameraModel,
    Option,
    Parameter,
    additional_model,
    additional_models,
    camera_model,
    camera_models,
    default_camera_model,
    distortion_names,
    register_additional,
    register_camera,
    unit_of,
)
from .series import ChebyshevCorrection, FourierCorrection

__all__ = [
    "AdditionalModel",
    "Brown",
    "BrownDistortion",
    "BrownWithAdditional",
    "CameraModel",
    "ChebyshevCorrection",
    "Converted",
    "Division",
    "DoubleSphere",
    "EbnerCorrection",
    "EnhancedUnified",
    "Equisolid",
    "Fisheye",
    "FourierCorrection",
    "LineScan",
    "Omni",
    "OpenCV",
    "OpenPtv",
    "Option",
    "Orthographic",
    "Parameter",
    "PixelGrid",
    "SplineGrid",
    "SplinedStereographic",
    "Stereographic",
    "Telecentric",
    "additional_model",
    "additional_models",
    "camera_model",
    "camera_models",
    "convert",
    "default_camera_model",
    "distortion_names",
    "opencv_coefficients",
    "register_additional",
    "register_camera",
    "roughly",
    "unit_of",
]
