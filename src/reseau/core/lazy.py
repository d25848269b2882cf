"""Names of a package that are imported when they are first used."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

__all__ = ["lazily"]


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
        found = getattr(import_module(places[name], package), name)
        setattr(sys.modules[package], name, found)
        return found

    return get
