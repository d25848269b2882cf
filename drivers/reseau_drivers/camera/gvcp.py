"""Whether a camera of GigE Vision answers, asked directly: libraries retry for many seconds.

Source: AIA, *GigE Vision* 2.0, section 14: a DISCOVERY command of the control protocol, acknowledged.
"""

from __future__ import annotations

import ipaddress
import socket

from reseau.errors import ConnectionLost
from reseau.instruments import Deadline

__all__ = ["require_answer"]

_PORT = 3956
_DISCOVERY = bytes.fromhex("4211 0002 0000 0001")
"""Key, flags (acknowledge), command, length of what follows, number of the request."""
_ACKNOWLEDGED = bytes.fromhex("0000 0003")
_TRY_S = 0.2
_TRIES = 5


def require_answer(address: str, deadline: Deadline) -> None:
    """Make sure that a camera answers at an IP address; other identifiers are not asked.

    Raises
    ------
    ConnectionLost
        When none answers.
    """
    try:
        ipaddress.ip_address(address)
    except ValueError:
        return
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
        for _ in range(_TRIES):
            try:
                asking.connect((address, _PORT))
                asking.settimeout(max(0.01, deadline.at_most(_TRY_S)))
                asking.send(_DISCOVERY)
                if asking.recv(2048)[:4] == _ACKNOWLEDGED:
                    return
            except OSError:
                # Refused at once, or no answer in time: packets get lost, a camera may be starting.
                pass
            if deadline.over:
                break
    raise ConnectionLost(f"{address} does not answer", do="is it switched on, and the address right?")
