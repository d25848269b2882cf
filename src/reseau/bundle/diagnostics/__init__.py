"""Results of an adjusted network: estimates, residual patterns, uncertainty over the image, warnings."""

from .checks import checks
from .control_check import ControlShape

__all__ = ["ControlShape", "checks"]
