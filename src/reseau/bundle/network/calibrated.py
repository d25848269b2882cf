"""A camera of a network from its calibration: parameters with their joint covariance."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from ...calibration import Calibration, CameraMapping
from ...core.errors import UsageError
from ...optics.cameras import camera_model
from .network import Camera

__all__ = ["calibrated_camera"]

_KEYS = ("model", "width", "height", "pitch_mm", "additional")
"""Keys of the model in a calibration; the others are options of the camera model."""


def calibrated_camera(name: str, calibration: Calibration, *, held: bool = False) -> Camera:
    """Return the camera of a calibration for use in another network.

    Parameters
    ----------
    name : str
        Id of the camera in the network.
    calibration : Calibration
        Of a camera.
    held : bool
        Whether its parameters are held. Otherwise those that it estimated are observations with their joint
        covariance, and are estimated again.

    Raises
    ------
    UsageError
        When it is no calibration of a camera.

    Examples
    --------
    >>> from reseau.bundle import adjust_network, calibration_of, example_network
    >>> result = adjust_network(example_network())
    >>> camera = calibrated_camera("front", calibration_of(result, "camera", name="front"))
    >>> camera.free, round(float(camera.covariance[0, 0] ** 0.5), 4)
    (('c', 'x0', 'y0', 'K1'), ...)
    """
    mapping = calibration.mapping()
    if not isinstance(mapping, CameraMapping):
        raise UsageError(
            f"is a calibration of a {calibration.kind.replace('_', ' ')}, not of a camera",
            where=f"camera {name}",
        )
    model = cast(dict[str, Any], calibration.model)
    names, covariance = mapping.mapping.names, np.zeros((len(mapping.mapping.names),) * 2)
    covariance[np.ix_(mapping.rows, mapping.rows)] = mapping.covariance
    # A camera with additional parameters has values of its own for them: a mapping of all parameters.
    whole = model.get("additional") is not None
    own = () if whole else camera_model(model["model"]).names
    if own and tuple(names) != tuple(own):
        raise UsageError("has other parameters than its model", where=f"calibration {calibration.name}")
    return Camera(
        id=name,
        width=mapping.width,
        height=mapping.height,
        pitch_mm=tuple(model["pitch_mm"]),
        model="mapping" if whole else model["model"],
        values=np.array(mapping.mapping.values, dtype=np.float64),
        free=() if held else tuple(names[k] for k in sorted(mapping.rows)),
        options={} if whole else {key: value for key, value in model.items() if key not in _KEYS},
        mapping=mapping.mapping if whole else None,
        covariance=None if held else covariance,
    )
