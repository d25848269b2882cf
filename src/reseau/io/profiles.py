"""Tone curves stated in image files: ICC profiles, and the tags of PNG and Exif for sRGB and powers.

A profile is that of ICC.1:2022, 7 (header and tags), 10.6 (``curv``) and 10.18 (``para``). Of the channels
the green one stands for all; profiles that state tables of colours instead of curves are not read. PNG: third
edition, 11.3.2, of which ``cICP`` counts before ``iCCP``, ``sRGB`` and ``gAMA``.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ..core.tone import ToneCurve

_SAMPLES = 4096
"""Entries of a table that stands for a formula."""
_MOST = 4_000_000
"""Bytes of the largest profile that is unpacked; those of cameras have a few thousand."""
_SRGB_IN_EXIF = 1
_TRANSFERS: dict[int, ToneCurve] = {4: ToneCurve(2.2), 5: ToneCurve(2.8), 13: ToneCurve(None)}
"""Curves by their numbers in ITU-T H.273, which ``cICP`` states."""


def curve_of_file(path: Path, magic: bytes) -> ToneCurve | None:
    """Curve stated in a PNG or JPEG file; None if there is none that can be read, or a straight line.

    Parameters
    ----------
    path : Path
        The file.
    magic : bytes
        Its first bytes.
    """
    try:
        if magic.startswith(b"\x89PNG"):
            found = _of_png(path)
        elif magic.startswith(b"\xff\xd8"):
            found = _of_jpeg(path)
        else:
            return None
    except (OSError, ValueError, IndexError, zlib.error):
        return None  # what describes the pixels is damaged, not the pixels
    return None if found is None or found.linear else found


def curve_of_profile(profile: bytes) -> ToneCurve | None:
    """Curve of an ICC profile; None if it is damaged, has none, or a straight line.

    Examples
    --------
    >>> tag = b"curv" + bytes(4) + (1).to_bytes(4, "big") + round(2.2 * 256).to_bytes(2, "big")
    >>> entry = b"kTRC" + (144).to_bytes(4, "big") + len(tag).to_bytes(4, "big")
    >>> profile = bytes(36) + b"acsp" + bytes(88) + (1).to_bytes(4, "big") + entry + tag
    >>> str(curve_of_profile(profile))
    'a power of 0.45'
    """
    try:
        found = _of_profile(profile)
    except (ValueError, IndexError):
        return None
    return None if found is None or found.linear else found


def _number(data: bytes, at: int, size: int) -> int:
    if at < 0 or at + size > len(data):
        raise ValueError("beyond the end")
    return int.from_bytes(data[at : at + size], "big")


def _of_profile(profile: bytes) -> ToneCurve | None:
    if profile[36:40] != b"acsp":
        return None
    tags = {}
    for k in range(min(_number(profile, 128, 4), 200)):
        entry = 132 + 12 * k
        offset, size = _number(profile, entry + 4, 4), _number(profile, entry + 8, 4)
        tags[profile[entry : entry + 4]] = profile[offset : offset + size]
    coded = tags.get(b"gTRC", tags.get(b"kTRC"))
    name = _name(tags.get(b"desc", b""))
    source = f"colour profile {name!r}" if name else "colour profile"
    if coded is None:
        return None
    if coded[:4] == b"para":
        return _parametric(coded, source)
    if coded[:4] != b"curv":
        return None
    count = _number(coded, 8, 4)
    if count <= 1:
        return ToneCurve(_number(coded, 12, 2) / 256 if count else 1.0, source=source)
    if len(coded) < 12 + 2 * count:
        return None
    values = np.frombuffer(coded, ">u2", count, 12) / 65535
    return ToneCurve(None, tuple(values.tolist()), source) if (np.diff(values) >= 0).all() else None


def _parametric(coded: bytes, source: str) -> ToneCurve | None:
    """Y = (a X + b)^g + e from X = d on, and c X + f below it; table 68."""
    kind = _number(coded, 8, 2)
    count = {0: 1, 1: 3, 2: 4, 3: 5, 4: 7}.get(kind)
    if count is None or len(coded) < 12 + 4 * count:
        return None
    given = (np.frombuffer(coded, ">i4", count, 12) / 65536).tolist()
    if kind == 0:
        return ToneCurve(given[0], source=source) if given[0] > 0 else None
    g, a, b = given[:3]
    c, d, e, f = 0.0, 0.0, 0.0, 0.0
    if kind <= 2:
        d = -b / a if a else 0.0
        e = f = given[3] if kind == 2 else 0.0
    else:
        c, d = given[3:5]
        e, f = given[5:] if kind == 4 else (0.0, 0.0)
    x = np.linspace(0.0, 1.0, _SAMPLES)
    light = np.where(x >= d, np.clip(a * x + b, 0.0, None) ** g + e, c * x + f)
    if not np.isfinite(light).all() or (np.diff(light) < -1e-4).any():
        return None
    return ToneCurve(None, tuple(np.clip(light, 0.0, 1.0).tolist()), source)


def _name(described: bytes) -> str:
    """Name of a profile, from its description of version 2 or 4."""
    if described[:4] == b"desc":
        text = described[12 : 12 + _number(described, 8, 4)].decode("latin-1")
    elif described[:4] == b"mluc" and len(described) >= 28:
        size, offset = _number(described, 20, 4), _number(described, 24, 4)
        text = described[offset : offset + size].decode("utf-16-be", "ignore")
    else:
        return ""
    return "".join(letter for letter in text if letter.isprintable()).strip()[:60]


# PNG


def _of_png(path: Path) -> ToneCurve | None:
    chunks = dict(_chunks(path))
    if len(coded := chunks.get(b"cICP", b"")) == 4:
        known = _TRANSFERS.get(coded[1])
        return None if known is None else ToneCurve(known.exponent, source="cICP tag")
    if b"iCCP" in chunks:
        _, _, packed = chunks[b"iCCP"].partition(b"\0")
        return curve_of_profile(zlib.decompressobj().decompress(packed[1:], _MOST))
    if b"sRGB" in chunks:
        return ToneCurve(None, source="sRGB tag")
    if b"gAMA" in chunks and (gamma := _number(chunks[b"gAMA"], 0, 4)):
        return ToneCurve(1e5 / gamma, source="gAMA tag")
    return None


def _chunks(path: Path) -> Iterator[tuple[bytes, bytes]]:
    """Names and contents of the chunks of a PNG before its pixels."""
    with path.open("rb") as stream:
        stream.seek(8)
        while len(head := stream.read(8)) == 8 and head[4:] not in (b"IDAT", b"IEND"):
            length = int.from_bytes(head[:4], "big")
            if length > _MOST:
                return
            yield head[4:], stream.read(length)
            stream.seek(4, 1)  # its check sum


# JPEG


def _of_jpeg(path: Path) -> ToneCurve | None:
    parts, exif = {}, b""
    for segment in _segments(path):
        if segment.startswith(b"ICC_PROFILE\0"):
            parts[segment[12]] = segment[14:]
        elif segment.startswith(b"Exif\0\0"):
            exif = segment[6:]
    if parts:
        return curve_of_profile(b"".join(parts[k] for k in sorted(parts)))
    if _colour_space(exif) == _SRGB_IN_EXIF:
        return ToneCurve(None, source="Exif tag of sRGB")
    return None


def _segments(path: Path) -> Iterator[bytes]:
    """Contents of the APP1 and APP2 segments of a JPEG before its pixels."""
    with path.open("rb") as stream:
        stream.seek(2)
        while len(head := stream.read(4)) == 4 and head[0] == 0xFF and head[1] != 0xDA:
            length = int.from_bytes(head[2:], "big") - 2
            if length < 0:
                return
            if head[1] in (0xE1, 0xE2):
                yield stream.read(length)
            else:
                stream.seek(length, 1)


def _colour_space(exif: bytes) -> int | None:
    """The tag ColorSpace of Exif data, which have the form of a TIFF."""
    order: Any = {b"II": "little", b"MM": "big"}.get(exif[:2])
    if order is None:
        return None

    def value(directory: int, tag: int, size: int) -> int | None:
        count = int.from_bytes(exif[directory : directory + 2], order)
        ends = range(directory + 2, directory + 2 + 12 * (count + 1), 12)
        for begin, end in pairwise(ends):
            if int.from_bytes(exif[begin : begin + 2], order) == tag and end <= len(exif):
                return int.from_bytes(exif[begin + 8 : begin + 8 + size], order)
        return None

    below = value(int.from_bytes(exif[4:8], order), 0x8769, 4)
    return None if below is None else value(below, 0xA001, 2)
