"""Bytes by their SHA-256: written once, never changed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from ..core.errors import ArchiveError
from ..core.provenance import sha256_of

__all__ = ["LocalObjects", "Objects", "RemoteObjects", "objects_at"]


class Objects(Protocol):
    """A store of bytes by their hash."""

    @property
    def place(self) -> str:
        """Where they are."""

    def put(self, data: bytes, suffix: str) -> str:
        """Keep bytes, unless they are there; returns their SHA-256 when nothing can lose them any more."""

    def get(self, sha256: str, suffix: str) -> bytes:
        """The bytes of a hash."""

    def names(self) -> Iterator[tuple[str, str]]:
        """Hash and suffix of all that is there."""


class LocalObjects:
    """A folder, two letters of the hash deep.

    A file is written beside its place, brought to the disk, renamed, and its folder brought to the disk:
    after `put` it outlasts a power cut, and before it there is nothing of it under its name.

    Parameters
    ----------
    folder : path
        Made when it is not there.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def place(self) -> str:
        """The folder."""
        return str(self.folder)

    def path(self, sha256: str, suffix: str) -> Path:
        """Where the bytes of a hash are."""
        return self.folder / sha256[:2] / f"{sha256}{suffix}"

    def put(self, data: bytes, suffix: str) -> str:
        """Keep bytes.

        Raises
        ------
        ArchiveError
            When the disk is full or may not be written to; nothing is left of them.
        """
        sha256 = sha256_of(data)
        path = self.path(sha256, suffix)
        if path.exists() and sha256_of(path) == sha256:
            return sha256
        draft = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            if not path.parent.is_dir():
                path.parent.mkdir(parents=True, exist_ok=True)
                _to_disk(self.folder)
            with draft.open("wb") as stream:
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
            draft.replace(path)
            _to_disk(path.parent)
        except OSError as error:
            with suppress(OSError):
                draft.unlink(missing_ok=True)
            what, do = f"cannot be kept ({error.strerror})", "make room, or name another archive"
            raise ArchiveError(what, where=self.folder, do=do) from None
        return sha256

    def get(self, sha256: str, suffix: str) -> bytes:
        """The bytes of a hash.

        Raises
        ------
        ArchiveError
            When they are not there, or are others than were put.
        """
        path = self.path(sha256, suffix)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise ArchiveError(f"cannot be read ({error.strerror})", where=path) from None
        return _sound(data, sha256, path)

    def names(self) -> Iterator[tuple[str, str]]:
        """Hash and suffix of all that is there; drafts of a process that was killed are none of them."""
        if not self.folder.is_dir():
            return
        for folder in sorted(self.folder.iterdir()):
            for path in sorted(folder.iterdir()) if folder.is_dir() else ():
                if len(path.stem) == 64 and not path.name.startswith("."):
                    yield path.stem, path.suffix


class RemoteObjects:
    """An object store that fsspec knows: ``s3://bucket/folder``, ``memory://folder`` and others.

    Parameters
    ----------
    url : str
        With the protocol.

    Raises
    ------
    ArchiveError
        When there is no such protocol, or the package for it is not installed.
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
        """Keep bytes; an object store shows an object whole or not at all.

        Raises
        ------
        ArchiveError
            When it does not take them.
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
        """The bytes of a hash.

        Raises
        ------
        ArchiveError
            When they are not there, or are others than were put.
        """
        path = self._path(sha256, suffix)
        return _sound(bytes(self._asked(lambda: self._files.cat_file(path))), sha256, path)

    def names(self) -> Iterator[tuple[str, str]]:
        """Hash and suffix of all that is there."""
        found = self._asked(lambda: self._files.find(self._root) if self._files.exists(self._root) else [])
        for path in sorted(found):
            stem, dot, suffix = path.rpartition("/")[2].partition(".")
            if len(stem) == 64:
                yield stem, dot + suffix

    def _asked(self, question: Any) -> Any:
        try:
            return question()
        except Exception as error:  # every backend of fsspec raises its own
            raise ArchiveError(f"the object store refused ({error})", where=self._url) from None


def objects_at(place: str | Path) -> Objects:
    """The store at a folder or URL.

    Raises
    ------
    ArchiveError
        When it cannot be used.
    """
    return RemoteObjects(str(place)) if "://" in str(place) else LocalObjects(Path(place))


def _sound(data: bytes, sha256: str, where: object) -> bytes:
    if sha256_of(data) != sha256:
        raise ArchiveError("holds other bytes than were put there", where=where, do="take it from a backup")
    return data


def _to_disk(folder: Path) -> None:
    """Bring the names in a folder to the disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
