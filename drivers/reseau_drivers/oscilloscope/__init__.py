"""Oscilloscopes, over raw sockets, VXI-11, HiSLIP and USBTMC."""

from __future__ import annotations

from typing import Any

from reseau.core.errors import SettingError

from ..link import Link
from .dialects import DIALECTS, Dialect, dialect_of
from .scope import Oscilloscope, OscilloscopeSettings
from .visa import resources, scpi_link

__all__ = [
    "DIALECTS",
    "Dialect",
    "Oscilloscope",
    "OscilloscopeSettings",
    "dialect_of",
    "oscilloscope",
    "resources",
]


def oscilloscope(
    name: str,
    address: str | Link,
    *,
    settings: dict[str, Any] | None = None,
    dialect: str | None = None,
    **options: Any,
) -> Oscilloscope:
    """An oscilloscope; found by its entry point.

    Parameters
    ----------
    name : str
        On the bench.
    address : str or Link
        A VISA resource, or ``tcp://host:port``.
    settings : dict, optional
        Of :class:`OscilloscopeSettings`.
    dialect : str, optional
        Name of one of :data:`DIALECTS`, instead of the one that its identity tells.
    **options
        Of :class:`Oscilloscope`.

    Raises
    ------
    SettingError
        When there is no such dialect.
    """
    by_name = {each.name: each for each in DIALECTS}
    if dialect is not None and dialect not in by_name:
        raise SettingError("is no dialect", where=dialect, do=f"there are {', '.join(by_name)}")
    chosen = by_name[dialect] if dialect is not None else None
    checked = OscilloscopeSettings().changed(settings or {})
    return Oscilloscope(name, scpi_link(address), checked, dialect=chosen, **options)
