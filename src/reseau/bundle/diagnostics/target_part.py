"""The part of the uncertainty of a camera that observed coordinates of targets cause.

The adjustment maps the errors e of observed coordinates, with variances s², to the parameters by Q_xt P_t e
with P_t = diag(1/s²): their part of the covariance is Q_xt P_t Q_tx σ₀². The other observations cause the
rest.
"""

from __future__ import annotations

import numpy as np

from ...core.data import Array
from .result import Result

# Points whose joint cofactors are computed at once.
_AT_ONCE = 64


def covariance_by_targets(result: Result, c: int) -> Array | None:
    """Compute the covariance of the parameters of a camera that observed target coordinates cause.

    Parameters
    ----------
    result : Result
        Of the adjustment.
    c : int
        Row of the camera.

    Returns
    -------
    ndarray (k, k) or None
        In the order of :meth:`Result.camera_columns`; None where no coordinates were observed.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from reseau.bundle import adjust_network, example_network
    >>> network = example_network()
    >>> surveyed = replace(network, sigma=np.full((20, 3), 1e-3), role=("control",) * 20, datum="control")
    >>> result = adjust_network(surveyed)
    >>> part = covariance_by_targets(result, 0) / result.formal_camera_covariance(0)
    >>> bool(0.01 < part[0, 0] < 1.0), covariance_by_targets(adjust_network(network), 0)
    (True, None)
    """
    network, fit = result.network, result.fit
    observed = network.observed & fit.usable.points[:, None]
    at = np.flatnonzero(observed.any(axis=1))
    _, columns, _ = result.camera_columns(c)
    if not len(at) or not len(columns):
        return None
    k, cofactors = len(columns), fit.cofactors
    total = np.zeros((k, k))
    for begin in range(0, len(at), _AT_ONCE):
        some = at[begin : begin + _AT_ONCE]
        between = cofactors.joint(columns, some)[:k, k:].reshape(k, len(some), 3)
        weight = np.where(observed[some], 1.0 / np.where(observed[some], network.sigma[some], 1.0), 0.0)
        weighted = (between * weight).reshape(k, -1)
        total += weighted @ weighted.T
    return total * fit.variance
