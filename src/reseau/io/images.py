"""Image files: one reader for whole frames and for windows of scans, and a writer.

Accepted files: PNG, JPEG and BMP as OpenCV decodes them; WebP, GIF, AVIF, JPEG 2000, plain PGM and PPM as
Pillow does, of an animation the first picture; and a page of a TIFF (``scan.tif#2`` is the second,
``scan.tif`` the first) with grey or RGB samples of 1, 8 or 16 bit, signed 16 bit, or floating point,
uncompressed or in a compression that tifffile decodes; and a frame of a DICOM file, see
:mod:`reseau.io.dicom`. Other grey values are never rescaled; an alpha channel is ignored, and so is
an orientation tag: pixel coordinates are those of the sensor. A colour profile does not change grey values:
its curve is given beside them.

An uncompressed TIFF is mapped into memory; of a compressed one only the strips or tiles that a window touches
are decoded, unless imagecodecs is not installed.
"""

from __future__ import annotations

import mmap
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ..core.data import Frame
from ..core.errors import ImageError, InputError, UsageError
from ..core.files import head_of, readable, split_frame
from ..core.provenance import sha256_of
from ..core.tone import ToneCurve
from . import write_whole
from .dicom import is_dicom, open_dicom
from .photographs import decoded_heic, decoded_raw, is_heic, is_raw, mosaic_of_raw
from .profiles import curve_of_file, curve_of_profile
from .scans import CHANNELS, Scan, Window, check_least, check_most, full_scale_of, scan_of

MAX_PIXELS = 500_000_000
"""The largest image that is read whole; its header is checked before a pixel is decoded."""

_LUMA = {"blue": 0.114, "green": 0.587, "red": 0.299}
"""Weights of Rec. 601, in the order in which they are summed."""
_HELD, _AROUND = 50_000_000, 65_536
"""Bytes of a mapped file that are held in memory, and bytes that a system maps around one that is read."""
_DECODED = 50_000_000
"""Bytes of decoded strips or tiles that are kept: windows side by side cross the same ones."""
_HELP = "convert it to grey or RGB of 8 or 16 bit"
_AGAIN = "copy or scan it again"
_BY_OPENCV = (5, 7, 8, 32946)
"""Compressions LZW, JPEG and Deflate of a TIFF, which OpenCV decodes, too."""

_LUMAS = ("luma", "interpolated")
Channel = Literal["luma", "red", "green", "blue", "interpolated"]


def read_image(path: Path | str, channel: Channel = "luma", digest: str | None = None) -> Frame:
    """Read an image file as a grey frame.

    Parameters
    ----------
    path : path
        PNG, JPEG, BMP, TIFF, HEIC, WebP, AVIF, GIF, JPEG 2000, PGM, a raw file or DICOM; see
        :mod:`reseau.io.images` for the kinds of TIFF. ``loop.dcm#3`` is the third frame of a DICOM file;
        without a number the first is read, with a note.
    channel : {"luma", "red", "green", "blue", "mosaic"}
        Channel of a colour image that is used. A lens images colours at slightly different scales; a single
        channel avoids the shifts that this causes. ``luma`` of a raw file are its pixels behind their filters
        of 2 × 2 pixels, none interpolated; its other channels, and ``interpolated``, its luma, are
        interpolated between them. The pixels of a grey image are the same for every channel.
    digest : str, optional
        SHA-256 of the file, if it is known.

    Returns
    -------
    Frame
        Grey values in the scale of the file.

    Raises
    ------
    InputError
        When the file cannot be read.
    ImageError
        When it is not an image, damaged, of an unsupported kind, or larger than `MAX_PIXELS`.
    UsageError
        When there is no such channel.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_image(Path(folder) / "flat.png", np.full((4, 6), 200, dtype=np.uint8))
    ...     frame = read_image(Path(folder) / "flat.png")
    >>> frame.name, frame.width, frame.height, frame.full_scale
    ('flat.png', 6, 4, 255.0)
    """
    path = Path(path)
    if channel not in get_args(Channel):
        raise UsageError("is not a channel", where=channel, do="use luma, red, green, blue or interpolated")
    scan = open_scan(path, mosaic=channel == "luma")
    digest = sha256_of(path) if digest is None else digest
    check_most(path, scan.width, scan.height, MAX_PIXELS)
    pixels = scan.window(0, scan.height, 0, scan.width)
    grey = np.array(pixels[:, :, 0]) if len(scan.channels) == 1 else grey_of(pixels, channel, scan.channels)
    return Frame(grey, scan.full_scale, scan.name, digest, scan.notes, scan.curve, scan.filters)


