"""Whitened residuals and design of a problem at any values of the parameters.

Both kinds of problem reduce to least squares of a whitened vector r(x). In the Gauss–Markov model
r = W (f(x) − l). In the Gauss–Helmert model the residuals v of given x are found first, as those of least
vᵀPv that keep the conditions; then r = L⁻¹(g − B v) with L Lᵀ = B Q Bᵀ (Mikhail 1976, ch. 7; Förstner &
Wrobel 2016, ch. 4), so that rᵀr = vᵀPv, and L⁻¹A is its derivative to first order. Observed parameters
are further rows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.data import Array
from ..core.errors import UsageError
from .differences import differences
from .parameters import Parameters
from .stochastic import Blocks, Covariance, Weighting, blocks_of

Values = NDArray[Any]
Function = Callable[[Values], Any]
Jacobian = Callable[[Array], Any]
Conditions = Callable[[Array, Array], Any]
Jacobians = Callable[[Array, Array], tuple[Any, Any]]

_EPS = float(np.finfo(np.float64).eps)
_INNER = 30


class Specification(Protocol):
    """The parts of a problem that do not depend on its kind; see :class:`reseau.adjust.GaussMarkov`."""

    @property
    def observations(self) -> Values:
        """Observations, in any shape."""

    @property
    def covariance(self) -> Covariance:
        """Their covariance."""

    @property
    def parameters(self) -> Parameters:
        """Names, approximate values, which are free, and their observations."""

    @property
    def weights(self) -> Array | None:
        """Factors on the weights, of the observations' shape."""

    @property
    def size(self) -> int:
        """Number of observations."""


@dataclass(frozen=True, eq=False)
class State:
    """A problem evaluated at one set of parameters.

    Parameters
    ----------
    x : ndarray (u,)
        Parameters, in the arithmetic of the observations.
    residuals : ndarray (n,)
        v = adjusted − observed.
    whitened : ndarray (N,)
        r of observations or conditions, then of observed parameters.
    cost : float
        rᵀr; infinite where the problem cannot be evaluated.
    root : Blocks or None
        L⁻¹ of the conditions (Gauss–Helmert).
    derivatives : ndarray or None
        B of the conditions (b, c, k).
    """

    x: Values
    residuals: Array
    whitened: Array
    cost: float
    root: Blocks | None = None
    derivatives: Array | None = None

    @property
    def usable(self) -> bool:
        """Whether the function has finite values."""
        return bool(np.isfinite(self.cost))


class Model:
    """Common part of both kinds: arithmetic of the parameters, and the rows of prior observations."""

    def __init__(self, problem: Specification) -> None:
        self.problem = problem
        self.names = problem.parameters.names
        self.mask = problem.parameters.mask
        observed = problem.observations
        self.factors = None if problem.weights is None else problem.weights.ravel()
        kind = type(observed.flat[0]) if observed.dtype == object and observed.size else None
        self._kind: Callable[[float], Any] | None = kind
        self._dtype = observed.dtype
        self.prior = None
        if problem.parameters.prior is not None:
            prior = problem.parameters.prior.select(problem.parameters.free)
            if prior.names:
                self.prior = prior
                self.prior_at = np.array([self.names.index(name) for name in prior.names], dtype=np.intp)
                blocks = blocks_of(prior.covariance, prior.values.shape, "prior")
                self.prior_weighting = Weighting(blocks, where="prior")

    def carry(self, values: Array) -> Values:
        """Values in the arithmetic of the observations."""
        if self._kind is not None:
            return np.array([self._kind(float(value)) for value in values], dtype=object)
        return values.astype(self._dtype)

    @property
    def start(self) -> Values:
        """Approximate values of the parameters."""
        return self.carry(self.problem.parameters.values)

    def evaluate(self, x: Values, near: State | None = None) -> State:
        """Residuals at x; `near` is a state not far away."""
        # A step that overflows is rejected by its cost; suppress the warning.
        try:
            with np.errstate(all="ignore"):
                state = self._evaluate(x, near)
        except ArithmeticError:
            state = None
        if state is None or not np.isfinite(state.whitened).all():
            n = self.problem.size
            return State(x, np.full(n, np.nan), np.zeros(0), np.inf)
        return state

    def design(self, state: State) -> Array:
        """Whitened design matrix (N, u) of all parameters at a state that is usable; fixed ones are zero."""
        with np.errstate(all="ignore"):
            rows = self._design(state)
        if self.prior is not None:
            extra = np.zeros((len(self.prior.names), len(self.names)))
            extra[np.arange(len(extra)), self.prior_at] = 1.0
            rows = np.vstack([rows, self.prior_weighting.whiten(extra)])
        rows[:, ~self.mask] = 0.0
        return rows

    def influence(self, state: State) -> list[Blocks]:
        """T with P v = T r and P A = T r' in each observation, then in each observed parameter."""
        blocks = self._influence(state)
        if self.prior is not None:
            rows, columns = self.problem.size, len(state.whitened) - len(self.prior.names)
            for root in self.prior_weighting.roots:
                turned = np.swapaxes(root.matrices, 1, 2)
                blocks.append(Blocks(rows + root.row, columns + root.row, turned))
        return blocks

    def cofactors(self) -> list[Blocks]:
        """Covariances that belong to the blocks of :meth:`influence`."""
        blocks = list(self.weighting.cofactors)
        if self.prior is not None:
            n = self.problem.size
            blocks += [Blocks(n + q.row, n + q.row, q.matrices) for q in self.prior_weighting.cofactors]
        return blocks

    @property
    def floor(self) -> float:
        """Sum of squares due to the rounding of the observations."""
        if self._kind is not None:
            return 0.0
        eps = float(np.finfo(self._dtype).eps)
        observed = np.abs(self.problem.observations.astype(np.float64).ravel())
        noise = self.weighting.whiten(eps * observed)
        return float(noise @ noise)

    def _with_prior(self, x: Values, whitened: Array) -> Array:
        if self.prior is None:
            return whitened
        misfit = x[self.prior_at].astype(np.float64) - self.prior.values
        return np.concatenate([whitened, self.prior_weighting.whiten(misfit)])

    weighting: Weighting
    # Whether r is whitened alike at all parameters, so that its second differences are the function's.
    constant_weights: bool

    @property
    def left_out(self) -> int:
        """Number of observations or conditions with weight zero."""
        raise NotImplementedError

    @property
    def analytic(self) -> bool:
        """Whether analytic derivatives were given."""
        raise NotImplementedError

    def _evaluate(self, x: Values, near: State | None) -> State | None:
        raise NotImplementedError

    def _design(self, state: State) -> Array:
        raise NotImplementedError

    def _influence(self, state: State) -> list[Blocks]:
        raise NotImplementedError


