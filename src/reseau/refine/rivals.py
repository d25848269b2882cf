"""Which of two models explains the same points better, when neither contains the other.

An F-test asks for nested models. Here every point is predicted from all the others by both models, and the
weighted squares of the two predictions' errors are compared point by point (Wilcoxon's signed ranks): more
parameters are no advantage, for what they fit of the noise they pay in the prediction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.stats
from numpy.typing import ArrayLike

from ..adjust import Adjustment
from ..core.data import Array, ImagePoints
from ..core.failure import Code, Failure
from ..measure.fitting import fit_mapping
from ..optics import PlaneMapping

__all__ = ["Rivalry", "leave_one_out", "rivals"]


@dataclass(frozen=True, eq=False)
class Rivalry:
    """Two models of the same points.

    Parameters
    ----------
    first, second : Adjustment
        The two.
    rms : ndarray (2, 2)
        Root mean square of the prediction of a point from the others; a row for each model, x and y.
    p : float
        Probability of as different predictions when the models are as good as one another.
    verdict : {"first", "second", "undecided"}
        Which one explains the points better, at the level asked for.
    """

    first: Adjustment
    second: Adjustment
    rms: Array
    p: float
    verdict: str


def rivals(
    first: PlaneMapping,
    second: PlaneMapping,
    points: ImagePoints,
    target: ArrayLike,
    target_sigma: ArrayLike = 0.0,
    alpha: float = 0.05,
) -> Rivalry | Failure:
    """Fit two models to the same points and tell which one explains them better.

    Parameters
    ----------
    first, second : PlaneMapping
        The models.
    points, target, target_sigma
        As in :func:`reseau.measure.fitting.mapping_problem`.
    alpha : float
        Level of the test.

    Returns
    -------
    Rivalry or Failure
        A failure when one of the two cannot be adjusted, or has no point to spare.
    """
    fits, errors, squares = [], [], []
    for model in (first, second):
        fit = fit_mapping(model, points, target, target_sigma)
        if isinstance(fit, Failure):
            return fit
        found = leave_one_out(
            model.with_values(fit.values), fit, points, np.asarray(target, dtype=np.float64)
        )
        if not np.isfinite(found[0]).all():
            return Failure(
                f"{len(points)} points leave none to predict with {len(model.names)} parameters",
                Code.TOO_FEW_POINTS,
            )
        fits.append(fit)
        errors.append(found[0])
        squares.append(found[1])
    difference = squares[0] - squares[1]
    p = float(scipy.stats.wilcoxon(difference).pvalue) if difference.any() else 1.0
    better = "first" if np.median(difference) < 0 else "second"
    rms = np.array([np.sqrt(np.mean(e**2, axis=0)) for e in errors])
    return Rivalry(fits[0], fits[1], rms, p, better if p < alpha else "undecided")


def leave_one_out(
    model: PlaneMapping, fit: Adjustment, points: ImagePoints, target: Array
) -> tuple[Array, Array]:
    """Predict every point from the others.

    Parameters
    ----------
    model : PlaneMapping
        The model at its estimates.
    fit : Adjustment
        Its adjustment, by :func:`reseau.measure.fitting.fit_mapping`.
    points, target
        What it was fitted to.

    Returns
    -------
    error : ndarray (n, 2)
        Mapped minus target for each point by the model without it; NaN where it cannot be spared.
    squares : ndarray (n,)
        The errors' weighted squares, with the weights of the fit.

    Notes
    -----
    For a model linear in its parameters exactly (I − A_i Q A_iᵀ W_i)⁻¹ r_i (Cook & Weisberg 1982, ch. 2);
    nothing is fitted anew.
    """
    value, slope, by_parameter = model.derivatives(points.xy)
    weights = np.linalg.inv(slope @ np.asarray(fit.problem.covariance) @ np.swapaxes(slope, 1, 2))
    residual = value - target
    leverage = by_parameter @ fit.cofactor @ np.swapaxes(by_parameter, 1, 2) @ weights
    rest = np.eye(2) - leverage
    spare = np.linalg.eigvals(rest).real.min(axis=1) > 1e-6
    error = np.full(residual.shape, np.nan)
    error[spare] = np.linalg.solve(rest[spare], residual[spare, :, None])[..., 0]
    squares: Array = np.einsum("ni,nij,nj->n", error, weights, error)
    return error, squares
