"""Agisoft Metashape's calibration of a frame camera or a fisheye (XML).

From Metashape's manual, appendix "Camera models"::

    x' = x(1 + K1r² + K2r⁴ + K3r⁶ + K4r⁸) + P1(r² + 2x²) + 2·P2·xy,  u = 0.5w + cx + x'f + x'B1 + y'B2
    y' = y(1 + K1r² + K2r⁴ + K3r⁶ + K4r⁸) + P2(r² + 2y²) + 2·P1·xy,  v = 0.5h + cy + y'f

Its P1, P2 are OpenCV's p2, p1; pixels are counted from the corner of the first one: + 0.5.

A fisheye (in newer versions also called equidistant fisheye) has x·θ/r, y·θ/r for x, y, with the angle
θ = atan r to the axis and r² = x² + y²: without P1, P2 and B2 it is OpenCV's.
"""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from xml.etree import ElementTree

from ...bundle import Camera
from ...core.errors import FormatError
from .plain import given, opencv_camera

_FISHEYE = ("fisheye", "equidistant_fisheye")


def write(camera: Camera) -> str:
    """Return the text of a calibration."""
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")
    fx, fy, cx, cy, k1, k2, k3, k4, p1, p2 = given(camera, *names)
    values = {
        "projection": "fisheye" if camera.model == "fisheye" else "frame",
        "width": camera.width,
        "height": camera.height,
        "f": fy,
        "cx": cx + 0.5 - camera.width / 2,
        "cy": cy + 0.5 - camera.height / 2,
        "b1": fx - fy,
        "k1": k1,
        "k2": k2,
        "k3": k3,
        "k4": k4,
        "p1": p2,
        "p2": p1,
    }
    lines = "".join(f"  <{name}>{value}</{name}>\n" for name, value in values.items())
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<calibration>\n{lines}</calibration>\n'


def recognises(text: str) -> bool:
    """Whether this is such a file."""
    return "<calibration" in text and "<projection>" in text


def read(text: str, path: Path) -> Camera:
    """Read a calibration.

    Raises
    ------
    FormatError
        When it is that of another projection, is incomplete, or has skew, K4 of a frame camera, or P1 and P2
        of a fisheye, which OpenCV's models lack.
    """
    try:
        root = ElementTree.fromstring(text.lstrip("\ufeff"))
    except ElementTree.ParseError:
        raise FormatError("is not XML", where=path) from None
    found = {element.tag: (element.text or "").strip() for element in root.iter()}
    if found.get("projection") not in ("frame", *_FISHEYE):
        what = f"has the projection {found.get('projection')!r}, not 'frame' or 'fisheye'"
        raise FormatError(what, where=path)
    fisheye = found["projection"] in _FISHEYE
    try:
        width, height = int(found["width"]), int(found["height"])
        f = float(found["f"])
        names = ("cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
        cx, cy, b1, b2, k1, k2, k3, k4, p1, p2 = (float(found.get(name) or 0.0) for name in names)
    except (KeyError, ValueError):
        raise FormatError("has no complete width, height and f", where=path) from None
    lacking = {"B2": b2, "P1 or P2 of a fisheye": p1 or p2} if fisheye else {"B2": b2, "K4": k4}
    for what, value in lacking.items():
        if value and isfinite(value):
            raise FormatError(f"has {what}, which cannot be read", where=path, do="export it without")
    centre = cx + width / 2 - 0.5, cy + height / 2 - 0.5
    given = (k1, k2, k3, k4) if fisheye else (k1, k2, p2, p1, k3)
    return opencv_camera(path.stem, (width, height), (f + b1, f), centre, given, path, fisheye=fisheye)
