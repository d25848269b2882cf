"""Simulated GigE Vision camera with its own protocol: triggers, action commands, lines, user sets, resends.

Beside :class:`~reseau_sims.serving.GigeCamera`, which is the fake camera of a library and so an independent
server, this one runs at any loopback address: several cameras make a rig. Sources: AIA, *GigE Vision* 2.0,
and EMVA, *Standard Features Naming Convention* 2.4.
"""

from __future__ import annotations

import os
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from select import select
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from reseau.core.errors import ProtocolError, UsageError
from reseau_drivers.codecs.gige import (
    ACTION_DEVICE_KEY,
    ACTION_GROUP_KEY,
    ACTION_GROUP_MASK,
    PORT,
    PRIVILEGE,
    Action,
    Command,
    Kind,
    Leader,
    Status,
    acknowledgement,
    data_packet,
    trailer,
)
from reseau_drivers.codecs.pixels import GENICAM, encode, size_of

from .faults import Fault
from .genicam import Feature, description, placed
from .imaging import SimulatedCamera, View

_MEMORY, _XML = 0x10000, 0x100000
_HEARTBEAT, _STREAM_PORT, _PACKET_SIZE, _STREAM_ADDRESS = 0x0938, 0x0D00, 0x0D04, 0x0D18
_FIRE_TEST = 0x80000000
_OVERHEAD_IP, _OVERHEAD = 28, 36
"""Bytes of a packet that are not its data: IP and UDP, and those of the stream protocol with them."""
_DISCOVERY = 0xF8
_POLL_S = 0.05
_AN_HOUR_NS = 3_600_000_000_000
_KEPT, _KEPT_STARTS = 2, 1000
"""Blocks whose packets can be sent again."""
_BROADCASTS = "127.255.255.255", "255.255.255.255"
_SETS = {"Default": 0, "UserSet1": 1, "UserSet2": 2}
_SOURCES = {"Software": 0, "Line0": 1, "Line1": 2, "Line2": 3, "Line3": 4, "Action1": 16}
_OFF_AUTO = {"Off": 0, "Once": 1, "Continuous": 2}


