"""Errors taken out of image coordinates: the camera's (group A), and those of what it looks at (group B)."""

from .camera import CameraCorrection, CorrectionFit, correct_camera, unit_of
from .causes import CAUSES, COEFFICIENTS, CONDITIONS, Causes, causes_of, physical_causes
from .instrument import InstrumentCorrection, InstrumentFit, correct_instrument
from .registration import Registration, register
from .resampled import CorrectedImage, write_corrected
from .rivals import Rivalry, leave_one_out, rivals
from .standard import StandardTest, still_standard

__all__ = [
    "CAUSES",
    "COEFFICIENTS",
    "CONDITIONS",
    "CameraCorrection",
    "Causes",
    "CorrectedImage",
    "CorrectionFit",
    "InstrumentCorrection",
    "InstrumentFit",
    "Registration",
    "Rivalry",
    "StandardTest",
    "causes_of",
    "correct_camera",
    "correct_instrument",
    "leave_one_out",
    "physical_causes",
    "register",
    "rivals",
    "still_standard",
    "unit_of",
    "write_corrected",
]
