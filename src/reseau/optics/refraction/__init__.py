"""Refracting windows between camera and object: their parameters, and the exact rays through them."""

from .rays import RefractedRays
from .windows import Refraction, RefractionColumns, RefractiveIndex, Window, window_parameters

__all__ = [
    "RefractedRays",
    "Refraction",
    "RefractionColumns",
    "RefractiveIndex",
    "Window",
    "window_parameters",
]
