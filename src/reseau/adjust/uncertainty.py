"""Uncertainty of results: budgets after the GUM, and Monte Carlo after its supplements.

The law of propagation of uncertainty (JCGM 100:2008, eq. 13; JCGM 102:2011, eq. 3): with the sensitivities
J = ∂f/∂x and independent contributions C₁ … C_G to the covariance of the inputs x, the results y = f(x)
have the covariance Σ J C_g Jᵀ. Each contribution has its degrees of freedom ν_g, and those of a result follow
from u⁴/ν = Σ u_g⁴/ν_g (Welch–Satterthwaite; JCGM 100, eq. G.2b). Jointly, with the parts S_g of the
covariance, whitened by the whole, ν = (m² + m) / Σ (tr²S_g + tr S_g²)/ν_g (Nel & van der Merwe 1986).
Where f is not linear, :func:`simulate` draws the inputs instead (JCGM 101:2008, JCGM 102:2011), and
:func:`validate` compares both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from ..core.data import Array, Mask
from ..core.display import Display
from ..core.errors import UsageError
from .differences import differences

Distribution = Literal["normal", "rectangular", "triangular", "arcsine"]
Model = Callable[[Array], Array]

_BATCH = 10_000
# Draws of a batch at least, so that the ends of its intervals are quantiles.
_LEAST = 400
# Fewer batches may agree by chance, and drawing would stop too early.
_LEAST_BATCHES = 10
_ZERO = 1e-12


@dataclass(frozen=True, eq=False)
class Contribution:
    """A contribution to the uncertainty of the inputs, independent of the others.

    Parameters
    ----------
    name : str
        Where it comes from.
    covariance : ndarray (k, k)
        Its part of the covariance of the inputs.
    degrees : float
        Degrees of freedom; infinite where the variance is known.
    distribution : {"normal", "rectangular", "triangular", "arcsine"}
        Distribution of its independent components. A normal one whose variance was estimated is drawn from
        the t distribution.
    group : str
        Contributions of the same group share one estimated variance factor, and their degrees of freedom; by
        default each is its own.

    Examples
    --------
    >>> Contribution("temperature", np.array([[0.04]]), distribution="rectangular").degrees
    inf
    """

    name: str
    covariance: Array
    degrees: float = np.inf
    distribution: Distribution = "normal"
    group: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class UncertaintyBudget(Display):
    """Results with the contributions to their uncertainty.

    Parameters
    ----------
    names, units : tuple of str (m,)
        Results.
    values : ndarray (m,)
        Their values.
    inputs : tuple of str (k,)
        Inputs.
    sensitivities : ndarray (m, k)
        Derivatives of the results by the inputs.
    contributions : tuple of Contribution (g,)
        Contributions.
    parts : ndarray (g, m, m)
        Covariance of the results by each of them.

    Examples
    --------
    The resistance of V/I, of a voltage with 9 degrees of freedom and a known current:

    >>> noise = Contribution("voltage", np.diag([1e-4, 0.0]), degrees=9)
    >>> current = Contribution("current", np.diag([0.0, 1e-8]))
    >>> found = propagate(lambda x: x[:, :1] / x[:, 1:], np.array([5.0, 0.02]), (noise, current),
    ...                   names=("R",), inputs=("V", "I"), units=("ohm",))
    >>> found.sigma.round(4), found.degrees.round(1), found.factor(0.95).round(3)
    (array([1.3463]), array([473.1]), array([1.965]))
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    inputs: tuple[str, ...]
    sensitivities: Array
    contributions: tuple[Contribution, ...]
    parts: Array

    @property
    def covariance(self) -> Array:
        """Covariance of the results (m, m)."""
        total: Array = self.parts.sum(axis=0)
        return total

    @property
    def sigma(self) -> Array:
        """Standard uncertainties (m,)."""
        return _sigma(self.covariance)

    @property
    def by_contribution(self) -> Array:
        """Standard uncertainty of each result by each contribution (g, m)."""
        return np.stack([_sigma(part) for part in self.parts]) if len(self.parts) else self.parts[:, 0]

    @property
    def degrees(self) -> Array:
        """Effective degrees of freedom of each result (m,)."""
        return _degrees(
            np.diagonal(self.covariance),
            [(np.diagonal(part), degrees) for part, degrees in self._grouped()],
        )

    @property
    def joint_degrees(self) -> float:
        """Effective degrees of freedom of all results together; see the module."""
        white, m = _whitening(self.covariance)
        sum_ = 0.0
        for part, degrees in self._grouped():
            if np.isfinite(degrees):
                s = white @ part @ white.T
                sum_ += (np.trace(s) ** 2 + np.trace(s @ s)) / degrees
        return float((m * m + m) / sum_) if sum_ > 0 else np.inf

    def factor(self, probability: float = 0.95) -> Array:
        """Coverage factors (m,) of intervals that each cover its result with this probability."""
        return np.array([_t(probability, nu) for nu in self.degrees])

    def expanded(self, probability: float = 0.95) -> Array:
        """Expanded uncertainties (m,)."""
        return self.factor(probability) * self.sigma

    def joint_factor(self, probability: float = 0.95) -> float:
        """Coverage factor of the ellipsoid that covers all results together.

        k² is the quantile of χ² with as many degrees of freedom as the covariance has dimensions m (JCGM 102,
        table 3), or m times that of F(m, ν), if ν is finite.
        """
        _, m = _whitening(self.covariance)
        _check(probability)
        if m == 0:
            return float("nan")
        nu = self.joint_degrees
        if not np.isfinite(nu):
            return float(np.sqrt(scipy.special.chdtri(m, 1.0 - probability)))
        return float(np.sqrt(m * scipy.special.fdtri(m, nu, probability)))

    def _grouped(self) -> list[tuple[Array, float]]:
        """Parts of the covariance with their degrees of freedom; those of a group are summed."""
        found: dict[str, tuple[Array, float]] = {}
        for k, (each, part) in enumerate(zip(self.contributions, self.parts, strict=True)):
            key = each.group or f"\0{k}"
            before, degrees = found.get(key, (np.zeros_like(part), np.inf))
            found[key] = before + part, min(degrees, each.degrees)
        return list(found.values())

    def _facts(self) -> list[tuple[str, str]]:
        shown = zip(self.names, self.values, self.expanded(), self.units, strict=True)
        return [(name, f"{value:.8g} ± {u:.2g} {unit}".strip()) for name, value, u, unit in shown]

    def _columns(self) -> dict[str, list[object]]:
        return {
            "name": list(self.names), "value": self.values.tolist(), "unit": list(self.units),
            "sigma": self.sigma.tolist(), "degrees": self.degrees.tolist(),
            **{each.name: u.tolist()
               for each, u in zip(self.contributions, self.by_contribution, strict=True)},
        }  # fmt: skip


