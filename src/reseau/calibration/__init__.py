"""The calibration: one document, and the mappings that it is read back to."""

from .document import Calibration, Covariance, Quantity

__all__ = ["Calibration", "Covariance", "Quantity"]
