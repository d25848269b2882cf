"""One session at a time on an instrument: a lock that names its owner and ends with its process."""

from __future__ import annotations

import fcntl
import getpass
import hashlib
import json
import os
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Self

from ..core.errors import StateError

__all__ = ["BenchLock"]


class BenchLock:
    """Exclusive use of the instruments at some addresses, within a ``with`` block.

    Parameters
    ----------
    addresses : iterable of str
        Addresses of the instruments. Two locks with a common address exclude each other.
    owner : str
        Purpose of the lock, shown to whoever is refused.
    folder : path, optional
        Folder of the lock files. Default: one that all users of this machine share.

    Notes
    -----
    The operating system releases the lock (``flock``) when the process ends, for any reason: the files that a
    killed process leaves behind lock nothing.

    Examples
    --------
    >>> with tempfile.TemporaryDirectory() as folder, BenchLock(["sim-a"], "session monday", Path(folder)):
    ...     with BenchLock(["sim-b"], "session tuesday", Path(folder)):
    ...         print("different instruments")
    different instruments
    """

    def __init__(self, addresses: Iterable[str], owner: str, folder: Path | None = None) -> None:
        self._addresses = sorted(set(addresses))
        self._owner = owner
        self._folder = folder or Path(tempfile.gettempdir()) / "reseau-locks"
        self._held: list[IO[str]] = []

    def __enter__(self) -> Self:
        """Take the lock.

        Raises
        ------
        StateError
            If another process uses one of the instruments; names the process.
        """
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with suppress(PermissionError):  # another user has made it, for all users
                self._folder.chmod(0o1777)
            for address in self._addresses:
                self._take(address)
        except OSError as error:
            self.__exit__()
            raise StateError(f"cannot be locked ({error.strerror})", where=self._folder) from None
        except BaseException:
            self.__exit__()
            raise
        return self

    def _take(self, address: str) -> None:
        # A device is the same under all its names.
        real = os.path.realpath(address) if address.startswith("/") else address
        handle = _shared_file(self._folder / f"{hashlib.sha256(real.encode()).hexdigest()[:20]}.lock")
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            with handle, suppress(ValueError):
                owner = json.load(handle)
                who = f"{owner['owner']} (process {owner['pid']} of {owner['user']} since {owner['since']})"
                what, do = f"is in use by {who}", "wait, or stop that process"
                raise StateError(what, where=address, do=do) from None
            raise StateError("is in use by another process", where=address, do="wait") from None
        self._held.append(handle)
        handle.truncate(0)
        since = datetime.now(UTC).isoformat(timespec="seconds")
        owner = {"owner": self._owner, "pid": os.getpid(), "user": _user(), "since": since}
        json.dump(owner, handle)
        handle.flush()

    def __exit__(self, *_: object) -> None:
        while self._held:
            handle = self._held.pop()
            with suppress(OSError):
                handle.truncate(0)
            handle.close()


def _shared_file(path: Path) -> IO[str]:
    """Open a file that all users may write."""
    try:
        # In a sticky folder, O_CREAT on a file of another user is refused.
        number = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    except FileNotFoundError:
        number = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        os.fchmod(number, 0o666)
    return os.fdopen(number, "r+", encoding="utf-8")


def _user() -> str:
    """Name of the user; in a container the number may have no name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())
