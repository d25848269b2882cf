"""Levenberg–Marquardt over the sparse system: one factorisation an iteration.

The damping falls where steps keep their promise and grows after Nielsen (1999) where they do not. What
decides is the relative offset (Bates & Watts 1981), as in :mod:`reseau.adjust.engine`; it is taken from the
decrease that the damped step promises, and therefore counts only once the damping is small.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...adjust import AdjustmentFailure
from ...core.data import Rows
from ...core.failure import Code, Failure
from .arrow import Singular
from .system import Linear, System
from .values import Values

__all__ = ["Iterated", "iterate"]

_LEAST_DAMPING, _MOST_DAMPING = 1e-12, 1e12
# A step that gains so much of what it promised lets the next one be so much bolder.
_GOOD, _SHRINK, _FAIR, _SLOWLY = 0.6, 0.3, 0.2, 0.5
# Damping at which the step is as good as undamped, and below which a decrease is rounding.
_SMALL, _FLAT, _NEAR = 1e-6, 1e-9, 1e-3
# Points farther off than so many times the extent of the network are at infinity.
_HORIZON, _NEARLY = 1e8, 0.99
# A sum of squares that falls by no more than this part in so many corrections creeps.
_PATIENCE, _CREEP = 25, 1e-6


@dataclass(frozen=True, eq=False)
class Iterated:
    """Where the iteration arrived.

    Parameters
    ----------
    linear : Linear
        The linear problem at the estimates.
    costs : tuple of float
        vᵀPv at the approximate values and after each correction taken.
    iterations : int
        Corrections tried.
    offset : float
        Relative offset: corrections still to come, in standard deviations.
    away : ndarray of int
        Points that ran off to infinity.
    converged : bool
        Whether this is the minimum; otherwise the iteration was at the end of its patience.
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
    """Bring the values to the minimum of vᵀPv.

    Parameters
    ----------
    system : System
        What is adjusted.
    start : Values
        Approximate values.
    redundancy : int
        For the relative offset.
    max_iterations : int
        Corrections tried at most.
    tolerance : float
        Relative offset at which the iteration has converged.
    damping : float
        Initial damping, relative to the diagonal of the normal equations.
    watch : callable, optional
        Told the number of corrections and vᵀPv after each one taken.

    Returns
    -------
    Iterated or Failure
        A failure when there is no way to go on.
    """
    linear = system.linearise(start)
    cost, growth, tried = linear.cost, 2.0, 0
    if not np.isfinite(cost):
        return Failure(
            "the image coordinates have no finite misfits at the approximate values", Code.NOT_FINITE
        )
    radius = _HORIZON * _extent(system, start)
    costs, rank = [cost], max(1, 2 * len(linear.misfits) + len(linear.other_misfits) - redundancy)
    while tried < max_iterations:
        tried += 1
        try:
            step = linear.normal(damping).correction()
        except Singular:
            damping, growth = max(damping, _LEAST_DAMPING) * 10.0 * growth, growth * 2.0
            if damping > _MOST_DAMPING:
                return AdjustmentFailure(
                    "the normal equations are singular", Code.SINGULAR, iterations=tried, costs=tuple(costs)
                )
            continue
        offset = np.sqrt(max(step.predicted, 0.0) / rank) / np.sqrt(max(cost, 1e-300) / max(1, redundancy))
        settled = damping <= _SMALL or step.predicted <= 1e-14 * cost
        # At the end of its patience it takes what is near, and what creeps it leaves where it is.
        creeps = len(costs) > _PATIENCE and costs[-_PATIENCE] - cost <= _CREEP * cost
        near = tried == max_iterations and offset < _NEAR
        if (offset <= tolerance and settled) or cost <= system.floor or near or creeps:
            away = linear.values.beyond(_NEARLY * radius)
            return Iterated(linear, tuple(costs), tried, float(offset), away)
        trial = linear.values.moved(system.unknowns, step, system.constraints)
        away = trial.beyond(radius)
        if len(away):
            trial = trial.confined(away, radius)
        out, others = system.misfits(trial)
        there = float((out**2).sum() + others @ others)
        flat = step.predicted <= _FLAT * cost and there <= cost * (1.0 + 1e-10)
        gain = (cost - there) / step.predicted if np.isfinite(there) and step.predicted > 0 else -1.0
        if gain > 1e-4 or flat:
            linear, cost, growth = system.linearise(trial), there, 2.0
            costs.append(cost)
            shrink = _SHRINK if flat or gain > _GOOD else _SLOWLY if gain > _FAIR else 1.0
            damping = max(damping * shrink, _LEAST_DAMPING)
            if watch is not None:
                watch(tried, cost)
            continue
        damping, growth = max(damping, _LEAST_DAMPING) * growth, growth * 2.0
        if damping > _MOST_DAMPING:
            break
    away = linear.values.beyond(_NEARLY * radius)
    return Iterated(linear, tuple(costs), tried, float("nan"), away, converged=False)


def _extent(system: System, values: Values) -> float:
    """Distance from the centre within which most projection centres or points lie."""
    images = system.unknowns.pose >= 0
    sizes = [np.linalg.norm(part, axis=1) for part in (values.x0[images], values.xyz)]
    return max(float(np.median(size)) if len(size) else 0.0 for size in sizes) or 1.0
