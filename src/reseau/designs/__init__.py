"""Targets as designed: reseaus, an ultrasonic test object, the coded testfield and its code, and drawings."""

from .reseaus import coded_sheet, n_wire_phantom, regular_reseau, standard_reseau, test_object
from .testfield import coded_testfield
from .topology import HIDDEN, Decoded, TopologicalCode

__all__ = [
    "HIDDEN",
    "Decoded",
    "TopologicalCode",
    "coded_sheet",
    "coded_testfield",
    "n_wire_phantom",
    "regular_reseau",
    "standard_reseau",
    "test_object",
]
