"""Recalibration without a network: which calibration is in force, is due, and has drifted.

The modules :mod:`~reseau.service.runlength`, :mod:`~reseau.service.charts` and
:mod:`~reseau.service.covariates` are statistics of series, without an archive.
"""

from .alarms import Alarm, Alarms, sender
from .charts import ChartOptions, KnownSeries, Monitored, monitor
from .covariates import CalibrationFunction, CovariateTable, FunctionOptions, explain, fit_function
from .inforce import Applied, Configurations, Decision, Drift
from .recalibration import Recalibrated, Recalibration, Recalibrations
from .recurrence import Recurrence
from .rules import AcceptanceRules, Judgement, Limits, judge
from .schedule import Run, Schedule, Schedules

__all__ = [
    "AcceptanceRules",
    "Alarm",
    "Alarms",
    "Applied",
    "CalibrationFunction",
    "ChartOptions",
    "Configurations",
    "CovariateTable",
    "Decision",
    "Drift",
    "FunctionOptions",
    "Judgement",
    "KnownSeries",
    "Limits",
    "Monitored",
    "Recalibrated",
    "Recalibration",
    "Recalibrations",
    "Recurrence",
    "Run",
    "Schedule",
    "Schedules",
    "explain",
    "fit_function",
    "judge",
    "monitor",
    "sender",
]
