"""Agisoft Metashape's calibration of a frame camera or a fisheye (XML).

From Metashape's manual, appendix "Camera models"::

    x' = x(1 + K1r² + K2r⁴ + K3r⁶ + K4r⁸) + P1(r² + 2x²) + 2·P2·xy,  u = 0.5w + cx + x'f + x'B1 + y'B2
    y' = y(1 + K1r² + K2r⁴ + K3r⁶ + K4r⁸) + P2(r² + 2y²) + 2·P1·xy,  v = 0.5h + cy + y'f

Its P1, P2 are OpenCV's p2, p1; pixels are counted from the corner of the first one: + 0.5.

A fisheye (in newer versions also called equidistant fisheye) has x·θ/r, y·θ/r for x, y, with the angle
θ = atan r to the axis and r² = x² + y²: without P1, P2 and B2 it is OpenCV's.
"""

from __future__ import annotations

from pathlib import Path

from ...bundle import Camera
from ..markup import read_markup
from ..metashape import camera_of, values_of
from .plain import given


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
        When it is that of another projection, is incomplete, or has what no camera here describes; see
        :func:`reseau.exchange.metashape.read_metashape`.
    """
    root = read_markup(path, text.lstrip("\ufeff").encode())
    given = root if root.tag == "calibration" else root.need(".//calibration")
    size = int(given.value("width")), int(given.value("height"))
    kind = given.need("projection").text.removeprefix("equidistant_")
    return camera_of(path.stem, size, kind, values_of(given), path, {"fixed": "true"})
