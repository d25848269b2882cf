"""Least squares: a problem in, estimates with covariance, reliability and tests out."""

from __future__ import annotations

from .batch import BatchAdjustment, BatchOptions, BatchReason, adjust_batch

__all__ = ["BatchAdjustment", "BatchOptions", "BatchReason", "adjust_batch"]
