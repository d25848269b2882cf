"""One session at a time on an instrument: a lock that names its owner and ends with its process."""

from __future__ import annotations

import getpass
import hashlib
import json
import os
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Self

from ..core.errors import StateError
from ..core.exclusive import lock_file


@dataclass(frozen=True)
class Holder:
    """Process that uses an instrument.

    Parameters
    ----------
    owner : str
        What it uses it for.
    pid : int
        Number of the process; 0 if it has not said so.
    user, since : str
        Its user, and the time at which it began (UTC).

    Examples
    --------
    >>> print(Holder("session monday", 4711, "anna", "2026-11-02T08:00:00+00:00"))
    session monday (process 4711 of anna since 2026-11-02T08:00:00+00:00)
    """

    owner: str
    pid: int
    user: str
    since: str

    def __str__(self) -> str:
        return f"{self.owner} (process {self.pid} of {self.user} since {self.since})"


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
    The operating system releases the lock when the process ends, for any reason: the files that a
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

    @classmethod
    def holder(cls, address: str, folder: Path | None = None) -> Holder | None:
        """Return who uses the instrument at an address; None if nobody does.

        Raises
        ------
        StateError
            If the lock files cannot be read.

        Examples
        --------
        >>> with tempfile.TemporaryDirectory() as folder, BenchLock(["sim-a"], "a test", Path(folder)):
        ...     BenchLock.holder("sim-a", Path(folder)).owner, BenchLock.holder("sim-b", Path(folder))
        ('a test', None)
        """
        try:
            with cls([address], "a question", folder):
                return None
        except _InUse as error:
            return error.holder

    def _take(self, address: str) -> None:
        # A device is the same under all its names.
        real = os.path.realpath(address) if address.startswith("/") else address
        handle = _shared_file(self._folder / f"{hashlib.sha256(real.encode()).hexdigest()[:20]}.lock")
        if not lock_file(handle):
            with handle:
                raise _InUse(address, _read(handle))
        self._held.append(handle)
        handle.truncate(0)
        since = datetime.now(UTC).isoformat(timespec="seconds")
        json.dump(asdict(Holder(self._owner, os.getpid(), _user(), since)), handle)
        handle.flush()

    def __exit__(self, *_: object) -> None:
        while self._held:
            handle = self._held.pop()
            with suppress(OSError):
                handle.truncate(0)
            handle.close()


class _InUse(StateError):
    """An instrument is used by another process."""

    def __init__(self, address: str, holder: Holder) -> None:
        self.holder = holder
        if holder.pid:
            super().__init__(f"is in use by {holder}", where=address, do="wait, or stop that process")
        else:
            super().__init__("is in use by another process", where=address, do="wait")


def _read(handle: IO[str]) -> Holder:
    """The holder that a lock file names; one without a number if the file has just been emptied."""
    try:
        return Holder(**json.load(handle))
    except (ValueError, TypeError):
        return Holder("another process", 0, "", "")


def _shared_file(path: Path) -> IO[str]:
    """Open a file that all users may write."""
    how = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0)
    try:
        # In a sticky folder, O_CREAT on a file of another user is refused.
        number = os.open(path, how)
    except FileNotFoundError:
        number = os.open(path, how | os.O_CREAT, 0o666)
        if hasattr(os, "fchmod"):  # elsewhere the folder of temporary files is that of one user
            os.fchmod(number, 0o666)
    return os.fdopen(number, "r+", encoding="utf-8")


def _user() -> str:
    """Name of the user; in a container the number may have no name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError, ImportError):
        return str(getattr(os, "getuid", lambda: "unknown user")())
