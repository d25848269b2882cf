"""What is adjusted: cameras, images, points and their observations, in columns."""

from .control import ControlPoints
from .network import Additional, Camera, Network, finite
from .stage import Moved, Stage, across
from .usable import Usable, usable

__all__ = [
    "Additional",
    "Camera",
    "ControlPoints",
    "Moved",
    "Network",
    "Stage",
    "Usable",
    "across",
    "finite",
    "usable",
]
