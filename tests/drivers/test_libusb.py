"""USB without a system library: PyUSB and pyvisa-py use the packaged libusb."""

from __future__ import annotations

import subprocess
import sys

SYSTEM_HIDDEN = """
import ctypes.util
ctypes.util.find_library = lambda name: None
"""


def run(code: str) -> str:
    command = [sys.executable, "-c", SYSTEM_HIDDEN + code]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout.strip()


def test_visa_searches_the_usb_bus_without_a_system_library() -> None:
    code = "import pyvisa; print(pyvisa.ResourceManager('@py').visalib.get_debug_info()['USB INSTR'])"
    assert run(code).startswith("Available via PyUSB")


def test_the_driver_of_an_absent_usb_instrument_says_so() -> None:
    code = """
from reseau.core.errors import ConnectionLost
from reseau.instruments import Deadline
from reseau_drivers.visa import VisaLink
try:
    VisaLink("USB0::4617::1::NONE::0::INSTR").open(Deadline(5.0))
except ConnectionLost as error:
    print(error)
"""
    message = run(code)
    assert "USB0::4617::1::NONE::0::INSTR" in message
    assert "No device found" in message
    assert "backend" not in message.lower()
