"""OpenPTV's calibration: ``.ori`` with pose and interior orientation, ``.addpar`` with the distortion.

Size of the image and of its pixels are in ``ptv.par``, where OpenPTV has them; a file written here repeats
them in a line after the numbers, which OpenPTV does not read. The pose is that of the camera itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ...bundle import Camera
from ...core.errors import FormatError
from ...io import read_text
from .plain import given

OPENPTV = ("c", "x0", "y0", "K1", "K2", "K3", "P1", "P2", "B1", "she")
BESIDE = ".addpar"
_NUMBERS = 21
_SIZE = "# imx imy pix_x pix_y of ptv.par:"


def write(camera: Camera) -> str:
    """Return the text of the ``.ori`` file."""
    c, x0, y0 = given(camera, "c", "x0", "y0")
    size = f"{camera.width} {camera.height} {camera.pitch_mm[0]!r} {camera.pitch_mm[1]!r}"
    return (
        "0.0 0.0 0.0\n    0.0 0.0 0.0\n\n    1.0 0.0 0.0\n    0.0 1.0 0.0\n    0.0 0.0 1.0\n\n"
        f"    {x0!r} {y0!r}\n    {c!r}\n\n    0.0 0.0 1.0\n{_SIZE} {size}\n"
    )


def write_beside(camera: Camera) -> str:
    """Return the text of the ``.addpar`` file: k1 k2 k3 p1 p2 scx she."""
    *distortion, b1, she = given(camera, *OPENPTV[3:])
    return " ".join(map(repr, [*distortion, 1.0 + b1, she])) + "\n"


def recognises(text: str) -> bool:
    """Whether this is an ``.ori`` file: 3, 3, 3 × 3, 2, 1 and 3 numbers."""
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [len(line) for line in lines[:8]] == [3, 3, 3, 3, 3, 2, 1, 3] and len(lines) == 8


def read(text: str, path: Path, free: Sequence[str] = ()) -> Camera:
    """Read a camera, with the ``.addpar`` file and ``ptv.par`` beside it.

    Raises
    ------
    FormatError
        When a number is missing, or the size of the image is found nowhere.
    """
    head, _, size = text.partition(_SIZE)
    addpar = path.with_suffix(BESIDE)
    try:
        numbers = [float(word) for word in head.split()]
        x0, y0, c = numbers[15:18]
        more = [float(word) for word in read_text(addpar).split()] if addpar.is_file() else []
        k1, k2, k3, p1, p2, scx, she = more[:7] or [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    except ValueError:
        raise FormatError(f"has not {_NUMBERS} numbers, or its {BESIDE} file not 7", where=path) from None
    width, height, *pitch = [float(word) for word in size.split()] or _sizes(path)
    if not c > 0:
        raise FormatError("has a principal distance that is not positive", where=path)
    values = dict(zip(OPENPTV, (c, x0, y0, k1, k2, k3, p1, p2, scx - 1.0, she), strict=True))
    size_px = int(width), int(height)
    return Camera.of(path.stem, size_px, "openptv", values, free, pitch_mm=(pitch[0], pitch[1]))


def _sizes(path: Path) -> list[float]:
    """Size of image and pixels, from ``ptv.par``."""
    for folder in (path.parent, path.parent / "parameters", path.parent.parent / "parameters"):
        file = folder / "ptv.par"
        if file.is_file():
            words = read_text(file).split()
            try:
                # The number of cameras, two names of each, and three flags come first.
                first = 1 + 2 * int(words[0]) + 3
                return [float(word) for word in words[first : first + 4]]
            except (ValueError, IndexError):
                raise FormatError("has no imx, imy, pix_x and pix_y", where=file) from None
    raise FormatError(
        "has no size of image and pixels", where=path, do="put ptv.par beside it, or into parameters/"
    )
