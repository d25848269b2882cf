"""Pixel formats of cameras, and conversion between the bytes of a frame and unmodified grey values.

Sources: the kernel's *Linux Media Infrastructure userspace API*, "Image Formats"; EMVA, *Pixel Format Naming
Convention* 2.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau.core.errors import ProtocolError

__all__ = ["GENICAM", "VIDEO", "PixelFormat", "decode", "encode", "size_of"]


@dataclass(frozen=True)
class PixelFormat:
    """Memory layout of grey values.

    Parameters
    ----------
    code : str or int
        Four characters of V4L2, or the number of the Pixel Format Naming Convention.
    bits : int
        Significant bits of a grey value, in the low bits of its bytes.
    stored : int
        Bytes per pixel; 0 for compressed frames.
    pattern : str
        Colour pattern of raw data: filters of the first two rows (RGGB …), YUYV or MJPEG; empty for grey.
    """

    code: str | int
    bits: int
    stored: int
    pattern: str = ""

    @property
    def full_scale(self) -> float:
        """Grey value at saturation."""
        return float(2**self.bits - 1)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Data type of the grey values."""
        return np.dtype(np.uint8 if self.bits <= 8 else "<u2")


VIDEO: dict[str, PixelFormat] = {
    "GREY": PixelFormat("GREY", 8, 1),
    "Y10": PixelFormat("Y10 ", 10, 2),
    "Y12": PixelFormat("Y12 ", 12, 2),
    "Y16": PixelFormat("Y16 ", 16, 2),
    "YUYV": PixelFormat("YUYV", 8, 2, "YUYV"),
    "MJPEG": PixelFormat("MJPG", 8, 0, "MJPEG"),
    "SRGGB8": PixelFormat("RGGB", 8, 1, "RGGB"),
    "SGRBG8": PixelFormat("GRBG", 8, 1, "GRBG"),
    "SGBRG8": PixelFormat("GBRG", 8, 1, "GBRG"),
    "SBGGR8": PixelFormat("BA81", 8, 1, "BGGR"),
}
"""Formats of V4L2, by the names of its documentation."""

GENICAM: dict[str, PixelFormat] = {
    "Mono8": PixelFormat(0x01080001, 8, 1),
    "Mono10": PixelFormat(0x01100003, 10, 2),
    "Mono12": PixelFormat(0x01100005, 12, 2),
    "Mono14": PixelFormat(0x01100025, 14, 2),
    "Mono16": PixelFormat(0x01100007, 16, 2),
    "BayerGR8": PixelFormat(0x01080008, 8, 1, "GRBG"),
    "BayerRG8": PixelFormat(0x01080009, 8, 1, "RGGB"),
    "BayerGB8": PixelFormat(0x0108000A, 8, 1, "GBRG"),
    "BayerBG8": PixelFormat(0x0108000B, 8, 1, "BGGR"),
    "BayerGR12": PixelFormat(0x01100010, 12, 2, "GRBG"),
    "BayerRG12": PixelFormat(0x01100011, 12, 2, "RGGB"),
    "BayerGB12": PixelFormat(0x01100012, 12, 2, "GBRG"),
    "BayerBG12": PixelFormat(0x01100013, 12, 2, "BGGR"),
}
"""Formats of GenICam, by the names of the convention."""


def size_of(layout: PixelFormat, width: int, height: int, stride: int = 0) -> int:
    """Return the size of a frame with rows `stride` bytes apart (bytes); 0 if compressed."""
    if not layout.stored:
        return 0
    row = width * layout.stored
    return (height - 1) * max(stride, row) + row


def decode(layout: PixelFormat, width: int, height: int, data: bytes, stride: int = 0) -> NDArray[Any]:
    """Decode the grey values of a frame: luminance of YUYV and MJPEG, all raw pixels of a mosaic.

    Parameters
    ----------
    layout : PixelFormat
        Format of the data.
    width, height : int
        Size of the frame (px).
    data : bytes
        The frame; further bytes are ignored.
    stride : int, optional
        Bytes from one row to the next.

    Returns
    -------
    ndarray (height, width)
        A view of `data` if no conversion is needed.

    Raises
    ------
    ProtocolError
        If there are too few bytes, or grey values exceed the number of bits.

    Examples
    --------
    >>> decode(VIDEO["Y10"], 2, 1, bytes([0x01, 0x02, 0xFF, 0x03]))
    array([[ 513, 1023]], dtype=uint16)
    >>> decode(VIDEO["YUYV"], 2, 1, bytes([16, 128, 235, 128]))
    array([[ 16, 235]], dtype=uint8)
    """
    if not layout.stored:
        return _jpeg(width, height, data)
    need = size_of(layout, width, height, stride)
    if len(data) < need or min(width, height) < 1:
        raise ProtocolError(f"a frame of {width}×{height} pixels has {len(data)} of {need} bytes")
    row = max(stride, width * layout.stored)
    raw = np.frombuffer(data, np.uint8, need)
    rows = np.lib.stride_tricks.as_strided(raw, (height, width * layout.stored), (row, 1), writeable=False)
    if layout.pattern == "YUYV":
        return rows[:, ::2]
    pixels = rows if layout.stored == 1 else _words(rows)
    if layout.stored == 2 and layout.bits < 16 and int(pixels.max()) >> layout.bits:
        raise ProtocolError(f"a frame of {layout.bits} bits contains the grey value {int(pixels.max())}")
    return pixels


def _words(rows: NDArray[np.uint8]) -> NDArray[Any]:
    if rows.strides[0] % 2:
        rows = np.ascontiguousarray(rows)
    return rows.view("<u2")


def _jpeg(width: int, height: int, data: bytes) -> NDArray[Any]:
    # Decoders silently fill the missing part of a truncated picture with grey: check the end mark.
    if not (data.startswith(b"\xff\xd8") and data.rstrip(b"\0").endswith(b"\xff\xd9")):
        raise ProtocolError(f"a frame of {len(data)} bytes is not a complete JPEG")
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.shape != (height, width):
        found = "nothing" if pixels is None else f"{pixels.shape[1]}×{pixels.shape[0]} pixels"
        raise ProtocolError(f"a JPEG of {width}×{height} pixels contains {found}")
    return np.asarray(pixels)


def encode(layout: PixelFormat, pixels: NDArray[Any]) -> bytes:
    r"""Encode grey values as a camera with this format sends them; YUYV is encoded without colour.

    Examples
    --------
    >>> encode(VIDEO["Y16"], np.array([[1, 256]], np.uint16))
    b'\x01\x00\x00\x01'
    """
    if layout.pattern == "YUYV":
        coloured = np.full((*pixels.shape, 2), 128, np.uint8)
        coloured[..., 0] = pixels
        return coloured.tobytes()
    if not layout.stored:
        return bytes(cv2.imencode(".jpg", pixels.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 95])[1])
    return pixels.astype(layout.dtype).tobytes()
