r"""Zaber's ASCII protocol: chained motion controllers with one or more axes.

Source: *Zaber ASCII Protocol Manual*, sections "Message Format" and "Checksumming". A command is
``/device axis id words:LRC\n``; a reply is ``@device axis id OK|RJ IDLE|BUSY flag data:LRC\r\n``, an info
starts with ``#``, an alert with ``!``. The checksum is the two's complement of the sum of the bytes between
the first one and the colon.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import ClassVar

from reseau.core.errors import ProtocolError, SettingError

from .stream import LineMessageDecoder, excerpt

LIMIT = 512
"""Largest size of an accepted message (bytes); devices send at most 80 by default."""

_REPLY = re.compile(rb"(\d{1,2}) (\d)(?: (\d{2}))? (OK|RJ) (IDLE|BUSY) ([A-Z]{2}|--) ([ -~]+)")
_INFO = re.compile(rb"(\d{1,2}) (\d)(?: (\d{2}))? ([ -~]*)")
_ALERT = re.compile(rb"(\d{1,2}) (\d) (IDLE|BUSY) ([A-Z]{2}|--)(?: ([ -~]*))?")


def lrc(content: bytes) -> bytes:
    """Return the checksum of a message as two hexadecimal digits; `content` is the part before the colon.

    Examples
    --------
    >>> lrc(b"01 0 00 tools echo")
    b'BF'
    """
    return b"%02X" % (-sum(content) & 0xFF)


@dataclass(frozen=True)
class Command:
    """Command to a device.

    Parameters
    ----------
    device, axis : int
        0 addresses all.
    words : str
        Command with its arguments; empty queries the status.
    id : int or None
        0 to 99; the reply repeats it.
    """

    device: int
    axis: int
    words: str
    id: int | None = None


@dataclass(frozen=True)
class Reply:
    """Answer of a device to a command."""

    lead: ClassVar[bytes] = b"@"
    device: int
    axis: int
    id: int | None
    ok: bool
    busy: bool
    flag: str
    data: str


@dataclass(frozen=True)
class Info:
    """Further line of an answer."""

    lead: ClassVar[bytes] = b"#"
    device: int
    axis: int
    id: int | None
    data: str


@dataclass(frozen=True)
class Alert:
    """Unsolicited message of a device."""

    lead: ClassVar[bytes] = b"!"
    device: int
    axis: int
    busy: bool
    flag: str
    data: str = ""


Message = Reply | Info | Alert


def encode(message: Command | Message) -> bytes:
    r"""Encode a message with its checksum.

    Raises
    ------
    SettingError
        If the words of a command cannot be sent.

    Examples
    --------
    >>> encode(Command(1, 2, "move abs 1000", 7))
    b'/01 2 07 move abs 1000:B8\n'
    """
    number = "" if getattr(message, "id", None) is None else f" {message.id:02d}"  # type: ignore[union-attr]
    if isinstance(message, Command):
        if not message.words.isascii() or any(c in message.words for c in "/:\n\r\\"):
            raise SettingError(
                "contains characters that the protocol does not allow", where=repr(message.words)
            )
        if not (0 <= message.device <= 99 and 0 <= message.axis <= 9 and (message.id or 0) in range(100)):
            raise SettingError("device must be 0…99, axis 0…9, id 0…99", where=repr(message))
        content = f"{message.device:02d} {message.axis}{number} {message.words}".rstrip().encode("ascii")
        return b"/" + content + b":" + lrc(content) + b"\n"
    text = f"{message.device:02d} {message.axis}{number} "
    if isinstance(message, Reply):
        text += f"{'OK' if message.ok else 'RJ'} "
    if not isinstance(message, Info):
        text += f"{'BUSY' if message.busy else 'IDLE'} {message.flag} "
    content = f"{text}{message.data}".rstrip().encode("ascii")
    return message.lead + content + b":" + lrc(content) + b"\r\n"


def _content(line: bytes) -> bytes:
    """Return the part between the first byte and the checksum; verify the checksum if there is one."""
    content, colon, check = line[1:].partition(b":")
    if colon and check.upper() != lrc(content):
        raise ProtocolError(f"a message with a wrong checksum: {excerpt(line)}")
    return content


def _number(text: bytes | None) -> int | None:
    return None if text is None else int(text)


def decode(line: bytes) -> Message:
    """Decode a message of a device.

    Raises
    ------
    ProtocolError
        If the line is not a message.
    """
    # After noise, the message starts at the last byte that can start one.
    start = max(line.rfind(b"@"), line.rfind(b"#"), line.rfind(b"!")) if line[:1] not in b"@#!" else 0
    line = line[max(start, 0) :]
    content, lead = _content(line), line[:1]
    if lead == b"@" and (found := _REPLY.fullmatch(content)):
        device, axis, id_, ok, busy, flag, data = found.groups()
        return Reply(
            int(device), int(axis), _number(id_), ok == b"OK", busy == b"BUSY", flag.decode(), data.decode()
        )
    if lead == b"#" and (found := _INFO.fullmatch(content)):
        device, axis, id_, data = found.groups()
        return Info(int(device), int(axis), _number(id_), data.decode())
    if lead == b"!" and (found := _ALERT.fullmatch(content)):
        device, axis, busy, flag, data = found.groups()
        return Alert(int(device), int(axis), busy == b"BUSY", flag.decode(), (data or b"").decode())
    raise ProtocolError(f"not a message of a Zaber device: {excerpt(line)}")


def decode_command(line: bytes) -> Command:
    """Decode a command; omitted numbers are 0.

    Raises
    ------
    ProtocolError
        If the line is not a command.
    """
    start = line.rfind(b"/")
    if start < 0:
        raise ProtocolError(f"not a command: {excerpt(line)}")
    content = _content(line[start:])
    if not content.isascii():
        raise ProtocolError(f"not a command: {excerpt(line)}")
    words, numbers = content.decode("ascii").split(), list[int]()
    while words and len(numbers) < 3 and words[0].isdigit():
        numbers.append(int(words.pop(0)))
    device, axis, id_ = (numbers[k] if k < len(numbers) else None for k in range(3))
    if max(device or 0, id_ or 0) > 99 or (axis or 0) > 9:
        raise ProtocolError(f"not a command: {excerpt(line)}")
    return Command(device or 0, axis or 0, " ".join(words), id_)


class MessageDecoder(LineMessageDecoder[Message]):
    """Decode messages of devices from a stream."""

    def __init__(self) -> None:
        super().__init__(decode, limit=LIMIT)
