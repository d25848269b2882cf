"""Calibrations of Basalt (JSON): ``pinhole``, ``pinhole-radtan8``, ``kb4``, ``ds``, ``eucm`` and ``ucm``.

Pixels are counted from the centre of the first one. Of a calibration of Basalt, which has cameras and an
inertial sensor, the first camera is read. What is written has a camera at the place of an inertial sensor
without errors: its numbers are to be filled in.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import numpy as np

from ...bundle import Camera
from ...core.errors import FormatError
from .plain import CENTRE, FISHEYE, RATIONAL, given

_TYPES: Final[dict[str, tuple[str, tuple[str, ...]]]] = {
    "pinhole": ("opencv", CENTRE),
    "pinhole-radtan8": ("opencv", (*CENTRE, *RATIONAL)),
    "kb4": ("fisheye", (*CENTRE, *FISHEYE)),
    "ds": ("double_sphere", (*CENTRE, "xi", "alpha")),
    "eucm": ("eucm", (*CENTRE, "alpha", "beta")),
    "ucm": ("eucm", (*CENTRE, "alpha")),
}
"""Types of cameras: registered models, and parameters."""
_INERTIAL = {
    "calib_accel_bias": 9, "calib_gyro_bias": 12, "accel_noise_std": 3, "gyro_noise_std": 3,
    "accel_bias_std": 3, "gyro_bias_std": 3,
}  # fmt: skip


def write(camera: Camera) -> str:
    """Return the text of a calibration with one camera."""
    kind = next(
        name
        for name, (model, names) in _TYPES.items()
        if model == camera.model and all(k in names for k, value in camera.parameters.items() if value)
    )
    values = dict(zip(_TYPES[kind][1], given(camera, *_TYPES[kind][1]), strict=True))
    if kind == "pinhole-radtan8":
        corners = np.array([[x, y] for x in (0, camera.width - 1) for y in (0, camera.height - 1)])
        # The largest tangent of an angle from the axis for which the model is meant.
        values["rpmax"] = float(np.hypot(*camera.bare_mapping().inverse(corners).T).max())
    pose = dict.fromkeys(("px", "py", "pz", "qx", "qy", "qz"), 0.0) | {"qw": 1.0}
    content = {
        "T_imu_cam": [pose],
        "intrinsics": [{"camera_type": kind, "intrinsics": values}],
        "resolution": [[camera.width, camera.height]],
        "vignette": [],
        **{name: [0.0] * count for name, count in _INERTIAL.items()},
        "imu_update_rate": 0.0,
        "cam_time_offset_ns": 0,
    }
    return json.dumps({"value0": content}, indent=2) + "\n"


def recognises(text: str) -> bool:
    """Whether this is a calibration of Basalt."""
    return '"value0"' in text and '"camera_type"' in text


def read(text: str, path: Path) -> Camera:
    """Read the first camera.

    Raises
    ------
    FormatError
        When it is incomplete, or of an unknown type.
    """
    try:
        content: Any = json.loads(text)["value0"]
        kind, given = (content["intrinsics"][0][key] for key in ("camera_type", "intrinsics"))
        width, height = (int(n) for n in content["resolution"][0])
    except (ValueError, KeyError, TypeError, IndexError):
        raise FormatError("has no complete intrinsics and resolution of a camera", where=path) from None
    if kind not in _TYPES:
        raise FormatError(f"has the camera type {kind!r}; known are {', '.join(_TYPES)}", where=path)
    model, names = _TYPES[kind]
    try:
        values = {name: float(given[name]) for name in names}
    except (KeyError, TypeError, ValueError):
        values = {}
    if not values or not np.isfinite(list(values.values())).all():
        raise FormatError(f"has not all of {', '.join(names)} of the type {kind}", where=path)
    if kind == "ucm":
        values["beta"] = 1.0
    return Camera.of(path.stem, (width, height), model, values)
