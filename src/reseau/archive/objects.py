"""Stores of files by their SHA-256: written once, never changed."""

from __future__ import annotations

import hashlib
import io
import os
import time
import uuid
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from ..core.errors import ArchiveError
from ..core.provenance import sha256_of

_LONGEST_WRITE_S = 600.0
"""Time after which a temporary file is no longer that of a process that is writing it."""
_MOST_CHECKED = 10_000
"""Files of which is remembered that they were checked."""


class Objects(Protocol):
    """Interface of a store of bytes by their SHA-256.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     store: Objects = objects_at(folder)
    ...     store.get(store.put(b"pixels", ".raw"), ".raw")
    b'pixels'
    """

    @property
    def place(self) -> str:
        """Name of the place, for messages."""

    def put(self, data: bytes, suffix: str) -> str:
        """Store bytes durably, unless they exist, and return their SHA-256."""

    def get(self, sha256: str, suffix: str) -> bytes:
        """Return the bytes of a hash."""

    def open(self, sha256: str, suffix: str) -> BinaryIO:
        """Return a stream of the bytes of a hash, of which parts can be read."""

    def names(self) -> Iterator[tuple[str, str]]:
        """Return SHA-256 and suffix of all files."""

    def left_over(self) -> Iterator[str]:
        """Return the paths of temporary files of killed processes."""

    def write_record(self, key: str, data: bytes) -> None:
        """Write a record durably, in place of an earlier one; its name is a SHA-256."""

    def record(self, key: str) -> bytes | None:
        """Return the record of a name, or None."""


class LocalObjects:
    """A store in a folder, with subfolders named by the first two letters of the hash.

    A file is written to a temporary name, flushed to disk and renamed, and its folder is flushed: after `put`
    it survives a power failure, and a partial file never has its final name.

    Parameters
    ----------
    folder : path
        Created if it does not exist.
    durable : bool
        Whether files are flushed to disk. Otherwise a power failure may leave the last of them empty or
        partial; `put` replaces such files. For copies, and for what can be computed again.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     store = LocalObjects(Path(folder))
    ...     sha256 = store.put(b"pixels", ".raw")
    ...     store.path(sha256, ".raw").parent.name == sha256[:2]
    True
    """

    def __init__(self, folder: Path, *, durable: bool = True) -> None:
        self.folder, self._durable = folder, durable
        self._checked: dict[Path, tuple[int, int, int]] = {}

    @property
    def place(self) -> str:
        """The folder."""
        return str(self.folder)

    def path(self, sha256: str, suffix: str) -> Path:
        """Return the path of the file of a hash."""
        return self.folder / sha256[:2] / f"{sha256}{suffix}"

    def put(self, data: bytes, suffix: str) -> str:
        """Store bytes.

        Raises
        ------
        ArchiveError
            If the disk is full or read-only; nothing is left behind.
        """
        sha256 = sha256_of(data)
        path = self.path(sha256, suffix)
        if not self._has(path, data):
            self._write(path, data)
        return sha256

    def write_record(self, key: str, data: bytes) -> None:
        """Write a record, in place of an earlier one.

        Raises
        ------
        ArchiveError
            As :meth:`put`.
        """
        self._write(self.folder / _record(key), data)

    def record(self, key: str) -> bytes | None:
        """Return the record of a name, or None."""
        try:
            return (self.folder / _record(key)).read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise ArchiveError(f"cannot be read ({error.strerror})", where=self.folder) from None

    @staticmethod
    def _has(path: Path, data: bytes) -> bool:
        try:
            return path.read_bytes() == data
        except FileNotFoundError:
            return False
        except OSError as error:
            raise ArchiveError(f"cannot be read ({error.strerror})", where=path) from None

    def _write(self, path: Path, data: bytes) -> None:
        # Processes of several machines may share the folder: a number of a process is not enough.
        draft = path.with_name(f".{path.name}.{uuid.uuid4().hex[:12]}")
        try:
            if not path.parent.is_dir():
                path.parent.mkdir(parents=True, exist_ok=True)
                if self._durable:
                    _to_disk(self.folder)
            with draft.open("wb") as stream:
                stream.write(data)
                stream.flush()
                if self._durable:
                    os.fsync(stream.fileno())
            draft.replace(path)
            if self._durable:
                _to_disk(path.parent)
        except OSError as error:
            with suppress(OSError):
                draft.unlink(missing_ok=True)
            what, do = f"cannot be stored ({error.strerror})", "free disk space or name another archive"
            raise ArchiveError(what, where=self.folder, do=do) from None

    def get(self, sha256: str, suffix: str) -> bytes:
        """Return the bytes of a hash.

        Raises
        ------
        ArchiveError
            If the file is missing or changed.
        """
        path = self.path(sha256, suffix)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise ArchiveError(f"cannot be read ({error.strerror})", where=path) from None
        return _sound(data, sha256, path)

    def open(self, sha256: str, suffix: str) -> BinaryIO:
        """Return a stream of the bytes of a hash; the file is checked once, and again when it was written.

        Raises
        ------
        ArchiveError
            If the file is missing or changed.
        """
        path = self.path(sha256, suffix)
        try:
            stream = path.open("rb")
        except OSError as error:
            raise ArchiveError(f"cannot be read ({error.strerror})", where=path) from None
        about = os.fstat(stream.fileno())
        state = about.st_ino, about.st_size, about.st_mtime_ns
        if self._checked.get(path) != state:
            try:
                found = hashlib.file_digest(stream, "sha256").hexdigest()
            except OSError as error:
                stream.close()
                raise ArchiveError(f"cannot be read ({error.strerror})", where=path) from None
            if found != sha256:
                stream.close()
                raise _changed(path)
            if len(self._checked) > _MOST_CHECKED:
                self._checked.clear()
            self._checked[path] = state
            stream.seek(0)
        return stream

    def names(self) -> Iterator[tuple[str, str]]:
        """Return SHA-256 and suffix of all files, except temporary files of killed processes."""
        if not self.folder.is_dir():
            return
        for folder in sorted(self.folder.iterdir()):
            for path in sorted(folder.iterdir()) if folder.is_dir() else ():
                if len(path.stem) == 64 and not path.name.startswith("."):
                    yield path.stem, path.suffix

    def left_over(self) -> Iterator[str]:
        """Return the paths of temporary files of killed processes: nobody has written to them for long."""
        for path in sorted(self.folder.glob("*/.*")):
            with suppress(FileNotFoundError):  # it has got its name meanwhile
                if time.time() - path.stat().st_mtime > _LONGEST_WRITE_S:
                    yield str(path)


