"""Additional causes of displacements in an adjusted network, as random effects: their scores and evidence.

A cause displaces the image points by C θ, with θ ~ N(0, σ² Λ), which the adjustment did not know of. All that
the observations say of θ is in the residual sum of squares wᵀw, in the score g = Cᵀw and in the information
M = Cᵀ (I − A Q Aᵀ) C (Rao 1948; Koch 1999, ch. 4). With S = (Λ⁻¹ + M)⁻¹ the restricted likelihood of the
observations (Patterson & Thompson 1971, *Biometrika* 58) is, but for a constant,

    −½ [ r ln σ² + ln det(I + Λ M) + (wᵀw − gᵀ S g) / σ² ].

It is the product of the densities with which each observation is predicted by those before it, so that a
cause with many parameters pays for them: it is compared with others without another test. The size of the
effects is unknown; the density is the mean over sizes on a logarithmic scale, and over σ² in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from ...core.data import Array, Rows
from ..solver.normal import SEGMENTS
from ..solver.problem import BundleFit

ODDS = np.log(10.0)
"""Logarithm of how much better a model with more parameters must predict what is left out: ten times, and as
many times more as there are such models, one of which could do so by chance. One parameter too many does in
1 % of cases: the logarithm is (χ² − 2) / 2 with one degree of freedom (Stone 1977, J. R. Statist. Soc. B 39),
and χ² > 2 + 2 ln 10 has this probability. So have several."""
_SIZES = np.geomspace(0.02, 2000.0, 24)
"""Root mean square displacements that a cause may have, in standard deviations of the image points."""
_LOG_RANGE = 2 * np.log(100.0**2)
"""Range of ln σ² over which an unknown variance factor is taken as equally probable."""
_ABSORBED = 1e-9
"""Information, relative to the largest, that is the rounding error of what the unknowns absorb."""
_AT_ONCE = 32
"""Images whose effects are looked at together."""
_LARGEST = 40_000_000
"""Largest number of products of coordinates of points and columns; beyond, nothing is computed."""


@dataclass(frozen=True, eq=False)
class Effect:
    """Columns C of one cause.

    Parameters
    ----------
    slope : ndarray (n, 2, q)
        Displacement (px) of each used image point by one unit of each of the q effects of its group.
    group : ndarray of int (n,)
        Group of each image point, such as its image or its camera; −1 for points without the effect.
    groups : int
        Number of groups; each has effects of its own.
    """

    slope: Array
    group: Rows
    groups: int

    @property
    def count(self) -> int:
        """Number of columns."""
        return self.groups * int(self.slope.shape[2])

    def rms(self, sigma: Array) -> Array:
        """Displacements of the points by one unit of each effect in their sigma (n,), (groups, q)."""
        own = self.group >= 0
        part = self.slope[own] / sigma[own, None, None]
        total = np.zeros((self.groups, part.shape[2]))
        np.add.at(total, self.group[own], (part**2).sum(axis=1))
        number = 2 * np.bincount(self.group[own], minlength=self.groups)
        return np.asarray(np.sqrt(total / np.maximum(number, 1)[:, None]))

    def mean_square(self, sigma: Array) -> Array:
        """Mean square of the same over the points of all groups (q,)."""
        number = np.bincount(self.group[self.group >= 0], minlength=self.groups)
        return np.asarray(number @ self.rms(sigma) ** 2 / max(int(number.sum()), 1))

    def columns(self, root: Array) -> scipy.sparse.csr_array:
        """Weighted columns (2n, groups · q), sparse."""
        n, _, q = self.slope.shape
        own = np.flatnonzero(self.group >= 0)
        values = root[own] @ self.slope[own]
        at = 2 * own[:, None, None] + np.arange(2)[:, None] + np.zeros(q, dtype=np.intp)
        column = self.group[own][:, None, None] * q + np.zeros((2, 1), dtype=np.intp) + np.arange(q)
        return scipy.sparse.csr_array(
            (values.ravel(), (at.ravel(), column.ravel())), shape=(2 * n, self.count)
        )


@dataclass(frozen=True, eq=False)
class Scores:
    """What the observations say of columns C, after an adjustment without them.

    Parameters
    ----------
    g : ndarray (k,)
        Scores of the columns, with the sign of the displacements.
    m : ndarray (k, k)
        Their information.
    square : float
        Sum of squares of the weighted residuals.
    redundancy : int
        Redundancy of the adjustment.
    carried : ndarray (u, k)
        Change of the reduced unknowns by the columns, if these are not taken into account.
    log_density : float
        Logarithm of the density that causes taken in before have already cost.
    """

    g: Array
    m: Array
    square: float
    redundancy: int
    carried: Array
    log_density: float = 0.0

    def part(self, columns: Rows | slice) -> Scores:
        """The scores of some of the columns."""
        m = self.m[columns][:, columns]
        return replace(self, g=self.g[columns], m=m, carried=self.carried[:, columns])

    def scaled(self, units: Array) -> Scores:
        """The scores of the columns in other units (k,)."""
        m = self.m * np.outer(units, units)
        return replace(self, g=self.g * units, m=m, carried=self.carried * units)

    def mapped(self, matrix: Array) -> Scores:
        """The scores of other columns C T."""
        return replace(self, g=matrix.T @ self.g, m=matrix.T @ self.m @ matrix, carried=self.carried @ matrix)

    def combined(self, groups: int, matrices: Array) -> Scores:
        """The scores of combinations of the columns of each group, (groups, q, k)."""
        q, k = matrices.shape[1:]
        g = (np.swapaxes(matrices, 1, 2) @ self.g.reshape(groups, q, 1)).ravel()
        half = (self.m.reshape(-1, groups, 1, q) @ matrices).reshape(-1, groups * k)
        m = np.swapaxes(matrices, 1, 2) @ half.reshape(groups, q, -1)
        carried = (self.carried.reshape(-1, groups, 1, q) @ matrices).reshape(-1, groups * k)
        return replace(self, g=g, m=m.reshape(groups * k, -1), carried=carried)

    @cached_property
    def _spectrum(self) -> tuple[Array, Array]:
        """Eigenvalues of M, and squares of g along the eigenvectors."""
        values, vectors = scipy.linalg.eigh(self.m, check_finite=False)
        seen = values > _ABSORBED * max(float(values[-1]), 0.0)
        return np.where(seen, values, 0.0), np.where(seen, (vectors.T @ self.g) ** 2, 0.0)

    def log_evidence(self, sizes: Array = _SIZES, *, known: float = 0.5) -> float:
        """Logarithm of the density of the observations with these effects, of unknown size.

        Parameters
        ----------
        sizes : ndarray
            Standard deviations of the effects, in standard deviations of the observations; equally probable.
        known : float
            Probability that the variance factor is one; otherwise it is unknown.
        """
        values, squares = self._spectrum
        lam = sizes[:, None] ** 2
        log_det = np.log1p(lam * values).sum(axis=1)
        quad = self.square - (lam * squares / (1 + lam * values)).sum(axis=1)
        each = self._log_density(quad, known) - 0.5 * log_det
        return float(scipy.special.logsumexp(each) - np.log(len(sizes))) + self.log_density

    def log_nothing(self, *, known: float = 0.5) -> float:
        """The same without any effect."""
        return float(self._log_density(np.array([self.square]), known)[0]) + self.log_density

    def _log_density(self, quad: Array, known: float = 0.5) -> Array:
        """Log density of residuals with this sum of squares: of a mixture of σ² = 1 and σ² unknown.

        Sums that are not positive have lost their digits, and have none.
        """
        half, found = self.redundancy / 2, np.full(quad.shape, -np.inf)
        possible = quad > 0
        quad = quad[possible]
        free = scipy.special.gammaln(half) + half * np.log(2.0) - half * np.log(quad) - np.log(_LOG_RANGE)
        with np.errstate(divide="ignore"):
            found[possible] = np.logaddexp(-0.5 * quad + np.log(known), free + np.log1p(-known))
        return found

    def log_profile(self, sizes: Array) -> Array:
        """Logarithm of the restricted likelihood with effects of these sizes, of the best variance factor."""
        values, squares = self._spectrum
        lam = sizes[:, None] ** 2
        quad = self.square - (lam * squares / (1 + lam * values)).sum(axis=1)
        return np.asarray(self.log_likelihood(quad) - 0.5 * np.log1p(lam * values).sum(axis=1))

    def log_likelihood(self, square: Array) -> Array:
        """The same for sums of squares, but for the determinant; none of those without any digits."""
        known = square > 0
        log = np.log(np.where(known, square, 1.0) / self.redundancy)
        return np.asarray(np.where(known, self.log_density - 0.5 * self.redundancy * log, -np.inf))

    def best_size(self, sizes: Array = _SIZES) -> float:
        """The most probable size of the effects."""
        values, squares = self._spectrum
        fine = np.geomspace(sizes[0], sizes[-1], 8 * len(sizes))
        lam = fine[:, None] ** 2
        quad = self.square - (lam * squares / (1 + lam * values)).sum(axis=1)
        each = self._log_density(quad) - 0.5 * np.log1p(lam * values).sum(axis=1)
        return float(fine[int(np.argmax(each))])

    def explained(self, size: float) -> float:
        """Decrease of the sum of squares by effects of this size."""
        values, squares = self._spectrum
        lam = size**2
        return float((lam * squares / (1 + lam * values)).sum())

    def effects(self, size: float) -> Array:
        """The most probable effects of this size (k,)."""
        return np.asarray(np.linalg.solve(self.m + np.eye(len(self.g)) / size**2, self.g), dtype=np.float64)

    def before(self, effects: Array) -> Scores:
        """The scores without these effects (k,), which were taken into account when they were computed."""
        more = self.m @ effects
        return replace(self, g=self.g + more, square=self.square + float(effects @ (2 * self.g + more)))

    def with_effects(self, columns: Rows, size: float | Array) -> Scores:
        """The scores after effects of this size, or these sizes (k,), were taken into account."""
        sizes = np.broadcast_to(np.asarray(size, dtype=np.float64), len(columns))
        columns, sizes = columns[sizes > 0], sizes[sizes > 0]
        m, cross = self.m, self.m[:, columns] * sizes
        factor = lower_factor(sizes[:, None] * cross[columns]), True
        side = np.column_stack([self.g[columns], m[columns]]) * sizes[:, None]
        solved = scipy.linalg.cho_solve(factor, side)
        return replace(
            self,
            g=self.g - cross @ solved[:, 0],
            m=m - cross @ solved[:, 1:],
            square=self.square - float(side[:, 0] @ solved[:, 0]),
            carried=self.carried - (self.carried[:, columns] * sizes) @ solved[:, 1:],
            log_density=self.log_density - float(np.log(np.diag(factor[0])).sum()),
        )


def lower_factor(m: Array) -> Array:
    """Lower Cholesky factor of I + M; what is negative in M is the rounding error of what unknowns absorb."""
    one, jitter = np.eye(len(m)), 0.0
    while True:
        try:
            return np.asarray(np.linalg.cholesky(m + (1.0 + jitter) * one))
        except np.linalg.LinAlgError:
            jitter = 10 * jitter or 1e-9 * max(float(np.abs(m).max(initial=0.0)), 1.0)


def too_large(fit: BundleFit, columns: int) -> bool:
    """Whether scores of so many columns take too long, or the adjustment has no cofactors."""
    points = int(np.count_nonzero(fit.linear.system.pattern.eliminated))
    every = max(3 * points, fit.unknowns.size, columns)
    return not fit.cofactors.reduced.known or every * columns > _LARGEST


def scores(fit: BundleFit, effects: Sequence[Effect]) -> Scores:
    """Compute the scores of the columns of several causes, one after the other.

    Parameters
    ----------
    fit : BundleFit
        The adjustment.
    effects : sequence of Effect
        For the used image points, in the order of :func:`used_rows`.
    """
    linear, cofactors = fit.linear, fit.cofactors
    root = linear.system.seen.root
    # The residuals are a column, too: what the adjustment has left of its convergence is then no score.
    own = scipy.sparse.csr_array(-linear.misfits.reshape(-1, 1))
    c = scipy.sparse.hstack([*(effect.columns(root) for effect in effects), own], format="csr")
    a, b = _design(fit)
    turned, by = _reduced(fit, a, b, c)
    eliminated = np.flatnonzero(linear.system.pattern.eliminated == 1)
    z = cofactors.reduced if cofactors.referral is None else cofactors.referral.before
    solved = z.times(turned)
    m = (c.T @ c).toarray() - turned.T @ solved
    if len(eliminated):
        inverse = cofactors.normal.inverse[eliminated] @ by[eliminated]
        flat = by[eliminated].reshape(-1, c.shape[1])
        m -= flat.T @ inverse.reshape(-1, c.shape[1])
    m = (m + m.T) / 2
    left = float((linear.misfits**2).sum()) - m[-1, -1]
    return Scores(m[:-1, -1].copy(), m[:-1, :-1].copy(), fit.cost - left, fit.redundancy, solved[:, :-1])


def sensitivities(fit: BundleFit, effect: Effect, columns: Rows) -> Array:
    """Changes (k, groups · q) of reduced unknowns by effects that the adjustment does not know of."""
    own = fit.cofactors.reduced.rows(columns)
    a, b = _design(fit)
    found, step = np.zeros((len(columns), effect.count)), _AT_ONCE * effect.slope.shape[2]
    c = effect.columns(fit.linear.system.seen.root).tocsc()
    for begin in range(0, effect.count, step):
        found[:, begin : begin + step] = own @ _reduced(fit, a, b, c[:, begin : begin + step])[0]
    return found


def _reduced(
    fit: BundleFit, a: scipy.sparse.csr_array, b: scipy.sparse.csr_array, c: scipy.sparse.sparray
) -> tuple[Array, Array]:
    """Products of the columns C and the design, with the points eliminated (u, k); and of points (p, 3, k).

    Those of points are dense: the columns of an image meet all its points.
    """
    turned: Array = (a.T @ c).toarray()
    by: Array = np.ascontiguousarray((b.T @ c).toarray().reshape(-1, 3, c.shape[1]))
    turned += fit.cofactors.normal.reduced_sides(by)
    return turned, by


def used_rows(fit: BundleFit) -> Rows:
    """Rows of the network of the image points that were adjusted, in the order of the solver."""
    return np.flatnonzero(fit.usable.observations)[fit.unknowns.order]


def places_seen(fit: BundleFit) -> Array:
    """Adjusted places (n, 2) of the used image points, px.

    Observed ones would carry the noise into whatever is computed from them.
    """
    rows, n = used_rows(fit), len(fit.problem.network.xy)
    return np.asarray(fit.problem.network.xy[rows] + fit.residuals[: 2 * n].reshape(n, 2)[rows])


def in_camera(fit: BundleFit) -> Array:
    """Used points in the axes of their cameras (n, 3)."""
    network, rows, values = fit.problem.network, used_rows(fit), fit.values
    image = network.image_of[rows]
    off = values.xyz[network.point_of[rows]] - values.x0[image]
    return np.asarray((values.rotation[image] @ off[:, :, None])[:, :, 0])


def sigma_seen(fit: BundleFit) -> Array:
    """Standard deviations (n,) of the used image points, px, mean of both coordinates."""
    cov = fit.problem.network.cov[used_rows(fit)]
    return np.asarray(np.sqrt(np.trace(cov, axis1=1, axis2=2) / 2))


def _design(fit: BundleFit) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
    """Weighted derivatives of the image points by the reduced unknowns (2n, u) and by points (2n, 3p)."""
    linear = fit.linear
    pattern, last = linear.system.pattern, linear.rows.shape[2] - 3
    n = len(linear.rows)
    entries, at, columns = [], [], []
    for s in range(SEGMENTS):
        width, start, first = pattern.width[:, s], pattern.start[:, s], pattern.column[:, s]
        for i in range(int(width.max(initial=0))):
            k = np.flatnonzero(width > i)
            for axis in range(2):
                entries.append(linear.rows[k, axis, first[k] + i])
                at.append(2 * k + axis)
                columns.append(start[k] + i)
    a = scipy.sparse.csr_array(
        (np.concatenate(entries), (np.concatenate(at), np.concatenate(columns))),
        shape=(2 * n, fit.unknowns.size),
    )
    point = linear.system.seen.point
    k = np.flatnonzero(pattern.eliminated[point] == 1)
    rows = 2 * k[:, None, None] + np.arange(2)[:, None] + np.zeros(3, dtype=np.intp)
    where = 3 * point[k][:, None, None] + np.zeros((2, 1), dtype=np.intp) + np.arange(3)
    b = scipy.sparse.csr_array(
        (linear.rows[k][:, :, last:].ravel(), (rows.ravel(), where.ravel())),
        shape=(2 * n, 3 * len(linear.prior)),
    )
    return a, b
