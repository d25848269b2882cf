"""Numerical derivatives, and the comparison of a Jacobian with them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..core.data import Array, Mask

# Truncation (h⁴) balances rounding (ε/h) at ε^(1/5) where x is the only scale; less is safer where it is not.
_STEP = float(np.finfo(np.float64).eps) ** 0.25


def differences(function: Callable[[Array], Array], x: Array, columns: Mask | None = None) -> Array:
    """Jacobian by central differences of fourth order (Abramowitz & Stegun 1964, ch. 25).

    Parameters
    ----------
    function : callable
        Maps x (u,) to an ndarray of any shape.
    x : ndarray (u,)
        Point of differentiation.
    columns : ndarray of bool (u,), optional
        Columns to compute; the others are zero.

    Returns
    -------
    ndarray (..., u)
        Derivatives, of the shape of the function's value + (u,).
    """
    with np.errstate(all="ignore"):
        return _differences(function, x, np.ones(len(x), bool) if columns is None else columns)


def _differences(function: Callable[[Array], Array], x: Array, columns: Mask) -> Array:
    here = np.asarray(function(x), dtype=np.float64)
    jacobian = np.zeros((*here.shape, len(x)))
    for j in np.flatnonzero(columns):
        h = _STEP * abs(x[j]) if x[j] != 0 else _step_from_zero(function, x, int(j), here)
        value = []
        for multiple in (-2.0, -1.0, 1.0, 2.0):
            moved = x.copy()
            moved[j] = x[j] + multiple * h
            value.append((np.asarray(function(moved), dtype=np.float64), moved[j] - x[j]))
        (f_2, _), (f_1, d_1), (f1, d1), (f2, _) = value
        jacobian[..., j] = (8.0 * (f1 - f_1) - (f2 - f_2)) / (6.0 * (d1 - d_1))
    return jacobian


def _step_from_zero(function: Callable[[Array], Array], x: Array, j: int, here: Array) -> float:
    """A step for a value of zero, which has no scale: the function is nearly linear within this step."""

    def slope(h: float) -> Array:
        moved = x.copy()
        moved[j] = h
        return (np.asarray(function(moved), dtype=np.float64) - here) / h

    noise = 10 * float(np.finfo(np.float64).eps) * float(np.abs(here).max(initial=0.0))

    def straight(narrow: Array, wide: Array, h: float) -> bool:
        # Not a number is not straight either.
        bent = float(np.abs(wide - narrow).max(initial=0.0))
        return bent <= 1e-3 * float(np.abs(narrow).max(initial=0.0)) + noise / h

    h: float = _STEP
    narrow, wide = slope(h / 10.0), slope(h)
    for _ in range(30):
        if straight(narrow, wide, h / 10.0):
            break
        h, wide = h / 10.0, narrow
        narrow = slope(h / 10.0)
    # And wide enough for the change to stand out of the rounding of the function.
    for _ in range(30):
        size = float(np.abs(wide).max(initial=0.0))
        if size == 0 or noise / h <= 1e-10 * size:
            break
        wider = slope(10.0 * h)
        if not straight(wide, wider, h):
            break
        h, wide = 10.0 * h, wider
    return h
