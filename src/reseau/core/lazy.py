"""Names of a package that are imported when they are first used."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import Any


def above(place: str) -> Any:
    """Return what a method of a result needs of a module above its own, imported at the call.

    Layers hold for what modules import, and what a result is does not depend on the packages above it. That
    ``result.report(path)`` can be written where the function is ``reseau.report``'s is for the user's
    convenience. It is for methods of results alone.

    Parameters
    ----------
    place : str
        Module and name, ``module:name``.

    Examples
    --------
    >>> above("reseau.core.data:Frame").__name__
    'Frame'
    """
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


@contextmanager
def without_collecting() -> Iterator[None]:
    """Look for no circles of objects while many are made that stay: imports and compilers make so many.

    Neither are they looked through when Python ends; where a process lives until old objects are looked
    through, they are among these again, as are those that others had made before.

    Examples
    --------
    >>> with without_collecting():
    ...     gc.isenabled()
    False
    >>> gc.get_freeze_count() > 0
    True
    """
    # Counting what others froze walks through all of it.
    collects, kept = gc.isenabled(), _thaw in gc.callbacks or gc.get_freeze_count() > 0
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if not kept:
            gc.callbacks.append(_thaw)
        if collects:
            gc.enable()


def _thaw(phase: str, about: Mapping[str, int]) -> None:
    """Look through everything again, unless Python ends."""
    if phase == "start" and about["generation"] == 2 and not sys.is_finalizing():
        gc.callbacks.remove(_thaw)
        gc.unfreeze()


def lazily(package: str, places: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the function ``__getattr__`` of a package.

    Parameters
    ----------
    package : str
        Its ``__name__``.
    places : mapping of str to str
        Modules that define the names, relative to the package.

    Examples
    --------
    >>> found = lazily("reseau.core", {"Frame": ".data"})
    >>> found("Frame").__name__
    'Frame'
    >>> found("Film")
    Traceback (most recent call last):
    AttributeError: module 'reseau.core' has no attribute 'Film'
    """

    def get(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        with without_collecting():
            found = getattr(import_module(places[name], package), name)
        setattr(sys.modules[package], name, found)
        return found

    return get
