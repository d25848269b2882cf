"""Simulated GigE Vision camera on the loopback interface: real packets, sent by Aravis's fake camera.

The library implements the protocol in a process of its own (see :mod:`~reseau_sims.serving.gige_process`);
images and faults come from this module. Aravis (``libaravis-0.8-0``) must be installed.
"""

from __future__ import annotations

import ctypes.util
import importlib.util
import mmap
import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray

from reseau.core.errors import UsageError
from reseau.core.exclusive import lock_file
from reseau_drivers.codecs.pixels import GENICAM, encode

from . import gige_process
from .faults import Fault
from .imaging import SimulatedCamera, View

_LARGEST = 2048
"""Rows and columns of the library's fake camera."""
_FORMATS = {layout.code: layout for layout in GENICAM.values()}
_DONE_S = 10.0
_AN_HOUR_NS = 3_600_000_000_000


def aravis_is_installed() -> bool:
    """Whether the library and its Python bindings are installed.

    Examples
    --------
    >>> isinstance(aravis_is_installed(), bool)
    True
    """
    typelibs = any(Path("/usr/lib").glob("*/girepository-1.0/Aravis-0.8.typelib"))
    return _library_is_there() and typelibs and importlib.util.find_spec("gi") is not None


def _library_is_there() -> bool:
    return ctypes.util.find_library("aravis-0.8") is not None


