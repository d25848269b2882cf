"""Drivers of oscilloscopes over raw sockets, VXI-11, HiSLIP and USBTMC."""

from __future__ import annotations

from typing import Any

from ..link import Link
from ..visa import scpi_link
from .dialects import DIALECTS, Dialect, dialect_named, dialect_of
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
        Name of one of :data:`DIALECTS`, or of a file of profiles (``FILE.toml``, ``FILE.toml#NAME``); by
        default it is chosen by the answer to ``*IDN?``.
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
    chosen = None if dialect is None else dialect_named(dialect)
    checked = OscilloscopeSettings().changed(settings or {})
    return Oscilloscope(name, scpi_link(address), checked, dialect=chosen, **options)
