"""Frames as TIFF files with metadata; the same frame and metadata give the same bytes."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.data import Frame
from ..core.errors import ArchiveError
from ..core.provenance import sha256_of
from ..core.tone import ToneCurve
from ..io.images import luma
from ..io.scans import CHANNELS, Scan, scan_of

_SCHEMA = "reseau-frame/1"


def tiff_of(frame: Frame | Scan, facts: Mapping[str, Any]) -> bytes:
    """Return a frame as an uncompressed grey TIFF, with metadata as JSON in its description.

    Parameters
    ----------
    frame : Frame or Scan
        Pixels of 8 or 16 bits, or floats; floats are stored with 32 bits. A scan is stored with its colours
        and its resolution.
    facts : mapping
        Metadata, JSON values; no times, so that the same exposure has the same hash.

    Raises
    ------
    ArchiveError
        If the pixels have another type.

    Examples
    --------
    >>> frame = Frame(np.zeros((2, 3), np.uint8), 255.0, "dark")
    >>> tiff_of(frame, {"gain": 0.0}) == tiff_of(frame, {"gain": 0.0})
    True
    """
    import tifffile

    about = {"schema": _SCHEMA, "name": frame.name, "full_scale": frame.full_scale, "facts": dict(facts)}
    if isinstance(frame, Scan):
        pixels = frame.window(0, frame.height, 0, frame.width)
        if len(frame.channels) == 1:
            pixels = pixels[:, :, 0]
        if frame.dpi is not None:
            about["dpi"] = frame.dpi
    else:
        pixels = frame.pixels
    if frame.curve is not None:
        about["curve"] = [frame.curve.exponent, list(frame.curve.table), frame.curve.source]
    if frame.filters:
        about["filters"] = frame.filters
    pixels = pixels.astype(np.float32) if pixels.dtype == np.float64 else pixels
    if pixels.dtype not in (np.uint8, np.uint16, np.float32):
        raise ArchiveError(f"has pixels of the unsupported type {pixels.dtype}", where=frame.name)
    stream = io.BytesIO()
    tifffile.imwrite(
        stream,
        pixels,
        photometric="minisblack" if pixels.ndim == 2 else "rgb",
        byteorder="<",
        description=json.dumps(about, sort_keys=True),
        metadata=None,
        software=False,
    )
    return stream.getvalue()


def frame_of(data: bytes, where: object) -> tuple[Frame, dict[str, Any]]:
    """Read the frame and the metadata of a TIFF made by :func:`tiff_of`; of colours their luma.

    Returns
    -------
    (Frame, dict)
        The frame, with the SHA-256 of the file, and the metadata.

    Raises
    ------
    ArchiveError
        If it is not such a file.

    Examples
    --------
    >>> frame, facts = frame_of(tiff_of(Frame(np.zeros((2, 3), np.uint8), 255.0), {"gain": 0.0}), "dark.tif")
    >>> frame.width, facts
    (3, {'gain': 0.0})
    """
    about, pixels = _read(data, where)
    if pixels.ndim == 3:
        pixels = luma(pixels, CHANNELS[3])
    try:
        frame = Frame(pixels, float(about["full_scale"]), about["name"], sha256_of(data), curve=_curve(about))
        return replace(frame, filters=about.get("filters", "")), about["facts"]
    except Exception as error:  # what is not of the schema
        raise ArchiveError(f"is not a frame of an archive ({error})", where=where) from None


def scan_in(data: bytes, where: object) -> Scan:
    """Read the frame of a TIFF made by :func:`tiff_of` as a scan, with its colours.

    Raises
    ------
    ArchiveError
        If it is not such a file.

    Examples
    --------
    >>> scan = scan_of(np.zeros((2, 3, 3), np.uint8), "07.tif", 2400.0)
    >>> found = scan_in(tiff_of(scan, {}), "07.tif")
    >>> found.channels, found.dpi
    (('red', 'green', 'blue'), 2400.0)
    """
    about, pixels = _read(data, where)
    try:
        scan = scan_of(pixels, about["name"], about.get("dpi"))
        return replace(scan, full_scale=float(about["full_scale"]), curve=_curve(about))
    except Exception as error:  # what is not of the schema
        raise ArchiveError(f"is not a frame of an archive ({error})", where=where) from None


def _read(data: bytes, where: object) -> tuple[dict[str, Any], NDArray[Any]]:
    import tifffile

    try:
        # The library's objects refer to one another: without its end the stream would keep the file for long.
        with io.BytesIO(data) as stream, tifffile.TiffFile(stream) as tiff:
            page = tiff.pages.first
            about = json.loads(page.description)
            pixels = page.asarray()
        if about["schema"] != _SCHEMA:
            raise ValueError(about["schema"])
        return about, pixels
    except Exception as error:  # tifffile raises many kinds of exceptions for invalid files
        raise ArchiveError(f"is not a frame of an archive ({error})", where=where) from None


def _curve(about: Mapping[str, Any]) -> ToneCurve | None:
    found = about.get("curve")
    return None if found is None else ToneCurve(found[0], tuple(found[1]), found[2])
