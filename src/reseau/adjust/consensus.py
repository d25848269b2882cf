"""Random sample consensus over any model that can be estimated from a few of the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.data import Array, Mask
from ..core.errors import UsageError
from ..core.failure import Code, Failure

__all__ = ["Consensus", "ConsensusModel", "ransac"]


class ConsensusModel(Protocol):
    """What :func:`ransac` asks of a model's instances; the class has `from_estimate` as well."""

    def residuals(self, *data: Any) -> ArrayLike:
        """Distances (n,) of the data from the model, not negative."""
        ...


M = TypeVar("M", bound=ConsensusModel)


class Estimator(Protocol):
    """A class of models, as in scikit-image's ``transform``."""

    def from_estimate(self, *data: Any) -> Any:
        """The model of best fit to the data, or something falsy where there is none."""
        ...


@dataclass(frozen=True, eq=False)
class Consensus(Generic[M]):
    """A model and the data that agree with it; truthy.

    Parameters
    ----------
    model : object
        Estimated from all inliers.
    inliers : ndarray of bool (n,)
        Data within the threshold of it.
    trials : int
        Samples drawn.
    """

    model: M
    inliers: Mask
    trials: int

    def __bool__(self) -> bool:
        return True

    def required(self) -> Consensus[M]:
        """The consensus itself; see :meth:`Failure.required`."""
        return self


def ransac(
    model: Estimator,
    data: ArrayLike | Sequence[ArrayLike],
    min_samples: int,
    threshold: float,
    rng: np.random.Generator,
    *,
    max_trials: int = 1000,
    confidence: float = 0.999,
    min_inliers: int | None = None,
) -> Consensus[Any] | Failure:
    """Find the model that most of the data agree with, and estimate it from them.

    Parameters
    ----------
    model : class
        With ``from_estimate(*data)``, which gives a model or something falsy, and ``residuals(*data)`` (n,)
        of a model, as the transformations of scikit-image have them.
    data : ndarray (n, ...) or tuple of ndarray (n, ...)
        What is handed to both, in rows.
    min_samples : int
        Rows that determine a model.
    threshold : float
        Residuals up to this agree with a model.
    rng : numpy.random.Generator
        Draws the samples; the same state gives the same result.
    max_trials : int
        Samples at most.
    confidence : float
        Ends when a sample free of outliers has been drawn with this probability, for the inliers found.
    min_inliers : int, optional
        Fewer are no consensus; `min_samples` + 1 by default.

    Returns
    -------
    Consensus or Failure
        Sampled models are compared by Σ min(residual², threshold²) (Torr & Zisserman 2000, MSAC); the best is
        estimated again from its inliers until they no longer change.

    Raises
    ------
    UsageError
        When the columns differ in length, or there are fewer rows than a sample.

    Notes
    -----
    Fischler & Bolles (1981), *Communications of the ACM* 24, 381–395.
    """
    columns = tuple(np.asarray(c) for c in data) if isinstance(data, tuple | list) else (np.asarray(data),)
    n = len(columns[0])
    if any(len(c) != n for c in columns) or not 0 < min_samples <= n or not threshold > 0:
        raise UsageError(
            f"{min_samples} samples of columns of {[len(c) for c in columns]} rows, threshold {threshold}",
            where="ransac",
        )
    enough = min_samples + 1 if min_inliers is None else min_inliers
    best, least, needed, trials = None, np.inf, float(max_trials), 0
    while trials < min(needed, max_trials):
        trials += 1
        rows = rng.choice(n, min_samples, replace=False)
        candidate = model.from_estimate(*(c[rows] for c in columns))
        if not candidate:
            continue
        distance = _distance(candidate, columns)
        cost = float(np.minimum(distance**2, threshold**2).sum())
        if cost < least:
            best, least = candidate, cost
            share = float((distance <= threshold).mean())
            needed = _trials(share, min_samples, confidence)
    if best is None:
        return Failure(f"none of {trials} samples of {min_samples} gave a model", Code.NOT_FOUND)
    return _refined(model, best, columns, threshold, enough, trials)


def _refined(
    model: Estimator, best: M, columns: tuple[NDArray[Any], ...], threshold: float, enough: int, trials: int
) -> Consensus[M] | Failure:
    inliers = _distance(best, columns) <= threshold
    for _ in range(20):
        if inliers.sum() < enough:
            break
        again = model.from_estimate(*(c[inliers] for c in columns))
        if not again:
            return Failure(
                f"the model cannot be estimated from its {int(inliers.sum())} inliers", Code.NOT_IDENTIFIED
            )
        within = _distance(again, columns) <= threshold
        best, same = again, bool((within == inliers).all())
        inliers = within
        if same:
            break
    if inliers.sum() < enough:
        reason = f"only {int(inliers.sum())} of {len(inliers)} agree with a model, fewer than {enough}"
        return Failure(reason, Code.TOO_MANY_OUTLIERS)
    return Consensus(best, inliers, trials)


def _distance(model: ConsensusModel, columns: tuple[NDArray[Any], ...]) -> Array:
    distance = np.abs(np.asarray(model.residuals(*columns), dtype=np.float64))
    return np.where(np.isfinite(distance), distance, np.inf)


def _trials(share: float, min_samples: int, confidence: float) -> float:
    """Samples after which one is free of outliers with this probability."""
    clean = share**min_samples
    if clean >= 1.0:
        return 1.0
    if clean <= 0.0:
        return np.inf
    return float(np.log(1.0 - confidence) / np.log1p(-clean))
