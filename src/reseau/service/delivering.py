"""Send one message by apprise, in a process that reaches no address inside.

An address of an alarm is a URL, whose host may resolve to an address of this machine or of its network, or
lead there by a redirect, and may resolve to another one a moment later. Therefore not the URL is checked, but
each connection, at the moment at which it is made, with the address that it is made to.
"""

from __future__ import annotations

import ipaddress
import json
import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar

from pydantic import Field

from ..io import Document

Network = ipaddress.IPv4Network | ipaddress.IPv6Network
_PROXIES = ("http_proxy", "https_proxy", "all_proxy", "ftp_proxy")


class AlarmDelivery(Document, defer_build=False):
    """Where a service sends alarms, ``reseau-alarm-delivery/1``.

    Parameters
    ----------
    notify : tuple of str
        Addresses to which alarms are sent, as mailtos://user:password@example.org (URLs of apprise).
    inside : tuple of str
        Networks of the laboratory to which they may be sent, such as 192.168.1.0/24.
    repeat_hours : float
        Time after which an alarm that nobody acknowledged is sent again (h).

    Examples
    --------
    >>> AlarmDelivery(notify=("mailto://user:password@example.org",)).repeat_hours
    24.0
    """

    SCHEMA: ClassVar[str] = "reseau-alarm-delivery/1"

    # Content of a request, too: it has lists, and is a body that must be built when it is declared.
    notify: tuple[Annotated[str, Field(max_length=500)], ...] = Field(default=(), max_length=10, strict=False)
    inside: tuple[Annotated[str, Field(max_length=50)], ...] = Field(default=(), max_length=10, strict=False)
    repeat_hours: float = Field(default=24.0, ge=0.1, le=8760)


def networks_of(texts: Sequence[str]) -> tuple[Network, ...]:
    """Return networks of texts such as ``192.168.1.0/24`` or ``127.0.0.1``.

    Raises
    ------
    ValueError
        If one is no network.

    Examples
    --------
    >>> networks_of(["127.0.0.1"])
    (IPv4Network('127.0.0.1/32'),)
    """
    return tuple(ipaddress.ip_network(each) for each in texts)


def is_reachable(host: str, inside: Sequence[Network] = ()) -> bool:
    """Return whether a message may be sent to an address: a public one, or one of the networks inside.

    Examples
    --------
    >>> is_reachable("8.8.8.8"), is_reachable("169.254.169.254"), is_reachable("::ffff:10.0.0.1")
    (True, False, False)
    >>> is_reachable("10.0.0.1", networks_of(["10.0.0.0/24"])), is_reachable("localhost")
    (True, False)
    """
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:  # a name, which has not been resolved, or a path
        return False
    if isinstance(address, ipaddress.IPv6Address):
        address = address.ipv4_mapped or address.sixtofour or address
    if any(address.version == each.version and address in each for each in inside):
        return True
    return address.is_global and not address.is_multicast


def _main() -> None:
    given = json.loads(sys.stdin.read())
    inside, refused = networks_of(given["inside"]), list[str]()
    # Through a proxy the address of the connection would say nothing about where it leads.
    for name in [each for each in os.environ if each.lower() in _PROXIES]:
        del os.environ[name]

    import apprise

    service = apprise.Apprise()
    for each in given["addresses"]:
        service.add(each)

    def watch(event: str, values: tuple[Any, ...]) -> None:
        if event in ("socket.connect", "socket.sendto", "socket.sendmsg"):
            target = values[1]
            host = target[0] if isinstance(target, tuple) and isinstance(target[0], str) else ""
            if not is_reachable(host, inside):
                refused.append(host or "a socket of this machine")
                raise PermissionError(f"{host} is an address inside")
        elif event in ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn"):
            refused.append("a program of this machine")
            raise PermissionError("programs are not run")

    sys.addaudithook(watch)
    try:
        delivered = bool(service.notify(title=given["title"], body=given["body"]))
    except Exception as error:  # whatever a plugin raises
        delivered = False
        refused = refused or [type(error).__name__]
    print(json.dumps({"delivered": delivered, "refused": sorted(set(refused))}))


if __name__ == "__main__":
    _main()
