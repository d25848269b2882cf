"""Recalibration without a network: which calibration is in force, is due, and has drifted.

The modules :mod:`~reseau.service.runlength`, :mod:`~reseau.service.charts` and
:mod:`~reseau.service.covariates` are statistics of series, without an archive.
"""

from .charts import ChartOptions, KnownSeries, Monitored, monitor
from .covariates import CalibrationFunction, FunctionOptions, explain, fit_function
from .inforce import Applied, Configurations, Decision, Drift
from .rules import AcceptanceRules, Judgement, Limits, judge

__all__ = [
    "AcceptanceRules",
    "Applied",
    "CalibrationFunction",
    "ChartOptions",
    "Configurations",
    "Decision",
    "Drift",
    "FunctionOptions",
    "Judgement",
    "KnownSeries",
    "Limits",
    "Monitored",
    "explain",
    "fit_function",
    "judge",
    "monitor",
]
