"""Refracting windows between camera and object: their parameters, and the exact rays through them."""

from .rays import RefractedRays
from .windows import Window

__all__ = ["RefractedRays", "Window"]
