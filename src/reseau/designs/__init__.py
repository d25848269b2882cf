"""Targets as designed: reseaus, a test object, testfields, space frames, aerial cameras; their drawings."""

from .aerial import aerial_camera, aerial_cameras
from .boards import board
from .frames import space_frame
from .reseaus import coded_sheet, n_wire_phantom, regular_reseau, standard_reseau, test_object
from .testfield import coded_testfield
from .topology import HIDDEN, Decoded, TopologicalCode

__all__ = [
    "HIDDEN",
    "Decoded",
    "TopologicalCode",
    "aerial_camera",
    "aerial_cameras",
    "board",
    "coded_sheet",
    "coded_testfield",
    "n_wire_phantom",
    "regular_reseau",
    "space_frame",
    "standard_reseau",
    "test_object",
]
