"""Cofactors from the rows of all observations by orthogonal transformations, without normal equations.

The rows F = A − B V⁻¹ Wᵀ of all observations, with points eliminated, satisfy FᵀF = S, and their condition
number is the square root of that of S: the triangle R of F = Q R keeps digits that S loses (Golub & Van Loan,
*Matrix Computations*, ch. 5). An example are thousands of images that form a chain: it bends as a whole by
many times the uncertainty of neighbours relative to each other.

R is computed block by block of the band, each time from the last rows of the block before and the rows of the
points that begin in it (Lawson & Hanson 1974, *Solving least squares problems*, ch. 27). A root C of the
inverse, Z = C Cᵀ, of the columns of a block and of those that follow it is computed from the last block to
the first: with R = (R₁ R₂) the rows of the block, and C₂ a root for the columns that follow,

    C = ( R₁⁻¹  −R₁⁻¹ R₂ C₂ )
        (  0         C₂     )

The cofactors of adjusted observations are those of F C. They are of the order of one where Z is of the order
of the squared condition number, and have the digits that F Z Fᵀ would lose.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy

from ...core.compiled import compiled
from ...core.data import Array, Mask, Rows, rows_of_groups
from .arrow import Arrow, Singular
from .linear import Linear
from .normal import SEGMENTS, Pattern

# Columns that are completed at once, and rows that are added to a triangle at once.
_BLOCK, _ROWS = 64, 600
# Standard deviation of an unknown, relative to that with all others known, from which on it is rounding.
ROUNDING = 1e12


@dataclass(frozen=True, eq=False)
class FromRows:
    """Cofactors of the reduced unknowns (u,), the points and the image coordinates.

    Parameters
    ----------
    arrow : Arrow
        Factors of the normal equations.
    band, border : ndarray (b, w + 1), (u − b, u)
        Entries of the inverse inside the band, and its full rows; zero for held unknowns.
    points : ndarray (p, 3, 3)
        Of eliminated points.
    seen : ndarray (n, 2, 2)
        Of the adjusted image coordinates, whitened, in the order of points.
    """

    arrow: Arrow
    band: Array
    border: Array
    points: Array
    seen: Array


@dataclass(frozen=True, eq=False)
class _Block:
    """A block of columns.

    `columns` (w,) are those of its window: `size` of its own, those that follow inside the band, and the full
    rows, from the place `inside` on. `points` are the points whose first column is in it, those with the
    nearest last columns first, `others` the rows of other observations, `held` the held columns that no block
    before it has.
    """

    columns: Rows
    size: int
    inside: int
    points: Rows
    others: Rows
    held: Rows


@dataclass(frozen=True, eq=False)
class _Part:
    """Rows of some points of a block, for the first `inside` columns of its window and the full rows.

    F (2 n + 3 p, w) of image and object coordinates, D = V⁻¹Wᵀ (3 p, w), V⁻¹ (p, 3, 3), B V⁻¹ Bᵀ (n, 2, 2)
    of the rays, and which rows of F are those of rays.
    """

    inside: int
    f: scipy.sparse.csr_array
    d: scipy.sparse.csr_array
    points: Array
    seen: Array
    by_ray: Mask


def cofactors_from_rows(linear: Linear, held: Mask, most: float = ROUNDING) -> FromRows:
    """Compute cofactors from the rows of the observations.

    Parameters
    ----------
    linear : Linear
        The linear problem at the estimates; without a stage or a rig.
    held : ndarray of bool (u,)
        Held reduced unknowns.
    most : float
        Largest standard deviation of an unknown relative to that with all others known.

    Raises
    ------
    Singular
        When the rows do not determine the other unknowns, or one of them less precisely than this.
    """
    rows, blocks = _Rows(linear, held), _blocks(linear, held)
    found = _inverted(rows, blocks, _triangles(rows, blocks))
    b = len(found.band)
    diagonal = np.concatenate([found.band[:, 0], np.diagonal(found.border[:, b:])])
    if not (diagonal * rows.squares < most**2).all():
        raise Singular
    return found


def _blocks(linear: Linear, held: Mask) -> list[_Block]:
    """Blocks in ascending order; the last one has what depends on full rows alone."""
    unknowns, pattern, others = linear.system.unknowns, linear.system.pattern, linear.other_rows
    b, u = unknowns.bands, unknowns.size
    starts = range(0, max(b, 1), _BLOCK)

    def block_of(indices: Rows, first: Rows) -> Rows:
        """Block of each row, from the lowest of its columns; −1 for a row without any."""
        some, found = np.diff(first) > 0, np.full(len(first) - 1, -1)
        if some.any():
            lowest = np.minimum.reduceat(indices, first[:-1][some])
            found[some] = np.minimum(lowest // _BLOCK, len(starts) - 1)
        return found

    of_point = block_of(pattern.at, pattern.local)
    of_point[of_point < 0] = len(starts) - 1
    # Short triangles are formed first, for the points that touch few columns.
    ends = last_columns(pattern, b)
    nearest = np.argsort(ends, kind="stable").astype(np.intp)
    points = [nearest[rows] for rows in rows_of_groups(of_point[nearest], len(starts))]
    of_other, found = block_of(others.indices, others.indptr), []
    for k, begin in enumerate(starts):
        end = min(begin + _BLOCK, b)
        inside = min(end + unknowns.bandwidth, b) - begin
        columns = np.concatenate([np.arange(begin, begin + inside), np.arange(b, u)])
        own = columns if k == len(starts) - 1 else columns[: end - begin]
        still = np.flatnonzero(held[own])
        found.append(_Block(columns, end - begin, inside, points[k], np.flatnonzero(of_other == k), still))
    return found


class _Rows:
    """Rows F of the observations with points eliminated, formed for some points at a time.

    `squares` (u,) are the squared lengths of the columns, once all have been added.
    """

    def __init__(self, linear: Linear, held: Mask) -> None:
        self.linear, self.held = linear, held
        self.pattern, self.rows = linear.system.pattern, linear.turned_rows
        self.roots = np.sqrt(linear.prior[:, :, 0])
        first, some = self.pattern.local, np.diff(self.pattern.local) > 0
        self.touched: Rows = np.zeros(len(some), dtype=np.intp)
        if some.any():
            self.touched[some] = np.add.reduceat(self.pattern.size, first[:-1][some])
        self.rays: Rows = np.diff(self.pattern.first)
        self.observed: Mask = np.asarray((self.roots > 0).any(axis=1))
        self.squares = np.zeros(linear.system.unknowns.size)
        self.ends = last_columns(self.pattern, linear.system.unknowns.bands)

    def of_points(self, block: _Block) -> Iterator[tuple[Rows, _Part]]:
        """Points of a block some at a time, and their rows."""
        total = np.cumsum(self._height(block.points))
        if len(total):
            part = total // _ROWS
            for points in np.split(block.points, np.flatnonzero(np.diff(part)) + 1):
                yield points, self._part(block, points)

    def of_others(self, block: _Block) -> Array:
        """Rows of the other observations of a block, and unit rows of held columns."""
        found = self.linear.other_rows[block.others][:, block.columns].toarray()
        found[:, self.held[block.columns]] = 0.0
        return np.concatenate([found, np.eye(len(block.columns))[block.held]])

    def _height(self, points: Rows) -> Rows:
        """Number of rows of points."""
        return np.asarray(2 * self.rays[points] + 3 * self.observed[points])

    def _part(self, block: _Block, points: Rows) -> _Part:
        k, height, parts = self.rays[points], self._height(points), []
        first_column = int(block.columns[0]) if len(block.columns) else 0
        inside = int(np.clip(self.ends[points].max() - first_column, 0, block.inside))
        for count in (height, np.full(len(points), 3)):
            begin = np.concatenate([[0], np.cumsum(np.repeat(self.touched[points], count))])
            parts.append((begin, np.zeros(begin[-1], dtype=np.intp), np.zeros(begin[-1])))
        (first, column, f), (first_d, column_d, d) = parts
        inverse, seen = np.zeros((len(points), 3, 3)), np.zeros((int(k.sum()), 2, 2))
        eliminated_rows(
            points, self.rows, self.pattern, self.roots, self.observed, column, f, column_d, d, inverse, seen
        )
        matrices = []
        for begin, columns, values in ((first, column, f), (first_d, column_d, d)):
            values[self.held[columns]] = 0.0
            bands = self.linear.system.unknowns.bands
            place = np.where(columns < bands, columns - first_column, columns - bands + inside)
            shape = (len(begin) - 1, inside + len(block.columns) - block.inside)
            matrices.append(scipy.sparse.csr_array((values, place, begin), shape=shape))
        by_ray = np.ones(len(first) - 1, dtype=bool)
        ends = np.cumsum(height)[self.observed[points]]
        by_ray[ends[:, None] - [1, 2, 3]] = False
        return _Part(inside, matrices[0], matrices[1], inverse, seen, by_ray)


def _triangles(rows: _Rows, blocks: list[_Block]) -> list[Array]:
    """Rows of R of each block (size, w); of the last block, all that are left."""
    full = len(blocks[0].columns) - blocks[0].inside
    found, carried, shared = list[Array](), np.zeros((0, full)), 0
    for k, block in enumerate(blocks):
        own, inside = np.zeros((0, full)), 0
        for _, part in rows.of_points(block):
            own = _triangle(np.concatenate([_widened(own, inside, part.inside), part.f.toarray()]))
            inside = part.inside
        new = np.concatenate([_widened(own, inside, block.inside), rows.of_others(block)])
        rows.squares[block.columns] += (new**2).sum(axis=0)
        triangle = _triangle(np.concatenate([_widened(carried, shared, block.inside), new]))
        size = block.size if k < len(blocks) - 1 else len(block.columns)
        pivots = np.abs(np.diagonal(triangle)[:size])
        if len(pivots) < size or not (pivots > 0).all():
            raise Singular
        found.append(triangle[:size].copy())
        # The columns that follow this block are the first of the next one, then the full rows.
        carried, shared = triangle[size:, block.size :], block.inside - block.size
    return found


def _widened(rows: Array, inside: int, wider: int) -> Array:
    """Insert columns of zeros between those inside the band and the full rows."""
    between = np.zeros((len(rows), wider - inside))
    return np.concatenate([rows[:, :inside], between, rows[:, inside:]], axis=1)


def _triangle(rows: Array) -> Array:
    """R of the QR factors of rows."""
    return np.asarray(np.linalg.qr(rows, mode="r"), dtype=np.float64)


def _inverted(rows: _Rows, blocks: list[_Block], triangles: list[Array]) -> FromRows:
    """Cofactors, block by block from the last to the first."""
    unknowns, first = rows.linear.system.unknowns, rows.pattern.first
    b, u, reach = unknowns.bands, unknowns.size, unknowns.bandwidth + 1
    band, border = np.zeros((b, reach if b else 1)), np.zeros((u - b, u))
    lower, coupling, corner = np.zeros_like(band), np.zeros((b, u - b)), np.zeros((0, 0))
    points, seen = np.zeros((len(rows.rays), 3, 3)), np.zeros((int(first[-1]), 2, 2))
    root = np.zeros((0, 0))
    for block, own in zip(reversed(blocks), reversed(triangles), strict=True):
        size = len(own)
        inverse = scipy.linalg.solve_triangular(own[:, :size], np.eye(size), check_finite=False)
        across = -inverse @ (own[:, size:] @ root)
        root = np.block([[inverse, across], [np.zeros((len(root), size)), root]])
        window, at = root @ root.T, block.columns[: block.size]
        still = rows.held[block.columns]
        window[still], window[:, still] = 0.0, 0.0
        for i in range(block.size):
            end = min(i + reach, block.inside)
            band[at[i], : end - i] = window[i, i:end]
            lower[at[i], : end - i] = own[i, i:end] * np.sign(own[i, i])
        border[:, at] = window[block.inside :, : block.size]
        coupling[at] = own[: block.size, block.inside :] * np.sign(np.diagonal(own))[: block.size, None]
        if size > block.size or not b:
            border[:, b:] = window[block.inside :, block.inside :]
            last = own[block.size :, block.size :]
            corner = (last * np.sign(np.diagonal(last))[:, None]).T.copy()
        for some, part in rows.of_points(block):
            # As many columns as rows serve as well, and are fewer.
            near = _triangle(np.delete(root, slice(part.inside, block.inside), axis=0).T).T
            _spread(some, part, near, first, points, seen)
        # Of the columns that follow the block before.
        root = _triangle(np.delete(root, slice(unknowns.bandwidth, block.inside), axis=0).T).T
    arrow = Arrow(lower, coupling, corner, np.ones(u))
    return FromRows(arrow, band, border, points, seen)


def _spread(some: Rows, part: _Part, root: Array, first: Rows, points: Array, seen: Array) -> None:
    """Write the cofactors of some points and of the adjusted coordinates of their rays."""
    own = (part.d @ root).reshape(len(some), 3, root.shape[1])
    points[some] = part.points + own @ np.swapaxes(own, 1, 2)
    pairs = (part.f @ root)[part.by_ray].reshape(len(part.seen), 2, root.shape[1])
    count = first[some + 1] - first[some]
    begin = np.repeat(first[some] - np.cumsum(count) + count, count)
    seen[begin + np.arange(len(part.seen))] = part.seen + pairs @ np.swapaxes(pairs, 1, 2)


def last_columns(pattern: Pattern, bands: int) -> Rows:
    """Column behind the last one inside the band that each point (p,) touches; 0 for none."""
    some = np.diff(pattern.local) > 0
    found = np.zeros(len(some), dtype=np.intp)
    if some.any():
        ends = np.where(pattern.at < bands, pattern.at + pattern.size, 0)
        found[some] = np.minimum(np.maximum.reduceat(ends, pattern.local[:-1][some]), bands)
    return found


@compiled
def eliminated_rows(
    chosen: Rows, rows: Array, pattern: Pattern, roots: Array, observed: Mask, column: Rows, f: Array,
    column_d: Rows, d: Array, inverse: Array, seen: Array,
) -> None:  # fmt: skip
    """Write the rows F = A − Q Qᵀ A of the chosen points, with B = Q T, and D = T⁻¹ Qᵀ A.

    Q are the orthonormal columns of B, by Gram and Schmidt, twice (Giraud, Langou & Rozložník 2005). The rows
    of a point are those of its rays, and three of its `observed` coordinates, whose weights have the `roots`
    (p, 3). Also written are V⁻¹ = T⁻¹ T⁻ᵀ and the squares Q Qᵀ of each ray.
    """
    last, most, longest = rows.shape[2] - 3, 1, 3
    for j in chosen:
        longest = max(longest, 2 * (pattern.first[j + 1] - pattern.first[j]) + 3)
        for a in range(pattern.local[j], pattern.local[j + 1]):
            most = max(most, pattern.offset[a] + pattern.size[a])
    q, a_rows, t, u = np.zeros((longest, 3)), np.zeros((longest, most)), np.zeros((3, 3)), np.zeros((3, 3))
    c, at = np.zeros((3, most)), np.zeros(most, np.intp)
    place_f, place_d, ray = 0, 0, 0
    for n in range(len(chosen)):
        j = chosen[n]
        rays, m = pattern.first[j + 1] - pattern.first[j], 0
        for a in range(pattern.local[j], pattern.local[j + 1]):
            for i in range(pattern.size[a]):
                at[pattern.offset[a] + i] = pattern.at[a] + i
            m = max(m, pattern.offset[a] + pattern.size[a])
        height = 2 * rays + (3 if observed[j] else 0)
        q[:height], a_rows[:height, :m], t[:, :], u[:, :] = 0.0, 0.0, 0.0, 0.0
        c[:, :m] = 0.0
        for k in range(rays):
            ray_k = pattern.first[j] + k
            for s in range(SEGMENTS):
                place, first = pattern.place[ray_k, s], pattern.column[ray_k, s]
                for i in range(pattern.width[ray_k, s]):
                    for r in range(2):
                        a_rows[2 * k + r, place + i] = rows[ray_k, r, first + i]
        if pattern.eliminated[j]:
            for k in range(rays):
                for r in range(2):
                    for i in range(3):
                        q[2 * k + r, i] = rows[pattern.first[j] + k, r, last + i]
            if observed[j]:
                for i in range(3):
                    q[2 * rays + i, i] = roots[j, i]
            for i in range(3):
                for _ in range(2):
                    for o in range(i):
                        dot = 0.0
                        for r in range(height):
                            dot += q[r, o] * q[r, i]
                        t[o, i] += dot
                        for r in range(height):
                            q[r, i] -= dot * q[r, o]
                norm = 0.0
                for r in range(height):
                    norm += q[r, i] ** 2
                t[i, i] = np.sqrt(norm)
                for r in range(height):
                    q[r, i] /= t[i, i]
            # u = T⁻¹
            for i in range(3):
                u[i, i] = 1.0 / t[i, i]
            u[0, 1] = -u[0, 0] * t[0, 1] * u[1, 1]
            u[1, 2] = -u[1, 1] * t[1, 2] * u[2, 2]
            u[0, 2] = -u[0, 0] * (t[0, 1] * u[1, 2] + t[0, 2] * u[2, 2])
            for i in range(3):
                for r in range(height):
                    for o in range(m):
                        c[i, o] += q[r, i] * a_rows[r, o]
                for r in range(height):
                    for o in range(m):
                        a_rows[r, o] -= q[r, i] * c[i, o]
                for o in range(3):
                    inverse[n, i, o] = u[i, 0] * u[o, 0] + u[i, 1] * u[o, 1] + u[i, 2] * u[o, 2]
        for r in range(height):
            for o in range(m):
                f[place_f + o], column[place_f + o] = a_rows[r, o], at[o]
            place_f += m
        for i in range(3):
            for o in range(m):
                d[place_d + o] = u[i, 0] * c[0, o] + u[i, 1] * c[1, o] + u[i, 2] * c[2, o]
                column_d[place_d + o] = at[o]
            place_d += m
        for k in range(rays):
            for r in range(2):
                for p in range(2):
                    for i in range(3):
                        seen[ray, r, p] += q[2 * k + r, i] * q[2 * k + p, i]
            ray += 1
