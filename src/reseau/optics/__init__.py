"""Image formation: cameras, distortions, displays, sensors and target images."""

from .mapping import Chain, Derivatives, Identity, Inverted, Mapping, PlaneMapping, Similarity
from .polynomials import RationalPolynomial

__all__ = [
    "Chain",
    "Derivatives",
    "Identity",
    "Inverted",
    "Mapping",
    "PlaneMapping",
    "RationalPolynomial",
    "Similarity",
]