class RemoteObjects:
    """An object store supported by fsspec: ``s3://bucket/folder``, ``memory://folder`` and others.

    Parameters
    ----------
    url : str
        URL of a folder.

    Raises
    ------
    ArchiveError
        If the protocol is unknown, or its package is not installed.

    Examples
    --------
    >>> store = RemoteObjects("memory://frames")
    >>> store.get(store.put(b"pixels", ".raw"), ".raw")
    b'pixels'
    """

    def __init__(self, url: str) -> None:
        import fsspec

        self._url = url.rstrip("/")
        try:
            self._files, self._root = fsspec.url_to_fs(self._url)
        except (ValueError, ImportError, OSError) as error:
            raise ArchiveError(f"cannot be used as an object store ({error})", where=url) from None

    @property
    def place(self) -> str:
        """The URL."""
        return self._url

    def _path(self, sha256: str, suffix: str) -> str:
        return f"{self._root}/{sha256[:2]}/{sha256}{suffix}"

    def put(self, data: bytes, suffix: str) -> str:
        """Store bytes; object stores write atomically.

        Raises
        ------
        ArchiveError
            If the store refuses them.
        """
        sha256 = sha256_of(data)
        path = self._path(sha256, suffix)

        def keep() -> None:
            if not (self._files.exists(path) and self._files.size(path) == len(data)):
                self._files.makedirs(path.rpartition("/")[0], exist_ok=True)
                self._files.pipe_file(path, data)

        self._asked(keep)
        return sha256

    def get(self, sha256: str, suffix: str) -> bytes:
        """Return the bytes of a hash.

        Raises
        ------
        ArchiveError
            If the file is missing or changed.
        """
        path = self._path(sha256, suffix)
        return _sound(bytes(self._asked(lambda: self._files.cat_file(path))), sha256, path)

    def open(self, sha256: str, suffix: str) -> BinaryIO:
        """Return a stream of the bytes of a hash, which are fetched whole and checked.

        Raises
        ------
        ArchiveError
            If the file is missing or changed.
        """
        return io.BytesIO(self.get(sha256, suffix))

    def write_record(self, key: str, data: bytes) -> None:
        """Write a record, in place of an earlier one; object stores write atomically.

        Raises
        ------
        ArchiveError
            If the store refuses it.
        """
        path = f"{self._root}/{_record(key)}"

        def keep() -> None:
            self._files.makedirs(path.rpartition("/")[0], exist_ok=True)
            self._files.pipe_file(path, data)

        self._asked(keep)

    def record(self, key: str) -> bytes | None:
        """Return the record of a name, or None."""
        path = f"{self._root}/{_record(key)}"

        def read() -> bytes | None:
            try:
                return bytes(self._files.cat_file(path))
            except FileNotFoundError:
                return None

        found: bytes | None = self._asked(read)
        return found

    def names(self) -> Iterator[tuple[str, str]]:
        """Return SHA-256 and suffix of all files."""
        found = self._asked(lambda: self._files.find(self._root) if self._files.exists(self._root) else [])
        for path in sorted(found):
            stem, dot, suffix = path.rpartition("/")[2].partition(".")
            if len(stem) == 64:
                yield stem, dot + suffix

    def left_over(self) -> Iterator[str]:
        """Return nothing: object stores write atomically."""
        return iter(())

    def _asked(self, question: Any) -> Any:
        try:
            return question()
        except Exception as error:  # each backend of fsspec has its own exceptions
            raise ArchiveError(f"the object store refused ({error})", where=self._url) from None


def objects_at(place: str | Path, *, durable: bool = True) -> Objects:
    """Return the store at a folder or URL.

    Parameters
    ----------
    place : str or Path
        Folder, or URL of fsspec.
    durable : bool
        Whether files of a folder are flushed to disk; see :class:`LocalObjects`.

    Raises
    ------
    ArchiveError
        If it cannot be used.

    Examples
    --------
    >>> objects_at("memory://frames").place
    'memory://frames'
    """
    return RemoteObjects(str(place)) if "://" in str(place) else LocalObjects(Path(place), durable=durable)


def _record(key: str) -> str:
    # No name of a record is as long as a hash: `names` passes over it.
    return f"records/{key[:2]}/record-{key}.json"


def _sound(data: bytes, sha256: str, where: object) -> bytes:
    if sha256_of(data) != sha256:
        raise _changed(where)
    return data


def _changed(where: object) -> ArchiveError:
    return ArchiveError("has been changed (SHA-256 differs)", where=where, do="restore it from a backup")


def _to_disk(folder: Path) -> None:
    """Flush the entries of a folder to disk; Windows flushes them with the file."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
