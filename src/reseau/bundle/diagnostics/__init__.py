"""Results of an adjusted network: estimates, residual patterns, uncertainty over the image, warnings."""

from .checks import checks
from .control_check import ControlCheck, ControlShape, checked_control, control_shape
from .estimates import (
    CameraEstimate,
    ImageEstimates,
    MotionEstimates,
    PointEstimates,
    PriorInfluence,
    RefractionEstimate,
    RigEstimate,
    StageEstimate,
)
from .fields import camera_mapping, projection_field_at
from .patterns import CommonPattern, by_place, by_point, common_pattern
from .regularisation import Regularised, regularised
from .result import Eliminated, Result
from .target_part import covariance_by_targets

__all__ = [
    "CameraEstimate",
    "CommonPattern",
    "ControlCheck",
    "ControlShape",
    "Eliminated",
    "ImageEstimates",
    "MotionEstimates",
    "PointEstimates",
    "PriorInfluence",
    "RefractionEstimate",
    "Regularised",
    "Result",
    "RigEstimate",
    "StageEstimate",
    "by_place",
    "by_point",
    "camera_mapping",
    "checked_control",
    "checks",
    "common_pattern",
    "control_shape",
    "covariance_by_targets",
    "projection_field_at",
    "regularised",
]