def propagate(
    model: Model,
    x: Array,
    contributions: Sequence[Contribution],
    *,
    names: Sequence[str],
    inputs: Sequence[str],
    units: Sequence[str] | None = None,
    sensitivities: Array | None = None,
) -> UncertaintyBudget:
    """Propagate contributions to the uncertainty of inputs to results.

    Parameters
    ----------
    model : callable
        Results (n, m) of inputs (n, k).
    x : ndarray (k,)
        Estimates of the inputs.
    contributions : sequence of Contribution
        Independent contributions to their uncertainty.
    names, inputs : sequence of str
        Names of results and inputs.
    units : sequence of str, optional
        Units of the results; by default none.
    sensitivities : ndarray (m, k), optional
        Derivatives of the results by the inputs; by default numerical ones, exact to about 1e-11.

    Raises
    ------
    UsageError
        If shapes do not fit, or a covariance is none.

    Notes
    -----
    Derived in ``docs/mathematics/uncertainty.md``.

    Examples
    --------
    >>> same = Contribution("same error", np.full((2, 2), 0.01))
    >>> found = propagate(lambda x: x[:, :1] - x[:, 1:], np.array([3.0, 1.0]), [same], names=["d"],
    ...                   inputs=["a", "b"])
    >>> bool(found.sigma[0] < 1e-9)
    True
    """
    x = np.asarray(x, dtype=np.float64)
    _check_contributions(contributions, len(x))
    values = _values(model, x[None], len(names))[0]
    if not np.isfinite(values).all():
        where = names[int(np.flatnonzero(~np.isfinite(values))[0])]
        raise UsageError("has no value at these inputs", where=where)
    if sensitivities is None:
        sensitivities = differences(lambda at: model(at[None])[0], x)
    j = np.asarray(sensitivities, dtype=np.float64)
    if j.shape != (len(names), len(x)) or len(inputs) != len(x):
        raise UsageError(f"sensitivities are {j.shape}, not {(len(names), len(x))}", where="uncertainty")
    if not np.isfinite(j).all():
        raise UsageError("has no derivatives at these inputs", where="uncertainty")
    parts = np.zeros((len(contributions), len(j), len(j)))
    for part, each in zip(parts, contributions, strict=True):
        part[:] = j @ each.covariance @ j.T
        part[:] = (part + part.T) / 2
    given = ("",) * len(names) if units is None else tuple(units)
    return UncertaintyBudget(tuple(names), given, values, tuple(inputs), j, tuple(contributions), parts)


