"""The oscilloscope's driver on a real USB bus: USBTMC by libusb, and the kernel's own driver as a witness."""

from __future__ import annotations

import os
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from reseau.core.errors import InstrumentError
from reseau_drivers.oscilloscope import oscilloscope

from .gadget import appeared, settle
from .lab import steer, value

RESOURCE = "USB0::4617::1::SCOPE1::0::INSTR"


def _nodes() -> list[Path]:
    """The bus's node of the instrument."""
    found = []
    for path in Path("/sys/bus/usb/devices").glob("*/serial"):
        if path.read_text().strip() == "SCOPE1":
            bus, device = (int((path.parent / name).read_text()) for name in ("busnum", "devnum"))
            found.append(Path(f"/dev/bus/usb/{bus:03}/{device:03}"))
    return found


@pytest.fixture
def scope() -> Iterator[Any]:
    with oscilloscope("scope", RESOURCE, seconds=5.0) as made:
        yield made


def test_the_screen_is_transferred_unchanged(scope: Any) -> None:
    shown = scope.screen().frame().pixels
    assert shown.shape == steer("scope.screen").shape
    assert (shown == steer("scope.screen")).all()
    assert value("scope.violations") == []


@pytest.mark.parametrize("kind", ["late", "dropped", "truncated", "corrupted", "disconnected"])
def test_a_fault_gives_the_right_result_or_an_error(scope: Any, kind: str) -> None:
    wanted = steer("scope.screen")
    scope.screen()
    steer("befall", "scope", kind)
    said = None
    try:
        assert (scope.screen(2.0).frame().pixels == wanted).all()
    except InstrumentError as error:
        said = error
    assert said is None or said.instrument == "scope"
    assert (scope.screen(10.0).frame().pixels == wanted).all()


def test_reconnection_after_unplugging(scope: Any) -> None:
    scope.screen()
    steer("usb.gadget.unplug")
    try:
        with pytest.raises(InstrumentError):
            scope.screen(3.0)
    finally:
        steer("usb.gadget.plug_in")
    assert (scope.screen(10.0).frame().pixels == steer("scope.screen")).all()
    assert scope.reconnections >= 2


def test_the_udev_rules_give_access_to_plugdev_only() -> None:
    settle()
    (node,) = _nodes()
    assert stat.S_IMODE(node.stat().st_mode) == 0o660
    opened = ["sh", "-c", f": <> {node}"]
    nobody = ["setpriv", "--reuid=65534", "--regid=65534"]
    plugdev = next(
        line.split(":")[2] for line in Path("/etc/group").read_text().splitlines() if "plugdev" in line
    )
    assert subprocess.run([*nobody, f"--groups={plugdev}", *opened]).returncode == 0
    assert subprocess.run([*nobody, "--clear-groups", *opened], stderr=subprocess.DEVNULL).returncode != 0


def test_the_kernel_driver_reads_the_simulated_instrument() -> None:
    subprocess.run(["/run/busybox", "insmod", "/run/modules/usbtmc.ko"], check=True)
    fd = os.open(appeared("/dev/usbtmc0"), os.O_RDWR)
    try:
        os.write(fd, b"*IDN?\n")
        assert os.read(fd, 4096) == steer("scope.execute", b"*IDN?\n")
    finally:
        os.close(fd)
