"""Screens that instruments send as bare pixels, or behind a head of their own, as PNG or BMP files.

Sources: Rigol DS1000D and DS1000E, whose ``:LCD:DATA?`` is in no manual, as described at improwis.com ("Rigol
scope wifi") and read by riglol-snap; GW Instek's own dso1kb.py for ``:DISPlay:OUTPut?``; Owon's SCPI
protocol of the HDS200, and the one of port 3000 as robert-hh/owonread describes it; Hantek's protocol of USB
as elinux.org ("Das Oszi Protocol") describes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reseau.core.errors import ProtocolError

from ..codecs.ieee488 import parse_block, picture
from ..codecs.stream import excerpt


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
    return _of_words(np.repeat(pairs[:, 1], pairs[:, 0]))


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


def _packets(answer: bytes) -> tuple[bytes, int]:
    """Data of the packets of a screen, and the number of bytes that are missing."""
    at, data = 0, bytearray()
    while len(answer) - at >= 3:
        end = at + 3 + int.from_bytes(answer[at + 1 : at + 3], "little")
        if answer[at : at + 1] != b"S" or end - at < 6:
            raise ProtocolError(f"not a packet: {excerpt(answer[at:])}")
        if len(answer) < end:
            return bytes(data), end - len(answer)
        if answer[end - 1] != sum(answer[at : end - 1]) & 0xFF or answer[at + 3] != 0xA0:
            raise ProtocolError("a packet of another command, or with a wrong checksum")
        kind, content = answer[at + 4], answer[at + 5 : end - 1]
        if kind == 2:
            if content[:1] != bytes([sum(data) & 0xFF]):
                raise ProtocolError("the picture was damaged in transmission")
            return bytes(data), 0
        data += content
        at = end
    return bytes(data), 3 - (len(answer) - at)


def packets_missing(answer: bytes) -> int:
    """Return the least number of bytes that are missing from the packets of a screen; 0 if it is complete.

    Raises
    ------
    ProtocolError
        If they are no packets, or damaged.

    Examples
    --------
    >>> packets_missing(b"S\x04"), packets_missing(bytes.fromhex("53 04 00 A0 02 00 F9"))
    (1, 0)
    """
    return _packets(answer)[1]


def pixels_of_packets(answer: bytes, palette: Sequence[str]) -> bytes:
    """Return the screen of a Hantek: packets with a byte or a word for each pixel.

    Parameters
    ----------
    answer : bytes
        The packets.
    palette : sequence of str
        Colours of the codes, in hexadecimal.

    Raises
    ------
    ProtocolError
        If it has another size.

    Examples
    --------
    >>> pixels_of_packets(bytes.fromhex("53 04 00 A0 02 00 F9"), [])
    Traceback (most recent call last):
    reseau.core.errors.ProtocolError: a screen of 0 bytes, not 800×480 pixels of one or two
    """
    data, _ = _packets(answer)
    if len(data) == 2 * 800 * 480:
        return _of_words(np.frombuffer(data, "<u2"))
    if len(data) != 800 * 480:
        raise ProtocolError(f"a screen of {len(data)} bytes, not 800×480 pixels of one or two")
    colours = np.frombuffer(bytes.fromhex("".join(palette)), np.uint8).reshape(-1, 3)
    return _png(colours[np.frombuffer(data, np.uint8).reshape(480, 800), ::-1])


def _of_words(values: NDArray[np.uint16]) -> bytes:
    """A screen 800 pixels wide of words with 5, 6 and 5 bits."""
    values = values.reshape(-1, 800)
    blue, green, red = (values & 0x1F) << 3, values >> 3 & 0xFC, values >> 8 & 0xF8
    return _png(np.stack([blue, green, red], axis=-1).astype(np.uint8))


def _png(pixels: NDArray[Any]) -> bytes:
    return bytes(cv2.imencode(".png", pixels)[1])
