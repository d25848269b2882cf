"""Calibration of sensors: dark signal, response to light, noise, sharpness, defective pixels."""

from .chart import ChartEdge, EdgeRegion, find_edges, measure_edges
from .edge import EdgeSpread, measure_edge
from .fields import estimate_fields
from .free_curve import FreeCurve
from .sensor import SensorResult, calibrate_sensor, with_edge
from .series import Level, LevelSums, SensorSeries
from .transfer import Linearity, PhotonTransfer, fit_linearity, fit_transfer

__all__ = [
    "ChartEdge",
    "EdgeRegion",
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
    "find_edges",
    "fit_linearity",
    "fit_transfer",
    "measure_edge",
    "measure_edges",
    "with_edge",
]
