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


_PACKED = {
    ("p", 10): (4, 5), ("p", 12): (2, 3), ("p", 14): (4, 7), ("gige", 10): (2, 3), ("gige", 12): (2, 3),
    ("mipi", 10): (4, 5), ("mipi", 12): (2, 3), ("mipi", 14): (4, 7), ("stream", 10): (4, 5),
}  # fmt: skip
_LUMINANCE = {
    "YUYV": (4, (0, 2)), "UYVY": (4, (1, 3)), "UYYVYY": (6, (1, 2, 4, 5)), "UYV": (3, (1,)),
}  # fmt: skip
"""Bytes of pixels with common colours, and those of them that are luminances."""
_COLOURS = {"RGB": cv2.COLOR_RGB2GRAY, "BGR": cv2.COLOR_BGR2GRAY, "RGBA": cv2.COLOR_RGBA2GRAY,
            "BGRA": cv2.COLOR_BGRA2GRAY}  # fmt: skip
_PLANES = "planes of RGB"


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
        bytes with the low bits of all.
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


_BAYER = {"GR": "GRBG", "RG": "RGGB", "GB": "GBRG", "BG": "BGGR"}


def _video(bits: int, stored: int, codes: str, packed: str = "") -> dict[str, PixelFormat]:
    """Mosaics of V4L2, by their codes in the order of `_BAYER`."""
    return {
        f"S{pattern}{bits}{'P' if packed else ''}": PixelFormat(code, bits, stored, pattern, packed)
        for pattern, code in zip(_BAYER.values(), codes.split(), strict=True)
    }


VIDEO: dict[str, PixelFormat] = {
    "GREY": PixelFormat("GREY", 8, 1),
    "Y10": PixelFormat("Y10 ", 10, 2),
    "Y12": PixelFormat("Y12 ", 12, 2),
    "Y14": PixelFormat("Y14 ", 14, 2),
    "Y16": PixelFormat("Y16 ", 16, 2),
    "Y10P": PixelFormat("Y10P", 10, 0, packed="mipi"),
    "Y12P": PixelFormat("Y12P", 12, 0, packed="mipi"),
    "Y14P": PixelFormat("Y14P", 14, 0, packed="mipi"),
    "Y10BPACK": PixelFormat("Y10B", 10, 0, packed="stream"),
    "RGB24": PixelFormat("RGB3", 8, 3, "RGB"),
    "BGR24": PixelFormat("BGR3", 8, 3, "BGR"),
    "YUYV": PixelFormat("YUYV", 8, 2, "YUYV"),
    "UYVY": PixelFormat("UYVY", 8, 2, "UYVY"),
    "NV12": PixelFormat("NV12", 8, 1, "NV12"),
    "MJPEG": PixelFormat("MJPG", 8, 0, "MJPEG"),
    **_video(8, 1, "GRBG RGGB GBRG BA81"),
    **_video(10, 2, "BA10 RG10 GB10 BG10"),
    **_video(12, 2, "BA12 RG12 GB12 BG12"),
    **_video(14, 2, "GR14 RG14 GB14 BG14"),
    **_video(16, 2, "GR16 RG16 GB16 BYR2"),
    **_video(10, 0, "pgAA pRAA pGAA pBAA", "mipi"),
    **_video(12, 0, "pgCC pRCC pGCC pBCC", "mipi"),
    **_video(14, 0, "pgEE pREE pGEE pBEE", "mipi"),
}
"""Formats of V4L2, by the names of its documentation."""


def _genicam(name: str, bits: int, stored: int, *codes: int, packed: str = "") -> dict[str, PixelFormat]:
    """Mosaics of GenICam, by their codes in the order of `_BAYER`."""
    return {
        f"Bayer{each}{name}": PixelFormat(code, bits, stored, pattern, packed)
        for (each, pattern), code in zip(_BAYER.items(), codes, strict=True)
    }


