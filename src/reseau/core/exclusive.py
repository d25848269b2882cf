"""Lock a file for one process, on every system."""

from __future__ import annotations

from typing import IO

_BEYOND = 1 << 30
"""Position of the byte that is locked where a lock keeps others from reading: beyond the content."""


def lock_file(handle: IO[str] | IO[bytes]) -> bool:
    """Lock an open file until it is closed or the process ends; return whether no other process has.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryFile() as file:
    ...     lock_file(file)
    True
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return _lock_byte(handle)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _lock_byte(handle: IO[str] | IO[bytes]) -> bool:
    """Lock a byte of the file, as Windows does it."""
    import importlib
    import os

    windows = importlib.import_module("msvcrt")
    number = handle.fileno()
    at = os.lseek(number, 0, os.SEEK_CUR)
    try:
        os.lseek(number, _BEYOND, os.SEEK_SET)
        windows.locking(number, windows.LK_NBLCK, 1)
    except OSError:
        return False
    finally:
        os.lseek(number, at, os.SEEK_SET)
    return True
