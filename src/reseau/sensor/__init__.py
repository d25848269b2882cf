"""Calibration of sensors: dark signal, response to light, noise, sharpness, defective pixels."""

from .edge import EdgeSpread, measure_edge
from .fields import estimate_fields
from .free_curve import FreeCurve
from .sensor import SensorResult, calibrate_sensor, with_edge
from .series import Level, LevelSums, SensorSeries
from .transfer import Linearity, PhotonTransfer, fit_linearity, fit_transfer

__all__ = [
    "EdgeSpread",
    "FreeCurve",
    "Level",
    "LevelSums",
    "Linearity",
    "PhotonTransfer",
    "SensorResult",
    "SensorSeries",
    "calibrate_sensor",
    "estimate_fields",
    "fit_linearity",
    "fit_transfer",
    "measure_edge",
    "with_edge",
]
