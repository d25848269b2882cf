"""One session at a time on an instrument: a lock that shows its owner and dies with it."""

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
    """The instruments at some addresses, for this process alone, from entering to leaving.

    Parameters
    ----------
    addresses : iterable of str
        Of the instruments; two benches that share one lock each other out.
    owner : str
        What they are wanted for; shown to whoever comes later.
    folder : path, optional
        Where locks are; by default one that all users of this machine share.

    Notes
    -----
    The system lets go of the lock (``flock``) when the process ends, however it ends: what a killed process
    leaves behind locks nothing.
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
            When another process has one of the instruments; says which process.
        """
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with suppress(PermissionError):  # another user made it, for all
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
        # A device is the same by all its names.
        real = os.path.realpath(address) if address.startswith("/") else address
        handle = _for_all(self._folder / f"{hashlib.sha256(real.encode()).hexdigest()[:20]}.lock")
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            with handle, suppress(ValueError):
                owner = json.load(handle)
                who = f"{owner['owner']} (process {owner['pid']} of {owner['user']} since {owner['since']})"
                what, do = f"is in use by {who}", "wait, or stop that one"
                raise StateError(what, where=address, do=do) from None
            raise StateError("is in use by another process", where=address) from None
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


def _for_all(path: Path) -> IO[str]:
    """A file that all users may write, open."""
    try:
        # In a folder for all the system lets nobody open another's file as one to be made.
        number = os.open(path, os.O_RDWR | os.O_NOFOLLOW)
    except FileNotFoundError:
        number = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        os.fchmod(number, 0o666)
    return os.fdopen(number, "r+", encoding="utf-8")


def _user() -> str:
    """Who this process belongs to; in a container the number may have no name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())
