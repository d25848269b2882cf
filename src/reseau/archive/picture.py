"""A frame as the bytes of a TIFF, with what is known of it; the same frame and facts give the same bytes."""

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
    """An uncompressed grey TIFF; the facts are JSON in its description.

    Parameters
    ----------
    frame : Frame
        Pixels of 8 or 16 bits, or of 32-bit floats.
    facts : mapping
        JSON values; no clock times, so that the same exposure has the same hash.

    Raises
    ------
    ArchiveError
        When the pixels are of no type that a TIFF of greys holds.
    """
    import tifffile

    pixels = frame.pixels.astype(np.float32) if frame.pixels.dtype == np.float64 else frame.pixels
    if pixels.dtype not in (np.uint8, np.uint16, np.float32):
        raise ArchiveError(f"has grey values of type {pixels.dtype}", where=frame.name)
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
    """The frame and the facts of a TIFF that :func:`tiff_of` made.

    Returns
    -------
    (Frame, dict)
        The frame has the SHA-256 of the file.

    Raises
    ------
    ArchiveError
        When it is none.
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
    except Exception as error:  # tifffile raises of every kind on what is no TIFF
        raise ArchiveError(f"is no frame of an archive ({error})", where=where) from None
