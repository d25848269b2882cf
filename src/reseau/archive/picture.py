"""Frames as TIFF files with metadata; the same frame and metadata give the same bytes."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core.data import Frame
from ..core.errors import ArchiveError
from ..core.provenance import sha256_of

__all__ = ["frame_of", "tiff_of"]

_SCHEMA = "reseau-frame/1"


def tiff_of(frame: Frame, facts: Mapping[str, Any]) -> bytes:
    """Return a frame as an uncompressed grey TIFF, with metadata as JSON in its description.

    Parameters
    ----------
    frame : Frame
        Pixels of 8 or 16 bits, or floats; floats are stored with 32 bits.
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

    pixels = frame.pixels.astype(np.float32) if frame.pixels.dtype == np.float64 else frame.pixels
    if pixels.dtype not in (np.uint8, np.uint16, np.float32):
        raise ArchiveError(f"has pixels of the unsupported type {pixels.dtype}", where=frame.name)
    about = {"schema": _SCHEMA, "name": frame.name, "full_scale": frame.full_scale, "facts": dict(facts)}
    stream = io.BytesIO()
    tifffile.imwrite(
        stream,
        pixels,
        photometric="minisblack",
        byteorder="<",
        description=json.dumps(about, sort_keys=True),
        metadata=None,
        software=False,
    )
    return stream.getvalue()


def frame_of(data: bytes, where: object) -> tuple[Frame, dict[str, Any]]:
    """Read the frame and the metadata of a TIFF made by :func:`tiff_of`.

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
    import tifffile

    try:
        with tifffile.TiffFile(io.BytesIO(data)) as tiff:
            page = tiff.pages.first
            about = json.loads(page.description)
            pixels = page.asarray()
        if about["schema"] != _SCHEMA:
            raise ValueError(about["schema"])
        return Frame(pixels, float(about["full_scale"]), about["name"], sha256_of(data)), about["facts"]
    except Exception as error:  # tifffile raises many kinds of exceptions for invalid files
        raise ArchiveError(f"is not a frame of an archive ({error})", where=where) from None
