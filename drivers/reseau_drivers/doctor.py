"""What keeps a computer from an instrument: permissions, programs that hold it, network, firewall, packets.

Each finding is one line with what to do. Nothing is changed, and nothing is sent to an instrument but an
attempt to connect and echo requests.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
import stat
import subprocess
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import psutil  # type: ignore[import-untyped, unused-ignore]

from reseau.core.errors import ConnectionLost, InstrumentError
from reseau.instruments import Deadline, Finding

from .camera.gvcp import is_ip, require_control

_CONNECTS, _ECHOES, _LARGE_MTU = 5, 20, 8000
_BUFFER = 4 << 20
"""Buffer of a socket that takes a frame of some megapixels (bytes)."""
_PORTS = {"INSTR": 111, "hislip": 4880, "SOCKET": 5025}


def examine(driver: str, address: str, seconds: float = 2.0) -> Iterator[Finding]:
    """Yield what can be found out about the way to an instrument; entry point ``doctor``.

    Parameters
    ----------
    driver : str
        Name of its driver.
    address : str
        Address in a bench file.
    seconds : float
        Time limit of an attempt to connect (s).

    Examples
    --------
    >>> next(examine("grbl", "/dev/none")).text
    '/dev/none does not exist'
    """
    device = address.partition("@")[0]
    if device.startswith("/"):
        yield from _device(device)
    elif address.upper().startswith("USB"):
        yield from _usb(address)
    elif driver == "aravis" and is_ip(address):
        yield from _camera(address, seconds)
    elif found := _endpoint(address):
        yield from _network(*found, seconds)
    else:
        yield Finding(None, f"{address} is no address whose way can be examined")


def _endpoint(address: str) -> tuple[str, int] | None:
    """Host and port of an address; port 0 for datagrams."""
    if "://" in address:
        url = urlsplit(address)
        return (url.hostname or "", 0 if url.scheme == "udp" else url.port or 0)
    parts = address.split("::")
    if len(parts) < 2 or not parts[0].upper().startswith("TCPIP"):
        return None
    host, _, given = parts[1].partition(",")
    kind = "hislip" if len(parts) > 2 and parts[2].startswith("hislip") else parts[-1].upper()
    given = given or (parts[2].partition(",")[2] if len(parts) > 2 else "")
    if kind == "SOCKET":
        given = parts[2]
    return host, int(given) if given.isdigit() else _PORTS.get(kind, 111)


def _device(path: str) -> Iterator[Finding]:
    """Serial ports and video nodes."""
    try:
        status = os.stat(path)
    except FileNotFoundError:
        others = sorted(str(each) for each in Path(path).parent.glob(re.sub(r"\d+$", "*", Path(path).name)))
        do = (
            f"plug it in; there are {', '.join(others)}"
            if others
            else "plug it in, and look with `reseau bench list`"
        )
        yield Finding(False, f"{path} does not exist", do)
        return
    if not os.access(path, os.R_OK | os.W_OK):
        # Not every system has groups of files.
        with suppress(KeyError, NotImplementedError):
            group = Path(path).group()
            shared = status.st_mode & stat.S_IRGRP and status.st_mode & stat.S_IWGRP
            do = (
                f"sudo usermod -a -G {group} $USER, and log in again"
                if shared
                else 'add a udev rule with MODE="0660"'
            )
            yield Finding(False, f"{path} may not be opened by {_user()}", do)
    else:
        yield Finding(True, f"{path} may be opened by {_user()}")
    for process in _holders(os.path.realpath(path)):
        do = (
            "sudo systemctl disable --now ModemManager"
            if process.startswith("ModemManager")
            else "end that program"
        )
        yield Finding(False, f"{path} is held by {process}", do)
    links = {"tty": "/dev/serial/by-id", "video": "/dev/v4l/by-id"}
    folder = next((links[kind] for kind in links if Path(path).name.startswith(kind)), None)
    if folder and re.search(r"(USB|ACM|video)\d+$", path):
        known = next(
            (link for link in Path(folder).glob("*") if link.resolve() == Path(path).resolve()), None
        )
        do = f"give {known}" if known else "add a udev rule with SYMLINK+=, or give a link in " + folder
        yield Finding(None, f"{path} may have another number after a restart", do)


def _user() -> str:
    return f"user {os.geteuid()}" if os.geteuid() else "root"


def _holders(path: str) -> Iterator[str]:
    """Other processes that have a device open; who serves a pseudo-terminal has its other end."""
    for folder in Path("/proc").glob("[0-9]*"):
        if int(folder.name) == os.getpid():
            continue
        with suppress(OSError):
            opened = {os.readlink(fd) for fd in (folder / "fd").iterdir()}
            if path in opened and not {"/dev/ptmx", "/dev/pts/ptmx"} & opened:
                yield f"{(folder / 'comm').read_text().strip()} (process {folder.name})"


def _usb(address: str) -> Iterator[Finding]:
    """USBTMC instruments: found, and with permission to use them."""
    import libusb_package
    import usb.backend.libusb1 as libusb
    import usb.core

    try:
        library = libusb.get_backend() or libusb_package.get_libusb1_backend()
        maker, model = (int(part, 0) for part in address.split("::")[1:3])
        found = list(usb.core.find(find_all=True, backend=library, idVendor=maker, idProduct=model) or [])
    except (ValueError, OSError, usb.core.NoBackendError) as error:
        yield Finding(False, f"USB cannot be searched ({error})", "install libusb-1.0")
        return
    if not found:
        yield Finding(
            False, f"no device {maker:04x}:{model:04x} on USB", "switch it on; another cable or port"
        )
    for each in found:
        node = f"/dev/bus/usb/{each.bus:03d}/{each.address:03d}"
        rule = f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{maker:04x}", MODE="0660", GROUP="plugdev"'
        if os.access(node, os.R_OK | os.W_OK):
            yield Finding(True, f"{node} may be opened by {_user()}")
        else:
            yield Finding(
                False, f"{node} may not be opened by {_user()}", f"add the udev rule {rule}, plug it in again"
            )
        for process in _holders(node):
            yield Finding(False, f"{node} is held by {process}", "end that program")


def _network(host: str, port: int, seconds: float) -> Iterator[Finding]:
    try:
        family, _, _, _, where = socket.getaddrinfo(host, port or 9, type=socket.SOCK_STREAM)[0]
    except OSError as error:
        yield Finding(
            False, f"{host} is not known ({error.strerror})", "give its number, or add it to /etc/hosts"
        )
        return
    yield from _route(str(where[0]))
    if port:
        yield from _connects(host, family, where, port, seconds)
    yield from _echoes(str(where[0]))


def _connects(host: str, family: int, where: Any, port: int, seconds: float) -> Iterator[Finding]:
    """How often a connection comes about, and how fast."""
    took = list[float]()
    for _ in range(_CONNECTS):
        began = time.monotonic()
        with socket.socket(family, socket.SOCK_STREAM) as asking:
            asking.settimeout(seconds)
            try:
                asking.connect(where)
            except ConnectionRefusedError:
                others = _open_ports(host) or "none found"
                do = f"is its remote interface on, and the port right? others: {others}"
                yield Finding(False, f"{host} is there, but nothing listens on port {port}", do)
                return
            except TimeoutError:
                do = "switch it on; let the firewalls between pass the port (here: sudo nft list ruleset)"
                yield Finding(False, f"{host} does not answer on port {port} within {seconds:g} s", do)
                return
            except OSError as error:
                yield Finding(
                    False, f"{host} cannot be reached ({error.strerror})", "check cable, address and netmask"
                )
                return
        took.append(time.monotonic() - began)
    slow = max(took) > 0.5
    do = "set longer time-outs (`seconds` in its options), or use a cable in place of Wi-Fi" if slow else ""
    text = f"{host} takes connections on port {port}, in {1e3 * min(took):.1f} to {1e3 * max(took):.1f} ms"
    yield Finding(None if slow else True, text, do)


def _open_ports(host: str) -> str:
    """Usual ports of instruments that listen at a host."""
    usual = {
        80: "web", 111: "VXI-11", 1861: "VICP", 4000: "Tektronix", 4880: "HiSLIP", 5024: "telnet",
        5025: "SCPI", 5555: "Rigol",
    }  # fmt: skip
    found = []
    for port, name in usual.items():
        with suppress(OSError), socket.create_connection((host, port), 0.2):
            found.append(f"{port} ({name})")
    return ", ".join(found)


def _route(host: str) -> Iterator[Finding]:
    """Interface to a host: whether it is up, and how large its packets are."""
    name = _interface(host)
    if name is None:
        yield Finding(False, f"there is no route to {host}", "give this computer an address in its network")
        return
    state = psutil.net_if_stats()[name]
    if not state.isup:
        yield Finding(False, f"the interface {name} to {host} is down", f"sudo ip link set {name} up")


def _interface(host: str) -> str | None:
    """Name of the interface by which a host is reached."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as asking:
        asking.connect((host, 9))
        own = asking.getsockname()[0]
        for name, addresses in psutil.net_if_addrs().items():
            if own in (each.address.partition("%")[0] for each in addresses):
                return str(name)
    return None


