"""Test which of two models that are not nested explains the same points better.

An F-test needs nested models. Here both models predict every point from all others, and the weighted
squares of the errors of prediction are compared point by point (Wilcoxon's signed ranks). More parameters are
no advantage: fitting the noise makes the prediction worse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from ..adjust import Adjustment
from ..core.data import Array, ImagePoints
from ..core.failure import Code, Failure
from ..measure.fitting import fit_mapping
from ..optics.mapping import PlaneMapping


@dataclass(frozen=True, eq=False)
class Rivalry:
    """Comparison of two models of the same points.

    Parameters
    ----------
    first, second : Adjustment
        Adjustments of the two models.
    rms : ndarray (2, 2)
        Root mean square of the prediction of a point from the others; a row for each model, x and y.
    p : float
        Probability of a difference at least as large when both models are equally good.
    verdict : {"first", "second", "undecided"}
        Which model explains the points better, at the level of the test.

    Examples
    --------
    >>> from reseau.optics import RationalPolynomial
    >>> xy = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1).reshape(-1, 2)
    >>> points = ImagePoints.with_sigma(map(str, range(20)), xy, 0.01)
    >>> target = xy * 1.1 + [0.0, 0.02] * xy[:, :1]  # sheared: no similarity
    >>> found = rivals(RationalPolynomial.affine(), RationalPolynomial.similarity(), points, target)
    >>> found.verdict
    'first'
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
    """Fit two models to the same points and decide which one explains them better.

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
        A failure when one of the two cannot be adjusted, or has no redundant point.

    Examples
    --------
    See :class:`Rivalry`.

    >>> from reseau.optics import RationalPolynomial
    >>> few = ImagePoints.with_sigma(["a"], [[0.0, 0.0]], 0.01)
    >>> bool(rivals(RationalPolynomial.affine(), RationalPolynomial.similarity(), few, few.xy))
    False
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
                f"{len(points)} points are too few for predictions with {len(model.names)} parameters",
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
    """Predict every point from all others.

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
        Mapped minus target for each point by the model fitted without it; NaN where that is not determined.
    squares : ndarray (n,)
        Weighted squares of the errors, with the weights of the fit.

    Notes
    -----
    For a model linear in its parameters this is exactly (I − A_i Q A_iᵀ W_i)⁻¹ r_i (Cook & Weisberg 1982,
    ch. 2); no model is fitted again.

    Examples
    --------
    >>> from reseau.optics import RationalPolynomial
    >>> xy = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [0.5, 0.4]])
    >>> points, model = ImagePoints.with_sigma("abcde", xy, 0.01), RationalPolynomial.affine()
    >>> fit = fit_mapping(model, points, 2 * xy).required()
    >>> error, _ = leave_one_out(model.with_values(fit.values), fit, points, 2 * xy)
    >>> bool(abs(error).max() < 1e-9)
    True
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
