"""Products and sums of rows of pixels, and small normal equations, compiled.

A library for matrices takes three times as long for so few rows.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.compiled import compiled

__all__ = [
    "TOGETHER",
    "Floats",
    "Index",
    "add_squares",
    "add_weighted",
    "factorised",
    "fill_normal",
    "fill_weighted",
    "multiply",
    "product",
    "solve",
    "without_common",
]

Floats = NDArray[Any]
Index = int | np.signedinteger[Any]
"""A number as `np.intp` keeps a constant from a specialisation of its own."""

_SINGULAR = 1e-12
"""As in :mod:`reseau.adjust.batch`."""
TOGETHER = 1024
"""Number of pixels whose derivatives are multiplied together: they fit into a cache."""
f32 = np.float32
_ANY_ORDER = frozenset({"reassoc", "nsz", "contract"})
"""Sums may be formed in any order, as several at once."""


@compiled
def product(a: Floats, b: Floats, begin: Index, end: Index) -> float:
    """Scalar product of a part, as four sums side by side: each waits for its own last addition only.

    A slice of an array would take longer than its product.
    """
    fours, one, two, three, four = end - (end - begin) % 4, 0.0, 0.0, 0.0, 0.0
    for i in range(begin, fours, 4):
        one += a[i] * b[i]
        two += a[i + 1] * b[i + 1]
        three += a[i + 2] * b[i + 2]
        four += a[i + 3] * b[i + 3]
    for i in range(fours, end):
        one += a[i] * b[i]
    return (one + two) + (three + four)


@compiled(fastmath=_ANY_ORDER)
def _with_four(a: Floats, one: Floats, two: Floats, three: Floats, four: Floats) -> tuple[Any, Any, Any, Any]:
    """Scalar products of a row with four others, which load it once."""
    w = x = y = z = f32(0)
    for i in range(len(a)):
        w += a[i] * one[i]
        x += a[i] * two[i]
        y += a[i] * three[i]
        z += a[i] * four[i]
    return w, x, y, z


@compiled(fastmath=_ANY_ORDER)
def _with_one(a: Floats, b: Floats) -> Any:
    """Scalar product."""
    total = f32(0)
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@compiled
def fill_normal(jacobian: Floats, normal: Floats) -> None:
    """Fill the products (u, u) of the rows of a Jacobian (u, n).

    A library for matrices takes three times as long for so few rows. Sums of parts are in double precision.
    """
    u, n = jacobian.shape
    normal[:] = 0.0
    for begin in range(0, n, TOGETHER):
        end = min(begin + TOGETHER, n)
        for i in range(u):
            a, m = jacobian[i, begin:end], 0
            while m + 4 <= i + 1:
                w, x, y, z = _with_four(
                    a,
                    jacobian[m, begin:end],
                    jacobian[m + 1, begin:end],
                    jacobian[m + 2, begin:end],
                    jacobian[m + 3, begin:end],
                )
                normal[i, m] += w
                normal[i, m + 1] += x
                normal[i, m + 2] += y
                normal[i, m + 3] += z
                m += 4
            while m <= i:
                normal[i, m] += _with_one(a, jacobian[m, begin:end])
                m += 1
    for i in range(u):
        for m in range(i):
            normal[m, i] = normal[i, m]


@compiled
def multiply(a: Floats, b: Floats, out: Floats) -> None:
    """a · b; few arrays, so that the compiler can prove that they do not overlap."""
    for i in range(len(out)):
        out[i] = a[i] * b[i]


@compiled
def add_weighted(factors: Floats, begin: Index, rows: Floats, out: Floats) -> None:
    """Add `rows` (m, n), times factors from `begin` on, to `out` (n,): three at a time, each of them once."""
    m, n = 0, len(out)
    while m + 3 <= len(rows):
        a, b, c = factors[begin + m], factors[begin + m + 1], factors[begin + m + 2]
        one, two, three = rows[m], rows[m + 1], rows[m + 2]
        for i in range(n):
            out[i] += a * one[i] + b * two[i] + c * three[i]
        m += 3
    while m < len(rows):
        a, one = factors[begin + m], rows[m]
        for i in range(n):
            out[i] += a * one[i]
        m += 1


@compiled(fastmath=_ANY_ORDER)
def _add_three(a: float, b: float, c: float, one: Floats, two: Floats, three: Floats, out: Floats) -> None:
    for i in range(len(out)):
        out[i] += a * one[i] + b * two[i] + c * three[i]


@compiled(fastmath=_ANY_ORDER)
def _add_one(a: float, one: Floats, out: Floats) -> None:
    for i in range(len(out)):
        out[i] += a * one[i]


@compiled
def fill_weighted(factors: Floats, first: Index, rows: Floats, begin: Index, out: Floats) -> None:
    """Fill `out` (k,) with columns of `rows` (m, n) from `begin` on, times factors (m,) from `first` on."""
    out[:] = f32(0)
    m, end = first, begin + len(out)
    while m + 3 <= len(rows):
        parts = rows[m, begin:end], rows[m + 1, begin:end], rows[m + 2, begin:end]
        _add_three(factors[m], factors[m + 1], factors[m + 2], *parts, out)
        m += 3
    while m < len(rows):
        _add_one(factors[m], rows[m, begin:end], out)
        m += 1


@compiled
def add_squares(part: Floats, out: Floats) -> None:
    """Add the squares of a row to another one."""
    for i in range(len(out)):
        out[i] += part[i] * part[i]


@compiled
def without_common(values: Floats, slope: Floats, weighted: Floats, columns: int, part: Floats) -> None:
    """Subtract from each row its common error along `slope`; see `Patches.whiten`.

    `part` is memory of the kind of `values`. Loops over all rows together are faster than one for each row.
    """
    n = len(values)
    for i in range(n):
        part[i] = weighted[i] * values[i]
    for first in range(0, n, columns):
        end = first + columns
        fours, zero = end - columns % 4, part.dtype.type(0)
        one, two, three, four = zero, zero, zero, zero
        for i in range(first, fours, 4):
            one += part[i]
            two += part[i + 1]
            three += part[i + 2]
            four += part[i + 3]
        for i in range(fours, end):
            one += part[i]
        total = (one + two) + (three + four)
        for i in range(first, end):
            part[i] = total
    for i in range(n):
        values[i] -= slope[i] * part[i]


@compiled
def factorised(normal: Floats, damping: float, scale: Floats, lower: Floats) -> bool:
    """Cholesky factor of normal equations scaled to a unit diagonal; False where they are singular."""
    u = len(normal)
    for i in range(u):
        scale[i] = 1.0 / math.sqrt(normal[i, i]) if normal[i, i] > 0 else 1.0
    for i in range(u):
        for j in range(i + 1):
            total = normal[i, j] * scale[i] * scale[j] + (damping if i == j else 0.0)
            for m in range(j):
                total -= lower[i, m] * lower[j, m]
            if i > j:
                lower[i, j] = total / lower[j, j]
            elif total > _SINGULAR:
                lower[i, i] = math.sqrt(total)
            else:
                return False
    return True


@compiled
def solve(lower: Floats, right: Floats) -> None:
    """Solve L Lᵀ x = right in place."""
    u = len(right)
    for i in range(u):
        for m in range(i):
            right[i] -= lower[i, m] * right[m]
        right[i] /= lower[i, i]
    for i in range(u - 1, -1, -1):
        for m in range(i + 1, u):
            right[i] -= lower[m, i] * right[m]
        right[i] /= lower[i, i]
