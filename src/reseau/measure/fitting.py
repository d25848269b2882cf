"""Fit a plane mapping of `optics` to measured points: transformations, polynomials, display models."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike

from ..adjust import Adjustment, Options, Parameters, adjust, eliminate
from ..adjust.elimination import Elimination
from ..adjust.problem import GaussHelmert
from ..core.data import Array, ImagePoints, Mask
from ..core.errors import UsageError
from ..core.failure import Code, Failure
from ..optics import RationalPolynomial
from ..optics.field import SmoothField
from ..optics.mapping import PlaneMapping


def mapping_problem(
    model: PlaneMapping, points: ImagePoints, target: ArrayLike, target_sigma: ArrayLike = 0.0
) -> GaussHelmert:
    """Set up the conditions model(point) = target; the points carry the errors.

    Parameters
    ----------
    model : PlaneMapping
        Model with approximate values.
    points : ImagePoints
        Measured points (n) with covariances: the observations.
    target : array_like (n, 2)
        Coordinates to which the points are mapped.
    target_sigma : array_like, optional
        Standard deviation of the target's coordinates, a number or (n, 2). It is propagated to the points
        with the derivatives of the model at the approximate values.

    Returns
    -------
    GaussHelmert
        The problem, to be solved with :func:`reseau.adjust.adjust`.

    Raises
    ------
    UsageError
        When target and points differ in number.

    Examples
    --------
    >>> import numpy as np
    >>> square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    >>> points = ImagePoints(tuple("abcd"), square, np.tile(0.01 * np.eye(2), (4, 1, 1)))
    >>> mapping_problem(RationalPolynomial.affine(), points, 2 * square + 1).parameters.names
    ('a1', 'b1', 'c1', 'a2', 'b2', 'c2')
    """
    goal = np.asarray(target, dtype=np.float64)
    if goal.shape != (len(points), 2):
        raise UsageError(f"{len(points)} points with targets of shape {goal.shape}")
    covariance = points.cov
    spread = np.broadcast_to(np.asarray(target_sigma, dtype=np.float64), goal.shape)
    if spread.any():
        back = np.linalg.inv(model.derivatives(points.xy).d_xy)
        covariance = covariance + np.einsum("nij,nj,nkj->nik", back, spread**2, back)

    def conditions(xy: Array, values: Array) -> Array:
        return model.with_values(values)(xy) - goal

    def jacobians(xy: Array, values: Array) -> tuple[Array, Array]:
        found = model.with_values(values).derivatives(xy)
        return found.d_parameters, found.d_xy

    parameters = Parameters(model.names, model.values)
    return GaussHelmert(conditions, points.xy, covariance, parameters, jacobians)


def fit_mapping(
    model: PlaneMapping, points: ImagePoints, target: ArrayLike, target_sigma: ArrayLike = 0.0
) -> Adjustment | Failure:
    """Adjust all parameters of a model; see :func:`mapping_problem`.

    A rational polynomial needs no approximate values: the adjustment starts from a linear solution if that
    fits better than the given values.

    Examples
    --------
    >>> from reseau.optics.composition import Similarity
    >>> square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0]])
    >>> points = ImagePoints.with_sigma("abcd", square, 0.01)
    >>> fit = fit_mapping(Similarity(), points, 2 * square + 1).required()
    >>> round(fit["X0"], 6), round(fit["a"], 6), fit.redundancy
    (1.0, 2.0, 4)
    """
    shortage = _shortage(model, points)
    if shortage is not None:
        return shortage
    return adjust(mapping_problem(_with_start_values(model, points, target), points, target, target_sigma))


def reduce_mapping(
    model: PlaneMapping,
    points: ImagePoints,
    target: ArrayLike,
    target_sigma: ArrayLike = 0.0,
    *,
    alpha: float = 0.05,
    criterion: Literal["t", "chi2", "F"] = "chi2",
    keep: Iterable[str] = (),
    options: Options | None = None,
) -> Elimination | Failure:
    """Adjust a model and drop its insignificant parameters one by one; see :func:`mapping_problem`.

    Parameters
    ----------
    alpha : float
        Significance level of the tests.
    criterion : {"t", "chi2", "F"}
        Kind of test; χ² assumes that the covariances of the points are correct.
    keep : iterable of str
        Parameters that are never dropped.
    options : Options, optional
        Options of the adjustment.

    Examples
    --------
    >>> square = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [5.0, 5.0]])
    >>> points = ImagePoints.with_sigma("abcde", square, 0.01)
    >>> found = reduce_mapping(RationalPolynomial.affine(), points, square * [2.0, 3.0]).required()
    >>> sorted(found.dropped), round(found.adjustment["a1"], 6)
    (['a2', 'b1', 'c1', 'c2'], 2.0)
    """
    shortage = _shortage(model, points)
    if shortage is not None:
        return shortage
    problem = mapping_problem(_with_start_values(model, points, target), points, target, target_sigma)
    return eliminate(problem, alpha, criterion, keep, options=options)


_BEYOND_CHANCE = 1e-3
"""Probability of a misfit, or of a point that deviates, by chance, from which it is explained otherwise."""
_SUSPECTS = 5
"""Number of points, those with the largest residuals, of which each is left out for a trial."""


def beyond_chance(fit: Adjustment) -> bool:
    """Whether the residuals of an adjustment are larger than the sigmas of the points explain."""
    squares = fit.sigma0**2 * fit.redundancy
    return fit.redundancy > 0 and bool(scipy.stats.chi2.sf(squares, fit.redundancy) < _BEYOND_CHANCE)


def gross_errors(
    model: PlaneMapping, points: ImagePoints, target: Array, target_sigma: ArrayLike = 0.0
) -> Mask:
    """Points that contradict all others, of a model that does not fit all of them.

    While the residuals are beyond chance, the point without which they are smallest is a gross error if it
    deviates from the prediction by the others (F-test with their scatter, over all points).

    Parameters
    ----------
    model, points, target, target_sigma
        As in :func:`mapping_problem`.

    Returns
    -------
    ndarray (n,) of bool

    Examples
    --------
    >>> square = np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0)), axis=-1).reshape(-1, 2)
    >>> points = ImagePoints.with_sigma(map(str, range(16)), square, 0.01)
    >>> target = square + 0.01 * np.random.default_rng(0).standard_normal(square.shape)
    >>> target[5] += [0.0, 0.4]
    >>> np.flatnonzero(gross_errors(RationalPolynomial.affine(), points, target))
    array([5])
    """
    spread = np.broadcast_to(np.asarray(target_sigma, dtype=np.float64), target.shape)
    kept = np.ones(len(points), dtype=bool)

    def fitted(rows: Mask) -> Adjustment | Failure:
        return fit_mapping(model, points.select(rows), target[rows], spread[rows])

    fit = fitted(kept)
    while isinstance(fit, Adjustment) and fit.redundancy > 4 and beyond_chance(fit):
        rows = np.flatnonzero(kept)
        off = model.with_values(fit.values)(points.xy[rows]) - target[rows]
        size = (off**2).sum(axis=1) / (np.trace(points.cov[rows], axis1=1, axis2=2) + 1e-300)
        trials = []
        for at in rows[np.union1d(np.argsort(-size)[:_SUSPECTS], np.argsort(-np.hypot(*off.T))[:_SUSPECTS])]:
            others = kept.copy()
            others[at] = False
            trial = fitted(others)
            if isinstance(trial, Adjustment) and trial.redundancy > 2:
                trials.append((trial.sigma0**2 * trial.redundancy, others, trial))
        if not trials:
            break
        squares, others, trial = min(trials, key=lambda one: one[0])
        gain = (fit.sigma0**2 * fit.redundancy - squares) / 2 / trial.sigma0**2
        if scipy.stats.f.sf(gain, 2, trial.redundancy) * len(rows) > _BEYOND_CHANCE:
            break
        kept, fit = others, trial
    return ~kept


def _with_start_values(model: PlaneMapping, points: ImagePoints, target: ArrayLike) -> PlaneMapping:
    """The model with approximate values from a linear solution, if these fit better than the given ones.

    N/(1 + D) + P = T multiplied by 1 + D is linear in the parameters of N, D and P if the product D·P of two
    small quantities is neglected.
    """
    goal = np.asarray(target, dtype=np.float64)
    if not isinstance(model, RationalPolynomial) or goal.shape != points.xy.shape:
        return model
    if set(model.fixed) - {"X", "Y"} or on_one_line(points.xy):
        return model
    at_zero = model.with_values(np.zeros(len(model.names))).derivatives(points.xy)
    columns = np.array(at_zero.d_parameters)
    for k, name in enumerate(model.names):
        text = model.terms[name].get("D")
        if text is not None:
            term = {name: {"X": text, "Y": text}}
            sums = RationalPolynomial(term, np.ones(1), offset=model.offset, scale=model.scale)
            columns[:, :, k] -= goal * sums(points.xy)
    matrix = columns.reshape(-1, len(model.names))
    size = np.linalg.norm(matrix, axis=0)
    size[size == 0] = 1.0
    found = np.linalg.lstsq(matrix / size, (goal - at_zero.value).ravel(), rcond=1e-12)[0] / size
    linear = model.with_values(found)
    with np.errstate(invalid="ignore"):
        nearer = np.square(linear(points.xy) - goal).sum() < np.square(model(points.xy) - goal).sum()
    return linear if nearer else model


def on_one_line(xy: Array) -> bool:
    """Whether points (n, 2) lie on one line, within rounding."""
    spread = np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)
    return len(xy) < 3 or bool(spread[1] <= 1e-9 * spread[0])


def _shortage(model: PlaneMapping, points: ImagePoints) -> Failure | None:
    """A failure if there are fewer coordinates than parameters."""
    if 2 * len(points) < len(model.names):
        return Failure(
            f"{len(points)} points give {2 * len(points)} coordinates, "
            f"fewer than the {len(model.names)} parameters of the model",
            Code.TOO_FEW_POINTS,
        )
    return None


def residual_field(
    model: PlaneMapping,
    points: ImagePoints,
    target: Array,
    residuals: Array,
    target_sigma: ArrayLike = 0.0,
    trials: int = 499,
) -> SmoothField | None:
    """Residuals of a fitted model as a smooth field, with a test of whether the field is needed.

    Parameters
    ----------
    model : PlaneMapping
        The model at its estimates.
    points, target, target_sigma
        What the model was fitted to.
    residuals : ndarray (n, 2)
        Mapped minus target.
    trials : int
        Number of simulated sets of residuals, drawn from the errors of the points alone.

    Returns
    -------
    SmoothField or None
        Field over the targets. Its `need` is the probability, per axis, that errors of the points alone
        produce such a field. None with fewer than 20 points.
    """
    if len(points) < 20:
        return None
    _, slope, by_parameter = model.derivatives(points.xy)
    spread = np.broadcast_to(np.asarray(target_sigma, dtype=np.float64), target.shape)
    cov = slope @ points.cov @ np.swapaxes(slope, 1, 2) + spread[:, :, None] ** 2 * np.eye(2)
    root = np.linalg.cholesky(cov)
    taken, _ = np.linalg.qr(np.linalg.solve(root, by_parameter).reshape(2 * len(points), -1))
    white = np.random.default_rng(0).standard_normal((trials, 2 * len(points)))
    white -= (white @ taken) @ taken.T
    null = np.einsum("nij,tnj->tni", root, white.reshape(trials, len(points), 2))
    variance = np.diagonal(cov, axis1=1, axis2=2)
    # Without weights a single uncertain point would raise a hill of its own.
    relative = np.sqrt((variance / np.median(variance, axis=0)).mean(axis=1))
    return SmoothField.fit(target, residuals, sigma=relative, degree=0, null=null)


def is_mirrored(first: Array, second: Array) -> bool:
    """Whether two sets of the same points (n, 2) differ in handedness, from the affinity between them."""
    affine = np.linalg.lstsq(first - first.mean(axis=0), second - second.mean(axis=0), rcond=None)[0]
    return bool(np.linalg.det(affine) < 0)
