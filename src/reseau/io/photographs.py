"""Photographs as cameras and telephones write them: HEIC, raw files, and what the camera says (Exif).

Pixels are always those of the sensor, in its rows and columns: the orientation in which a viewer shows the
photograph is ignored, so that upright and sideways photographs are of one camera.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.data import filters_of
from ..core.errors import ImageError
from ..core.optional import optional

RAW = (
    ".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw", ".3fr", ".iiq",
)  # fmt: skip
"""Suffixes of raw files."""
PHOTOGRAPHS = (
    ".png", ".jpg", ".jpeg", ".jfif", ".tif", ".tiff", ".bmp", ".dcm", ".heic", ".heif",
    ".webp", ".gif", ".avif", ".jp2", ".j2k", ".pgm", ".ppm", *RAW,
)  # fmt: skip
"""Suffixes of photographs in a folder."""
_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")
_MAKER, _MODEL, _ORIENTATION, _EXIF = 0x010F, 0x0110, 0x0112, 0x8769
_FOCAL, _FOCAL_35, _EXPOSURE, _TAKEN = 0x920A, 0xA405, 0x829A, 0x9003
_DIAGONAL_35 = float(np.hypot(36.0, 24.0))
"""Of the format to which the equivalent focal length refers, mm."""


@dataclass(frozen=True)
class Exif:
    """What a camera says about a photograph.

    Parameters
    ----------
    orientation : int
        How a viewer shows it, 1 to 8; 1 as the sensor has it.
    focal_mm : float, optional
        Focal length.
    focal_35_mm : float, optional
        Focal length of the same field of view in the format of 36 × 24 mm.
    exposure_us : float, optional
        Exposure time.
    day : str
        Day on which it was taken, as 2026-03-05; empty if it is not known.
    camera : str
        Maker and model of the camera; empty if they are not known.

    Examples
    --------
    >>> round(Exif(focal_35_mm=28.0).focal_px(4000, 3000))
    3236
    """

    orientation: int = 1
    focal_mm: float | None = None
    focal_35_mm: float | None = None
    exposure_us: float | None = None
    day: str = ""
    camera: str = ""

    def focal_px(self, width: int, height: int) -> float | None:
        """Approximate focal length in pixels; None if it is not known."""
        if not self.focal_35_mm:
            return None
        return self.focal_35_mm * float(np.hypot(width, height)) / _DIAGONAL_35


def is_heic(magic: bytes) -> bool:
    """Whether a file begins like a HEIC image."""
    return magic[4:8] == b"ftyp" and magic[8:12] in _BRANDS and b"avif" not in magic[12:32]


def is_raw(path: Path) -> bool:
    """Whether a file has the suffix of a raw file.

    Examples
    --------
    >>> is_raw(Path("DSC_0001.NEF"))
    True
    """
    return path.suffix.lower() in RAW


def decoded_heic(path: Path) -> NDArray[Any]:
    """Red, green and blue (h, w, 3) of a HEIC image, as the sensor has them.

    Raises
    ------
    UsageError
        When pillow-heif is missing.
    ImageError
        When the file is damaged.
    """
    with optional():
        import pillow_heif
    try:
        file = pillow_heif.open_heif(str(path), convert_hdr_to_8bit=False)
        pixels = np.asarray(file)
    except (OSError, ValueError, RuntimeError, SyntaxError, EOFError) as error:
        raise ImageError("is a damaged HEIC image", where=path, do="copy it again") from error
    # The decoder turns the image upright.
    shown = file.info.get("original_orientation") or 1
    return np.ascontiguousarray(_as_sensor(pixels, int(shown)))


def _as_sensor(pixels: NDArray[Any], shown: int) -> NDArray[Any]:
    """Undo the orientation in which a viewer shows an image."""
    turned = {3: 2, 6: 1, 8: 3, 5: 1, 7: 3}.get(shown, 0)
    if shown == 4:
        return pixels[::-1]
    if shown in (2, 5, 7):
        pixels = pixels[:, ::-1]
    return np.rot90(pixels, turned)


def decoded_raw(path: Path) -> NDArray[Any]:
    """Red, green and blue (h, w, 3) of a raw file: 16 bit, proportional to the light, as the sensor has them.

    See :func:`mosaic_of_raw` for pixels without interpolation.

    Raises
    ------
    UsageError
        When rawpy is missing.
    ImageError
        When the file is damaged, or of a camera that is not known.
    """
    with _opened_raw(path) as (rawpy, raw):
        pixels = raw.postprocess(
            gamma=(1, 1), no_auto_bright=True, output_bps=16, use_camera_wb=True, user_flip=0,
            output_color=rawpy.ColorSpace.raw,
        )  # fmt: skip
    return np.asarray(pixels)


def mosaic_of_raw(path: Path) -> tuple[NDArray[np.uint16], float, str] | None:
    """Pixels (h, w) of a raw file behind their filters, above black; where they saturate; the filters.

    None if its filters are not red, green, green and blue in cells of 2 × 2 pixels.

    Raises
    ------
    UsageError
        When rawpy is missing.
    ImageError
        When the file is damaged, or of a camera that is not known.
    """
    with _opened_raw(path) as (_, raw):
        pattern, sensor = raw.raw_pattern, np.array(raw.raw_image_visible)
        if pattern is None or pattern.shape != (2, 2) or sensor.ndim != 2:
            return None
        kinds = np.array(raw.raw_colors_visible)
        filters = filters_of("".join(raw.color_desc.decode()[kind] for kind in kinds[:2, :2].ravel()))
        if not filters:
            return None
        black = np.array(raw.black_level_per_channel, np.int64)[kinds]
        full = float(raw.white_level - max(raw.black_level_per_channel))
    return np.clip(sensor - black, 0, full).astype(np.uint16), full, filters


@contextmanager
def _opened_raw(path: Path) -> Iterator[tuple[Any, Any]]:
    """The library, and a raw file."""
    with optional():
        import rawpy
    try:
        with rawpy.imread(str(path)) as raw:
            yield rawpy, raw
    except (rawpy.LibRawError, OSError) as error:
        raise ImageError("is no raw file that can be read", where=path, do="convert it to TIFF") from error


def _tells(path: Path) -> bool:
    """Whether a PNG file has a chunk that may contain what a camera says.

    Pillow decodes all pixels to find it: a sixth of the time for a small frame, seconds for a large one.
    """
    with path.open("rb") as stream:
        stream.seek(8)
        while len(head := stream.read(8)) == 8:
            if head[4:] in (b"eXIf", b"tEXt", b"zTXt", b"iTXt"):
                return True
            stream.seek(int.from_bytes(head[:4], "big") + 4, os.SEEK_CUR)
    return False


def read_exif(path: Path) -> Exif:
    """Read what the camera says; of files without it, or that cannot be read, nothing.

    Examples
    --------
    >>> read_exif(Path("missing.jpg"))
    Exif(orientation=1, focal_mm=None, focal_35_mm=None, exposure_us=None, day='', camera='')
    """
    try:
        from PIL import Image

        if path.suffix.lower() in (".heic", ".heif"):
            import pillow_heif

            pillow_heif.register_heif_opener()
        with Image.open(path) as image:
            if image.format == "PNG" and not _tells(path):
                return Exif()
            found = image.getexif()
            inner = found.get_ifd(_EXIF)
            shown = image.info.get("original_orientation") or found.get(_ORIENTATION) or 1
        day = re.match(r"(\d{4}):(\d\d):(\d\d) ", str(inner.get(_TAKEN, "")))
        numbers = [float(inner[tag]) if tag in inner else None for tag in (_FOCAL, _FOCAL_35, _EXPOSURE)]
    except (OSError, ValueError, SyntaxError, ZeroDivisionError, TypeError, ImportError):
        return Exif()
    focal, equivalent = (v if v is not None and 0.1 < v < 1e4 else None for v in numbers[:2])
    seconds = numbers[2] if numbers[2] is not None and 0 < numbers[2] < 1e5 else None
    exposure = None if seconds is None else seconds * 1e6
    taken = "" if day is None else "-".join(day.groups())
    maker, model = (str(found.get(tag, "")).strip(" \0") for tag in (_MAKER, _MODEL))
    # Many models repeat the name of their maker.
    camera = model if model.lower().startswith(maker.lower()) else f"{maker} {model}".strip()
    return Exif(int(shown) if shown in range(1, 9) else 1, focal, equivalent, exposure, taken, camera)
