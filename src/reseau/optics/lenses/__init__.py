"""Lenses: prescriptions, media, rays through them, and the images that rays form."""

from .images import PlaneTarget, RayImage, image_scale, ray_image, ray_images
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
from .prescription import Aperture, Layout, Prescription, Surface, in_order
from .pupils import Aimed, Aiming, PupilElements, RayKind, aim, labels
from .ray_maps import CalibratedLens, LensCamera, RayMap, SensorPlane
from .stand_ins import AberratedLens, ThinLens
from .surrogate import RaySurrogate
from .trace import SURFACE_PARAMETERS, RayDerivatives, Rays, Traced, Tracer
from .windows import behind_windows

__all__ = [
    "AIR",
    "SURFACE_PARAMETERS",
    "AberratedLens",
    "Aimed",
    "Aiming",
    "Air",
    "Aperture",
    "CalibratedLens",
    "Cauchy",
    "Constant",
    "Layout",
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
    "behind_windows",
    "glass",
    "glass_names",
    "image_scale",
    "in_order",
    "labels",
    "model_glass",
    "ray_image",
    "ray_images",
]
