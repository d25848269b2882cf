"""Lenses: prescriptions, media, rays through them, and the images that rays form."""

from .images import ray_image
from .media import AIR, Medium, glass, glass_names
from .paraxial import Paraxial
from .prescription import Aperture, Prescription, in_order
from .pupils import PupilElements, aim
from .ray_maps import RayMap
from .stand_ins import ThinLens
from .trace import Tracer

__all__ = [
    "AIR",
    "Aperture",
    "Medium",
    "Paraxial",
    "Prescription",
    "PupilElements",
    "RayMap",
    "ThinLens",
    "Tracer",
    "aim",
    "glass",
    "glass_names",
    "in_order",
    "ray_image",
]
