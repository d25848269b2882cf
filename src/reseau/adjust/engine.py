"""The least-squares engine: Levenberg–Marquardt and Gauss–Newton over either kind of problem.

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
from .linear import Linearised, constraint_matrix, linearise
from .models import Model, State, Values
from .reliability import Solution

NullVector = Mapping[str, float]

_EPS = float(np.finfo(np.float64).eps)
_MEMORY, _SHRINK, _LEAST_DAMPING, _MOST_DAMPING = 0.7, 1.0 / 3.0, 1e-18, 1e18
_LEAST_LENGTH = 2.0**-20


@dataclass(frozen=True)
class Options:
    """Options of an adjustment.

    Parameters
    ----------
    method : {"levenberg-marquardt", "gauss-newton"}
        Gauss–Newton halves a step until the sum of squares decreases.
    max_iterations : int
        Maximum number of corrections tried.
    tolerance : float
        Relative offset at which the iteration has converged: the correction still to come, in standard
        deviations a posteriori.
    damping : float
        Initial damping of Levenberg–Marquardt, relative to the scaled columns of length one.
    curvature : float
        Levenberg–Marquardt rejects a step v whose geodesic acceleration a has 2|a|/|v| above this, in scaled
        parameters. For Gauss–Markov problems only.
    rank_tolerance : float, optional
        Singular values of the scaled design below this fraction of the largest are treated as zero. By
        default 1e-13 with analytic derivatives and 1e-9 with differences.
    scale : {"a-posteriori", "a-priori"}
        Whether :attr:`Adjustment.covariance` and :attr:`Adjustment.sigma` are multiplied by the estimated
        variance factor, or computed from the input covariance of the observations alone. Without redundancy
        always a priori.
    check_jacobian : float, optional
        Compare analytic derivatives with differences at the approximate values, and raise `UsageError` when
        they differ by more than this, relative to the largest value of each column.

    Raises
    ------
    UsageError
        For an unknown method or scale, for values out of range, and for an option that the method ignores.

    Examples
    --------
    >>> Options(method="gauss-newton", max_iterations=20).max_iterations
    20
    """

    method: Literal["levenberg-marquardt", "gauss-newton"] = "levenberg-marquardt"
    max_iterations: int = 1000
    tolerance: float = 1e-10
    damping: float = 1e-4
    curvature: float = 0.75
    rank_tolerance: float | None = None
    scale: Literal["a-posteriori", "a-priori"] = "a-posteriori"
    check_jacobian: float | None = None

    def __post_init__(self) -> None:
        if self.method not in ("levenberg-marquardt", "gauss-newton"):
            raise UsageError(
                f"{self.method!r} is not levenberg-marquardt or gauss-newton", where="Options.method"
            )
        if self.scale not in ("a-posteriori", "a-priori"):
            raise UsageError(f"{self.scale!r} is not a-posteriori or a-priori", where="Options.scale")
        if (
            self.max_iterations < 0
            or not self.tolerance > 0
            or not self.damping > 0
            or not self.curvature > 0
        ):
            raise UsageError(
                "tolerance, damping and curvature must be positive, max_iterations not negative",
                where="Options",
            )
        if self.rank_tolerance is not None and not 0 <= self.rank_tolerance < 1:
            raise UsageError("must be in [0, 1)", where="Options.rank_tolerance")
        usual = (Options.damping, Options.curvature)
        if self.method == "gauss-newton" and (self.damping, self.curvature) != usual:
            raise UsageError(
                "apply to levenberg-marquardt only", where="Options.damping and Options.curvature"
            )


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
    defect : int
        Rank defect that inner constraints removed.
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
    defect: int
    iterations: int
    costs: tuple[float, ...]
    solution: Solution


def solve(model: Model, options: Options) -> Solved | AdjustmentFailure:
    """Minimise the weighted sum of squares of a model, from its approximate values.

    Raises
    ------
    UsageError
        When `options.check_jacobian` is given and the derivatives disagree with differences, and for an
        option that the model cannot honour.
    """
    if options.check_jacobian is not None:
        _check(model, options.check_jacobian)
    if options.curvature != Options.curvature and not model.constant_weights:
        raise UsageError("applies to Gauss-Markov problems only", where="Options.curvature")
    return _Run(model, options).solve()


class _Run:
    """State of one adjustment."""

    def __init__(self, model: Model, options: Options) -> None:
        self.model, self.problem, self.options = model, model.problem, options
        problem, parameters = self.problem, self.problem.parameters
        self.free = np.flatnonzero(parameters.mask)
        self.constraints = constraint_matrix(
            problem.constraints, parameters.names, parameters.values, parameters.mask
        )
        default = 1e-13 if model.analytic else 1e-9
        self.rank_tolerance = default if options.rank_tolerance is None else options.rank_tolerance
        datum = set(problem.datum)
        self.datum = np.array([name in datum for name in parameters.free], dtype=bool)
        self.marquardt = options.method == "levenberg-marquardt"
        self.damping, self.growth, self.length = options.damping if self.marquardt else 0.0, 2.0, 1.0
        self.lengths = np.zeros(len(self.free))
        self.costs: list[float] = []
        self.iterations = 0

    def solve(self) -> Solved | AdjustmentFailure:
        model, x = self.model, self.model.start
        x = self._moved(x, self.constraints.onto(x[self.free].astype(np.float64)))
        self.begin = x[self.free].astype(np.float64)
        state = model.evaluate(x)
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
        self.length = 1.0
        while self.iterations < self.options.max_iterations:
            bend = self.marquardt and self.model.constant_weights
            trial = self._trial(state, linear, self.damping, self.length, bend)
            promised = linear.predicted(self.damping) if self.marquardt else self.length * linear.reducible
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

    def _trial(
        self, state: State, linear: Linearised, damping: float, length: float, bend: bool = False
    ) -> State:
        self.iterations += 1
        step = length * self._datum_step(state, linear, damping)
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
        if 2.0 * bend > self.options.curvature * size:
            return None
        return 0.5 * bent

    def _closer(self, state: State, linear: Linearised) -> tuple[State, Linearised] | None:
        """Where the sum of squares is flat to rounding: the full step, if it decreases the offset."""
        trial = self._trial(state, linear, 0.0, 1.0)
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
        self.damping = max(self.damping * shrink, _LEAST_DAMPING) if self.damping else 0.0
        self.growth = 2.0

    def _restrain(self) -> bool:
        """Shorten the next step; False when it cannot be shortened further."""
        if self.marquardt:
            self.damping = max(self.damping, _LEAST_DAMPING) * self.growth
            self.growth *= 2.0
            return self.damping < _MOST_DAMPING
        self.length *= 0.5
        return self.length > _LEAST_LENGTH

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
        return linearise(design, state.whitened, self.constraints, self.rank_tolerance, self.lengths)

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

    def _datum_step(self, state: State, linear: Linearised, damping: float) -> Array:
        step = linear.step(damping)
        if not self.datum.any() or linear.rank == len(linear.singular):
            return step
        # Inner constraints: Gᵀ (x − x_begin) = 0 over the chosen parameters (Förstner & Wrobel 2016, sect.
        # 4.5).
        past = np.where(self.datum, state.x[self.free].astype(np.float64) - self.begin + step, 0.0)
        g = linear.null
        inner = g[self.datum].T @ g[self.datum]
        return step - g @ (np.linalg.pinv(inner) @ (g.T @ past)) / (1.0 + damping)

    def _arrived(self, state: State, linear: Linearised) -> Solved | AdjustmentFailure:
        factor, defect = linear.factor, linear.null.shape[1]
        if defect:
            vectors = self._null_vectors(linear)
            listed = "; ".join(" with ".join(vector) for vector in vectors)
            if not self.datum.any():
                reason = f"rank defect {defect}: the observations do not determine {listed}"
                return self._failure(reason, Code.RANK_DEFECT, state, vectors)
            g = linear.null
            inner = g[self.datum].T @ g[self.datum]
            size = np.sqrt(np.maximum(np.diag(inner), np.finfo(float).tiny))
            if np.linalg.eigvalsh(inner / np.outer(size, size))[0] < 1e-10:
                reason = f"rank defect {defect}: the chosen datum does not determine {listed}"
                return self._failure(reason, Code.NO_DATUM, state, vectors)
            weight = np.linalg.solve(inner, np.where(self.datum[:, None], g, 0.0).T)
            factor = factor - g @ (weight @ factor)
        return self._solved(state, linear, factor, defect)

    def _solved(self, state: State, linear: Linearised, factor: Array, defect: int) -> Solved:
        parameters = self.problem.parameters
        cofactor = np.zeros((len(parameters), len(parameters)))
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
            defect=defect,
            iterations=self.iterations,
            costs=tuple(self.costs),
            solution=solution,
        )

    def _null_vectors(self, linear: Linearised) -> tuple[NullVector, ...]:
        """A sparse basis of the null space, in scaled parameters."""
        vectors = sparse_basis(linear.scaled_null)
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


def sparse_basis(vectors: Array) -> Array:
    """A basis (n, k) of the same space with as many zeros as possible, reduced by pivots.

    Examples
    --------
    >>> sparse_basis(np.array([[1.0, 1.0], [1.0, -1.0], [0.0, 0.0]]))
    array([[1., 0.],
           [0., 1.],
           [0., 0.]])
    """
    vectors, count = vectors.copy(), vectors.shape[1]
    for column in range(count):
        rest = vectors[:, column:]
        row, pick = divmod(int(np.argmax(np.abs(rest))), rest.shape[1])
        vectors[:, [column, column + pick]] = vectors[:, [column + pick, column]]
        vectors[:, column] /= vectors[row, column]
        others = np.arange(count) != column
        vectors[:, others] -= np.outer(vectors[:, column], vectors[row, others])
    return vectors


def _check(model: Model, tolerance: float) -> None:
    found = model.check(np.array(model.problem.parameters.values, dtype=np.float64))
    if not found.agrees(tolerance):
        raise UsageError(
            f"differs from differences by {found.error:.2g} of its column, at row {found.row}",
            where=f"derivative with respect to {found.worst}",
        )
