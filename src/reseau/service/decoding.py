"""Decode photographs in processes of their own, with limits on memory, time and pixels.

What decodes files from outside has no other task: no archive, no keys. One process loads the readers once;
for each photograph it forks a child, which sets its limits before it looks at the file, and ends with it. The
child gives back a line of JSON and the grey values; the process that reads these checks sizes and interprets
nothing else.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray

from ..archive import Session
from ..core.data import Frame
from ..core.errors import ImageError, UsageError
from ..core.tone import ToneCurve
from ..io.scans import Scan, scan_of

PHOTOGRAPH = "photograph"
"""Kind of the files that were uploaded, as they came."""

_TYPES = {"uint8": np.uint8, "uint16": np.uint16, "float32": np.float32}
_HEAD, _PART = 1 << 20, 1 << 20
_DAMAGED = "cannot be decoded: it is damaged, or needs too much memory or time"


@dataclass(frozen=True)
class DecodingLimits:
    """Limits for one photograph.

    Parameters
    ----------
    memory : int
        Address space (bytes).
    seconds : float
        Processor time, and half of the largest duration.
    pixels : int
        Largest number of pixels.

    Examples
    --------
    >>> DecodingLimits().pixels
    120000000
    """

    memory: int = 6 << 30
    seconds: int = 60
    pixels: int = 120_000_000


def is_upload(session: Session) -> bool:
    """Return whether a session is made of uploaded photographs."""
    return bool(session.frames(kind=PHOTOGRAPH, first=1))


class Decoder:
    """Decodes photographs, one after the other; its process is started when it is first needed.

    Parameters
    ----------
    limits : DecodingLimits, optional
        Limits for each photograph.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.io.images import write_image
    >>> with tempfile.TemporaryDirectory() as folder, Decoder() as decoder:
    ...     write_image(Path(folder) / "flat.png", np.full((4, 6), 200, dtype=np.uint8))
    ...     decoder.frame(Path(folder) / "flat.png", "flat").pixels.shape
    (4, 6)
    """

    def __init__(self, limits: DecodingLimits | None = None) -> None:
        self.limits = limits or DecodingLimits()
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def frame(self, path: Path, name: str) -> Frame:
        """Decode a photograph to grey values.

        Parameters
        ----------
        path : Path
            The file.
        name : str
            Name of the frame.

        Raises
        ------
        ImageError
            If it is not a photograph that can be used, or exceeds a limit.
        """
        about, pixels = self._decoded(path, name, colours=False)
        return Frame(pixels[:, :, 0], about.full_scale, name, curve=about.curve, filters=about.filters)

    def scan(self, path: Path, name: str) -> Scan:
        """Decode a photograph with all its colours, and the resolution that it states.

        Raises
        ------
        ImageError
            As :meth:`frame`.
        """
        about, pixels = self._decoded(path, name, colours=True)
        return replace(
            scan_of(pixels, name, about.dpi),
            full_scale=about.full_scale,
            curve=about.curve,
            notes=about.notes,
        )

    def _decoded(self, path: Path, name: str, *, colours: bool) -> tuple[_About, NDArray[Any]]:
        end = time.monotonic() + 2 * self.limits.seconds
        reading = self._asked(path, colours)
        try:
            about = _About.read(_line(reading, end), name, self.limits)
            pixels = np.empty((about.height, about.width, about.channels), dtype=_TYPES[about.type])
            _fill(reading, memoryview(cast(Any, pixels)).cast("B"), end)
        except TimeoutError:
            self._end()
            raise ImageError(f"takes longer than {2 * self.limits.seconds} s to decode", where=name) from None
        except (EOFError, OSError):
            raise ImageError(_DAMAGED, where=name) from None
        finally:
            os.close(reading)  # a child that still writes ends
            well = self._well(end)
        if not well:
            raise ImageError(_DAMAGED, where=name)
        return about, pixels

    def _asked(self, path: Path, colours: bool) -> int:
        """Have a photograph decoded; return where its pixels can be read."""
        if self._process is None or self._process.poll() is not None:
            self._start()
        assert self._control is not None
        reading, writing = os.pipe()
        order = json.dumps({"path": str(path), "colours": colours, **vars(self.limits)}).encode()
        try:
            socket.send_fds(self._control, [order], [writing])
        except OSError:
            self._end()
        finally:
            os.close(writing)
        return reading

    def _well(self, end: float) -> bool:
        """Wait for the child's end, and return whether it ended well."""
        if self._control is None:
            return False
        self._control.settimeout(max(0.0, end - time.monotonic()) + 1.0)
        try:
            answer = self._control.recv(1)
        except OSError:
            answer = b""
        if not answer:
            self._end()
        return answer == b"\0"

    def _start(self) -> None:
        if not hasattr(os, "fork"):
            raise UsageError(
                "are not decoded on this system, which cannot bound memory and time of a process",
                where="uploaded photographs", do="run the service on Linux or macOS",
            )  # fmt: skip
        self._end()
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = [sys.executable, "-I", "-c", _BOOT, *(str(p) for p in sys.path if p), "--"]
        environment = {
            "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PATH": "/usr/bin:/bin", "LC_ALL": "C.UTF-8",
        }  # fmt: skip
        with there:
            self._process = subprocess.Popen(
                [*command, str(there.fileno())], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL, env=environment, cwd="/", pass_fds=[there.fileno()],
                start_new_session=True,
            )  # fmt: skip
        self._control = here

    def _end(self) -> None:
        if self._control is not None:
            self._control.close()
            self._control = None
        if self._process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
            self._process = None


