"""Decode photographs in a process of their own, with limits on memory, time and pixels.

What decodes files from outside has no other task: no archive, no keys. It gives back a line of JSON and the
grey values; the process that reads these checks sizes and interprets nothing else.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from ..archive import Session
from ..core.data import Frame
from ..core.errors import ImageError

__all__ = ["PHOTOGRAPH", "DecodingLimits", "decode", "is_upload"]

PHOTOGRAPH = "photograph"
"""Kind of the files that were uploaded, as they came."""

_TYPES = {"uint8": np.uint8, "uint16": np.uint16, "float32": np.float32}
_HEAD = 4096


@dataclass(frozen=True)
class DecodingLimits:
    """Limits of a decoding process.

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
    return bool(session.frames(kind=PHOTOGRAPH))


def decode(path: Path, name: str, limits: DecodingLimits | None = None) -> Frame:
    """Decode a photograph in another process.

    Parameters
    ----------
    path : Path
        The file.
    name : str
        Name of the frame.
    limits : DecodingLimits, optional
        Limits.

    Raises
    ------
    ImageError
        If it is not a photograph that can be used, or exceeds a limit.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.io.images import write_image
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_image(Path(folder) / "flat.png", np.full((4, 6), 200, dtype=np.uint8))
    ...     decode(Path(folder) / "flat.png", "flat").pixels.shape
    (4, 6)
    """
    bound = limits or DecodingLimits()
    command = [sys.executable, "-I", "-c", _BOOT, *(str(p) for p in sys.path if p), "--", str(path)]
    command += [str(bound.memory), str(bound.seconds), str(bound.pixels)]
    environment = {
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "PATH": "/usr/bin:/bin",
        "LC_ALL": "C.UTF-8",
    }
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=2 * bound.seconds,
            env=environment, check=False, cwd="/",
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise ImageError(f"takes longer than {2 * bound.seconds} s to decode", where=name) from None
    head, _, body = done.stdout.partition(b"\n")
    if done.returncode != 0 or len(head) > _HEAD:
        raise ImageError("cannot be decoded: it is damaged, or needs too much memory or time", where=name)
    try:
        about = json.loads(head)
        if "error" in about:
            raise ImageError(str(about["error"])[:300], where=name)
        width, height, kind = int(about["width"]), int(about["height"]), _TYPES[about["type"]]
        scale = float(about["full_scale"])
    except (ValueError, KeyError, TypeError):
        raise ImageError("cannot be decoded", where=name) from None
    if not 0 < width * height <= bound.pixels or len(body) != width * height * np.dtype(kind).itemsize:
        raise ImageError(f"has more than {bound.pixels} pixels", where=name)
    pixels = np.frombuffer(body, kind).reshape(height, width).copy()
    return Frame(pixels, scale, name)


_BOOT = (
    "import sys; k = sys.argv.index('--'); sys.path[:] = sys.argv[1:k]; del sys.argv[1:k + 1]; "
    "from reseau.service.decoding import _main; _main()"
)


def _main() -> None:
    """What the other process does."""
    path, memory, seconds, pixels = Path(sys.argv[1]), *(int(each) for each in sys.argv[2:5])
    # Nothing of the file has been looked at yet.
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    out: IO[bytes] = sys.stdout.buffer
    from ..core.errors import ReseauError
    from ..io.images import open_scan, read_image

    try:
        scan = open_scan(path)
        if scan.width * scan.height > pixels:
            raise ImageError(f"has {scan.width}×{scan.height} pixels, more than {pixels}")
        frame = read_image(path)
        grey = frame.pixels if frame.pixels.dtype.name in _TYPES else frame.pixels.astype(np.float32)
        about = {"width": frame.width, "height": frame.height, "type": grey.dtype.name}
        out.write(json.dumps(about | {"full_scale": frame.full_scale}).encode() + b"\n")
        out.write(np.ascontiguousarray(grey).tobytes())
    except ReseauError as error:
        out.write(json.dumps({"error": error.what}).encode() + b"\n")
    except MemoryError:
        out.write(json.dumps({"error": "needs too much memory"}).encode() + b"\n")
    out.flush()
