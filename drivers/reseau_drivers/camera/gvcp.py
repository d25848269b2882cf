"""Commands to GigE Vision cameras beside the library: whether one answers and is free, and action commands.

Libraries retry for many seconds. Source: AIA, *GigE Vision* 2.0: commands DISCOVERY, READREG and ACTION of
the control protocol (sections 14, 16 and 18), register Control Channel Privilege (section 28).
"""

from __future__ import annotations

import ipaddress
import socket
import time
from collections.abc import Iterable

import psutil  # type: ignore[import-untyped, unused-ignore]

from reseau.core.errors import ConnectionLost, RefusedError
from reseau.instruments import Deadline

from ..codecs.gige import PORT, PRIVILEGE, Action, Command, Kind, Status

_EXCLUSIVE, _CONTROL = 0x1, 0x2
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
    if is_ip(address):
        _answer(address, Kind.DISCOVERY, b"", deadline)


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
    if not is_ip(address):
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
    status, value = _register(address, PRIVILEGE, deadline)
    # Where another application has exclusive access, others may not even read.
    return _EXCLUSIVE if status == Status.ACCESS_DENIED else value if status == 0 else 0


def _register(address: str, register: int, deadline: Deadline) -> tuple[int, int]:
    """Return status and value of a register."""
    answer = _answer(address, Kind.READ_REGISTER, register.to_bytes(4, "big"), deadline)
    return int.from_bytes(answer[:2], "big"), int.from_bytes(answer[8:12], "big")


def _answer(address: str, command: Kind, data: bytes, deadline: Deadline) -> bytes:
    """Return the acknowledgement of a command, whatever its status."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for number in range(1, _TRIES + 1):
            try:
                asking.connect((address, PORT))
                asking.settimeout(max(0.01, deadline.at_most(_TRY_S)))
                asking.send(Command(command, data, number).encode())
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


def send_action(cameras: Iterable[str], action: Action) -> None:
    """Send an action command to cameras: one packet to all that are in a network of this computer.

    Parameters
    ----------
    cameras : iterable of str
        IP addresses of the cameras.
    action : Action
        The command. It has no acknowledgement: a camera shows by its frame that it received it.

    Raises
    ------
    ConnectionLost
        If it cannot be sent.
    """
    command = Command(Kind.ACTION, action.encode(), acknowledge=False).encode()
    targets = dict.fromkeys(_broadcast_to(each) for each in cameras)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending:
        sending.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        for each in targets:
            try:
                sending.sendto(command, (each, PORT))
            except OSError as error:
                raise ConnectionLost(
                    f"the action command to {each} was not sent ({error.strerror})", do="check the network"
                ) from None


def _broadcast_to(address: str) -> str:
    """Broadcast address of the network of a camera; its own address if it is in none of this computer."""
    for interface in psutil.net_if_addrs().values():
        for each in interface:
            if each.family == socket.AF_INET and each.netmask:
                network = ipaddress.ip_network(f"{each.address}/{each.netmask}", strict=False)
                if ipaddress.ip_address(address) in network and network.num_addresses > 2:
                    return str(network.broadcast_address)
    return address


def is_ip(address: str) -> bool:
    """Whether a text is an IP address."""
    try:
        ipaddress.ip_address(address)
    except ValueError:
        return False
    return True