def _features(width: int, height: int, serial: str) -> dict[str, Feature]:
    """The features of a camera with such a sensor."""
    image, taking, analog = "ImageFormatControl", "AcquisitionControl", "AnalogControl"
    formats = {name: int(GENICAM[name].code) for name in GENICAM}
    return placed([
        Feature("DeviceControl", "DeviceVendorName", "string", "reseau", access="RO", address=0x48),
        Feature("DeviceControl", "DeviceModelName", "string", "GigE simulator", access="RO", address=0x68),
        Feature("DeviceControl", "DeviceVersion", "string", "1", access="RO", address=0x88),
        Feature("DeviceControl", "DeviceSerialNumber", "string", serial, access="RO", address=0xD8,
                length=16),
        Feature("DeviceControl", "DeviceUserID", "string", "", address=0xE8, length=16),
        Feature("DeviceControl", "DeviceTemperature", "float", 41.5, -40, 120, unit="C", access="RO"),
        Feature(image, "SensorWidth", "integer", width, 1, 65535, access="RO"),
        Feature(image, "SensorHeight", "integer", height, 1, 65535, access="RO"),
        Feature(image, "WidthMax", "integer", width, 1, 65535, access="RO"),
        Feature(image, "HeightMax", "integer", height, 1, 65535, access="RO"),
        Feature(image, "Width", "integer", width, 1, width, unit="px"),
        Feature(image, "Height", "integer", height, 1, height, unit="px"),
        Feature(image, "OffsetX", "integer", 0, 0, width - 1, unit="px"),
        Feature(image, "OffsetY", "integer", 0, 0, height - 1, unit="px"),
        Feature(image, "ReverseX", "boolean", 0),
        Feature(image, "PixelFormat", "enumeration", "Mono8", entries=formats),
        Feature(image, "PayloadSize", "integer", width * height, access="RO"),
        Feature(taking, "AcquisitionMode", "enumeration", "Continuous",
                entries={"SingleFrame": 1, "MultiFrame": 2, "Continuous": 3}),
        Feature(taking, "AcquisitionStart", "command"),
        Feature(taking, "AcquisitionStop", "command"),
        Feature(taking, "AcquisitionFrameRateEnable", "boolean", 1),
        Feature(taking, "AcquisitionFrameRate", "float", 25.0, 0.1, 1000.0, unit="Hz"),
        Feature(taking, "ExposureMode", "enumeration", "Timed", entries={"Timed": 1}),
        Feature(taking, "ExposureTime", "float", 10_000.0, 10.0, 1e7, unit="us"),
        Feature(taking, "ExposureAuto", "enumeration", "Off", entries=_OFF_AUTO),
        Feature(taking, "TriggerSelector", "enumeration", "FrameStart", entries={"FrameStart": 0}),
        Feature(taking, "TriggerMode", "enumeration", "Off", entries={"Off": 0, "On": 1}),
        Feature(taking, "TriggerSource", "enumeration", "Software", entries=_SOURCES),
        Feature(taking, "TriggerActivation", "enumeration", "RisingEdge",
                entries={"RisingEdge": 0, "FallingEdge": 1}),
        Feature(taking, "TriggerDelay", "float", 0.0, 0.0, 1e6, unit="us"),
        Feature(taking, "TriggerSoftware", "command"),
        Feature(analog, "Gain", "float", 0.0, 0.0, 24.0, unit="dB"),
        Feature(analog, "GainAuto", "enumeration", "Off", entries=_OFF_AUTO),
        Feature(analog, "BlackLevel", "integer", 0, 0, 255),
        Feature("ActionControl", "ActionDeviceKey", "integer", 0, address=ACTION_DEVICE_KEY),
        Feature("ActionControl", "ActionSelector", "integer", 0, 0, 0),
        Feature("ActionControl", "ActionGroupKey", "integer", 0, address=ACTION_GROUP_KEY),
        Feature("ActionControl", "ActionGroupMask", "integer", 0, address=ACTION_GROUP_MASK),
        Feature("UserSetControl", "UserSetSelector", "enumeration", "Default", entries=_SETS),
        Feature("UserSetControl", "UserSetLoad", "command"),
        Feature("UserSetControl", "UserSetSave", "command"),
        Feature("UserSetControl", "UserSetDefault", "enumeration", "Default", entries=_SETS),
        Feature("TransportLayerControl", "TLParamsLocked", "integer", 0, 0, 1),
        Feature("TransportLayerControl", "GevTimestampTickFrequency", "integer", 1_000_000_000,
                access="RO", address=0x093C, length=8),
        Feature("TransportLayerControl", "GevTimestampControlLatch", "command"),
        Feature("TransportLayerControl", "GevTimestampValue", "integer", 0, access="RO", address=0x0948,
                length=8),
    ])  # fmt: skip


_NOT_SAVED = ("TLParamsLocked", "UserSetSelector", "UserSetDefault", "DeviceUserID")


@dataclass
class _Block:
    """Packets of an image, of which some are lost."""

    number: int
    packets: list[bytes]
    complete: bool = True


