"""USB devices of our own on the kernel's dummy controller, set up through its configuration file system."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path

__all__ = ["Gadget", "appeared", "mounted", "settle"]

CONFIGURATION = Path("/sys/kernel/config")
_PATIENCE_S = 20.0


def mounted(kind: str, source: str, target: Path) -> None:
    """Mount a file system, if it is not mounted yet."""
    target.mkdir(parents=True, exist_ok=True)
    if not target.is_mount():
        subprocess.run(["mount", "-t", kind, source, str(target)], check=True)


def appeared(path: str | Path) -> Path:
    """The path, once it is there."""
    until = time.monotonic() + _PATIENCE_S
    while not Path(path).exists():
        if time.monotonic() > until:
            raise TimeoutError(f"{path} did not appear")
        time.sleep(0.02)
    return Path(path)


def settle() -> None:
    """Let udevd finish links, modes, and telling others."""
    subprocess.run(["udevadm", "settle"], check=True, env={**os.environ, "SYSTEMD_IGNORE_CHROOT": "1"})


class Gadget:
    """One USB device with one configuration.

    Parameters
    ----------
    name : str
        In the configuration file system.
    product : int
        Of the vendor number 1209.
    serial : str
        Its number.
    port : int
        Of the dummy controller.
    """

    def __init__(self, name: str, product: int, serial: str, port: int) -> None:
        mounted("configfs", "none", CONFIGURATION)
        self._serial, self._port = serial, port
        self.path = CONFIGURATION / "usb_gadget" / name
        for folder in ("", "strings/0x409", "configs/c.1"):
            (self.path / folder).mkdir()
        for key, value in {
            "idVendor": "0x1209",
            "idProduct": f"{product:#06x}",
            "bcdUSB": "0x0200",
            "bcdDevice": "0x0100",
            "strings/0x409/serialnumber": serial,
            "strings/0x409/manufacturer": "reseau",
            "strings/0x409/product": "simulated instrument",
            "configs/c.1/MaxPower": "100",
        }.items():
            (self.path / key).write_text(value)

    def function(self, kind: str) -> Path:
        """Give it a function, as ``acm.0`` or ``ffs.scope``."""
        path = self.path / "functions" / kind
        path.mkdir()
        (self.path / "configs/c.1" / kind).symlink_to(path)
        return path

    def plug_in(self) -> None:
        """Plug it in; returns once the host has set it up."""
        (self.path / "UDC").write_text(f"dummy_udc.{self._port}")
        self._seen_by_host()
        settle()

    def unplug(self) -> None:
        """Pull it; returns once the host has noticed."""
        entry = self._seen_by_host()
        (self.path / "UDC").write_text("\n")
        until = time.monotonic() + _PATIENCE_S
        while (entry / "serial").exists():
            if time.monotonic() > until:
                raise TimeoutError(f"{entry} stays")
            time.sleep(0.02)

    def _seen_by_host(self) -> Path:
        until = time.monotonic() + _PATIENCE_S
        while time.monotonic() < until:
            for path in Path("/sys/bus/usb/devices").glob("*/serial"):
                try:
                    found = path.read_text().strip() == self._serial
                    if found and (path.parent / "bConfigurationValue").read_text().strip():
                        return path.parent
                except OSError:  # it comes or goes just now
                    continue
            time.sleep(0.02)
        raise TimeoutError(f"the host does not see {self._serial}")
