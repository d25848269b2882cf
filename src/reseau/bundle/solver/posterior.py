"""Cofactors of all unknowns and adjusted observations, in any datum.

If Q⁻ is the cofactor matrix in some datum, that of inner constraints over chosen unknowns is S Q⁻ Sᵀ with
S = I − G (GᵀEG)⁻¹ Gᵀ E (Baarda 1973); each block needs only G, Q⁻EG and its own block of Q⁻.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy

from ...adjust.reliability import Whitened
from ...adjust.stochastic import Blocks, Weighting
from ...core.data import Array, Mask, Rows
from .arrow import Arrow, Singular
from .conjugate import Conjugate
from .constraints import Constraints
from .datum import Freedom, held_for
from .direct import Normal
from .implicit import normal_of
from .linear import Linear
from .normal import posterior
from .orthogonal import ROUNDING, cofactors_from_rows
from .rank import PARALLEL
from .threads import in_parallel

# Columns of the inverse that are solved for at once.
_AT_ONCE = 256


class Factors(Protocol):
    """What solves the reduced normal equations."""

    def solve(self, sides: Array) -> Array:
        """Return the inverse of the matrix times right-hand sides (u,) or (u, s)."""
        ...


@dataclass(frozen=True, eq=False)
class Referral:
    """Terms of the transformation of cofactors to inner constraints: Q = Q⁻ − G N Hᵀ − H N Gᵀ + G M Gᵀ.

    N = (GᵀEG)⁻¹ (d, d) is `weight`; H = Q⁻EG of reduced unknowns (u, d) and points (p, 3, d); M = N GᵀE H N
    is `m`; `before` is Q⁻ of the reduced unknowns.
    """

    freedom: Freedom
    before: Reduced
    weight: Array
    h: Array
    h_points: Array
    m: Array


@dataclass(frozen=True, eq=False)
class Reduced:
    """Cofactors of the reduced unknowns (u,).

    Parameters
    ----------
    held : ndarray of bool (u,)
        Held unknowns: their cofactors are zero.
    band : ndarray (b, w + 1)
        Entries inside the band, column by column from the diagonal down; of the combinations `turn`.
    border : ndarray (u − b, u), optional
        Entries of the full rows, both triangles; None where nothing is stored.
    factors : Factors, optional
        Solves for what is not stored; not needed where everything is.
    turn : sparse array (u, u), optional
        Unknowns from the combinations for which the normal equations were formed.
    referral : Referral, optional
        Transformation to inner constraints.
    """

    held: Mask
    band: Array
    border: Array | None
    factors: Factors | None = None
    turn: scipy.sparse.csr_array | None = None
    referral: Referral | None = None

    @classmethod
    def of_matrix(cls, matrix: Array, held: Mask) -> Reduced:
        """Create them from the whole matrix (u, u), which is overwritten."""
        matrix[held] = 0.0
        matrix[:, held] = 0.0
        return cls(held, np.zeros((0, 1)), matrix)

    def referred(self, referral: Referral) -> Reduced:
        """Return the cofactors with inner constraints."""
        return replace(self, referral=referral)

    @property
    def known(self) -> bool:
        """Whether cofactors of all images and points were computed; those of single ones always are."""
        return self.border is not None

    @cached_property
    def full(self) -> Array:
        """The whole matrix (u, u)."""
        every = np.arange(len(self.held))
        return self.block(every, every)

    @property
    def diagonal(self) -> Array:
        """Diagonal (u,); NaN where nothing is stored."""
        return self.blocks(np.arange(len(self.held))[:, None])[:, 0, 0]

    def block(self, rows: Rows, columns: Rows) -> Array:
        """Return cofactors (k, l) of some unknowns (k,) with others (l,)."""
        one, left = self._combined(np.asarray(rows))
        two, right = self._combined(np.asarray(columns))
        if self.border is not None and self._stored(one[:, None], two[None, :]).all():
            found = self._entries(one[:, None], two[None, :])
        elif len(one) < len(two):
            found = self._solved(one)[two].T
        else:
            found = self._solved(two)[one]
        if left is not None and right is not None:
            found = left @ (right @ found.T).T
        if self.referral is not None:
            found = found + self._change(np.asarray(rows)[None], np.asarray(columns)[None])[0]
        return found

    def blocks(self, columns: Rows) -> Array:
        """Return the cofactors (g, k, k) of groups of unknowns (g, k); NaN where nothing is stored."""
        if self.border is None:
            return np.full((*columns.shape, columns.shape[1]), np.nan)
        if self.turn is not None:
            plain = replace(self, referral=None)
            g, k = columns.shape
            found = np.array([plain.block(own, own) for own in columns]).reshape(g, k, k)
        else:
            found = self._entries(columns[:, :, None], columns[:, None, :])
        return found if self.referral is None else found + self._change(columns, columns)

    def times(self, sides: Array) -> Array:
        """Return the cofactor matrix times (u, s)."""
        free = np.where(self.held[:, None], 0.0, sides)
        if self.turn is not None:
            free = self.turn.T @ free
        if self.factors is not None:
            found = self.factors.solve(free)
        elif self.border is not None:
            found = self.border @ free
        else:
            raise AssertionError("nothing is stored, and nothing solves for it")
        if self.turn is not None:
            found = self.turn @ found
        found[self.held] = 0.0
        if self.referral is not None:
            r, g = self.referral, self.referral.freedom.reduced
            found = found - g @ (r.weight @ (r.h.T @ sides)) - r.h @ (r.weight @ (g.T @ sides))
            found += g @ (r.m @ (g.T @ sides))
        return found

    def rows(self, columns: Rows) -> Array:
        """Return whole rows (k, u) of some unknowns (k,)."""
        unit = np.zeros((len(self.held), len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        return self.times(unit).T

    def _combined(self, rows: Rows) -> tuple[Rows, scipy.sparse.csr_array | None]:
        """Combinations on which some unknowns depend, and these unknowns from them."""
        if self.turn is None:
            return rows, None
        own = self.turn[rows]
        at, place = np.unique(own.indices, return_inverse=True)
        own = scipy.sparse.csr_array((own.data, place, own.indptr), shape=(len(rows), len(at)))
        return at.astype(np.intp), own

    def _stored(self, i: Rows, o: Rows) -> Mask:
        bands, width = self.band.shape
        return np.asarray((np.maximum(i, o) >= bands) | (np.abs(i - o) < width))

    def _entries(self, i: Rows, o: Rows) -> Array:
        """Stored entries, of indices that are broadcast."""
        bands, border = len(self.band), self.border
        if border is None:
            raise AssertionError("nothing is stored")
        low, high = np.minimum(i, o), np.maximum(i, o)
        if not bands:
            return np.asarray(border[high, low])
        found = np.asarray(border[np.maximum(high - bands, 0), low]) if len(border) else np.zeros(low.shape)
        inside = high < bands
        near = np.minimum(high - low, self.band.shape[1] - 1)
        return np.where(inside, self.band[np.minimum(low, bands - 1), near], found)

    def _solved(self, columns: Rows) -> Array:
        """Columns (u, k) of the inverse for the combinations."""
        if self.factors is None:
            raise AssertionError("everything is stored without factors")
        found = np.empty((len(self.held), len(columns)))
        for begin in range(0, len(columns), _AT_ONCE):
            some = columns[begin : begin + _AT_ONCE]
            unit = np.zeros((len(self.held), len(some)))
            unit[some, np.arange(len(some))] = 1.0
            unit[self.held] = 0.0
            found[:, begin : begin + len(some)] = self.factors.solve(unit)
        found[self.held] = 0.0
        return found

    def _change(self, rows: Rows, columns: Rows) -> Array:
        """What inner constraints add to the blocks (g, k, l) of unknowns (g, k) and (g, l)."""
        r = self.referral
        if r is None:
            raise AssertionError("without inner constraints")
        g, h = r.freedom.reduced, r.h
        one = g[rows] @ r.weight @ np.swapaxes(h[columns], 1, 2)
        two = h[rows] @ r.weight @ np.swapaxes(g[columns], 1, 2)
        return np.asarray(g[rows] @ r.m @ np.swapaxes(g[columns], 1, 2) - one - two)


# Smallest pivot of the normal equations with unit diagonal that is not rounding.
_RANK = 1e-14
# Allowed deviation of the trace of the cofactors of the adjusted observations from the number of unknowns.
_EXACT, _INEXACT = 1e-7, 1e-4
# The same with a stage: frontal images make the normal equations lose half of their digits.
_STAGED = 1e-3
# Accuracy of the solution for a random right-hand side: it is only asked whether there is one.
_ROUGHLY = 1e-3
# Standard deviation of an unknown of a small network, relative to that with all others known, of which first
# derivatives say nothing any more.
_INFLATED = 1e6
# Largest number of entries of F for which its decomposition takes about a second, and of products for which
# it takes some minutes.
_ENTRIES, _PRODUCTS = 20_000_000, 5e12


@dataclass(frozen=True, eq=False)
class BlockSolution(Whitened):
    """Whitened residuals, and the cofactors of the adjusted observations in blocks.

    Parameters
    ----------
    whitened : ndarray (N,)
        Weighted residuals.
    influence, cofactors : tuple of Blocks
        See :class:`~reseau.adjust.reliability.Whitened`.
    adjusted : tuple of ndarray (b, k, k)
        Cofactors of the adjusted observations, whitened, of the same blocks.
    """

    whitened: Array
    influence: tuple[Blocks, ...]
    cofactors: tuple[Blocks, ...]
    adjusted: tuple[Array, ...]

    @classmethod
    def of(cls, weightings: list[Weighting], whitened: Array, adjusted: list[Array]) -> BlockSolution:
        """Create the solution from the weights of image coordinates and of other observations."""
        influence, cofactors, start = [], [], 0
        for weighting in weightings:
            for root, cofactor in zip(weighting.roots, weighting.cofactors, strict=True):
                turned = np.swapaxes(root.matrices, 1, 2)
                influence.append(Blocks(start + root.row, start + root.column, turned))
                cofactors.append(Blocks(start + root.row, start + root.row, cofactor.matrices))
            start += weighting.n
        return cls(whitened, tuple(influence), tuple(cofactors), tuple(adjusted))

    def hats(self) -> Iterator[Array]:
        """See :meth:`Whitened.hats`."""
        for turn, block in zip(self.influence, self.adjusted, strict=True):
            t = turn.matrices
            yield t @ block @ np.swapaxes(t, 1, 2)


@dataclass(frozen=True, eq=False)
class Cofactors:
    """Cofactors after the adjustment.

    Parameters
    ----------
    reduced : Reduced
        Of the reduced unknowns. Where its attribute `known` is false, as after conjugate gradients, all other
        cofactors are NaN.
    points : ndarray (p, 3, 3)
        Of the points; zero for points that are held or not adjusted.
    seen : ndarray (n, 2, 2)
        Of the adjusted image coordinates, whitened, in the order of points.
    others : ndarray
        Of the other adjusted observations, divided by their variances.
    normal : Normal
        Undamped normal equations, for joint cofactors.
    referral : Referral, optional
        Transformation of the cofactors to inner constraints.
    stage : ndarray (k, k), optional
        Of readings and axis of a stage.
    """

    reduced: Reduced
    points: Array
    seen: Array
    others: Array
    normal: Normal
    referral: Referral | None = None
    stage: Array | None = None

    def joint(self, columns: Rows, points: Rows) -> Array:
        """Compute the joint cofactor matrix of reduced unknowns and of all coordinates of points.

        Parameters
        ----------
        columns : ndarray of int (k,)
            Reduced unknowns.
        points : ndarray of int (q,)
            Adjusted points, eliminated or among the reduced unknowns.

        Returns
        -------
        ndarray (k + 3q, k + 3q)
            In this order; zero for held coordinates.
        """
        linear, inverse = self.normal.linear, self.normal.inverse
        system, k, size = linear.system, len(columns), len(columns) + 3 * len(points)
        own = k + 3 * np.arange(len(points))[:, None] + np.arange(3)
        kept = system.unknowns.kept[points]
        reduced = np.flatnonzero(kept >= 0)
        at_reduced = kept[reduced, None] + np.arange(3)
        through = np.zeros((size, system.unknowns.size))
        through[np.arange(k), columns] = 1.0
        through[own[reduced], at_reduced] = 1.0
        for q in np.flatnonzero(kept < 0):
            through[own[q]] = -(_cross(linear, int(points[q])) @ inverse[points[q]]).T
        z = self.reduced if self.referral is None else self.referral.before
        at = np.flatnonzero(through.any(axis=0))
        joint = through[:, at] @ z.block(at, at) @ through[:, at].T
        for q in np.flatnonzero(kept < 0):
            joint[np.ix_(own[q], own[q])] += inverse[points[q]]
        if self.referral is not None:
            r = self.referral
            g = np.concatenate([r.freedom.reduced[columns], *r.freedom.points[points]])
            h = np.concatenate([r.h[columns], *r.h_points[points]])
            g[own[reduced]], h[own[reduced]] = r.freedom.reduced[at_reduced], r.h[at_reduced]
            one = g @ r.weight @ h.T
            joint = joint - one - one.T + g @ r.m @ g.T
        free = np.concatenate([np.ones(k), system.movable[points].ravel()])
        return joint * np.outer(free, free)


def cofactors_of(linear: Linear, freedom: Freedom, datum: Mask | None, taking_part: Mask) -> Cofactors:
    """Compute the cofactors at the estimates.

    Parameters
    ----------
    linear : Linear
        The linear problem at the estimates.
    freedom : Freedom
        Similarity transformations that the observations do not determine.
    datum : ndarray of bool (p,), optional
        Points of the inner constraints; by default the held unknowns of the system are the datum.
    taking_part : ndarray of bool (p,)
        Adjusted points.

    Raises
    ------
    Singular
        When the observations do not determine the unknowns in this datum.
    """
    system = linear.system
    normal = normal_of(linear, 0.0)
    diagonal = normal.sums.diagonal.copy()
    held = system.held.copy()
    held[system.still] = True
    if system.constraints is not None:
        inner = freedom if datum is not None and freedom.defect else None
        (z, points, seen, others), q = _constrained(
            linear, normal, system.constraints, held, taking_part, inner
        )
    else:
        if datum is not None:
            held[held_for(freedom, system.unknowns, diagonal)] = True
            normal.hold(held)
        if system.iterative:
            z, points, seen, others = _unknown(linear, normal, held, taking_part)
        else:
            z, points, seen, others = _marginal(linear, normal, held, taking_part)
    kept, columns = system.unknowns.kept_points
    referral, stage = None, None
    if system.constraints is not None and system.constraints.stage is not None:
        stage = q[system.constraints.stage.own, system.constraints.stage.own]
    if datum is not None and freedom.defect:
        referral = _referral(normal, freedom, datum & taking_part, z)
        if stage is not None:
            stage = _stage_in_datum(referral, stage, linear, q, normal, datum & taking_part)
        z, points = z.referred(referral), _in_datum(referral, points)
        points[kept] = z.blocks(columns)
    return Cofactors(z, points, seen, others, normal, referral, stage)


def _unknown(
    linear: Linear, normal: Normal, held: Mask, taking_part: Mask
) -> tuple[Reduced, Array, Array, Array]:
    """Cofactors that are solved for when they are asked for; NaN for all points and observations.

    A random right-hand side has a part along every direction: where the observations leave one of them
    undetermined, the solution does not reach its accuracy.

    Raises
    ------
    Singular
        When the observations do not determine the unknowns.
    """
    factors = normal.factorise()
    if normal.least < PARALLEL or not isinstance(factors, Conjugate):
        raise Singular
    side = np.random.default_rng(0).normal(size=len(held)) * np.sqrt(normal.sums.diagonal)
    factors.solve(np.where(held, 0.0, side), _ROUGHLY)
    if not factors.complete:
        raise Singular
    z = Reduced(held, np.zeros((0, 1)), None, factors, normal.turn)
    points = np.where(taking_part[:, None, None], np.full((len(linear.prior), 3, 3), np.nan), 0.0)
    fixed = linear.system.movable == 0
    points[fixed[:, :, None] | fixed[:, None, :]] = 0.0
    seen = np.full((len(linear.misfits), 2, 2), np.nan)
    others = np.full(len(linear.system.sigma_root), np.nan)
    return z, points, seen, others


def _marginal(
    linear: Linear, normal: Normal, held: Mask, taking_part: Mask
) -> tuple[Reduced, Array, Array, Array]:
    """Cofactors of reduced unknowns, points, image coordinates and other observations in some datum.

    The trace of the cofactors of the adjusted observations is the number of unknowns. Where it is not, the
    normal equations have lost digits, and the inverse is computed from the rows of the observations instead.

    Raises
    ------
    Singular
        When the observations do not determine the unknowns.
    """
    system = linear.system
    free = int((~held).sum()) + _free_coordinates(linear, taking_part)
    try:
        arrow = normal.factorise()
        if normal.least < PARALLEL or not isinstance(arrow, Arrow):
            raise Singular
        band, border = arrow.inverse()
        bands = len(band)
        # The rows of held unknowns are those of a unit matrix.
        border[held[bands:]] = 0.0
        border[:, held] = 0.0
        band[held[:bands], 0] = 0.0
        z = Reduced(held, band, border, arrow if bands else None, normal.turn)
        found = _with_inverse(linear, normal, z, held, taking_part)
        missing = abs(_total(found) - free)
        if arrow.weakest >= _RANK and missing < _EXACT:
            return found
    except Singular:
        missing = np.inf
    if normal.least < PARALLEL:
        raise Singular
    enough = _INEXACT * max(1.0, system.unknowns.size / 1000.0)
    small = _is_small(linear)
    if small or (not missing < enough and _is_affordable(linear)):
        # The ends of a long chain are determined weakly, although neighbours are determined well.
        own = cofactors_from_rows(linear, held, _INFLATED if small else ROUNDING)
        z = Reduced(held, own.band, own.border, own.arrow if len(own.band) else None, normal.turn)
        found = _complete(linear, z, own.points, own.seen, taking_part)
        missing = abs(_total(found) - free)
    if not missing < enough:
        raise Singular
    return found


def _constrained(
    linear: Linear,
    normal: Normal,
    constraints: Constraints,
    columns: Mask,
    taking_part: Mask,
    inner: Freedom | None,
) -> tuple[tuple[Reduced, Array, Array, Array], Array]:
    """Compute the same cofactors with a stage or a rig, and those of its independent unknowns (size, size).

    `inner` is the freedom without a datum.

    Raises
    ------
    Singular
        When the observations do not determine the unknowns.
    """
    held = constraints.held(columns)
    held[linear.system.fixed] = True
    if inner is not None:
        free = normal.constrained()
        slopes = linear.constraint_slopes
        held[constraints.held_for(inner.reduced, free.back, slopes, np.diag(free.matrix))] = True
    own = normal.constrained(held)
    arrow = Arrow.factorise(np.zeros((0, 1)), own.matrix)
    _, q = arrow.inverse()
    q[held], q[:, held] = 0.0, 0.0
    back = linear.sparse_transformation
    z = Reduced.of_matrix(back @ (back @ q).T, columns)
    found = _with_inverse(linear, normal, z, columns, taking_part, independent=q)
    slopes = linear.constraint_slopes
    found[3][len(found[3]) - len(slopes) :] = np.einsum("ai,ij,aj->a", slopes, q, slopes, optimize=True)
    missing = abs(_total(found) - int((~held).sum()) - _free_coordinates(linear, taking_part))
    if normal.least < PARALLEL or arrow.weakest < _RANK or not missing < _STAGED:
        raise Singular
    return found, q


def _total(found: tuple[Reduced, Array, Array, Array]) -> float:
    """Trace of the whitened cofactors of the adjusted observations."""
    _, _, seen, others = found
    return float(np.trace(seen, axis1=1, axis2=2).sum() + others.sum())


def _free_coordinates(linear: Linear, taking_part: Mask) -> int:
    """Number of unknown coordinates of eliminated points."""
    eliminated = linear.system.pattern.eliminated == 1
    return int(linear.system.movable[eliminated & taking_part].sum())


def _with_inverse(
    linear: Linear, normal: Normal, z: Reduced, held: Mask, taking_part: Mask, *,
    independent: Array | None = None,
) -> tuple[Reduced, Array, Array, Array]:  # fmt: skip
    """Cofactors from the inverse of the reduced normal equations.

    `independent` is the inverse for the independent unknowns of a stage or a rig.
    """
    system = linear.system
    points, seen = np.zeros((len(linear.prior), 3, 3)), np.zeros((len(linear.misfits), 2, 2))
    if z.border is None:
        raise AssertionError("only with stored cofactors")
    rows, pattern, band, border = linear.rows, system.pattern, z.band, z.border
    if z.turn is not None:
        rows = linear.turned_rows
    if independent is not None and linear.blocks is not None:
        rows, pattern, border = linear.rows_through, system.through[0], independent

    def work(_: int, a: int, b: int) -> None:
        posterior(a, b, rows, pattern, normal.inverse, band, border, points, seen)

    in_parallel(work, system.chunks)
    return _complete(linear, z, points, seen, taking_part)


def _complete(
    linear: Linear, z: Reduced, points: Array, seen: Array, taking_part: Mask
) -> tuple[Reduced, Array, Array, Array]:
    """Add the cofactors of points that are not eliminated, and of the other observations."""
    system = linear.system
    points *= system.movable[:, :, None] * system.movable[:, None, :]
    points[~taking_part] = 0.0
    kept, columns = system.unknowns.kept_points
    points[kept] = z.blocks(columns)
    return z, points, seen, _others(linear, z, points)


def _others(linear: Linear, z: Reduced, points: Array) -> Array:
    """Cofactors of distances, observed coordinates and interior orientation, divided by their variances."""
    system = linear.system
    hats = np.zeros(len(system.sigma_root))
    j, axis = system.others.coordinate.T
    _, coordinates, _ = system.others.slices
    hats[coordinates] = points[j, axis, axis]
    rows, columns = system.prior_column
    hats[rows] = z.blocks(columns[:, None])[:, 0, 0]
    hats *= system.sigma_root**2
    for k, column, slope in linear.slopes():
        hats[k] = slope @ z.block(column, column) @ slope
    return hats


def _referral(normal: Normal, freedom: Freedom, chosen: Mask, z: Reduced) -> Referral:
    """Terms of the transformation of cofactors to inner constraints over the chosen points."""
    system, d = normal.linear.system, freedom.defect
    g, g_reduced = _chosen(normal, freedom, chosen)
    h = z.times(g_reduced + normal.reduced_sides(g))
    h_points = normal.points(g, h) * system.movable[:, :, None]
    inner = g.reshape(-1, d).T @ g.reshape(-1, d) + g_reduced.T @ g_reduced
    weight = np.asarray(np.linalg.inv(inner), dtype=np.float64)
    m = weight @ (np.einsum("pad,pae->de", g, h_points) + g_reduced.T @ h) @ weight
    return Referral(freedom, z, weight, h, h_points, m)


def _chosen(normal: Normal, freedom: Freedom, chosen: Mask) -> tuple[Array, Array]:
    """EG of the points (p, 3, d) and of the reduced unknowns (u, d), for the chosen points."""
    unknowns = normal.linear.system.unknowns
    g = np.where(chosen[:, None, None], freedom.points, 0.0)
    g_reduced = np.zeros((unknowns.size, freedom.defect))
    kept, columns = unknowns.kept_points
    columns = columns[chosen[kept]]
    g_reduced[columns] = freedom.reduced[columns]
    return g, g_reduced


def _stage_in_datum(
    referral: Referral, stage: Array, linear: Linear, q: Array, normal: Normal, chosen: Mask
) -> Array:
    """Cofactors of readings and axis of a stage with inner constraints, as those of :func:`_in_datum`."""
    constraints, values = linear.system.constraints, linear.values
    if constraints is None or constraints.stage is None or values.stage is None:
        return stage
    g, g_reduced = _chosen(normal, referral.freedom, chosen)
    side = linear.transformation.T @ (g_reduced + normal.reduced_sides(g))
    h = q[constraints.stage.own] @ side
    own = constraints.stage.changes(values.stage) @ referral.freedom.basis
    one = own @ referral.weight @ h.T
    return np.asarray(stage - one - one.T + own @ referral.m @ own.T)


def _in_datum(referral: Referral, points: Array) -> Array:
    """Cofactors of the points with inner constraints."""
    freedom, weight, m = referral.freedom, referral.weight, referral.m
    cross = np.einsum("pad,de,pbe->pab", freedom.points, weight, referral.h_points, optimize=True)
    points = points - cross - np.swapaxes(cross, 1, 2)
    points += np.einsum("pad,de,pbe->pab", freedom.points, m, freedom.points, optimize=True)
    return points


def _cross(linear: Linear, point: int) -> Array:
    """W of one point (u, 3): products of derivatives by the reduced unknowns and by the point."""
    pattern, last = linear.system.pattern, linear.rows.shape[2] - 3
    w = np.zeros((linear.system.unknowns.size, 3))
    for k in range(pattern.first[point], pattern.first[point + 1]):
        b = linear.rows[k, :, last:]
        for start, width, column in zip(pattern.start[k], pattern.width[k], pattern.column[k], strict=True):
            w[start : start + width] += linear.rows[k, :, column : column + width].T @ b
    return w


def _is_small(linear: Linear) -> bool:
    """Whether the rows of all observations are few enough to be decomposed at once."""
    return 2 * len(linear.misfits) * linear.system.unknowns.size <= _ENTRIES


def _is_affordable(linear: Linear) -> bool:
    """Whether triangles of these rows, inside a band if there is one, take less than some minutes."""
    unknowns = linear.system.unknowns
    width = unknowns.bandwidth + unknowns.size - unknowns.bands
    return 2 * len(linear.misfits) * width**2 <= _PRODUCTS
