"""Calibration of sensors: dark signal, response to light, noise, sharpness, defective pixels."""

from .chart import measure_edges
from .edge import EdgeSpread, measure_edge
from .free_curve import FreeCurve
from .sensor import calibrate_sensor
from .series import Level, SensorSeries
from .transfer import Linearity

__all__ = [
    "EdgeSpread",
    "FreeCurve",
    "Level",
    "Linearity",
    "SensorSeries",
    "calibrate_sensor",
    "measure_edge",
    "measure_edges",
]
