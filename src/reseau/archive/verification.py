"""Verify the files and the index of an archive."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ..core.errors import ArchiveError
from .archive import Archive


@dataclass(frozen=True)
class Verified:
    """Result of a verification; truthy if nothing is damaged.

    Parameters
    ----------
    files : int
        Number of files in the index.
    size : int
        Total size (bytes).
    damaged : tuple of str
        Missing or changed files, by frame or result; and faults of the index.
    unknown : tuple of str
        Files that are not in the index: their process was killed after writing them. They are harmless;
        resuming the session adds them.
    temporary : tuple of str
        Files that a killed process left half written, by their path. They can be deleted.

    Examples
    --------
    >>> bool(Verified(3, 1200, ("monday/tilt 0/frame: has been changed",), ()))
    False
    """

    files: int
    size: int
    damaged: tuple[str, ...]
    unknown: tuple[str, ...]
    temporary: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return not self.damaged


def verify(archive: Archive, step: Callable[[str], None] = lambda name: None) -> Verified:
    """Read every file again, compare it with its SHA-256, and check the index.

    Parameters
    ----------
    archive : Archive
        The archive.
    step : callable, optional
        Called with the name of each file that was read.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     _ = archive.begin("monday", "frames", {}, inputs={"note.txt": "warm-up 1 h"})
    ...     verify(archive).files
    1
    """
    damaged = [f"index: {line}" for line in archive.faults()]
    known, total = set(), 0
    for sha256, suffix, size, name in archive.files():
        total += size
        if (sha256, suffix) not in known:
            known.add((sha256, suffix))
            try:
                archive.objects.get(sha256, suffix)
            except ArchiveError as error:
                damaged.append(f"{name}: {error}")
        step(name)
    unknown = tuple(
        f"{sha256}{suffix}" for sha256, suffix in archive.objects.names() if (sha256, suffix) not in known
    )
    return Verified(len(known), total, tuple(damaged), unknown, tuple(archive.objects.left_over()))
