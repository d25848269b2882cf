"""Memory that is available to this process, and how one that runs for weeks keeps to what it needs."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
from pathlib import Path

_ARENA_MAX = -8
"""`M_ARENA_MAX` of the C library of Linux."""


def available_memory() -> float:
    """Return the memory (bytes) that this process can still take: of the machine, and of its control group.

    Examples
    --------
    >>> available_memory() > 0
    True
    """
    found = [_of_machine()]
    group = Path("/sys/fs/cgroup")
    limit, used = _number(group / "memory.max"), _number(group / "memory.current")
    if limit is not None and used is not None:
        found.append(max(limit - used, 0.0))
    return min(found)


def _of_machine() -> float:
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return 1024.0 * int(line.split()[1])
    except (OSError, ValueError):
        pass
    # Not on Linux: what is installed.
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return float("inf")


def _number(path: Path) -> float | None:
    """Number in a file; None where there is no such file or no limit."""
    try:
        return float(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None


def share_freed_memory() -> None:
    """Let every thread of this process use the memory that any other one has freed.

    The C library of Linux gives threads arenas of their own, up to eight for each processor. What is freed in
    one of them is of no use to the threads of another, so that a process with many threads grows for hours.
    Call it before the threads are started. Other C libraries are left as they are.

    Examples
    --------
    >>> share_freed_memory()
    """
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):  # not the GNU C library
            ctypes.CDLL(None).mallopt(_ARENA_MAX, 1)


def keep_loaded() -> None:
    """Exempt what is loaded by now, such as modules, from the collection of garbage.

    Python collects old garbage when a quarter as many objects are new as there are old ones: with many
    modules that is seldom, so that garbage with circular references piles up, and all threads wait for long
    when it is collected.

    Examples
    --------
    >>> import gc
    >>> keep_loaded()
    >>> gc.get_freeze_count() > 0
    True
    """
    gc.collect()
    gc.freeze()
