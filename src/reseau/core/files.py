"""Files that appear complete or not at all."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from .errors import InputError, UsageError

P = TypeVar("P", bound=Path | None)


def writable(path: P, *suffixes: str, folder: bool = False) -> P:
    """Return the path if a file can be written there; nothing is made: called before a computation.

    Parameters
    ----------
    path : Path or None
        None is returned as it is.
    *suffixes : str
        What its name may end in; by default anything.
    folder : bool
        Whether it is a folder of files, which may be there already.

    Raises
    ------
    InputError
        When the folder does not exist, or nothing can be written there.
    UsageError
        When the suffix is another one.

    Examples
    --------
    >>> writable(Path("camera.yml"), ".json")
    Traceback (most recent call last):
    ...
    reseau.core.errors.UsageError: camera.yml: has the suffix '.yml'; use .json
    """
    if path is None:
        return path
    there = path.is_dir()
    inside = path if there and folder else path.parent
    if not inside.is_dir():
        raise InputError("its folder does not exist", where=path, do="create the folder first")
    if there and not folder:
        raise InputError("is a folder", where=path, do="give the name of a file")
    if path.exists() and folder and not there:
        raise InputError("is a file", where=path, do="give the name of a folder")
    if not os.access(inside, os.W_OK):
        raise InputError("its folder is write-protected", where=path, do="choose another one")
    if suffixes and path.suffix.lower() not in suffixes:
        what = f"has the suffix {path.suffix!r}" if path.suffix else "has no suffix"
        raise UsageError(what, where=path, do=f"use {', '.join(suffixes)}")
    return path


@contextmanager
def readable(path: object) -> Iterator[None]:
    """Say of a file that the block cannot read it.

    Raises
    ------
    InputError
        When it cannot be read.

    Examples
    --------
    >>> with readable("none.txt"):
    ...     open("none.txt")
    Traceback (most recent call last):
    reseau.core.errors.InputError: none.txt: cannot be read (No such file or directory)
    """
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", where=path) from None


def head_of(path: Path, size: int = 4000) -> bytes:
    """Return the first bytes of a file, which tell its format.

    Raises
    ------
    InputError
        When it cannot be read.

    Examples
    --------
    >>> head_of(Path("none.txt"))
    Traceback (most recent call last):
    reseau.core.errors.InputError: none.txt: cannot be read (No such file or directory)
    """
    with readable(path), path.open("rb") as file:
        return file.read(size)


def empty_folder(path: Path, do: str = "give a new or an empty folder") -> Path:
    """Return the path if there is nothing there, or an empty folder.

    Raises
    ------
    UsageError
        When there is something; `do` says what helps.
    """
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise UsageError("is not empty", where=path, do=do)
    return path


def made_folder(path: Path) -> Path:
    """Make a folder and those that contain it, where they are not there, and return its path.

    Raises
    ------
    InputError
        When it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be created ({error.strerror})", where=path) from None
    return path


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file completely or not at all.

    Raises
    ------
    InputError
        When the folder does not exist or cannot be written to.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_whole(Path(folder) / "note.txt", b"21")
    ...     (Path(folder) / "note.txt").stat().st_size
    2
    """
    data = content.encode("utf-8") if isinstance(content, str) else content
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with draft.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        draft.replace(path)
    except OSError as error:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
        raise InputError(f"cannot be written ({error.strerror})", where=path) from None


_NUMBERED = re.compile(r"(?P<file>.+)#(?P<frame>\d+)")


def split_frame(path: Path) -> tuple[Path, int | None]:
    """Split ``file.dcm#3`` into the file and the number of its frame, from 1; None without one.

    A file that is really called so is left as it is.

    Examples
    --------
    >>> file, frame = split_frame(Path("loop.dcm#3"))
    >>> file.name, frame
    ('loop.dcm', 3)
    """
    found = _NUMBERED.fullmatch(path.name)
    if found is None or path.exists():
        return path, None
    return path.with_name(found["file"]), int(found["frame"])