def _echoes(host: str, size: int = 0) -> Iterator[Finding]:
    """Loss of echo requests, of a size that may not be divided."""
    if shutil.which("ping") is None:
        return
    large = ["-M", "do", "-s", str(size)] if size else []
    done = subprocess.run(
        ["ping", "-n", "-q", "-i", "0.01", "-c", str(_ECHOES), "-W", "1", *large, host],
        capture_output=True, text=True, check=False, timeout=30, env=os.environ | {"LC_ALL": "C"},
    )  # fmt: skip
    lost = re.search(r"([\d.]+)% packet loss", done.stdout)
    if lost is None:
        return
    percent = float(lost[1])
    what = f"packets of {size + 28} bytes" if size else "packets"
    if percent == 0:
        yield Finding(True, f"{host} answers {_ECHOES} of {_ECHOES} {what}")
    elif percent == 100 and not size:
        yield Finding(None, f"{host} answers no echo request", "nothing, if it takes connections")
    elif percent == 100:
        yield Finding(
            False,
            f"{what} do not reach {host}",
            "set packet_size to 1400, or the MTU of all switches to 9000",
        )
    else:
        yield Finding(
            False, f"{percent:g} % of {what} to {host} are lost", "another cable or switch; no Wi-Fi"
        )


def _camera(host: str, seconds: float) -> Iterator[Finding]:
    """GigE Vision: an answer, nobody else, large packets, a large buffer."""
    yield from _route(host)
    try:
        require_control(host, Deadline(seconds))
        yield Finding(True, f"{host} answers, and no other program controls it")
    except InstrumentError as error:
        silent = "switch it on; look with `reseau bench list`; let firewalls pass UDP from port 3956"
        yield Finding(False, error.what, silent if isinstance(error, ConnectionLost) else error.do or "")
        return
    name = _interface(host)
    if name is not None and (mtu := psutil.net_if_stats()[name].mtu) < _LARGE_MTU:
        do = f"sudo ip link set {name} mtu 9000, if camera and switch support it"
        yield Finding(None, f"the interface {name} sends packets of {mtu} bytes at most", do)
    elif name is not None:
        yield from _echoes(host, _LARGE_MTU)
    limit = Path("/proc/sys/net/core/rmem_max")
    if limit.exists() and (size := int(limit.read_text())) < _BUFFER:
        do = f"sudo sysctl -w net.core.rmem_max={4 * _BUFFER}"
        yield Finding(None, f"sockets may buffer {size} bytes only: frames get lost on a busy computer", do)
