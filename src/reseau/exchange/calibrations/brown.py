"""Cameras with Brown's distortion: PhotoModeler's text export, cameras of DBAT and MicMac (XML).

The first two correct measured coordinates: c, principal point from the upper left corner of the format, K1,
K2, K3, P1, P2, in mm; MicMac's are in pixels. A camera of PhotoModeler is written as the head of its text
export, which DBAT reads; into PhotoModeler itself the numbers are typed (Camera Viewer).
"""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from pathlib import Path

from ...bundle import Camera
from ...core.errors import FormatError
from ..dbat import camera_of as dbat_camera
from ..lines import is_number
from ..markup import read_markup
from ..photomodeler import camera_of_numbers
from .plain import CENTRE, given

BROWN = ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2")
"""Parameters that both have."""
_HEAD, _CAMERA_LINE = 4, 10


def in_pixels(
    values: Mapping[str, float], size: tuple[int, int], pitch_mm: tuple[float, float]
) -> dict[str, float]:
    """Parameters of OpenCV's model of a camera with Brown's distortion of ideal points.

    Examples
    --------
    >>> found = in_pixels({"c": 8.0, "K1": 1e-3}, (640, 480), (0.01, 0.01))
    >>> round(found["fx"], 6), round(found["k1"], 6), found["cx"]
    (800.0, 0.064, 319.5)
    """
    c, x0, y0, k1, k2, k3, p1, p2 = (values.get(name, 0.0) for name in BROWN)
    found = {
        "fx": c / pitch_mm[0], "fy": c / pitch_mm[1],
        "cx": x0 / pitch_mm[0] + (size[0] - 1) / 2, "cy": (size[1] - 1) / 2 - y0 / pitch_mm[1],
        "k1": k1 * c**2, "k2": k2 * c**4, "p1": -p2 * c, "p2": p1 * c, "k3": k3 * c**6,
    }  # fmt: skip
    return {name: value for name, value in found.items() if value or name in CENTRE}


def write_photomodeler(camera: Camera) -> str:
    """Return the head of a text export, without images."""
    wide, tall = _format(camera)
    c, x0, y0, *more = given(camera, *BROWN)
    values = [c, x0 + wide / 2, tall / 2 - y0, wide, tall, *more]
    lines = [
        camera.id or "camera",
        f"1e-06 20 {camera.width} {camera.height}",
        "1.0",
        " ".join(map(repr, values)),
        " ".join(["0.0"] * 10),
    ]
    return "\n".join(lines) + "\n"


def is_photomodeler(text: str) -> bool:
    """Whether this is such a file."""
    lines = [line.split() for line in text.splitlines() if line.strip()]
    counts = [len(line) if all(map(is_number, line)) else -1 for line in lines[1:5]]
    return len(counts) >= 3 and counts[0] == _HEAD and counts[2] == _CAMERA_LINE


def read_photomodeler(text: str, path: Path) -> Camera:
    """Read the camera at the head of a text export.

    Raises
    ------
    FormatError
        When a number is not positive where it must be.
    """
    lines = [line.split() for line in text.splitlines() if line.strip()]
    values = [float(word) for word in lines[3]]
    width, height = int(float(lines[1][2])), int(float(lines[1][3]))
    if min(values[0], values[3], values[4]) <= 0 or min(width, height) < 1:
        raise FormatError("has a camera constant, a format or a size that is not positive", where=path)
    return camera_of_numbers(path.stem, values, width, height)


def write_dbat(camera: Camera) -> str:
    """Return the text of a file of cameras with one camera."""
    wide, tall = _format(camera)
    c, x0, y0, k1, k2, k3, p1, p2 = given(camera, *BROWN)
    aspect = camera.pitch_mm[1] / camera.pitch_mm[0]
    entries = {
        "id": "1", "name": escape(camera.id, quote=False), "unit": "mm", "sensor": f"{wide!r},{tall!r}",
        "image": f"{camera.width},{camera.height}", "aspect": repr(aspect), "focal": repr(c), "model": "3",
        "nK": "3", "nP": "2", "cc": repr(c), "pp": f"{(x0 + wide / 2) * aspect!r},{tall / 2 - y0!r}",
        "K": f"{k1!r},{k2!r},{k3!r}", "P": f"{p1!r},{p2!r}", "skew": "0",
    }  # fmt: skip
    lines = "".join(f"      <{key}>{value}</{key}>\n" for key, value in entries.items())
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document dbat_script_version="1.0">\n  <cameras>\n'
        f"    <camera>\n{lines}    </camera>\n  </cameras>\n</document>\n"
    )


def is_dbat(text: str) -> bool:
    """Whether this is such a file."""
    return "<camera>" in text and "<sensor>" in text and ("<cc>" in text or "<focal>" in text)


def read_dbat(text: str, path: Path) -> Camera:
    """Read the only camera.

    Raises
    ------
    FormatError
        When there are several, it is incomplete, or of a lens model that is not read.
    """
    root = read_markup(path)
    cameras = root if root.tag == "cameras" else root.find("cameras") or root.need("input/cameras")
    found = list(cameras.all("camera"))
    if len(found) != 1:
        raise FormatError(f"has {len(found)} cameras, not one", where=path)
    name = found[0].find("name")
    return dbat_camera(found[0], path.stem if name is None or not name.text else name.text, ())


def is_micmac(text: str) -> bool:
    """Whether this is such a file."""
    return "<CalibrationInternConique>" in text


def _format(camera: Camera) -> tuple[float, float]:
    """Size of the image, mm."""
    return camera.width * camera.pitch_mm[0], camera.height * camera.pitch_mm[1]
