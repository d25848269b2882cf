"""The folder of the service's own state: accounts, keys, the local token; apart from the archive."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from ..core.errors import InputError, UsageError

_LOCAL, _TOKEN = "local-token", 32


def state_beside(archive: Path) -> Path:
    """Return the state folder that belongs to an archive, which need not exist.

    Examples
    --------
    >>> state_beside(Path("/srv/archive"))
    PosixPath('/srv/archive-service')
    """
    place = archive.absolute()
    return place.with_name(f"{place.name}-service")


class StateFolder:
    """The folder in which the service keeps what must not be in the archive.

    Parameters
    ----------
    folder : Path
        Created if it does not exist, readable by its owner alone.

    Raises
    ------
    UsageError
        If others may read or write it.
    InputError
        If it cannot be created.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     state = StateFolder(Path(folder) / "state")
    ...     state.local_token() == state.local_token()
    True
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.absolute()
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            mode = self.folder.stat().st_mode
        except OSError as error:
            raise InputError(f"cannot be created ({error.strerror})", where=folder) from None
        if mode & 0o077:
            raise UsageError("can be read by others", where=self.folder, do=f"chmod 700 {self.folder}")

    @classmethod
    def beside(cls, archive: str, given: Path | None = None) -> StateFolder:
        """Return the given folder, or the one that belongs to an archive in a folder.

        Raises
        ------
        UsageError
            If the archive is a database and no folder is given.
        """
        if given is not None:
            return cls(given)
        if "://" in archive:
            raise UsageError("is missing", where="--state", do="name a folder for accounts and keys")
        return cls(state_beside(Path(archive)))

    def path(self, name: str) -> Path:
        """Return the path of a file of the folder."""
        return self.folder / name

    def subfolder(self, name: str) -> Path:
        """Return a subfolder, created if it does not exist."""
        found = self.folder / name
        found.mkdir(mode=0o700, exist_ok=True)
        return found

    def local_token(self) -> str:
        """Return the token of programs of the same user on this machine; made when first asked for."""
        path = self.path(_LOCAL)
        if not path.is_file():
            private_file(path, secrets.token_urlsafe(_TOKEN).encode(), fresh=True)
        return path.read_text().strip()


def private_file(path: Path, content: bytes, *, fresh: bool = False) -> None:
    """Write a file that only its owner can read, whole or not at all.

    Parameters
    ----------
    path : Path
        The file.
    content : bytes
        Its content.
    fresh : bool
        Whether a file that is there already is kept.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     private_file(Path(folder) / "key", b"secret")
    ...     oct((Path(folder) / "key").stat().st_mode & 0o777)
    '0o600'
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    number = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0), 0o600)
    try:
        with os.fdopen(number, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if fresh:
            try:
                os.link(temporary, path)
            except FileExistsError:  # another process was faster
                return
        else:
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
