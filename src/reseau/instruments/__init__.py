"""What an instrument is to those who use it: protocols, settings, values; it talks to nothing.

Drivers live in a package of their own, ``reseau_drivers``, and are found through the entry points of the
group ``reseau.instruments``; so may be those of others.
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
