"""Drivers of turntables: axes that home, move and stop, independent of the controller."""

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
    """Create the driver of a table with chained Zaber devices; entry point ``zaber``.

    Parameters
    ----------
    name : str
        Name on the bench.
    address : str or Link
        Serial device or ``tcp://host:port``.
    axes : mapping
        Fields of :class:`AxisPlan` by name of the axis.
    settings : mapping, optional
        Values for :class:`TableSettings`.
    **options
        Further arguments of :class:`Table`.

    Examples
    --------
    >>> axes = {"tilt": {"per_unit": 2844.4, "low": -45.0, "high": 45.0, "backlash": 0.2}}
    >>> table = zaber("table", "/dev/ttyUSB0", axes=axes, settings={"speed": 5.0})
    >>> table.axes["tilt"].unit, table.axes["tilt"].limits
    ('deg', (-44.8, 45.0))
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
    """Create the driver of a table with Newport SMC100 controllers; entry point ``smc100``.

    Parameters
    ----------
    name, address, axes, settings, **options
        As for :func:`zaber`; for a CONEX controller use the address ``device@921600``.

    Examples
    --------
    >>> table = smc100("table", "/dev/ttyUSB0", axes={"roll": {"device": 2, "high": 180.0}})
    >>> sorted(table.axes)
    ['roll']
    """
    return Table(
        name,
        Smc100(link_to(address, baud=57600, xonxoff=True)),
        AxisPlan.read(axes),
        TableSettings().changed(settings or {}),
        **options,
    )
