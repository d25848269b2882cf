"""YAML files: ``camera_info`` of ROS, and the ``camchain`` of Kalibr.

ROS: sensor_msgs/CameraInfo as ``camera_calibration`` writes it, with the models ``plumb_bob``,
``rational_polynomial`` and ``equidistant``. Kalibr: pinhole cameras with ``radtan`` or ``equidistant``
distortion, ``omni`` with ``radtan``, ``ds`` and ``eucm`` without. Pixels are counted from the centre of the
first one.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ...bundle import Camera
from ...core.errors import FormatError
from .opencv import coefficients
from .plain import CENTRE, FISHEYE, RADIAL_TANGENTIAL, Mounted, given, opencv_camera

_SHAPES = {
    "omni": ("omni", ("xi",)),
    "double_sphere": ("ds", ("xi", "alpha")),
    "eucm": ("eucm", ("alpha", "beta")),
}
"""Registered models, those of Kalibr, and the parameters that come first."""
_DISTORTIONS = {"radtan": RADIAL_TANGENTIAL, "equidistant": FISHEYE, "none": ()}
_ROS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,), "fisheye": (4,)}


def write_ros(camera: Camera) -> str:
    """Return the text of a ``camera_info`` file."""
    fx, fy, cx, cy = given(camera, *CENTRE)
    found = coefficients(camera)
    model = (
        "equidistant"
        if camera.model == "fisheye"
        else {5: "plumb_bob"}.get(len(found), "rational_polynomial")
    )
    text: str = yaml.safe_dump(
        {
            "image_width": camera.width,
            "image_height": camera.height,
            "camera_name": camera.id,
            "camera_matrix": _matrix(3, 3, [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
            "distortion_model": "equidistant" if camera.model == "fisheye" else model,
            "distortion_coefficients": _matrix(1, len(found), found),
            "rectification_matrix": _matrix(3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
            "projection_matrix": _matrix(3, 4, [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
        },
        sort_keys=False,
    )
    return text


def _matrix(rows: int, cols: int, data: list[float]) -> dict[str, Any]:
    return {"rows": rows, "cols": cols, "data": data}


def is_ros(text: str) -> bool:
    """Whether this is a ``camera_info`` file."""
    return "distortion_model:" in text and "projection_matrix:" in text


def read_ros(text: str, path: Path) -> Camera:
    """Read a camera of ROS.

    Raises
    ------
    FormatError
        When the camera is incomplete, or of an unknown model.
    """
    content = _mapping(text, path)
    model = content.get("distortion_model", "")
    try:
        matrix = [float(v) for v in content["camera_matrix"]["data"]]
        found = [float(v) for v in content["distortion_coefficients"]["data"]]
        size = int(content["image_width"]), int(content["image_height"])
        (fx, _, cx, _, fy, cy, *_) = matrix
    except (KeyError, TypeError, ValueError):
        raise FormatError(
            "has no complete camera_matrix, distortion_coefficients and size", where=path
        ) from None
    if model not in _ROS or len(found) not in _ROS[model]:
        raise FormatError(
            f"has the distortion model {model!r} with {len(found)} coefficients; known are {', '.join(_ROS)}",
            where=path,
        )
    name = str(content.get("camera_name") or path.stem)
    fisheye = model in ("equidistant", "fisheye")
    return opencv_camera(name, size, (fx, fy), (cx, cy), found, path, fisheye=fisheye)


def write_kalibr(camera: Camera) -> str:
    """Return the text of a ``camchain`` file with one camera."""
    return _chain([_entry(camera)])


def write_kalibr_rig(rig: Sequence[Mounted]) -> str:
    """Return the text of a ``camchain`` file; ``T_cn_cnm1`` maps from the camera before to the camera, m."""
    entries = [_entry(mounted.camera) for mounted in rig]
    for before, after, entry in zip(rig[:-1], rig[1:], entries[1:], strict=True):
        matrix = np.eye(4)
        matrix[:3, :3] = after.rotation @ before.rotation.T
        matrix[:3, 3] = 1e-3 * (after.translation - matrix[:3, :3] @ before.translation)
        entry["T_cn_cnm1"] = matrix.tolist()
    return _chain(entries)


def _chain(entries: list[dict[str, Any]]) -> str:
    content = {f"cam{k}": entry for k, entry in enumerate(entries)}
    text: str = yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
    return text


def _entry(camera: Camera) -> dict[str, Any]:
    centre = given(camera, *CENTRE)
    kind, own = _SHAPES.get(camera.model, ("pinhole", ()))
    distortion = {"opencv": "radtan", "fisheye": "equidistant", "omni": "radtan"}
    model = distortion.get(camera.model, "none")
    return {
        "camera_model": kind,
        "intrinsics": [*given(camera, *own), *centre],
        "distortion_model": model,
        "distortion_coeffs": given(camera, *_DISTORTIONS[model]),
        "resolution": [camera.width, camera.height],
        "rostopic": f"/{camera.id}/image_raw",
    }


def is_kalibr(text: str) -> bool:
    """Whether this is a ``camchain`` file."""
    return "cam0:" in text and "intrinsics:" in text


def read_kalibr(text: str, path: Path) -> Camera:
    """Read the first camera of a chain.

    Raises
    ------
    FormatError
        When the camera is incomplete, or of an unknown model.
    """
    entry: Any = _mapping(text, path).get("cam0")
    try:
        kind, model = str(entry["camera_model"]), str(entry.get("distortion_model", "none"))
        values = [float(v) for v in entry["intrinsics"]]
        found = [float(v) for v in entry.get("distortion_coeffs", ())]
        width, height = (int(v) for v in entry["resolution"])
        registered, own = {"pinhole": ("opencv", ()), **{k: (n, o) for n, (k, o) in _SHAPES.items()}}[kind]
        *shape, fx, fy, cx, cy = values
    except (KeyError, TypeError, ValueError, AttributeError):
        raise FormatError(
            "has no complete camera cam0 of the model pinhole, omni, ds or eucm", where=path
        ) from None
    names, fisheye, size = _DISTORTIONS.get(model), model == "equidistant", (width, height)
    if (
        names is None
        or len(found) not in (len(names), 0)
        or len(shape) != len(own)
        or (fisheye and kind != "pinhole")
    ):
        raise FormatError(f"has the model {kind} with the distortion {model!r}, which is unknown", where=path)
    found = found or [0.0] * len(names)
    plain = opencv_camera(path.stem, size, (fx, fy), (cx, cy), found, path, fisheye=fisheye)
    if kind == "pinhole":
        return plain
    return Camera.of(path.stem, size, registered, plain.parameters | dict(zip(own, shape, strict=True)))


def _mapping(text: str, path: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError:
        raise FormatError("is not YAML", where=path) from None
    if not isinstance(content, dict):
        raise FormatError("has no camera", where=path)
    return content
