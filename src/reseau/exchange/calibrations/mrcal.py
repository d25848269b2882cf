"""mrcal's ``.cameramodel``: a Python dictionary with lens model, intrinsics, extrinsics and image size.

Lens models: ``LENSMODEL_PINHOLE``, ``LENSMODEL_OPENCV4``, ``5``, ``8``, ``12``, ``LENSMODEL_STEREOGRAPHIC``
and ``LENSMODEL_SPLINED_STEREOGRAPHIC_…``. Pixels are counted from the centre of the first one.
"""

from __future__ import annotations

import ast
from math import isfinite
from pathlib import Path

from ...bundle import Camera
from ...core.errors import FormatError, UsageError
from ...optics.cameras.registry import camera_model
from ...optics.cameras.splined import SplinedStereographic
from .plain import CENTRE, RADIAL_TANGENTIAL, RATIONAL, THIN_PRISM, given, opencv_camera

_MODELS: dict[str, tuple[str, ...]] = {
    "LENSMODEL_PINHOLE": (),
    "LENSMODEL_OPENCV4": RADIAL_TANGENTIAL,
    "LENSMODEL_OPENCV5": (*RADIAL_TANGENTIAL, "k3"),
    "LENSMODEL_OPENCV8": RATIONAL,
    "LENSMODEL_OPENCV12": THIN_PRISM,
}
_STEREOGRAPHIC, _SPLINED = "LENSMODEL_STEREOGRAPHIC", "LENSMODEL_SPLINED_STEREOGRAPHIC"
_OURS = "splined_stereographic"


def write(camera: Camera) -> str:
    """Return the text of a camera model, with the camera at the origin."""
    mapping = camera.bare_mapping()
    if isinstance(mapping, SplinedStereographic):
        model, values = _SPLINED + mapping.grid.name.removeprefix(_OURS), given(camera, *mapping.names)
    elif camera.model == "stereographic":
        model, values = _STEREOGRAPHIC, given(camera, *CENTRE)
    else:
        used = {name for name, value in camera.parameters.items() if value and name not in CENTRE}
        model = next(name for name, own in _MODELS.items() if own and used <= set(own))
        values = given(camera, *CENTRE, *_MODELS[model])
    return (
        "{\n"
        f"    'lensmodel':  '{model}',\n\n"
        "    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n"
        f"    'intrinsics': [ {', '.join(map(repr, values))},],\n\n"
        "    # extrinsics are rt_fromref\n"
        "    'extrinsics': [ 0,0,0,0,0,0 ],\n\n"
        f"    'imagersize': [ {camera.width}, {camera.height},]\n"
        "}\n"
    )


def recognises(text: str) -> bool:
    """Whether this is such a file."""
    return "LENSMODEL_" in text


def read(text: str, path: Path) -> Camera:
    """Read a camera.

    Raises
    ------
    FormatError
        When the lens model is unknown, or the file is incomplete.
    """
    try:
        content = ast.literal_eval(text.strip())
        model, numbers = str(content["lensmodel"]), [float(v) for v in content["intrinsics"]]
        width, height = (int(v) for v in content["imagersize"])
    except (SyntaxError, ValueError, KeyError, TypeError, OverflowError, MemoryError, RecursionError):
        # The last two: of the parser, where signs or brackets are nested too deeply.
        raise FormatError("has no complete lensmodel, intrinsics and imagersize", where=path) from None
    if model.startswith(_SPLINED) or model == _STEREOGRAPHIC:
        return _stereographic(path, model, numbers, (width, height))
    names = _MODELS.get(model)
    if names is None:
        raise FormatError(f"has the lens model {model}; known are {', '.join(_MODELS)}", where=path)
    if len(numbers) != 4 + len(names):
        raise FormatError(f"has {len(numbers)} intrinsics, not the {4 + len(names)} of {model}", where=path)
    (fx, fy, cx, cy), found = numbers[:4], numbers[4:]
    return opencv_camera(path.stem, (width, height), (fx, fy), (cx, cy), found, path)


def _stereographic(path: Path, model: str, numbers: list[float], size: tuple[int, int]) -> Camera:
    """The stereographic camera, with or without a spline surface."""
    name = "stereographic" if model == _STEREOGRAPHIC else _OURS + model.removeprefix(_SPLINED)
    try:
        names = CENTRE if model == _STEREOGRAPHIC else camera_model(name).names
    except UsageError as error:
        raise FormatError(f"has the lens model {model}: {error}", where=path) from None
    if len(numbers) != len(names):
        raise FormatError(f"has {len(numbers)} intrinsics, not the {len(names)} of {model}", where=path)
    if not all(isfinite(number) for number in numbers) or min(numbers[:2]) <= 0 or min(size) < 1:
        raise FormatError("has no finite intrinsics and image size", where=path)
    return Camera.of(path.stem, size, name, dict(zip(names, numbers, strict=True)))
