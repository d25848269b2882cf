"""Numbers in lines of text files, and the network of such a file."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..bundle import Camera, Network
from ..core.data import Array, Rows
from ..core.errors import FormatError, InputError, UsageError
from ..core.files import readable


def numbers(words: Sequence[str], count: int, path: Path, line: int) -> list[float]:
    """Convert words to `count` finite numbers.

    Raises
    ------
    FormatError
        When the words are not that; names the line, counted from one.
    """
    try:
        values = [float(word) for word in words]
        if len(values) != count or not np.isfinite(values).all():
            raise ValueError
    except ValueError:
        shown = " ".join(words)[:60]
        raise FormatError(f"line {line}: `{shown}` is not {count} numbers", where=path) from None
    return values


def is_number(word: str) -> bool:
    """Whether a word is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True


def read_bytes(path: Path, most_mb: int) -> bytes:
    """Content of a file of at most `most_mb` megabytes.

    Raises
    ------
    InputError
        When it cannot be read, or is larger.
    """
    with readable(path):
        if path.stat().st_size > most_mb * 1_000_000:
            raise InputError(f"is larger than {most_mb} MB", where=path)
        return path.read_bytes()


class Binary:
    """A binary file, read from its beginning."""

    def __init__(self, path: Path, begin: int = 0) -> None:
        self.path, self._content, self._at = path, read_bytes(path, 1000), begin

    @property
    def left(self) -> int:
        """Number of bytes that were not read."""
        return len(self._content) - self._at

    def _next(self, size: int) -> int:
        start, self._at = self._at, self._at + size
        if size < 0 or self.left < 0:
            raise FormatError("ends too early", where=self.path, do="write it again")
        return start

    def skip(self, size: int) -> None:
        """Leave out bytes."""
        self._next(size)

    def take(self, form: str) -> tuple[Any, ...]:
        """Values in the form of :mod:`struct`."""
        return struct.unpack_from(form, self._content, self._next(struct.calcsize(form)))

    def count(self, form: str = "<Q") -> int:
        """A number of entries."""
        return int(self.take(form)[0])

    def table(self, length: int, kind: np.dtype[Any]) -> NDArray[Any]:
        """Rows of a structured array."""
        start = self._next(length * kind.itemsize)
        return np.frombuffer(self._content, kind, length, start)

    def text(self) -> str:
        """Text up to a zero byte."""
        end = self._content.find(b"\0", self._at)
        if end < 0:
            raise FormatError("ends within a name", where=self.path, do="write it again")
        start = self._next(end + 1 - self._at)
        return self._content[start:end].decode("utf-8", "replace")


class Control(NamedTuple):
    """A known point: coordinates (3,), standard deviations (3,), NaN where they are no observations."""

    xyz: Array
    sigma: Array
    role: str


def require_said(sigma: Array, path: Path, what: str) -> None:
    """Ask for the standard deviations of control points where all are 1, which a program writes by default.

    Raises
    ------
    UsageError
        Says `what` all are 1, and which option gives them.
    """
    if (sigma == 1).any() and ((sigma == 1) | np.isnan(sigma)).all():
        raise UsageError(what, where=path, do="say how good they are: --control-sigma, 0.01 for 1 cm")


def network_of(
    cameras: tuple[Camera, ...],
    images: tuple[str, ...],
    camera_of: Rows,
    rotation: Array,
    x0: Array,
    points: tuple[str, ...],
    xyz: Array,
    seen: ArrayLike,
    *,
    control: Mapping[str, Control] | None = None,
    files: tuple[str | None, ...] | None = None,
    unit: str = "",
    notes: tuple[str, ...] = (),
) -> Network:
    """Create a free network with approximate coordinates and poses of another program.

    Parameters
    ----------
    rotation : ndarray (m, 3)
        Rotation vectors.
    seen : ndarray (n, 4) or (n, 6)
        Row of the image, row of the point, x, y; their standard deviations, by default 1: px.
    control : mapping of str to Control
        Known points, by name; others are tie points. Points that are not seen are left out.
    notes : tuple of str
        What was assumed or left out.
    """
    table = np.asarray(seen, dtype=np.float64)
    cov = np.tile(np.eye(2), (len(table), 1, 1))
    if table.shape[1] > 4:
        cov[:, [0, 1], [0, 1]] = table[:, 4:] ** 2
    m, p = len(images), len(points)
    xyz, sigma, role = xyz.copy(), np.full((p, 3), np.nan), ["tie"] * p
    for j, name in enumerate(points):
        if control is not None and name in control:
            xyz[j], sigma[j], role[j] = control[name]
    return Network(
        cameras=cameras,
        images=images,
        camera_of=camera_of,
        x0=x0,
        rotation=rotation,
        points=points,
        xyz=xyz,
        sigma=sigma,
        role=tuple(role),
        image_of=table[:, 0].astype(np.intp),
        point_of=table[:, 1].astype(np.intp),
        xy=table[:, 2:4],
        cov=cov,
        distance_of=np.zeros((0, 2), dtype=np.intp),
        distance=np.zeros((0, 2)),
        datum="free",
        datum_points=np.ones(p, dtype=bool),
        groups=(None,) * m,
        files=files or (None,) * m,
        notes=notes,
        unit=unit,
    )
