"""Correction of image coordinates for errors of the camera (group A) and the instrument (group B)."""

from .camera import CorrectionFit, FittedCamera, correct_camera
from .causes import CAUSES, COEFFICIENTS, CONDITIONS, Causes, causes_of, physical_causes
from .instrument import FittedInstrument, InstrumentFit, correct_instrument
from .registration import Registration, register
from .rivals import Rivalry, leave_one_out, rivals
from .standard import StandardTest, still_standard

__all__ = [
    "CAUSES",
    "COEFFICIENTS",
    "CONDITIONS",
    "Causes",
    "CorrectionFit",
    "FittedCamera",
    "FittedInstrument",
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
]
