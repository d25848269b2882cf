"""Drivers of oscilloscopes over raw sockets, VXI-11, HiSLIP and USBTMC."""

from __future__ import annotations

from typing import Any

from reseau.core.errors import SettingError

from ..link import Link
from ..visa import scpi_link
from .dialects import DIALECTS, Dialect, dialect_of
from .scope import Oscilloscope, OscilloscopeSettings

__all__ = [
    "DIALECTS",
    "Dialect",
    "Oscilloscope",
    "OscilloscopeSettings",
    "dialect_of",
    "oscilloscope",
]


def oscilloscope(
    name: str,
    address: str | Link,
    *,
    settings: dict[str, Any] | None = None,
    dialect: str | None = None,
    **options: Any,
) -> Oscilloscope:
    """Create the driver of an oscilloscope; entry point ``oscilloscope``.

    Parameters
    ----------
    name : str
        Name on the bench.
    address : str or Link
        VISA resource, or ``tcp://host:port``.
    settings : dict, optional
        Values for :class:`OscilloscopeSettings`.
    dialect : str, optional
        Name of one of :data:`DIALECTS`; by default it is chosen by the answer to ``*IDN?``.
    **options
        Further arguments of :class:`Oscilloscope`.

    Raises
    ------
    SettingError
        If the dialect does not exist.

    Examples
    --------
    The connection is opened on the first call, not on construction:

    >>> scope = oscilloscope("scope", "TCPIP::192.0.2.20::INSTR", settings={"channel": 2})
    >>> scope.settings.channel
    2
    """
    by_name = {each.name: each for each in DIALECTS}
    if dialect is not None and dialect not in by_name:
        raise SettingError("is not a known dialect", where=dialect, do=f"choose from {', '.join(by_name)}")
    chosen = by_name[dialect] if dialect is not None else None
    checked = OscilloscopeSettings().changed(settings or {})
    return Oscilloscope(name, scpi_link(address), checked, dialect=chosen, **options)
