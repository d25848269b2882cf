"""Robust adjustment of linear problems with a common design, compiled.

The iteration is that of :func:`reseau.adjust.adjust_batch` with Tukey's weights, for the small problems that
a measurement solves again and again: there most of its time is spent between the operations on arrays.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.assign import assign
from ..core.compiled import compiled

__all__ = ["reweighted"]

Floats = NDArray[Any]

_MAD_TO_SIGMA, _TUKEY = 1.4826, 4.685
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING, _HELD = 1e-3, 1e-10, 1e12, 1e-2
_EPS = float(np.finfo(np.float64).eps)
"""As in :mod:`reseau.adjust.batch` and :func:`reseau.adjust.weight_function`."""


@compiled
def _robust_factors(residuals: Floats, least: float, factors: Floats) -> None:
    """Tukey's factors (n,) on the weights of residuals (n,), of which the scale is at least `least`."""
    scale = max(_MAD_TO_SIGMA * np.median(np.abs(residuals)), least)
    for i in range(len(residuals)):
        within = 1.0 - min(abs(residuals[i] / scale) / _TUKEY, 1.0) ** 2
        factors[i] = within * within


@compiled
def _cost(residuals: Floats, factors: Floats, x: Floats, prior: float) -> float:
    total = 0.0
    for i in range(len(residuals)):
        total += residuals[i] * factors[i] * residuals[i]
    for m in range(len(x)):
        total += x[m] * x[m] * prior
    return total


@compiled
def _step(normal: Floats, gradient: Floats, damping: float, step: Floats) -> float:
    """Fill the damped correction (u,); the decrease of the sum of squares that it predicts."""
    u = len(gradient)
    scale, right, scaled = np.empty(u), np.empty(u), np.empty((u, u))
    for m in range(u):
        scale[m] = 1.0 / np.sqrt(normal[m, m]) if normal[m, m] > 0 else 1.0
        right[m] = gradient[m] * scale[m]
    for m in range(u):
        for i in range(u):
            scaled[m, i] = normal[m, i] * scale[m] * scale[i] + (damping if i == m else 0.0)
    found = np.linalg.solve(scaled, right)
    # 2 sᵀ g − sᵀ N s, with (N + d I) s = g.
    predicted = 0.0
    for m in range(u):
        predicted += found[m] * (right[m] + damping * found[m])
        step[m] = found[m] * scale[m]
    return predicted


@compiled
def reweighted(
    design: Floats, observed: Floats, prior: float, tolerance: float, most: int
) -> tuple[Floats, Floats]:
    """Adjust linear problems with Tukey's weights, from zero.

    Parameters
    ----------
    design : ndarray (n, u)
        Their common design matrix.
    observed : ndarray (b, n)
        Observations of each problem, of equal weight and finite.
    prior : float
        Weight of every parameter as an observation of zero; above zero.
    tolerance : float
        A problem has converged when no parameter is corrected by more than this.
    most : int
        Most evaluations of each after the initial one.

    Returns
    -------
    ndarray (b, u), ndarray (b, n)
        Estimates and residuals, adjusted minus observed.
    """
    (count, n), u = observed.shape, design.shape[1]
    estimates, left = np.zeros((count, u)), np.empty((count, n))
    turned, weighted = np.ascontiguousarray(design.T), np.empty((u, n))
    factors, step = np.empty(n), np.empty(u)
    for k in range(count):
        x, residuals, damping, growth = np.zeros(u), -observed[k], _DAMPING, 2.0
        floor = n * _EPS**2 * (observed[k] @ observed[k])
        normal, gradient, cost, renewed = np.empty((u, u)), np.empty(u), 0.0, True
        for turn in range(most + 1):
            if renewed:
                _robust_factors(residuals, np.sqrt(floor) + 1e-300, factors)
                cost = _cost(residuals, factors, x, prior)
                for m in range(u):
                    for i in range(n):
                        weighted[m, i] = turned[m, i] * factors[i]
                np.dot(weighted, design, normal)
                np.dot(weighted, residuals, gradient)
                for m in range(u):
                    normal[m, m] += prior
                    gradient[m] = -gradient[m] - x[m] * prior
            if turn == most:
                break
            predicted = _step(normal, gradient, damping, step)
            done = np.abs(step).max() <= tolerance
            if done and damping > _HELD:  # the damping alone may have made it small
                free = np.empty(u)
                _step(normal, gradient, _LEAST_DAMPING, free)
                done = np.abs(free).max() <= tolerance
            if done or predicted <= 10 * _EPS * cost + floor:
                x += step
                break
            trial = x + step
            tried = np.dot(design, trial) - observed[k]
            gain = (cost - _cost(tried, factors, trial, prior)) / max(predicted, 1e-300)
            renewed = gain > 1e-4
            if renewed:
                x, residuals, growth = trial, tried, 2.0
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
                damping = max(damping, _LEAST_DAMPING)
            else:
                damping, growth = damping * growth, 2.0 * growth
                if damping > _MOST_DAMPING:
                    break
        assign(estimates[k], x)
        assign(left[k], residuals)
    return estimates, left
