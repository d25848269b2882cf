"""An instrument of USBTMC in user space (FunctionFS): to the host it is a real one.

Source: *USBTMC* 1.0, section 4.2; *USBTMC-USB488* 1.0, section 4.3; the kernel's ``functionfs.h``.
"""

from __future__ import annotations

import os
import select
import struct
import threading
import time
from contextlib import suppress
from pathlib import Path

from reseau.core.errors import ProtocolError
from reseau_drivers.codecs import usbtmc
from reseau_sims.serving import FaultScript, Machine
from reseau_sims.serving.scpi import AnswerQueue, Execute

from .gadget import Gadget, appeared, mounted

__all__ = ["UsbtmcDevice"]

_PACKET = 512
_DESCRIPTORS, _STRINGS, _SPEEDS = 3, 2, 3
_ENABLE, _SETUP = 2, 4
_GONE = (1, 3)
"""Events of FunctionFS: unbound, disabled."""
_SUCCESS, _NOT_IN_PROGRESS = 0x01, 0x81
_CAPABILITIES = bytes([_SUCCESS, 0, 0, 1, 0, 0, *[0] * 6, 0, 1, 0x06, 0x0E, *[0] * 8])
_ANSWERS = {
    1: bytes([_NOT_IN_PROGRESS, 0]),
    2: bytes([_NOT_IN_PROGRESS, *[0] * 7]),
    3: bytes([_NOT_IN_PROGRESS, 0]),
    4: bytes([_NOT_IN_PROGRESS, *[0] * 7]),
    5: bytes([_SUCCESS]),
    6: bytes([_SUCCESS, 0]),
    7: _CAPABILITIES,
    160: bytes([_SUCCESS]),
}
"""To requests of the control endpoint: abort, clear, capabilities, remote."""


def _descriptors() -> bytes:
    def at(packet: int) -> bytes:
        ends = [struct.pack("<BBBBHB", 7, 5, address, 2, packet, 0) for address in (0x01, 0x82)]
        return struct.pack("<9B", 9, 4, 0, 0, 2, 0xFE, 0x03, 0x01, 1) + b"".join(ends)

    body = struct.pack("<II", 3, 3) + at(64) + at(_PACKET)
    return struct.pack("<III", _DESCRIPTORS, 12 + len(body), _SPEEDS) + body


def _strings() -> bytes:
    body = struct.pack("<H", 0x0409) + b"USBTMC\0"
    return struct.pack("<IIII", _STRINGS, 16 + len(body), 1, 1) + body


class UsbtmcDevice:
    """The device.

    Parameters
    ----------
    machine : Machine
        Answers.
    execute : callable
        Takes program messages.
    script : FaultScript
        What goes wrong.
    """

    RESOURCE = "USB0::4617::1::SCOPE1::0::INSTR"

    def __init__(self, machine: Machine, execute: Execute, script: FaultScript) -> None:
        self._machine, self._queue = machine, AnswerQueue(machine, execute, script)
        self._lock = threading.Condition()
        self._begun = b""
        self._asked: usbtmc.Transfer | None = None
        self._enabled = threading.Event()
        self.gadget = Gadget("scope", 0x0001, "SCOPE1", 0)
        self.gadget.function("ffs.scope")
        self._folder = Path("/run/ffs/scope")
        mounted("functionfs", "scope", self._folder)
        self._control = os.open(self._folder / "ep0", os.O_RDWR)
        os.write(self._control, _descriptors())
        os.write(self._control, _strings())
        appeared(self._folder / "ep2")
        self.gadget.plug_in()
        for work in (self._controls, self._receives, self._sends):
            threading.Thread(target=work, daemon=True).start()

    def _controls(self) -> None:
        events = select.poll()
        events.register(self._control, select.POLLIN)
        while True:
            # A read that blocks holds what unbinding the gadget needs, in kernels from 6.12 on.
            events.poll()
            data = os.read(self._control, 12)
            if data[8] == _ENABLE:
                self._enabled.set()
            elif data[8] in _GONE:
                self._enabled.clear()
                self._forget()
            elif data[8] == _SETUP:
                self._answer(*struct.unpack("<BBHHH", data[:8]))

    def _forget(self) -> None:
        with self._lock:
            self._begun, self._asked = b"", None
            self._queue.clear()

    def _answer(self, kind: int, request: int, value: int, index: int, length: int) -> None:
        if request == 5:
            self._forget()
        reply = _ANSWERS.get(request) if kind & 0x60 == 0x20 else None
        with suppress(OSError):  # a stall that was asked for reports back as an error
            if kind & 0x80 and reply is not None:
                os.write(self._control, reply[:length])
            elif kind & 0x80:
                os.read(self._control, 0)
            else:
                os.write(self._control, b"")

    def _receives(self) -> None:
        endpoint = os.open(self._folder / "ep1", os.O_RDWR)
        while True:
            try:
                # Packet by packet: a host need not end a whole number of them with an empty one.
                data = os.read(endpoint, _PACKET)
                if data[:1] == bytes([usbtmc.OUT]) and len(data) >= usbtmc.HEAD:
                    size = int.from_bytes(data[4:8], "little")
                    while len(data) < usbtmc.HEAD + size:
                        data += os.read(endpoint, _PACKET)
            except OSError:
                self._enabled.wait()
                time.sleep(0.01)
                continue
            if data:
                self._take(data)

    def _take(self, data: bytes) -> None:
        with self._lock:
            try:
                transfer = usbtmc.decode(data)
            except ProtocolError as error:
                self._machine.violations.append(error.what)
                return
            if transfer.kind == usbtmc.REQUEST_IN:
                self._asked = transfer
            else:
                self._begun += transfer.data
                if transfer.end:
                    message, self._begun = self._begun, b""
                    self._asked = None
                    self._queue.write(message)
            self._lock.notify_all()

    def _sends(self) -> None:
        endpoint = os.open(self._folder / "ep2", os.O_RDWR)
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._asked and self._queue.available(), 0.05)
                if self._asked is None or not self._queue.available():
                    continue
                # Taken now: the next request may come before the write below returns.
                asked, self._asked = self._asked, None
                _, data, _ = self._queue.take(0.0)
                if data is None:
                    threading.Thread(target=self._pulled, daemon=True).start()
                    continue
                if data[asked.size :]:
                    self._queue.put_back(data[asked.size :])
                whole = len(data) <= asked.size
                sent = usbtmc.encode_in(asked.tag, data[: asked.size], whole)
            try:
                os.write(endpoint, sent)
                if len(sent) % _PACKET == 0:
                    os.write(endpoint, b"")
            except OSError:
                self._enabled.wait()

    def _pulled(self) -> None:
        self.gadget.unplug()
        self.gadget.plug_in()
