"""Levenberg–Marquardt iteration of the sparse system, with one factorisation per iteration.

The damping decreases where a step reaches the predicted decrease, and otherwise increases after Nielsen
(1999). In a narrow curved valley the steps follow its curvature to second order (Transtrum & Sethna 2012,
Improvements to the Levenberg–Marquardt algorithm, arXiv:1201.5885); they then need two factorisations.
Convergence is decided by the relative offset (Bates & Watts 1981), as in :mod:`reseau.adjust.engine`; it is
computed from the decrease predicted for the damped step and is therefore valid only with small damping.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...adjust.engine import AdjustmentFailure
from ...core.data import Rows
from ...core.failure import Code, Failure
from .arrow import Singular
from .direct import Normal
from .implicit import normal_of
from .linear import Linear, linearised
from .system import System
from .values import Correction, Values

_LEAST_DAMPING, _MOST_DAMPING = 1e-16, 1e12
# Ratio of actual to predicted decrease above which the damping is multiplied by the factor that follows.
_GOOD, _SHRINK, _FAIR, _SLOWLY = 0.6, 0.3, 0.2, 0.5
# Damping at which a step is practically undamped; relative decrease that is rounding; relative offset
# accepted in the last iteration.
_SMALL, _FLAT, _NEAR = 1e-6, 1e-9, 1e-3
# Conjugate gradients: relative length of the error of a step, at first and near the minimum, and its length
# relative to the largest correction that counts as none.
_FORCING, _SHARP, _BELOW = 0.1, 1e-3, 0.1
# Relative increase of the sum of squares that can be rounding.
_ROUNDING = 1e-10
# Points farther away than this many times the extent of the network are at infinity.
_HORIZON, _NEARLY = 1e8, 0.99
# A step rejected at a damping below this lies in a curved valley. The second difference of the misfits is
# taken over this part of a step; an acceleration longer than this part of the step is not trusted.
_CURVED, _PART, _TRUSTED = 1e-2, 0.1, 0.375
# The iteration stalls when the sum of squares decreases by at most this fraction in this many iterations.
_STALL_ITERATIONS, _STALL_DECREASE = 25, 1e-6


@dataclass(frozen=True, eq=False)
class Iterated:
    """Result of the iteration.

    Parameters
    ----------
    linear : Linear
        The linear problem at the estimates.
    costs : tuple of float
        vᵀPv at the approximate values and after each accepted step.
    iterations : int
        Number of steps tried.
    offset : float
        Relative offset: size of the next correction, in standard deviations.
    away : ndarray of int
        Points that diverged to infinity.
    converged : bool
        Whether the minimum was reached; otherwise the maximum number of iterations or damping was.
    """

    linear: Linear
    costs: tuple[float, ...]
    iterations: int
    offset: float
    away: Rows
    converged: bool = True

    @property
    def values(self) -> Values:
        """The estimates."""
        return self.linear.values


def iterate(
    system: System,
    start: Values,
    *,
    redundancy: int,
    max_iterations: int,
    tolerance: float,
    damping: float,
    watch: Callable[[int, float], None] | None = None,
) -> Iterated | Failure:
    """Minimise vᵀPv.

    Parameters
    ----------
    system : System
        System to adjust.
    start : Values
        Approximate values.
    redundancy : int
        Redundancy, for the relative offset.
    max_iterations : int
        Maximum number of steps tried.
    tolerance : float
        Relative offset at which the iteration has converged.
    damping : float
        Initial damping, relative to the diagonal of the normal equations.
    watch : callable, optional
        Called with the number of steps and vᵀPv after each accepted step.

    Returns
    -------
    Iterated or Failure
        A failure when the misfits are not finite or the normal equations are singular.
    """
    linear = linearised(system, start)
    cost, growth, tried = linear.cost, 2.0, 0
    if not np.isfinite(cost):
        return Failure(
            "misfits of image coordinates are not finite at the approximate values", Code.NOT_FINITE
        )
    radius = _HORIZON * _extent(system, start)
    curved, forcing = False, _FORCING
    costs, rank = [cost], max(1, 2 * len(linear.misfits) + len(linear.other_misfits) - redundancy)
    if system.iterative:
        # Steps are not exact: the next correction of each unknown must be small, not that of all on average.
        tolerance /= np.sqrt(rank)
    while tried < max_iterations:
        tried += 1
        normal = normal_of(linear, damping)
        unit = np.sqrt(rank * max(cost, 1e-300) / max(1, redundancy))
        try:
            step = normal.correction(forcing, _BELOW * tolerance * unit)
        except Singular:
            damping, growth = max(damping, _LEAST_DAMPING) * 10.0 * growth, growth * 2.0
            if damping > _MOST_DAMPING:
                return AdjustmentFailure(
                    "the normal equations are singular", Code.SINGULAR, iterations=tried, costs=tuple(costs)
                )
            continue
        offset = np.sqrt(max(step.predicted, 0.0)) / unit
        forcing = float(np.clip(offset, _SHARP, _FORCING))
        settled = (damping <= _SMALL or step.predicted <= 1e-14 * cost) and step.complete
        # In the last iteration a larger offset is accepted; a stalled iteration ends where it is.
        slow = len(costs) > _STALL_ITERATIONS
        stalled = slow and costs[-_STALL_ITERATIONS] - cost <= _STALL_DECREASE * cost
        near = tried == max_iterations and offset < _NEAR
        if (offset <= tolerance and settled) or cost <= system.floor or near or stalled:
            away = linear.values.beyond(_NEARLY * radius)
            return Iterated(linear, tuple(costs), tried, float(offset), away)
        if curved:
            step = _accelerated(normal, step)
        trial = linear.values.moved(system.unknowns, step, system.constraints)
        away = trial.beyond(radius)
        if len(away):
            trial = trial.confined(away, radius)
        out, others = system.misfits(trial)
        there = float((out**2).sum() + others @ others)
        flat = step.predicted <= _FLAT * cost and there <= cost * (1.0 + _ROUNDING)
        gain = (cost - there) / step.predicted if np.isfinite(there) and step.predicted > 0 else -1.0
        if gain > 1e-4 or flat:
            linear, cost, growth = linearised(system, trial), there, 2.0
            costs.append(cost)
            shrink = _SHRINK if gain > _GOOD else _SLOWLY if gain > _FAIR else 1.0
            if flat and gain < _FAIR:
                # Rounding, or a step that is too long: with large residuals the sum of squares can be more
                # curved across a narrow valley than its linear part.
                shrink = _SHRINK if damping > _SMALL else 2.0
            damping = max(damping * shrink, _LEAST_DAMPING)
            if watch is not None:
                watch(tried, cost)
            continue
        curved |= damping < _CURVED
        damping, growth = max(damping, _LEAST_DAMPING) * growth, growth * 2.0
        if damping > _MOST_DAMPING:
            break
    away = linear.values.beyond(_NEARLY * radius)
    return Iterated(linear, tuple(costs), tried, float("nan"), away, converged=False)


def _accelerated(normal: Normal, step: Correction) -> Correction:
    """Add the acceleration a = −½ (JᵀPJ + λD)⁻¹ JᵀP v″ to a step; v″ is the second derivative along it."""
    linear = normal.linear
    system, values = linear.system, linear.values
    ahead, back = (
        system.misfits(values.moved(system.unknowns, step.times(sign * _PART), system.constraints))
        for sign in (1.0, -1.0)
    )
    second = [
        (one + other - 2.0 * here) / (2.0 * _PART**2)
        for one, other, here in zip(ahead, back, (linear.misfits, linear.other_misfits), strict=True)
    ]
    if not all(np.isfinite(part).all() for part in second):
        return step
    if system.constraints is None:
        bend = normal.correction_for(second[0], second[1])
        return step.plus(bend) if bend.length <= _TRUSTED * step.length else step
    try:
        bent = Linear(system, values, linear.rows, second[0], second[1])
        bend = normal_of(bent, normal.damping).correction()
    except Singular:
        return step
    return step.plus(bend) if bend.length <= _TRUSTED * step.length else step


def _extent(system: System, values: Values) -> float:
    """Median distance of projection centres or of points from the centroid, whichever is larger."""
    images = system.unknowns.pose >= 0
    sizes = [np.linalg.norm(part, axis=1) for part in (values.x0[images], values.xyz)]
    return max(float(np.median(size)) if len(size) else 0.0 for size in sizes) or 1.0
