"""The service, and recalibration without a network: which calibration is in force, is due, and has drifted.

The modules :mod:`~reseau.service.runlength`, :mod:`~reseau.service.charts` and
:mod:`~reseau.service.covariates` are statistics of series, without an archive. Names are imported when they
are first used: the service is ready before the statistics are loaded.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import lazily

if TYPE_CHECKING:
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

_PLACES = {
    "AcceptanceRules": ".rules",
    "Alarm": ".alarms",
    "Alarms": ".alarms",
    "Applied": ".inforce",
    "CalibrationFunction": ".covariates",
    "ChartOptions": ".charts",
    "Configurations": ".inforce",
    "CovariateTable": ".covariates",
    "Decision": ".inforce",
    "Drift": ".inforce",
    "FunctionOptions": ".covariates",
    "Judgement": ".rules",
    "KnownSeries": ".charts",
    "Limits": ".rules",
    "Monitored": ".charts",
    "Recalibrated": ".recalibration",
    "Recalibration": ".recalibration",
    "Recalibrations": ".recalibration",
    "Recurrence": ".recurrence",
    "Run": ".schedule",
    "Schedule": ".schedule",
    "Schedules": ".schedule",
    "explain": ".covariates",
    "fit_function": ".covariates",
    "judge": ".rules",
    "monitor": ".charts",
    "sender": ".alarms",
}
"""Modules that define the names."""


__getattr__ = lazily(__name__, _PLACES)
