"""What installed packages add: drivers, camera models, kinds of sessions, by entry points."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

from .errors import UsageError

INSTRUMENTS, DISCOVERY, SIMULATORS = "reseau.instruments", "reseau.discovery", "reseau.simulators"
"""Groups of entry points: drivers; functions that list addresses; simulated benches."""
CAMERAS, SESSIONS = "reseau.cameras", "reseau.sessions"
"""Groups of entry points: camera models; kinds of sessions."""
TOOLS = "reseau.tools"
"""Group of entry points: what packages of drivers know about instruments: ``profiles``, ``doctor``."""


def plugins(group: str) -> tuple[str, ...]:
    """Return the names that the installed packages have in a group of entry points.

    Examples
    --------
    >>> "zaber" in plugins(INSTRUMENTS)
    True
    """
    return tuple(sorted({each.name for each in entry_points(group=group)}))


def plugin(group: str, name: str) -> Any:
    """Load the entry point of an installed package.

    Raises
    ------
    UsageError
        If no entry point has this name, or it cannot be loaded.

    Examples
    --------
    >>> callable(plugin(INSTRUMENTS, "zaber"))
    True
    """
    found = entry_points(group=group, name=name)
    if not found:
        known = ", ".join(plugins(group))
        raise UsageError(f"no such entry point of {group}", where=name, do=f"installed: {known or 'none'}")
    try:
        return next(iter(found)).load()
    except (ImportError, AttributeError) as error:
        raise UsageError(f"cannot be loaded ({error})", where=name) from None
