"""Drivers of turntables: axes that home, move and stop, independent of the controller."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from reseau.core.errors import SettingError
from reseau.instruments import RemoteOperator, TerminalOperator

from ..link import Link, link_to
from .gcode import letter_of
from .grbl import Grbl
from .hand import ByHand, HandTable, Marker
from .kinesis import Kinesis, MotorKind, kinesis_ports
from .marlin import Marlin
from .reference import References
from .smc100 import Smc100
from .table import Axis, AxisPlan, Controller, Table, TableSettings
from .zaber import Zaber

__all__ = [
    "Axis",
    "AxisPlan",
    "ByHand",
    "Grbl",
    "HandTable",
    "Kinesis",
    "Marker",
    "Marlin",
    "References",
    "Smc100",
    "Table",
    "TableSettings",
    "Zaber",
    "grbl",
    "hand",
    "kinesis",
    "kinesis_ports",
    "marlin",
    "smc100",
    "zaber",
]


def zaber(
    name: str,
    address: str | Link,
    *,
    axes: Mapping[str, Mapping[str, Any]],
    dialect: str | None = None,
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
    dialect : str, optional
        File of a profile of one's own, as ``reseau bench profile NAME`` shows one.
    **options
        Further arguments of :class:`Table`, as `keep_out`.

    Examples
    --------
    >>> axes = {"tilt": {"per_unit": 2844.4, "low": -45.0, "high": 45.0, "backlash": 0.2}}
    >>> table = zaber("table", "/dev/ttyUSB0", axes=axes, settings={"speed": 5.0})
    >>> table.axes["tilt"].unit, table.axes["tilt"].limits
    ('deg', (-44.8, 45.0))
    """
    return _table(Zaber(link_to(address), dialect=dialect), name, axes, settings, options)


