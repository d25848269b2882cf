"""Simulated USBTMC instrument: a PyUSB backend on which it is plugged in.

Source: *USBTMC* 1.0, sections 3 and 4.2; *USBTMC-USB488* 1.0, section 4.2. Every program that uses PyUSB's
libusb-1.0 backend can list, open and use it without modification.
"""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.backend.libusb1
import usb.core

from reseau.core.errors import ProtocolError
from reseau_drivers.codecs import usbtmc

from .faults import FaultScript
from .machine import Machine
from .scpi import AnswerQueue

_PACKET = 512
_OUT, _IN = 0x01, 0x82
_VENDOR, _PRODUCT = 0x1209, 0x0001
_STRINGS = ("", "reseau", "simulated oscilloscope")
_GET_DESCRIPTOR, _CAPABILITIES, _REMOTE = 6, 7, 160
_NOT_IN_PROGRESS = 0x81

Fields = SimpleNamespace


class UsbInstrument(usb.backend.IBackend):  # type: ignore[misc]
    """USB bus with this instrument.

    Parameters
    ----------
    machine : Machine
        Simulated instrument.
    execute : callable
        Executes program messages.
    script : FaultScript
        Faults.
    serial : str
        Serial number of the instrument.

    Examples
    --------
    >>> from reseau_sims.serving import Oscilloscope
    >>> scope = Oscilloscope()
    >>> UsbInstrument(scope, scope.execute, FaultScript()).resource
    'USB0::4617::1::SIM1::0::INSTR'
    """

    def __init__(
        self,
        machine: Machine,
        execute: Callable[[bytes], bytes | None],
        script: FaultScript,
        serial: str = "SIM1",
    ) -> None:
        super().__init__()
        self._machine, self._strings = machine, (*_STRINGS, serial)
        self._queue = AnswerQueue(machine, execute, script)
        self._lock = threading.RLock()
        self._begun, self._sending, self._short = b"", b"", False
        self._asked: usbtmc.Transfer | None = None
        self.present = True
        self.open_handles = 0

    @property
    def resource(self) -> str:
        """VISA resource string."""
        return f"USB0::{_VENDOR}::{_PRODUCT}::{self._strings[3]}::0::INSTR"

    def enumerate_devices(self) -> Iterator[object]:
        """Yield the instrument if it is plugged in."""
        return iter([self] if self.present else [])

    def get_device_descriptor(self, dev: object) -> Fields:
        """Return the device descriptor (USB 2.0, table 9-8)."""
        return Fields(
            bLength=18, bDescriptorType=1, bcdUSB=0x200, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=64, idVendor=_VENDOR, idProduct=_PRODUCT, bcdDevice=0x100, iManufacturer=1,
            iProduct=2, iSerialNumber=3, bNumConfigurations=1, address=1, bus=1, port_number=1,
            port_numbers=(1,), speed=3,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: object, config: int) -> Fields:
        """Return the only configuration."""
        if config:
            raise IndexError(config)
        return Fields(
            bLength=9, bDescriptorType=2, wTotalLength=32, bNumInterfaces=1, bConfigurationValue=1,
            iConfiguration=0, bmAttributes=0x80, bMaxPower=50, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: object, intf: int, alt: int, config: int) -> Fields:
        """Return the only interface: application specific, USBTMC, USB488."""
        if intf or alt or config:
            raise IndexError(intf)
        return Fields(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0, bNumEndpoints=2,
            bInterfaceClass=0xFE, bInterfaceSubClass=3, bInterfaceProtocol=1, iInterface=0,
            extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: object, ep: int, intf: int, alt: int, config: int) -> Fields:
        """Return the bulk-out or bulk-in endpoint."""
        return Fields(
            bLength=7, bDescriptorType=5, bEndpointAddress=(_OUT, _IN)[ep], bmAttributes=2,
            wMaxPacketSize=_PACKET, bInterval=0, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev: object) -> object:
        """Open a handle."""
        self._attached()
        self.open_handles += 1
        return self

    def close_device(self, dev_handle: object) -> None:
        """Close a handle."""
        self.open_handles -= 1

    def set_configuration(self, dev_handle: object, config_value: int) -> None:
        """Do nothing: there is only one configuration."""

    def get_configuration(self, dev_handle: object) -> int:
        """Return the only configuration."""
        return 1

    def set_interface_altsetting(self, dev_handle: object, intf: int, altsetting: int) -> None:
        """Do nothing: there is only one setting."""

    def claim_interface(self, dev_handle: object, intf: int) -> None:
        """Claim the interface."""
        self._attached()

    def release_interface(self, dev_handle: object, intf: int) -> None:
        """Release the interface."""

    def reset_device(self, dev_handle: object) -> None:
        """Discard incomplete transfers."""
        with self._lock:
            self._begun, self._asked, self._sending, self._short = b"", None, b"", False
            self._queue.clear()

    def clear_halt(self, dev_handle: object, ep: int) -> None:
        """Do nothing: endpoints never halt."""

    def is_kernel_driver_active(self, dev_handle: object, intf: int) -> bool:
        """Return False: there is no kernel driver."""
        return False

    def ctrl_transfer(
        self, dev_handle: object, kind: int, request: int, value: int, index: int, data: Any, timeout: int
    ) -> int:
        """Answer requests for strings, capabilities, and those of USB488."""
        self._attached()
        answer = bytes([_NOT_IN_PROGRESS, 0])
        if request == _GET_DESCRIPTOR and kind == 0x80:
            number = value & 0xFF
            text = b"\x09\x04" if number == 0 else self._strings[number].encode("utf-16-le")
            answer = bytes([len(text) + 2, 3]) + text
        elif request == _CAPABILITIES:
            # Success; USBTMC 1.0; USB488 with remote control, SCPI.
            answer = bytes([1, 0, 0, 1, 0, 0, *[0] * 6, 0, 1, 0x06, 0x0E, *[0] * 8])
        elif request == _REMOTE:
            answer = bytes([1])
        taken = min(len(data), len(answer))
        data[:taken] = type(data)(data.typecode, answer[:taken])
        return taken

    def bulk_write(self, dev_handle: object, ep: int, intf: int, data: Any, timeout: int) -> int:
        """Receive a transfer from the host."""
        self._attached()
        packet = bytes(data)
        with self._lock:
            try:
                transfer = usbtmc.decode(packet)
            except ProtocolError as error:
                self._machine.violations.append(error.what)
                return len(packet)
            if transfer.kind == usbtmc.REQUEST_IN:
                self._asked = transfer
                return len(packet)
            self._begun += transfer.data
            if len(self._begun) > 1 << 20:
                self._machine.violations.append("a message without end")
                self._begun = b""
            if transfer.end:
                # The next message discards an answer that was not read.
                self._asked, self._sending, self._short = None, b"", False
                message, self._begun = self._begun, b""
                self._queue.write(message)
            return len(packet)

    def bulk_read(self, dev_handle: object, ep: int, intf: int, buff: Any, timeout: int) -> int:
        """Send a transfer to the host, or its next packets."""
        self._attached()
        with self._lock:
            if not self._sending and not self._short:
                self._begin_answer(timeout)
            given, self._sending = self._sending[: len(buff)], self._sending[len(buff) :]
            # A transfer ends with a short packet, which may be empty.
            self._short = not self._sending and len(given) > 0 and len(given) % _PACKET == 0
            buff[: len(given)] = type(buff)(buff.typecode, given)
            return len(given)

    def _begin_answer(self, timeout: int) -> None:
        wait, data, found = self._queue.take((timeout or 1000) / 1000)
        asked = self._asked
        time.sleep(wait)
        if data is None:
            self.unplug()
        self._attached()
        if not found or not data or asked is None:
            raise usb.core.USBTimeoutError("no answer", errno=errno.ETIMEDOUT)
        part, rest = data[: asked.size], data[asked.size :]
        if rest:
            self._queue.put_back(rest)
        self._asked = None
        self._sending = usbtmc.encode_in(asked.tag, part, not rest)

    def unplug(self) -> None:
        """Pull the cable and plug it in again: existing handles become invalid."""
        self.reset_device(self)
        raise usb.core.USBError("No such device (it may have been disconnected)", errno=errno.ENODEV)

    def _attached(self) -> None:
        if not self.present:
            raise usb.core.USBError("No such device (it may have been disconnected)", errno=errno.ENODEV)


@contextmanager
def plugged_in(instrument: UsbInstrument) -> Iterator[UsbInstrument]:
    """Make PyUSB find this instrument, and no other, within the context.

    Examples
    --------
    >>> from reseau_sims.serving import Oscilloscope
    >>> scope = Oscilloscope()
    >>> with plugged_in(UsbInstrument(scope, scope.execute, FaultScript())) as instrument:
    ...     instrument.present
    True
    """
    original = usb.backend.libusb1.get_backend
    usb.backend.libusb1.get_backend = lambda *_, **__: instrument
    try:
        yield instrument
    finally:
        usb.backend.libusb1.get_backend = original
