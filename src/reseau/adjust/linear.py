"""The linear problem of one iteration: scale the columns, solve by QR and SVD.

The normal equations are never formed: QR of the scaled design, then the singular values of R. The error of
the correction is therefore proportional to the condition number and not to its square, each damping costs
only a product, and the null space is available for the diagnosis of a rank defect (Golub & Van Loan, *Matrix
Computations*, ch. 5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.data import Array


@dataclass(frozen=True, eq=False)
class Linearised:
    """Scaled design A D = Q U diag(s) Vᵀ over the free parameters, and the residuals seen through it.

    Parameters
    ----------
    design : ndarray (N, f)
        Whitened design of the free parameters.
    basis : ndarray (f, q)
        D V: corrections of the free parameters for each singular direction.
    singular : ndarray (q,)
        Singular values, descending; zero below the rank.
    projected : ndarray (q,)
        Uᵀ Qᵀ r.
    rank : int
        Numerical rank.
    scaled_null : ndarray (f, q − rank)
        Corrections that leave all residuals unchanged, in scaled parameters, orthonormal.
    outside : float
        Norm of r outside the column space.
    """

    design: Array
    basis: Array
    singular: Array
    projected: Array
    rank: int
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
    tolerance: float,
    lengths: Array | None = None,
) -> Linearised:
    """Factorise the linear problem ``|r + A dx|``.

    Parameters
    ----------
    design : ndarray (N, f)
        Whitened design A of the free parameters.
    whitened : ndarray (N,)
        r.
    tolerance : float
        Singular values of the scaled design below this fraction of the largest are treated as zero.
    """
    length = np.sqrt((design**2).sum(axis=0)) if lengths is None else lengths
    scale = 1.0 / np.where(length > 0, length, 1.0)
    scaled = design * scale
    columns = len(scale)
    triangle: Array = np.asarray(np.linalg.qr(np.column_stack([scaled, whitened]), mode="r"))
    u, singular, vt = np.linalg.svd(triangle[:columns, :columns])
    singular = np.pad(singular, (0, columns - len(singular)))
    projected = np.zeros(columns)
    head = triangle[:columns, columns]
    projected[: len(head)] = u.T @ head
    largest = singular[0] if columns else 0.0
    rank = int((singular > tolerance * largest).sum()) if largest > 0 else 0
    v = np.ascontiguousarray(vt.T)
    basis = scale[:, None] * v
    return Linearised(
        design=design,
        basis=basis,
        singular=singular,
        projected=projected,
        rank=rank,
        scaled_null=v[:, rank:],
        scale=scale,
        outside=abs(float(triangle[columns, columns])) if len(triangle) > columns else 0.0,
    )
