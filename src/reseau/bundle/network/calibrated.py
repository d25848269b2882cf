"""Cameras of a network from calibrations: of a camera, or of the scanned frame of a camera on film."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np

from ...calibration import (
    Calibration,
    CameraMapping,
    FiducialMapping,
    FilmFrameMapping,
    calibration_of_frame,
)
from ...core.data import Array
from ...core.errors import UsageError
from ...io import FrameOrientation
from ...optics.cameras.registry import camera_model
from .camera import Camera
from .shutter import Shutter

_KEYS = ("model", "width", "height", "pitch_mm", "additional", "shutter")
"""Keys of `Calibration.model` for every camera; all others are options of the camera model."""


def calibrated_camera(name: str, calibration: Calibration, *, held: bool = False) -> Camera:
    """Return the camera of a calibration for use in a network.

    Parameters
    ----------
    name : str
        Id of the camera in the network.
    calibration : Calibration
        Calibration of a camera.
    held : bool
        Whether all parameters are held. Otherwise those that the calibration estimated are observations with
        their joint covariance and are estimated again.

    Raises
    ------
    UsageError
        When `calibration` is of another kind.

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
        raise UsageError(calibration.not_of("camera"), where=f"camera {name}")
    model = cast(dict[str, Any], calibration.model)
    names, covariance = mapping.mapping.names, np.zeros((len(mapping.mapping.names),) * 2)
    covariance[np.ix_(mapping.rows, mapping.rows)] = mapping.covariance
    # With additional parameters, the mapping of the calibration contains all parameters.
    whole = model.get("additional") is not None
    own = () if whole else camera_model(model["model"]).names
    if own and tuple(names) != tuple(own):
        raise UsageError(
            "has parameters that do not match its model", where=f"calibration {calibration.name}"
        )
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
        shutter=None if model.get("shutter") is None else Shutter(**model["shutter"]),
    )


def film_camera(camera: Camera, frame: Calibration | FrameOrientation, *, held: bool = False) -> Camera:
    """Return a camera with the pixel size and the principal point of a scanned film frame.

    Parameters
    ----------
    camera : Camera
        Camera with all other parameters, including the principal distance; width and height are those of the
        scan.
    frame : Calibration or FrameOrientation
        The inner orientation of the frame.
    held : bool
        Whether the principal point is held. Otherwise it is an observation with its covariance.

    Raises
    ------
    UsageError
        When the camera model is not defined in millimetres, the scan is mirrored or has another size, or
        `frame` is a calibration of another kind.
    FormatError
        When the orientation of the frame was declined.

    Notes
    -----
    The principal point is the origin of the photo-coordinates. The pixel size is the length in the frame of
    one step along a row and along a column of the scan; the frame may be rotated in the scan.

    Examples
    --------
    >>> corner = {"sx": 0.1, "sy": 0.1, "rho": 0.0}
    >>> at = {"ul": (10.0, 20.0), "ur": (370.0, 20.0), "lr": (370.0, 260.0), "ll": (10.0, 260.0)}
    >>> frame = FrameOrientation.model_validate({
    ...     "image": "scan.tif", "status": "oriented", "why": "", "format_mm": (36.0, 24.0),
    ...     "channel": "grey",
    ...     "corners": {name: corner | {"x": x, "y": y} for name, (x, y) in at.items()},
    ...     "principal_point": corner | {"x": 190.0, "y": 140.0}, "angle_deg": 0.0, "angle_sigma_deg": 0.01,
    ...     "px_per_mm": (10.0, 10.0), "edges": {}})
    >>> camera = Camera("film", 380, 280, (1.0, 1.0), "brown", np.array([35.0] + 9 * [0.0]), ("c",))
    >>> found = film_camera(camera, frame)
    >>> found.pitch_mm, found.free, found.values[:3].round(6)
    ((0.1, 0.1), ('c', 'x0', 'y0'), array([35. ,  0.05, -0.05]))
    """
    calibration = calibration_of_frame(frame) if isinstance(frame, FrameOrientation) else frame
    mapping, model, where = calibration.mapping(), camera.registered, f"camera {camera.id}"
    if not isinstance(mapping, FilmFrameMapping | FiducialMapping):
        raise UsageError(calibration.not_of("film_frame"), where=where)
    centre = () if model is None else model.of_role("centre")
    if model is None or not model.needs_pitch or len(centre) != 2:
        raise UsageError(
            f"the model `{camera.model}` is not defined in millimetres and cannot use a film frame",
            where=where,
        )
    mapping.check_size(camera.width, camera.height, where)
    xy = mapping.to_pixels(np.zeros((1, 2)))
    _, linear, by_parameters = (values[0] for values in mapping.derivatives(xy))
    if np.linalg.det(linear) > 0:
        raise UsageError("the film frame was scanned from the wrong side", where=where, do="mirror the scan")
    inverse = np.linalg.inv(linear)
    cov: Array = inverse @ by_parameters @ mapping.parameter_covariance @ by_parameters.T @ inverse.T
    if isinstance(frame, FrameOrientation) and frame.transform is None and frame.principal_point is not None:
        # The document has no correlations between corners; its principal point takes them into account.
        point = frame.principal_point
        xy, mixed = np.array([[point.x, point.y]]), point.rho * point.sx * point.sy
        cov = np.array([[point.sx**2, mixed], [mixed, point.sy**2]])
    pitch = np.hypot(*linear)
    found = replace(camera, pitch_mm=(float(pitch[0]), float(pitch[1])))
    to_mm = np.diag(1.0 / found.grid.pixels_per_mm)
    at = [camera.names.index(name) for name in centre]
    values = camera.values.copy()
    values[at] = found.grid.to_photo(xy)[0]
    own = () if held else tuple(name for k, name in enumerate(centre) if cov[k, k] > 0)
    free = ({*camera.free} - {*centre}) | {*own}
    covariance = camera.covariance
    if own:
        sigma = np.array([camera.sigma.get(name, 0.0) for name in camera.names])
        covariance = np.diag(sigma**2) if covariance is None else covariance.copy()
        covariance[at], covariance[:, at] = 0.0, 0.0
        covariance[np.ix_(at, at)] = to_mm @ cov @ to_mm
    return replace(
        found,
        values=values,
        free=tuple(name for name in camera.names if name in free),
        sigma={name: s for name, s in camera.sigma.items() if not own and name in free},
        covariance=covariance,
    )