class MarkovModel(Model):
    """l + v = f(x)."""

    constant_weights = True

    def __init__(self, problem: Specification, function: Function, jacobian: Jacobian | None) -> None:
        super().__init__(problem)
        self._function, self._jacobian = function, jacobian
        self.weighting = Weighting(blocks_of(problem.covariance, problem.observations.shape), self.factors)

    @property
    def left_out(self) -> int:
        """Observations of weight zero."""
        return 0 if self.factors is None else int((self.factors == 0).sum())

    @property
    def analytic(self) -> bool:
        """Whether a Jacobian was given."""
        return self._jacobian is not None

    def _compute(self, x: Values) -> Values:
        computed = np.asarray(self._function(x))
        if computed.size != self.problem.size:
            raise UsageError(
                f"gave {computed.shape} for observations {self.problem.observations.shape}", where="function"
            )
        return computed.reshape(-1)

    def _evaluate(self, x: Values, near: State | None) -> State | None:
        residuals = (self._compute(x) - self.problem.observations.reshape(-1)).astype(np.float64)
        # Observations of weight zero may be NaN and must not reach the others as 0 · NaN.
        counted = residuals if self.factors is None else np.where(self.factors == 0, 0.0, residuals)
        whitened = self._with_prior(x, self.weighting.whiten(counted))
        return State(x, residuals, whitened, float(whitened @ whitened))

    def jacobian(self, x: Array) -> Array:
        """Derivatives (n, u) of the function."""
        n, u = self.problem.size, len(self.names)
        if self._jacobian is None:
            return self.numeric(x)
        given = np.asarray(self._jacobian(x), dtype=np.float64)
        if given.shape not in ((*self.problem.observations.shape, u), (n, u)):
            raise UsageError(f"gave {given.shape}, not {(n, u)}", where="jacobian")
        return given.reshape(n, u)

    def numeric(self, x: Array) -> Array:
        """The same by differences."""
        return differences(lambda y: self._compute(self.carry(y)).astype(np.float64), x, self.mask)

    def _design(self, state: State) -> Array:
        jacobian = self.jacobian(state.x.astype(np.float64))
        if self.factors is not None:
            jacobian = np.where((self.factors == 0)[:, None], 0.0, jacobian)
        return self.weighting.whiten(jacobian)

    def _influence(self, state: State) -> list[Blocks]:
        return [root.transposed for root in self.weighting.roots]


