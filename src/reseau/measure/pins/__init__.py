"""Rods of an ultrasonic test object in an image of a scanner's screen: detection, numbering, measurement."""

from .detection import PinDetections

__all__ = ["PinDetections"]
