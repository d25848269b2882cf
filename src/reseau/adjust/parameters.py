"""The unknowns of an adjustment: named, fixed or free, with prior observations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core.data import Array, Mask, twice
from ..core.errors import UsageError


@dataclass(frozen=True, eq=False)
class Prior:
    """Prior observations of parameters, with their covariance.

    Parameters
    ----------
    names : sequence of str (p,)
        Names of the parameters.
    values : array_like (p,)
        Observed values.
    covariance : array_like (p,) or (p, p)
        Standard deviations or a full covariance matrix, in the units of the parameters.

    Raises
    ------
    UsageError
        When the shapes disagree or a name occurs twice.

    Examples
    --------
    >>> Prior(["c", "x0"], [35.0, 0.0], [0.1, 0.02]).select(["x0"]).values
    array([0.])
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array

    def __init__(self, names: Iterable[str], values: ArrayLike, covariance: ArrayLike) -> None:
        object.__setattr__(self, "names", tuple(names))
        object.__setattr__(self, "values", np.asarray(values, dtype=np.float64))
        object.__setattr__(self, "covariance", np.asarray(covariance, dtype=np.float64))
        p = len(self.names)
        if self.values.shape != (p,) or self.covariance.shape not in ((p,), (p, p)):
            raise UsageError(
                f"{p} names, values {self.values.shape} and covariance {self.covariance.shape}", where="Prior"
            )
        if len(set(self.names)) != p:
            raise UsageError("names a parameter twice", where="Prior")

    def select(self, keep: Iterable[str]) -> Prior:
        """The observations of some of the parameters, with the marginal of the covariance."""
        kept = set(keep)
        rows = np.array([i for i, name in enumerate(self.names) if name in kept], dtype=np.intp)
        diagonal = self.covariance.ndim == 1
        covariance = self.covariance[rows] if diagonal else self.covariance[np.ix_(rows, rows)]
        return Prior([self.names[i] for i in rows], self.values[rows], covariance)


@dataclass(frozen=True, eq=False)
class Parameters:
    """Named parameters with their approximate values.

    Parameters
    ----------
    names : sequence of str (u,)
        Unique names.
    values : array_like (u,)
        Approximate values of free parameters, exact values of fixed ones.
    free : sequence of str, optional
        Names of the parameters to estimate; all by default.
    prior_sigma : mapping of str to float, optional
        Standard deviations of parameters whose `values` are also observations.
    prior : Prior, optional
        Prior observations that differ from the approximate values, or are correlated.

    Raises
    ------
    UsageError
        For duplicate or unknown names, and values that are not finite.

    Examples
    --------
    >>> p = Parameters(["a", "b", "c"], [1.0, 2.0, 3.0]).fix("b")
    >>> p.free
    ('a', 'c')
    """

    names: tuple[str, ...]
    values: Array
    free: tuple[str, ...]
    prior: Prior | None

    def __init__(
        self,
        names: Iterable[str],
        values: ArrayLike,
        free: Iterable[str] | None = None,
        prior_sigma: Mapping[str, float] | None = None,
        prior: Prior | None = None,
    ) -> None:
        object.__setattr__(self, "names", tuple(names))
        object.__setattr__(self, "values", np.array(values, dtype=np.float64))
        if self.values.shape != (len(self.names),) or not np.isfinite(self.values).all():
            raise UsageError(
                f"{len(self.names)} names need as many finite values, not {self.values.shape}",
                where="Parameters",
            )
        if (again := twice(self.names)) is not None:
            raise UsageError("occurs twice among the parameters", where=again)
        wanted = set(self.names) if free is None else set(self._known(free))
        object.__setattr__(self, "free", tuple(name for name in self.names if name in wanted))
        if prior_sigma:
            if prior is not None:
                raise UsageError("give either prior_sigma or prior", where="Parameters")
            at = [self.index(name) for name in self._known(prior_sigma)]
            prior = Prior(prior_sigma, self.values[at], list(prior_sigma.values()))
        if prior is not None:
            self._known(prior.names)
        object.__setattr__(self, "prior", prior)

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, name: str) -> float:
        return float(self.values[self.index(name)])

    @property
    def mask(self) -> Mask:
        """True for free parameters, (u,)."""
        free = set(self.free)
        return np.array([name in free for name in self.names], dtype=bool)

    def index(self, name: str) -> int:
        """Index of a parameter.

        Raises
        ------
        UsageError
            When there is no parameter of this name.
        """
        self._known([name])
        return self.names.index(name)

    def fix(self, *names: str, at: float | None = None) -> Parameters:
        """A copy with these parameters fixed, at their present values or at `at`."""
        gone = set(self._known(names))
        values = self.values.copy()
        if at is not None:
            values[[self.index(name) for name in names]] = at
        return Parameters(self.names, values, [n for n in self.free if n not in gone], prior=self.prior)

    def with_values(self, values: ArrayLike) -> Parameters:
        """A copy with other (approximate) values (u,); prior observations are kept."""
        return Parameters(self.names, values, self.free, prior=self.prior)

    def _known(self, names: Iterable[str]) -> list[str]:
        listed = list(names)
        unknown = [str(name) for name in listed if name not in self.names]
        if unknown:
            raise UsageError("is not among the parameters", where=", ".join(unknown[:5]))
        return listed
