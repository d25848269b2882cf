"""Images of many small shapes in single precision; in double precision responses, and gridded images.

The sums are those of :mod:`reseau.optics.formation`; here they are computed shape by shape, so that they fit
into a cache, the normal distribution comes from a table, and a node of an outline is evaluated only in the
rows and columns within its reach, all nodes of a shape in one loop.
"""

from __future__ import annotations

from math import erfc, sqrt
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..core.compiled import Instruction, compiled

Single = NDArray[Any]
Double = NDArray[Any]

_SIDE = 5.0
"""End of the table of the normal distribution in standard deviations; 6e-7 of the light is outside."""
PER_SIGMA = 64
"""Entries of tables per standard deviation; with two more terms of the series, accurate to 1e-7."""


_FAR = 8.5
"""The same for double precision; 1e-17 of the light is outside."""


def normal_table(far: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distribution and density of the normal distribution at steps of 1/64 from −far to far.

    Examples
    --------
    >>> float(normal_table(1.0)[0][64])
    0.5
    """
    z = np.arange(-far * PER_SIGMA, far * PER_SIGMA + 1) / PER_SIGMA
    step = np.array([0.5 * erfc(-each * sqrt(0.5)) for each in z])
    return step, np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)


_FINE_STEP, _FINE_BELL = normal_table(_FAR)
_STEP, _BELL = (values.astype(np.float32) for values in normal_table(_SIDE))
f32 = np.float32
_FREE = frozenset({"nnan", "ninf", "nsz"})
"""Assumptions allowed to the compiler. Sums must not be reordered, and products not be fused into sums: both
would make the last bits depend on the compilation. (Products of matrices are left to BLAS.)
"""


@compiled(fastmath=_FREE)
def _edges(
    offset: Single, count: int, shift: np.float32, inverse: np.float32, step: Single, bell: Single
) -> None:
    """Distribution and density at (offset + shift) · inverse."""
    for k in range(count):
        z = (offset[k] + shift) * inverse
        z = min(max(z, f32(-_SIDE)), f32(_SIDE))
        # An unsigned index needs no check for negative values, so that the loop is vectorised.
        i = np.uint32((z + f32(_SIDE)) * f32(PER_SIGMA) + f32(0.5))
        middle = f32(i) * f32(1 / PER_SIGMA) - f32(_SIDE)
        d = z - middle
        b = _BELL[i]
        step[k] = _STEP[i] + b * d * (f32(1) - f32(0.5) * d * middle)
        bell[k] = b * (f32(1) - d * (middle - f32(0.5) * d * (middle * middle - f32(1))))


@Instruction
def _add_eight(context: Any, sums: Any, at: Any, factors: Any, rows: Any, begin: Any) -> Any:
    """Add factors[k] · rows[k, begin : begin + 8] to sums[k, at : at + 8] with vector instructions.

    The compiler would leave loops as short as these in single numbers. There are no checks of the limits.

    Parameters
    ----------
    sums, rows : tuple of ndarray (n,)
        As many as there are factors; a row may be given several times, and is read once.
    """

    from llvmlite import ir
    from numba import types
    from numba.np.arrayobj import make_array

    def code(target: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        eight = ir.VectorType(ir.FloatType(), 8)

        def place(group: int, k: int, index: Any) -> Any:
            array = builder.extract_value(arguments[group], k)
            array_type = cast(Any, make_array)(signature.args[group].types[k])
            data = array_type(target, builder, array).data
            return builder.bitcast(builder.gep(data, [index]), eight.as_pointer())

        count = len(signature.args[2])
        values = [builder.load(place(3, k, arguments[4]), align=4) for k in range(count)]
        for k, value in enumerate(values):
            factor = ir.Constant(eight, ir.Undefined)
            for i in range(8):
                one = builder.extract_value(arguments[2], k)
                factor = builder.insert_element(factor, one, ir.Constant(ir.IntType(32), i))
            sum_ = place(0, k, arguments[1])
            product = builder.fmul(factor, value)
            builder.store(builder.fadd(builder.load(sum_, align=4), product), sum_, align=4)
        return target.get_dummy_value()

    return types.void(sums, types.intp, factors, rows, types.intp), code


@compiled(fastmath=_FREE)
def _steps(offset: Single, count: int, shift: np.float32, inverse: np.float32, step: Single) -> None:
    """Distribution at (offset + shift) · inverse, as in :func:`_edges`."""
    for k in range(count):
        z = (offset[k] + shift) * inverse
        z = min(max(z, f32(-_SIDE)), f32(_SIDE))
        i = np.uint32((z + f32(_SIDE)) * f32(PER_SIGMA) + f32(0.5))
        middle = f32(i) * f32(1 / PER_SIGMA) - f32(_SIDE)
        d = z - middle
        step[k] = _STEP[i] + _BELL[i] * d * (f32(1) - f32(0.5) * d * middle)


@compiled(fastmath=_FREE)
def _responses(
    points: Single,
    n: int,
    sigma: np.float32,
    half: np.float32,
    whole: Any,
    complete: Any,
    first: Single,
    work: Single,
    out: Single,
) -> int:
    """Integral, value and derivative (3, j·s) of the response to light at points (j,), for s pixels each.

    Pixels are at 0, 1, … n − 1; `first` (j,) is filled with the first one with a response. Returns s, a
    multiple of `whole`. The integral is 0 before and 1 after them. Only the value is needed if not
    `complete`. Loops over all points are much faster than loops over the pixels of each.
    """
    reach, lag = f32(_SIDE) * sigma + half, 1 if half == f32(0.5) else 0
    stride = (int(min(f32(2) * reach, f32(n))) + lag + whole) // whole * whole
    count = len(points) * stride
    offset, per, inverse = work[4], f32(0.5) / half, f32(1) / sigma
    for j in range(len(points)):
        first[j] = min(max(int(np.ceil(points[j] - reach)), 0), n)
        begin = f32(first[j]) - points[j] - half
        for k in range(stride):
            offset[j * stride + k] = begin + f32(k)
    if complete:
        _edges(offset, count, f32(0), inverse, work[0], work[1])
    else:
        _steps(offset, count, f32(0), inverse, work[0])
    if lag == 0 and complete:  # otherwise adjacent pixels share an edge
        _edges(offset, count, f32(2) * half, inverse, work[2], work[3])
    elif lag == 0:
        _steps(offset, count, f32(2) * half, inverse, work[2])
    before, bell = work[0, : count - lag], work[1, : count - lag]
    beyond, bells = (work[0, 1:count], work[1, 1:count]) if lag else (work[2, :count], work[3, :count])
    integral, value, slope = out[0], out[1], out[2]
    # Loops over few arrays each, so that the compiler can prove that these do not overlap.
    for k in range(count - lag):
        value[k] = (beyond[k] - before[k]) * per
    for k in range(count - lag if complete else 0):
        slope[k] = (bells[k] - bell[k]) * (inverse * per)
    for k in range(count - lag if complete else 0):
        integral[k] = offset[k] * value[k] + beyond[k] + sigma * sigma * slope[k]
    if lag:  # the second edge of the last pixel is the first one of the next point
        for j in range(len(points)):
            k = (j + 1) * stride - 1
            integral[k], value[k], slope[k] = f32(1), f32(0), f32(0)
    return int(stride)


@compiled(fastmath=_FREE)
def formed(
    nodes: Single,
    tangents: Single,
    generators: Single,
    at: Single,
    place: Single,
    form: Single,
    sigma: Single,
    fill: float,
    parts: Single,
) -> None:
    """Form share and derivatives of shapes whose outlines are multiplied by 1 + Σ p_i F_i.

    Parameters
    ----------
    nodes, tangents : ndarray (k, j, 2)
        Nodes of outlines, and tangents times weights; see :class:`reseau.optics.formation.Outline`.
    generators : ndarray (m, 2, 2)
        The generators F_i.
    at : ndarray of int (n,)
        Indices of the outlines.
    place : ndarray (n, 2)
        Positions of their origins, from the centre of the first pixel of each window.
    form : ndarray (n, m)
        The p_i.
    sigma : ndarray (n,)
        Widths of the point-spread function.
    fill : float
        Light-sensitive share of the pitch.
    parts : ndarray (n, 1, r, c) or (n, 4 + m, r, c)
        The share and, if there is space for them, its derivatives by shifts along x and y, width, and forms.
    """
    half, (count, high, wide), most = f32(max(fill, 1e-6) / 2), parts.shape[1:], nodes.shape[1]
    size = most * (max(high, wide) + 9)
    work, of_x, of_y = np.empty((5, size), f32), np.empty((3, size), f32), np.empty((3, size), f32)
    x, y, dx, dy = np.empty(most, f32), np.empty(most, f32), np.empty(most, f32), np.empty(most, f32)
    first_x, first_y = np.empty(most, np.intp), np.empty(most, np.intp)
    normals, grown = np.empty((most, len(generators)), f32), np.empty((2, 2), f32)
    # Light to the right of a window is added to columns beyond it.
    behind, sums = np.empty((high, wide + 1), f32), np.empty(count * high * (2 * wide + 9), f32)
    for k in range(len(at)):
        grown[:] = f32(0)
        grown[0, 0], grown[1, 1] = f32(1), f32(1)
        for m in range(len(generators)):
            grown += form[k, m] * generators[m]
        n = 0
        for j in range(most):
            u, v = tangents[at[k], j, 0], tangents[at[k], j, 1]
            if u == 0 and v == 0:
                continue
            dx[n], dy[n] = grown[0, 0] * u + grown[0, 1] * v, grown[1, 0] * u + grown[1, 1] * v
            u, v = nodes[at[k], j, 0], nodes[at[k], j, 1]
            x[n] = grown[0, 0] * u + grown[0, 1] * v + place[k, 0]
            y[n] = grown[1, 0] * u + grown[1, 1] * v + place[k, 1]
            for m in range(len(generators)):
                f = generators[m]
                normals[n, m] = (f[0, 0] * u + f[0, 1] * v) * dy[n] - (f[1, 0] * u + f[1, 1] * v) * dx[n]
            n += 1
        tall = _responses(y[:n], high, sigma[k], half, np.intp(1), count > 1, first_y, work, of_y)
        broad = _responses(x[:n], wide, sigma[k], half, np.intp(8), np.bool_(True), first_x, work, of_x)
        row, behind[:] = wide + broad, f32(0)
        part = high * row
        sums[: count * part] = f32(0)
        integral, value, slope = of_x[0], of_x[1], of_x[2]
        reach, share = f32(_SIDE) * sigma[k] + half, sums
        if count > 1:
            slopes = sums[part:], sums[2 * part :], sums[3 * part :], sums
        for j in range(n):
            begin, beyond = j * broad, min(first_x[j] + broad, wide)
            u, v, widths = dx[j], dy[j], sigma[k]
            last = min(int(y[j] + reach) + 2, first_y[j] + tall, high)
            for r in range(first_y[j], last):
                down, bend = of_y[1, j * tall + r - first_y[j]], of_y[2, j * tall + r - first_y[j]]
                covered, to = -v * down, r * row + first_x[j]
                behind[r, beyond] += covered
                if count == 1:
                    for c in range(0, broad, 8):
                        _add_eight((share,), to + c, (covered,), (integral,), begin + c)
                    continue
                four = v * down, -u * down, widths * u * bend, covered
                for c in range(0, broad, 8):
                    _add_eight(slopes, to + c, four, (value, value, value, integral), begin + c)
                    _add_eight((slopes[2],), to + c, (widths * covered,), (slope,), begin + c)
                for m in range(count - 4):
                    for c in range(0, broad, 8):
                        to_form = (4 + m) * part + to + c
                        _add_eight((sums,), to_form, (normals[j, m] * down,), (value,), begin + c)
        for p in range(count):
            for r in range(high):
                line, out = sums[p * part + r * row : p * part + r * row + wide], parts[k, p, r]
                for c in range(wide):
                    out[c] = line[c]
        # Outside the reach of nodes their integral is 1: add all at once.
        for r in range(high):
            total = f32(0)
            for c in range(wide):
                total += behind[r, c]
                parts[k, 0, r, c] += total


@compiled(fastmath=_FREE)
def responses(points: Single, first: Single, sigma: Single, out: Single) -> None:
    """Integral, value and derivative of the response of adjacent pixels, in double precision.

    Between the entries of the table the distribution has six terms of its series and the density as many:
    their errors are below 1e-14.

    Parameters
    ----------
    points : ndarray (k, j)
        Coordinates of light along an axis.
    first : ndarray (k,)
        The first of the adjacent pixels.
    sigma : ndarray (k,)
        Widths of the point-spread function.
    out : ndarray (3, k, j, c)
        The responses of c pixels.
    """
    count = out.shape[3]
    step, bell, whole = np.empty(count + 1), np.empty(count + 1), np.empty(count + 1)
    for k in range(len(points)):
        inverse = 1.0 / sigma[k]
        for j in range(points.shape[1]):
            begin = first[k] - 0.5 - points[k, j]
            low = min(max(int(np.ceil(-_FAR * sigma[k] - begin)), 0), count + 1)
            high = min(max(int(np.floor(_FAR * sigma[k] - begin)) + 1, low), count + 1)
            for c in range(low):
                step[c], bell[c], whole[c] = 0.0, 0.0, 0.0
            for c in range(high, count + 1):
                step[c], bell[c], whole[c] = 1.0, 0.0, begin + c
            for c in range(low, high):
                t = begin + c
                z = t * inverse
                i = np.uint32((z + _FAR) * PER_SIGMA + 0.5)
                m = np.float64(i) * (1.0 / PER_SIGMA) - _FAR
                d, m2 = z - m, m * m
                # Hermite polynomials over factorials.
                h2, h3 = (m2 - 1.0) * (1 / 2), m * (m2 - 3.0) * (1 / 6)
                h4, h5 = (m2 * (m2 - 6.0) + 3.0) * (1 / 24), m * (m2 * (m2 - 10.0) + 15.0) * (1 / 120)
                b = _FINE_BELL[i]
                series = h3 * (1 / 4) - d * (h4 * (1 / 5) - d * (h5 * (1 / 6)))
                step[c] = _FINE_STEP[i] + b * d * (1.0 - d * (m * (1 / 2) - d * (h2 * (1 / 3) - d * series)))
                bell[c] = b * (1.0 - d * (m - d * (h2 - d * (h3 - d * (h4 - d * h5)))))
                whole[c] = t * step[c] + sigma[k] * bell[c]
            for c in range(count):
                out[0, k, j, c] = whole[c + 1] - whole[c]
            for c in range(count):
                out[1, k, j, c] = step[c + 1] - step[c]
            for c in range(count):
                out[2, k, j, c] = (bell[c + 1] - bell[c]) * inverse


@compiled(fastmath=_FREE)
def _basis(t: float, out: Double) -> None:
    """Values (6,) of the B-spline of fifth degree around a point, at t ∈ [0, 1) of its cell."""
    for side in range(2):
        u = t if side == 0 else 1.0 - t
        # Fifth powers of the distances from the ends of the spline's pieces, over 5!.
        a, b, c = (1.0 - u) ** 5 / 120, (2.0 - u) ** 5 / 120, (3.0 - u) ** 5 / 120
        out[5 * side] = a
        out[1 + 3 * side] = b - 6 * a
        out[2 + side] = c - 6 * b + 15 * a


@compiled(fastmath=_FREE)
def gathered(at: Double, weights: Double, cells: Double) -> None:
    """Add the weights (q, j) of nodes at (2, j), in cells, to the cells (q, r, c) around them."""
    of_x, of_y = np.empty(6), np.empty(6)
    for j in range(at.shape[1]):
        column, row = int(np.floor(at[0, j])), int(np.floor(at[1, j]))
        _basis(at[0, j] - column, of_x)
        _basis(at[1, j] - row, of_y)
        for q in range(len(weights)):
            for m in range(6):
                factor = weights[q, j] * of_y[m]
                line = cells[q, row - 2 + m, column - 2 : column + 4]
                for k in range(6):
                    line[k] += factor * of_x[k]


@compiled(fastmath=_FREE)
def filtered(cells: Double, taps: Double, low: int, per_px: int, summed: Double, out: Double) -> None:
    """Filter cells (g, m) with taps (q, t): out[i, q] = Σ taps[q, k] cells[per_px i − low − k].

    The first filter goes on with the value 1 to the left: sums (g + 1, m) of the cells there are added.
    """
    count, width = len(cells), taps.shape[1]
    backwards = np.ascontiguousarray(taps[:, ::-1])
    for i in range(len(out)):
        last = per_px * i - low + 1
        first = last - width
        a, b = min(max(first, 0), count), min(max(last, 0), count)
        if b > a:
            part = np.ascontiguousarray(backwards[:, a - first : b - first])
            out[i] = np.dot(part, cells[a:b])
        else:
            out[i] = 0.0
        if len(summed):
            out[i, 0] += summed[a]
