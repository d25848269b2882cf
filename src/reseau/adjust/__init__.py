"""Least squares: a problem in, estimates with covariance, reliability and tests out."""

from __future__ import annotations

from .batch import BatchAdjustment, BatchOptions, BatchReason, adjust_batch
from .checks import check_jacobian
from .differences import JacobianCheck
from .engine import Options, adjust
from .parameters import Constraint, Parameters, Prior
from .problem import GaussHelmert, GaussMarkov, Problem
from .reliability import ExternalReliability, critical_tau, critical_w, noncentrality
from .result import Adjustment, Failure
from .significance import CoefficientTest, GlobalTest, NestedTest, compare

__all__ = [
    "Adjustment",
    "BatchAdjustment",
    "BatchOptions",
    "BatchReason",
    "CoefficientTest",
    "Constraint",
    "ExternalReliability",
    "Failure",
    "GaussHelmert",
    "GaussMarkov",
    "GlobalTest",
    "JacobianCheck",
    "NestedTest",
    "Options",
    "Parameters",
    "Prior",
    "Problem",
    "adjust",
    "adjust_batch",
    "check_jacobian",
    "compare",
    "critical_tau",
    "critical_w",
    "noncentrality",
]
