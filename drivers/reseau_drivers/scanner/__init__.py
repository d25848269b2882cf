"""Ultrasonic scanners."""

from __future__ import annotations

from typing import Any

from ..link import Link, link_to
from .ping360 import Ping360, Ping360Settings

__all__ = ["Ping360", "Ping360Settings", "ping360"]


def ping360(
    name: str, address: str | Link, *, settings: dict[str, Any] | None = None, **options: Any
) -> Ping360:
    """A Ping360; found by its entry point.

    Parameters
    ----------
    name : str
        On the bench.
    address : str or Link
        Serial device or ``tcp://host:port``.
    settings : dict, optional
        Of :class:`Ping360Settings`.
    **options
        Of :class:`Ping360`.
    """
    return Ping360(name, link_to(address), Ping360Settings().changed(settings or {}), **options)
