"""Reduced normal equations without their matrix, for conjugate gradients, where it would be too large."""

from __future__ import annotations

import numpy as np
import scipy

from ...core.data import Array, Mask
from .camera_basis import damping_of
from .conjugate import Conjugate
from .direct import Normal, formed
from .linear import Linear
from .normal import Sums, assemble_blocks, product
from .threads import in_parallel


def normal_of(linear: Linear, damping: float) -> Normal:
    """Form the damped normal equations, reduced to the unknowns other than points.

    They have a matrix unless the system is :attr:`~System.iterative`.

    Parameters
    ----------
    linear : Linear
        The linear problem.
    damping : float
        Relative to the diagonal.
    """
    return _formed(linear, damping) if linear.system.iterative else formed(linear, damping)


class Implicit(Normal):
    """Reduced normal equations without their matrix, for conjugate gradients.

    Attributes
    ----------
    near : ndarray
        Lower triangles of the diagonal blocks of the matrix.
    extra : sparse array (u, u)
        Damping, and what observations other than image coordinates add to the matrix.
    held : ndarray of bool (u,)
        Held unknowns.
    """

    near: Array
    extra: scipy.sparse.csr_array
    held: Mask | None = None

    def hold(self, held: Mask) -> None:
        """Hold reduced unknowns (u,)."""
        self.held = held.copy() if self.held is None else self.held | held
        for column in (self.sums.gradient, self.sums.reduced, self.sums.diagonal):
            column[held] = 0.0

    def factorise(self) -> Conjugate:
        """Invert the diagonal blocks.

        Raises
        ------
        Singular
            When a block is not positive definite.
        """
        system = self.linear.system
        held = system.held if self.held is None else self.held
        return Conjugate(self._product, system.unknowns.blocks.inverted(self.near, held))

    def _product(self, x: Array) -> Array:
        """Product of the matrix with a vector (u,)."""
        system, rows = self.linear.system, self.linear.turned_rows
        held = system.held if self.held is None else self.held
        free, chunks = np.where(held, 0.0, x), system.chunks
        parts = np.zeros((len(chunks), len(x)))

        def work(part: int, a: int, b: int) -> None:
            product(a, b, rows, system.pattern, self.inverse, free, parts[part])

        in_parallel(work, chunks)
        out: Array = parts.sum(axis=0) + self.extra @ free
        return np.where(held, x, out)


def _formed(linear: Linear, damping: float) -> Implicit:
    """Form them but for their matrix."""
    system, unknowns, p = linear.system, linear.system.unknowns, len(linear.prior)
    u, blocks, rows, bases = unknowns.size, unknowns.blocks, linear.turned_rows, linear.bases
    inverse, side, points = np.zeros((p, 3, 3)), np.zeros((p, 3)), np.zeros((p, 3))
    chunks, nothing = system.chunks, np.zeros((0, u))
    parts = [Sums(np.zeros((0, 1)), nothing, np.zeros(u), np.zeros(u), np.zeros(u)) for _ in chunks]
    near, least = [np.zeros(blocks.total) for _ in chunks], np.ones(len(chunks))

    def work(part: int, a: int, b: int) -> None:
        least[part] = assemble_blocks(
            a, b, rows, linear.misfits, system.pattern, linear.prior, damping, parts[part], inverse, side,
            points, blocks.first, blocks.base, near[part],
        )  # fmt: skip

    in_parallel(work, chunks)
    sums, own, more = parts[0], near[0], linear.other_rows
    for other, entries in zip(parts[1:], near[1:], strict=True):
        own += entries
        for mine, theirs in zip(sums[2:], other[2:], strict=True):
            mine += theirs
    sums.gradient[:] += more.T @ linear.other_misfits
    sums.diagonal[:] += more.power(2).sum(axis=0)
    sums.reduced[:] += sums.gradient
    extra = (damping_of(bases, damping, sums.diagonal) + more.T @ more).tocsr()
    for basis in bases:
        sums.diagonal[basis.columns] = basis.diagonal
    added = extra.tocoo()
    blocks.add(own, added.row, added.col, added.data)
    held = system.held.copy()
    held[system.still] = True
    normal = Implicit(linear, sums, inverse, side, points, damping, float(least.min(initial=1.0)), bases)
    normal.near, normal.extra = own, extra
    normal.hold(held)
    return normal