GENICAM: dict[str, PixelFormat] = {
    "Mono8": PixelFormat(0x01080001, 8, 1),
    "Mono10": PixelFormat(0x01100003, 10, 2),
    "Mono12": PixelFormat(0x01100005, 12, 2),
    "Mono14": PixelFormat(0x01100025, 14, 2),
    "Mono16": PixelFormat(0x01100007, 16, 2),
    "Mono10p": PixelFormat(0x010A0046, 10, 0, packed="p"),
    "Mono12p": PixelFormat(0x010C0047, 12, 0, packed="p"),
    "Mono14p": PixelFormat(0x010E0104, 14, 0, packed="p"),
    "Mono10Packed": PixelFormat(0x010C0004, 10, 0, packed="gige"),
    "Mono12Packed": PixelFormat(0x010C0006, 12, 0, packed="gige"),
    **_genicam("8", 8, 1, *range(0x01080008, 0x0108000C)),
    **_genicam("10", 10, 2, *range(0x0110000C, 0x01100010)),
    **_genicam("12", 12, 2, *range(0x01100010, 0x01100014)),
    **_genicam("14", 14, 2, *range(0x01100109, 0x0110010D)),
    **_genicam("14p", 14, 0, *range(0x010E0105, 0x010E0109), packed="p"),
    **_genicam("16", 16, 2, *range(0x0110002E, 0x01100032)),
    **_genicam("10p", 10, 0, 0x010A0056, 0x010A0058, 0x010A0054, 0x010A0052, packed="p"),
    **_genicam("12p", 12, 0, 0x010C0057, 0x010C0059, 0x010C0055, 0x010C0053, packed="p"),
    **_genicam("10Packed", 10, 0, *range(0x010C0026, 0x010C002A), packed="gige"),
    **_genicam("12Packed", 12, 0, *range(0x010C002A, 0x010C002E), packed="gige"),
    **{
        f"{order}{bits}": PixelFormat(code, bits, size, order)
        for order, bits, size, code in (
            ("RGB", 8, 3, 0x02180014),
            ("BGR", 8, 3, 0x02180015),
            ("RGB", 10, 6, 0x02300018),
            ("BGR", 10, 6, 0x02300019),
            ("RGB", 12, 6, 0x0230001A),
            ("BGR", 12, 6, 0x0230001B),
            ("RGB", 16, 6, 0x02300033),
            ("BGR", 16, 6, 0x0230004B),
        )
    },
    "RGBa8": PixelFormat(0x02200016, 8, 4, "RGBA"),
    "BGRa8": PixelFormat(0x02200017, 8, 4, "BGRA"),
    "RGB8_Planar": PixelFormat(0x02180021, 8, 1, _PLANES),
    "RGB10_Planar": PixelFormat(0x02300022, 10, 2, _PLANES),
    "RGB12_Planar": PixelFormat(0x02300023, 12, 2, _PLANES),
    "RGB16_Planar": PixelFormat(0x02300024, 16, 2, _PLANES),
    "YCbCr422_8": PixelFormat(0x0210003B, 8, 2, "YUYV"),
    "YUV422_8": PixelFormat(0x02100032, 8, 2, "YUYV"),
    "YUV422_8_UYVY": PixelFormat(0x0210001F, 8, 2, "UYVY"),
    "YUV411_8_UYYVYY": PixelFormat(0x020C001E, 8, 0, "UYYVYY"),
    "YUV8_UYV": PixelFormat(0x02180020, 8, 3, "UYV"),
}
"""Formats of GenICam, by the names of the convention."""


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
    if layout.packed:
        return _unpacked(layout, rows)
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
    return np.sum([shared[..., k].astype(np.uint64) << np.uint64(8 * n) for n, k in enumerate(order)], axis=0)


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
        return coded[:, size - 1 :: -1].tobytes() if big else coded[:, :size].tobytes()
    rest = coded[:, : size - count]
    whole = [high[:, :1], rest, high[:, 1:]] if layout.packed == "gige" else [high, rest]
    return np.hstack(whole).tobytes()


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
