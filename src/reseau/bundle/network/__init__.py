"""The network: cameras, images, points and their observations, in columns."""

from .calibrated import calibrated_camera, film_camera
from .camera import Additional, Camera
from .example import example_network
from .network import ControlPoints, Network
from .rig import Rig
from .settings import network_document, with_control, with_datum, with_parameters, with_sigma
from .shutter import Shutter
from .stage import Stage
from .turntable import stage_of_turntable

__all__ = [
    "Additional",
    "Camera",
    "ControlPoints",
    "Network",
    "Rig",
    "Shutter",
    "Stage",
    "calibrated_camera",
    "example_network",
    "film_camera",
    "network_document",
    "stage_of_turntable",
    "with_control",
    "with_datum",
    "with_parameters",
    "with_sigma",
]
