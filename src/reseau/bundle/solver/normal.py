"""Normal equations with the points eliminated: compiled loops over points and their rays.

For each point j with rays k, the blocks V = Σ BᵀB, W = Σ AᵀB and the right-hand side are formed and its part
of the reduced normal equations S = Σ AᵀA − Σ W V⁻¹ Wᵀ is added (Brown 1958; Kraus, *Photogrammetry*;
Förstner & Wrobel 2016, sect. 15.3.3). A ray depends on at most six *segments* of the reduced unknowns: pose,
interior orientation, additional parameters, windows and media, the point itself where it is not eliminated,
and the motion of the camera.

S is an arrow matrix: a band of `bands` unknowns (lower triangle, column by column) and full rows below it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...core.compiled import compiled, kernel
from ...core.data import Array, Rows

SEGMENTS = 6


class Pattern(NamedTuple):
    """Sparsity pattern, in columns over points (p), rays (n) and local segments.

    Point j has the rays `first[j]:first[j+1]`. For each segment of a ray, `start` (n, 6) is its first reduced
    unknown, `width` its number of unknowns, `column` its first column among the derivatives of the ray, and
    `place` its first position among the unknowns that the point depends on. These unknowns are the segments
    `local[j]:local[j+1]` of `at`, `size`, `offset`, in ascending order; `eliminated` (p,) is 1 for
    eliminated points.
    """

    first: Rows
    start: Rows
    width: Rows
    column: Rows
    place: Rows
    local: Rows
    at: Rows
    size: Rows
    offset: Rows
    eliminated: Rows


class Sums(NamedTuple):
    """Arrow matrix S, right-hand sides (u,) before and after elimination, diagonal (u,) before it."""

    band: Array
    border: Array
    gradient: Array
    reduced: Array
    diagonal: Array


def locals_of(first: Rows, start: Rows, width: Rows) -> tuple[Rows, Rows, Rows]:
    """Distinct segments of each point.

    Returns
    -------
    place : ndarray (n, 6)
        First position of each segment of a ray among the unknowns that its point depends on.
    count : ndarray (p,)
        Number of segments of each point.
    table : ndarray (m, 3)
        First reduced unknown, number of unknowns and offset of each; segments that follow each other without
        a gap are one, as long loops are faster.
    """
    place = np.zeros_like(start)
    ray, a = np.nonzero(width)
    point = np.repeat(np.arange(len(first) - 1), np.diff(first))[ray]
    # The rays are in the order of their points, and the segments of a point in that of their unknowns.
    key = point * (start.max(initial=0) + 1) + start[ray, a]
    _, index, which = np.unique(key, return_index=True, return_inverse=True)
    owner, at, size = point[index], start[ray, a][index], width[ray, a][index]
    before = np.cumsum(size) - size
    offset = before - before[np.searchsorted(owner, owner)]
    place[ray, a] = offset[which]
    begins = np.ones(len(at), dtype=bool)
    begins[1:] = (owner[1:] != owner[:-1]) | (at[:-1] + size[:-1] != at[1:])
    joined = np.flatnonzero(begins)
    sizes = np.diff(np.append(before[joined], size.sum()))
    count = np.bincount(owner[joined], minlength=len(first) - 1)
    return place, count, np.column_stack([at[joined], sizes, offset[joined]])


@compiled
def through(rows: Array, image: Rows, blocks: Array, place: int, out: Array) -> None:
    """Write derivatives (n, 2, w + 6) by other unknowns of images, from those by poses (n, 2, w).

    `blocks` (m, 6, 12) are derivatives of the pose of each image by six unknowns, which replace the first
    columns, and by six more, which are inserted at the column `place`.
    """
    w = rows.shape[2]
    for k in range(len(rows)):
        i = image[k]
        for r in range(2):
            for c in range(6, place):
                out[k, r, c] = rows[k, r, c]
            for c in range(place, w):
                out[k, r, c + 6] = rows[k, r, c]
            for c in range(6):
                one, other = 0.0, 0.0
                for q in range(6):
                    one += rows[k, r, q] * blocks[i, q, c]
                    other += rows[k, r, q] * blocks[i, q, c + 6]
                out[k, r, c], out[k, r, place + c] = one, other


@kernel
def _inverse(j: int, v: Array, out: Array) -> float:
    """Invert a symmetric positive definite 3×3 matrix; return the smallest pivot with unit diagonal."""
    s0, s1, s2 = 1.0 / np.sqrt(v[0, 0]), 1.0 / np.sqrt(v[1, 1]), 1.0 / np.sqrt(v[2, 2])
    a, b, c = v[1, 0] * s0 * s1, v[2, 0] * s0 * s2, v[2, 1] * s1 * s2
    d1 = 1.0 - a * a
    e = (c - a * b) / d1
    d2 = 1.0 - b * b - e * e * d1
    # L⁻¹ of the unit triangle L: rows (1), (−a, 1), (a·e − b, −e, 1).
    f = a * e - b
    out[j, 2, 2] = s2 * s2 / d2
    out[j, 2, 1] = -e * s1 * s2 / d2
    out[j, 2, 0] = f * s0 * s2 / d2
    out[j, 1, 1] = (1.0 / d1 + e * e / d2) * s1 * s1
    out[j, 1, 0] = (-a / d1 - e * f / d2) * s0 * s1
    out[j, 0, 0] = (1.0 + a * a / d1 + f * f / d2) * s0 * s0
    out[j, 0, 1], out[j, 0, 2], out[j, 1, 2] = out[j, 1, 0], out[j, 2, 0], out[j, 2, 1]
    return float(min(d1, d2))


@kernel
def _blocks(k: int, rows: Array, misfits: Array, pattern: Pattern, sums: Sums) -> None:
    """Add AᵀA and Aᵀr of one ray to the matrix and the right-hand side."""
    start, width, column, border = pattern.start, pattern.width, pattern.column, sums.border
    bands, r0, r1 = len(sums.band), misfits[k, 0], misfits[k, 1]
    for a in range(SEGMENTS):
        sa, ca = start[k, a], column[k, a]
        for i in range(width[k, a]):
            x0, x1, at = rows[k, 0, ca + i], rows[k, 1, ca + i], sa + i
            if x0 == 0.0 and x1 == 0.0:
                # Most control points of a spline surface.
                continue
            sums.diagonal[at] += x0 * x0 + x1 * x1
            sums.gradient[at] += x0 * r0 + x1 * r1
            for b in range(SEGMENTS):
                sb, cb = start[k, b], column[k, b]
                if width[k, b] == 0 or sb > sa:
                    continue
                if at >= bands:
                    for j in range(min(width[k, b], at - sb + 1)):
                        border[at - bands, sb + j] += x0 * rows[k, 0, cb + j] + x1 * rows[k, 1, cb + j]
                else:
                    for j in range(min(width[k, b], at - sb + 1)):
                        sums.band[sb + j, at - sb - j] += x0 * rows[k, 0, cb + j] + x1 * rows[k, 1, cb + j]


@kernel
def _eliminate(j: int, w: Array, t: Array, pattern: Pattern, sums: Sums) -> None:
    """Add −T Wᵀ of one point to the matrix."""
    bands, border, first = len(sums.band), sums.border, pattern.local[j]
    for a in range(first, pattern.local[j + 1]):
        sa, oa, size = pattern.at[a], pattern.offset[a], pattern.size[a]
        if sa >= bands:
            # Three rows at a time: W is read once for them. What they write above the diagonal is not read.
            full = size - size % 3
            for i in range(0, full, 3):
                o, at = oa + i, sa + i - bands
                a0, a1, a2 = t[o, 0], t[o, 1], t[o, 2]
                b0, b1, b2 = t[o + 1, 0], t[o + 1, 1], t[o + 1, 2]
                c0, c1, c2 = t[o + 2, 0], t[o + 2, 1], t[o + 2, 2]
                if not (a0 or a1 or a2 or b0 or b1 or b2 or c0 or c1 or c2):
                    continue
                for b in range(first, a + 1):
                    sb, ob = pattern.at[b], pattern.offset[b]
                    n = min(pattern.size[b], sa + i + 3 - sb)
                    w0, w1, w2 = w[0, ob : ob + n], w[1, ob : ob + n], w[2, ob : ob + n]
                    one, two = border[at, sb : sb + n], border[at + 1, sb : sb + n]
                    three = border[at + 2, sb : sb + n]
                    for q in range(n):
                        x, y, z = w0[q], w1[q], w2[q]
                        one[q] -= a0 * x + a1 * y + a2 * z
                        two[q] -= b0 * x + b1 * y + b2 * z
                        three[q] -= c0 * x + c1 * y + c2 * z
        else:
            full = 0
        for i in range(full, size):
            t0, t1, t2, at = t[oa + i, 0], t[oa + i, 1], t[oa + i, 2], sa + i
            if t0 == 0.0 and t1 == 0.0 and t2 == 0.0:
                continue
            for b in range(first, a + 1):
                sb, ob = pattern.at[b], pattern.offset[b]
                n = min(pattern.size[b], at - sb + 1)
                w0, w1, w2 = w[0, ob : ob + n], w[1, ob : ob + n], w[2, ob : ob + n]
                if at >= bands:
                    row = border[at - bands, sb : sb + n]
                    for q in range(n):
                        row[q] -= t0 * w0[q] + t1 * w1[q] + t2 * w2[q]
                else:
                    for q in range(n):
                        sums.band[sb + q, at - sb - q] -= t0 * w0[q] + t1 * w1[q] + t2 * w2[q]


@kernel
def _cross(j: int, rows: Array, pattern: Pattern, w: Array) -> None:
    """Compute W of one point (3, m), for the unknowns that it depends on."""
    end = rows.shape[2]
    for q in range(3):
        for i in range(_touched(j, pattern)):
            w[q, i] = 0.0
    for k in range(pattern.first[j], pattern.first[j + 1]):
        for a in range(SEGMENTS):
            place, column = pattern.place[k, a], pattern.column[k, a]
            for i in range(pattern.width[k, a]):
                x0, x1 = rows[k, 0, column + i], rows[k, 1, column + i]
                for q in range(3):
                    w[q, place + i] += x0 * rows[k, 0, end - 3 + q] + x1 * rows[k, 1, end - 3 + q]


@kernel
def _touched(j: int, pattern: Pattern) -> int:
    last = pattern.local[j + 1] - 1
    return pattern.offset[last] + pattern.size[last] if last >= pattern.local[j] else 0


@kernel
def _point(
    j: int, rows: Array, misfits: Array, pattern: Pattern, prior: Array, damping: float, v: Array,
    inverse: Array, side: Array, diagonal: Array,
) -> float:  # fmt: skip
    """Compute V⁻¹, right-hand side and diagonal of one point; return the smallest pivot. `v` is room."""
    last = rows.shape[2] - 3
    for q in range(3):
        v[q, 0], v[q, 1], v[q, 2] = 0.0, 0.0, 0.0
        v[q, q], side[j, q] = prior[j, q, 0], prior[j, q, 1]
    for k in range(pattern.first[j], pattern.first[j + 1]):
        for q in range(3):
            b0, b1 = rows[k, 0, last + q], rows[k, 1, last + q]
            side[j, q] += b0 * misfits[k, 0] + b1 * misfits[k, 1]
            for s in range(q + 1):
                v[q, s] += b0 * rows[k, 0, last + s] + b1 * rows[k, 1, last + s]
    for q in range(3):
        diagonal[j, q] = v[q, q]
        v[q, q] *= 1.0 + damping
    return _inverse(j, v, inverse)


@compiled
def assemble(
    begin: int, end: int, rows: Array, misfits: Array, pattern: Pattern, prior: Array, damping: float,
    sums: Sums, inverse: Array, side: Array, diagonal: Array,
) -> float:  # fmt: skip
    """Form the normal equations of the points begin…end, reduced to the other unknowns.

    `prior` (p, 3, 2) has the weights of observed coordinates (1 for held ones, to avoid division by zero) and
    their weighted misfits. Output: `inverse` (p, 3, 3) is V⁻¹ of the damped V, `side` (p, 3) the right-hand
    side, `diagonal` (p, 3) the undamped diagonal of V. Returns the smallest scaled pivot of V.
    """
    most = 1
    for j in range(begin, end):
        most = max(most, _touched(j, pattern))
    w, t, v, least = np.empty((3, most)), np.empty((most, 3)), np.empty((3, 3)), 1.0
    for j in range(begin, end):
        for k in range(pattern.first[j], pattern.first[j + 1]):
            _blocks(k, rows, misfits, pattern, sums)
        if not pattern.eliminated[j]:
            continue
        least = min(least, _point(j, rows, misfits, pattern, prior, damping, v, inverse, side, diagonal))
        _cross(j, rows, pattern, w)
        for i in range(_touched(j, pattern)):
            for q in range(3):
                t[i, q] = w[0, i] * inverse[j, 0, q] + w[1, i] * inverse[j, 1, q] + w[2, i] * inverse[j, 2, q]
        for a in range(pattern.local[j], pattern.local[j + 1]):
            for i in range(pattern.size[a]):
                o = pattern.offset[a] + i
                part = t[o, 0] * side[j, 0] + t[o, 1] * side[j, 1] + t[o, 2] * side[j, 2]
                sums.reduced[pattern.at[a] + i] -= part
        _eliminate(j, w, t, pattern, sums)
    return least


@compiled
def assemble_blocks(
    begin: int, end: int, rows: Array, misfits: Array, pattern: Pattern, prior: Array, damping: float,
    sums: Sums, inverse: Array, side: Array, diagonal: Array, first: Rows, base: Rows, near: Array,
) -> float:  # fmt: skip
    """Form right-hand sides as :func:`assemble` does, and of the matrix only its diagonal blocks.

    Unknowns with the same `first` (u,) are one block; its row of unknown i begins at `base[i]` of `near`, of
    which the lower triangles are written.
    """
    most = 1
    for j in range(begin, end):
        most = max(most, _touched(j, pattern))
    w, t, v, index, least = np.empty((3, most)), np.empty(3), np.empty((3, 3)), np.empty(most, np.int64), 1.0
    for j in range(begin, end):
        for k in range(pattern.first[j], pattern.first[j + 1]):
            r0, r1 = misfits[k, 0], misfits[k, 1]
            for a in range(SEGMENTS):
                for i in range(pattern.width[k, a]):
                    at, column = pattern.start[k, a] + i, pattern.column[k, a] + i
                    x0, x1 = rows[k, 0, column], rows[k, 1, column]
                    sums.diagonal[at] += x0 * x0 + x1 * x1
                    sums.gradient[at] += x0 * r0 + x1 * r1
                    place = base[at] - first[at]
                    for b in range(SEGMENTS):
                        sb, cb = pattern.start[k, b], pattern.column[k, b]
                        for o in range(pattern.width[k, b]):
                            if sb + o <= at and first[sb + o] == first[at]:
                                near[place + sb + o] += x0 * rows[k, 0, cb + o] + x1 * rows[k, 1, cb + o]
        if not pattern.eliminated[j]:
            continue
        least = min(least, _point(j, rows, misfits, pattern, prior, damping, v, inverse, side, diagonal))
        _cross(j, rows, pattern, w)
        for a in range(pattern.local[j], pattern.local[j + 1]):
            for i in range(pattern.size[a]):
                index[pattern.offset[a] + i] = pattern.at[a] + i
        for i in range(_touched(j, pattern)):
            at = index[i]
            for q in range(3):
                t[q] = w[0, i] * inverse[j, 0, q] + w[1, i] * inverse[j, 1, q] + w[2, i] * inverse[j, 2, q]
            sums.reduced[at] -= t[0] * side[j, 0] + t[1] * side[j, 1] + t[2] * side[j, 2]
            o = i
            while o >= 0 and first[index[o]] == first[at]:
                place = base[at] + index[o] - first[at]
                near[place] -= t[0] * w[0, o] + t[1] * w[1, o] + t[2] * w[2, o]
                o -= 1
    return least


@compiled
def product(
    begin: int, end: int, rows: Array, pattern: Pattern, inverse: Array, x: Array, out: Array
) -> None:
    """Add (Σ AᵀA − Σ W V⁻¹ Wᵀ) x of the points begin…end to `out` (u,), without the matrix."""
    most, last = 1, rows.shape[2] - 3
    for j in range(begin, end):
        most = max(most, pattern.first[j + 1] - pattern.first[j])
    seen, h, g = np.empty((most, 2)), np.empty(3), np.zeros(3)
    for j in range(begin, end):
        k0 = pattern.first[j]
        h[:] = 0.0
        for k in range(k0, pattern.first[j + 1]):
            s0, s1 = 0.0, 0.0
            for a in range(SEGMENTS):
                at, column = pattern.start[k, a], pattern.column[k, a]
                for i in range(pattern.width[k, a]):
                    s0 += rows[k, 0, column + i] * x[at + i]
                    s1 += rows[k, 1, column + i] * x[at + i]
            seen[k - k0, 0], seen[k - k0, 1] = s0, s1
            for q in range(3):
                h[q] += rows[k, 0, last + q] * s0 + rows[k, 1, last + q] * s1
        if pattern.eliminated[j]:
            for q in range(3):
                g[q] = inverse[j, q, 0] * h[0] + inverse[j, q, 1] * h[1] + inverse[j, q, 2] * h[2]
        else:
            g[:] = 0.0
        for k in range(k0, pattern.first[j + 1]):
            s0, s1 = seen[k - k0, 0], seen[k - k0, 1]
            for q in range(3):
                s0 -= rows[k, 0, last + q] * g[q]
                s1 -= rows[k, 1, last + q] * g[q]
            for a in range(SEGMENTS):
                at, column = pattern.start[k, a], pattern.column[k, a]
                for i in range(pattern.width[k, a]):
                    out[at + i] += rows[k, 0, column + i] * s0 + rows[k, 1, column + i] * s1


@compiled
def substitute(
    begin: int, end: int, rows: Array, pattern: Pattern, inverse: Array, side: Array, y: Array, out: Array
) -> None:
    """Compute points (p, 3, s) from right-hand sides `side` (p, 3, s) and reduced unknowns y (u, s)."""
    last, sides = rows.shape[2] - 3, y.shape[1]
    h, step = np.empty(3), np.empty(2)
    for j in range(begin, end):
        if not pattern.eliminated[j]:
            continue
        for c in range(sides):
            for q in range(3):
                h[q] = side[j, q, c]
            for k in range(pattern.first[j], pattern.first[j + 1]):
                step[:] = 0.0
                for a in range(SEGMENTS):
                    at, column = pattern.start[k, a], pattern.column[k, a]
                    for i in range(pattern.width[k, a]):
                        step[0] += rows[k, 0, column + i] * y[at + i, c]
                        step[1] += rows[k, 1, column + i] * y[at + i, c]
                for q in range(3):
                    h[q] -= rows[k, 0, last + q] * step[0] + rows[k, 1, last + q] * step[1]
            for q in range(3):
                out[j, q, c] = inverse[j, q, 0] * h[0] + inverse[j, q, 1] * h[1] + inverse[j, q, 2] * h[2]


@compiled
def reduce_sides(
    begin: int, end: int, rows: Array, pattern: Pattern, inverse: Array, side: Array, out: Array
) -> None:
    """Add −W V⁻¹ times right-hand sides (p, 3, s) of the points to `out` (u, s)."""
    last, sides = rows.shape[2] - 3, side.shape[2]
    h = np.empty(3)
    for j in range(begin, end):
        if not pattern.eliminated[j]:
            continue
        for c in range(sides):
            for q in range(3):
                h[q] = (
                    inverse[j, q, 0] * side[j, 0, c]
                    + inverse[j, q, 1] * side[j, 1, c]
                    + inverse[j, q, 2] * side[j, 2, c]
                )
            for k in range(pattern.first[j], pattern.first[j + 1]):
                x0 = rows[k, 0, last] * h[0] + rows[k, 0, last + 1] * h[1] + rows[k, 0, last + 2] * h[2]
                x1 = rows[k, 1, last] * h[0] + rows[k, 1, last + 1] * h[1] + rows[k, 1, last + 2] * h[2]
                for a in range(SEGMENTS):
                    at, column = pattern.start[k, a], pattern.column[k, a]
                    for i in range(pattern.width[k, a]):
                        out[at + i, c] -= rows[k, 0, column + i] * x0 + rows[k, 1, column + i] * x1


@compiled
def gradients(
    begin: int, end: int, rows: Array, misfits: Array, pattern: Pattern, side: Array, out: Array
) -> None:
    """Add Aᵀr of the points begin…end to `out` (u,), and Bᵀr to `side` (p, 3)."""
    last = rows.shape[2] - 3
    for j in range(begin, end):
        for k in range(pattern.first[j], pattern.first[j + 1]):
            r0, r1 = misfits[k, 0], misfits[k, 1]
            for a in range(SEGMENTS):
                at, column = pattern.start[k, a], pattern.column[k, a]
                for i in range(pattern.width[k, a]):
                    out[at + i] += rows[k, 0, column + i] * r0 + rows[k, 1, column + i] * r1
            if pattern.eliminated[j]:
                for q in range(3):
                    side[j, q] += rows[k, 0, last + q] * r0 + rows[k, 1, last + q] * r1


@kernel
def _entry(band: Array, border: Array, i: int, o: int) -> float:
    """Entry of a symmetric arrow matrix, both triangles of whose full rows are stored."""
    bands = len(band)
    if i >= bands:
        return float(border[i - bands, o])
    if o >= bands:
        return float(border[o - bands, i])
    return float(band[o, i - o]) if i >= o else float(band[i, o - i])


@compiled
def posterior(
    begin: int, end: int, rows: Array, pattern: Pattern, inverse: Array, band: Array, border: Array,
    points: Array, seen: Array,
) -> None:  # fmt: skip
    """Compute cofactors from the inverse Z of the reduced normal equations, stored as they are.

    Only entries inside the band and the full rows are read: both triangles of the latter.

    Written to `points` (p, 3, 3): Q = V⁻¹ + Tᵀ Z T with T = W V⁻¹, for the points; to `seen` (n, 2, 2):
    A Z Aᵀ − A Z T Bᵀ − B Tᵀ Z Aᵀ + B Q Bᵀ, for the adjusted image coordinates, whitened.
    """
    most = 1
    for j in range(begin, end):
        most = max(most, _touched(j, pattern))
    w, t, y, index = np.empty((3, most)), np.zeros((most, 3)), np.zeros((most, 3)), np.empty(most, np.int64)
    cross = np.zeros((2, 3))
    for j in range(begin, end):
        m = _touched(j, pattern) if pattern.eliminated[j] else 0
        if pattern.eliminated[j]:
            _cross(j, rows, pattern, w)
            for a in range(pattern.local[j], pattern.local[j + 1]):
                for i in range(pattern.size[a]):
                    index[pattern.offset[a] + i] = pattern.at[a] + i
            for i in range(m):
                for s in range(3):
                    t[i, s] = (
                        w[0, i] * inverse[j, 0, s] + w[1, i] * inverse[j, 1, s] + w[2, i] * inverse[j, 2, s]
                    )
            for i in range(m):
                y0, y1, y2 = 0.0, 0.0, 0.0
                for o in range(m):
                    x = _entry(band, border, index[i], index[o])
                    y0 += x * t[o, 0]
                    y1 += x * t[o, 1]
                    y2 += x * t[o, 2]
                y[i, 0], y[i, 1], y[i, 2] = y0, y1, y2
            for s in range(3):
                for c in range(3):
                    x = inverse[j, s, c]
                    for i in range(m):
                        x += t[i, s] * y[i, c]
                    points[j, s, c] = x
        for k in range(pattern.first[j], pattern.first[j + 1]):
            _hat(j, k, rows, pattern, band, border, y, points, cross, seen)


@kernel
def _hat(
    j: int, k: int, rows: Array, pattern: Pattern, band: Array, border: Array, y: Array, q: Array,
    cross: Array, out: Array,
) -> None:  # fmt: skip
    """Compute the cofactor (2, 2) of the adjusted coordinates of one ray; `cross` (2, 3) is room."""
    eliminated, last = pattern.eliminated[j], rows.shape[2] - 3
    h00, h01, h11 = 0.0, 0.0, 0.0
    cross[:, :] = 0.0
    for a in range(SEGMENTS):
        for i in range(pattern.width[k, a]):
            at, x0, x1 = pattern.start[k, a] + i, 0.0, 0.0
            for b in range(SEGMENTS):
                sb, cb = pattern.start[k, b], pattern.column[k, b]
                for o in range(pattern.width[k, b]):
                    z = _entry(band, border, at, sb + o)
                    x0 += z * rows[k, 0, cb + o]
                    x1 += z * rows[k, 1, cb + o]
            a0, a1 = rows[k, 0, pattern.column[k, a] + i], rows[k, 1, pattern.column[k, a] + i]
            h00 += a0 * x0
            h01 += a0 * x1
            h11 += a1 * x1
            if eliminated:
                place = pattern.place[k, a] + i
                for s in range(3):
                    cross[0, s] += a0 * y[place, s]
                    cross[1, s] += a1 * y[place, s]
    if eliminated:
        for s in range(3):
            b0, b1 = rows[k, 0, last + s], rows[k, 1, last + s]
            h00 -= 2.0 * cross[0, s] * b0
            h11 -= 2.0 * cross[1, s] * b1
            h01 -= cross[0, s] * b1 + cross[1, s] * b0
            for c in range(3):
                h00 += b0 * q[j, s, c] * rows[k, 0, last + c]
                h01 += b0 * q[j, s, c] * rows[k, 1, last + c]
                h11 += b1 * q[j, s, c] * rows[k, 1, last + c]
    out[k, 0, 0], out[k, 0, 1], out[k, 1, 0], out[k, 1, 1] = h00, h01, h01, h11
