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

from ..profiles import known

_PACKED = {
    ("p", 10): (4, 5), ("p", 12): (2, 3), ("p", 14): (4, 7), ("gige", 10): (2, 3), ("gige", 12): (2, 3),
    ("mipi", 10): (4, 5), ("mipi", 12): (2, 3), ("mipi", 14): (4, 7), ("stream", 10): (4, 5),
    ("565", 8): (1, 2),
}  # fmt: skip
_LUMINANCE = {
    "YUYV": (4, (0, 2)), "UYVY": (4, (1, 3)), "UYYVYY": (6, (1, 2, 4, 5)), "UYV": (3, (1,)),
}  # fmt: skip
"""Bytes of pixels with common colours, and those of them that are luminances."""
_COLOURS = {"RGB": cv2.COLOR_RGB2GRAY, "BGR": cv2.COLOR_BGR2GRAY, "RGBA": cv2.COLOR_RGBA2GRAY,
            "BGRA": cv2.COLOR_BGRA2GRAY}  # fmt: skip
_PLANES = "planes of RGB"
_565 = ((0, 31), (5, 63), (11, 31))
"""Lowest bit and largest value of the three colours of a word."""
_CUSTOM = 0x80000000
"""Bit of the numbers of formats that a maker has defined."""


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
        Bytes per pixel; 0 for packed and compressed frames.
    pattern : str
        Colour pattern of raw data: filters of the first two rows (RGGB …), the order of luminance and colours
        (YUYV, UYVY, UYYVYY, UYV, NV12), the order of colours (RGB, BGRA …, planes of RGB) or MJPEG; empty for
        grey.
    packed : str
        How pixels share bytes: ``p``, a stream of bits from the lowest on; ``stream``, from the highest on;
        ``gige``, two pixels in three bytes, the middle one with the low bits of both; ``mipi``, the last
        bytes with the low bits of all; ``565``, colours of 5, 6 and 5 bits, the first of `pattern` lowest.
    """

    code: str | int
    bits: int
    stored: int
    pattern: str = ""
    packed: str = ""

    @property
    def group(self) -> tuple[int, int]:
        """Pixels that share bytes, and the number of these bytes."""
        if self.pattern in _LUMINANCE:
            size, luminances = _LUMINANCE[self.pattern]
            return len(luminances), size
        return _PACKED[self.packed, self.bits] if self.packed else (1, self.stored)

    @property
    def coloured(self) -> bool:
        """Whether grey values are not all that a frame has."""
        return self.pattern in (*_LUMINANCE, *_COLOURS, _PLANES, "NV12", "MJPEG")

    def row(self, width: int) -> int:
        """Return the number of bytes of a row, without padding; 0 if compressed.

        Raises
        ------
        ProtocolError
            If the row ends within bytes that pixels share.
        """
        pixels, size = self.group
        if width % pixels:
            raise ProtocolError(f"rows of {width} pixels end within a byte", do=f"set a multiple of {pixels}")
        return width // pixels * size

    @property
    def full_scale(self) -> float:
        """Grey value at saturation."""
        return float(2**self.bits - 1)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Data type of the grey values."""
        return np.dtype(np.uint8 if self.bits <= 8 else "<u2")


_KNOWN = known("pixels")
VIDEO: dict[str, PixelFormat] = {name: PixelFormat(*told) for name, told in _KNOWN["video"].items()}
"""Formats of V4L2, by the names of its documentation."""
GENICAM: dict[str, PixelFormat] = {name: PixelFormat(*told) for name, told in _KNOWN["genicam"].items()}
"""Formats of GenICam, by the names of the convention."""


def format_named(code: int) -> str:
    """Return the name of a format of GenICam, or in words what its number says.

    Examples
    --------
    >>> format_named(0x01080001), format_named(0x81080001)
    ('Mono8', "the maker's own format 0x81080001")
    """
    found = next((name for name, layout in GENICAM.items() if layout.code == code), None)
    kind = "the maker's own" if code & _CUSTOM else "the unknown"
    return found or f"{kind} format {code:#010x}"


