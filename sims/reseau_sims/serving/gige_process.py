"""Process that implements GigE Vision: Aravis's fake camera with the images of the simulator.

:class:`reseau_sims.serving.gige.GigeCamera` runs this file as a script that imports the standard library
only, so that it starts quickly: ``python gige_process.py ADDRESS SERIAL MEMORY BYTES [FEATURES]``. For each
frame it writes a request to its standard output and reads the order for it from its standard input; the
pixels are in memory that is shared by its file descriptor. It is a separate process because a C thread calls
back for every frame.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import queue
import re
import struct
import sys
import threading
import time
from typing import Any, BinaryIO

REQUEST = struct.Struct("<QQIIIIIIII")
"""Number, own time (ns), exposure (µs), gain (dB), pixel format, left, top, width, height, triggered."""
DONE = bytes(REQUEST.size)
"""Sent instead of a request: the process is ready, or has executed a command."""
ORDER = struct.Struct("<cddqqI")
"""Kind, delay (s), fraction of packets lost, frame number or −1, time (ns) or −1, frame size (bytes)."""
FRAME, STICK, HANG_UP, RESET, END = b"F", b"S", b"H", b"R", b"E"
"""Kinds of orders: for a frame, and for the camera."""

WIDTH, HEIGHT, GAIN, EXPOSURE, ACQUISITION, FORMAT = 0x100, 0x104, 0x110, 0x120, 0x124, 0x128
LEFT, TOP, PERIOD, TRIGGER_MODE, TRIGGER_SOURCE = 0x130, 0x134, 0x138, 0x300, 0x304
PRIVILEGE = 0xA00
DEFAULTS = {
    WIDTH: 512, HEIGHT: 512, GAIN: 0, EXPOSURE: 10000, FORMAT: 0x01080001, LEFT: 0, TOP: 0,
    PERIOD: 40000, TRIGGER_MODE: 0, TRIGGER_SOURCE: 0,
}  # fmt: skip
"""Default values of the library's registers."""

_POINTER = ctypes.c_void_p
_FILL = ctypes.CFUNCTYPE(None, _POINTER, _POINTER, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32)
_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "arv_gv_fake_camera_new": (_POINTER, [ctypes.c_char_p, ctypes.c_char_p]),
    "arv_gv_fake_camera_new_full": (_POINTER, [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_char_p]),
    "arv_fake_camera_new": (_POINTER, [ctypes.c_char_p]),
    "arv_fake_camera_get_genicam_xml": (_POINTER, [_POINTER, ctypes.POINTER(ctypes.c_size_t)]),
    "arv_gv_fake_camera_get_fake_camera": (_POINTER, [_POINTER]),
    "arv_gv_fake_camera_is_running": (ctypes.c_int, [_POINTER]),
    "arv_fake_camera_read_register": (
        ctypes.c_int, [_POINTER, ctypes.c_uint32, ctypes.POINTER(ctypes.c_uint32)],
    ),
    "arv_fake_camera_write_register": (ctypes.c_int, [_POINTER, ctypes.c_uint32, ctypes.c_uint32]),
    "arv_fake_camera_set_fill_pattern": (None, [_POINTER, _FILL, _POINTER]),
    "arv_buffer_get_data": (_POINTER, [_POINTER, ctypes.POINTER(ctypes.c_size_t)]),
    "arv_buffer_get_frame_id": (ctypes.c_uint64, [_POINTER]),
    "arv_buffer_set_frame_id": (None, [_POINTER, ctypes.c_uint64]),
    "arv_buffer_get_timestamp": (ctypes.c_uint64, [_POINTER]),
    "arv_buffer_set_timestamp": (None, [_POINTER, ctypes.c_uint64]),
}  # fmt: skip


