"""Scans of any size: an overview, and windows at full resolution, without reading the rest.

An uncompressed TIFF is mapped into memory, of a compressed one only the strips or tiles that a window needs
are decoded. Channels stay apart.
"""

from __future__ import annotations

import mmap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import ImageError, InputError
from .images import decoded

__all__ = ["CHANNELS", "Scan", "open_scan", "scan_of"]

CHANNELS = {1: ("grey",), 3: ("red", "green", "blue")}
"""Names of the channels by their number."""
_STRIPE = 256
"""Rows that are decoded at a time for an overview."""
_WHOLE = 60_000_000
"""Samples up to which an image is averaged whole; of a larger one some rows and columns are enough."""

_HELD, _AROUND = 50_000_000, 65_536
"""Bytes of a mapped file that are held in memory, and those that a system maps around one that is read."""

Window = Callable[[int, int, int, int], NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Scan:
    """A scanned image, opened.

    Parameters
    ----------
    name : str
        What it is called in messages and results.
    width, height : int
        Columns and rows.
    channels : tuple of str
        ``grey``, or ``red``, ``green``, ``blue``.
    full_scale : float
        Grey value at which it saturates.
    dpi : float or None
        Resolution as the file says it; None where it says none.
    window : callable
        `window(top, bottom, left, right)` reads rows and columns [top, bottom) × [left, right), within the
        image, as (rows, columns, channels) in the file's own type.
    """

    name: str
    width: int
    height: int
    channels: tuple[str, ...]
    full_scale: float
    dpi: float | None
    window: Window

    def overview(self, longest: int) -> tuple[NDArray[np.float32], float]:
        """The image reduced so that its longer side has at most so many pixels.

        Returns
        -------
        (ndarray (h, w, channels), float)
            Grey values, and the reduction r: pixel (i, j) of the overview has its centre at
            ((j + 0.5)·r − 0.5, (i + 0.5)·r − 0.5) of the image.
        """
        r = max(1, int(np.ceil(max(self.width, self.height) / longest)))
        thin = max(1, r // 4) if self.width * self.height * len(self.channels) > _WHOLE else 1
        h, w = self.height // r, self.width // r
        out = np.empty((h, w, len(self.channels)), dtype=np.float32)
        step = max(1, _STRIPE // r)
        for top in range(0, h, step):
            rows = min(step, h - top)
            part = self.window(top * r, (top + rows) * r, 0, w * r)
            # From the middle of each group on, so that the centres stay where they are.
            part = np.ascontiguousarray(part[thin // 2 :: thin, thin // 2 :: thin])
            for c in range(out.shape[2]):
                small = cv2.resize(part[:, :, c], (w, rows), interpolation=cv2.INTER_AREA)
                out[top : top + rows, :, c] = small
        return out, float(r)


def scan_of(pixels: NDArray[Any], name: str = "scan", dpi: float | None = None) -> Scan:
    """A scan that is in memory: (h, w) or (h, w, 3), 8 or 16 bit.

    Raises
    ------
    ImageError
        When it is no such image.
    """
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.dtype not in (np.uint8, np.uint16):
        raise ImageError(
            f"has grey values of type {pixels.dtype}", where=name, do="convert it to 8 or 16 bit grey or RGB"
        )
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3, 4) or min(pixels.shape[:2]) < 2:
        raise ImageError(f"has the shape {pixels.shape}", where=name, do="convert it to grey or RGB")
    colours = pixels[:, :, :3]
    h, w, c = colours.shape
    scale = float(np.iinfo(pixels.dtype).max)
    return Scan(name, w, h, CHANNELS[c], scale, dpi, lambda t, b, le, r: colours[t:b, le:r])


def open_scan(path: Path | str) -> Scan:
    """Open an image file: TIFF of any size, PNG, JPEG or BMP; grey or RGB, 8 or 16 bit.

    Raises
    ------
    InputError
        When the file cannot be read.
    ImageError
        When it is no image, a damaged one, or of a kind in which no edges can be measured.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream:
            magic = stream.read(64)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path) from None
    if magic[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return _open_tiff(path)
    pixels = decoded(path, magic[:32])
    if pixels.ndim == 3:
        pixels = pixels[:, :, 2::-1]
    return scan_of(pixels, path.name, _coded_dpi(magic))


def _coded_dpi(magic: bytes) -> float | None:
    """Resolution of a JFIF header or of a PNG whose ``pHYs`` comes at once; others are not looked for."""
    if magic[6:11] == b"JFIF\0":
        unit, density = magic[13], int.from_bytes(magic[14:16], "big")
        # 72 and 96 are what programs write that do not know.
        known = unit in (1, 2) and density not in (0, 1, 72, 96)
        return density * (1.0 if unit == 1 else 2.54) if known else None
    if magic[37:41] == b"pHYs" and magic[49:50] == b"\x01":
        return int.from_bytes(magic[41:45], "big") * 0.0254 or None
    return None


def _open_tiff(path: Path) -> Scan:
    import tifffile

    try:
        with tifffile.TiffFile(path) as tiff:
            page = tiff.pages.first
            _usable(page, path)
            # The file must hold what its header promises; to map beyond its end is a fault of the bus.
            ends = [o + n for o, n in zip(page.dataoffsets, page.databytecounts, strict=True)]
            if not ends or max(ends) > path.stat().st_size:
                raise ImageError("is a truncated TIFF", where=path, do="copy or scan it anew")
            window = _mapped(page, path) if page.is_memmappable else _decoding(page, path)
            dpi = _tiff_dpi(page)
    except ImageError:
        raise
    except Exception as error:  # tifffile and its codecs raise of every kind on damaged files
        raise ImageError(f"is a damaged TIFF ({error})", where=path, do="copy or scan it anew") from None
    colours = CHANNELS[3 if page.samplesperpixel >= 3 else 1]
    scale = float(np.iinfo(page.dtype).max)
    if page.photometric == 0:  # white is zero
        stored = window
        window = lambda t, b, le, r: np.iinfo(page.dtype).max - stored(t, b, le, r)  # noqa: E731
    return Scan(path.name, page.imagewidth, page.imagelength, colours, scale, dpi, window)


def _usable(page: Any, path: Path) -> None:
    import tifffile

    colour = tifffile.PHOTOMETRIC(page.photometric).name
    help_ = "convert it to grey or RGB of 8 or 16 bit"
    if colour not in ("MINISBLACK", "MINISWHITE", "RGB", "YCBCR"):
        known = {"SEPARATED": "CMYK", "PALETTE": "a palette"}.get(colour, colour)
        raise ImageError(f"is a TIFF of colour {known}", where=path, do=help_)
    if page.bitspersample not in (8, 16) or page.dtype is None or page.dtype.kind != "u":
        kind = "floating point" if page.sampleformat == 3 else "integer"
        raise ImageError(f"is a TIFF of {page.bitspersample} bit {kind} per sample", where=path, do=help_)
    if page.samplesperpixel not in (1, 2, 3, 4) or page.imagedepth > 1:
        raise ImageError(f"is a TIFF of {page.samplesperpixel} samples per pixel", where=path, do=help_)
    if min(page.imagewidth, page.imagelength) < 2:
        raise ImageError(f"is a TIFF of {page.imagewidth}×{page.imagelength} pixels", where=path)


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
            # What was read stays in the system's cache, but no longer counts as ours; views of it stay valid.
            whole._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]
            touched = 0
        return np.asarray(pixels[top:bottom, left:right]).astype(page.dtype, copy=False)

    return window


def _channels_last(pixels: NDArray[Any], page: Any) -> NDArray[Any]:
    if pixels.ndim == 2:
        return pixels[:, :, None]
    planes = page.planarconfig == 2 and page.samplesperpixel > 1
    last = np.moveaxis(pixels, 0, -1) if planes else pixels
    return last[:, :, : 3 if last.shape[2] >= 3 else 1]


def _decoding(page: Any, path: Path) -> Window:
    """Windows of a compressed image: the strips or tiles they touch are decoded, the last ones kept."""
    high, wide = (page.tilelength, page.tilewidth) if page.is_tiled else (page.rowsperstrip, page.imagewidth)
    across = -(-page.imagewidth // wide)
    down = -(-page.imagelength // high)
    planes = page.samplesperpixel if page.planarconfig == 2 else 1
    channels = 3 if page.samplesperpixel >= 3 else 1
    tables, kept = page.jpegtables, dict[int, NDArray[Any]]()

    def segment(index: int) -> NDArray[Any]:
        if index not in kept:
            with path.open("rb") as stream:
                stream.seek(page.dataoffsets[index])
                coded = stream.read(page.databytecounts[index])
            try:
                found = page.decode(coded, index, jpegtables=tables)[0]
            except Exception as error:
                raise ImageError(
                    f"is a damaged TIFF ({error})", where=path, do="copy or scan it anew"
                ) from None
            # Enough for the segments of one row of them.
            while len(kept) >= max(2 * across * planes, 4):
                kept.pop(next(iter(kept)))
            kept[index] = np.zeros((high, wide, channels), page.dtype) if found is None else found[0]
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


def _tiff_dpi(page: Any) -> float | None:
    tag, unit = page.tags.get("XResolution"), page.tags.get("ResolutionUnit")
    if tag is None or unit is None or int(unit.value) not in (2, 3):
        return None
    over, under = tag.value
    dpi = over / under * (1.0 if int(unit.value) == 2 else 2.54) if under else 0.0
    return float(dpi) if dpi > 1 and dpi not in (72.0, 96.0) else None