@dataclass(frozen=True, eq=False)
class Simulated:
    """Results of drawn inputs.

    Parameters
    ----------
    draws : int
        Number of draws; those without results are left out, and counted in `lost`.
    lost : int
        Number of draws for which the model has no results.
    probability : float
        Coverage probability of the intervals.
    mean, sigma : ndarray (m,)
        Mean and standard deviation of each result.
    covariance : ndarray (m, m)
        Covariance.
    low, high : ndarray (m,)
        Ends of the intervals that leave out as much below as above.
    errors : ndarray (4, m)
        Standard errors of mean, sigma, low and high by the scatter between batches.
    joint_factor : float
        Coverage factor of the ellipsoid around the mean, of the shape of the covariance, that covers all
        results together (JCGM 102, 7.7).
    stable : bool or None
        Whether the numbers are stable to the digits that were asked for; None: for none.

    Examples
    --------
    >>> known = Contribution("noise", np.eye(1))
    >>> found = simulate(lambda x: x**2, np.array([0.0]), [known], draws=40_000)
    >>> found.mean.round(1), found.high.round(0)
    (array([1.]), array([5.]))
    """

    draws: int
    lost: int
    probability: float
    mean: Array
    sigma: Array
    covariance: Array
    low: Array
    high: Array
    errors: Array
    joint_factor: float
    stable: bool | None = None


