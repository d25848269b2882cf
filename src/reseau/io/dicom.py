"""DICOM files as photographs: one frame of a file, with its grey values.

Source: DICOM PS3.3, C.7.6.3 "Image Pixel" and C.11.1 "Modality LUT". Grey values are those of the file after
its modality transformation (`RescaleSlope` and `RescaleIntercept`, or a table); a window for the display is
not applied. In MONOCHROME1 the largest value is black; it is inverted. pydicom decodes the transfer syntaxes
whose decoders are installed: uncompressed, RLE and deflated always; JPEG (8 bits) and JPEG 2000 with Pillow.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import ImageError, InputError
from ..core.optional import optional
from .scans import CHANNELS, Scan, check_least, check_most

_SUFFIXES = (".dcm", ".dicom", ".dic", ".ima")


def is_dicom(path: Path, head: bytes) -> bool:
    """Return whether a file is DICOM, by its first 132 bytes, or by its suffix where it has no preamble."""
    if head[128:132] == b"DICM":
        return True
    # Without a preamble, a file begins with group 0002 or 0008, little or big endian.
    groups = (b"\x02\x00", b"\x08\x00", b"\x00\x02", b"\x00\x08")
    return path.suffix.lower() in _SUFFIXES and head[:2] in groups


def count_dicom(path: Path) -> int:
    """Number of frames of a file.

    Raises
    ------
    InputError, ImageError
        When it cannot be read, or is damaged.
    """
    return max(1, int(_header(path).get("NumberOfFrames", 1) or 1))


def exposure_of_dicom(path: Path) -> float | None:
    """Exposure time (µs) that a file states; None without one.

    Raises
    ------
    InputError, ImageError
        When it cannot be read, or is damaged.
    """
    header = _header(path)
    for keyword, unit in (("ExposureTimeInuS", 1.0), ("ExposureTime", 1e3)):
        try:
            value = float(header.get(keyword, None) or 0)
        except (TypeError, ValueError):
            continue
        if value > 0:
            return value * unit
    return None


def _header(path: Path) -> Any:
    with optional():
        import pydicom
    with _quiet(), _readable(path):
        return pydicom.dcmread(path, stop_before_pixels=True, force=True)


def open_dicom(path: Path, number: int | None, most_pixels: int) -> Scan:
    """Decode one frame of a file.

    Parameters
    ----------
    path : Path
        The file.
    number : int or None
        Number of the frame, from 1; None for the first, with a note if the file has several.
    most_pixels : int
        Largest number of pixels of a frame.

    Raises
    ------
    InputError
        When the file cannot be read.
    ImageError
        When it contains no such frame, is damaged, or is compressed in a way that cannot be decoded.
    UsageError
        When pydicom is not installed.
    """
    with optional():
        import pydicom
        import pydicom.pixels  # not imported by pydicom itself
    decoding: Any = pydicom.pixels
    with _quiet(), _readable(path):
        header = pydicom.dcmread(path, stop_before_pixels=True, force=True)
        rows, columns = int(header.get("Rows", 0) or 0), int(header.get("Columns", 0) or 0)
        count = int(header.get("NumberOfFrames", 1) or 1)
        syntax = header.file_meta.get("TransferSyntaxUID", None) if hasattr(header, "file_meta") else None
    if not rows or not columns:
        raise ImageError("is a DICOM file without an image", where=path)
    check_least(path, columns, rows)
    check_most(path, columns, rows, most_pixels)
    index = 0 if number is None else number - 1
    if not 0 <= index < count:
        raise ImageError(f"has {count} frames; there is no frame {number}", where=path)
    if syntax is not None:
        _check_decoder(pydicom, syntax, path)
    with _quiet(), _readable(path):
        dataset = pydicom.dcmread(path, force=True)
        if syntax is None:  # a file without its meta information has the default of PS3.5
            dataset.ensure_file_meta()
            dataset.file_meta.TransferSyntaxUID = pydicom.uid.ImplicitVRLittleEndian
        try:
            values = decoding.pixel_array(dataset, index=index)
        except RuntimeError as error:
            raise _undecoded(syntax, path, str(error)) from None
        values, low, high = _grey_values(values, dataset, decoding)
    name = path.name if count == 1 else f"{path.name}#{index + 1}"
    notes: tuple[str, ...] = ()
    if number is None and count > 1:
        notes = (f"{path.name} has {count} frames; the first is used, {path.name}#2 names the second",)
    pixels = values[:, :, None] if values.ndim == 2 else values
    if pixels.ndim != 3 or pixels.shape[2] not in CHANNELS or not np.isfinite(pixels).all():
        kind = header.get("PhotometricInterpretation", "unknown")
        raise ImageError(
            f"has pixels of the kind {kind}, {values.shape}", where=path, do="convert it to grey"
        )
    if str(header.get("PhotometricInterpretation", "")) == "MONOCHROME1":
        pixels = np.asarray(low + high - pixels, dtype=pixels.dtype)
    return Scan(
        name,
        columns,
        rows,
        CHANNELS[pixels.shape[2]],
        high,
        _dpi(header),
        pixels.dtype,
        lambda t, b, le, r: pixels[t:b, le:r],
        notes,
    )


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress pydicom's warnings about files that deviate from the standard but can be read."""
    log = logging.getLogger("pydicom")
    before = log.disabled
    log.disabled = True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.disabled = before


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Convert the exceptions of pydicom, which have no common class, to errors of one line."""
    try:
        yield
    except ImageError:
        raise
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error})", where=path) from None
    except Exception as error:
        raise ImageError(f"is a damaged DICOM file ({error})", where=path, do="copy it again") from None


def _check_decoder(pydicom: Any, syntax: Any, path: Path) -> None:
    try:
        if not pydicom.pixels.get_decoder(syntax).is_available:
            raise NotImplementedError
    except (NotImplementedError, KeyError):
        raise _undecoded(syntax, path) from None


def _undecoded(syntax: Any, path: Path, why: str = "") -> ImageError:
    return ImageError(
        f"is compressed as {syntax.name} ({syntax}), which cannot be decoded" + (f" ({why})" if why else ""),
        where=path,
        do="decompress it (gdcmconv --raw), or install pylibjpeg's decoders",
    )


def _grey_values(values: NDArray[Any], dataset: Any, pixels: Any) -> tuple[NDArray[Any], float, float]:
    """Values of a frame after the modality transformation; their lowest and highest possible value."""
    kind, bits = str(dataset.get("PhotometricInterpretation", "")), int(dataset.get("BitsStored", 8) or 8)
    if kind == "PALETTE COLOR":
        values = pixels.apply_color_lut(values, dataset)
        return values, 0.0, float(np.iinfo(values.dtype).max)
    if values.dtype.kind == "f":  # PS3.3, C.7.6.24: no number of bits
        return values.astype(np.float32), 0.0, float(max(values.max(), 1e-9))
    signed = values.dtype.kind == "i"
    ends = np.array([-(2 ** (bits - 1)), 2 ** (bits - 1) - 1] if signed else [0, 2**bits - 1])
    if values.ndim == 3:
        return values if values.itemsize < 4 else values.astype(np.float32), 0.0, float(ends[1])
    # Bits above those stored may carry an overlay of older files.
    values = np.clip(values, *ends.astype(values.dtype))
    plain = (
        float(dataset.get("RescaleSlope", 1) or 1) == 1
        and float(dataset.get("RescaleIntercept", 0) or 0) == 0
    )
    if plain and "ModalityLUTSequence" not in dataset:
        if values.dtype.itemsize > 2:
            values = values.astype(np.float32)
        return values, float(ends[0]), float(ends[1])
    low, high = sorted(float(end) for end in pixels.apply_modality_lut(ends, dataset))
    return np.asarray(pixels.apply_modality_lut(values, dataset), dtype=np.float32), low, high


def _dpi(header: Any) -> float | None:
    """Resolution of a scanner, in pixels per inch, where the file states it and both axes agree."""
    try:
        down, across = (float(step) for step in header.get("NominalScannedPixelSpacing", None) or (0, 0))
    except (TypeError, ValueError):
        return None
    return 25.4 / down if down > 0 and abs(down - across) < 1e-3 * down else None
