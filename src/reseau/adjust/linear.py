"""The linear problem of one iteration: scale the columns, eliminate constraints, solve by QR and SVD.

The normal equations are never formed: QR of the scaled design, then the singular values of R. The error of
the correction is therefore proportional to the condition number and not to its square, each damping costs
only a product, and the null space is available for the diagnosis of a rank defect (Golub & Van Loan, *Matrix
Computations*, ch. 5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..core.data import Array, Mask
from ..core.errors import UsageError
from .parameters import Constraint


@dataclass(frozen=True, eq=False)
class ConstraintMatrix:
    """Independent linear constraints C x = d on the free parameters: C (q, f), d (q,)."""

    matrix: Array
    value: Array

    def __len__(self) -> int:
        return len(self.value)

    def onto(self, x: Array) -> Array:
        """The correction of least relative norm after which x (f,) satisfies the constraints."""
        if not len(self):
            return np.zeros_like(x)
        scale = np.where(x != 0, np.abs(x), np.abs(x).max(initial=0.0) or 1.0)
        short = self.value - self.matrix @ x
        correction: Array = scale * (np.linalg.pinv(self.matrix * scale) @ short)
        return correction


def constraint_matrix(
    constraints: Sequence[Constraint], names: tuple[str, ...], values: Array, mask: Mask
) -> ConstraintMatrix:
    """Constraints by name as a matrix over the free parameters; the fixed ones go to the right-hand side.

    Raises
    ------
    UsageError
        When they contradict each other or the fixed values.
    """
    full = np.zeros((len(constraints), len(names)))
    value = np.array([c.value for c in constraints], dtype=np.float64)
    for row, constraint in enumerate(constraints):
        for name, coefficient in constraint.coefficients.items():
            full[row, names.index(name)] = coefficient
    size = np.abs(full).max(axis=1, initial=0.0)
    if (size == 0).any():
        raise UsageError("has no coefficient other than zero", where="constraint")
    value = (value - full[:, ~mask] @ values[~mask]) / size
    matrix = full[:, mask] / size[:, None]
    if not len(matrix):
        return ConstraintMatrix(matrix, value)
    left, singular, right = np.linalg.svd(matrix, full_matrices=True)
    rank = int((singular > 1e-10).sum())
    rest = left[:, rank:].T @ value
    if np.abs(rest).max(initial=0.0) > 1e-8 * max(1.0, float(np.abs(value).max())):
        raise UsageError("contradict each other or the fixed parameters", where="constraints")
    # Dependent constraints are redundant.
    return ConstraintMatrix(right[:rank], (left[:, :rank].T @ value) / singular[:rank])


@dataclass(frozen=True, eq=False)
class Linearised:
    """Scaled design A D Z = Q U diag(s) Vᵀ over the free parameters, and the residuals seen through it.

    Parameters
    ----------
    design : ndarray (N, f)
        Whitened design of the free parameters.
    basis : ndarray (f, q)
        D Z V: corrections of the free parameters for each singular direction, constraints kept.
    singular : ndarray (q,)
        Singular values, descending; zero below the rank.
    projected : ndarray (q,)
        Uᵀ Qᵀ r.
    rank : int
        Numerical rank.
    null : ndarray (f, q − rank)
        Corrections of the parameters that leave all residuals unchanged.
    scaled_null : ndarray (f, q − rank)
        The same in the scaled parameters, orthonormal.
    outside : float
        Norm of r outside the column space.
    """

    design: Array
    basis: Array
    singular: Array
    projected: Array
    rank: int
    null: Array
    scaled_null: Array
    outside: float
    scale: Array

    def step(self, damping: float) -> Array:
        """Return the correction (f,) that minimises ``|r + A dx|² + damping · |D⁻¹ dx|²``.

        Without damping it is the one of least norm.
        """
        s, g = self.singular[: self.rank], self.projected[: self.rank]
        return -self.basis[:, : self.rank] @ (s / (s**2 + damping) * g)

    def predicted(self, damping: float) -> float:
        """Decrease of the sum of squares predicted for :meth:`step`."""
        s, g = self.singular[: self.rank], self.projected[: self.rank]
        left = damping / (s**2 + damping)
        return float(((1.0 - left**2) * g**2).sum())

    def answer(self, residuals: Array, damping: float) -> Array:
        """The correction (f,) to other residuals (N,) of the same design."""
        basis, s = self.basis[:, : self.rank], self.singular[: self.rank]
        return -basis @ ((basis.T @ (self.design.T @ residuals)) / (s**2 + damping))

    @property
    def reducible(self) -> float:
        """The decrease of the sum of squares that a correction can still give, to first order."""
        g = self.projected[: self.rank]
        return float(g @ g)

    @property
    def factor(self) -> Array:
        """F (f, rank) with the cofactor matrix of the parameters F Fᵀ; least norm at a rank defect."""
        return self.basis[:, : self.rank] / self.singular[: self.rank]


def linearise(
    design: Array,
    whitened: Array,
    constraints: ConstraintMatrix,
    tolerance: float,
    lengths: Array | None = None,
) -> Linearised:
    """Factorise the linear problem ``|r + A dx|`` with constraints C dx = 0.

    Parameters
    ----------
    design : ndarray (N, f)
        Whitened design A of the free parameters.
    whitened : ndarray (N,)
        r.
    constraints : ConstraintMatrix
        On the free parameters.
    tolerance : float
        Singular values of the scaled design below this fraction of the largest are treated as zero.
    """
    length = np.sqrt((design**2).sum(axis=0)) if lengths is None else lengths
    scale = 1.0 / np.where(length > 0, length, 1.0)
    scaled = design * scale
    free = len(scale)
    z = np.eye(free)
    if len(constraints):
        turned = constraints.matrix * scale
        turned /= np.sqrt((turned**2).sum(axis=1, keepdims=True))
        orthogonal: Array = np.linalg.qr(turned.T, mode="complete").Q
        z = orthogonal[:, len(constraints) :]
        scaled = scaled @ z
    columns = scaled.shape[1]
    triangle: Array = np.asarray(np.linalg.qr(np.column_stack([scaled, whitened]), mode="r"))
    u, singular, vt = np.linalg.svd(triangle[:columns, :columns])
    singular = np.pad(singular, (0, columns - len(singular)))
    projected = np.zeros(columns)
    head = triangle[:columns, columns]
    projected[: len(head)] = u.T @ head
    largest = singular[0] if columns else 0.0
    rank = int((singular > tolerance * largest).sum()) if largest > 0 else 0
    turned_z = z @ vt.T
    basis = scale[:, None] * turned_z
    return Linearised(
        design=design,
        basis=basis,
        singular=singular,
        projected=projected,
        rank=rank,
        null=basis[:, rank:],
        scaled_null=turned_z[:, rank:],
        scale=scale,
        outside=abs(float(triangle[columns, columns])) if len(triangle) > columns else 0.0,
    )
