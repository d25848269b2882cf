"""Interfaces of instruments: protocols, settings with units and limits, and the values that they return.

This package does no input or output. Drivers are in the separate package ``reseau_drivers``; drivers of
either package are found through the entry points of the group ``reseau.instruments``.
"""

from .deadline import Deadline
from .device import Device
from .protocols import Camera, Exposure, Instrument, Movable, Oscilloscope, Turntable, UltrasonicScanner
from .settings import Limits, Settings, choice, quantity, text
from .status import Status
from .values import AxisState, BScan, Identity, ScreenPicture, Waveform

__all__ = [
    "AxisState",
    "BScan",
    "Camera",
    "Deadline",
    "Device",
    "Exposure",
    "Identity",
    "Instrument",
    "Limits",
    "Movable",
    "Oscilloscope",
    "ScreenPicture",
    "Settings",
    "Status",
    "Turntable",
    "UltrasonicScanner",
    "Waveform",
    "choice",
    "quantity",
    "text",
]
