"""Agisoft Metashape's calibration of a frame camera (XML).

From Metashape's manual, appendix "Camera models"::

    x' = x(1 + K1r² + K2r⁴ + K3r⁶ + K4r⁸) + P1(r² + 2x²) + 2·P2·xy,  u = 0.5w + cx + x'f + x'B1 + y'B2
    y' = y(1 + K1r² + K2r⁴ + K3r⁶ + K4r⁸) + P2(r² + 2y²) + 2·P1·xy,  v = 0.5h + cy + y'f

Its P1, P2 are OpenCV's p2, p1; pixels are counted from the corner of the first one: + 0.5.
"""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from xml.etree import ElementTree

from ...core.errors import FormatError
from .plain import PlainCamera, opencv_camera

__all__ = ["read", "recognises", "write"]


def write(camera: PlainCamera) -> str:
    """Return the text of a calibration."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = camera.of("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    values = {
        "projection": "frame",
        "width": camera.width,
        "height": camera.height,
        "f": fy,
        "cx": cx + 0.5 - camera.width / 2,
        "cy": cy + 0.5 - camera.height / 2,
        "b1": fx - fy,
        "k1": k1,
        "k2": k2,
        "k3": k3,
        "p1": p2,
        "p2": p1,
    }
    lines = "".join(f"  <{name}>{value}</{name}>\n" for name, value in values.items())
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<calibration>\n{lines}</calibration>\n'


def recognises(text: str) -> bool:
    """Whether this is such a file."""
    return "<calibration" in text and "<projection>" in text


def read(text: str, path: Path) -> PlainCamera:
    """Read a calibration.

    Raises
    ------
    FormatError
        When it is not that of a frame camera, is incomplete, or has skew or K4, which OpenCV's model lacks.
    """
    try:
        root = ElementTree.fromstring(text.lstrip("\ufeff"))
    except ElementTree.ParseError:
        raise FormatError("is not XML", where=path) from None
    found = {element.tag: (element.text or "").strip() for element in root.iter()}
    if found.get("projection") != "frame":
        raise FormatError(f"has the projection {found.get('projection')!r}, not 'frame'", where=path)
    try:
        width, height = int(found["width"]), int(found["height"])
        f = float(found["f"])
        names = ("cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
        cx, cy, b1, b2, k1, k2, k3, k4, p1, p2 = (float(found.get(name) or 0.0) for name in names)
    except (KeyError, ValueError):
        raise FormatError("has no complete width, height and f", where=path) from None
    if (b2 or k4) and isfinite(b2 + k4):
        raise FormatError("has B2 or K4, which cannot be read", where=path, do="export it without them")
    centre = cx + width / 2 - 0.5, cy + height / 2 - 0.5
    return opencv_camera(path.stem, (width, height), (f + b1, f), centre, (k1, k2, p2, p1, k3), path)
