"""Adjusted cameras of a fit: their mappings, with and without covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...calibration.camera import CameraMapping
from ...optics.cameras.registry import camera_model
from ...optics.mapping import PlaneMapping
from ..diagnostics.fields import camera_mapping
from ..diagnostics.result import Result
from ..solver.problem import BundleFit


def mapping_of(fit: BundleFit, camera: int = 0) -> CameraMapping:
    """The camera with its covariance."""
    return camera_mapping(result_of(fit), camera, formal=True)


def result_of(fit: BundleFit) -> Result:
    """The result of an adjustment without rejected observations."""
    network = fit.problem.network
    return Result(network, fit, np.zeros(len(network.xy), dtype=bool), ())


def whole_camera(fit: BundleFit, c: int = 0) -> PlaneMapping:
    """The adjusted camera with its additional parameters."""
    camera = fit.problem.network.cameras[c]
    camera = replace(camera, values=fit.values.cameras[c, : len(camera.values)])
    extra = camera.additional
    if extra is None:
        return camera.plane_mapping()
    series = extra.mapping(fit.values.extra[0, : len(extra.names)])
    return camera_model(camera.model).mapping(camera.values, camera.grid, camera.options, series)