def simulate(
    model: Model,
    x: Array,
    contributions: Sequence[Contribution],
    *,
    probability: float = 0.95,
    draws: int = 100_000,
    digits: int | None = None,
    part: float = 1.0,
    seed: int = 0,
) -> Simulated:
    """Draw inputs from their distributions, and describe the results.

    Parameters
    ----------
    model : callable
        Results (n, m) of inputs (n, k); NaN where there is none.
    x : ndarray (k,)
        Estimates of the inputs.
    contributions : sequence of Contribution
        As for :func:`propagate`. Contributions of a group are drawn with one variance.
    probability : float
        Coverage probability.
    draws : int
        Number of draws, at least 4000; with `digits` the largest number.
    digits : int, optional
        Draw until the results are stable to so many significant digits of their standard uncertainties (see
        Notes), at most `draws`.
    part : float
        Part of the tolerance that must be reached: 1/5 where the results are to judge those of
        :func:`propagate` (JCGM 101, 8.2).
    seed : int
        Seed of the draws.

    Raises
    ------
    UsageError
        If there are too few draws, or more than one in a hundred has no result.

    Notes
    -----
    The adaptive procedure of JCGM 101, 7.9, and JCGM 102, 7.8: batches are drawn until twice the standard
    errors of mean, standard deviation and both ends of the interval of every result are at most half of a
    unit of the last digit of its standard deviation, and those of the factor of the ellipsoid and of the
    largest eigenvalue of the correlations at most half of a unit of their own last digit. There are at least
    ten batches, since few of them may agree by chance.

    Examples
    --------
    The square of an error is never negative, and its mean is the variance:

    >>> found = simulate(lambda x: x**2, np.array([0.0]), [Contribution("noise", np.eye(1))], draws=40_000)
    >>> bool(found.low[0] >= 0), found.mean.round(1)
    (True, array([1.]))
    """
    x = np.asarray(x, dtype=np.float64)
    _check(probability)
    _check_contributions(contributions, len(x))
    if draws < 10 * _LEAST:
        raise UsageError(f"needs at least {10 * _LEAST} draws, not {draws}", where="Monte Carlo")
    if digits is not None and not (digits >= 1 and 0 < part <= 1):
        raise UsageError(
            f"{digits} digits, {part:g} of the tolerance", where="Monte Carlo", do="ask for 1 or 2"
        )
    rng = np.random.default_rng(seed)
    size = min(_BATCH, draws // 10)
    batches: list[Array] = []
    each: list[Array] = []
    joint: list[Array] = []
    stable: bool | None = None
    while (len(batches) + 1) * size <= draws and not stable:
        with np.errstate(all="ignore"):  # what has no result is NaN
            y = model(x + _drawn(rng, contributions, size))
        batches.append(y[np.isfinite(y).all(axis=1)])
        total, known = len(batches) * size, sum(map(len, batches))
        if total - known > 0.01 * total:
            raise UsageError(f"has no result for {total - known} of {total} draws", where="Monte Carlo")
        each.append(_described(batches[-1], probability))
        if digits is not None:
            joint.append(_joint(batches[-1], probability))
            stable = len(batches) >= _LEAST_BATCHES and _stable(np.array(each), np.array(joint), digits, part)
    y = np.concatenate(batches)
    mean, sigma, low, high = _described(y, probability)
    return Simulated(
        len(y), total - len(y), probability, mean, sigma, np.atleast_2d(np.cov(y.T)), low, high,
        _standard_error(np.array(each)), float(_joint(y, probability)[0]), stable,
    )  # fmt: skip


def _described(y: Array, probability: float) -> Array:
    """Mean, standard deviation and ends of the interval of each result (4, m)."""
    ends = np.quantile(y, [(1.0 - probability) / 2, (1.0 + probability) / 2], axis=0)
    return np.stack([y.mean(axis=0), y.std(axis=0, ddof=1), *ends])


def _joint(y: Array, probability: float) -> Array:
    """Factor of the ellipsoid, and the largest eigenvalue of the correlations."""
    covariance = np.atleast_2d(np.cov(y.T))
    white, _ = _whitening(covariance)
    squares = np.square((y - y.mean(axis=0)) @ white.T).sum(axis=1)
    size = _sigma(covariance)
    scale = np.where(size > 0, size, 1.0)
    largest = np.linalg.eigvalsh(covariance / np.outer(scale, scale))[-1]
    return np.array([np.sqrt(np.quantile(squares, probability)), largest])


def _stable(each: Array, joint: Array, digits: int, part: float) -> bool:
    """Whether twice the standard errors of the numbers of batches are within part of their tolerances."""
    own = part * _tolerance(np.sqrt(np.square(each[:, 1]).mean(axis=0)), digits)
    together = part * _tolerance(joint.mean(axis=0), digits)
    inside = (2.0 * _standard_error(each) <= own).all()
    # Of a single result the factor says nothing that its interval does not say.
    return bool(inside and (each.shape[2] == 1 or (2.0 * _standard_error(joint) <= together).all()))


def _standard_error(of_batches: Array) -> Array:
    """Standard errors of the means of the numbers of batches."""
    found: Array = of_batches.std(axis=0, ddof=1) / np.sqrt(len(of_batches))
    return found


def _tolerance(u: Array, digits: int) -> Array:
    """Half of a unit of the last of the significant digits of u (JCGM 101, 7.9.2)."""
    known = np.where(u > 0, u, 1.0)
    return np.where(u > 0, 0.5 * 10.0 ** (np.floor(np.log10(known)) - digits + 1), 0.5)


@dataclass(frozen=True, eq=False)
class Validation:
    """Linear propagation compared with Monte Carlo (JCGM 101, clause 8).

    Parameters
    ----------
    low, high : ndarray (m,)
        Ends of the coverage intervals by Monte Carlo minus those by the budget.
    tolerance : ndarray (m,)
        Half of a unit of the last of the significant digits of the standard uncertainty.
    error : ndarray (m,)
        Standard error of the differences.
    joint_factor : float
        Coverage factor of the ellipsoid by Monte Carlo minus that by the budget.

    Examples
    --------
    >>> one = np.ones(1)
    >>> Validation(0.1 * one, 0.0 * one, 0.5 * one, 0.01 * one, 0.0).verdicts
    ('linear',)
    """

    low: Array
    high: Array
    tolerance: Array
    error: Array
    joint_factor: float

    @property
    def largest(self) -> Array:
        """Larger difference of the two ends (m,)."""
        return np.maximum(np.abs(self.low), np.abs(self.high))

    @property
    def verdicts(self) -> tuple[str, ...]:
        """For each result "linear", "not linear", or "not decided" where more draws are needed."""
        margin = 2.0 * self.error
        return tuple(
            "linear" if off + m <= d else "not linear" if off - m > d else "not decided"
            for off, m, d in zip(self.largest, margin, self.tolerance, strict=True)
        )


def validate(budget: UncertaintyBudget, simulated: Simulated, digits: int = 1) -> Validation:
    """Compare the coverage intervals of a budget with those of Monte Carlo.

    Parameters
    ----------
    budget : UncertaintyBudget
        By linear propagation.
    simulated : Simulated
        With the same inputs.
    digits : {1, 2}
        Significant digits of the standard uncertainty.

    Examples
    --------
    >>> known = Contribution("noise", np.eye(1))
    >>> f, x = (lambda x: np.exp(x)), np.array([0.0])
    >>> budget = propagate(f, x, [known], names=["y"], inputs=["x"])
    >>> validate(budget, simulate(f, x, [known])).verdicts
    ('not linear',)
    """
    # Where the derivatives vanish, the budget has no uncertainty to round.
    u = np.where(budget.sigma > 0, budget.sigma, simulated.sigma)
    expanded = budget.expanded(simulated.probability)
    return Validation(
        simulated.low - (budget.values - expanded), simulated.high - (budget.values + expanded),
        _tolerance(u, digits), simulated.errors[2:].max(axis=0),
        simulated.joint_factor - budget.joint_factor(simulated.probability),
    )  # fmt: skip


def _drawn(rng: np.random.Generator, contributions: Sequence[Contribution], n: int) -> Array:
    """Errors of the inputs (n, k)."""
    total = np.zeros((n, len(contributions[0].covariance) if contributions else 0))
    scales: dict[str, Array] = {}
    for k, each in enumerate(contributions):
        values, vectors = np.linalg.eigh(each.covariance)
        keep = values > _ZERO * max(values[-1], 0.0)
        z = _standard(rng, each.distribution, (n, int(keep.sum())))
        if np.isfinite(each.degrees):
            key = each.group or f"\0{k}"
            if key not in scales:
                scales[key] = np.sqrt(each.degrees / rng.chisquare(each.degrees, n))
            z = z * scales[key][:, None]
        total += z @ (vectors[:, keep] * np.sqrt(values[keep])).T
    return total


def _standard(rng: np.random.Generator, distribution: Distribution, shape: tuple[int, int]) -> Array:
    """Random numbers with mean 0 and variance 1."""
    if distribution == "normal":
        return rng.standard_normal(shape)
    u = rng.random(shape)
    found: Array
    if distribution == "rectangular":
        found = np.sqrt(3.0) * (2.0 * u - 1.0)
    elif distribution == "triangular":
        found = np.sqrt(6.0) * (u + rng.random(shape) - 1.0)
    else:
        found = np.sqrt(2.0) * np.sin(np.pi * (u - 0.5))
    return found


def _values(model: Model, x: Array, m: int) -> Array:
    with np.errstate(all="ignore"):
        y = np.asarray(model(x), dtype=np.float64)
    if y.shape != (len(x), m):
        raise UsageError(f"returns {y.shape}, not {(len(x), m)}", where="model")
    return y


def _check_contributions(contributions: Sequence[Contribution], k: int) -> None:
    for each in contributions:
        c = each.covariance
        if c.shape != (k, k) or not np.isfinite(c).all():
            raise UsageError(f"is not a covariance of {k} inputs", where=each.name)
        size = np.sqrt(np.maximum(np.diag(c), 0.0))
        scaled = c / np.outer(np.where(size > 0, size, 1.0), np.where(size > 0, size, 1.0))
        if np.abs(c - c.T).max(initial=0.0) > 1e-9 * np.abs(c).max(initial=0.0):
            raise UsageError("is not symmetric", where=each.name)
        if k and np.linalg.eigvalsh((scaled + scaled.T) / 2)[0] < -1e-8 * k:
            raise UsageError("is not a covariance: it has negative eigenvalues", where=each.name)
        if not each.degrees > 0:
            raise UsageError(f"has {each.degrees:g} degrees of freedom", where=each.name)


def _degrees(total: Array, parts: Sequence[tuple[Array, float]]) -> Array:
    """Welch–Satterthwaite (m,): total²/ν = Σ part²/ν_g of variances."""
    sums = np.zeros(len(total))
    for part, degrees in parts:
        if np.isfinite(degrees):
            sums += part**2 / degrees
    return np.where(sums > 0, total**2 / np.where(sums > 0, sums, 1.0), np.inf)


def _whitening(covariance: Array) -> tuple[Array, int]:
    """A matrix W (r, m) with W C Wᵀ = 1 (r, r), and the rank r of C with unit diagonal."""
    size = _sigma(covariance)
    used: Mask = size > 0
    scale = size[used]
    values, vectors = np.linalg.eigh(covariance[np.ix_(used, used)] / np.outer(scale, scale))
    keep = values > _ZERO * len(values)
    white = np.zeros((int(keep.sum()), len(size)))
    white[:, used] = (vectors[:, keep] / np.sqrt(values[keep])).T / scale
    return white, len(white)


def _sigma(covariance: Array) -> Array:
    return np.sqrt(np.maximum(np.diagonal(covariance), 0.0))


def _check(probability: float) -> None:
    if not 0.0 < probability < 1.0:
        raise UsageError(f"{probability:g} is not between 0 and 1", where="coverage probability")


def _t(probability: float, degrees: float) -> float:
    """Quantile of t such that ± it covers the probability."""
    _check(probability)
    upper = (1.0 + probability) / 2
    found = scipy.special.stdtrit(degrees, upper) if np.isfinite(degrees) else scipy.special.ndtri(upper)
    return float(found)
