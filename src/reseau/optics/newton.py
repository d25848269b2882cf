"""Newton's method for many points of the plane at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..core.data import Array

# Small enough for the work arrays to stay in the cache, large enough to make NumPy's call overhead
# negligible.
BLOCK = 16384
STEPS = 60
# Number of times a start beyond a fold is halved: to within 1/1000 of the way to the centre.
PULLS = 10
# After a Newton step shorter than this (relative), the error is below rounding.
SHORT_STEP = 1e-10


def solve_2x2(matrix: Array, right: Array) -> Array:
    """Solve n systems of two equations, (n, 2, 2) with (n, 2) or (n, 2, u); not finite where singular."""
    a, b, c, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 1, 1]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        adjugate = np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], -2)
        inverse = adjugate / (a * d - b * c)[:, None, None]
        solution: Array = inverse @ (right[..., None] if right.ndim == 2 else right)
    return solution[..., 0] if right.ndim == 2 else solution


def determinant(matrix: Array) -> Array:
    """Determinants of (n, 2, 2) matrices."""
    return matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0]


def in_blocks(function: Callable[[Array], Array], xy: Array) -> Array:
    """Apply a function of points to a large array of points, block by block."""
    if len(xy) <= BLOCK:
        return function(xy)
    return np.concatenate([function(xy[i : i + BLOCK]) for i in range(0, len(xy), BLOCK)])


def newton(
    slope_at: Callable[[Array], tuple[Array, Array]], target: Array, start: Array, centre: Array
) -> Array:
    """Solve f(xy) = target for arrays by Newton's method with damping.

    A point is accepted if its *undamped* step is short, which is true at a root only; a stuck point is
    therefore not mistaken for a solution. A step that would change the orientation of the mapping (the sign
    of the determinant of its derivatives) from that at the centre crosses a fold and is rejected.

    Parameters
    ----------
    slope_at : callable
        Function that returns f (n, 2) and its derivatives (n, 2, 2) at points (n, 2).
    target, start : ndarray (n, 2)
        Required values of f, and start points.
    centre : ndarray (1, 2)
        A point of the required branch.

    Returns
    -------
    ndarray (n, 2)
        Solutions; NaN where there was no convergence.
    """
    found = np.full(target.shape, np.nan)
    rows = np.flatnonzero(np.isfinite(target).all(1) & np.isfinite(start).all(1))
    with np.errstate(all="ignore"):
        side = np.sign(determinant(slope_at(centre)[1]))
        xy, goal = start[rows], target[rows]
        value, slope = _before_the_fold(slope_at, xy, centre, side)
        damping = np.ones(len(rows))
        for _ in range(STEPS):
            error = goal - value
            step = solve_2x2(slope, error)
            length = np.hypot(step[:, 0], step[:, 1])
            done = length <= SHORT_STEP * (1 + np.hypot(xy[:, 0], xy[:, 1]))
            found[rows[done]] = (xy + step)[done]
            on = ~done & np.isfinite(length) & (damping > 1e-6)
            if not on.any():
                break
            rows, xy, goal, value, slope = rows[on], xy[on], goal[on], value[on], slope[on]
            damping, step, error = damping[on], step[on], error[on]
            trial = xy + damping[:, None] * step
            new_value, new_slope = slope_at(trial)
            better = ((goal - new_value) ** 2).sum(1) < (error**2).sum(1)
            better &= determinant(new_slope) * side > 0
            xy[better], value[better], slope[better] = trial[better], new_value[better], new_slope[better]
            damping = np.where(better, np.minimum(1.0, 4 * damping), damping / 4)
    return found


def _before_the_fold(
    slope_at: Callable[[Array], tuple[Array, Array]], xy: Array, centre: Array, side: Array
) -> tuple[Array, Array]:
    """Move starts beyond a fold towards the centre, in place; return values and derivatives there."""
    value, slope = slope_at(xy)
    for _ in range(PULLS):
        behind = ~(determinant(slope) * side > 0)
        if not behind.any():
            break
        xy[behind] = (xy[behind] + centre) / 2
        value[behind], slope[behind] = slope_at(xy[behind])
    return value, slope
