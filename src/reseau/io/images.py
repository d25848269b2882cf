"""Image files in and out: PNG, JPEG and TIFF, 8 and 16 bit, bounded in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..core.data import Frame
from ..core.errors import ImageError, InputError
from ..core.provenance import sha256_of
from . import write_whole

__all__ = ["MAX_PIXELS", "Channel", "decoded", "read_frame", "write_image"]

MAX_PIXELS = 500_000_000
"""The largest image that is read whole; the header is asked before a pixel is decoded."""

_GREY = np.array([0.114, 0.587, 0.299])  # Rec. 601 luma, in OpenCV's order blue, green, red


Channel = Literal["luma", "red", "green", "blue"]
_BGR: tuple[Channel, ...] = ("blue", "green", "red")


def read_frame(path: Path | str, channel: Channel = "luma") -> Frame:
    """Read an image file as a grey frame; values keep their scale.

    Parameters
    ----------
    path : path
        PNG, JPEG, TIFF (any size and compression that tifffile knows) or BMP.
    channel : {"luma", "red", "green", "blue"}
        What is taken of a colour image. A lens images colours at slightly different scales; in one channel
        that shifts nothing.

    Raises
    ------
    InputError
        When the file cannot be read.
    ImageError
        When it is no image, a damaged one, or larger than `MAX_PIXELS`.
    """
    path = Path(path)
    digest = sha256_of(path)
    with path.open("rb") as stream:
        magic = stream.read(32)
    if magic[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        pixels, full_scale = _read_tiff(path, channel)
    else:
        pixels, full_scale = _read_coded(path, magic, channel)
    return Frame(pixels, full_scale, path.name, digest)


def _too_large(path: Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise ImageError(f"has {width}×{height} pixels, more than {MAX_PIXELS:,}", where=path, do="crop it")


def _full_scale(dtype: np.dtype[Any], path: Path) -> float:
    if dtype.kind == "u" and dtype.itemsize <= 2:
        return float(np.iinfo(dtype).max)
    if dtype == np.int16:  # as planetary archives store 12 and more bits
        return 32767.0
    if dtype.kind == "f":
        return 1.0
    raise ImageError(f"has grey values of type {dtype}", where=path, do="convert it to 8 or 16 bit grey")


def _read_tiff(path: Path, channel: Channel) -> tuple[NDArray[Any], float]:
    import tifffile

    try:
        with tifffile.TiffFile(path) as tiff:
            page = tiff.pages.first
            _too_large(path, page.imagewidth, page.imagelength)
            colour = tifffile.PHOTOMETRIC(page.photometric).name
            if colour not in ("MINISBLACK", "MINISWHITE", "RGB"):
                raise ImageError(f"is a TIFF of colour {colour}", where=path, do="convert it to grey or RGB")
            pixels = page.asarray()
    except ImageError:
        raise
    except Exception as error:  # tifffile and its codecs raise of every kind on damaged files
        raise ImageError(f"is a damaged TIFF ({error})", where=path) from None
    if pixels.dtype == bool:
        pixels = pixels.astype(np.uint8) * np.uint8(255)
    full_scale = _full_scale(pixels.dtype, path)
    if pixels.ndim == 3 and pixels.shape[2] in (3, 4):
        pixels = _grey(pixels[:, :, 2::-1], channel)
    return (np.iinfo(pixels.dtype).max - pixels if colour == "MINISWHITE" else pixels), full_scale


def _grey(bgr: NDArray[Any], channel: Channel) -> NDArray[Any]:
    if channel != "luma":
        return np.ascontiguousarray(bgr[:, :, _BGR.index(channel)])
    grey = np.zeros(bgr.shape[:2], dtype=np.float32)
    for k, weight in enumerate(_GREY):
        grey += np.float32(weight) * bgr[:, :, k]
    return grey if bgr.dtype.kind == "f" else np.rint(grey).astype(bgr.dtype)


def _header_size(magic: bytes, path: Path) -> tuple[int, int]:
    """Width and height that the header of a PNG, JPEG or BMP promises."""
    if magic.startswith(b"\x89PNG\r\n\x1a\n"):
        return int.from_bytes(magic[16:20], "big"), int.from_bytes(magic[20:24], "big")
    if magic.startswith(b"BM"):
        return (
            abs(int.from_bytes(magic[18:22], "little", signed=True)),
            abs(int.from_bytes(magic[22:26], "little", signed=True)),
        )
    if magic.startswith(b"\xff\xd8"):
        with path.open("rb") as stream:
            stream.seek(2)
            while len(head := stream.read(4)) == 4 and head[0] == 0xFF:
                length = int.from_bytes(head[2:], "big")
                if 0xC0 <= head[1] <= 0xCF and head[1] not in (0xC4, 0xC8, 0xCC):
                    sizes = stream.read(5)
                    return int.from_bytes(sizes[3:5], "big"), int.from_bytes(sizes[1:3], "big")
                stream.seek(length - 2, 1)
        raise ImageError("is a damaged JPEG", where=path)
    raise ImageError("is no PNG, JPEG, TIFF or BMP image", where=path)


def _read_coded(path: Path, magic: bytes, channel: Channel) -> tuple[NDArray[Any], float]:
    pixels = decoded(path, magic)
    full_scale = _full_scale(pixels.dtype, path)
    return (_grey(pixels, channel) if pixels.ndim == 3 else pixels), full_scale


def decoded(path: Path, magic: bytes) -> NDArray[Any]:
    """Pixels of a PNG, JPEG or BMP with the given first bytes: (h, w), or (h, w, c) in the order BGR.

    Raises
    ------
    ImageError
        When it is none of these, damaged, truncated or too large.
    """
    import cv2

    _too_large(path, *_header_size(magic, path))
    coded = np.fromfile(path, dtype=np.uint8)
    # The decoder fills what a truncated file lacks with grey and says nothing: ask for the end mark.
    end = {b"\x89P": b"IEND", b"\xff\xd8": b"\xff\xd9"}.get(magic[:2], b"")
    if end not in coded[-4096:].tobytes():
        raise ImageError("is a truncated image", where=path, do="copy it anew")
    try:
        pixels = cv2.imdecode(coded, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise ImageError("is a damaged image", where=path)
    return np.asarray(pixels)


def write_image(path: Path | str, pixels: NDArray[Any]) -> None:
    """Write a grey (h, w) or RGB (h, w, 3) image, whole or not at all; the suffix says the kind.

    Raises
    ------
    InputError
        When the suffix is none of PNG, JPEG, TIFF, or the place cannot be written to.
    """
    import cv2

    path = Path(path)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg", ".tif", ".tiff"):
        raise InputError("has no suffix of an image", where=path, do="use .png, .jpg or .tif")
    options = [cv2.IMWRITE_PNG_COMPRESSION, 6] if path.suffix.lower() == ".png" else []
    _, coded = cv2.imencode(path.suffix, pixels[:, :, ::-1] if pixels.ndim == 3 else pixels, options)
    write_whole(path, coded.tobytes())
