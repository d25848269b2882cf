"""Base of all motion controllers: home first, stay within limits, approach each position from below."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol, Self

from reseau.core.errors import DeadlineError, ProtocolError, SettingError, StateError
from reseau.instruments import (
    AxisState,
    Deadline,
    Device,
    Identity,
    Instrument,
    Limits,
    Monitor,
    Settings,
    Status,
    quantity,
)

from .reference import References, Reported
from .zones import EVERYWHERE, NOWHERE, KeepOut, Span

_POLL_S, _HALT_S = 0.02, 1.0
_ATTEMPTS = 3
"""Number of queries during a movement when answers are invalid: one bad answer must not end the wait."""
_CONFIRMATIONS = 4
"""Number of further queries until two states in succession agree, of controllers without checksums."""


@dataclass(frozen=True)
class AxisPlan:
    """One axis with its limits.

    Parameters
    ----------
    device, axis : int
        Number of the controller on the chain, and of the axis on it.
    per_unit : float
        Steps of the controller per unit.
    unit : str
        ``deg`` or ``mm``.
    low, high : float
        Soft limits, in the unit.
    backlash : float
        Backlash of the gear; every position is approached from below by this distance. 0 moves directly.
    tolerance : float
        Largest accepted distance from the target after a move.
    name : str
        Name of the axis; its table sets it.

    Raises
    ------
    SettingError
        If a value is not positive where it must be, or low is not below high.

    Examples
    --------
    >>> AxisPlan(low=-45.0, high=45.0, backlash=0.2).require_reachable("tilt", 30.0)
    30.0
    >>> AxisPlan(low=-45.0, high=45.0).require_reachable("tilt", 60.0)
    Traceback (most recent call last):
    reseau.core.errors.SettingError: axis tilt: 60 deg is outside -45…45 deg
    """

    device: int = 1
    axis: int = 1
    per_unit: float = 1.0
    unit: str = "deg"
    low: float = 0.0
    high: float = 360.0
    backlash: float = 0.0
    tolerance: float = 0.01
    name: str = ""

    def __post_init__(self) -> None:
        if not (self.per_unit > 0 and self.low < self.high and self.backlash >= 0 and self.tolerance > 0):
            raise SettingError(
                "per_unit and tolerance must be positive, backlash not negative, low below high", where="axis"
            )

    @classmethod
    def read(cls, axes: Mapping[str, Mapping[str, Any]]) -> dict[str, Self]:
        """Create plans from fields by name of the axis.

        Raises
        ------
        SettingError
            If a plan has an unknown field, or there is no plan.
        """
        known = {each.name for each in fields(cls)} - {"name"}
        for name, plan in axes.items():
            if unknown := set(plan) - known:
                raise SettingError(f"has unknown fields: {', '.join(sorted(unknown))}", where=f"axis {name}")
        if not axes:
            raise SettingError("has no axes", where="table", do="define at least one")
        return {name: cls(**plan) for name, plan in axes.items()}

    def require_reachable(self, name: str, position: float) -> float:
        """Return the position if it is allowed.

        Raises
        ------
        SettingError
            If the position is outside the limits, or too close to the lower one to be approached from below.
        """
        lowest = self.low + self.backlash
        if not lowest <= position <= self.high:
            raise SettingError(
                f"{position:g} {self.unit} is outside {lowest:g}…{self.high:g} {self.unit}",
                where=f"axis {name}",
            )
        return position


class Controller(Protocol):
    """Motion controller; positions are in the unit of the :class:`AxisPlan`."""

    references: References
    """What is known of the references of its axes; it notes there what voids them."""

    @property
    def checked(self) -> bool:
        """Whether answers carry a checksum; otherwise a state at rest counts once a second one agrees."""

    def open(self, deadline: Deadline) -> None:
        """Open the connection."""

    def close(self) -> None:
        """Close the connection."""

    def identify(self, plans: Mapping[str, AxisPlan], deadline: Deadline) -> Identity:
        """Return the identity of the controllers; raises if one is missing."""

    def set_speed(self, plan: AxisPlan, units_per_s: float, deadline: Deadline) -> None:
        """Set the speed of an axis."""

    def begin_home(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Start the search for the reference."""

    def begin_move(self, plan: AxisPlan, position: float, deadline: Deadline) -> None:
        """Start a movement."""

    def halt(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Stop the axis."""

    def state(self, plan: AxisPlan, deadline: Deadline) -> Reported:
        """Return what it reports of the axis."""


@dataclass(frozen=True)
class TableSettings(Settings):
    """Settings of a table: speed in units of the axis per second.

    Examples
    --------
    >>> TableSettings(speed=5.0).units
    {'speed': '1/s'}
    """

    speed: float = quantity(10.0, "1/s", 0.001, 1000.0)


class Axis:
    """One axis, as bluesky moves it.

    Examples
    --------
    >>> from reseau_drivers.turntable import zaber
    >>> tilt = zaber("table", "/dev/ttyUSB0", axes={"tilt": {"high": 90.0}}).axes["tilt"]
    >>> tilt.name, tilt.limits
    ('table_tilt', (0.0, 90.0))
    """

    def __init__(self, table: Table, key: str) -> None:
        self.parent, self._table, self._key = None, table, key
        self.name = f"{table.name}_{key}"
        self._setpoint = float("nan")
        self._monitor = Monitor(self.read)

    @property
    def unit(self) -> str:
        """Unit of positions: ``deg`` or ``mm``."""
        return self._table.plans[self._key].unit

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest allowed position; the lowest one leaves room for the backlash."""
        plan = self._table.plans[self._key]
        return plan.low + plan.backlash, plan.high

    @property
    def position(self) -> float:
        """Current position."""
        return self._table.state(self._key).position

    @property
    def hints(self) -> dict[str, Any]:
        """Fields that bluesky plots."""
        return {"fields": [self.name]}

    def set(self, value: float) -> Status:
        """Start to move to a position; the status ends when the axis has arrived.

        Raises
        ------
        SettingError
            If the position is not allowed.
        """
        self.check_value(value)
        self._setpoint = value
        return Status(lambda: self._table.move(self._key, value), self.name)

    def locate(self) -> dict[str, float]:
        """Return the last target of the axis, and where it is; before a move both are the same."""
        position = self.position
        return {"setpoint": position if math.isnan(self._setpoint) else self._setpoint, "readback": position}

    def subscribe(self, function: Callable[[dict[str, Any]], None]) -> None:
        """Call a function with each new position, ten times a second at most."""
        self._monitor.subscribe(function)

    def clear_sub(self, function: Callable[[dict[str, Any]], None]) -> None:
        """Stop calling a function."""
        self._monitor.clear(function)

    def stop(self, *, success: bool = False) -> None:
        """Stop the table."""
        self._table.stop(success=success)

    def check_value(self, value: float) -> None:
        """Raise SettingError if the position is not allowed; used to check plans before they run."""
        self._table.plans[self._key].require_reachable(f"{self._key} of {self._table.name}", value)

    def read(self) -> dict[str, Any]:
        """Return the current position as a reading."""
        return {self.name: {"value": self.position, "timestamp": time.time()}}

    def describe(self) -> dict[str, Any]:
        """Return the contents of the reading."""
        return {name: kind for name, kind in self._table.describe().items() if name == self.name}

    def read_configuration(self) -> dict[str, Any]:
        """Return the settings of the table as a reading."""
        return self._table.read_configuration()

    def describe_configuration(self) -> dict[str, Any]:
        """Return the contents of the reading of the settings."""
        return self._table.describe_configuration()


class Table(Device[TableSettings]):
    """Driver of a table with one or more axes.

    Parameters
    ----------
    name : str
        Name on the bench.
    controller : Controller
        Moves the axes.
    plans : mapping
        Axes by name.
    settings : TableSettings
        Speed.
    seconds : float
        Time limit of an exchange that does not specify one (s); a move has one minute.
    limits : mapping, optional
        Limits of settings.
    keep_out : sequence of mapping
        Zones in which axes must not be together: the lowest and highest position of each. ``lift.z`` is the
        axis z of another table of the bench.

    Examples
    --------
    >>> from reseau_drivers.link import link_to
    >>> from reseau_drivers.turntable import Zaber
    >>> table = Table("table", Zaber(link_to("/dev/ttyUSB0")), {"tilt": AxisPlan(high=90.0)})
    >>> table.axes["tilt"].name
    'table_tilt'
    """

    MOVE_S = 60.0

    def __init__(
        self,
        name: str,
        controller: Controller,
        plans: Mapping[str, AxisPlan],
        settings: TableSettings | None = None,
        *,
        seconds: float = 5.0,
        limits: Limits | None = None,
        keep_out: Sequence[Mapping[str, Sequence[float]]] = (),
    ) -> None:
        super().__init__(name, settings or TableSettings(), seconds=seconds, limits=limits)
        self._keep_out, self._tables = keep_out, dict[str, Table]()
        self._zones = KeepOut(keep_out, [*plans, *_foreign(keep_out)])
        self._controller = controller
        self.plans = {key: replace(plan, name=key) for key, plan in plans.items()}
        self.axes: dict[str, Axis] = {key: Axis(self, key) for key in plans}

    @property
    def uses(self) -> tuple[str, ...]:
        """Names of other tables with which it has zones in common."""
        mine = [zone for zone in self._zones.zones if {self._key(axis) for axis in self.plans} & zone.keys()]
        return tuple({key.rpartition(".")[0] for zone in mine for key in zone} - {"", self.name})

    def combine(self, instruments: Mapping[str, Instrument]) -> None:
        """Join the zones of all tables of a bench, where some name axes of others.

        Raises
        ------
        SettingError
            If there is no such axis.
        """
        tables = {name: each for name, each in instruments.items() if isinstance(each, Table)}
        if any(_foreign(each._keep_out) for each in tables.values()):
            zones = [
                {key if "." in key else f"{name}.{key}": span for key, span in zone.items()}
                for name, each in tables.items()
                for zone in each._keep_out
            ]
            known = [f"{name}.{axis}" for name, each in tables.items() for axis in each.plans]
            self._zones, self._tables = KeepOut(zones, known), tables
            for each in tables.values():
                each._zones, each._tables = self._zones, tables

    def _key(self, axis: str) -> str:
        """Name of an axis in the zones."""
        return f"{self.name}.{axis}" if self._tables else axis

    def _open(self, deadline: Deadline) -> None:
        self._controller.open(deadline)
        self._controller.references.connected()

    def _disconnect(self) -> None:
        self._controller.close()

    def _push(self, settings: TableSettings, deadline: Deadline) -> None:
        for plan in self.plans.values():
            self._controller.set_speed(plan, settings.speed, deadline)

    def _identify(self, deadline: Deadline) -> Identity:
        return self._controller.identify(self.plans, deadline)

    def _halt(self, deadline: Deadline) -> None:
        for plan in self.plans.values():
            self._controller.halt(plan, deadline)

    def _acquire(self) -> dict[str, Any]:
        return {f"{self.name}_{key}": self.state(key).position for key in self.plans}

    def _reading_format(self) -> dict[str, dict[str, Any]]:
        return {
            f"{self.name}_{key}": {"dtype": "number", "shape": [], "units": plan.unit}
            for key, plan in self.plans.items()
        }

    def _test(self, deadline: Deadline) -> dict[str, str]:
        found = {}
        for key in self.plans:
            state = self.state(key, deadline.left)
            found[key] = "; ".join(
                (
                    f"{state.position:g} {self.plans[key].unit}"
                    if state.homed
                    else f"not homed: {state.reference}",
                    *state.faults,
                )
            )
        return found

    def state(self, axis: str, seconds: float | None = None) -> AxisState:
        """Return the state of an axis.

        Raises
        ------
        SettingError
            If there is no such axis.
        InstrumentError
            If the controller does not answer.
        """
        plan = self._plan(axis)
        with self._exchange(f"state of {axis}", seconds) as deadline:
            return self._confirmed(plan, deadline)

    def _confirmed(self, plan: AxisPlan, deadline: Deadline) -> AxisState:
        """The state of an axis; without checksums a second answer confirms one at rest: bits may turn."""
        state = self._judged(plan, deadline)
        if self._controller.checked or state.moving or state.faults:
            return state
        for _ in range(_CONFIRMATIONS):
            before, state = state, self._judged(plan, deadline)
            if state.moving or state.faults:
                return state
            near = abs(state.position - before.position) <= plan.tolerance
            if state.homed == before.homed and (near or not state.homed):
                return state
        raise ProtocolError(
            f"reports positions of {plan.name} that contradict each other", do="check the cable"
        )

    def _judged(self, plan: AxisPlan, deadline: Deadline) -> AxisState:
        """What the controller reports, with what is known of the reference."""
        found = self._controller.state(plan, deadline)
        homed, how = self._controller.references.judged(plan.name, found.referenced)
        return AxisState(found.position, found.moving, homed, found.faults, how)

    def _stands(self, key: str) -> Span | None:
        """Where an axis of this or another table stands; None if it moves, or that is not known."""
        table, _, axis = key.rpartition(".")
        if table and table != self.name:
            return self._tables[table]._stands(axis) if table in self._tables else None
        state, tolerance = self.state(axis), self.plans[axis].tolerance
        known = state.homed and not state.moving
        return (state.position - tolerance, state.position + tolerance) if known else None

    def home(self, axis: str, seconds: float | None = None) -> AxisState:
        """Find the reference of an axis; required before any movement.

        Raises
        ------
        SettingError
            If the axis can enter a zone to be kept out of, with others that have a reference.
        StateError
            If the axis stalled, reached a limit switch, or was stopped.
        DeadlineError
            If the search does not finish in time; the axis is then stopped.
        """
        command, plan = f"home {axis}", self._plan(axis)
        self._begin(command)
        deadline = Deadline(self.MOVE_S if seconds is None else seconds)
        with self._zones.crossed(self._key(axis), EVERYWHERE, lambda each: self._stands(each) or NOWHERE):
            with self._exchange(command, deadline.left) as time:
                self._require_unstopped(command)
                self._controller.references.searching(axis)
                self._controller.begin_home(plan, time)
            self._wait_until_stopped(axis, plan, deadline, command)
        self._controller.references.found(axis)
        state = self._retrying(lambda: self.state(axis, max(0.05, deadline.at_most(self._seconds))))()
        if not state.homed:
            why = f"did not find its reference: {state.reference}"
            raise StateError(why, where=self.name, command=command)
        with self._exchange(command, max(_POLL_S, deadline.at_most(self._seconds))) as time:
            # Some controllers accept a speed only after homing.
            self._controller.set_speed(plan, self.settings.speed, time)
        return state

    def move(self, axis: str, position: float, seconds: float | None = None) -> AxisState:
        """Move an axis to a position, from below, and wait until it has stopped.

        Parameters
        ----------
        axis : str
            Name of the axis.
        position : float
            Target, in the unit of the axis.
        seconds : float, optional
            Time limit of the whole movement (s).

        Raises
        ------
        SettingError
            If the position is outside the soft limits, or the way to it enters a zone to be kept out of;
            nothing moves then.
        StateError
            If the axis is not homed, stalled, reached a limit switch, was stopped, or did not arrive at the
            target.
        DeadlineError
            If the movement does not finish in time; the axis is then stopped.
        """
        command, plan = f"move {axis} to {position:g} {self._plan(axis).unit}", self._plan(axis)
        plan.require_reachable(f"{axis} of {self.name}", position)
        self._begin(command)
        deadline = Deadline(self.MOVE_S if seconds is None else seconds)
        state = self.state(axis, deadline.at_most(self._seconds))
        if not state.homed:
            why = f"is not homed: {state.reference}"
            raise StateError(why, where=self.name, command=command, do=f"home {axis} first")
        before = (
            [position - plan.backlash] if plan.backlash and state.position > position - plan.backlash else []
        )
        way = (state.position, *before, position)
        with self._zones.crossed(self._key(axis), way, self._stands):
            for target in (*before, position):
                with self._exchange(command, deadline.at_most(self._seconds)) as time:
                    self._require_unstopped(command)
                    self._controller.begin_move(plan, target, time)
                state = self._wait_until_stopped(axis, plan, deadline, command)
        if not state.homed:
            why = f"lost its reference: {state.reference}"
            raise StateError(why, where=self.name, command=command, do=f"home {axis} again")
        if abs(state.position - position) > plan.tolerance:
            raise StateError(f"stopped at {state.position:g} {plan.unit}", where=self.name, command=command)
        return state

    def _wait_until_stopped(self, axis: str, plan: AxisPlan, deadline: Deadline, command: str) -> AxisState:
        """Wait until an axis stops; stop one that does not stop in time."""
        try:
            state = self._wait_until(
                self._retrying(lambda: self.state(axis, max(0.05, deadline.at_most(self._seconds)))),
                lambda state: not state.moving or bool(state.faults),
                deadline,
                _POLL_S,
                command,
            )
        except DeadlineError:
            # Stopping an axis that still moves is worth the additional time.
            with self._exchange(command, min(_HALT_S, self._seconds)) as time:
                self._controller.halt(plan, time)
            raise
        if state.faults:
            raise StateError("; ".join(state.faults), where=self.name, command=command)
        return state

    def _retrying(self, ask: Callable[[], AxisState]) -> Callable[[], AxisState]:
        """Repeat a query whose answer was lost or damaged."""

        def asked() -> AxisState:
            for _ in range(_ATTEMPTS - 1):
                try:
                    return ask()
                except (DeadlineError, ProtocolError):
                    continue
            return ask()

        return asked

    def _plan(self, axis: str) -> AxisPlan:
        if axis not in self.plans:
            raise SettingError(
                f"has no axis {axis!r}", where=self.name, do=f"choose from {', '.join(self.plans)}"
            )
        return self.plans[axis]


def _foreign(zones: Sequence[Mapping[str, Sequence[float]]]) -> list[str]:
    """Axes of other tables in zones."""
    return [key for zone in zones for key in zone if "." in key]
