"""The polynomial of a mapping, adjusted robustly to measured points."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ...adjust import adjust_batch, weight_function
from ...adjust.batch import BatchOptions
from ...core.data import Array, Rows
from ...core.threads import one_thread
from ...optics.composition import Chain
from ...optics.field import trend_degree
from .lattice_images import monomials
from .lattice_mapping import degree_of, numbers_of, of_degree, with_coefficients

_MOST_PX = 20.0
"""Prior standard deviation of the coefficients of the polynomial, pixels."""
_NEIGHBOURS, _TOGETHER_PX, _SCATTER, _ALONE = 9, 0.1, 0.5, 6.0
"""Number of neighbouring points, themselves included, of which the median residual is compared; median from
which they deviate together from a mapping, and its multiple by which they may scatter; multiple of the usual
deviation from it that a point may have."""


def refit(mapping: Chain, at: Array, xy: Array, sigma_px: float) -> Chain:
    """The mapping with its polynomial adjusted to measured points.

    Parameters
    ----------
    at, xy : ndarray (n, 2)
        Lattice coordinates and images; the degree grows with their number, up to the fifth. Those that the
        projectivity takes beyond the horizon say nothing.
    sigma_px : float
        Standard deviation of the images.
    """
    # At least the degree already determined by the lines.
    before = degree_of(mapping) if len(at) > len(mapping.second.values) // 2 else 1
    mapping = of_degree(mapping, max(before, trend_degree(len(at))))
    monomials, straight = monomials_of(mapping, at)
    seen = np.isfinite(straight).all(axis=1) & np.isfinite(monomials).all(axis=1)
    if not seen.all():
        if seen.sum() <= monomials.shape[1]:
            return mapping
        at, xy, straight, monomials = at[seen], xy[seen], straight[seen], monomials[seen]
    observed = (xy - straight).T
    fit, residuals = _solved(mapping, monomials, observed, sigma_px)
    common = common_part(at, residuals.T)
    if common is None:
        return fit
    # A robust adjustment has rejected all points of a region. Points that agree with their neighbours count.
    own = np.hypot(*(residuals.T - common).T)
    agree = own < _ALONE * median(own)
    if agree.sum() <= 2 * monomials.shape[1]:
        return fit
    size = np.maximum(np.linalg.norm(monomials, axis=0), 1e-12)
    values: Array = np.linalg.lstsq((monomials / size)[agree], observed.T[agree], rcond=1e-10)[0]
    return with_coefficients(mapping, (values / size[:, None]).T)


def common_part(at: Array, residuals: Array) -> Array | None:
    """Medians (n, 2) of the residuals (n, 2) of points (n, 2) and their nearest neighbours.

    None if neighbours deviate together nowhere, by more than a tenth of a pixel.
    """
    far = (np.abs(residuals) > _TOGETHER_PX).any(axis=1)
    if len(at) < _NEIGHBOURS or np.count_nonzero(far) <= _NEIGHBOURS // 2:
        return None
    near = scipy.spatial.KDTree(at).query(at, k=_NEIGHBOURS)[1]
    common: Array = np.median(residuals[near], axis=1)
    size, scatter = np.abs(common), np.median(np.abs(residuals[near] - common[:, None]), axis=1)
    return common if ((size > _TOGETHER_PX) & (scatter < _SCATTER * size)).any() else None


def monomials_of(mapping: Chain, at: Array) -> tuple[Array, Array]:
    """Monomials (n, m) of the polynomial at lattice coordinates (n, 2), and images by the projectivity."""
    return monomials(numbers_of(mapping), at, degree_of(mapping))


def _solved(mapping: Chain, design: Array, observed: Array, sigma_px: float) -> tuple[Chain, Array]:
    """The mapping with its polynomial adjusted robustly, and the residuals (b, n).

    The projectivity is kept. The coefficients of the polynomial are linear: all of them in one problem, or
    those of x and those of y, which share a design matrix (n, u), in two.
    """
    none, most = np.zeros((len(observed), design.shape[1])), np.full(design.shape[1], _MOST_PX / sigma_px)

    def images(x: Array, rows: Rows) -> tuple[Array, Array]:
        return x @ design.T, np.broadcast_to(design, (len(rows), *design.shape))

    with one_thread():
        fit = adjust_batch(
            images, none, observed, prior=(none, most),
            options=BatchOptions(
                max_iterations=5, tolerance=0.1 * sigma_px, reweight=weight_function("tukey")
            ),
        )  # fmt: skip
    return with_coefficients(mapping, fit.estimates), fit.residuals


def median(values: NDArray[Any]) -> float:
    """Median of finite values (n,), n > 0; ten times as fast for a few hundred as that of NumPy."""
    half = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, half)[half])
    low, high = np.partition(values, (half - 1, half))[half - 1 : half + 1].tolist()
    return float((low + high) / 2)
