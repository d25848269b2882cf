"""Rods of an ultrasonic test object in an image of a scanner's screen: detection, numbering, measurement."""

from .detection import PinDetections, PinOptions, find_pins
from .measure import PinResult, measure_pins
from .wires import Layout, LayoutOptions, Wires, lay_wires

__all__ = [
    "Layout",
    "LayoutOptions",
    "PinDetections",
    "PinOptions",
    "PinResult",
    "Wires",
    "find_pins",
    "lay_wires",
    "measure_pins",
]
