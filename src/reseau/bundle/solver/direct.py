"""Reduced normal equations with their matrix, and the corrections that solve them."""

from __future__ import annotations

import numpy as np
import scipy

from ...core.data import Array, Mask, Rows
from .arrow import Arrow, add, full
from .camera_basis import CameraBasis, damping_of, in_blocks
from .conjugate import Conjugate
from .constraints import Constrained
from .linear import Linear
from .normal import Pattern, Sums, assemble, gradients, reduce_sides, substitute
from .threads import in_parallel
from .values import Correction

# The sums of each part need as much memory as the matrix: large matrices are formed in one part.
_LARGE = 2000


class Normal:
    """Reduced normal equations."""

    def __init__(
        self, linear: Linear, sums: Sums, inverse: Array, side: Array, diagonal: Array, damping: float,
        least: float, bases: tuple[CameraBasis, ...] = (),
    ) -> None:  # fmt: skip
        self.linear, self.sums, self.inverse, self.side = linear, sums, inverse, side
        self.diagonal, self.damping, self.least, self.bases = diagonal, damping, least, bases
        self.factors: Arrow | Conjugate | None = None
        self.accuracy = (0.0, 0.0)

    def hold(self, held: Mask) -> None:
        """Hold reduced unknowns (u,)."""
        for column in np.flatnonzero(held):
            _hold(self.sums, int(column))

    def factorise(self) -> Arrow | Conjugate:
        """Compute the Cholesky factors; the sums are overwritten.

        Raises
        ------
        Singular
            When the matrix is not positive definite.
        """
        return Arrow.factorise(self.sums.band, self.sums.border)

    def constrained(self, held: Mask | None = None) -> Constrained:
        """Return the normal equations of the independent unknowns, of which some (size,) may be held."""
        linear = self.linear
        t, slopes = linear.transformation, linear.constraint_slopes
        own = slopes.T @ linear.other_misfits[len(linear.other_misfits) - len(slopes) :]
        matrix, gradient = full(self.sums.band, self.sums.border), self.sums.reduced
        if linear.blocks is None:
            # A pose depends on few unknowns: nearly all of T is zero.
            sparse = linear.sparse_transformation
            matrix, gradient = sparse.T @ (sparse.T @ matrix).T, t.T @ gradient
        matrix, gradient = matrix + slopes.T @ slopes, gradient + own
        if held is not None:
            matrix[held], matrix[:, held] = 0.0, 0.0
            matrix[held, held] = 1.0
            gradient = np.where(held, 0.0, gradient)
        return Constrained(t, matrix, own, gradient)

    @property
    def turn(self) -> scipy.sparse.csr_array | None:
        """Reduced unknowns (u, u) from the combinations for which these are formed; None for themselves."""
        if not self.bases:
            return None
        turns = [basis.turn for basis in self.bases]
        return in_blocks(self.bases, turns, np.ones(self.linear.system.unknowns.size))

    def correction(self, relative: float = 0.0, absolute: float = 0.0) -> Correction:
        """Solve for the correction.

        Parameters
        ----------
        relative, absolute : float
            Accuracy with conjugate gradients: see :meth:`Conjugate.solve`.

        Raises
        ------
        Singular
            When the matrix is not positive definite.
        """
        constraints, q, by_stage = self.linear.system.constraints, None, 0.0
        complete = True
        if constraints is None:
            factors = self.factors = self.factorise()
            self.accuracy = relative, absolute
            y = self._solved(factors, -self.sums.reduced)
            complete = isinstance(factors, Arrow) or factors.complete
            gradient = self.sums.gradient @ y
            y = self.in_parameters(y)
        else:
            columns = self.linear.system.held
            held = constraints.held(columns)
            held[self.linear.system.fixed] = True
            own = self.constrained(held if held.any() else None)
            q = Arrow.factorise(np.zeros((0, 1)), own.matrix).solve(-own.gradient)
            y, by_stage = own.back @ q, float(own.own @ q)
            gradient = self.sums.gradient @ (y if self.linear.blocks is None else q)
        points = self.points(-self.side[:, :, None], y[:, None])[:, :, 0]
        gradient += float((self.side * points).sum()) + by_stage
        bent = (self.sums.diagonal * y) @ y + float((self.diagonal * points**2).sum())
        predicted = float(-gradient + self.damping * bent)
        return Correction(y, points, predicted, float(np.sqrt(bent)), q, complete)

    def correction_for(self, misfits: Array, other_misfits: Array) -> Correction:
        """Solve for the correction with other misfits, with the factors of :meth:`correction`.

        Without a stage or a rig only. The predicted decrease is not computed.

        Parameters
        ----------
        misfits : ndarray (n, 2)
            Weighted misfits of the image coordinates.
        other_misfits : ndarray
            Weighted misfits of the other observations.
        """
        linear, system = self.linear, self.linear.system
        rows, pattern = linear.turned_rows if self.bases else linear.rows, system.pattern
        other = Linear(system, linear.values, linear.rows, misfits, other_misfits)
        side, gradient = other.prior[:, :, 1].copy(), np.zeros(system.unknowns.size)
        gradients(0, len(side), rows, misfits, pattern, side, gradient)
        gradient += linear.other_rows.T @ other_misfits
        reduced = np.zeros((len(gradient), 1))
        reduce_sides(0, len(side), rows, pattern, self.inverse, side[:, :, None], reduced)
        held = system.held.copy()
        held[system.still] = True
        factors = self.factorise() if self.factors is None else self.factors
        y = self._solved(factors, np.where(held, 0.0, -(gradient + reduced[:, 0])))
        y = self.in_parameters(y)
        points = self.points(-side[:, :, None], y[:, None])[:, :, 0]
        bent = (self.sums.diagonal * y) @ y + float((self.diagonal * points**2).sum())
        return Correction(y, points, 0.0, float(np.sqrt(bent)))

    def _solved(self, factors: Arrow | Conjugate, side: Array) -> Array:
        return factors.solve(side) if isinstance(factors, Arrow) else factors.solve(side, *self.accuracy)

    def in_parameters(self, z: Array) -> Array:
        """Return reduced unknowns (u, …) for the parameters of cameras, from those for their combinations."""
        y = z.copy()
        for basis in self.bases:
            y[basis.columns] = basis.turn @ z[basis.columns]
        return y

    def points(self, side: Array, y: Array) -> Array:
        """Compute points (p, 3, s) from right-hand sides (p, 3, s) and reduced unknowns (u, s)."""
        linear, out = self.linear, np.zeros(side.shape)

        def work(_: int, a: int, b: int) -> None:
            substitute(a, b, linear.rows, linear.system.pattern, self.inverse, side, y, out)

        in_parallel(work, linear.system.chunks)
        return out

    def reduced_sides(self, side: Array) -> Array:
        """Compute −W V⁻¹ times right-hand sides (p, 3, s) of the points, (u, s)."""
        linear = self.linear
        out = np.zeros((linear.system.unknowns.size, side.shape[2]))
        reduce_sides(0, len(side), linear.rows, linear.system.pattern, self.inverse, side, out)
        return out


