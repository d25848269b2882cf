"""Which adjusted cameras are determined: their parameters, and their projection up to the corners."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import takewhile

import numpy as np

from ...calibration.camera import CameraMapping, projection_field
from ...optics import PlaneMapping
from ...optics.cameras import camera_model
from ..diagnostics import Result, camera_mapping
from ..solver import BundleFit

__all__ = ["mapping_of", "parameters_determined", "result_of", "undetermined", "whole_camera"]

# Places along the longer side at which the projection is looked at.
_ACROSS = 9
# Standard deviation of a projection that is determined, and residuals that practically do not differ, pixels.
_DETERMINED_PX, _PRACTICAL_PX = 2.0, 0.02
# Ratio of standard deviations of two projections from which the larger is not determined.
_TIMES = 10.0


def undetermined(fits: Mapping[int, BundleFit]) -> dict[int, float]:
    """Candidates that describe the images best, but are not determined beyond them, where others are.

    These others are determined ten times as well, and their residuals are in practice the same; or twice as
    large, where an image folds before a corner of the frame. Returned are standard deviations in the worst
    corner of candidates, which come by description length.
    """
    every = list(fits)
    rms = {k: _rms(fit) for k, fit in fits.items()}
    worst = {every[0]: projection_field(mapping_of(fits[every[0]]), _ACROSS).worst_px}
    if worst[every[0]] <= _DETERMINED_PX:
        return {}
    near = [k for k in every if rms[k] < 2 * min(rms.values())]
    worst |= {k: projection_field(mapping_of(fits[k]), _ACROSS).worst_px for k in near if k not in worst}
    found = dict(takewhile(lambda each: not np.isfinite(each[1]), ((k, worst[k]) for k in near)))
    rest = near[len(found) :]
    if not rest:
        return {}
    alike = [k for k in rest if rms[k] ** 2 - rms[rest[0]] ** 2 < _PRACTICAL_PX**2]
    limit = max(_DETERMINED_PX, _TIMES * min(worst[k] for k in alike))
    return found | dict(takewhile(lambda each: each[1] > limit, ((k, worst[k]) for k in alike)))


def _rms(fit: BundleFit) -> float:
    """Root mean square of the residuals of the image points used, pixels."""
    v = fit.residuals[: 2 * len(fit.problem.network.xy)].reshape(-1, 2)[fit.usable.observations]
    return float(np.sqrt(np.nanmean(v**2)))


def parameters_determined(fit: BundleFit) -> float:
    """Number of parameters of the camera that the images determine, without what is only regularised."""
    camera = fit.problem.network.cameras[0]
    extra = 0 if camera.additional is None else len(camera.additional.names)
    prior = result_of(fit).priors(0)
    regularised = 0.0 if prior is None else len(prior.parameters) - prior.determined
    return len(camera.free) + extra - regularised


def mapping_of(fit: BundleFit) -> CameraMapping:
    """The camera with its covariance."""
    return camera_mapping(result_of(fit), 0)


def result_of(fit: BundleFit) -> Result:
    """The result of an adjustment without rejected observations."""
    network = fit.problem.network
    return Result(network, fit, np.zeros(len(network.xy), dtype=bool), ())


def whole_camera(fit: BundleFit) -> PlaneMapping:
    """The adjusted camera with its additional parameters."""
    camera = fit.problem.network.cameras[0]
    camera = replace(camera, values=fit.values.cameras[0, : len(camera.values)])
    extra = camera.additional
    if extra is None:
        return camera.plane_mapping()
    series = extra.mapping(fit.values.extra[0, : len(extra.names)])
    return camera_model(camera.model).mapping(camera.values, camera.grid, camera.options, series)
