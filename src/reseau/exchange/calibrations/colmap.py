"""A line of COLMAP's ``cameras.txt``, and its ``rig_config.json``.

COLMAP counts pixels from the corner of the first one: + 0.5.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...bundle import Camera
from ...core.errors import FormatError
from ...optics.poses import quaternions
from .plain import CENTRE, FISHEYE, RADIAL_TANGENTIAL, RATIONAL, Mounted, opencv_camera

# Models with their parameters, in the order of COLMAP's numbers.
MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": CENTRE,
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": (*CENTRE, *RADIAL_TANGENTIAL),
    "OPENCV_FISHEYE": (*CENTRE, *FISHEYE),
    "FULL_OPENCV": (*CENTRE, *RATIONAL),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
}


def write(camera: Camera) -> str:
    """Return the text of a ``cameras.txt`` with one camera, in the smallest model that holds it."""
    model, values = _model_of(camera)
    head = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    return f"{head}1 {model} {camera.width} {camera.height} {' '.join(map(repr, values))}\n"


def write_rig(rig: Sequence[Mounted]) -> str:
    """Return the text of a ``rig_config.json``: images of each camera are in a folder of its name; m."""
    cameras = []
    for k, mounted in enumerate(rig):
        model, values = _model_of(mounted.camera)
        place: dict[str, Any] = {"ref_sensor": True}
        if k:
            place = {
                "cam_from_rig_rotation": quaternions(mounted.rotation[None])[0].tolist(),
                "cam_from_rig_translation": (1e-3 * mounted.translation).tolist(),
            }
        given = {"camera_model_name": model, "camera_params": values}
        cameras.append({"image_prefix": f"{mounted.camera.id}/"} | place | given)
    return json.dumps([{"cameras": cameras}], indent=2) + "\n"


def _model_of(camera: Camera) -> tuple[str, list[float]]:
    """The smallest model that holds a camera, and its numbers."""
    given = {name: value for name, value in camera.parameters.items() if value}
    if given.get("fx") == given.get("fy"):
        given["f"] = given.get("fx", 0.0)
    fisheye = camera.model == "fisheye"
    holding = (
        (model, names)
        for model, names in MODELS.items()
        if model.endswith("FISHEYE") == fisheye
        and set(given) - {"f", "fx", "fy"} <= set(names)
        and (names[0] == "fx" or "f" in given)
    )
    model, names = min(holding, key=lambda each: len(each[1]))
    return model, [given.get(name, 0.0) + 0.5 * (name in ("cx", "cy")) for name in names]


def recognises(text: str) -> bool:
    """Whether this is such a file."""
    return any(words[1:2] and words[1] in MODELS for words in _lines(text))


def read(text: str, path: Path) -> Camera:
    """Read the only camera.

    Raises
    ------
    FormatError
        When there are several, or its model or numbers are unknown.
    """
    lines = list(_lines(text))
    if len(lines) != 1:
        raise FormatError(f"has {len(lines)} cameras, not one", where=path)
    number, model, width, height, *rest = [*lines[0], *4 * [""]][: max(4, len(lines[0]))]
    names = MODELS.get(model)
    if names is None:
        raise FormatError(f"has the model {model!r}; known are {', '.join(MODELS)}", where=path)
    try:
        values = dict(zip(names, map(float, rest), strict=True))
        size = int(width), int(height)
    except ValueError:
        raise FormatError(f"has not {len(names)} numbers for {model}", where=path) from None
    focal = values.get("fx", values.get("f", 0.0)), values.get("fy", values.get("f", 0.0))
    fisheye = model.endswith("FISHEYE")
    found = [values.get(name, 0.0) for name in (FISHEYE if fisheye else RATIONAL)]
    centre = values["cx"] - 0.5, values["cy"] - 0.5
    return opencv_camera(number, size, focal, centre, found, path, fisheye=fisheye)


def _lines(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
