"""How a network is adjusted: normal equations with the points eliminated, iteration, cofactors, datum."""

from .approximation import Approximate, approximate
from .datum import similarity_onto
from .normal import SEGMENTS
from .posterior import cofactors_of
from .problem import BundleFit, BundleProblem
from .system import residuals
from .unknowns import Unknowns
from .values import Values

__all__ = [
    "SEGMENTS",
    "Approximate",
    "BundleFit",
    "BundleProblem",
    "Unknowns",
    "Values",
    "approximate",
    "cofactors_of",
    "residuals",
    "similarity_onto",
]
