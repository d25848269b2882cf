"""Bundle adjustment: orientation, calibration and object points, with their quality."""

from __future__ import annotations

from .approximate import Approximate, approximate
from .network import Additional, Camera, Network
from .problem import BundleFit, BundleProblem

__all__ = ["Additional", "Approximate", "BundleFit", "BundleProblem", "Camera", "Network", "approximate"]
