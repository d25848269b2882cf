"""One frame to image coordinates: marks of a reseau, a testfield or a sheet, pins, edges of film frames."""

from .boards.measure import measure_board
from .matching import match
from .matching.patches import MatchOptions
from .pins import PinDetections
from .pins.detection import find_pins
from .pins.measure import measure_pins
from .reseau import measure_reseau
from .testfield.measure import measure_testfield

__all__ = [
    "MatchOptions",
    "PinDetections",
    "find_pins",
    "match",
    "measure_board",
    "measure_pins",
    "measure_reseau",
    "measure_testfield",
]
