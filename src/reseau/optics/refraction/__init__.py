"""Refracting windows between camera and object: their parameters, and the exact rays through them."""

from .rays import RefractedRays
from .windows import Refraction, RefractiveIndex, Window, window_parameters

__all__ = [
    "RefractedRays",
    "Refraction",
    "RefractiveIndex",
    "Window",
    "window_parameters",
]