class GigeCamera:
    """Camera on ``127.0.0.1``.

    Parameters
    ----------
    body : SimulatedCamera
        Forms the images; frames are the upper left part of the requested size. An image must be drawn within
        two seconds: the library does not answer meanwhile, and its client releases control. If drawing takes
        longer, use software triggers.
    serial : str
        Serial number.
    features : str
        File with additional GenICam features.
    wait_s : float
        Time to wait for another simulated camera on this machine to end (s): there is one port.

    Raises
    ------
    UsageError
        If the library is not installed, or the port is in use.

    Examples
    --------
    >>> from reseau_sims.serving import SimulatedCamera
    >>> with GigeCamera(SimulatedCamera()) as camera:  # doctest: +SKIP
    ...     camera.address
    '127.0.0.1'
    """

    ADDRESS = "127.0.0.1"

    def __init__(
        self, body: SimulatedCamera, *, serial: str = "SIM1", features: str = "", wait_s: float = 0.0
    ) -> None:
        if not _library_is_there():
            raise UsageError("Aravis is not installed", do="apt-get install libaravis-0.8-0")
        self.body, self._serial, self._features = body, serial, features
        self.frames = 0
        """Frames that were asked for."""
        self._locked = _one_at_a_time(wait_s)
        self._size = _LARGEST * _LARGEST * 2
        self._descriptor = os.memfd_create("reseau-gige")
        os.ftruncate(self._descriptor, self._size)
        self._memory = mmap.mmap(self._descriptor, self._size)
        # A file, not a pipe: the library may warn of much, and nobody reads it.
        self._said = tempfile.TemporaryFile()  # noqa: SIM115
        self._ended, self._lock = False, threading.Lock()
        self._issued, self._done, self._serving = 0, 0, False
        self._replugging: threading.Thread | None = None
        self._heard = threading.Condition()
        self._last: tuple[int, int, bytes] | None = None
        self._start()

    @property
    def address(self) -> str:
        """As a driver takes it."""
        return self.ADDRESS

    def _start(self) -> None:
        memory = str(self._descriptor), str(self._size)
        features = [self._features] if self._features else []
        self._process = subprocess.Popen(
            [sys.executable, gige_process.__file__, self.ADDRESS, self._serial, *memory, *features],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
            pass_fds=[self._descriptor],
            env={**os.environ, "PYTHONPATH": ""},
        )
        assert self._process.stdout is not None
        if self._process.stdout.read(gige_process.REQUEST.size) != gige_process.DONE:
            self._process.wait(5.0)
            self._said.seek(0)
            said = self._said.read().decode("utf-8", "replace").strip()
            self.close()
            raise UsageError(said or "ended at once", where="simulated GigE camera")
        self._issued, self._done, self._serving = 0, 0, True
        self._thread = threading.Thread(target=self._serve, name="GigeCamera", daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        stdout = self._process.stdout
        assert stdout is not None
        while len(data := stdout.read(gige_process.REQUEST.size)) == gige_process.REQUEST.size:
            if data == gige_process.DONE:
                with self._heard:
                    self._done += 1
                    self._heard.notify_all()
                continue
            number, stamp, exposure, gain, code, left, top, width, height, _ = gige_process.REQUEST.unpack(
                data
            )
            layout = _FORMATS.get(code, GENICAM["Mono8"])
            view = View(float(exposure), float(gain), 0.0, left, top, width, height, layout.full_scale)
            pixels = encode(layout, self._filled(view))
            self.frames += 1
            self._answer(number, stamp, pixels)

        with self._heard:
            self._serving = False
            self._heard.notify_all()

    def _filled(self, view: View) -> NDArray[Any]:
        """Return the image; black where the frame exceeds the sensor."""
        seen = self.body.draw(view)
        if seen.shape == (view.height, view.width):
            return seen
        whole = np.zeros((view.height, view.width), seen.dtype)
        whole[: seen.shape[0], : seen.shape[1]] = seen
        return whole

    def _answer(self, number: int, stamp: int, pixels: bytes) -> None:
        fault = self.body.script.draw()
        kind = "" if fault is None else fault.kind
        wait = fault.seconds if fault is not None and kind == "late" else 0.0
        loss, number_, stamp_ = 0.0, -1, -1
        if kind in ("dropped", "stuck"):
            loss = 1.0
        elif kind in ("truncated", "corrupted"):
            # Each packet has a checksum: a damaged one is discarded.
            loss = 0.5
        elif kind == "repeated" and self._last is not None:
            number_, stamp_, pixels = self._last
        elif kind == "out of range":
            stamp_ = stamp + _AN_HOUR_NS
        self._memory[: len(pixels)] = pixels
        self._send_order(gige_process.FRAME, wait, loss, number_, stamp_, len(pixels))
        self._last = number, stamp, pixels
        if fault is not None:
            self._apply_fault(fault)

    def _apply_fault(self, fault: Fault) -> None:
        """Apply a fault of the camera itself after the frame."""
        if fault.kind == "stuck":
            self._send_command(gige_process.STICK)
        elif fault.kind == "disconnected":
            # This is the thread of the frames, which ends with the unplugged process.
            self._replugging = threading.Thread(target=self._unplug_for, args=(fault.seconds,), daemon=True)
            self._replugging.start()
        elif fault.kind == "wrong state":
            self.hang_up()
        elif fault.kind == "power-cycled":
            self.power_cycle()

    def hang_up(self) -> None:
        """Revoke the control of the client, and stop; the camera can be opened again."""
        self._send_command(gige_process.HANG_UP)

    def power_cycle(self) -> None:
        """Switch the camera off and on: control and settings are lost."""
        self._send_command(gige_process.RESET)

    def pull_plug(self) -> None:
        """Disconnect the camera until :meth:`plug_in`."""
        self._process.kill()
        self._process.wait()
        self._thread.join(5.0)

    def plug_in(self) -> None:
        """Connect the camera again, with default settings."""
        self._close_pipes()
        self._start()

    def _unplug_for(self, seconds: float) -> None:
        self.pull_plug()
        time.sleep(seconds)
        self.plug_in()

    def _send_command(self, kind: bytes) -> None:
        """Send a command to the camera and wait for its execution (except in the frames' thread)."""
        with self._heard:
            self._issued += 1
            number = self._issued
        self._send_order(kind)
        if threading.current_thread() is not self._thread:
            with self._heard:
                self._heard.wait_for(lambda: self._done >= number or not self._serving, _DONE_S)

    def _send_order(
        self,
        kind: bytes,
        wait: float = 0.0,
        loss: float = 0.0,
        number: int = -1,
        stamp: int = -1,
        size: int = 0,
    ) -> None:
        stdin = self._process.stdin
        assert stdin is not None
        with self._lock, suppress(OSError, ValueError):
            stdin.write(gige_process.ORDER.pack(kind, wait, loss, number, stamp, size))
            stdin.flush()

    def close(self) -> None:
        """End the process."""
        if self._ended:
            return
        self._ended = True
        if self._replugging is not None:
            self._replugging.join()
        self._send_order(gige_process.END)
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if hasattr(self, "_thread"):
            self._thread.join(5.0)
        self._close_pipes()
        self._memory.close()
        self._said.close()
        os.close(self._descriptor)
        self._locked.close()

    def _close_pipes(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _one_at_a_time(wait_s: float) -> IO[bytes]:
    """Acquire a lock that ends with the process: the library binds one port of the machine."""
    path = Path(tempfile.gettempdir()) / f"reseau-gige-{os.getuid()}.lock"
    handle = path.open("ab")
    until = time.monotonic() + wait_s
    while not lock_file(handle):
        if time.monotonic() >= until:
            handle.close()
            raise UsageError("another simulated GigE camera runs on this machine", do="end it first")
        time.sleep(0.05)
    return handle
