"""Uncertainty of cameras from the scatter between their images.

Each image i contributes dxᵢ = Q Aᵢᵀ Pᵢ vᵢ to the estimates, and the contributions sum to zero. If errors of
different images are independent, Σ dxᵢ dxᵢᵀ estimates the covariance of the estimates, also with dependent
errors within an image (Huber 1967; Liang & Zeger 1986, *Biometrika* 73). It reveals a camera that changes
between images, or marks with a common error.
"""

from __future__ import annotations

import numpy as np

from ...core.data import Array
from ..solver.normal import SEGMENTS
from .result import Result

__all__ = ["image_scatter", "sigma_between_images"]

# Images processed at once, and minimum number of images for an estimate.
_AT_ONCE, LEAST_IMAGES = 64, 6


def sigma_between_images(result: Result, c: int) -> Array:
    """Compute standard deviations of the parameters of a camera from the scatter between its images.

    Parameters
    ----------
    result : Result
        Of the adjustment.
    c : int
        Row of the camera.

    Returns
    -------
    ndarray (k,)
        In the order of :meth:`Result.camera_columns`; NaN with fewer than six images.

    Notes
    -----
    The unknowns of an image absorb part of its residuals: its contribution is divided by its mean redundancy
    number, and the sum is multiplied by m/(m − 1) for m images.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> result = adjust_network(example_network())
    >>> (sigma_between_images(result, 0) / result.camera(0).sigma).round(1)
    array([1.8, ...])
    """
    network, fit = result.network, result.fit
    _, columns, _ = result.camera_columns(c)
    images = np.flatnonzero(fit.usable.images & (network.camera_of == c))
    if len(images) < LEAST_IMAGES or not len(columns):
        return np.full(len(columns), np.nan)
    linear, cofactors = fit.linear, fit.cofactors
    pattern, seen, last = linear.system.pattern, linear.system.seen, linear.rows.shape[2] - 3
    pulled = (np.swapaxes(linear.rows, 1, 2) @ linear.misfits[:, :, None])[:, :, 0]
    r = np.nan_to_num(result.redundancy_numbers).sum(axis=1)
    kept = fit.usable.observations & ~result.rejected
    count = np.bincount(network.image_of[kept], minlength=len(network.images))
    share = np.bincount(network.image_of[kept], r[kept], len(count)) / np.maximum(2 * count, 1)
    moved, own = np.zeros((len(columns), len(images))), cofactors.reduced.rows(columns)
    for begin in range(0, len(images), _AT_ONCE):
        some = images[begin : begin + _AT_ONCE]
        place = np.full(len(network.images), -1)
        place[some] = np.arange(len(some))
        of = place[seen.image]
        side, sums = np.zeros((len(linear.prior), 3, len(some))), np.zeros((fit.unknowns.size, len(some)))
        k = np.flatnonzero((of >= 0) & (pattern.eliminated[seen.point] == 1))
        side[seen.point[k], :, of[k]] += pulled[k, last:]
        for s in range(SEGMENTS):
            for i in range(int(pattern.width[:, s].max(initial=0))):
                k = np.flatnonzero((of >= 0) & (pattern.width[:, s] > i))
                np.add.at(sums, (pattern.start[k, s] + i, of[k]), pulled[k, pattern.column[k, s] + i])
        sums += cofactors.normal.reduced_sides(side)
        moved[:, begin : begin + len(some)] = own @ sums / np.maximum(share[some], 0.1)
    m = len(images)
    sigma: Array = np.sqrt((moved**2).sum(axis=1) * m / (m - 1))
    return sigma


def image_scatter(result: Result, c: int, between: Array | None = None) -> float:
    """Return how much more the images of a camera scatter than their standard deviations say.

    Parameters
    ----------
    result : Result
        Of the adjustment.
    c : int
        Row of the camera.
    between : ndarray (k,), optional
        From :func:`sigma_between_images`, if it is known.

    Returns
    -------
    float
        Root mean square, over the parameters of the camera, of :func:`sigma_between_images` relative to the
        formal standard deviations; NaN with fewer than six images.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> round(image_scatter(adjust_network(example_network()), 0), 1)
    1.3
    """
    sigma = np.sqrt(np.diag(result.camera_covariance(c)))
    between = sigma_between_images(result, c) if between is None else between
    ratio = between / np.where(sigma > 0, sigma, np.inf)
    ratio = ratio[np.isfinite(ratio)]
    return float(np.sqrt(np.mean(ratio**2))) if len(ratio) else float("nan")
