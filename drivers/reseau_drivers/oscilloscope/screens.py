"""Screens that instruments send as bare pixels, or behind a head of their own, as PNG or BMP files.

Sources: Rigol DS1000D and DS1000E, whose ``:LCD:DATA?`` is in no manual, as described at improwis.com ("Rigol
scope wifi") and read by riglol-snap; GW Instek's own dso1kb.py for ``:DISPlay:OUTPut?``; Owon's SCPI
protocol of the HDS200, and the one of port 3000 as robert-hh/owonread describes it.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau.core.errors import ProtocolError

from ..codecs.ieee488 import parse_block, picture

__all__ = ["bytes_of_colours", "picture_after", "runs_of_colours"]


def bytes_of_colours(answer: bytes) -> bytes:
    """Return the screen of a Rigol DS1000E: a byte for each pixel, two bits red, three green, three blue.

    Raises
    ------
    ProtocolError
        If it has another size.

    Examples
    --------
    >>> bytes_of_colours(b"#3004" + bytes(4))
    Traceback (most recent call last):
    reseau.core.errors.ProtocolError: a screen of 4 pixels, not 320×234
    """
    values = np.frombuffer(parse_block(answer), np.uint8)
    if len(values) != 320 * 234:
        raise ProtocolError(f"a screen of {len(values)} pixels, not 320×234")
    blue, green, red = values << 5 & 0xE0, values << 2 & 0xE0, values & 0xC0
    return _png(np.stack([blue, green, red], axis=-1).reshape(234, 320, 3))


def runs_of_colours(answer: bytes) -> bytes:
    """Return the screen of a GW Instek: pairs of a number of pixels and their colour (5, 6 and 5 bits).

    Raises
    ------
    ProtocolError
        If its pixels do not fill a screen of 800×480 or 800×600.

    Examples
    --------
    >>> runs_of_colours(b"#14" + bytes([2, 0, 0, 0]))
    Traceback (most recent call last):
    reseau.core.errors.ProtocolError: a screen of 2 pixels, not 800×480 or 800×600
    """
    content = parse_block(answer)
    pairs = np.frombuffer(content, "<u2", len(content) // 4 * 2).reshape(-1, 2)
    count = int(pairs[:, 0].sum(dtype=np.int64))
    if count not in (800 * 480, 800 * 600):
        raise ProtocolError(f"a screen of {count} pixels, not 800×480 or 800×600")
    values = np.repeat(pairs[:, 1], pairs[:, 0]).reshape(-1, 800)
    blue, green, red = (values & 0x1F) << 3, values >> 3 & 0xFC, values >> 8 & 0xF8
    return _png(np.stack([blue, green, red], axis=-1).astype(np.uint8))


def picture_after(answer: bytes, ahead: int) -> bytes:
    r"""Return the picture behind bytes of which the first four are its size.

    Raises
    ------
    ProtocolError
        If it has another size.

    Examples
    --------
    >>> picture_after(b"\x09\0\0\0BM", 4)
    Traceback (most recent call last):
    reseau.core.errors.ProtocolError: an incomplete picture (2 bytes)
    """
    found, announced = picture(answer[ahead:]), int.from_bytes(answer[:4], "little")
    if len(found) != announced:
        raise ProtocolError(f"a picture of {len(found)} bytes; {announced} were announced")
    return found


def _png(pixels: NDArray[Any]) -> bytes:
    return bytes(cv2.imencode(".png", pixels)[1])
