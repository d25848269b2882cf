"""The ``Calib_Results.m`` of the Camera Calibration Toolbox for Matlab.

Bouguet, J.-Y., Camera Calibration Toolbox for Matlab, "Description of the calibration parameters": fc, cc,
alpha_c, kc = [k1 k2 p1 p2 k3]; pixels are counted from the centre of the first one. In MATLAB the
script assigns these variables; ``cameraIntrinsics(fc, cc + 1, [ny nx], RadialDistortion = kc([1 2 5]),
TangentialDistortion = kc([3 4]))`` makes the object of its Computer Vision Toolbox, which counts from one.
"""

from __future__ import annotations

import re
from pathlib import Path

from ...bundle import Camera
from ...core.errors import FormatError
from .plain import CENTRE, RADIAL_TANGENTIAL, given, opencv_camera

_ASSIGNED = re.compile(r"^\s*(\w+)\s*=\s*(\[[^\]]*\]|[^;%\n]+)", re.MULTILINE)


def write(camera: Camera) -> str:
    """Return the text of the script."""
    fx, fy, cx, cy = (repr(v) for v in given(camera, *CENTRE))
    kc = " ; ".join(repr(v) for v in given(camera, *RADIAL_TANGENTIAL, "k3"))
    return (
        f"% Camera {camera.id}; pixels are counted from the centre of the first one, which is (0, 0).\n"
        f"fc = [ {fx} ; {fy} ];\ncc = [ {cx} ; {cy} ];\nalpha_c = 0.0;\nkc = [ {kc} ];\n"
        f"nx = {camera.width};\nny = {camera.height};\n"
        "% intrinsics = cameraIntrinsics(fc', cc' + 1, [ny nx], RadialDistortion = kc([1 2 5])', "
        "TangentialDistortion = kc([3 4])');\n"
    )


def recognises(text: str) -> bool:
    """Whether this is such a file."""
    return {"fc", "cc", "kc"} <= {name for name, _ in _ASSIGNED.findall(text)}


def read(text: str, path: Path) -> Camera:
    """Read a camera.

    Raises
    ------
    FormatError
        When a variable is missing, or the pixels are not rectangular.
    """
    known = dict(_ASSIGNED.findall(text))
    try:
        fc, cc, kc, skew, nx, ny = (
            [float(v) for v in re.split(r"[\s;,]+", known[name].strip(" []")) if v]
            for name in ("fc", "cc", "kc", "alpha_c", "nx", "ny")
        )
        (fx, fy), (cx, cy), (width,), (height,) = fc, cc, nx, ny
    except (KeyError, ValueError):
        raise FormatError("has no complete fc, cc, kc, alpha_c, nx and ny", where=path) from None
    if any(skew):
        raise FormatError("has a skew alpha_c, which cannot be read", where=path)
    return opencv_camera(path.stem, (int(width), int(height)), (fx, fy), (cx, cy), kc, path)
