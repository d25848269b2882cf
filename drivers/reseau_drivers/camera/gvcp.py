"""Whether a camera of GigE Vision answers, and is free, asked directly: libraries retry for many seconds.

Source: AIA, *GigE Vision* 2.0: commands DISCOVERY and READREG of the control protocol (sections 14 and 16),
register Control Channel Privilege (section 28).
"""

from __future__ import annotations

import ipaddress
import socket
import struct
import time

from reseau.core.errors import ConnectionLost, RefusedError
from reseau.instruments import Deadline

__all__ = ["HEARTBEAT_S", "controlled_elsewhere", "require_answer", "require_control"]

_PORT = 3956
_COMMAND = struct.Struct(">BBHHH")
"""Key, flags (acknowledge), command, length of what follows, number of the request."""
_KEY, _ACKNOWLEDGE = 0x42, 0x01
_DISCOVERY, _READREG = 0x0002, 0x0080
_PRIVILEGE = 0x0A00
_EXCLUSIVE, _CONTROL = 0x1, 0x2
_DENIED = 0x8006
"""GEV_STATUS_ACCESS_DENIED: one who has exclusive access lets nobody else read."""
_TRY_S = 0.2
_TRIES = 5
_PAUSE_S = 0.05
HEARTBEAT_S = 3.0
"""After which a camera takes control from one that is silent: register Heartbeat Timeout, as switched on."""


def require_answer(address: str, deadline: Deadline) -> None:
    """Make sure that a camera answers at an IP address; other identifiers are not asked.

    Raises
    ------
    ConnectionLost
        When none answers.
    """
    if _is_ip(address):
        _answer(address, _DISCOVERY, b"", deadline)


def require_control(address: str, deadline: Deadline, ours_until: float = 0.0) -> None:
    """Make sure that nobody controls a camera at an IP address; other identifiers are not asked.

    Parameters
    ----------
    address : str
        Of the camera.
    deadline : Deadline
        Of the question.
    ours_until : float, optional
        Until when, by the monotonic clock, control may be one's own, of a connection that broke; until then
        it is waited for.

    Raises
    ------
    RefusedError
        When somebody does.
    ConnectionLost
        When none answers.
    """
    if not _is_ip(address):
        return
    while _privilege(address, deadline) & (_EXCLUSIVE | _CONTROL):
        if time.monotonic() >= ours_until or deadline.expired:
            raise controlled_elsewhere(address)
        time.sleep(deadline.at_most(_PAUSE_S))


def controlled_elsewhere(address: str) -> RefusedError:
    """What is to be said of a camera that another program has."""
    hint = f"end that program; if it died, the camera is free {HEARTBEAT_S:.0f} s later"
    return RefusedError(f"{address} is controlled by another program", do=hint)


def _privilege(address: str, deadline: Deadline) -> int:
    """Who has which access; where that register cannot be read, the library is left to find out."""
    status, value = _register(address, _PRIVILEGE, deadline)
    return _EXCLUSIVE if status == _DENIED else value if status == 0 else 0


def _register(address: str, register: int, deadline: Deadline) -> tuple[int, int]:
    """Status and value of a register."""
    answer = _answer(address, _READREG, register.to_bytes(4, "big"), deadline)
    return int.from_bytes(answer[:2], "big"), int.from_bytes(answer[8:12], "big")


def _answer(address: str, command: int, data: bytes, deadline: Deadline) -> bytes:
    """The acknowledgement of a command, of whatever status."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for number in range(1, _TRIES + 1):
            try:
                asking.connect((address, _PORT))
                asking.settimeout(max(0.01, deadline.at_most(_TRY_S)))
                asking.send(_COMMAND.pack(_KEY, _ACKNOWLEDGE, command, len(data), number) + data)
                answer = asking.recv(2048)
                # An acknowledgement has the number of the command, and one more; a late one is as good.
                if len(answer) >= 8 and answer[2:4] == (command + 1).to_bytes(2, "big"):
                    return answer
            except OSError:
                # Refused at once, or no answer in time: packets get lost, a camera may be starting.
                pass
            if deadline.expired:
                break
    raise ConnectionLost(f"{address} does not answer", do="is it switched on, and the address right?")


def _is_ip(address: str) -> bool:
    try:
        ipaddress.ip_address(address)
    except ValueError:
        return False
    return True