@dataclass(frozen=True)
class _About:
    """What the other process says about a photograph."""

    width: int
    height: int
    channels: int
    type: str
    full_scale: float
    dpi: float | None
    curve: ToneCurve | None
    notes: tuple[str, ...]
    filters: str

    @classmethod
    def read(cls, head: bytes, name: str, limits: DecodingLimits) -> _About:
        try:
            given = json.loads(head)
            if "error" in given:
                raise ImageError(str(given["error"])[:300], where=name)
            curve = given["curve"]
            if curve is not None:
                exponent = None if curve[0] is None else float(curve[0])
                curve = ToneCurve(exponent, tuple(float(v) for v in curve[1]), str(curve[2])[:200])
            found = cls(
                int(given["width"]), int(given["height"]), int(given["channels"]), str(given["type"]),
                float(given["full_scale"]), None if given["dpi"] is None else float(given["dpi"]), curve,
                tuple(str(each)[:300] for each in given["notes"][:20]), str(given["filters"])[:4],
            )  # fmt: skip
        except (ValueError, KeyError, TypeError, IndexError, RecursionError):
            raise ImageError("cannot be decoded", where=name) from None
        if min(found.width, found.height) < 2 or found.width * found.height > limits.pixels:
            raise ImageError(f"has more than {limits.pixels} pixels", where=name)
        if found.channels not in (1, 3) or found.type not in _TYPES:
            raise ImageError("cannot be decoded", where=name)
        return found


def _ready(reading: int, end: float) -> None:
    if not select.select([reading], [], [], max(0.0, end - time.monotonic()))[0]:
        raise TimeoutError


def _line(reading: int, end: float) -> bytes:
    """Read a line byte by byte: what follows are pixels."""
    found = bytearray()
    while len(found) < _HEAD:
        _ready(reading, end)
        part = os.read(reading, 1)
        if not part:
            raise EOFError
        if part == b"\n":
            return bytes(found)
        found += part
    raise EOFError


def _fill(reading: int, view: memoryview, end: float) -> None:
    at = 0
    while at < len(view):
        _ready(reading, end)
        count = os.readv(reading, [view[at : at + _PART]])
        if count == 0:
            raise EOFError
        at += count


_BOOT = (
    "import sys; k = sys.argv.index('--'); sys.path[:] = sys.argv[1:k]; del sys.argv[1:k + 1]; "
    "from reseau.service.decoding import _main; _main()"
)


def _main() -> None:
    """What the other process does: a child for each photograph, until nobody asks any more."""
    import cv2  # noqa: F401 - loaded once, before any file is looked at
    import imagecodecs  # noqa: F401
    import tifffile  # noqa: F401

    from ..io import images  # noqa: F401

    control = socket.socket(fileno=int(sys.argv[1]))
    while True:
        order, writing, _, _ = socket.recv_fds(control, 1 << 16, 1)
        if not order:
            return
        child = os.fork()
        if child == 0:
            control.close()
            code = 1
            with suppress(BaseException):
                _decode(json.loads(order), writing[0])
                code = 0
            os._exit(code)
        os.close(writing[0])
        _, status = os.waitpid(child, 0)
        control.send(b"\0" if status == 0 else b"\1")


def _decode(order: dict[str, Any], writing: int) -> None:
    import resource

    # Nothing of the file has been looked at yet.
    seconds, memory = order["seconds"], order["memory"]
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    from ..core.errors import ReseauError
    from ..io.images import luma, open_scan

    with os.fdopen(writing, "wb") as out:
        try:
            scan = open_scan(Path(order["path"]), mosaic=not order["colours"])
            if scan.width * scan.height > order["pixels"]:
                raise ImageError(f"has {scan.width}×{scan.height} pixels, more than {order['pixels']}")
            pixels = scan.window(0, scan.height, 0, scan.width)
            if not order["colours"] and pixels.shape[2] > 1:
                pixels = luma(pixels, scan.channels)[:, :, None]
            if pixels.dtype.name not in _TYPES:
                pixels = pixels.astype(np.float32)
            if pixels.dtype.kind == "f" and not np.isfinite(pixels).all():
                raise ImageError("contains grey values that are not finite")
            curve = scan.curve
            about = {
                "width": scan.width, "height": scan.height, "channels": pixels.shape[2],
                "type": pixels.dtype.name, "full_scale": scan.full_scale, "dpi": scan.dpi,
                "notes": list(scan.notes), "filters": scan.filters,
                "curve": None if curve is None else [curve.exponent, list(curve.table), curve.source],
            }  # fmt: skip
            out.write(json.dumps(about).encode() + b"\n")
            out.write(memoryview(cast(Any, np.ascontiguousarray(pixels))).cast("B"))
        except ReseauError as error:
            out.write(json.dumps({"error": error.what}).encode() + b"\n")
        except MemoryError:
            out.write(json.dumps({"error": "needs too much memory"}).encode() + b"\n")
