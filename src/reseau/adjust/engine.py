"""The least-squares engine: Levenberg–Marquardt over either kind of problem.

Convergence is decided by the *relative offset* (Bates & Watts 1981): the length of the residual vector in the
space of the parameters over its length outside, each per degree of freedom. It is the correction still to
come, in standard deviations. Near the minimum, in double precision, the sum of squares no longer
distinguishes two points while the offset still does; there the offset decides on the steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ..core.data import Array
from ..core.errors import UsageError
from ..core.failure import Code, Failure
from .models import Model, State, Values
from .reliability import Solution


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


NullVector = Mapping[str, float]

_EPS = float(np.finfo(np.float64).eps)
_MEMORY, _SHRINK, _LEAST_DAMPING, _MOST_DAMPING = 0.7, 1.0 / 3.0, 1e-18, 1e18
# Largest geodesic acceleration of a step, relative to its length, both in scaled parameters.
_CURVATURE = 0.75


@dataclass(frozen=True)
class Options:
    """Options of an adjustment.

    Parameters
    ----------
    max_iterations : int
        Maximum number of corrections tried.
    tolerance : float
        Relative offset at which the iteration has converged: the correction still to come, in standard
        deviations a posteriori.
    damping : float
        Initial damping of Levenberg–Marquardt, relative to the scaled columns of length one.
    rank_tolerance : float, optional
        Singular values of the scaled design below this fraction of the largest are treated as zero. By
        default 1e-13 with analytic derivatives and 1e-9 with differences.
    scale : {"a-posteriori", "a-priori"}
        Whether :attr:`Adjustment.covariance` and :attr:`Adjustment.sigma` are multiplied by the estimated
        variance factor, or computed from the input covariance of the observations alone. Without redundancy
        always a priori.

    Raises
    ------
    UsageError
        For an unknown scale, and for values out of range.

    Examples
    --------
    >>> Options(max_iterations=20).max_iterations
    20
    """

    max_iterations: int = 1000
    tolerance: float = 1e-10
    damping: float = 1e-4
    rank_tolerance: float | None = None
    scale: Literal["a-posteriori", "a-priori"] = "a-posteriori"

    def __post_init__(self) -> None:
        if self.scale not in ("a-posteriori", "a-priori"):
            raise UsageError(f"{self.scale!r} is not a-posteriori or a-priori", where="Options.scale")
        if self.max_iterations < 0 or not self.tolerance > 0 or not self.damping > 0:
            raise UsageError(
                "tolerance and damping must be positive, max_iterations not negative", where="Options"
            )
        if self.rank_tolerance is not None and not 0 <= self.rank_tolerance < 1:
            raise UsageError("must be in [0, 1)", where="Options.rank_tolerance")


@dataclass(frozen=True, eq=False, kw_only=True)
class AdjustmentFailure(Failure):
    """An adjustment that gave no estimate, with the point where it stopped; falsy.

    Parameters
    ----------
    reason, code, where
        As for :class:`~reseau.core.failure.Failure`.
    values : mapping of str to float
        Parameters where the iteration stopped; for diagnosis only.
    iterations : int
        Number of corrections tried.
    costs : tuple of float
        Weighted sums of squares of the accepted iterations.
    null_space : tuple of mapping of str to float
        For a rank defect, combinations of parameters that the observations do not determine: any multiple of
        these corrections leaves the sum of squares unchanged.

    Examples
    --------
    >>> from reseau.core.failure import Code
    >>> failed = AdjustmentFailure("not converged in 3 iterations", Code.NOT_CONVERGED, iterations=3)
    >>> bool(failed), failed.iterations, str(failed)
    (False, 3, 'not converged in 3 iterations')
    """

    values: Mapping[str, float] = field(default_factory=dict)
    iterations: int = 0
    costs: tuple[float, ...] = ()
    null_space: tuple[NullVector, ...] = ()


@dataclass(frozen=True, eq=False)
class Solved:
    """A model at the minimum of its weighted sum of squares.

    Parameters
    ----------
    x : ndarray (u,)
        Parameters, in the arithmetic of the observations.
    cofactor : ndarray (u, u)
        Q of the parameters; zero for fixed ones.
    residuals : ndarray (n,)
        v = adjusted − observed.
    cost : float
        vᵀPv.
    redundancy : int
        Degrees of freedom.
    iterations : int
        Number of corrections tried.
    costs : tuple of float
        vᵀPv at the approximate values and after each accepted correction.
    solution : Solution
        The linearised model, from which the reliability is computed.
    """

    x: Values
    cofactor: Array
    residuals: Array
    cost: float
    redundancy: int
    iterations: int
    costs: tuple[float, ...]
    solution: Solution


def solve(model: Model, options: Options) -> Solved | AdjustmentFailure:
    """Minimise the weighted sum of squares of a model, from its approximate values."""
    return _Run(model, options).solve()


class _Run:
    """State of one adjustment."""

    def __init__(self, model: Model, options: Options) -> None:
        self.model, self.problem, self.options = model, model.problem, options
        self.free = np.flatnonzero(self.problem.parameters.mask)
        default = 1e-13 if model.analytic else 1e-9
        self.rank_tolerance = default if options.rank_tolerance is None else options.rank_tolerance
        self.damping, self.growth = options.damping, 2.0
        self.lengths = np.zeros(len(self.free))
        self.costs: list[float] = []
        self.iterations = 0

    def solve(self) -> Solved | AdjustmentFailure:
        model = self.model
        state = model.evaluate(model.start)
        if not state.usable:
            return self._failure(
                "the problem has no finite residuals at the approximate values", Code.NOT_FINITE, state
            )
        self.floor = model.floor
        self.costs.append(state.cost)
        linear = self._linearise(state)
        while not isinstance(linear, AdjustmentFailure):
            if self._offset(linear, state) <= self.options.tolerance or state.cost <= 100.0 * self._rounding(
                state, linear
            ):
                return self._arrived(state, linear)
            following = self._advance(state, linear)
            if isinstance(following, AdjustmentFailure):
                return following
            if following is None:
                return self._arrived(state, linear)
            state, linear = following
        return linear

    def _advance(
        self, state: State, linear: Linearised
    ) -> tuple[State, Linearised | AdjustmentFailure] | AdjustmentFailure | None:
        """The next better point; None at the minimum to rounding."""
        if linear.reducible <= 1e-9 * state.cost + self.floor:
            left = self.iterations < self.options.max_iterations
            closer = self._closer(state, linear) if left else None
            if closer is not None or self._offset(linear, state) < 1e-6:
                return closer
        while self.iterations < self.options.max_iterations:
            trial = self._trial(state, linear, self.damping, bend=self.model.constant_weights)
            promised = linear.predicted(self.damping)
            gain = (state.cost - trial.cost) / promised if trial.usable and promised > 0 else -1.0
            if gain > 1e-4:
                self._relax(gain)
                self.costs.append(trial.cost)
                return trial, self._linearise(trial)
            if not self._restrain():
                if self._offset(linear, state) < 1e-4 or state.cost <= 1e6 * self._rounding(state, linear):
                    return None
                return self._failure(
                    "no step decreases the sum of squares, and this is not a minimum",
                    Code.NOT_CONVERGED,
                    state,
                )
        return self._failure(f"not converged in {self.iterations} iterations", Code.NOT_CONVERGED, state)

    def _trial(self, state: State, linear: Linearised, damping: float, *, bend: bool = False) -> State:
        self.iterations += 1
        step = linear.step(damping)
        if bend:
            bent = self._bend(state, linear, damping, step)
            if bent is None:
                return State(state.x, state.residuals, state.whitened, np.inf)
            step = step + bent
        return self.model.evaluate(self._moved(state.x, step), state)

    def _bend(self, state: State, linear: Linearised, damping: float, step: Array) -> Array | None:
        """Geodesic acceleration: half the second-order correction; None where a step is too curved to trust.

        A step whose second-order part is not small against it leaves the region in which the model is known
        at all, and often for a plateau where a parameter has lost its influence (Transtrum & Sethna 2012).
        """
        h = 0.1
        ahead = self.model.evaluate(self._moved(state.x, h * step), state)
        if not ahead.usable:
            return None
        second = 2.0 / h * ((ahead.whitened - state.whitened) / h - linear.design @ step)
        bent = linear.answer(second, damping)
        size, bend = np.linalg.norm(step / linear.scale), np.linalg.norm(bent / linear.scale)
        if 2.0 * bend > _CURVATURE * size:
            return None
        return 0.5 * bent

    def _closer(self, state: State, linear: Linearised) -> tuple[State, Linearised] | None:
        """Where the sum of squares is flat to rounding: the full step, if it decreases the offset."""
        trial = self._trial(state, linear, 0.0)
        if not trial.usable or trial.cost > state.cost * (1.0 + 1e-8) + self.floor:
            return None
        following = self._linearise(trial)
        if isinstance(following, AdjustmentFailure) or following.reducible >= 0.81 * linear.reducible:
            return None
        self.costs.append(trial.cost)
        return trial, following

    def _rounding(self, state: State, linear: Linearised) -> float:
        """Squared rounding error of the observations and of the function's terms at an exact fit."""
        terms = np.abs(linear.design) @ np.abs(state.x[self.free].astype(np.float64))
        return self.floor + _EPS**2 * float(terms @ terms)

    def _relax(self, gain: float) -> None:
        shrink = max(_SHRINK, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
        self.damping = max(self.damping * shrink, _LEAST_DAMPING)
        self.growth = 2.0

    def _restrain(self) -> bool:
        """Shorten the next step; False when it cannot be shortened further."""
        self.damping = max(self.damping, _LEAST_DAMPING) * self.growth
        self.growth *= 2.0
        return self.damping < _MOST_DAMPING

    def _linearise(self, state: State) -> Linearised | AdjustmentFailure:
        design = self.model.design(state)[:, self.free]
        if not np.isfinite(design).all():
            column = int(np.flatnonzero(~np.isfinite(design).all(axis=0))[0])
            name = self.problem.parameters.free[column]
            return self._failure(
                f"the derivatives with respect to {name} are not finite", Code.NOT_FINITE, state
            )
        # After Moré (1978): the scale of a column decreases slowly, so that a parameter that loses its
        # influence does not diverge; it does decrease, because narrow valleys would be slow otherwise.
        self.lengths = np.maximum(_MEMORY * self.lengths, np.sqrt((design**2).sum(axis=0)))
        return linearise(design, state.whitened, self.rank_tolerance, self.lengths)

    def _moved(self, x: Array, step: Array) -> Array:
        full = np.zeros(len(x))
        full[self.free] = step
        return x + self.model.carry(full)

    def _offset(self, linear: Linearised, state: State) -> float:
        """Relative offset of Bates & Watts (1981)."""
        redundancy = len(linear.design) - linear.rank
        if linear.rank == 0:
            return 0.0
        inside = np.sqrt(linear.reducible / linear.rank)
        if redundancy <= 0 or linear.outside == 0.0:
            return float(inside) if inside**2 > self.floor else 0.0
        return float(inside / (linear.outside / np.sqrt(redundancy)))

    def _arrived(self, state: State, linear: Linearised) -> Solved | AdjustmentFailure:
        defect = linear.scaled_null.shape[1]
        if defect:
            vectors = self._null_vectors(linear)
            listed = "; ".join(" with ".join(vector) for vector in vectors)
            reason = f"rank defect {defect}: the observations do not determine {listed}"
            return self._failure(reason, Code.RANK_DEFECT, state, vectors)
        factor, count = linear.factor, len(self.problem.parameters)
        cofactor = np.zeros((count, count))
        cofactor[np.ix_(self.free, self.free)] = factor @ factor.T
        redundancy = len(linear.design) - self.model.left_out - linear.rank
        solution = Solution(
            design=linear.design,
            whitened=state.whitened,
            factor=factor,
            influence=tuple(self.model.influence(state)),
            cofactors=tuple(self.model.cofactors()),
        )
        return Solved(
            x=state.x,
            cofactor=cofactor,
            residuals=state.residuals,
            cost=state.cost,
            redundancy=redundancy,
            iterations=self.iterations,
            costs=tuple(self.costs),
            solution=solution,
        )

    def _null_vectors(self, linear: Linearised) -> tuple[NullVector, ...]:
        """A sparse basis of the null space: reduced by pivots, in scaled parameters."""
        vectors = linear.scaled_null.copy()
        count = vectors.shape[1]
        for column in range(count):
            rest = vectors[:, column:]
            row, pick = divmod(int(np.argmax(np.abs(rest))), rest.shape[1])
            vectors[:, [column, column + pick]] = vectors[:, [column + pick, column]]
            vectors[:, column] /= vectors[row, column]
            others = np.arange(count) != column
            vectors[:, others] -= np.outer(vectors[:, column], vectors[row, others])
        free = self.problem.parameters.free
        length = np.sqrt((linear.design**2).sum(axis=0))
        scale = 1.0 / np.where(length > 0, length, 1.0)
        named = []
        for vector in vectors.T:
            involved = np.flatnonzero(np.abs(vector) > 1e-6 * np.abs(vector).max())
            named.append({free[i]: float(vector[i] * scale[i]) for i in involved})
        return tuple(named)

    def _failure(
        self, reason: str, code: Code, state: State, null_space: tuple[NullVector, ...] = ()
    ) -> AdjustmentFailure:
        values = state.x.astype(np.float64)
        return AdjustmentFailure(
            reason,
            code,
            values=dict(zip(self.problem.parameters.names, values.tolist(), strict=True)),
            iterations=self.iterations,
            costs=tuple(self.costs),
            null_space=null_space,
        )
