"""Backup and restore of a service's archive and state, and upgrades of their schema."""

from __future__ import annotations

import os
import shutil
import sqlite3
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path

from ..archive import Archive
from ..archive.verification import verify
from ..core.errors import ArchiveError, InputError, UsageError
from ..core.files import empty_folder

_ARCHIVE, _STATE, _INDEX, _OBJECTS, _WORKERS = "archive", "state", "index.sqlite", "objects", "workers"
_KEPT = ("accounts.sqlite", "audit-key.pem", "audit-public.pem", "audit-head.json", "local-token")


@dataclass(frozen=True)
class Counted:
    """What was copied.

    Examples
    --------
    >>> Counted(3, 40).files
    40
    """

    sessions: int
    files: int


def backup(archive: Path, state: Path, out: Path) -> Counted:
    """Copy the archive and the state of a service to a new folder, and verify the copy.

    The service may be running: the index is copied by SQLite's own backup before the files, and an archive
    never changes a file, so that every file that the copied index names is there.

    Parameters
    ----------
    archive : Path
        Folder of the archive.
    state : Path
        State folder.
    out : Path
        Folder to write.

    Raises
    ------
    UsageError
        If the archive is a database, or `out` is not empty.
    InputError
        If it cannot be written.
    ArchiveError
        If the copy is not whole.
    """
    if "://" in str(archive) or not (archive / _INDEX).is_file():
        do = "back up a database with its own tools, and the folder of the files"
        raise UsageError("is not an archive in a folder", where=archive, do=do)
    return _copied(archive, state, out / _ARCHIVE, out / _STATE, out)


def restore(source: Path, archive: Path, state: Path) -> Counted:
    """Restore a backup to a new archive and a new state folder.

    Raises
    ------
    UsageError
        If it is not a backup, or archive or state folder exist already.
    ArchiveError
        If the backup is not whole.
    """
    if not (source / _ARCHIVE / _INDEX).is_file():
        raise UsageError("is not a backup", where=source)
    for place in (archive, state):
        if place.exists() and any(place.iterdir()):
            raise UsageError("is there already", where=place, do="name another place, or move it away")
    return _copied(source / _ARCHIVE, source / _STATE, archive, state, archive)


def _copied(archive: Path, state: Path, to: Path, to_state: Path, new: Path) -> Counted:
    empty_folder(new)
    try:
        to.mkdir(parents=True, exist_ok=True)
        to_state.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.chmod(to_state, 0o700)
        _database(archive / _INDEX, to / _INDEX)
        shutil.copytree(archive / _OBJECTS, to / _OBJECTS, dirs_exist_ok=True)
        for name in _KEPT:
            if (state / name).is_file():
                if name.endswith(".sqlite"):
                    _database(state / name, to_state / name)
                else:
                    shutil.copy2(state / name, to_state / name)
                os.chmod(to_state / name, 0o600)
        # Workers on other machines know the service by these.
        for each in (state / _WORKERS).glob("*.pem"):
            (to_state / _WORKERS).mkdir(mode=0o700, exist_ok=True)
            shutil.copy2(each, to_state / _WORKERS / each.name)
            os.chmod(to_state / _WORKERS / each.name, 0o600)
    except (OSError, sqlite3.Error, shutil.Error) as error:
        raise InputError(f"cannot be written ({error})", where=new) from None
    with Archive.open(to) as made:
        found = verify(made)
        sessions = len(made.sessions())
    if not found:
        raise ArchiveError(f"is not whole: {found.damaged[0]}", where=new, do="see `reseau archive verify`")
    return Counted(sessions, found.files)


def _database(source: Path, to: Path) -> None:
    """Copy a database of SQLite that may be in use."""
    with (
        closing(sqlite3.connect(f"file:{source}?mode=ro", uri=True)) as old,
        closing(sqlite3.connect(to)) as new,
    ):
        old.backup(new)
        with suppress(sqlite3.Error):
            new.execute("PRAGMA journal_mode=WAL")


def upgrade_archive(archive: Archive) -> list[str]:
    """Add what archives of earlier versions lack, and return it in words.

    Raises
    ------
    ArchiveError
        If the archive is read-only.
    """
    return ["journals of the archive"] if archive.extend() else []
