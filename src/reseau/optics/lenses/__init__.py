"""Lenses: prescriptions, media, rays through them, and the images that rays form."""

from .images import (
    LensCamera,
    PlaneTarget,
    RayImage,
    RayMap,
    RaySurrogate,
    SensorPlane,
    ThinLens,
    counted_image,
    ray_image,
)
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
from .paraxial import Paraxial
from .prescription import Aperture, Prescription, Surface, in_order
from .pupils import Aimed, PupilElements, RayKind, aim, labels, principal_rays
from .trace import SURFACE_PARAMETERS, RayDerivatives, Rays, Traced, Tracer

__all__ = [
    "AIR",
    "SURFACE_PARAMETERS",
    "Aimed",
    "Air",
    "Aperture",
    "Cauchy",
    "Constant",
    "LensCamera",
    "Medium",
    "Paraxial",
    "PlaneTarget",
    "Powers",
    "Prescription",
    "PupilElements",
    "RayDerivatives",
    "RayImage",
    "RayKind",
    "RayMap",
    "RaySurrogate",
    "Rays",
    "Sellmeier",
    "SensorPlane",
    "Surface",
    "ThinLens",
    "Traced",
    "Tracer",
    "Water",
    "aim",
    "counted_image",
    "glass",
    "glass_names",
    "in_order",
    "labels",
    "model_glass",
    "principal_rays",
    "ray_image",
]
