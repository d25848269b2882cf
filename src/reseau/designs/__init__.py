"""Targets as designed: reseaus, an ultrasonic test object, coded testfields, space frames, and drawings."""

from .boards import board
from .frames import space_frame
from .reseaus import coded_sheet, n_wire_phantom, regular_reseau, standard_reseau, test_object
from .testfield import coded_testfield
from .topology import HIDDEN, Decoded, TopologicalCode

__all__ = [
    "HIDDEN",
    "Decoded",
    "TopologicalCode",
    "board",
    "coded_sheet",
    "coded_testfield",
    "n_wire_phantom",
    "regular_reseau",
    "space_frame",
    "standard_reseau",
    "test_object",
]
