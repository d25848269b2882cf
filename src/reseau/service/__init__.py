"""The service, and recalibration without a network: which calibration is in force, is due, and has drifted.

The modules :mod:`~reseau.service.runlength`, :mod:`~reseau.service.charts` and
:mod:`~reseau.service.covariates` are statistics of series, without an archive. Names are imported when they
are first used: the service is ready before the statistics are loaded.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import lazily

if TYPE_CHECKING:
    from .alarms import Alarms
    from .charts import ChartOptions, monitor
    from .covariates import CovariateTable, fit_function
    from .inforce import Configurations
    from .recalibration import Recalibrations
    from .rules import AcceptanceRules, Limits, judge
    from .schedule import Run, Schedule, Schedules

__all__ = [
    "AcceptanceRules",
    "Alarms",
    "ChartOptions",
    "Configurations",
    "CovariateTable",
    "Limits",
    "Recalibrations",
    "Run",
    "Schedule",
    "Schedules",
    "fit_function",
    "judge",
    "monitor",
]

_PLACES = {
    "AcceptanceRules": ".rules",
    "Alarms": ".alarms",
    "ChartOptions": ".charts",
    "Configurations": ".inforce",
    "CovariateTable": ".covariates",
    "Limits": ".rules",
    "Recalibrations": ".recalibration",
    "Run": ".schedule",
    "Schedule": ".schedule",
    "Schedules": ".schedule",
    "fit_function": ".covariates",
    "judge": ".rules",
    "monitor": ".charts",
}
"""Modules that define the names."""


__getattr__ = lazily(__name__, _PLACES)