class GigeVisionCamera:
    """Camera on a loopback address.

    Parameters
    ----------
    body : SimulatedCamera
        Forms the images, at the start of each exposure.
    address : str
        Loopback address; each camera of a rig has another one.
    serial : str
        Serial number.
    latency_us : float
        Time from a trigger to the start of the exposure.

    Attributes
    ----------
    outputs : list of callable
        Called when an exposure starts: a line to :meth:`pulse` of another camera.
    frames : int
        Number of exposures.
    missed : int
        Number of triggers that arrived during an exposure.
    starts_ns : deque of int
        True starts of the last exposures, by the monotonic clock of this computer.

    Raises
    ------
    UsageError
        If another camera has the address.

    Examples
    --------
    >>> with GigeVisionCamera(SimulatedCamera(), address="127.0.0.9") as camera:
    ...     camera.value("TriggerMode")
    'Off'
    """

    def __init__(
        self,
        body: SimulatedCamera,
        *,
        address: str = "127.0.0.1",
        serial: str = "RS1",
        latency_us: float = 0.0,
    ) -> None:
        self.body, self.address, self.latency_us = body, address, latency_us
        self.features = _features(body.width, body.height, serial)
        self.outputs: list[Callable[[], None]] = []
        self.frames, self.missed = 0, 0
        self.starts_ns: deque[int] = deque(maxlen=_KEPT_STARTS)
        self._xml = description(self.features, "GigE simulator", "reseau")
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._clock_ns = int.from_bytes(serial.encode()[-4:], "big") * 1_000_003
        self._memory = bytearray(_MEMORY)
        self._power_on()
        self._sets: dict[int, dict[str, float | str]] = {}
        self._controller: tuple[tuple[str, int], float] | None = None
        self._plugged, self._ended = True, False
        self._pulse: int | None = None
        self._number = 0
        self._blocks: deque[_Block] = deque(maxlen=_KEPT)
        self._last: tuple[int, int, bytes] | None = None
        self._timers: list[threading.Timer] = []
        self._sockets = [self._bound(address, reuse=False)]
        self._sockets += [self._bound(each, reuse=True) for each in _BROADCASTS]
        self._stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stream.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 22)
        self._stream.bind((address, 0))
        self._threads = [
            threading.Thread(target=work, name="GigeVisionCamera", daemon=True)
            for work in (self._serve, self._expose_on)
        ]
        for each in self._threads:
            each.start()

    def _bound(self, address: str, *, reuse: bool) -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        if reuse:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            made.bind((address, PORT))
        except OSError as error:
            made.close()
            raise UsageError(
                f"cannot be used ({error.strerror})", where=f"{address}:{PORT}",
                do="end the other simulated camera, or give another loopback address",
            ) from None  # fmt: skip
        return made

    # Registers.

    def _power_on(self) -> None:
        """Give all registers their values after power-on."""
        memory = self._memory
        memory[:] = bytes(_MEMORY)
        url = f"Local:reseau.xml;{_XML:X};{len(self._xml):X}".encode()
        words = {
            0x0000: 0x00010002, 0x0004: 0x80000001, 0x0010: 0x6, 0x0014: 0x6, 0x0904: 1, 0x0908: 1,
            0x0934: 0xC0000046, _HEARTBEAT: 3000, _PACKET_SIZE: 1500,
        }  # fmt: skip
        for at, word in words.items():
            memory[at : at + 4] = word.to_bytes(4, "big")
        memory[0x0008:0x0010] = bytes((0, 0, 0x02, 0x52, *socket.inet_aton(self.address)))
        memory[0x0024:0x0028] = socket.inet_aton(self.address)
        memory[0x0034:0x0038] = socket.inet_aton("255.0.0.0")
        memory[0x0200 : 0x0200 + len(url)] = url
        for each in self.features.values():
            memory[each.address : each.address + each.size] = each.encode(each.default)
        self._acquiring = False

    def value(self, name: str) -> Any:
        """Return the value of a feature."""
        each = self.features[name]
        with self._lock:
            return each.decode(bytes(self._memory[each.address : each.address + each.size]))

    def set(self, name: str, value: float | str) -> None:
        """Change a feature, as at the camera itself."""
        each = self.features[name]
        with self._lock:
            self._memory[each.address : each.address + each.size] = each.encode(value)

    def _word(self, at: int) -> int:
        return int.from_bytes(self._memory[at : at + 4], "big")

    def _read(self, at: int, size: int) -> bytes | None:
        """Content of registers or of the description; None beyond them."""
        if at >= 0 and at + size <= _MEMORY:
            return bytes(self._memory[at : at + size])
        if at >= _XML and at < _XML + len(self._xml):
            return self._xml[at - _XML : at - _XML + size].ljust(size, b"\0")
        return None

    def _write(self, at: int, data: bytes) -> int:
        """Write registers; return the status."""
        if not 0 <= at <= _MEMORY - len(data):
            return Status.INVALID_ADDRESS
        for name, each in self.features.items():
            if at <= each.address < at + len(data) or each.address <= at < each.address + each.size:
                if each.access == "RO":
                    return Status.ACCESS_DENIED
                if each.address == at and each.size == len(data):
                    if not each.valid(data):
                        return Status.INVALID_PARAMETER
                    if each.kind == "command":
                        self._execute(name)
                        return Status.SUCCESS
        self._memory[at : at + len(data)] = data
        if at == _PACKET_SIZE and self._word(at) & _FIRE_TEST:
            self._memory[at : at + 4] = (self._word(at) & ~_FIRE_TEST).to_bytes(4, "big")
            size = (self._word(at) & 0xFFFF) - _OVERHEAD_IP
            self._deliver([bytes(max(8, size))])
        pixels = GENICAM[self.value("PixelFormat") or "Mono8"]
        width = self.value("Width") // pixels.group[0] * pixels.group[0]
        self.set("PayloadSize", size_of(pixels, width, self.value("Height")))
        return Status.SUCCESS

    def _execute(self, command: str) -> None:
        """Execute a command."""
        if command in ("AcquisitionStart", "AcquisitionStop"):
            self._acquiring, self._pulse = command == "AcquisitionStart", None
            self._changed.notify_all()
        elif command == "TriggerSoftware":
            self._triggered("Software")
        elif command == "GevTimestampControlLatch":
            self.set("GevTimestampValue", self._now())
        else:
            number = _SETS[self.value("UserSetSelector")]
            saved = {
                name: self.value(name)
                for name, each in self.features.items()
                if each.access == "RW" and each.kind != "command" and name not in _NOT_SAVED
            }
            if command == "UserSetSave" and number:
                self._sets[number] = saved
            elif command == "UserSetLoad":
                at_power_on = {name: self.features[name].default for name in saved}
                for name, value in self._sets.get(number, at_power_on).items():
                    self.set(name, value)

    def _now(self) -> int:
        """Time of the camera's clock (ns)."""
        return time.monotonic_ns() + self._clock_ns

    # The control protocol.

    def _serve(self) -> None:
        while not self._ended:
            ready, _, _ = select(self._sockets, [], [], _POLL_S)
            for each in ready:
                with suppress(OSError):
                    packet, client = each.recvfrom(2048)
                    if not self._plugged:
                        continue
                    with self._lock:
                        answer = self._answer(packet, client)
                    if answer:
                        self._sockets[0].sendto(answer, client)

    def _answer(self, packet: bytes, client: tuple[str, int]) -> bytes:
        """Execute a command; return its acknowledgement, empty if none is due."""
        try:
            command = Command.decode(packet)
        except ProtocolError as error:
            self.body.violations.append(str(error))
            return b""
        self._watch_heartbeat(client)
        data, status = command.data, int(Status.SUCCESS)
        answer: bytes | None = b""
        if command.kind == Kind.DISCOVERY:
            answer = bytes(self._memory[:_DISCOVERY])
        elif command.kind == Kind.READ_REGISTER:
            words = [self._read(int.from_bytes(data[k : k + 4], "big"), 4) for k in range(0, len(data), 4)]
            answer = None if None in words else b"".join(each for each in words if each is not None)
        elif command.kind == Kind.READ_MEMORY and len(data) >= 8:
            content = self._read(int.from_bytes(data[:4], "big"), int.from_bytes(data[6:8], "big"))
            answer = None if content is None else data[:4] + content
        elif command.kind in (Kind.WRITE_REGISTER, Kind.WRITE_MEMORY) and len(data) >= 8:
            parts = (
                [(data[k : k + 4], data[k + 4 : k + 8]) for k in range(0, len(data) - 7, 8)]
                if command.kind == Kind.WRITE_REGISTER
                else [(data[:4], data[4:])]
            )
            written = 0
            for at, content in parts:
                status = self._written(int.from_bytes(at, "big"), content, client)
                if status != Status.SUCCESS:
                    break
                written += 1
            answer = struct.pack(">HH", 0, written)
        elif command.kind == Kind.ACTION:
            self._act(data)
        elif command.kind == Kind.PACKET_RESEND and len(data) >= 12:
            _, block, first, last = struct.unpack_from(">HHII", data)
            self._send_again(block, first & 0xFFFFFF, last & 0xFFFFFF)
        else:
            status = Status.NOT_IMPLEMENTED
        if answer is None:
            answer, status = b"", Status.INVALID_ADDRESS
        return acknowledgement(command, answer, status) if command.acknowledge else b""

    def _watch_heartbeat(self, client: tuple[str, int]) -> None:
        """Note that the application that controls the camera lives; release a silent one."""
        now = time.monotonic()
        if self._controller is not None:
            if self._controller[0] == client:
                self._controller = client, now
            elif now - self._controller[1] > self._word(_HEARTBEAT) / 1000:
                self._release()

    def _release(self) -> None:
        """End the control of an application, and the acquisition."""
        self._controller = None
        self._memory[PRIVILEGE : PRIVILEGE + 4] = bytes(4)
        self._acquiring = False
        self._changed.notify_all()

    def _written(self, at: int, data: bytes, client: tuple[str, int]) -> int:
        if self._controller is not None and self._controller[0] != client:
            return Status.ACCESS_DENIED
        if at == PRIVILEGE and len(data) == 4:
            self._memory[at : at + 4] = data
            if int.from_bytes(data, "big"):
                self._controller = client, time.monotonic()
            else:
                self._release()
            return Status.SUCCESS
        return self._write(at, data)

    def _act(self, data: bytes) -> None:
        """Execute an action command, if it concerns this camera."""
        try:
            action = Action.decode(data)
        except ProtocolError as error:
            self.body.violations.append(str(error))
            return
        own = Action(*(self._word(at) for at in (ACTION_DEVICE_KEY, ACTION_GROUP_KEY, ACTION_GROUP_MASK)))
        if action.concerns(own):
            self._triggered("Action1")

    # Exposures.

    def pulse(self, line: str = "Line0") -> None:
        """A rising edge at an input line."""
        with self._lock:
            if self._plugged:
                self._triggered(line)

    def _triggered(self, source: str) -> None:
        """A trigger of a source; call it with the lock."""
        if not self._acquiring or self.value("TriggerMode") != "On" or self.value("TriggerSource") != source:
            return
        if self._pulse is not None:
            self.missed += 1
            return
        self._pulse = time.monotonic_ns()
        self._changed.notify_all()

    def _expose_on(self) -> None:
        """Expose at each trigger, or periodically, until the camera is closed."""
        due: int | None = None
        while not self._ended:
            with self._lock:
                start = self._start(due)
            if start is None:
                due = None if not self._acquiring else due
                continue
            due = self._exposed(start)

    def _start(self, due: int | None) -> int | None:
        """Start of the next exposure; None if there is none yet."""
        if not self._acquiring:
            self._changed.wait(_POLL_S)
            return None
        if self.value("TriggerMode") == "On":
            if self._pulse is None:
                self._changed.wait(_POLL_S)
            if self._pulse is None:
                return None
            late = self.latency_us + self.value("TriggerDelay")
            return self._pulse + int(1000 * late)
        return time.monotonic_ns() if due is None else due

    def _exposed(self, start: int) -> int:
        """Expose and send one image; return when the next one would be due."""
        _until(start)
        self.starts_ns.append(start)
        for each in self.outputs:
            each()
        with self._lock:
            layout = GENICAM[self.value("PixelFormat")]
            region = [self.value(name) for name in ("OffsetX", "OffsetY", "Width", "Height")]
            exposure, gain, offset = (self.value(name) for name in ("ExposureTime", "Gain", "BlackLevel"))
            reverse = self.value("ReverseX")
            period = int(1e9 / self.value("AcquisitionFrameRate"))
        left, top, width, height = region
        view = View(exposure, gain, float(offset), left, top, width, height, layout.full_scale)
        seen = self._filled(view)
        pixels = encode(layout, seen[:, ::-1] if reverse else seen)
        end = start + int(1000 * exposure)
        _until(end)
        with self._lock:
            self._pulse = None
            self.frames += 1
            self._number = self._number % 65535 + 1
            number = self._number
        if self._acquiring and self._plugged:
            self._send(number, end + self._clock_ns, pixels, view, int(layout.code))
        return max(start + period, time.monotonic_ns())

    def _filled(self, view: View) -> NDArray[Any]:
        """Return the image; black where the frame exceeds the sensor."""
        seen = self.body.draw(view)
        if seen.shape == (view.height, view.width):
            return seen
        whole = np.zeros((view.height, view.width), seen.dtype)
        whole[: seen.shape[0], : seen.shape[1]] = seen
        return whole

    def _send(self, number: int, stamp: int, pixels: bytes, view: View, code: int) -> None:
        fault = self.body.script.draw()
        kind = "" if fault is None else fault.kind
        if fault is not None and kind == "late":
            time.sleep(fault.seconds)
        if kind == "repeated" and self._last is not None:
            number, stamp, pixels = self._last
        elif kind == "out of range":
            stamp += _AN_HOUR_NS
        self._last = number, stamp, pixels
        leader = Leader(stamp, code, view.width, view.height, view.left, view.top).packet(number)
        size = max(64, (self._word(_PACKET_SIZE) & 0xFFFF) - _OVERHEAD)
        body, packets = memoryview(pixels), [leader]
        packets += [
            data_packet(number, 1 + k, body[at : at + size]) for k, at in enumerate(range(0, len(body), size))
        ]
        packets.append(trailer(number, len(packets), view.height))
        lost = {"dropped": len(packets), "stuck": len(packets), "truncated": len(packets) // 2}.get(kind, 0)
        sent = packets[: len(packets) - lost]
        if kind == "corrupted":
            # Each packet has a checksum: a damaged one is discarded.
            sent = [*packets[:1], *packets[2:]]
        self._blocks.append(_Block(number, packets, complete=sent == packets))
        self._deliver(sent)
        if fault is not None:
            self._apply_fault(fault)

    def _deliver(self, packets: list[bytes]) -> None:
        """Send packets to the receiver."""
        where = socket.inet_ntoa(self._memory[_STREAM_ADDRESS : _STREAM_ADDRESS + 4])
        port = self._word(_STREAM_PORT) & 0xFFFF
        if port and self._plugged:
            for packet in packets:
                with suppress(OSError):
                    self._stream.sendto(packet, (where, port))

    def _send_again(self, block: int, first: int, last: int) -> None:
        """Send packets of a block again; those of a fault stay lost."""
        for each in self._blocks:
            if each.number == block and each.complete:
                self._deliver(each.packets[first : last + 1])

    def _apply_fault(self, fault: Fault) -> None:
        """Apply a fault of the camera itself after the frame."""
        if fault.kind == "stuck":
            with self._lock:
                self._acquiring = False
        elif fault.kind == "disconnected":
            self.pull_plug()
            timer = threading.Timer(fault.seconds, self.plug_in)
            self._timers.append(timer)
            timer.start()
        elif fault.kind == "wrong state":
            self.hang_up()
        elif fault.kind == "power-cycled":
            self.power_cycle()

    def hang_up(self) -> None:
        """Revoke the control of the client, and stop; the camera can be opened again."""
        with self._lock:
            self._release()

    def power_cycle(self) -> None:
        """Switch the camera off and on: control and settings are lost; user sets stay."""
        with self._lock:
            self._release()
            self._power_on()

    def pull_plug(self) -> None:
        """Disconnect the camera until :meth:`plug_in`."""
        self._plugged = False

    def plug_in(self) -> None:
        """Connect the camera again, with default settings."""
        self.power_cycle()
        self._plugged = True

    def close(self) -> None:
        """Stop and release the address."""
        if self._ended:
            return
        self._ended = True
        for timer in self._timers:
            timer.cancel()
            timer.join()
        with self._lock:
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(5.0)
        for each in (*self._sockets, self._stream):
            each.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def loopback_addresses(count: int) -> tuple[str, ...]:
    """Return loopback addresses that other processes do not use: they contain the number of this one.

    Examples
    --------
    >>> len(set(loopback_addresses(4)))
    4
    """
    own = os.getpid()
    return tuple(f"127.{1 + own // 251 % 250}.{1 + own % 251}.{k}" for k in range(1, count + 1))


def _until(when_ns: int) -> None:
    """Sleep until a time of the monotonic clock."""
    while (left := when_ns - time.monotonic_ns()) > 0:
        time.sleep(min(left / 1e9, 0.05))
