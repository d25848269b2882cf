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

from ..errors import StateError

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
        self._folder.mkdir(parents=True, exist_ok=True)
        with suppress(PermissionError):  # another user made it, for all
            self._folder.chmod(0o1777)
        try:
            for address in self._addresses:
                self._take(address)
        except BaseException:
            self.__exit__()
            raise
        return self

    def _take(self, address: str) -> None:
        path = self._folder / f"{hashlib.sha256(address.encode()).hexdigest()[:20]}.lock"
        handle = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT, 0o666), "r+", encoding="utf-8")
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
        owner = {"owner": self._owner, "pid": os.getpid(), "user": getpass.getuser(), "since": since}
        json.dump(owner, handle)
        handle.flush()

    def __exit__(self, *_: object) -> None:
        while self._held:
            handle = self._held.pop()
            with suppress(OSError):
                handle.truncate(0)
            handle.close()
