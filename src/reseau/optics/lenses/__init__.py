"""Lenses: prescriptions, media, and rays through them."""

from .media import (
    AIR,
    Air,
    Cauchy,
    Constant,
    Medium,
    Powers,
    Sellmeier,
    Water,
    glass,
    glass_names,
    model_glass,
)
from .prescription import Aperture, Prescription, Surface, in_order
from .trace import SURFACE_PARAMETERS, RayDerivatives, Rays, Traced, Tracer

__all__ = [
    "AIR",
    "SURFACE_PARAMETERS",
    "Air",
    "Aperture",
    "Cauchy",
    "Constant",
    "Medium",
    "Powers",
    "Prescription",
    "RayDerivatives",
    "Rays",
    "Sellmeier",
    "Surface",
    "Traced",
    "Tracer",
    "Water",
    "glass",
    "glass_names",
    "in_order",
    "model_glass",
]