def formed(linear: Linear, damping: float, *, turned: bool = True) -> Normal:
    """Form the matrix of the damped normal equations, reduced to the unknowns other than points.

    Parameters
    ----------
    damping : float
        Relative to the diagonal.
    turned : bool
        Whether to form them for well-conditioned combinations of the parameters of cameras.
    """
    system, unknowns = linear.system, linear.system.unknowns
    if linear.blocks is not None:
        return _through(linear, damping)
    u, bands = unknowns.size, unknowns.bands
    bases, rows = (linear.bases, linear.turned_rows) if turned else ((), linear.rows)
    sums, inverse, side, diagonal, least = _assembled(
        linear, rows, system.pattern, damping, u, bands, unknowns.bandwidth
    )
    _add_others(linear, sums)
    sums.reduced[:] += sums.gradient
    for column in (*np.flatnonzero(system.held), *system.still):
        _hold(sums, int(column))
    if damping:
        add(sums.band, sums.border, damping_of(bases, damping, sums.diagonal))
    for basis in bases:
        sums.diagonal[basis.columns] = basis.diagonal
    return Normal(linear, sums, inverse, side, diagonal, damping, least, bases)


def _assembled(
    linear: Linear, rows: Array, pattern: Pattern, damping: float, u: int, bands: int, bandwidth: int
) -> tuple[Sums, Array, Array, Array, float]:
    """Sums over all points; V⁻¹, right-hand side and diagonal of each, and the smallest scaled pivot."""
    p = len(linear.prior)
    inverse, side, diagonal = np.zeros((p, 3, 3)), np.zeros((p, 3)), np.zeros((p, 3))
    chunks = linear.system.chunks if u < _LARGE or bands else [(0, p)]
    parts = [
        Sums(
            np.zeros((bands, bandwidth + 1)),
            np.zeros((u - bands, u)),
            np.zeros(u),
            np.zeros(u),
            np.zeros(u),
        )
        for _ in chunks
    ]
    least = np.ones(len(chunks))

    def work(part: int, a: int, b: int) -> None:
        least[part] = assemble(
            a, b, rows, linear.misfits, pattern, linear.prior, damping, parts[part], inverse, side, diagonal
        )

    in_parallel(work, chunks)
    sums = parts[0]
    for other in parts[1:]:
        for mine, theirs in zip(sums, other, strict=True):
            mine += theirs
    return sums, inverse, side, diagonal, float(least.min(initial=1.0))


