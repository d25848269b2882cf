"""Results of matching, in columns over the marks."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np

from ...adjust.batch import BatchAdjustment
from ...core.data import Array, Mask, Rows
from .patches import CONTRAST, LEVEL, WIDTH, Patches

Columns = TypeVar("Columns", "Matches", BatchAdjustment)


@dataclass(frozen=True, eq=False)
class Matches:
    """Results of matching, in columns over the k marks.

    Parameters
    ----------
    xy : ndarray (k, 2)
        Positions in pixels.
    cov : ndarray (k, 2, 2)
        Covariances of the positions, from the residuals of each patch.
    psf_px : ndarray (k,)
        Widths of the point-spread function.
    contrast : ndarray (k,)
        Share of the light that a dark mark attenuates; grey values that a bright mark adds.
    level : ndarray (k,)
        Grey value of the background at the mark.
    t : ndarray (k,)
        Contrast over its standard deviation, for given width and form.
    form : ndarray (k, m)
        Parameters of the form.
    noise : ndarray (k,)
        Standard deviation of the residuals, grey values.
    correlation : ndarray (k,)
        Correlation of the patch with the formed image after subtraction of the background.
    seen : ndarray (k,)
        Share of the mark on valid pixels.
    rejected : ndarray (k,)
        Share of the mark on pixels rejected as blunders.
    converged : ndarray of bool (k,)
        Whether the adjustment converged.
    residuals : ndarray (k, rows, columns)
        Adjusted minus observed, NaN where a pixel was not used.
    form_sigma : ndarray (k, m)
        Standard deviations of `form`.
    form_cofactor : ndarray (k, 2, m)
        Cofactors of the position and `form`; over the squared standard deviation of a prior of the form they
        are the derivatives of the position by its mean.
    influence : ndarray (k, 2, rows, columns)
        Change of the position with the grey value of each pixel; (k, 2, 0, 0) if it was not wanted.
    leverage : ndarray (k, rows, columns)
        Share of the error of each pixel that the adjustment takes from its residual; empty as `influence`.
    psf_log_sigma : ndarray (k,)
        Standard deviations of the logarithms of `psf_px`.

    Examples
    --------
    >>> one, none = np.ones(2), np.zeros((2, 0))
    >>> xy, cov = np.array([[10.3, 9.6], [40.1, 9.8]]), np.tile(1e-4 * np.eye(2), (2, 1, 1))
    >>> seen = np.array([1.0, 0.4])
    >>> marks = Matches(xy, cov, one, 0.6 * one, 200 * one, 300 * one, none, one, one, seen, 0 * one,
    ...                 one > 0, np.zeros((2, 17, 17)), none, np.zeros((2, 2, 0)), np.zeros((2, 2, 17, 17)),
    ...                 np.zeros((2, 17, 17)), 0.1 * one)
    >>> len(marks.select(marks.seen > 0.5))
    1
    """

    xy: Array
    cov: Array
    psf_px: Array
    contrast: Array
    level: Array
    t: Array
    form: Array
    noise: Array
    correlation: Array
    seen: Array
    rejected: Array
    converged: Mask
    residuals: Array
    form_sigma: Array
    form_cofactor: Array
    influence: Array
    leverage: Array
    psf_log_sigma: Array

    def __len__(self) -> int:
        return len(self.xy)

    @property
    def variance(self) -> Array:
        """Mean variance (k,) of both coordinates."""
        return np.asarray(np.trace(self.cov, axis1=1, axis2=2) / 2)

    def select(self, keep: Mask | Rows) -> Matches:
        """Matches selected by a mask (k,), or by rows."""
        return Matches(**{column.name: getattr(self, column.name)[keep] for column in fields(self)})

    def replaced(self, rows: Rows, others: Matches) -> Matches:
        """These matches with `rows` replaced by others from windows of the same size."""
        return with_rows(self, rows, others)


def with_rows(whole: Columns, rows: Rows, part: Columns) -> Columns:
    """A dataclass of columns with some rows replaced by those of another."""
    columns = {}
    for column in fields(whole):
        columns[column.name] = getattr(whole, column.name).copy()
        columns[column.name][rows] = getattr(part, column.name)
    return replace(whole, **columns)


def matches_of(
    patch: Patches,
    found: BatchAdjustment,
    used: Mask,
    scale: Array,
    share: Array | None = None,
    influences: tuple[Array, Array] | None = None,
) -> Matches:
    """Columns of results from the adjusted batch; `share` as formed last, and influences, if known."""
    x, k = found.estimates, len(patch.xy)
    flat = (patch.share(x) if share is None else share).reshape(k, -1)
    plane = x[:, patch.ground] @ patch.monomials.T
    formed = -plane * flat if patch.options.polarity == "dark" else flat
    whole = np.maximum((flat * patch.near).sum(axis=1), 1e-12)
    seen, unused = ((flat * each).sum(axis=1) / whole for each in (patch.weights, patch.weights - used))
    # Without the background.
    count = used.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        cov = found.covariance
        one, other = (
            np.where(used, each - np.where(used, each, 0.0).sum(axis=1, keepdims=True) / count[:, None], 0.0)
            for each in (patch.grey - plane, formed)
        )
        squares = (one * one).sum(axis=1) * (other * other).sum(axis=1)
        correlation = (one * other).sum(axis=1) / np.sqrt(squares)
        t = correlation * np.sqrt(np.maximum(count - patch.form_at, 1) / (1 - correlation**2))
    influence, leverage = np.zeros((k, 2, 0, 0)), np.zeros((k, 0, 0))
    if influences is not None:
        influence, leverage = influences
    elif patch.options.influence:
        influence, leverage = patch.influence(x, found.cofactor, used, scale, np.arange(k))
    width = patch.width(x, np.arange(k))
    return Matches(
        xy=patch.xy + x[:, :2],
        cov=cov[:, :2, :2],
        psf_px=width,
        contrast=x[:, CONTRAST],
        level=x[:, LEVEL],
        t=np.nan_to_num(t),
        form=x[:, patch.form_at :],
        noise=found.sigma0 * scale,
        correlation=np.nan_to_num(correlation),
        seen=seen,
        rejected=unused,
        converged=found.converged & np.isfinite(cov[:, :2, :2]).all(axis=(1, 2)),
        residuals=np.where(used, found.residuals, np.nan).reshape(patch.shape),
        form_sigma=np.sqrt(np.diagonal(cov, axis1=1, axis2=2)[:, patch.form_at :]),
        form_cofactor=found.cofactor[:, :2, patch.form_at :],
        influence=influence,
        leverage=leverage,
        psf_log_sigma=np.sqrt(cov[:, WIDTH, WIDTH]) * (np.exp(x[:, WIDTH]) / width) ** 2,
    )