def grey_of(
    pixels: NDArray[Any], channel: Channel, channels: tuple[str, ...] = ("red", "green", "blue")
) -> NDArray[Any]:
    """A channel (h, w) of colours (h, w, 3), or their luma.

    Examples
    --------
    >>> grey_of(np.array([[[10, 20, 30]]], np.uint8), "luma")
    array([[18]], dtype=uint8)
    """
    if channel not in _LUMAS:
        return np.array(pixels[:, :, channels.index(channel)])
    return luma(pixels, channels)


def luma(pixels: NDArray[Any], channels: tuple[str, ...]) -> NDArray[Any]:
    """Return the grey values (h, w) of colours (h, w, 3), with the weights of Rec. 601 and of their type.

    Examples
    --------
    >>> luma(np.full((1, 2, 3), 200, dtype=np.uint8), CHANNELS[3])
    array([[200, 200]], dtype=uint8)
    """
    grey = np.zeros(pixels.shape[:2], dtype=np.float32)
    for name, weight in _LUMA.items():
        grey += np.float32(weight) * pixels[:, :, channels.index(name)]
    return grey if pixels.dtype.kind == "f" else np.rint(grey).astype(pixels.dtype)


def open_scan(path: Path | str, *, mosaic: bool = False) -> Scan:
    """Open an image file to read it window by window.

    Parameters
    ----------
    path : path
        As for :func:`read_image`; a TIFF may have any size.
    mosaic : bool
        Whether pixels of a raw file behind filters of 2 × 2 pixels are wanted as they are, not interpolated.

    Raises
    ------
    InputError
        When the file cannot be read.
    ImageError
        When it is not an image, damaged, or of an unsupported kind.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_image(Path(folder) / "flat.tif", np.full((400, 600), 9, dtype=np.uint16))
    ...     scan = open_scan(Path(folder) / "flat.tif")
    ...     scan.channels, scan.window(100, 102, 200, 203).shape
    (('grey',), (2, 3, 1))
    """
    whole, number = split_frame(Path(path))
    magic = head_of(whole)
    if not magic:
        raise ImageError("is empty", where=path, do=_AGAIN)
    if is_dicom(whole, magic):
        return open_dicom(whole, number, MAX_PIXELS)
    path = Path(path)
    if is_raw(path):
        if mosaic and (found := mosaic_of_raw(path)):
            pixels, full_scale, filters = found
            return replace(scan_of(pixels, path.name), full_scale=full_scale, filters=filters)
        return scan_of(decoded_raw(path), path.name)
    if is_heic(magic):
        return scan_of(decoded_heic(path), path.name)
    if magic[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return _open_tiff(path, whole, number)
    if number is not None:
        what = "is no TIFF or DICOM file, which could have several images"
        raise ImageError(what, where=path, do=f"give {whole.name}")
    if kind := coded_kind(magic):
        decoded, notes = decoded_coded(path, kind, MAX_PIXELS)
        return replace(scan_of(decoded, path.name), notes=notes)
    pixels = _decoded(path, magic)
    check_least(path, pixels.shape[1], pixels.shape[0])
    if pixels.ndim == 3:
        pixels = pixels[:, :, 2::-1] if pixels.shape[2] >= 3 else pixels[:, :, :1]
    return replace(scan_of(pixels, path.name, _coded_dpi(magic)), curve=curve_of_file(path, magic))


# PNG, JPEG and BMP


def _decoded(path: Path, magic: bytes) -> NDArray[Any]:
    """Pixels of a PNG, JPEG or BMP with the given first bytes: (h, w), or (h, w, c) in the order BGR."""
    import cv2

    check_most(path, *_header_size(magic, path), MAX_PIXELS)
    coded = np.fromfile(path, dtype=np.uint8)
    # The decoder fills the missing part of a truncated file with grey, silently: check the end mark.
    end = {b"\x89P": b"IEND", b"\xff\xd8": b"\xff\xd9"}.get(magic[:2], b"")
    # Telephones append films and previews to a JPEG: its end mark may be far from the end of the file.
    if end not in coded[-4096:].tobytes() and not _complete_jpeg(coded.tobytes()):
        raise ImageError("is a truncated image", where=path, do=_AGAIN)
    try:
        pixels = cv2.imdecode(coded, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise ImageError("is a damaged image", where=path, do=_AGAIN)
    return np.asarray(pixels)


def _complete_jpeg(coded: bytes) -> bool:
    """Whether the end mark of a JPEG follows its first scan; it cannot occur inside of one."""
    at = 2
    while coded[:2] == b"\xff\xd8" and coded[at : at + 1] == b"\xff":
        if coded[at + 1] == 0xDA:
            return b"\xff\xd9" in coded[at:]
        at += 2 + int.from_bytes(coded[at + 2 : at + 4], "big")
    return False


def _header_size(magic: bytes, path: Path) -> tuple[int, int]:
    """Width and height stated in the header of a PNG, JPEG or BMP."""
    if magic.startswith(b"\x89PNG\r\n\x1a\n"):
        return int.from_bytes(magic[16:20], "big"), int.from_bytes(magic[20:24], "big")
    if magic.startswith(b"BM"):
        return (
            abs(int.from_bytes(magic[18:22], "little", signed=True)),
            abs(int.from_bytes(magic[22:26], "little", signed=True)),
        )
    if _is_video(magic):
        raise ImageError(
            "is a video", where=path, do="write some of its pictures, sharp and from different sides, as PNG"
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
        raise ImageError("is a damaged JPEG", where=path, do=_AGAIN)
    raise ImageError("is not a PNG, JPEG, TIFF or BMP image", where=path)


def _is_video(magic: bytes) -> bool:
    """Whether a file begins like MP4, QuickTime, AVI or Matroska."""
    avi = magic[:4] == b"RIFF" and magic[8:12] == b"AVI "
    return avi or magic[4:8] in (b"ftyp", b"moov") or magic[:4] == b"\x1aE\xdf\xa3"


def _coded_dpi(magic: bytes) -> float | None:
    """Resolution of a JFIF header, or of a PNG with ``pHYs`` as its second chunk; others are not read."""
    if magic[6:11] == b"JFIF\0":
        unit, density = magic[13], int.from_bytes(magic[14:16], "big")
        # Programs that do not know the resolution write 72 or 96.
        known = unit in (1, 2) and density not in (0, 1, 72, 96)
        return density * (1.0 if unit == 1 else 2.54) if known else None
    if magic[37:41] == b"pHYs" and magic[49:50] == b"\x01":
        return int.from_bytes(magic[41:45], "big") * 0.0254 or None
    return None


# TIFF


def _open_tiff(given: Path, path: Path, number: int | None) -> Scan:
    """Open a page of a TIFF, by default the first, of the file `path` that was `given` with its number."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as tiff:
            page: Any = tiff.pages.first if number is None else _page(tiff, given, number)
            full_scale = _usable(page, path)
            mapped = page.is_memmappable and page.dtype.kind != "b"
            # The file must hold all data: reading a mapping beyond the end of its file is a bus error.
            if mapped:
                ends = [page.dataoffsets[0] + page.nbytes]
            else:
                ends = [o + n for o, n in zip(page.dataoffsets, page.databytecounts, strict=True)]
            if not ends or max(ends) > path.stat().st_size:
                raise ImageError("is a truncated TIFF", where=path, do=_AGAIN)
            window = _mapped(page, path) if mapped else _decoding(page, path)
            dpi, curve = _tiff_dpi(page), _tiff_curve(page)
            notes = _further_pages(tiff, path) if number is None else ()
    except ImageError:
        raise
    except Exception as error:  # tifffile and its codecs raise exceptions of every kind on damaged files
        raise _damaged(path, error) from None
    dtype = np.dtype(np.uint8 if page.dtype.kind == "b" else page.dtype)
    return Scan(
        given.name,
        page.imagewidth,
        page.imagelength,
        CHANNELS[_colours(page)],
        full_scale,
        dpi,
        dtype,
        _as_stored(window, page, path, dtype, full_scale),
        notes,
        curve,
    )


def _page(tiff: Any, given: Path, number: int) -> Any:
    """A page by its number, from 1; previews do not count."""
    pages = _pages(tiff)
    if not 1 <= number <= len(pages):
        raise ImageError(f"has {len(pages)} pages; there is no page {number}", where=given)
    return pages[number - 1]


def _pages(tiff: Any) -> list[Any]:
    return [tiff.pages.first, *(page for page in tiff.pages[1:] if not page.subfiletype & 1)]


def count_pages(path: Path) -> int:
    """Number of images of a TIFF; previews do not count.

    Raises
    ------
    ImageError
        When it is damaged.
    """
    import tifffile

    try:
        with tifffile.TiffFile(path) as tiff:
            return len(_pages(tiff))
    except Exception as error:  # tifffile raises exceptions of every kind on damaged files
        raise _damaged(path, error) from None


def _further_pages(tiff: Any, path: Path) -> tuple[str, ...]:
    """A note if a file has images beside the first one."""
    try:
        count = len(_pages(tiff))
    except Exception:  # the chain of pages is damaged, and the first one is not
        return ("further pages are damaged; the first is used",)
    if count == 1:
        return ()
    return (f"has {count} pages, of which the first is used; {path.name}#2 is the second",)


def _damaged(path: Path, error: Exception) -> ImageError:
    # A message of tifffile, or an import, where its optional package is not installed.
    if isinstance(error, ImportError) or "imagecodecs" in str(error):
        return _needs_imagecodecs(path)
    return ImageError(f"is a damaged TIFF ({error})", where=path, do=_AGAIN)


def _needs_imagecodecs(path: Path) -> ImageError:
    what = "is a TIFF in a compression that needs imagecodecs, which is not installed"
    return ImageError(what, where=path, do="pip install 'reseau[photographs]'")


def _usable(page: Any, path: Path) -> float:
    """Full scale of a page; raises when its kind is not supported."""
    import tifffile

    colour = tifffile.PHOTOMETRIC(page.photometric).name
    if colour not in ("MINISBLACK", "MINISWHITE", "RGB", "YCBCR"):
        known = {"SEPARATED": "CMYK", "PALETTE": "a palette"}.get(colour, colour)
        raise ImageError(f"is a TIFF of colour {known}", where=path, do=_HELP)
    coding = tifffile.COMPRESSION(page.compression).name
    # Codecs for photographs return RGB; others would return the luminance as red.
    if colour == "YCBCR" and coding in (
        "NONE",
        "LZW",
        "DEFLATE",
        "ADOBE_DEFLATE",
        "PACKBITS",
        "LZMA",
        "ZSTD",
    ):
        raise ImageError("is a TIFF of colour YCBCR that is not a JPEG", where=path, do=_HELP)
    if page.dtype is None:
        raise ImageError(f"has grey values of {page.bitspersample} bit", where=path, do=_HELP)
    dtype = np.dtype(page.dtype)
    full_scale = 255.0 if dtype.kind == "b" else full_scale_of(dtype, path)
    if page.samplesperpixel not in (1, 2, 3, 4) or page.imagedepth > 1:
        raise ImageError(f"is a TIFF of {page.samplesperpixel} samples per pixel", where=path, do=_HELP)
    check_least(path, page.imagewidth, page.imagelength)
    return full_scale


def _colours(page: Any) -> int:
    return 3 if page.samplesperpixel >= 3 else 1


def _as_stored(window: Window, page: Any, path: Path, dtype: np.dtype[Any], full_scale: float) -> Window:
    """Windows with bits as 0 and 255, with black at zero, and with finite values."""
    bits, real = page.dtype.kind == "b", dtype.kind == "f"
    inverted: Callable[[NDArray[Any]], NDArray[Any]] | None = None
    if page.photometric == 0:  # white is zero
        top = full_scale if real else np.iinfo(dtype).max
        inverted = lambda values: np.asarray(top - values, dtype=dtype)  # noqa: E731
    if not bits and not real and inverted is None:
        return window

    def stored(t: int, b: int, le: int, r: int) -> NDArray[Any]:
        values = window(t, b, le, r)
        if bits:
            values = values.astype(np.uint8) * np.uint8(255)
        if real and not np.isfinite(values).all():
            raise ImageError("contains grey values that are not finite", where=path.name)
        return values if inverted is None else inverted(values)

    return stored


def _mapped(page: Any, path: Path) -> Window:
    """Windows of an uncompressed image, mapped into memory."""
    order = ">" if page.parent.byteorder == ">" else "<"
    kind = np.dtype(page.dtype).newbyteorder(order)
    whole = np.memmap(path, dtype=kind, mode="r", offset=page.dataoffsets[0], shape=page.shape)
    pixels = _channels_last(whole, page)
    row, touched = whole.nbytes // page.imagelength, 0

    def window(top: int, bottom: int, left: int, right: int) -> NDArray[Any]:
        nonlocal touched
        touched += (bottom - top) * min(row, pixels.itemsize * pixels.shape[2] * (right - left) + 2 * _AROUND)
        if touched > _HELD and hasattr(mmap, "MADV_DONTNEED"):
            # The pages stay in the system's cache but no longer count as this process's; views stay valid.
            whole._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]
            touched = 0
        return np.asarray(pixels[top:bottom, left:right]).astype(page.dtype, copy=False)

    return window


def _channels_last(pixels: NDArray[Any], page: Any) -> NDArray[Any]:
    if pixels.ndim == 2:
        return pixels[:, :, None]
    planes = page.planarconfig == 2 and page.samplesperpixel > 1
    last = np.moveaxis(pixels, 0, -1) if planes else pixels
    return last[:, :, : _colours(page)]


def _decoding(page: Any, path: Path) -> Window:
    """Windows of a compressed image: decode the strips or tiles they touch, and keep the last ones."""
    if page.compression in _BY_OPENCV and not _has_imagecodecs():
        return _decoded_at_once(page, path)
    high, wide = (page.tilelength, page.tilewidth) if page.is_tiled else (page.rowsperstrip, page.imagewidth)
    high = min(high, page.imagelength) if not page.is_tiled else high
    across = -(-page.imagewidth // wide)
    down = -(-page.imagelength // high)
    planes = page.samplesperpixel if page.planarconfig == 2 else 1
    channels = _colours(page)
    tables, header, kept = page.jpegtables, page.jpegheader, dict[int, NDArray[Any]]()
    decode = page.decode  # made while the file is open: the decoder of JPEG looks into it

    def segment(index: int) -> NDArray[Any]:
        if index not in kept:
            with readable(path), path.open("rb") as stream:
                stream.seek(page.dataoffsets[index])
                coded = stream.read(page.databytecounts[index])
            try:
                found = decode(coded, index, jpegtables=tables, jpegheader=header)[0]
            except Exception as error:
                raise _damaged(path, error) from None
            # The oldest are dropped, but at least one row of segments is kept.
            size = high * wide * np.dtype(page.dtype).itemsize * (channels if planes == 1 else 1)
            while len(kept) >= max(2 * across * planes, 4, _DECODED // size):
                kept.pop(next(iter(kept)))
            empty = np.full((high, wide, channels), page.nodata, page.dtype)
            kept[index] = empty if found is None else found[0]
        return kept[index]

    def window(top: int, bottom: int, left: int, right: int) -> NDArray[Any]:
        out = np.zeros((bottom - top, right - left, channels), dtype=page.dtype)
        for i in range(top // high, -(-bottom // high)):
            for j in range(left // wide, -(-right // wide)):
                for plane in range(min(planes, channels)):
                    part = segment((plane * down + i) * across + j)
                    y0, y1 = max(top, i * high), min(bottom, i * high + part.shape[0])
                    x0, x1 = max(left, j * wide), min(right, j * wide + part.shape[1])
                    if y1 <= y0 or x1 <= x0:
                        continue
                    seen = part[y0 - i * high : y1 - i * high, x0 - j * wide : x1 - j * wide]
                    where = slice(plane, plane + 1) if planes > 1 else slice(None)
                    out[y0 - top : y1 - top, x0 - left : x1 - left, where] = seen[:, :, :channels]
        return out

    return window


def _has_imagecodecs() -> bool:
    try:
        import imagecodecs  # noqa: F401
    except ImportError:
        return False
    return True


def _decoded_at_once(page: Any, path: Path) -> Window:
    """Windows of an image that OpenCV decodes as a whole."""
    kept: list[NDArray[Any]] = []

    def window(top: int, bottom: int, left: int, right: int) -> NDArray[Any]:
        if not kept:
            import cv2

            done, found = cv2.imreadmulti(str(path), int(page.index), 1, flags=cv2.IMREAD_UNCHANGED)
            pixels = np.atleast_3d(found[0])[:, :, :3] if done else np.zeros((0, 0, 0))
            if (pixels.dtype, pixels.shape) != (
                page.dtype,
                (page.imagelength, page.imagewidth, _colours(page)),
            ):
                raise _needs_imagecodecs(path)
            # Blue comes first, and black is zero in images of 8 bit, whatever the file says.
            inverted = page.photometric == 0 and page.dtype == np.uint8
            kept.append(255 - pixels if inverted else pixels[:, :, ::-1])
        return kept[0][top:bottom, left:right]

    return window


def _tiff_dpi(page: Any) -> float | None:
    tag, unit = page.tags.get("XResolution"), page.tags.get("ResolutionUnit")
    if tag is None or unit is None or int(unit.value) not in (2, 3):
        return None
    over, under = tag.value
    dpi = over / under * (1.0 if int(unit.value) == 2 else 2.54) if under else 0.0
    return float(dpi) if dpi > 1 and dpi not in (72.0, 96.0) else None


def _tiff_curve(page: Any) -> ToneCurve | None:
    profile, exif = page.tags.get("InterColorProfile"), page.tags.get("ExifTag")
    if profile is not None:
        return curve_of_profile(bytes(profile.value))
    is_srgb = exif is not None and isinstance(exif.value, dict) and exif.value.get("ColorSpace") == 1
    return ToneCurve(None, source="Exif tag of sRGB") if is_srgb else None


def write_image(path: Path | str, pixels: NDArray[Any]) -> None:
    """Write an image completely or not at all.

    Parameters
    ----------
    path : path
        The suffix selects the format: PNG, JPEG or TIFF.
    pixels : ndarray (h, w) or (h, w, 3)
        Grey or RGB values of 8 or 16 bit.

    Raises
    ------
    InputError
        When the suffix is not one of these, or the file cannot be written.

    Examples
    --------
    >>> write_image("frame.gif", np.zeros((4, 6), dtype=np.uint8))
    Traceback (most recent call last):
    reseau.core.errors.InputError: frame.gif: has no suffix of an image; use .png, .jpg or .tif
    """
    import cv2

    path = Path(path)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg", ".tif", ".tiff"):
        raise InputError("has no suffix of an image", where=path, do="use .png, .jpg or .tif")
    options = [cv2.IMWRITE_PNG_COMPRESSION, 6] if path.suffix.lower() == ".png" else []
    _, coded = cv2.imencode(path.suffix, pixels[:, :, ::-1] if pixels.ndim == 3 else pixels, options)
    write_whole(path, coded.tobytes())


_JP2, _J2K = b"\0\0\0\x0cjP  \r\n\x87\n", b"\xff\x4f\xff\x51"


def coded_kind(magic: bytes) -> str:
    """The format of a file by its first bytes, at least 32; empty for any other.

    Examples
    --------
    >>> coded_kind(b"RIFF\\0\\0\\0\\0WEBPVP8 ")
    'WebP'
    """
    if magic[:4] == b"RIFF" and magic[8:12] == b"WEBP":
        return "WebP"
    if magic[:6] in (b"GIF87a", b"GIF89a"):
        return "GIF"
    if magic[4:8] == b"ftyp" and (b"avif" in magic[8:32] or b"avis" in magic[8:32]):
        return "AVIF"
    if magic.startswith((_JP2, _J2K)):
        return "JPEG 2000"
    if magic[:2] in (b"P5", b"P6") and magic[2:3].isspace():
        return "PGM"
    return ""


def decoded_coded(path: Path, kind: str, largest: int) -> tuple[NDArray[Any], tuple[str, ...]]:
    """Pixels of an image, and notes about it.

    Parameters
    ----------
    path : Path
        The file.
    kind : str
        Its format, as :func:`coded_kind` gives it.
    largest : int
        Number of pixels that it may have.

    Returns
    -------
    pixels : ndarray (h, w) or (h, w, 3)
        Grey values or colours, of 8 or 16 bit; a PGM of 10 or 12 bit is scaled to 16.
    notes : tuple of str
        Says that it has several pictures.

    Raises
    ------
    ImageError
        When it is damaged or too large.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings(), _whole_files():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as image:
                check_most(path, *image.size, largest)
                return _pixels(image), _notes(image)
    except ImageError:
        raise
    except Image.DecompressionBombError as error:
        raise ImageError(
            "has more pixels than a file of its kind may have", where=path, do="crop it"
        ) from error
    except (OSError, ValueError, SyntaxError, EOFError, RuntimeError) as error:
        raise ImageError(f"is a damaged {kind} image", where=path, do="copy it again") from error


@contextmanager
def _whole_files() -> Iterator[None]:
    """Refuse files that end too early, also where another library (WeasyPrint) has Pillow fill them up."""
    from PIL import ImageFile

    before, ImageFile.LOAD_TRUNCATED_IMAGES = ImageFile.LOAD_TRUNCATED_IMAGES, False
    try:
        yield
    finally:
        ImageFile.LOAD_TRUNCATED_IMAGES = before


def _pixels(image: Any) -> NDArray[Any]:
    """Grey values or colours, without transparency."""
    if image.mode in ("I;16", "I;16B", "I"):
        return np.asarray(image).astype(np.uint16)
    grey = image.mode in ("1", "L", "LA")
    return np.asarray(image.convert("L" if grey else "RGB"))


def _notes(image: Any) -> tuple[str, ...]:
    several = getattr(image, "n_frames", 1) > 1
    return ("has several pictures, of which the first is used",) if several else ()
