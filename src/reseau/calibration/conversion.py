"""Calibrations of a camera in the model of another calibration."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from ..core.errors import UsageError
from ..optics import PixelGrid
from ..optics.cameras import convert
from .camera import CameraMapping, options_of
from .document import Calibration, Covariance, Quantity


def in_model_of(calibration: Calibration, like: Calibration) -> tuple[Calibration, float]:
    """Convert the calibration of a camera to the model of another one.

    Parameters
    ----------
    calibration : Calibration
        The calibration of a camera.
    like : Calibration
        The one whose model and estimated parameters are used.

    Returns
    -------
    Calibration
        The converted one; its covariance is that of the original, and does not contain the error of the
        conversion.
    float
        The largest difference that remains over the image, px.

    Raises
    ------
    UsageError
        If the images differ in size, or the models have not the same kind of rays or additional parameters.

    Examples
    --------
    >>> brown = Calibration(
    ...     kind="camera", name="left", sigma0=1.0, redundancy=100,
    ...     model={"model": "brown", "width": 640, "height": 480, "pitch_mm": [0.01, 0.01]},
    ...     parameters={"c": Quantity(value=8.0, sigma=1e-3, unit="mm")},
    ...     covariance=Covariance(names=("c",), matrix=((1e-6,),)))
    >>> in_model_of(brown, brown)[1] < 1e-9
    True
    """
    given, wanted = cast(dict[str, Any], calibration.model), cast(dict[str, Any], like.model)
    camera = CameraMapping.from_calibration(calibration)
    if camera.size != (wanted["width"], wanted["height"]):
        raise UsageError("have images of different sizes", where=f"{calibration.name}, {like.name}")
    if given.get("additional") or wanted.get("additional"):
        where = f"{calibration.name}, {like.name}"
        raise UsageError("have additional parameters and cannot be converted", where=where)
    names = like.covariance.names
    free = tuple(n for n, each in like.parameters.items() if each.value != 0 or n in names)
    grid = PixelGrid(wanted["width"], wanted["height"], (wanted["pitch_mm"][0], wanted["pitch_mm"][1]))
    found = convert(camera.mapping, grid, wanted["model"], options_of(wanted), free=free)
    rows = [found.free.index(name) for name in names]
    whole = found.covariance(camera.names, camera.covariance)[np.ix_(rows, rows)]
    parameters = {}
    for name, each in like.parameters.items():
        sigma = float(np.sqrt(whole[names.index(name), names.index(name)])) if name in names else 0.0
        value = found.mapping.value_of(name) if name in free else each.value
        parameters[name] = Quantity(value=float(value), sigma=sigma, unit=each.unit)
    matrix = tuple(tuple(row) for row in whole.tolist())
    update = {
        "model": like.model,
        "parameters": parameters,
        "covariance": Covariance(names=names, matrix=matrix),
    }
    return calibration.model_copy(update=update), found.greatest_px
