"""Whole frames and windowed scans accept the same files, give the same pixels and the same messages."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from reseau.core.errors import ImageError, InputError, UsageError
from reseau.io.images import open_scan, read_image

H, W = 70, 50
RNG = np.random.default_rng(5)
GREY8 = RNG.integers(0, 256, (H, W)).astype(np.uint8)
GREY16 = RNG.integers(0, 65536, (H, W)).astype(np.uint16)
SIGNED = RNG.integers(-3000, 32768, (H, W)).astype(np.int16)
REAL = RNG.random((H, W)).astype(np.float32)
BITS = RNG.random((H, W)) < 0.5
RGB8 = RNG.integers(0, 256, (H, W, 3)).astype(np.uint8)
RGB16 = RNG.integers(0, 65536, (H, W, 3)).astype(np.uint16)
SMOOTH = np.stack(np.broadcast_arrays(np.arange(W) * 4, np.arange(H)[:, None] * 3, 90), axis=2).astype(
    np.uint8
)
ALPHA8 = np.dstack([RGB8, np.full((H, W), 200, np.uint8)])

TIFFS: dict[str, tuple[np.ndarray, dict[str, Any], np.ndarray]] = {
    # name: what is written, how, and the values that are read
    "8 bit": (GREY8, {}, GREY8),
    "16 bit": (GREY16, {}, GREY16),
    "16 bit, big-endian": (GREY16, {"byteorder": ">"}, GREY16),
    "BigTIFF": (GREY16, {"bigtiff": True}, GREY16),
    "16 bit signed": (SIGNED, {}, SIGNED),
    "16 bit signed, LZW": (SIGNED, {"compression": "lzw"}, SIGNED),
    "32 bit float": (REAL, {}, REAL),
    "32 bit float, big-endian": (REAL, {"byteorder": ">"}, REAL),
    "32 bit float, deflate, predictor": (REAL, {"compression": "zlib", "predictor": True}, REAL),
    "64 bit float": (REAL.astype(np.float64), {}, REAL.astype(np.float64)),
    "16 bit float": (REAL.astype(np.float16), {}, REAL.astype(np.float16)),
    "1 bit": (BITS, {}, BITS.astype(np.uint8) * 255),
    "1 bit, white is zero": (BITS, {"photometric": "miniswhite"}, 255 - BITS.astype(np.uint8) * 255),
    "white is zero": (GREY8, {"photometric": "miniswhite"}, 255 - GREY8),
    "float, white is zero": (REAL, {"photometric": "miniswhite"}, np.float32(1) - REAL),
    "tiles": (GREY16, {"tile": (32, 16), "compression": "zlib"}, GREY16),
    "strips": (GREY8, {"rowsperstrip": 7, "compression": "packbits"}, GREY8),
    "RGB": (RGB8, {"photometric": "rgb"}, RGB8),
    "RGB, 16 bit": (RGB16, {"photometric": "rgb", "compression": "lzw"}, RGB16),
    "RGB, planes": (np.moveaxis(RGB8, 2, 0), {"photometric": "rgb", "planarconfig": "separate"}, RGB8),
    "RGB, planes, deflate": (
        np.moveaxis(RGB16, 2, 0),
        {"photometric": "rgb", "planarconfig": "separate", "compression": "zlib"},
        RGB16,
    ),
    "RGB, float": (RGB8 / np.float32(255), {"photometric": "rgb"}, RGB8 / np.float32(255)),
    "RGB with alpha": (ALPHA8, {"photometric": "rgb", "extrasamples": ["unassalpha"]}, RGB8),
    "grey with alpha": (
        np.dstack([GREY8, GREY8]),
        {"photometric": "minisblack", "planarconfig": "contig"},
        GREY8,
    ),
    "orientation ignored": (GREY8, {"extratags": [(274, 3, 1, 6, True)]}, GREY8),
}


def luma(rgb: np.ndarray) -> np.ndarray:
    value = 0.299 * rgb[:, :, 0] + 0.587 * rgb[:, :, 1] + 0.114 * rgb[:, :, 2]
    return value if rgb.dtype.kind == "f" else np.rint(value)


def same_by_both(path: Path, want: np.ndarray, full_scale: float, atol: float = 0.0) -> None:
    scan, frame = open_scan(path), read_image(path)
    colours = want if want.ndim == 3 else want[:, :, None]
    assert (scan.height, scan.width, len(scan.channels)) == colours.shape
    assert (frame.height, frame.width) == want.shape[:2]
    assert scan.full_scale == frame.full_scale == full_scale
    assert scan.dtype == frame.pixels.dtype or (want.ndim == 3 and want.dtype.kind == "f")
    for top, bottom, left, right in ((0, want.shape[0], 0, want.shape[1]), (5, 41, 13, 37), (H - 1, H, 0, 1)):
        seen = scan.window(top, bottom, left, right)
        assert seen.dtype == scan.dtype
        np.testing.assert_allclose(seen, colours[top:bottom, left:right], rtol=0, atol=atol)
    if want.ndim == 2:
        np.testing.assert_allclose(frame.pixels, want, rtol=0, atol=atol)
        return
    tolerance = 1e-6 if want.dtype.kind == "f" else 1.0 + atol  # float32 rounds some halves the other way
    np.testing.assert_allclose(frame.pixels, luma(want), rtol=0, atol=tolerance)
    for c, name in enumerate(("red", "green", "blue")):
        one = read_image(path, name).pixels
        np.testing.assert_array_equal(one, scan.window(0, want.shape[0], 0, want.shape[1])[:, :, c])


@pytest.mark.parametrize("kind", TIFFS)
def test_both_read_every_kind_of_tiff(kind: str, tmp_path: Path) -> None:
    pixels, how, want = TIFFS[kind]
    how = {"photometric": "minisblack", **how} if pixels.ndim == 2 else how
    tifffile.imwrite(tmp_path / "a.tif", pixels, **how)
    full_scale = 1.0 if want.dtype.kind == "f" else float(np.iinfo(want.dtype).max)
    same_by_both(tmp_path / "a.tif", want, full_scale)


def test_both_read_twelve_bits(tmp_path: Path) -> None:
    deep = GREY16 >> 4
    coded = np.zeros((H, W // 2 * 3), np.uint8)  # two samples in three bytes
    coded[:, 0::3], coded[:, 2::3] = deep[:, 0::2] >> 4, deep[:, 1::2] & 255
    coded[:, 1::3] = ((deep[:, 0::2] & 15) << 4) | (deep[:, 1::2] >> 8)
    entries = [
        (256, 4, W), (257, 4, H), (258, 3, 12), (259, 3, 1), (262, 3, 1), (273, 4, 200),
        (277, 3, 1), (278, 4, H), (279, 4, coded.size),
    ]  # fmt: skip
    directory = struct.pack("<H", len(entries)) + b"".join(
        struct.pack("<HHII", t, k, 1, v) for t, k, v in entries
    )
    head = b"II*\0" + struct.pack("<I", 8) + directory + bytes(4)
    (tmp_path / "a.tif").write_bytes(head.ljust(200, b"\0") + coded.tobytes())
    same_by_both(tmp_path / "a.tif", deep, 65535.0)


@pytest.mark.parametrize(
    "how", [{"subsampling": (1, 1), "tile": (32, 32)}, {"subsampling": (2, 2), "rowsperstrip": 16}]
)
def test_both_read_a_tiff_coded_as_jpeg(how: dict[str, Any], tmp_path: Path) -> None:
    how = {"photometric": "ycbcr", "compression": "jpeg", **how}
    stored = cv2.cvtColor(SMOOTH, cv2.COLOR_RGB2YCrCb)[:, :, [0, 2, 1]]
    tifffile.imwrite(tmp_path / "a.tif", stored, compressionargs={"level": 97}, **how)
    same_by_both(tmp_path / "a.tif", SMOOTH, 255.0, atol=8)


@pytest.mark.parametrize("suffix", [".png", ".bmp"])
@pytest.mark.parametrize("pixels", [GREY8, GREY16, RGB8, RGB16], ids=["grey8", "grey16", "rgb8", "rgb16"])
def test_both_read_png_and_bmp(suffix: str, pixels: np.ndarray, tmp_path: Path) -> None:
    if suffix == ".bmp" and pixels.dtype != np.uint8:
        pixels = (pixels >> 8).astype(np.uint8)
    cv2.imwrite(str(tmp_path / f"a{suffix}"), pixels[:, :, ::-1] if pixels.ndim == 3 else pixels)
    same_by_both(tmp_path / f"a{suffix}", pixels, float(np.iinfo(pixels.dtype).max))


def png(path: Path, colour: int, bits: int, rows: np.ndarray, *chunks: tuple[bytes, bytes]) -> Path:
    """A PNG whose rows (height, bytes) are already packed."""
    width = rows.shape[1] * 8 // (bits * {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour])
    packed = zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows))
    head = (b"IHDR", struct.pack(">IIBBBBB", width, len(rows), bits, colour, 0, 0, 0))
    parts = (head, *chunks, (b"IDAT", packed), (b"IEND", b""))
    coded = [struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in parts]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(coded))
    return path


def test_both_read_png_of_every_colour_type(tmp_path: Path) -> None:
    palette = RNG.integers(0, 256, (256, 3)).astype(np.uint8)
    indexed = png(tmp_path / "palette.png", 3, 8, GREY8, (b"PLTE", palette.tobytes()))
    same_by_both(indexed, palette[GREY8], 255.0)
    packed = np.packbits(BITS[:, :48], axis=1)
    same_by_both(png(tmp_path / "bits.png", 0, 1, packed), BITS[:, :48].astype(np.uint8) * 255, 255.0)
    both = np.dstack([GREY8, GREY8[::-1]]).reshape(H, -1)
    same_by_both(png(tmp_path / "grey+alpha.png", 4, 8, both), np.repeat(GREY8[:, :, None], 3, axis=2), 255.0)
    same_by_both(png(tmp_path / "rgba.png", 6, 8, ALPHA8.reshape(H, -1)), RGB8, 255.0)


def exif(orientation: int) -> bytes:
    body = b"II*\0\x08\0\0\0" + struct.pack("<HHHIHHI", 1, 274, 3, 1, orientation, 0, 0)
    return b"\xff\xe1" + struct.pack(">H", len(body) + 8) + b"Exif\0\0" + body


def test_both_read_jpeg_as_the_sensor_saw_it(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), SMOOTH[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 97])
    same_by_both(path, SMOOTH, 255.0, atol=6)
    coded = path.read_bytes()
    turned = tmp_path / "turned.jpg"
    turned.write_bytes(coded[:2] + exif(6) + coded[2:])
    np.testing.assert_array_equal(read_image(turned).pixels, read_image(path).pixels)
    same_by_both(turned, SMOOTH, 255.0, atol=6)
    cv2.imwrite(str(path), GREY8, [cv2.IMWRITE_JPEG_QUALITY, 100])
    same_by_both(path, GREY8, 255.0, atol=6)


def test_both_read_the_first_of_several_pages(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "a.tif") as writer:
        writer.write(GREY8, photometric="minisblack")
        writer.write(RGB16, photometric="rgb")
    same_by_both(tmp_path / "a.tif", GREY8, 255.0)


def _cut(path: Path, keep: float) -> Path:
    path.write_bytes(path.read_bytes()[: int(len(path.read_bytes()) * keep)])
    return path


def _tiff(pixels: np.ndarray, **how: Any) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        tifffile.imwrite(folder / "a.tif", pixels, **how)
        return folder / "a.tif"

    return write


def _other(suffix: str, pixels: np.ndarray) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        cv2.imwrite(str(folder / f"a{suffix}"), pixels)
        return folder / f"a{suffix}"

    return write


def _noise_in(path: Path) -> Path:
    coded = bytearray(path.read_bytes())
    coded[len(coded) // 3 : len(coded) // 2] = b"\x55" * (len(coded) // 2 - len(coded) // 3)
    path.write_bytes(bytes(coded))
    return path


def _text(folder: Path) -> Path:
    (folder / "a.tif").write_text("no image")
    return folder / "a.tif"


_REMEDY = "convert it to grey or RGB of 8 or 16 bit"
_AGAIN = "copy or scan it again"
_COLOURS = np.zeros((3, 256), np.uint16)
REFUSED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "CMYK": (_tiff(ALPHA8, photometric="separated"), f"is a TIFF of colour CMYK; {_REMEDY}"),
    "palette": (
        _tiff(GREY8, photometric="palette", colormap=_COLOURS),
        f"is a TIFF of colour a palette; {_REMEDY}",
    ),
    "YCbCr, uncompressed": (
        _tiff(RGB8, photometric="ycbcr"),
        f"is a TIFF of colour YCBCR that is not a JPEG; {_REMEDY}",
    ),
    "32 bit integers": (_tiff(GREY16.astype(np.uint32)), f"has grey values of type uint32; {_REMEDY}"),
    "8 bit signed": (_tiff(GREY8.astype(np.int8)), f"has grey values of type int8; {_REMEDY}"),
    "complex": (_tiff(REAL.astype(np.complex64)), f"has grey values of type complex64; {_REMEDY}"),
    "five samples": (
        _tiff(np.zeros((H, W, 5), np.uint8), photometric="rgb", extrasamples=[0, 0]),
        f"is a TIFF of 5 samples per pixel; {_REMEDY}",
    ),
    "one row": (_tiff(GREY8[:1]), f"has {W}×1 pixels, fewer than 2×2"),
    "one column": (_other(".png", GREY8[:, :1]), f"has 1×{H} pixels, fewer than 2×2"),
    "cut TIFF": (lambda folder: _cut(_tiff(GREY8)(folder), 0.6), f"is a truncated TIFF; {_AGAIN}"),
    "cut LZW": (
        lambda folder: _cut(_tiff(GREY8, compression="lzw", rowsperstrip=10)(folder), 0.6),
        f"is a truncated TIFF; {_AGAIN}",
    ),
    "cut PNG": (lambda folder: _cut(_other(".png", GREY8)(folder), 0.6), f"is a truncated image; {_AGAIN}"),
    "cut JPEG": (lambda folder: _cut(_other(".jpg", GREY8)(folder), 0.6), f"is a truncated image; {_AGAIN}"),
    "cut BMP": (lambda folder: _cut(_other(".bmp", GREY8)(folder), 0.6), f"is a damaged image; {_AGAIN}"),
    "damaged PNG": (lambda folder: _noise_in(_other(".png", GREY8)(folder)), f"is a damaged image; {_AGAIN}"),
    "damaged header": (lambda folder: _cut(_tiff(GREY8)(folder), 0.002), f"is a damaged TIFF (.*); {_AGAIN}"),
    "text": (_text, "is not a PNG, JPEG, TIFF or BMP image"),
    "not finite": (
        _tiff(np.where(BITS, np.float32(np.nan), REAL)),
        "contains grey values that are not finite",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_both_refuse_in_the_same_words(kind: str, tmp_path: Path) -> None:
    write, message = REFUSED[kind]
    path = write(tmp_path)
    texts = []
    for read in (read_image, lambda path: open_scan(path).window(0, H, 0, W)):
        with pytest.raises(ImageError) as caught:
            read(path)
        texts.append(str(caught.value))
    assert texts[0] == texts[1]
    expected = re.escape(message).replace(re.escape("(.*)"), r"\(.*\)")
    assert re.search(rf"a\.\w+: {expected}$", texts[0])


def test_both_refuse_damaged_strips_in_the_same_words(tmp_path: Path) -> None:
    path = _noise_in(_tiff(GREY8, compression="zlib", rowsperstrip=10)(tmp_path))
    texts = []
    for read in (read_image, lambda path: open_scan(path).window(0, H, 0, W)):
        with pytest.raises(ImageError, match="is a damaged TIFF") as caught:
            read(path)
        texts.append(str(caught.value))
    assert texts[0] == texts[1]


def test_both_name_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none.tif"):
        texts = []
        for read in (read_image, open_scan):
            with pytest.raises(InputError, match="cannot be read") as caught:
                read(path)
            texts.append(str(caught.value))
        assert texts[0] == texts[1]


def test_an_unknown_channel_is_named(tmp_path: Path) -> None:
    path = _other(".png", RGB8)(tmp_path)
    with pytest.raises(
        UsageError, match="cyan: is not a channel; use luma, red, green, blue or interpolated"
    ):
        read_image(path, "cyan")  # type: ignore[arg-type]


@pytest.mark.parametrize(("suffix", "code"), [("mp4", "mp4v"), ("avi", "MJPG"), ("mkv", "MJPG")])
def test_a_film_is_called_one(tmp_path: Path, suffix: str, code: str) -> None:
    path = tmp_path / f"film.{suffix}"
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 10, (64, 48))
    film.write(np.zeros((48, 64, 3), np.uint8))
    film.release()
    with pytest.raises(ImageError, match="is a video; write some of its pictures"):
        read_image(path)
