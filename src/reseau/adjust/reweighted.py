"""Robust adjustment of linear problems with a common design.

The iteration is that of :func:`reseau.adjust.adjust_batch` with Tukey's weights, for the small problems that
a measurement solves again and again.
"""

from __future__ import annotations

import numpy as np

from ..core.data import Array

__all__ = ["reweighted"]

_MAD_TO_SIGMA, _TUKEY = 1.4826, 4.685
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING, _HELD = 1e-3, 1e-10, 1e12, 1e-2
_EPS = float(np.finfo(np.float64).eps)
"""As in :mod:`reseau.adjust.batch` and :func:`reseau.adjust.weight_function`."""


def reweighted(
    design: Array, observed: Array, prior: float, tolerance: float, most: int
) -> tuple[Array, Array]:
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
    found = [_one(design, each, prior, tolerance, most) for each in observed]
    return np.stack([x for x, _ in found]), np.stack([residuals for _, residuals in found])


def _one(design: Array, observed: Array, prior: float, tolerance: float, most: int) -> tuple[Array, Array]:
    """Estimates and residuals of one problem."""
    x, residuals, damping, growth = np.zeros(design.shape[1]), -observed, _DAMPING, 2.0
    floor = len(observed) * _EPS**2 * float(observed @ observed)
    cost, renewed = 0.0, True
    for turn in range(most + 1):
        if renewed:
            scale = max(_MAD_TO_SIGMA * float(np.median(np.abs(residuals))), np.sqrt(floor) + 1e-300)
            factors = (1.0 - np.minimum(np.abs(residuals) / (scale * _TUKEY), 1.0) ** 2) ** 2
            weighted = design.T * factors
            cost = float(residuals @ (factors * residuals) + prior * (x @ x))
            normal, gradient = weighted @ design, -weighted @ residuals - prior * x
            normal.flat[:: len(x) + 1] += prior
        if turn == most:
            break
        step, predicted = _step(normal, gradient, damping)
        done = np.abs(step).max() <= tolerance
        if done and damping > _HELD:  # the damping alone may have made it small
            done = np.abs(_step(normal, gradient, _LEAST_DAMPING)[0]).max() <= tolerance
        if done or predicted <= 10 * _EPS * cost + floor:
            return x + step, residuals
        trial = x + step
        tried = design @ trial - observed
        gain = (cost - float(tried @ (factors * tried) + prior * (trial @ trial))) / max(predicted, 1e-300)
        renewed = gain > 1e-4
        if renewed:
            x, residuals, growth = trial, tried, 2.0
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
            damping = max(damping, _LEAST_DAMPING)
        else:
            damping, growth = damping * growth, 2.0 * growth
            if damping > _MOST_DAMPING:
                break
    return x, residuals


def _step(normal: Array, gradient: Array, damping: float) -> tuple[Array, float]:
    """The damped correction (u,), and the decrease of the sum of squares that it predicts."""
    diagonal = normal.diagonal()
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled, right = normal * (scale[:, None] * scale), gradient * scale
    scaled.flat[:: len(scale) + 1] += damping
    found = np.linalg.solve(scaled, right)
    # 2 sᵀ g − sᵀ N s, with (N + d I) s = g.
    return found * scale, float(found @ (right + damping * found))
