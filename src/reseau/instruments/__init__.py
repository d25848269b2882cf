"""Interfaces of instruments: protocols, settings with units and limits, and the values that they return.

This package does no input or output but that of images to files for bluesky. Drivers are in the separate
package ``reseau_drivers``; drivers of either package are found through the entry points of the group
``reseau.instruments``.
"""

from .assets import ImageStore
from .deadline import Deadline
from .device import Device
from .monitor import Monitor
from .operators import RemoteOperator, TerminalOperator
from .protocols import (
    Camera,
    CameraRig,
    EnvironmentSensor,
    Exposure,
    ExposureSet,
    Instrument,
    Movable,
    Oscilloscope,
    Turntable,
    UltrasonicScanner,
)
from .settings import Limits, Settings, choice, quantity, text
from .status import Status
from .values import AxisState, BScan, Environment, Finding, Identity, ScreenPicture, Waveform

__all__ = [
    "AxisState",
    "BScan",
    "Camera",
    "CameraRig",
    "Deadline",
    "Device",
    "Environment",
    "EnvironmentSensor",
    "Exposure",
    "ExposureSet",
    "Finding",
    "Identity",
    "ImageStore",
    "Instrument",
    "Limits",
    "Monitor",
    "Movable",
    "Oscilloscope",
    "RemoteOperator",
    "ScreenPicture",
    "Settings",
    "Status",
    "TerminalOperator",
    "Turntable",
    "UltrasonicScanner",
    "Waveform",
    "choice",
    "quantity",
    "text",
]
