"""A line of COLMAP's ``cameras.txt``. COLMAP counts pixels from the corner of the first one: + 0.5."""

from __future__ import annotations

from pathlib import Path

from ...core.errors import FormatError
from .plain import RADIAL_TANGENTIAL, RATIONAL, PlainCamera, opencv_camera

__all__ = ["read", "recognises", "write"]

_CENTRE = ("fx", "fy", "cx", "cy")
_FISHEYE = ("k1", "k2", "k3", "k4")
# Models with their parameters; those with one focal length, and simpler ones, are read only.
_MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": _CENTRE,
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": (*_CENTRE, *RADIAL_TANGENTIAL),
    "FULL_OPENCV": (*_CENTRE, *RATIONAL),
    "OPENCV_FISHEYE": (*_CENTRE, *_FISHEYE),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
}


def write(camera: PlainCamera) -> str:
    """Return the text of a ``cameras.txt`` with one camera."""
    if camera.model == "fisheye":
        model = "OPENCV_FISHEYE"
    else:
        rational = any(camera.values.get(name, 0.0) for name in RATIONAL[4:])
        model = "FULL_OPENCV" if rational else "OPENCV"
    names = _MODELS[model]
    values = [v + 0.5 * (name in ("cx", "cy")) for name, v in zip(names, camera.of(*names), strict=True)]
    head = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    return f"{head}1 {model} {camera.width} {camera.height} {' '.join(map(repr, values))}\n"


def recognises(text: str) -> bool:
    """Whether this is such a file."""
    return any(words[1:2] and words[1] in _MODELS for words in _lines(text))


def read(text: str, path: Path) -> PlainCamera:
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
    names = _MODELS.get(model)
    if names is None:
        raise FormatError(f"has the model {model!r}; known are {', '.join(_MODELS)}", where=path)
    try:
        values = dict(zip(names, map(float, rest), strict=True))
        size = int(width), int(height)
    except ValueError:
        raise FormatError(f"has not {len(names)} numbers for {model}", where=path) from None
    focal = values.get("fx", values.get("f", 0.0)), values.get("fy", values.get("f", 0.0))
    fisheye = model.endswith("FISHEYE")
    found = [values.get(name, 0.0) for name in (_FISHEYE if fisheye else RATIONAL)]
    centre = values["cx"] - 0.5, values["cy"] - 0.5
    return opencv_camera(number, size, focal, centre, found, path, fisheye=fisheye)


def _lines(text: str) -> list[list[str]]:
    return [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
