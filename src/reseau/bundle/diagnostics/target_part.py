"""The part of the uncertainty of a camera that observed coordinates of targets cause.

The adjustment maps the errors e of observed coordinates, with variances s², to the parameters by Q_xt P_t e
with P_t = diag(1/s²): their part of the covariance is Q_xt P_t Q_tx σ₀². The other observations cause the
rest.
"""

from __future__ import annotations

import numpy as np

from ...core.data import Array
from .result import Result

__all__ = ["covariance_by_targets"]

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
    >>> part = covariance_by_targets(result, 0) / result.camera_covariance(0)
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
    kept = fit.unknowns.kept[at]
    between = [cofactors.reduced.block(columns, start + np.arange(3)) for start in kept[kept >= 0]]
    eliminated = at[kept < 0]
    for begin in range(0, len(eliminated), _AT_ONCE):
        some = eliminated[begin : begin + _AT_ONCE]
        joint = cofactors.joint(columns, some)[:k, k:]
        between += list(joint.reshape(k, len(some), 3).transpose(1, 0, 2))
    for j, block in zip([*at[kept >= 0], *eliminated], between, strict=True):
        weighted = block[:, observed[j]] / network.sigma[j, observed[j]]
        total += weighted @ weighted.T
    return total * fit.variance