class HelmertModel(Model):
    """g(l + v, x) = 0 of m marks, with c conditions and k observations each."""

    analytic, constant_weights = True, False

    def __init__(self, problem: Specification, conditions: Conditions, jacobians: Jacobians) -> None:
        super().__init__(problem)
        self._given_conditions, self._jacobians = conditions, jacobians
        self.marks, self.k = problem.observations.shape
        self.weighting = Weighting([self._blocks()], self._whole_marks())
        self.covariances = self.weighting.cofactors[0].matrices

    def _blocks(self) -> Array:
        """The covariance as blocks (m, k, k)."""
        index, out = np.arange(self.k), []
        for part in blocks_of(self.problem.covariance, self.problem.observations.shape):
            if part.shape[1] not in (1, self.k) or part.size // part.shape[1] % self.k:
                raise UsageError("reaches from one mark into another", where="covariance")
            if part.shape[1] != self.k:
                part, sigma = np.zeros((len(part) // self.k, self.k, self.k)), part
                part[:, index, index] = sigma.reshape(-1, self.k)
            out.append(part)
        return np.concatenate(out)

    def _whole_marks(self) -> Array | None:
        if self.factors is None:
            return None
        factors = self.factors.reshape(self.marks, self.k)
        self.outside = (factors == 0).any(axis=1)
        self.factors = np.where(self.outside[:, None], 0.0, factors).ravel()
        return self.factors

    @property
    def left_out(self) -> int:
        """Conditions of the marks left out."""
        return 0 if self.factors is None else int(self.outside.sum()) * self._conditions_each

    def _conditions(self, observed: Array, x: Array) -> Array:
        shape = self.problem.observations.shape
        g = np.asarray(self._given_conditions(observed.reshape(shape), x), dtype=float)
        if not g.ndim or g.shape[0] != self.marks:
            raise UsageError(f"gave {g.shape} of {shape}", where="conditions")
        self._conditions_each = g.size // self.marks
        return g.reshape(self.marks, self._conditions_each)

    def derivatives(self, observed: Array, x: Array) -> tuple[Array, Array]:
        """A (m, c, u) and B (m, c, k)."""
        a, b = self._jacobians(observed.reshape(self.problem.observations.shape), x)
        a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
        rows = self.marks, self._conditions_each
        if b.shape != (*rows, self.k) or a.size != rows[0] * rows[1] * len(self.names):
            raise UsageError(f"gave A {a.shape} and B {b.shape}", where="jacobians")
        return a.reshape(*rows, -1), b

    def _evaluate(self, x: Values, near: State | None) -> State | None:
        l0, at = self.problem.observations.ravel(), x.astype(np.float64)
        v = np.zeros_like(l0) if near is None or not near.usable else near.residuals
        tiny = self.floor
        for _ in range(_INNER):
            g = self._conditions(l0 + v, at)
            _, b = self.derivatives(l0 + v, at)
            w = g - (b @ v.reshape(self.marks, self.k, 1))[..., 0]
            state = self._solve(x, w, b)
            if state is None:
                return None
            change = self.weighting.whiten(state.residuals - v)
            v = state.residuals
            if change @ change <= 1e-24 * state.cost + 10 * tiny:
                return state
        return None

    def _solve(self, x: Values, w: Array, b: Array) -> State | None:
        """The residuals of least squares that keep the linearised conditions w + B v = 0 at x."""
        bq = b @ self._safe_covariances
        m = bq @ np.swapaxes(b, 1, 2)
        if not np.isfinite(m).all():
            return None
        try:
            lower = np.linalg.cholesky(m)
        except np.linalg.LinAlgError:
            return None
        inverse = np.linalg.inv(lower)
        r = inverse @ w[..., None]
        v = -np.swapaxes(bq, 1, 2) @ (np.swapaxes(inverse, 1, 2) @ r)
        if self.factors is not None:
            inverse = np.where(self.outside[:, None, None], 0.0, inverse)
            r = np.where(self.outside[:, None, None], 0.0, r)
        whitened = self._with_prior(x, r.ravel())
        return State(x, v.ravel(), whitened, float(whitened @ whitened), Blocks(0, 0, inverse), b)

    @property
    def _safe_covariances(self) -> Array:
        """Covariances where marks left out keep theirs, so that their residuals are still found."""
        if self.factors is None or not self.outside.any():
            return self.covariances
        return np.where(self.outside[:, None, None], self._blocks(), self.covariances)

    def _design(self, state: State) -> Array:
        assert state.root is not None
        observed = self.problem.observations.ravel() + state.residuals
        a, _ = self.derivatives(observed, state.x.astype(np.float64))
        return state.root.times(a.reshape(-1, len(self.names)))

    def _influence(self, state: State) -> list[Blocks]:
        assert state.root is not None
        assert state.derivatives is not None
        return [Blocks(0, 0, -np.swapaxes(state.root.matrices @ state.derivatives, 1, 2))]
