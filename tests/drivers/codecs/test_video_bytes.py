"""Structures of V4L2: sizes, numbers and places typed from <linux/videodev2.h>, as a compiler gives them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from reseau.core.errors import ProtocolError
from reseau_drivers.codecs import v4l2 as uapi
from reseau_drivers.codecs.pixels import GENICAM, VIDEO, PixelFormat, decode, encode, size_of


def test_requests_equal_those_of_the_kernel_header() -> None:
    assert {
        "QUERYCAP": uapi.QUERYCAP,
        "ENUM_FMT": uapi.ENUM_FMT,
        "G_FMT": uapi.G_FMT,
        "S_FMT": uapi.S_FMT,
        "REQBUFS": uapi.REQBUFS,
        "QUERYBUF": uapi.QUERYBUF,
        "QBUF": uapi.QBUF,
        "DQBUF": uapi.DQBUF,
        "STREAMON": uapi.STREAMON,
        "STREAMOFF": uapi.STREAMOFF,
        "G_PARM": uapi.G_PARM,
        "S_PARM": uapi.S_PARM,
        "G_CTRL": uapi.G_CTRL,
        "S_CTRL": uapi.S_CTRL,
        "QUERYCTRL": uapi.QUERYCTRL,
        "G_SELECTION": uapi.G_SELECTION,
        "S_SELECTION": uapi.S_SELECTION,
    } == {
        "QUERYCAP": 0x80685600,
        "ENUM_FMT": 0xC0405602,
        "G_FMT": 0xC0D05604,
        "S_FMT": 0xC0D05605,
        "REQBUFS": 0xC0145608,
        "QUERYBUF": 0xC0585609,
        "QBUF": 0xC058560F,
        "DQBUF": 0xC0585611,
        "STREAMON": 0x40045612,
        "STREAMOFF": 0x40045613,
        "G_PARM": 0xC0CC5615,
        "S_PARM": 0xC0CC5616,
        "G_CTRL": 0xC008561B,
        "S_CTRL": 0xC008561C,
        "QUERYCTRL": 0xC0445624,
        "G_SELECTION": 0xC040565E,
        "S_SELECTION": 0xC040565F,
    }


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("GREY", 0x59455247),
        ("Y10", 0x20303159),
        ("Y12", 0x20323159),
        ("Y16", 0x20363159),
        ("YUYV", 0x56595559),
        ("MJPEG", 0x47504A4D),
        ("SRGGB8", 0x42474752),
    ],
)
def test_pixel_formats_have_the_numbers_of_the_header(name: str, code: int) -> None:
    assert uapi.fourcc_of(str(VIDEO[name].code)) == code
    assert uapi.fourcc_text(code) == VIDEO[name].code


def test_capabilities_are_those_of_the_node_not_of_the_device() -> None:
    data = bytearray(104)
    data[0:5], data[16:22], data[48:64] = b"vivid", b"vivid!", b"platform:vivid-0"
    data[80:84] = bytes([56, 1, 6, 0])  # 6.1.56
    data[84:88] = (0x85201003).to_bytes(4, "little")
    data[88:92] = (0x05200001).to_bytes(4, "little")
    found = uapi.Capability.parse(data)
    assert found == uapi.Capability("vivid", "vivid!", "platform:vivid-0", (6, 1, 56), 0x05200001)


def test_format_fields_are_at_the_offsets_of_the_header() -> None:
    data = bytearray(208)
    data[0:4] = b"\x01\0\0\0"
    data[8:12], data[12:16], data[16:20] = b"\x40\x06\0\0", b"\xb0\x04\0\0", b"Y16 "
    data[20:24], data[24:28], data[28:32] = b"\x01\0\0\0", b"\x80\x0c\0\0", b"\0\x98\x3a\0"
    expected = uapi.Format(1600, 1200, "Y16 ", 3200, 3840000)
    assert uapi.Format.parse(data) == expected
    assert expected.build() == data


def test_buffer_fields_are_at_the_offsets_of_the_header() -> None:
    data = bytearray(88)
    data[0:4], data[4:8], data[8:12] = b"\x02\0\0\0", b"\x01\0\0\0", b"\0\x10\0\0"
    data[12:16], data[16:20] = b"\x40\x20\x01\0", b"\x01\0\0\0"
    data[24:32], data[32:40] = (77).to_bytes(8, "little"), (123456).to_bytes(8, "little")
    data[56:60], data[60:64] = b"\xfe\xff\xff\xff", b"\x01\0\0\0"
    data[64:68], data[72:76] = b"\0\x20\0\0", b"\0\x10\0\0"
    buffer = uapi.Buffer(2, 4096, 0x12040, 77_123_456_000, 0xFFFFFFFE, 8192, 4096)
    assert uapi.Buffer.parse(data) == buffer
    assert buffer.build() == data
    assert buffer.flags & uapi.Buffer.ERROR
    assert buffer.flags & uapi.Buffer.CLOCKS == uapi.Buffer.MONOTONIC
    assert buffer.flags & uapi.Buffer.SOURCES == uapi.Buffer.START_OF_EXPOSURE


def test_a_control_with_negative_limits() -> None:
    data = bytearray(68)
    data[0:4], data[4:8], data[8:18] = b"\x00\x09\x98\0", b"\x01\0\0\0", b"Brightness"
    data[40:44], data[44:48] = (-64).to_bytes(4, "little", signed=True), (64).to_bytes(4, "little")
    data[48:52], data[56:60] = b"\x01\0\0\0", b"\x10\0\0\0"
    control = uapi.Control(uapi.BRIGHTNESS, "Brightness", 1, -64, 64, 1, 0, uapi.Control.INACTIVE)
    assert uapi.Control.parse(data) == control
    assert control.build() == data
    assert uapi.Control.after(uapi.BRIGHTNESS)[:4] == b"\x00\x09\x98\x80"


def test_intervals_and_regions() -> None:
    data = bytearray(204)
    data[0:4], data[4:8], data[12:16], data[16:20] = (
        b"\1\0\0\0",
        b"\0\x10\0\0",
        b"\xe9\3\0\0",
        b"\x60\xea\0\0",
    )
    assert uapi.Interval.parse(data) == uapi.Interval(1001, 60000)
    assert uapi.Interval(1001, 60000).build() == data
    assert uapi.Interval(1001, 60000).ns == 16_683_333
    region = bytearray(64)
    region[0:4], region[12:16], region[16:20] = b"\1\0\0\0", b"\x10\0\0\0", b"\x20\0\0\0"
    region[20:24], region[24:28] = b"\x80\2\0\0", b"\xe0\1\0\0"
    assert uapi.Selection(16, 32, 640, 480).build() == region
    assert uapi.Selection.parse(region) == uapi.Selection(16, 32, 640, 480)


def test_rows_with_padding() -> None:
    data = bytes([1, 2, 99, 3, 4])
    assert decode(VIDEO["GREY"], 2, 2, data, 3).tolist() == [[1, 2], [3, 4]]
    words = bytes([1, 0, 9, 2, 0])
    assert decode(VIDEO["Y16"], 1, 2, words, 3).tolist() == [[1], [2]]
    assert size_of(VIDEO["Y16"], 4, 3, 100) == 208


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("GREY", bytes(3)),
        ("Y16", bytes(7)),
        ("Y10", bytes([0, 4] * 4)),
        ("MJPEG", b""),
        ("MJPEG", b"\xff\xd8" + bytes(50)),
        ("MJPEG", b"\xff\xd8" + bytes(50) + b"\xff\xd9"),
    ],
)
def test_incomplete_frames_are_rejected(name: str, data: bytes) -> None:
    with pytest.raises(ProtocolError):
        decode(VIDEO[name], 2, 2, data)


def test_a_jpeg_gives_the_luminance_of_its_decoder() -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (16, 24, 3), np.uint8)
    data = cv2.imencode(".jpg", pixels)[1].tobytes()
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert (decode(VIDEO["MJPEG"], 24, 16, data + bytes(9)) == expected).all()
    with pytest.raises(ProtocolError, match="24×16"):
        decode(VIDEO["MJPEG"], 24, 17, data)


def test_genicam_numbers_contain_the_bits_per_pixel() -> None:
    for name, layout in GENICAM.items():
        assert isinstance(layout.code, int)
        pixels, size = layout.group
        planes = 3 if "Planar" in name else 1
        assert (layout.code >> 16 & 0xFF) == 8 * size * planes // pixels, name


HEADER = Path("/usr/include/linux/videodev2.h")


@pytest.mark.skipif(not HEADER.exists(), reason="needs linux-libc-dev")
def test_all_formats_of_video_have_the_codes_of_the_kernel() -> None:
    found = re.findall(
        r"V4L2_PIX_FMT_(\w+)\s+v4l2_fourcc\('(.)', *'(.)', *'(.)', *'(.)'\)", HEADER.read_text()
    )
    known = {name: "".join(letters) for name, *letters in found}
    newer = {"Y12P": "Y12P", "Y14P": "Y14P"}  # of Linux 6.9
    for name, layout in VIDEO.items():
        assert (newer | known)[name] == layout.code, name


def _stream(bits: int, pixels: list[int]) -> bytes:
    """PFNC, formats with p: each pixel begins with its lowest bit, in the lowest bit that is free."""
    text = "".join(format(value, f"0{bits}b")[::-1] for value in pixels)
    return bytes(int(text[k : k + 8][::-1], 2) for k in range(0, len(text), 8))


def _gige(bits: int, pixels: list[int]) -> bytes:
    """GigE Vision 1.2, 26.1: the high bits of both pixels, with the low ones of both in the byte between."""
    low = bits - 8
    return b"".join(
        bytes([a >> low, (a & (1 << low) - 1) | (b & (1 << low) - 1) << 4, b >> low])
        for a, b in zip(pixels[::2], pixels[1::2], strict=True)
    )


def _mipi(bits: int, pixels: list[int]) -> bytes:
    """The kernel's SRGGB10P and SRGGB12P: the high bits of the pixels, then the low bits of all of them."""
    low = bits - 8
    found = b""
    together = {10: 4, 12: 2, 14: 4}[bits]
    for k in range(0, len(pixels), together):
        some = pixels[k : k + together]
        rest = sum((value & (1 << low) - 1) << low * n for n, value in enumerate(some))
        found += bytes([value >> low for value in some]) + rest.to_bytes(together * low // 8, "little")
    return found


def _highest(bits: int, pixels: list[int]) -> bytes:
    """The kernel's Y10BPACK: a stream of bits, the highest of each pixel first."""
    text = "".join(format(value, f"0{bits}b") for value in pixels)
    return int(text, 2).to_bytes(len(text) // 8, "big")


def _words(size: int, pixels: list[int]) -> bytes:
    return b"".join(value.to_bytes(size, "little") for value in pixels)


def _grey(name: str, rows: list[list[int]]) -> list[bytes]:
    """Rows of a format of grey values or of a mosaic, as its name says."""
    found = re.fullmatch(r"(?:GREY|Y|Mono|Bayer..|S[GRB]{4})(\d*)(p|P|Packed|BPACK)?", name)
    assert found is not None, name
    bits, how = int(found[1] or 8), found[2]
    packers = {"p": _stream, "P": _mipi, "Packed": _gige, "BPACK": _highest}
    return [packers[how](bits, row) if how else _words(bits + 7 >> 3, row) for row in rows]


def _bits_of(name: str) -> int:
    return int(next(iter(re.findall(r"\d+", re.sub("565p?|422|411|601|709|NV12", "", name))), 8)) % 16 or 16


def _five_six_five(name: str, colours: NDArray[Any]) -> list[bytes]:
    """PFNC: with p the first colour is lowest; the kernel's RGB565 has red in the highest bits."""
    red, blue = (0, 11) if name == "RGB565p" else (11, 0)
    words = colours[..., 0] >> 3 << red | colours[..., 1] >> 2 << 5 | colours[..., 2] >> 3 << blue
    return [_words(2, row) for row in words.tolist()]


def _coloured(name: str, colours: NDArray[Any]) -> list[bytes]:
    """Rows of a format of three colours, as its name says."""
    order = {"R": 0, "G": 1, "B": 2}
    size = 2 if _bits_of(name) > 8 else 1
    if "Planar" in name:
        return [_words(size, row) for plane in np.moveaxis(colours, -1, 0).tolist() for row in plane]
    places = [order[letter] for letter in name[:3]]
    rows = []
    for row in colours.tolist():
        values = [pixel[place] for pixel in row for place in places]
        if "a" in name:
            values = [each for k in range(0, len(values), 3) for each in (*values[k : k + 3], 77)]
        rows.append(_words(size, values))
    return rows


def _luminances(name: str, rows: list[list[int]]) -> list[bytes]:
    """Rows of luminances among colours, which are 200 and over: the order of a format is in its name."""
    order = next(
        (each for each in ("YUYV", "UYYVYY", "CbYYCrYY", "CbYCrY", "CbYCr", "UYVY", "UYV") if each in name),
        "YUYV",
    )
    order = order.replace("Cb", "U").replace("Cr", "V")
    found = []
    for row in rows:
        values, out = iter(row), bytearray()
        while len(out) < len(row) * len(order) // order.count("Y"):
            out += bytes(next(values) if letter == "Y" else 200 + len(out) % 50 for letter in order)
        found.append(bytes(out))
    return found


NAMES = [
    (name, layout) for formats in (GENICAM, VIDEO) for name, layout in formats.items() if name != "MJPEG"
]


@pytest.mark.parametrize(("name", "layout"), NAMES, ids=[name for name, _ in NAMES])
def test_a_picture_that_was_packed_as_the_name_says_is_read_exactly(name: str, layout: PixelFormat) -> None:
    """By code that knows the conventions of names, not the table: each order of bytes, bits and colours."""
    rng, bits = np.random.default_rng(11), _bits_of(name)
    assert layout.bits == bits
    if "565" in name or re.match("RGB|BGR", name):
        colours = rng.integers(0, 1 << bits, (5, 8, 3))
        if "565" in name:
            rows = _five_six_five(name, colours)
            parts = [
                (colours[..., k] >> low) * 255 / most for k, low, most in ((0, 3, 31), (1, 2, 63), (2, 3, 31))
            ]
            colours = np.rint(np.stack(parts, axis=-1)).astype(int)
        else:
            rows = _coloured(name, colours)
        expected = cv2.cvtColor(colours.astype(np.uint8 if bits == 8 else np.uint16), cv2.COLOR_RGB2GRAY)
    else:
        expected = rng.integers(0, 1 << bits, (5 if name != "NV12" else 6, 8))
        if "YUV" in name or "YCbCr" in name or "UYVY" in name or "YUYV" in name:
            rows = _luminances(name, expected.tolist())
        elif name == "NV12":
            rows = [bytes(row) for row in expected.tolist()] + [bytes([200, 90] * 4)] * 3
        else:
            rows = _grey(name, expected.tolist())
            assert encode(layout, expected) == b"".join(rows)
    height = len(expected)
    assert (decode(layout, 8, height, b"".join(rows)) == expected).all()
    padded = b"".join(row + b"\xff" * 3 for row in rows)
    assert (decode(layout, 8, height, padded, len(rows[0]) + 3) == expected).all()
    with pytest.raises(ProtocolError):
        decode(layout, 8, height, b"".join(rows)[:-1])
    if layout.group[0] > 1:
        with pytest.raises(ProtocolError, match="set a multiple of"):
            decode(layout, 7, height, b"".join(rows))


def test_packed_pixels_of_the_documents() -> None:
    """The kernel's table of SRGGB10P; PFNC's figure of Mono10p."""
    assert decode(VIDEO["SRGGB10P"], 4, 1, bytes([0xFF, 0, 0x80, 1, 0b11_00_01_10])).tolist() == [
        [0x3FE, 1, 0x200, 7]
    ]
    assert decode(GENICAM["Mono10p"], 4, 1, bytes([0x01, 0x08, 0x30, 0x00, 0x01])).tolist() == [[1, 2, 3, 4]]
    assert decode(GENICAM["Mono12Packed"], 2, 1, bytes([0x12, 0x63, 0x45])).tolist() == [[0x123, 0x456]]
