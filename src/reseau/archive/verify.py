"""Whether an archive still holds what was put into it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ..core.errors import ArchiveError
from .archive import Archive

__all__ = ["Verified", "verify"]


@dataclass(frozen=True)
class Verified:
    """What came out; truthy when all is sound.

    Parameters
    ----------
    files : int
        How many the index names.
    size : int
        Their bytes.
    damaged : tuple of str
        What is missing or changed, by the frame or result it is; and what is wrong with the index.
    unknown : tuple of str
        Files that the index does not name: of a process that was killed between file and index. They harm
        nothing; resuming the session enters its own.
    """

    files: int
    size: int
    damaged: tuple[str, ...]
    unknown: tuple[str, ...]

    def __bool__(self) -> bool:
        return not self.damaged


def verify(archive: Archive, step: Callable[[str], None] = lambda name: None) -> Verified:
    """Read every file again and compare it with its hash, and have the index look at itself.

    Parameters
    ----------
    archive : Archive
        Which.
    step : callable, optional
        Told the name of each file that has been read.
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
    return Verified(len(known), total, tuple(damaged), unknown)
