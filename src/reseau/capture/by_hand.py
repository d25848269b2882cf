"""Acts on the axes of a table by hand: where they are, where they can be moved, move, home."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from ..core.errors import InstrumentError, UsageError
from ..instruments import Turntable
from ..instruments.protocols import Movable


@dataclass(frozen=True)
class AxisReport:
    """State and range of an axis.

    Parameters
    ----------
    position : float
        Position in `unit`; without a reference it is meaningless.
    unit : str
        Unit of the axis.
    limits : (float, float)
        Lowest and highest position.
    homed, moving : bool
        Whether it has its reference; whether it moves.
    faults : tuple of str
        Faults that the controller reports.

    Examples
    --------
    >>> print(AxisReport(30.0, "°", (-45.0, 45.0), homed=True, moving=False))
    30 ° (-45 to 45)
    >>> print(AxisReport(0.0, "mm", (0.0, 300.0), homed=False, moving=False))
    no reference (0 to 300 mm)
    """

    position: float
    unit: str
    limits: tuple[float, float]
    homed: bool
    moving: bool
    faults: tuple[str, ...] = ()

    def __str__(self) -> str:
        low, high = self.limits
        words = f"{self.position:g} {self.unit} ({low:g} to {high:g})"
        if not self.homed:
            words = f"no reference ({low:g} to {high:g} {self.unit})"
        return ", ".join((words, *(["moving"] if self.moving else []), *self.faults))


def axes_of(table: Turntable) -> dict[str, AxisReport]:
    """Return the axes of a table by name.

    Raises
    ------
    InstrumentError
        If the table does not answer.
    """
    found = {}
    for name, axis in table.axes.items():
        state = table.state(name)
        found[name] = AxisReport(
            state.position, axis.unit, axis.limits, state.homed, state.moving, state.faults
        )
    return found


def axis_of(table: Turntable, name: str, where: str = "") -> Movable:
    """Return an axis by its name; the error names `where` it was asked for, or the table.

    Raises
    ------
    UsageError
        If the table has no such axis.
    """
    if name not in table.axes:
        raise UsageError(
            f"the table has no axis {name}", where=where or table.name, do=f"use {', '.join(table.axes)}"
        )
    return table.axes[name]


def check_reach(table: Turntable, position: Mapping[str, float], where: str = "") -> None:
    """Check that a table has the axes of a position, and reaches it.

    Raises
    ------
    UsageError
        If it does not.
    """
    for name, value in position.items():
        axis = axis_of(table, name, where)
        low, high = axis.limits
        if not low <= value <= high:
            what = f"{name} = {value:g} {axis.unit} is out of range"
            raise UsageError(what, where=where or table.name, do=f"use {low:g} to {high:g} {axis.unit}")


def targets(table: Turntable, position: Mapping[str, float], *, relative: bool = False) -> dict[str, float]:
    """Return where axes will stand, all within their ranges.

    Parameters
    ----------
    table : Turntable
        Connected.
    position : mapping of str to float
        Positions by axis, or changes of them if `relative`.

    Raises
    ------
    UsageError
        If there is no such axis, or it does not reach the position.
    """
    for name in position:
        axis_of(table, name)
    found = {
        name: table.state(name).position + value if relative else value for name, value in position.items()
    }
    check_reach(table, found)
    return found


def move(table: Turntable, position: Mapping[str, float]) -> None:
    """Move axes, all at the same time, and wait until all of them have stopped.

    Raises
    ------
    InstrumentError
        If an axis does not arrive.
    """
    statuses = [table.axes[axis].set(value) for axis, value in position.items()]
    failures = [status.exception(None) for status in statuses]
    for failure in failures:
        if failure is not None:
            raise failure


def home(table: Turntable, axes: Iterable[str] = ()) -> tuple[str, ...]:
    """Home axes one after the other; by default those that have no reference. Return their names.

    Raises
    ------
    UsageError
        If there is no such axis.
    InstrumentError
        If an axis does not find its reference.
    """
    axes = tuple(axes)
    names = axes or tuple(name for name in table.axes if not table.state(name).homed)
    for name in names:
        axis_of(table, name)
    for name in names:
        # Some controllers home all axes at once.
        if not axes and table.state(name).homed:
            continue
        state = table.home(name)
        if not state.homed:
            raise InstrumentError("did not find its reference", where=f"{table.name}: {name}")
    return names
