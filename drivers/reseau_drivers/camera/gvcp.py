"""Check directly whether a GigE Vision camera answers and is free; libraries retry for many seconds.

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
"""Key, flags (acknowledge), command, length of the payload, number of the request."""
_KEY, _ACKNOWLEDGE = 0x42, 0x01
_DISCOVERY, _READREG = 0x0002, 0x0080
_PRIVILEGE = 0x0A00
_EXCLUSIVE, _CONTROL = 0x1, 0x2
_DENIED = 0x8006
"""GEV_STATUS_ACCESS_DENIED: another application has exclusive access; others may not even read."""
_TRY_S = 0.2
_TRIES = 5
_PAUSE_S = 0.05
HEARTBEAT_S = 3.0
"""Time after which a camera releases the control of a silent application (default Heartbeat Timeout, s)."""


def require_answer(address: str, deadline: Deadline) -> None:
    """Raise if no camera answers at an IP address; other identifiers are not checked.

    Raises
    ------
    ConnectionLost
        If no camera answers.
    """
    if _is_ip(address):
        _answer(address, _DISCOVERY, b"", deadline)


def require_control(address: str, deadline: Deadline, ours_until: float = 0.0) -> None:
    """Raise if an application controls the camera at an IP address; other identifiers are not checked.

    Parameters
    ----------
    address : str
        IP address of the camera.
    deadline : Deadline
        Time limit.
    ours_until : float, optional
        Until this time of the monotonic clock, the control may still be that of an own connection that broke;
        until then the function waits.

    Raises
    ------
    RefusedError
        If another application controls the camera.
    ConnectionLost
        If no camera answers.
    """
    if not _is_ip(address):
        return
    while _privilege(address, deadline) & (_EXCLUSIVE | _CONTROL):
        if time.monotonic() >= ours_until or deadline.expired:
            raise controlled_elsewhere(address)
        time.sleep(deadline.at_most(_PAUSE_S))


def controlled_elsewhere(address: str) -> RefusedError:
    """Return the error for a camera that another program controls."""
    hint = f"close that program; after a crash the camera is free {HEARTBEAT_S:.0f} s later"
    return RefusedError(f"{address} is controlled by another program", do=hint)


def _privilege(address: str, deadline: Deadline) -> int:
    """Return the access bits; 0 if the register cannot be read, so that the library finds out."""
    status, value = _register(address, _PRIVILEGE, deadline)
    return _EXCLUSIVE if status == _DENIED else value if status == 0 else 0


def _register(address: str, register: int, deadline: Deadline) -> tuple[int, int]:
    """Return status and value of a register."""
    answer = _answer(address, _READREG, register.to_bytes(4, "big"), deadline)
    return int.from_bytes(answer[:2], "big"), int.from_bytes(answer[8:12], "big")


def _answer(address: str, command: int, data: bytes, deadline: Deadline) -> bytes:
    """Return the acknowledgement of a command, whatever its status."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for number in range(1, _TRIES + 1):
            try:
                asking.connect((address, _PORT))
                asking.settimeout(max(0.01, deadline.at_most(_TRY_S)))
                asking.send(_COMMAND.pack(_KEY, _ACKNOWLEDGE, command, len(data), number) + data)
                answer = asking.recv(2048)
                # The acknowledgement has the number of the command plus one; a late one is accepted too.
                if len(answer) >= 8 and answer[2:4] == (command + 1).to_bytes(2, "big"):
                    return answer
            except OSError:
                # Connection refused or no answer: packets get lost, a camera may be starting up.
                pass
            if deadline.expired:
                break
    raise ConnectionLost(f"{address} does not answer", do="check power and address")


def _is_ip(address: str) -> bool:
    try:
        ipaddress.ip_address(address)
    except ValueError:
        return False
    return True
