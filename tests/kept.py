"""What takes long, kept by content: pictures for all workers and runs, other results by each worker."""

from __future__ import annotations

import hashlib
import inspect
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from reseau.core.data import Array

T = TypeVar("T")
FOLDER: Path | None = None
"""Where they are kept, in pytest's cache; without it nothing is."""
_DAYS = 30
"""What was not used for as long is deleted."""


class Drawn(Protocol):
    """A dataclass of arrays and numbers that draws; neither it nor what it is drawn with is tested."""

    def picture(self) -> Array: ...


def picture(view: Drawn) -> Array:
    """The picture of a view, drawn once for each content of it and of the code that draws."""
    if FOLDER is None:
        return view.picture()
    digest = hashlib.sha256(_drawing())
    for path in dict.fromkeys(str(inspect.getsourcefile(kind)) for kind in type(view).__mro__[:-1]):
        digest.update(_source(path))
    for part in _content(view):
        digest.update(part + b"\0")
    kept = FOLDER / f"{digest.hexdigest()}.npy"
    if kept.exists():
        os.utime(kept)
        return np.asarray(np.load(kept))
    pixels = view.picture()
    # Another worker may write the same one.
    written = kept.with_suffix(f".{os.getpid()}")
    with written.open("wb") as file:
        np.save(file, pixels)
    written.replace(kept)
    return pixels


_FOUND: dict[tuple[object, bytes], object] = {}


def once(function: Callable[..., T], *arguments: object) -> T:
    """What a function returns, computed once for each content of its arguments."""
    digest = hashlib.sha256()
    for part in _content(arguments):
        digest.update(part + b"\0")
    key = function, digest.digest()
    if key not in _FOUND:
        _FOUND[key] = function(*arguments)
    return _FOUND[key]  # type: ignore[return-value]


def clear_unused(folder: Path) -> None:
    """Delete the pictures that no run has used for a month."""
    for path in folder.iterdir():
        if path.stat().st_mtime < time.time() - _DAYS * 86400:
            path.unlink(missing_ok=True)


@cache
def _drawing() -> bytes:
    """What draws: the worlds of the benchmarks, which use nothing of the project, and the libraries."""
    worlds = sorted((Path(__file__).parents[1] / "benchmarks" / "worlds").glob("*.py"))
    versions = " ".join(version(name) for name in ("numpy", "scipy", "opencv-python-headless"))
    return b"".join(map(_source, map(str, worlds))) + versions.encode()


@cache
def _source(path: str) -> bytes:
    return Path(path).read_bytes()


def _content(value: object) -> Iterator[bytes]:
    """Class and fields of dataclasses, sizes and bytes of arrays, and what else is its own text."""
    if is_dataclass(value):
        yield type(value).__qualname__.encode()
        for field in fields(value):
            if field.init:
                yield from _content(getattr(value, field.name))
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype}{value.shape}".encode() + value.tobytes()
    elif isinstance(value, tuple | list):
        for part in value:
            yield from _content(part)
    else:
        yield repr(value).encode()
