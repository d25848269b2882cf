"""Diagnostics of an adjusted network: result, residual patterns, uncertainty over the image, checks."""

from .checks import checks, listed
from .control_check import doubtful_control
from .fields import camera_mapping, projection_field_at
from .image_scatter import sigma_between_images
from .patterns import CommonPattern, by_place, by_point, common_pattern
from .result import Result

__all__ = [
    "CommonPattern",
    "Result",
    "by_place",
    "by_point",
    "camera_mapping",
    "checks",
    "common_pattern",
    "doubtful_control",
    "listed",
    "projection_field_at",
    "sigma_between_images",
]
