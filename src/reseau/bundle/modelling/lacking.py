"""The next radial coefficient of a camera's own model, which the observations may need.

Residuals show little of a coefficient that is missing: the others take over its effect where there are
points, and the projection is wrong where there are few. The coefficient is therefore estimated and tested,
with what it changes in the middle and in the corners of the image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.special

from ...calibration import CameraMapping, calibration_difference
from ...calibration.camera import corners_of
from ...core.errors import UsageError
from ..diagnostics import Result, camera_mapping
from ..solver import BundleFit

__all__ = ["Lacking", "lacking"]

# Images above which the adjustment with one parameter more takes too long for what it says.
_MOST = 1000
_ROUNDS, _ACROSS = 10, 13


@dataclass(frozen=True)
class Lacking:
    """A parameter that a camera lacks, and what it would change.

    Parameters
    ----------
    name : str
        The parameter.
    p : float
        Probability of a decrease of the residuals at least as large where it is zero.
    centre_px, corners_px : float
        Change of the projection in the middle, and in the worst of the corners (of the image, where its
        corners have no rays), after the best rotation.

    Examples
    --------
    >>> Lacking("k3", 1e-4, 0.001, 0.12).significant
    True
    """

    name: str
    p: float
    centre_px: float
    corners_px: float

    @property
    def significant(self) -> bool:
        """Whether noise explains it in less than one case of a thousand: every calibration is tested."""
        return self.p < 0.001


def lacking(result: Result, camera: int = 0) -> Lacking | None:
    """Test the next radial coefficient that the model of a camera has and the adjustment did not estimate.

    Parameters
    ----------
    result : Result
        The adjustment.
    camera : int
        Row of the camera.

    Returns
    -------
    Lacking or None
        None where the model has no further one, the network is very large, or the adjustment with it fails.

    Notes
    -----
    With vᵀPv before and after, and redundancy r after, F(1, r) = (before − after) / (after / r).

    Examples
    --------
    >>> from reseau.bundle import adjust_network, example_network
    >>> found = lacking(adjust_network(example_network()))
    >>> found.name, found.significant
    ('K2', False)
    """
    network, fit = result.network, result.fit
    own = network.cameras[camera]
    if own.registered is None or own.additional is not None or own.sigma or len(network.images) > _MOST:
        return None
    values = dict(zip(own.registered.names, own.values.tolist(), strict=False))
    held = [name for name in own.registered.of_role("distortion") if name not in own.free]
    # Radial coefficients are called k or K in all models.
    following = next((name for name in held if name[0] in "kK"), None)
    # A parameter that is held at a value was determined elsewhere.
    if following is None or any(values.get(name, 0.0) for name in held):
        return None
    names = tuple(name for name in own.registered.names if name in own.free or name == following)
    cameras = list(network.cameras)
    cameras[camera] = replace(own, free=names)
    start = fit.problem.continued(fit)
    more = replace(start, network=replace(network, cameras=tuple(cameras)), max_iterations=_ROUNDS, rounds=0)
    trial = more.adjusted()
    if not isinstance(trial, BundleFit):
        return None
    after, redundancy = trial.cost, result.redundancy - 1
    if redundancy < 1 or not 0 < after <= fit.cost:
        return None
    p = float(scipy.special.fdtrc(1, redundancy, (fit.cost - after) / (after / redundancy)))
    estimated = replace(cameras[camera], values=trial.values.cameras[camera, : len(own.values)])
    size = (own.width, own.height)
    other = CameraMapping(estimated.plane_mapping(), *size, np.array([0]), np.zeros((1, 1)))
    try:
        change = calibration_difference(camera_mapping(result, camera), other, _ACROSS).difference
    except UsageError:
        return None
    far = np.hypot(change[..., 0], change[..., 1])
    rows, columns = far.shape
    corners = corners_of(far)
    if not np.isfinite(corners).any():
        corners = far
    return Lacking(following, p, float(far[rows // 2, columns // 2]), float(np.nanmax(corners)))
