"""Least-squares adjustment: estimates with covariance, reliability and tests."""

from __future__ import annotations

from .batch import adjust_batch
from .components import variance_components
from .elimination import eliminate
from .engine import Options
from .outliers import data_snooping, weight_function
from .parameters import Parameters
from .problem import Adjustment, GaussMarkov, adjust
from .uncertainty import Contribution, propagate, simulate

__all__ = [
    "Adjustment",
    "Contribution",
    "GaussMarkov",
    "Options",
    "Parameters",
    "adjust",
    "adjust_batch",
    "data_snooping",
    "eliminate",
    "propagate",
    "simulate",
    "variance_components",
    "weight_function",
]
