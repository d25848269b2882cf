"""Cameras: from the ideal direction of a ray to its image point, and back.

A camera is a plane mapping whose first plane is that of the ideal directions u = xc/zc, v = yc/zc (camera
axes: x right, y down, z along the view) and whose second is the image. :mod:`reseau.optics.poses` puts it in
space.

Each model is one module: its parameters with units, its mapping with derivatives and inverse, a kernel for
the bundle adjustment, and its registration. Files, commands, adjustments and reports know the models by the
registry.
"""

# The order of the imports is the order of the registry.
from . import brown, opencv, projections, telecentric, openptv, line_scan, splined, ebner, series  # isort: skip
from .convert import convert
from .registry import Parameter

__all__ = ["Parameter", "convert"]

_MODELS = brown, opencv, projections, telecentric, openptv, line_scan, splined, ebner, series
"""What registers itself where it is imported."""