def smc100(
    name: str,
    address: str | Link,
    *,
    axes: Mapping[str, Mapping[str, Any]],
    dialect: str | None = None,
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> Table:
    """Create the driver of a table with Newport SMC100 controllers; entry point ``smc100``.

    Parameters
    ----------
    name, address, axes, dialect, settings, **options
        As for :func:`zaber`; for a CONEX controller use the address ``device@921600``.

    Examples
    --------
    >>> table = smc100("table", "/dev/ttyUSB0", axes={"roll": {"device": 2, "high": 180.0}})
    >>> sorted(table.axes)
    ['roll']
    """
    controller = Smc100(link_to(address, baud=57600, xonxoff=True), dialect=dialect)
    return _table(controller, name, axes, settings, options)


def kinesis(
    name: str,
    address: str | Link,
    *,
    axes: Mapping[str, Mapping[str, Any]],
    motor: MotorKind = "dc",
    rack: bool = False,
    dialect: str | None = None,
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> Table:
    """Create the driver of a table with Kinesis controllers of Thorlabs; entry point ``kinesis``.

    Parameters
    ----------
    name, axes, dialect, settings, **options
        As for :func:`zaber`; `per_unit` of an axis is the number of its encoder counts, or of its microsteps,
        per unit: 1919.64 per degree for a PRM1-Z8, 136533.33 for a K10CR1.
    address : str or Link
        Serial devices of the controllers, separated by commas; `device` of an axis counts them from 1.
    motor : {"dc", "brushless", "stepper"}
        Kind of the motors.
    rack : bool
        Whether the address is that of a rack; `device` of an axis is then its bay.

    Examples
    --------
    >>> axes = {"tilt": {"per_unit": 1919.64, "low": -10.0}, "roll": {"device": 2, "per_unit": 1919.64}}
    >>> table = kinesis("table", "/dev/ttyUSB0, /dev/ttyUSB1", axes=axes)
    >>> table.axes["roll"].limits
    (0.0, 360.0)
    """
    links = [link_to(each.strip()) for each in address.split(",")] if isinstance(address, str) else [address]
    for axis, plan in AxisPlan.read(axes).items():
        if not rack and not 1 <= plan.device <= len(links):
            do = "give the addresses of all controllers, separated by commas"
            raise SettingError(f"device {plan.device} has no address", where=f"axis {axis}", do=do)
    return _table(Kinesis(links, motor, rack=rack, dialect=dialect), name, axes, settings, options)


def hand(
    name: str,
    address: str,
    *,
    axes: Mapping[str, Mapping[str, Any]],
    markers: Mapping[str, Mapping[str, Any]] | None = None,
    camera: str = "",
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> HandTable:
    """Create the driver of a table that is moved by hand; entry point ``hand``.

    Parameters
    ----------
    name, axes, settings, **options
        As for :func:`zaber`; `tolerance` is how exactly a person can set the axis.
    address : str
        ``terminal``, or ``tcp://host:port`` of a program as that of `operator` in ``bench.toml``.
    markers : mapping, optional
        Fields of :class:`Marker` of axes that a camera reads; the others are read by the person.
    camera : str
        Camera of the bench that sees the markers.

    Examples
    --------
    >>> table = hand("table", "terminal", axes={"tilt": {"low": -45.0, "high": 45.0, "tolerance": 0.2}})
    >>> table.axes["tilt"].limits
    (-45.0, 45.0)
    """
    plans = AxisPlan.read(axes)
    known = {}
    for axis, fields in (markers or {}).items():
        if axis not in plans:
            raise SettingError("is no axis", where=f"marker of {axis}", do=f"use {', '.join(plans)}")
        try:
            known[axis] = Marker(**fields)
        except TypeError as error:
            raise SettingError(f"its fields do not fit ({error})", where=f"marker of {axis}") from None
    if bool(known) != bool(camera):
        raise SettingError("are given together", where="markers and camera")
    person = TerminalOperator() if address == "terminal" else RemoteOperator(address)
    chosen = TableSettings().changed(settings or {})
    return HandTable(name, ByHand(person, known), plans, camera=camera, settings=chosen, **options)


def grbl(
    name: str,
    address: str | Link,
    *,
    axes: Mapping[str, Mapping[str, Any]],
    dialect: str | None = None,
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> Table:
    """Create the driver of a table with a GRBL controller; entry point ``grbl``.

    Parameters
    ----------
    name, address, axes, dialect, settings, **options
        As for :func:`zaber`; `axis` of an axis is 1 for X, 2 for Y and so on, `per_unit` the number of GRBL's
        units (of ``$100`` and following) per unit, `low` and `high` are machine positions.

    Examples
    --------
    >>> axes = {"z": {"axis": 3, "unit": "mm", "low": -120.0, "high": -1.0}}
    >>> table = grbl("table", "/dev/ttyUSB0", axes=axes)
    >>> table.axes["z"].limits
    (-120.0, -1.0)
    """
    controller = Grbl(link_to(address, keep_up=True), dialect=dialect)
    return _table(controller, name, axes, settings, options, letters=True)


def marlin(
    name: str,
    address: str | Link,
    *,
    axes: Mapping[str, Mapping[str, Any]],
    dialect: str | None = None,
    settings: Mapping[str, Any] | None = None,
    **options: Any,
) -> Table:
    """Create the driver of a table with a Marlin controller; entry point ``marlin``.

    Parameters
    ----------
    name, address, axes, dialect, settings, **options
        As for :func:`grbl`; `per_unit` is the number of Marlin's units (of M92) per unit. Many boards have
        the address ``device@250000``.

    Examples
    --------
    >>> marlin("table", "/dev/ttyACM0", axes={"roll": {"axis": 4}}).axes["roll"].unit
    'deg'
    """
    controller = Marlin(link_to(address, keep_up=True), dialect=dialect)
    return _table(controller, name, axes, settings, options, letters=True)


def _table(
    controller: Controller,
    name: str,
    axes: Mapping[str, Mapping[str, Any]],
    settings: Mapping[str, Any] | None,
    options: Mapping[str, Any],
    *,
    letters: bool = False,
) -> Table:
    """A table, of which each axis may need a letter."""
    plans = AxisPlan.read(axes)
    for plan in plans.values() if letters else ():
        letter_of(plan)
    return Table(name, controller, plans, TableSettings().changed(settings or {}), **options)
