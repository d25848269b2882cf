"""Least-squares adjustment: estimates with covariance, reliability and tests."""

from __future__ import annotations

from .batch import BatchAdjustment, BatchOptions, BatchReason, adjust_batch
from .components import VarianceComponents, variance_components
from .differences import JacobianCheck
from .elimination import Elimination, EliminationStep, eliminate
from .engine import AdjustmentFailure, Options
from .fitted import compare
from .outliers import Rejection, Robust, SnoopingStep, data_snooping, robust, weight_function
from .parameters import Constraint, Parameters, Prior
from .problem import Adjustment, GaussHelmert, GaussMarkov, Problem, adjust, check_jacobian
from .reliability import ExternalReliability, critical_tau, critical_w, noncentrality
from .significance import CoefficientTest, GlobalTest, NestedTest
from .uncertainty import Contribution, Simulated, UncertaintyBudget, Validation, propagate, simulate, validate

__all__ = [
    "Adjustment",
    "AdjustmentFailure",
    "BatchAdjustment",
    "BatchOptions",
    "BatchReason",
    "CoefficientTest",
    "Constraint",
    "Contribution",
    "Elimination",
    "EliminationStep",
    "ExternalReliability",
    "GaussHelmert",
    "GaussMarkov",
    "GlobalTest",
    "JacobianCheck",
    "NestedTest",
    "Options",
    "Parameters",
    "Prior",
    "Problem",
    "Rejection",
    "Robust",
    "Simulated",
    "SnoopingStep",
    "UncertaintyBudget",
    "Validation",
    "VarianceComponents",
    "adjust",
    "adjust_batch",
    "check_jacobian",
    "compare",
    "critical_tau",
    "critical_w",
    "data_snooping",
    "eliminate",
    "noncentrality",
    "propagate",
    "robust",
    "simulate",
    "validate",
    "variance_components",
    "weight_function",
]
