"""Least squares: a problem in, estimates with covariance, reliability and tests out."""

from __future__ import annotations

from .batch import BatchAdjustment, BatchOptions, BatchReason, adjust_batch
from .checks import check_jacobian
from .components import VarianceComponents, variance_components
from .consensus import Consensus, ConsensusModel, ransac
from .differences import JacobianCheck
from .elimination import Elimination, EliminationStep, eliminate
from .engine import Options, adjust
from .fitted import AdjustmentFailure
from .parameters import Constraint, Parameters, Prior
from .problem import GaussHelmert, GaussMarkov, Problem
from .rejection import Rejection, SnoopingStep, data_snooping, reject_outliers
from .reliability import ExternalReliability, critical_tau, critical_w, noncentrality
from .result import Adjustment
from .robust import Robust, robust, weight_function
from .significance import CoefficientTest, GlobalTest, NestedTest, compare

__all__ = [
    "Adjustment",
    "AdjustmentFailure",
    "BatchAdjustment",
    "BatchOptions",
    "BatchReason",
    "CoefficientTest",
    "Consensus",
    "ConsensusModel",
    "Constraint",
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
    "SnoopingStep",
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
    "ransac",
    "reject_outliers",
    "robust",
    "variance_components",
    "weight_function",
]
