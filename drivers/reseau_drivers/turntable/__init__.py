"""Turntables: axes that home, move and stop, whoever made their controller."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..link import Link, link_to
from .smc100 import Smc100
from .table import Axis, AxisPlan, Table, TableSettings
from .zaber import Zaber

__all__ = ["Axis", "AxisPlan", "Smc100", "Table", "TableSettings", "Zaber", "smc100", "zaber"]


def zaber(
    name: str,
    address: str | Link,
    *,
    axes: Mapping[str, Mapping[str, Any]],
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> Table:
    """A table whose axes are moved by chained Zaber devices; found by its entry point.

    Parameters
    ----------
    name : str
        On the bench.
    address : str or Link
        Serial device or ``tcp://host:port``.
    axes : mapping
        Fields of :class:`AxisPlan` by the name of the axis.
    settings : mapping, optional
        Of :class:`TableSettings`.
    **options
        Of :class:`Table`.
    """
    return Table(
        name, Zaber(link_to(address)), AxisPlan.read(axes), TableSettings().changed(settings or {}), **options
    )


def smc100(
    name: str,
    address: str | Link,
    *,
    axes: Mapping[str, Mapping[str, Any]],
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> Table:
    """A table whose axes are moved by Newport SMC100 controllers; found by its entry point.

    Parameters
    ----------
    name, address, axes, settings, **options
        As for :func:`zaber`; a CONEX wants ``device@921600``.
    """
    return Table(
        name,
        Smc100(link_to(address, baud=57600, xonxoff=True)),
        AxisPlan.read(axes),
        TableSettings().changed(settings or {}),
        **options,
    )
