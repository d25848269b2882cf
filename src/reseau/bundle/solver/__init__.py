"""The solver: normal equations with the points eliminated, iteration, cofactors, datum."""

from .approximation import Approximate, approximate
from .problem import BundleFit, BundleProblem

__all__ = ["Approximate", "BundleFit", "BundleProblem", "approximate"]