class FakeCameraServer:
    """Fake camera, and the pipe to the simulator.

    Parameters
    ----------
    address, serial : str
        Address on which it listens, and serial number.
    memory : mmap
        Pixels of the next frame.
    orders, requests : binary files
        The pipe.
    features : str
        File with additional GenICam features, inserted at the end of the library's own.
    """

    def __init__(
        self,
        address: str,
        serial: str,
        memory: mmap.mmap,
        orders: BinaryIO,
        requests: BinaryIO,
        features: str = "",
    ) -> None:
        self._library = ctypes.CDLL("libaravis-0.8.so.0")
        self._objects = ctypes.CDLL("libgobject-2.0.so.0")
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(self._library, name)
            function.restype, function.argtypes = result, arguments
        named = address.encode(), serial.encode()
        if features:
            self._server = self._library.arv_gv_fake_camera_new_full(*named, self._described(features))
        else:
            self._server = self._library.arv_gv_fake_camera_new(*named)
        if not self._server or not self._library.arv_gv_fake_camera_is_running(self._server):
            raise SystemExit(f"no GigE Vision on {address}: is port 3956 taken?")
        self._camera = self._library.arv_gv_fake_camera_get_fake_camera(self._server)
        self._memory = (ctypes.c_char * len(memory)).from_buffer(memory)
        self._orders, self._requests = orders, requests
        self._frames: queue.Queue[tuple[Any, ...]] = queue.Queue()
        self._lock = threading.Lock()
        self._fill = _FILL(self._frame)
        self._library.arv_fake_camera_set_fill_pattern(self._camera, self._fill, None)

    def _described(self, features: str) -> bytes:
        """Return the name of a file with the library's description of the camera and additional features."""
        size = ctypes.c_size_t()
        bare = self._library.arv_fake_camera_new(b"bare")
        text = ctypes.string_at(
            self._library.arv_fake_camera_get_genicam_xml(bare, ctypes.byref(size)), size.value
        )
        with open(features, "rb") as file:
            more = file.read()
        for name in re.findall(rb'Name="(\w+)"', more):
            # A feature with the same name replaces that of the library.
            text = re.sub(rb'<(\w+) Name="%s".*?</\1>' % name, b"", text, count=1, flags=re.DOTALL)
        end = text.rindex(b"</RegisterDescription>")
        whole = features + ".xml"
        with open(whole, "wb") as file:
            file.write(text[:end] + more + text[end:])
        return whole.encode()

    def run(self) -> None:
        """Execute orders until there are no more."""
        self._send(DONE)
        while len(data := self._orders.read(ORDER.size)) == ORDER.size:
            order = ORDER.unpack(data)
            if order[0] == END:
                break
            if order[0] == FRAME:
                self._frames.put(order)
            else:
                self._execute(order[0])
                self._send(DONE)
        # The library's thread may wait for a frame that will not arrive.
        os._exit(0)

    def _execute(self, kind: bytes) -> None:
        self._write(ACQUISITION, 0)
        if kind in (HANG_UP, RESET):
            self._write(PRIVILEGE, 0)
        if kind == RESET:
            for register, value in DEFAULTS.items():
                self._write(register, value)

    def _frame(self, buffer: int, _: int, exposure: int, gain: int, layout: int) -> None:
        """Fill a buffer; called by the library."""
        library = self._library
        triggered = self._read(TRIGGER_MODE)
        region = [self._read(register) for register in (LEFT, TOP, WIDTH, HEIGHT)]
        number = library.arv_buffer_get_frame_id(buffer)
        stamp = library.arv_buffer_get_timestamp(buffer)
        self._send(REQUEST.pack(number, stamp, exposure, gain, layout, *region, triggered))
        _, wait, loss, number, stamp, size = self._frames.get()
        if wait > 0:
            time.sleep(wait)
        # The library reads the fraction of lost packets with every packet of the next frame.
        self._objects.g_object_set(_POINTER(self._server), b"gvsp-lost-ratio", ctypes.c_double(loss), None)
        if number >= 0:
            library.arv_buffer_set_frame_id(buffer, number)
        if stamp >= 0:
            library.arv_buffer_set_timestamp(buffer, stamp)
        ctypes.memmove(
            library.arv_buffer_get_data(buffer, ctypes.byref(ctypes.c_size_t())), self._memory, size
        )

    def _send(self, data: bytes) -> None:
        with self._lock:
            self._requests.write(data)
            self._requests.flush()

    def _read(self, register: int) -> int:
        value = ctypes.c_uint32()
        self._library.arv_fake_camera_read_register(self._camera, register, ctypes.byref(value))
        return value.value

    def _write(self, register: int, value: int) -> None:
        self._library.arv_fake_camera_write_register(self._camera, register, value)


def main() -> None:
    """Serve until the simulator ends."""
    address, serial, descriptor, size, *features = sys.argv[1:]
    memory = mmap.mmap(int(descriptor), int(size))
    FakeCameraServer(address, serial, memory, sys.stdin.buffer, sys.stdout.buffer, *features).run()


if __name__ == "__main__":
    main()
