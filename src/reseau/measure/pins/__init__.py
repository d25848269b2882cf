"""The rods of an ultrasonic test object in a picture of a scanner's screen: echoes, names, places."""

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