def size_of(layout: PixelFormat, width: int, height: int, stride: int = 0) -> int:
    """Return the size of a frame with rows `stride` bytes apart (bytes); 0 if compressed."""
    row = layout.row(width)
    # Colours are below the luminance.
    rows = {"NV12": height * 3 // 2, _PLANES: 3 * height}.get(layout.pattern, height)
    return (rows - 1) * max(stride, row) + row if row else 0


def decode(layout: PixelFormat, width: int, height: int, data: bytes, stride: int = 0) -> NDArray[Any]:
    """Decode the grey values of a frame: luminance of colours, all raw pixels of a mosaic.

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
    if layout.pattern == "MJPEG":
        return _jpeg(width, height, data)
    need = size_of(layout, width, height, stride)
    if len(data) < need or min(width, height) < 1:
        raise ProtocolError(f"a frame of {width}×{height} pixels has {len(data)} of {need} bytes")
    size = layout.row(width)
    raw = np.frombuffer(data, np.uint8, need)
    count = 3 * height if layout.pattern == _PLANES else height
    rows = np.lib.stride_tricks.as_strided(raw, (count, size), (max(stride, size), 1), writeable=False)
    if layout.pattern in _LUMINANCE:
        together, luminances = _LUMINANCE[layout.pattern]
        return rows.reshape(height, -1, together)[..., list(luminances)].reshape(height, width)
    if layout.packed == "565":
        pixels = _widened(_words(rows))
    elif layout.packed:
        return _unpacked(layout, rows)
    else:
        pixels = rows if layout.bits == 8 else _words(rows)
    if layout.pattern in (*_COLOURS, _PLANES):
        if layout.pattern == _PLANES:
            coloured = np.moveaxis(pixels.reshape(3, height, width), 0, -1)
        else:
            coloured = pixels.reshape(height, width, -1)
        kind = _COLOURS.get(layout.pattern, cv2.COLOR_RGB2GRAY)
        pixels = np.asarray(cv2.cvtColor(np.ascontiguousarray(coloured), kind))
    if 8 < layout.bits < 16 and int(pixels.max()) >> layout.bits:
        raise ProtocolError(f"a frame of {layout.bits} bits contains the grey value {int(pixels.max())}")
    return pixels


def _widened(words: NDArray[Any]) -> NDArray[np.uint8]:
    """Three colours (8 bits) of words with 5, 6 and 5 bits, the first lowest."""
    parts = [np.rint((words >> at & most) * (255 / most)) for at, most in _565]
    return np.stack(parts, axis=-1).astype(np.uint8)


def _unpacked(layout: PixelFormat, rows: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Grey values of pixels that share bytes."""
    pixels, size = layout.group
    shared, low = rows.reshape(len(rows), -1, size), layout.bits - 8
    if layout.packed in ("p", "stream"):
        word, step = _number(shared, layout.packed == "stream"), layout.bits
        order = range(pixels)[:: -1 if layout.packed == "stream" else 1]
        found = [word >> np.uint64(step * k) & np.uint64((1 << step) - 1) for k in order]
    elif layout.packed == "mipi":
        found = _joined(shared[..., :pixels], _number(shared[..., pixels:]), low, low)
    else:
        found = _joined(shared[..., ::2], _number(shared[..., 1:2]), low, 4)
    return np.stack(found, axis=-1).astype(np.uint16).reshape(len(rows), -1)


def _joined(
    high: NDArray[np.uint8], rest: NDArray[np.uint64], low: int, step: int
) -> list[NDArray[np.uint64]]:
    """High bytes of pixels with `low` further bits of each, `step` bits apart in the rest."""
    mask = np.uint64((1 << low) - 1)
    return [
        high[..., k].astype(np.uint64) << np.uint64(low) | rest >> np.uint64(step * k) & mask
        for k in range(high.shape[-1])
    ]


def _number(shared: NDArray[np.uint8], big: bool = False) -> NDArray[np.uint64]:
    """The number that a few bytes are."""
    order = range(shared.shape[-1])[:: -1 if big else 1]
    found = np.zeros(shared.shape[:-1], np.uint64)
    for n, k in enumerate(order):
        found |= shared[..., k].astype(np.uint64) << np.uint64(8 * n)
    return found


def _packed(layout: PixelFormat, pixels: NDArray[Any]) -> bytes:
    """Bytes of pixels that share them."""
    count, size = layout.group
    groups, low = pixels.reshape(-1, count).astype(np.uint64), layout.bits - 8
    high = (groups >> np.uint64(low)).astype(np.uint8)
    if layout.packed in ("p", "stream"):
        step, big = layout.bits, layout.packed == "stream"
        parts = groups[:, ::-1] if big else groups
    else:
        step, big, parts = 4 if layout.packed == "gige" else low, False, groups & np.uint64((1 << low) - 1)
    word = np.sum([parts[:, k] << np.uint64(step * k) for k in range(count)], axis=0).astype("<u8")
    coded = word.view(np.uint8).reshape(-1, 8)
    if layout.packed in ("p", "stream"):
        return bytes((coded[:, size - 1 :: -1] if big else coded[:, :size]).tobytes())
    rest = coded[:, : size - count]
    whole = [high[:, :1], rest, high[:, 1:]] if layout.packed == "gige" else [high, rest]
    return bytes(np.hstack(whole).tobytes())


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
    r"""Encode grey values as a camera with this format sends them, with neutral colours.

    Examples
    --------
    >>> encode(VIDEO["Y16"], np.array([[1, 256]], np.uint16))
    b'\x01\x00\x00\x01'
    """
    if layout.pattern in _LUMINANCE:
        together, luminances = _LUMINANCE[layout.pattern]
        coloured = np.full((len(pixels), pixels.shape[1] // len(luminances), together), 128, np.uint8)
        coloured[..., list(luminances)] = pixels.reshape(len(pixels), -1, len(luminances))
        return coloured.tobytes()
    if layout.packed == "565":
        grey = pixels.astype(float) / 255
        parts = [np.rint(grey * most).astype("<u2") << np.uint16(at) for at, most in _565]
        return bytes(np.sum(parts, axis=0, dtype="<u2").tobytes())
    if layout.pattern in _COLOURS:
        return np.repeat(pixels.astype(layout.dtype)[..., None], len(layout.pattern), axis=-1).tobytes()
    if layout.pattern == _PLANES:
        return pixels.astype(layout.dtype).tobytes() * 3
    if layout.pattern == "NV12":
        return pixels.tobytes() + bytes([128]) * (pixels.size // 2)
    if layout.packed:
        return _packed(layout, pixels)
    if not layout.stored:
        return bytes(cv2.imencode(".jpg", pixels.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 95])[1])
    return pixels.astype(layout.dtype).tobytes()