def _through(linear: Linear, damping: float) -> Normal:
    """Normal equations of the independent unknowns of a rig, formed without those of single images."""
    system, unknowns = linear.system, linear.system.unknowns
    pattern, to, size = system.through
    image = system.seen.image
    sums, inverse, side, points, least = _assembled(linear, linear.rows_through, pattern, damping, size, 0, 0)
    _add_others(linear, sums, to)
    sums.reduced[:] += sums.gradient
    for column in to[system.still]:
        _hold(sums, int(column))
    # The damping is that of poses, as without a rig.
    diagonal = np.zeros(unknowns.size)
    known = to >= 0
    diagonal[known] = sums.diagonal[to[known]]
    square = (linear.rows[:, :, :6] ** 2).sum(axis=1)
    own, count = np.flatnonzero(unknowns.pose >= 0), len(unknowns.pose)
    for i in range(6):
        diagonal[unknowns.pose[own] + i] = np.bincount(image, square[:, i], count)[own]
    if damping:
        extra = damping * np.where(diagonal > 0, diagonal, 1.0)
        sparse = linear.sparse_transformation
        sums.border[:] += (sparse.T @ scipy.sparse.diags_array(extra) @ sparse).toarray()
    return Normal(linear, sums._replace(diagonal=diagonal), inverse, side, points, damping, least)


def _add_others(linear: Linear, sums: Sums, to: Rows | None = None) -> None:
    """Add distances, and observed coordinates and parameters among the reduced unknowns.

    `to` (u,) are new numbers of these unknowns, where they have been renumbered.
    """
    rows = linear.other_rows
    if to is not None:
        rows = scipy.sparse.csr_array(
            (rows.data, to[rows.indices], rows.indptr), (rows.shape[0], len(sums.gradient))
        )
    sums.gradient[:] += rows.T @ linear.other_misfits
    sums.diagonal[:] += rows.power(2).sum(axis=0)
    add(sums.band, sums.border, rows.T @ rows)


def _hold(sums: Sums, column: int) -> None:
    """Hold an unknown."""
    bands = len(sums.band)
    if column < bands:
        sums.band[column] = 0.0
        reach = min(column, sums.band.shape[1] - 1)
        back = np.arange(1, reach + 1)
        sums.band[column - back, back] = 0.0
        sums.band[column, 0] = 1.0
    else:
        sums.border[column - bands] = 0.0
    sums.border[:, column] = 0.0
    if column >= bands:
        sums.border[column - bands, column] = 1.0
    sums.gradient[column] = sums.reduced[column] = sums.diagonal[column] = 0.0
