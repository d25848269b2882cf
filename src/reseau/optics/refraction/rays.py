"""Exact rays through refracting surfaces, by Newton's method on Fermat's principle, with all derivatives.

The optical path ``L = Σ n_j |Q_{j+1} − Q_j|`` from the projection centre ``Q_0 = 0`` through points ``Q_j``
on the surfaces ``φ_j(Q_j) = 0`` to the object point is stationary. Newton's method solves for the points in
the tangent planes of the surfaces; the matrix is block-tridiagonal with 2 × 2 blocks::

    H_jj = T_jᵀ (∂²L/∂Q_j² + μ_j ∂²φ_j) T_j,   H_j,j+1 = T_jᵀ ∂²L/∂Q_j∂Q_{j+1} T_{j+1},

with the multiplier μ_j of the surface. The direction of the first segment is what the camera images. Its
derivatives follow from two adjoint solutions with the same matrix: by the implicit function theorem, for a
parameter θ of a surface, −Σ_j (μ_j λ_j·∂∇φ_j/∂θ + ν_j ∂φ_j/∂θ).

The rays are computed in the camera system: a window on the camera does not move with the pose, and a change
of the pose moves the object point and the windows on the object.

Sources: Kotowski 1988, Int. Archives of Photogrammetry 27(B5), 323–333 (rays through any refracting surfaces
in the bundle); Agrawal, Ramalingam, Taguchi, Chari 2012, A theory of multi-layer flat refractive geometry,
CVPR (closed forms for planes, with which these rays are compared in the tests).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple, Self

import numpy as np

from ...core.compiled import compiled, kernel
from ...core.data import Array, Mask, Rows
from .windows import RefractionColumns

# Largest tangential component of Snell's condition at the solution; an image point is exact to 1e-9 px.
_CONVERGED = 1e-12
# Rounding, beside which another step gains nothing.
_EXACT = 1e-14
_ITERATIONS, _HALVINGS = 60, 30


@kernel
def _on_surface(kind: int, s: Array, q: Array) -> None:
    """Move a point to the surface (for a plane along its normal, otherwise along the radius), in place."""
    d0, d1, d2 = q[0] - s[3], q[1] - s[4], q[2] - s[5]
    along = s[0] * d0 + s[1] * d1 + s[2] * d2
    if kind == 0:
        w0, w1, w2 = d0 - along * s[0], d1 - along * s[1], d2 - along * s[2]
        square = s[6] * s[6] * (w0 * w0 + w1 * w1 + w2 * w2)
        # Beyond the equator of a curved window the point stays at the height of the equator.
        height = 0.0
        if s[6] != 0.0:
            height = s[6] * (w0 * w0 + w1 * w1 + w2 * w2) / (1.0 + np.sqrt(max(1.0 - square, 0.0)))
        q[0], q[1], q[2] = s[3] + w0 + height * s[0], s[4] + w1 + height * s[1], s[5] + w2 + height * s[2]
        return
    if kind == 1:
        along = 0.0
    w0, w1, w2 = d0 - along * s[0], d1 - along * s[1], d2 - along * s[2]
    size = np.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    f = s[6] / size if size > 0 else 0.0
    q[0] = s[3] + along * s[0] + f * w0
    q[1] = s[4] + along * s[1] + f * w1
    q[2] = s[5] + along * s[2] + f * w2


@kernel
def _gradient(kind: int, s: Array, q: Array, out: Array) -> None:
    """Write the gradient of the equation of a surface at a point of it."""
    d0, d1, d2 = q[0] - s[3], q[1] - s[4], q[2] - s[5]
    if kind == 0:
        out[0], out[1], out[2] = s[0] - s[6] * d0, s[1] - s[6] * d1, s[2] - s[6] * d2
        return
    along = 0.0
    if kind == 2:
        along = s[0] * d0 + s[1] * d1 + s[2] * d2
    out[0] = (d0 - along * s[0]) / s[6]
    out[1] = (d1 - along * s[1]) / s[6]
    out[2] = (d2 - along * s[2]) / s[6]


@kernel
def _crossing(kind: int, side: float, s: Array, x: Array, q: Array) -> None:
    """Write where the straight line from the origin to x crosses a surface, or a point near it."""
    a = b = c = 0.0
    if kind == 0:
        c = -(s[0] * s[3] + s[1] * s[4] + s[2] * s[5])
        b = s[0] * x[0] + s[1] * x[1] + s[2] * x[2]
        f = -c / b if b != 0.0 else 0.5
    else:
        ux = uv = 0.0
        if kind == 2:
            ux = s[0] * x[0] + s[1] * x[1] + s[2] * x[2]
            uv = s[0] * s[3] + s[1] * s[4] + s[2] * s[5]
        for i in range(3):
            dx, dv = x[i] - ux * s[i], s[3 + i] - uv * s[i]
            a += dx * dx
            b += dx * dv
            c += dv * dv
        c -= s[6] * s[6]
        square = b * b - a * c
        f = b / a if a > 0 else 0.5
        if square > 0 and a > 0:
            f += side * np.sqrt(square) / a
    f = min(max(f, 1e-6), 1.0 - 1e-6)
    for i in range(3):
        q[i] = f * x[i]
    _on_surface(kind, s, q)


@kernel
def _segments(count: int, q: Array, x: Array, e: Array, length: Array) -> None:
    """Write unit vectors and lengths of the segments from the origin through the points to x."""
    for j in range(count + 1):
        total = 0.0
        for i in range(3):
            end = x[i] if j == count else q[j, i]
            begin = 0.0 if j == 0 else q[j - 1, i]
            e[j, i] = end - begin
            total += e[j, i] * e[j, i]
        length[j] = np.sqrt(total)
        for i in range(3):
            e[j, i] /= length[j]


@kernel
def _conditions(
    count: int, kind: Rows, s: Array, index: Array, q: Array, e: Array, g: Array, t: Array, mu: Array,
    f: Array,
) -> float:  # fmt: skip
    """Write gradients g, tangents t, multipliers and Snell's conditions f; return the largest condition.

    f_j is the component of n_{j−1} e_{j−1} − n_j e_j in the tangent plane.
    """
    worst = 0.0
    for j in range(count):
        _gradient(kind[j], s[j], q[j], g[j])
        n0, n1, n2 = g[j, 0], g[j, 1], g[j, 2]
        size = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        n0, n1, n2 = n0 / size, n1 / size, n2 / size
        # Two perpendicular tangents without a branch near a pole (Duff et al. 2017).
        sign = 1.0 if n2 >= 0 else -1.0
        a = -1.0 / (sign + n2)
        b = n0 * n1 * a
        t[j, 0, 0], t[j, 0, 1], t[j, 0, 2] = 1.0 + sign * n0 * n0 * a, sign * b, -sign * n0
        t[j, 1, 0], t[j, 1, 1], t[j, 1, 2] = b, sign + n1 * n1 * a, -n1
        h0 = index[j] * e[j, 0] - index[j + 1] * e[j + 1, 0]
        h1 = index[j] * e[j, 1] - index[j + 1] * e[j + 1, 1]
        h2 = index[j] * e[j, 2] - index[j + 1] * e[j + 1, 2]
        mu[j] = -(h0 * n0 + h1 * n1 + h2 * n2) / size
        for k in range(2):
            f[j, k] = t[j, k, 0] * h0 + t[j, k, 1] * h1 + t[j, k, 2] * h2
            worst = max(worst, abs(f[j, k]))
    return worst


@kernel
def _matrix(
    count: int, kind: Rows, s: Array, index: Array, e: Array, length: Array, t: Array, mu: Array, d: Array,
    o: Array,
) -> None:  # fmt: skip
    """Write the blocks of the matrix: d (k, 2, 2) on the diagonal, o (k, 2, 2) to its right."""
    for j in range(count):
        before, after = index[j] / length[j], index[j + 1] / length[j + 1]
        bend = -mu[j] * s[j, 6] if kind[j] == 0 else mu[j] / s[j, 6]
        # The tangents are perpendicular unit vectors.
        e0 = t[j, 0, 0] * e[j, 0] + t[j, 0, 1] * e[j, 1] + t[j, 0, 2] * e[j, 2]
        e1 = t[j, 1, 0] * e[j, 0] + t[j, 1, 1] * e[j, 1] + t[j, 1, 2] * e[j, 2]
        f0 = t[j, 0, 0] * e[j + 1, 0] + t[j, 0, 1] * e[j + 1, 1] + t[j, 0, 2] * e[j + 1, 2]
        f1 = t[j, 1, 0] * e[j + 1, 0] + t[j, 1, 1] * e[j + 1, 1] + t[j, 1, 2] * e[j + 1, 2]
        d[j, 0, 0] = before * (1.0 - e0 * e0) + after * (1.0 - f0 * f0) + bend
        d[j, 1, 1] = before * (1.0 - e1 * e1) + after * (1.0 - f1 * f1) + bend
        d[j, 0, 1] = -before * e0 * e1 - after * f0 * f1
        if kind[j] == 2:
            u0 = t[j, 0, 0] * s[j, 0] + t[j, 0, 1] * s[j, 1] + t[j, 0, 2] * s[j, 2]
            u1 = t[j, 1, 0] * s[j, 0] + t[j, 1, 1] * s[j, 1] + t[j, 1, 2] * s[j, 2]
            d[j, 0, 0] -= bend * u0 * u0
            d[j, 1, 1] -= bend * u1 * u1
            d[j, 0, 1] -= bend * u0 * u1
        d[j, 1, 0] = d[j, 0, 1]
        if j + 1 < count:
            for m in range(2):
                a = t[j + 1, m, 0] * e[j + 1, 0] + t[j + 1, m, 1] * e[j + 1, 1] + t[j + 1, m, 2] * e[j + 1, 2]
                for k in range(2):
                    tt = 0.0
                    for i in range(3):
                        tt += t[j, k, i] * t[j + 1, m, i]
                    o[j, k, m] = -after * (tt - (f0 if k == 0 else f1) * a)


@kernel
def _eliminate(count: int, d: Array, o: Array, inverse: Array) -> bool:
    """Write the inverses of the diagonal blocks after elimination from above; False where singular."""
    for j in range(count):
        a, b, c, e = d[j, 0, 0], d[j, 0, 1], d[j, 1, 0], d[j, 1, 1]
        if j > 0:
            for k in range(2):
                for m in range(2):
                    total = 0.0
                    for p in range(2):
                        for r in range(2):
                            total += o[j - 1, p, k] * inverse[j - 1, p, r] * o[j - 1, r, m]
                    if k == 0 and m == 0:
                        a -= total
                    elif k == 0:
                        b -= total
                    elif m == 0:
                        c -= total
                    else:
                        e -= total
        det = a * e - b * c
        if not abs(det) > 0:
            return False
        inverse[j, 0, 0], inverse[j, 0, 1] = e / det, -b / det
        inverse[j, 1, 0], inverse[j, 1, 1] = -c / det, a / det
    return True


@kernel
def _solve(count: int, o: Array, inverse: Array, right: Array) -> None:
    """Solve for one right-hand side (k, 2), in place."""
    for j in range(1, count):
        a = inverse[j - 1, 0, 0] * right[j - 1, 0] + inverse[j - 1, 0, 1] * right[j - 1, 1]
        b = inverse[j - 1, 1, 0] * right[j - 1, 0] + inverse[j - 1, 1, 1] * right[j - 1, 1]
        right[j, 0] -= o[j - 1, 0, 0] * a + o[j - 1, 1, 0] * b
        right[j, 1] -= o[j - 1, 0, 1] * a + o[j - 1, 1, 1] * b
    for j in range(count - 1, -1, -1):
        a, b = right[j, 0], right[j, 1]
        if j + 1 < count:
            a -= o[j, 0, 0] * right[j + 1, 0] + o[j, 0, 1] * right[j + 1, 1]
            b -= o[j, 1, 0] * right[j + 1, 0] + o[j, 1, 1] * right[j + 1, 1]
        right[j, 0] = inverse[j, 0, 0] * a + inverse[j, 0, 1] * b
        right[j, 1] = inverse[j, 1, 0] * a + inverse[j, 1, 1] * b


@kernel
def _ray(
    count: int, kind: Rows, side: Array, s: Array, index: Array, x: Array, q: Array, trial: Array, e: Array,
    length: Array, g: Array, t: Array, mu: Array, f: Array, d: Array, o: Array, inverse: Array, step: Array,
    begun: bool,
) -> bool:  # fmt: skip
    """Find the ray to x; write its points q and all else at them. False where there is none.

    Newton's method begins at the points q if they are near those of the ray, otherwise on the straight line.
    """
    for j in range(count):
        if begun:
            _on_surface(kind[j], s[j], q[j])
        else:
            _crossing(kind[j], side[j], s[j], x, q[j])
    _segments(count, q, x, e, length)
    worst = _conditions(count, kind, s, index, q, e, g, t, mu, f)
    found, near = worst <= _EXACT, False
    for _ in range(_ITERATIONS):
        _matrix(count, kind, s, index, e, length, t, mu, d, o)
        if not _eliminate(count, d, o, inverse):
            return False
        if found:
            break
        norm = 0.0
        for j in range(count):
            for k in range(2):
                norm += f[j, k] * f[j, k]
                step[j, k] = -f[j, k]
        _solve(count, o, inverse, step)
        # A step beyond the size of the arrangement would leave the branch of the ray.
        factor, better = 1.0, False
        for j in range(count):
            size = np.sqrt(step[j, 0] * step[j, 0] + step[j, 1] * step[j, 1])
            most = length[j] + length[j + 1]
            if not size <= most / factor:
                factor = most / size
        if not factor > 0:
            return False
        # Rounding leaves the conditions at some 1e-15: at the solution no step can be better.
        for _halving in range(_HALVINGS):
            for j in range(count):
                for i in range(3):
                    by = step[j, 0] * t[j, 0, i] + step[j, 1] * t[j, 1, i]
                    trial[j, i] = q[j, i] + factor * by
                _on_surface(kind[j], s[j], trial[j])
            _segments(count, trial, x, e, length)
            worst = _conditions(count, kind, s, index, trial, e, g, t, mu, f)
            total = 0.0
            for j in range(count):
                total += f[j, 0] * f[j, 0] + f[j, 1] * f[j, 1]
            if total < norm or worst <= _CONVERGED:
                better = True
                break
            factor *= 0.5
            # The tangents of the step are those of the last accepted points.
            _segments(count, q, x, e, length)
            _conditions(count, kind, s, index, q, e, g, t, mu, f)
        if not better:
            return False
        for j in range(count):
            for i in range(3):
                q[j, i] = trial[j, i]
        # A ray must not depend on where its search began: one more step where this one was long.
        found = worst <= _EXACT or (near and worst <= _CONVERGED)
        near = worst <= _CONVERGED
    if not found:
        return False
    # The surfaces lie between camera and object, in their order.
    for j in range(count):
        before = after = 0.0
        for i in range(3):
            before += e[j, i] * g[j, i]
            after += e[j + 1, i] * g[j, i]
        if not (side[j] * before > 0 and side[j] * after > 0):
            return False
    return True


@kernel
def _by_adjoint(
    count: int, kind: Rows, s: Array, index: Array, q: Array, e: Array, length: Array, g: Array, t: Array,
    mu: Array, o: Array, inverse: Array, step: Array, along: Array, to: Array, by_x: Array, by_s: Array,
    by_index: Array,
) -> None:  # fmt: skip
    """Write the derivatives of to·Q_1 by the object point (3,), the surfaces (k, 7) and the indices (k + 1,).

    `to` (3,) is the derivative of one component of the direction by Q_1.
    """
    for j in range(count):
        for k in range(2):
            step[j, k] = 0.0
            if j == 0:
                step[j, k] = t[0, k, 0] * to[0] + t[0, k, 1] * to[1] + t[0, k, 2] * to[2]
    _solve(count, o, inverse, step)
    for j in range(count):
        for i in range(3):
            along[j + 1, i] = step[j, 0] * t[j, 0, i] + step[j, 1] * t[j, 1, i]
    for i in range(3):
        along[0, i] = along[count + 1, i] = 0.0
    last = index[count] / length[count]
    le = along[count, 0] * e[count, 0] + along[count, 1] * e[count, 1] + along[count, 2] * e[count, 2]
    for i in range(3):
        by_x[i] = last * (along[count, i] - le * e[count, i])
    for j in range(count + 1):
        by_index[j] = 0.0
        for i in range(3):
            by_index[j] -= (along[j + 1, i] - along[j, i]) * e[j, i]
    for j in range(count):
        # ν along the normal: what the stationarity of the adjoint leaves there.
        size = g[j, 0] ** 2 + g[j, 1] ** 2 + g[j, 2] ** 2
        before, after = index[j] / length[j], index[j + 1] / length[j + 1]
        le = lf = pe = qe = lu = 0.0
        for i in range(3):
            le += along[j + 1, i] * e[j, i]
            lf += along[j + 1, i] * e[j + 1, i]
            pe += along[j, i] * e[j, i]
            qe += along[j + 2, i] * e[j + 1, i]
            lu += along[j + 1, i] * s[j, i]
        nu = lq = 0.0
        for i in range(3):
            h = before * (along[j + 1, i] - le * e[j, i]) + after * (along[j + 1, i] - lf * e[j + 1, i])
            h -= before * (along[j, i] - pe * e[j, i]) + after * (along[j + 2, i] - qe * e[j + 1, i])
            if kind[j] == 2:
                h += mu[j] / s[j, 6] * (along[j + 1, i] - lu * s[j, i])
            if j == 0:
                nu += to[i] * g[j, i] / size
            nu -= h * g[j, i] / size
            lq += along[j + 1, i] * (q[j, i] - s[j, 3 + i])
        # Derivatives of the equation of the surface and of its gradient by what describes it.
        m = mu[j]
        if kind[j] == 0:
            square = 0.0
            for i in range(3):
                p = q[j, i] - s[j, 3 + i]
                square += p * p
                by_s[j, i] = -(m * along[j + 1, i] + nu * p)
                by_s[j, 3 + i] = -(m * s[j, 6] * along[j + 1, i] - nu * g[j, i])
            by_s[j, 6] = m * lq + nu * 0.5 * square
            continue
        r, uq = s[j, 6], 0.0
        if kind[j] == 2:
            for i in range(3):
                uq += s[j, i] * (q[j, i] - s[j, 3 + i])
        lg = 0.0
        for i in range(3):
            p = q[j, i] - s[j, 3 + i]
            lg += along[j + 1, i] * g[j, i]
            by_s[j, i] = 0.0
            across = along[j + 1, i]
            if kind[j] == 2:
                by_s[j, i] = (m * (lu * p + uq * along[j + 1, i]) + nu * uq * p) / r
                across -= lu * s[j, i]
            by_s[j, 3 + i] = m * across / r + nu * g[j, i]
        by_s[j, 6] = m * lg / r + nu


@kernel
def _rays(
    begin: int, end: int, image: Rows, point: Rows, columns: RefractionColumns, path_of: Rows, placed: Array,
    rotation: Array, x0: Array, xyz: Array, derivatives: bool, uv: Array, by: Array, reached: Mask,
    crossings: Array,
) -> None:  # fmt: skip
    """Compute the rays begin…end; `placed` (m, k, 7) are the surfaces of each image in its camera system.

    Rays begin at `crossings` (n, k, 3), which are not NaN where they are known, and write theirs.
    """
    longest, parameters = columns.kind.shape[1], columns.by_parameters.shape[3]
    x, to, by_x = np.empty(3), np.empty(3), np.empty(3)
    q, trial, g = np.empty((longest, 3)), np.empty((longest, 3)), np.empty((longest, 3))
    e, length, along = np.empty((longest + 1, 3)), np.empty(longest + 1), np.empty((longest + 2, 3))
    t, mu, f, step = (
        np.empty((longest, 2, 3)),
        np.empty(longest),
        np.empty((longest, 2)),
        np.empty((longest, 2)),
    )
    d, o, inverse = np.empty((longest, 2, 2)), np.empty((longest, 2, 2)), np.empty((longest, 2, 2))
    by_s, by_index, at = np.empty((longest, 7)), np.empty(longest + 1), np.empty(3)
    spin, moved = np.empty(3), np.empty(3)
    for k in range(begin, end):
        i, p = image[k], path_of[image[k]]
        if p < 0:
            continue
        a, b, c = xyz[point[k], 0] - x0[i, 0], xyz[point[k], 1] - x0[i, 1], xyz[point[k], 2] - x0[i, 2]
        for r in range(3):
            x[r] = rotation[i, r, 0] * a + rotation[i, r, 1] * b + rotation[i, r, 2] * c
        count, s = columns.surfaces[p], placed[i]
        kind, side, index = columns.kind[p], columns.side[p], columns.indices[p]
        begun = len(crossings) > 0 and not np.isnan(crossings[k, 0, 0])
        if begun:
            q[:] = crossings[k]
        reached[k] = _ray(
            count, kind, side, s, index, x, q, trial, e, length, g, t, mu, f, d, o, inverse, step, begun
        )  # fmt: skip
        if begun and not reached[k]:
            reached[k] = _ray(
                count, kind, side, s, index, x, q, trial, e, length, g, t, mu, f, d, o, inverse, step, False
            )  # fmt: skip
        if len(crossings) > 0:
            crossings[k] = q
            if not reached[k]:
                crossings[k, 0, 0] = np.nan
        first = q[0]
        if not reached[k]:
            first = x
        w = first[2]
        uv[k, 0], uv[k, 1] = first[0] / w, first[1] / w
        if not derivatives:
            continue
        for row in range(2):
            to[0], to[1], to[2] = 0.0, 0.0, -first[row] / (w * w)
            to[row] = 1.0 / w
            for r in range(by.shape[2]):
                by[k, row, r] = 0.0
            for r in range(3):
                spin[r], moved[r] = 0.0, 0.0
            if reached[k]:
                _by_adjoint(
                    count, kind, s, index, q, e, length, g, t, mu, o, inverse, step, along, to, by_x, by_s,
                    by_index,
                )  # fmt: skip
            else:
                by_x[0], by_x[1], by_x[2] = to[0], to[1], to[2]
            # A turn of the camera turns the object point and the surfaces on the object about it.
            spin[0] = x[1] * by_x[2] - x[2] * by_x[1]
            spin[1] = x[2] * by_x[0] - x[0] * by_x[2]
            spin[2] = x[0] * by_x[1] - x[1] * by_x[0]
            for r in range(3):
                moved[r] = by_x[r]
            if reached[k]:
                for j in range(count):
                    if columns.on_object[p, j]:
                        for r in range(3):
                            one, two = (r + 1) % 3, (r + 2) % 3
                            spin[r] += s[j, one] * by_s[j, two] - s[j, two] * by_s[j, one]
                            spin[r] += s[j, 3 + one] * by_s[j, 3 + two] - s[j, 3 + two] * by_s[j, 3 + one]
                            moved[r] += by_s[j, 3 + r]
                        for part in (0, 3):
                            for r in range(3):
                                at[r] = (
                                    rotation[i, 0, r] * by_s[j, part]
                                    + rotation[i, 1, r] * by_s[j, part + 1]
                                    + rotation[i, 2, r] * by_s[j, part + 2]
                                )
                            for r in range(3):
                                by_s[j, part + r] = at[r]
                    for z in range(parameters):
                        total = 0.0
                        for r in range(7):
                            total += by_s[j, r] * columns.by_parameters[p, j, r, z]
                        by[k, row, 9 + z] += total
                for j in range(count + 1):
                    if columns.index_of[p, j] >= 0:
                        by[k, row, 9 + columns.index_of[p, j]] += by_index[j]
            for r in range(3):
                by[k, row, r] = spin[r]
                for m in range(3):
                    by[k, row, 3 + m] -= moved[r] * rotation[i, r, m]
                    by[k, row, 6 + m] += by_x[r] * rotation[i, r, m]


class RefractedRays(NamedTuple):
    """Directions in which cameras see object points through windows.

    Parameters
    ----------
    uv : ndarray (n, 2)
        Ideal directions u = x/z, v = y/z of the first segments, in the camera system; not set for images in
        air. Where there is no ray through the windows in their order, the direction of the straight line.
    by : ndarray (n, 2, 9 + f)
        Derivatives by the rotation about the axes of the camera (3), the projection centre (3), the object
        point (3) and the free parameters of the windows and media; empty (n, 2, 0) unless asked for.
    reached : ndarray of bool (n,)
        Whether there is a ray through the windows in their order; False for images in air.

    Examples
    --------
    A point 100 in front of the camera, seen through a surface of water at 40; Snell's law is satisfied:

    >>> from reseau.optics.refraction import Window
    >>> from reseau.optics.refraction.windows import Refraction, RefractiveIndex
    >>> media = (RefractiveIndex("air", 1.0), RefractiveIndex("water", 1.333))
    >>> surface = Window("surface", "plane", "camera", {"distance": 40.0}, ("air", "water"))
    >>> refraction = Refraction(media, (surface,), ((0,),), np.array([0]))
    >>> rays = RefractedRays.of(refraction.columns(refraction.values), refraction.path_of, np.eye(3)[None],
    ...     np.zeros((1, 3)), np.array([[50.0, 0.0, 100.0]]), np.array([0]), np.array([0]))
    >>> u = rays.uv[0, 0]
    >>> w = (50 - 40 * u) / 60
    >>> bool(abs(u / np.hypot(1, u) - 1.333 * w / np.hypot(1, w)) < 1e-12)
    True
    """

    uv: Array
    by: Array
    reached: Mask

    @classmethod
    def empty(cls, n: int, width: int) -> Self:
        """Room for n rays with this number of derivatives."""
        return cls(np.zeros((n, 2)), np.zeros((n if width else 0, 2, width)), np.zeros(n, np.bool_))

    @classmethod
    def of(
        cls, columns: RefractionColumns, path_of: Rows, rotation: Array, x0: Array, xyz: Array, image: Rows,
        point: Rows, *, derivatives: bool = False,
    ) -> Self:  # fmt: skip
        """Compute rays.

        Parameters
        ----------
        columns : RefractionColumns
            Paths of windows; those on the object in the system of `xyz`.
        path_of : ndarray of int (m,)
            Path of each image; −1 for images in air, whose rays are left out.
        rotation, x0 : ndarray (m, 3, 3), (m, 3)
            Poses.
        xyz : ndarray (p, 3)
            Object points.
        image, point : ndarray of int (n,)
            Image and point of each ray.
        derivatives : bool
            Whether to compute the derivatives.
        """
        width = 9 + columns.by_parameters.shape[3] if derivatives else 0
        rays = cls.empty(len(image), width)
        work = cls.worker(columns, path_of, rotation, x0, xyz, image, point, rays)
        work(0, len(image))
        return rays

    @staticmethod
    def worker(
        columns: RefractionColumns, path_of: Rows, rotation: Array, x0: Array, xyz: Array, image: Rows,
        point: Rows, rays: RefractedRays, crossings: Array | None = None,
    ) -> Callable[[int, int], None]:  # fmt: skip
        """Return a function that computes the rays begin…end, for threads; see :meth:`of`.

        `crossings` (n, k, 3) are points in camera axes where the rays cross the surfaces, NaN where they are
        not known; each ray is sought from there first, and its own are written. They save more than half of
        the time where the same rays are computed again for slightly different poses and points.
        """
        placed = _placed(columns, path_of, rotation, x0)
        known = np.zeros((0, 1, 3)) if crossings is None else crossings

        def work(begin: int, end: int) -> None:
            _compiled_rays()(
                begin, end, image, point, columns, path_of, placed, rotation, x0, xyz, rays.by.shape[2] > 0,
                rays.uv, rays.by, rays.reached, known,
            )  # fmt: skip

        return work

    @classmethod
    def beside(
        cls, columns: RefractionColumns, path: int, rotation: Array, x0: Array, begin: Array, end: Array
    ) -> Self:  # fmt: skip
        """Compute rays from points near the projection centre of an image: through points of its stop.

        Parameters
        ----------
        columns : RefractionColumns
            Paths of windows.
        path : int
            Path of the image.
        rotation, x0 : ndarray (3, 3), (3,)
            Its pose.
        begin, end : ndarray (n, 3)
            Ends of the rays in camera axes: near the projection centre, and behind the windows.
        """
        n, path_of = len(begin), np.full(1, path, np.intp)
        primitives, moving = columns.primitives.copy(), columns.on_object.copy()
        # Camera axes are those of an object system in which every ray has a centre of its own.
        primitives[path], moving[path] = _placed(columns, path_of, rotation[None], x0[None])[0], True
        still = columns._replace(primitives=primitives, on_object=moving)
        every = np.arange(n)
        turned = np.tile(np.eye(3), (n, 1, 1))
        return cls.of(still, np.full(n, path, np.intp), turned, begin, end, every, every)


def _placed(columns: RefractionColumns, path_of: Rows, rotation: Array, x0: Array) -> Array:
    """Surfaces (m, k, 7) of each image in its camera system."""
    if not len(columns.primitives):
        return np.zeros((len(path_of), 0, 7))
    rows = np.maximum(path_of, 0)
    placed = columns.primitives[rows].copy()
    moving = columns.on_object[rows]
    turned = np.einsum("mij,mkj->mki", rotation, placed[:, :, :3])
    shifted = np.einsum("mij,mkj->mki", rotation, placed[:, :, 3:6] - x0[:, None, :])
    placed[:, :, :3] = np.where(moving[:, :, None], turned, placed[:, :, :3])
    placed[:, :, 3:6] = np.where(moving[:, :, None], shifted, placed[:, :, 3:6])
    return placed


@cache
def _compiled_rays() -> Callable[..., Any]:
    return compiled(_rays)
