"""What is safe with any motion controller: homed first, within limits, the last way always from below."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Protocol, Self

from reseau.core.errors import DeadlineError, ProtocolError, SettingError, StateError
from reseau.instruments import AxisState, Deadline, Device, Identity, Limits, Settings, Status, quantity

__all__ = ["Axis", "AxisPlan", "Controller", "Table", "TableSettings"]

_POLL_S, _HALT_S = 0.02, 1.0
_ATTEMPTS = 3
"""Bad answers in a row that are asked for again while an axis moves: it must not be left alone for one."""


@dataclass(frozen=True)
class AxisPlan:
    """One axis, and what it may do.

    Parameters
    ----------
    device, axis : int
        Its controller on the chain, and its number there.
    per_unit : float
        Steps of the controller for one unit.
    unit : str
        Degrees or millimetres.
    low, high : float
        Soft limits, in the unit.
    backlash : float
        Play of its gear; every position is reached from below by as much. 0 moves straight there.
    tolerance : float
        How far from the target it may stand in the end.
    """

    device: int = 1
    axis: int = 1
    per_unit: float = 1.0
    unit: str = "deg"
    low: float = 0.0
    high: float = 360.0
    backlash: float = 0.0
    tolerance: float = 0.01

    def __post_init__(self) -> None:
        if not (self.per_unit > 0 and self.low < self.high and self.backlash >= 0 and self.tolerance > 0):
            raise SettingError("per_unit and tolerance are positive, low below high", where="axis")

    @classmethod
    def read(cls, axes: Mapping[str, Mapping[str, Any]]) -> dict[str, Self]:
        """Plans by the name of the axis.

        Raises
        ------
        SettingError
            When a plan has an unknown field, or there is none.
        """
        known = {each.name for each in fields(cls)}
        for name, plan in axes.items():
            if unknown := set(plan) - known:
                raise SettingError(f"has no {', '.join(sorted(unknown))}", where=f"axis {name}")
        if not axes:
            raise SettingError("has no axes", where="table", do="name at least one")
        return {name: cls(**plan) for name, plan in axes.items()}

    def require_reachable(self, name: str, position: float) -> float:
        """The position, when it is one that may be moved to.

        Raises
        ------
        SettingError
            When it is beyond the limits, or too near to the lower one to be reached from below.
        """
        lowest = self.low + self.backlash
        if not lowest <= position <= self.high:
            raise SettingError(
                f"{position:g} {self.unit} is beyond {lowest:g}…{self.high:g} {self.unit}",
                where=f"axis {name}",
            )
        return position


class Controller(Protocol):
    """What moves axes; positions are those of :class:`AxisPlan`, in its unit."""

    def open(self, deadline: Deadline) -> None:
        """Open the connection."""

    def close(self) -> None:
        """Close it."""

    def identify(self, plans: Mapping[str, AxisPlan], deadline: Deadline) -> Identity:
        """Who moves these axes; raises when one is missing."""

    def set_speed(self, plan: AxisPlan, units_per_s: float, deadline: Deadline) -> None:
        """How fast an axis moves."""

    def begin_home(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Begin to look for the reference."""

    def begin_move(self, plan: AxisPlan, position: float, deadline: Deadline) -> None:
        """Begin to move."""

    def halt(self, plan: AxisPlan, deadline: Deadline) -> None:
        """Stop."""

    def state(self, plan: AxisPlan, deadline: Deadline) -> AxisState:
        """How the axis stands."""


@dataclass(frozen=True)
class TableSettings(Settings):
    """How a table moves."""

    speed: float = quantity(10.0, "1/s", 0.001, 1000.0)


class Axis:
    """One axis as bluesky moves it."""

    def __init__(self, table: Table, key: str) -> None:
        self.parent, self._table, self._key = None, table, key
        self.name = f"{table.name}_{key}"

    @property
    def unit(self) -> str:
        """Of its positions: degrees or millimetres."""
        return self._table.plans[self._key].unit

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest position that it may be moved to; the lowest leaves room for the backlash."""
        plan = self._table.plans[self._key]
        return plan.low + plan.backlash, plan.high

    @property
    def position(self) -> float:
        """Where it stands."""
        return self._table.state(self._key).position

    @property
    def hints(self) -> dict[str, Any]:
        """What bluesky plots of it."""
        return {"fields": [self.name]}

    def set(self, value: float) -> Status:
        """Begin to move there; the status is done when it is there.

        Raises
        ------
        SettingError
            When it cannot be moved there.
        """
        self.check_value(value)
        return Status(lambda: self._table.move(self._key, value), self.name)

    def stop(self, *, success: bool = False) -> None:
        """Stop the table."""
        self._table.stop(success=success)

    def check_value(self, value: float) -> None:
        """Raise SettingError when it cannot be moved there; for plans that are checked before they run."""
        self._table.plans[self._key].require_reachable(f"{self._key} of {self._table.name}", value)

    def read(self) -> dict[str, Any]:
        """Where it stands."""
        return {name: value for name, value in self._table.read_now().items() if name == self.name}

    def describe(self) -> dict[str, Any]:
        """What the reading holds."""
        return {name: kind for name, kind in self._table.describe().items() if name == self.name}

    def read_configuration(self) -> dict[str, Any]:
        """That of the table."""
        return self._table.read_configuration()

    def describe_configuration(self) -> dict[str, Any]:
        """What that holds."""
        return self._table.describe_configuration()


class Table(Device[TableSettings]):
    """A table with one or more axes.

    Parameters
    ----------
    name : str
        On the bench.
    controller : Controller
        What moves them.
    plans : mapping
        The axes by name.
    settings : TableSettings
        How it moves.
    seconds : float
        Deadline of an exchange that names none; of a move, a minute.
    limits : mapping, optional
        Of the settings.
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
    ) -> None:
        super().__init__(name, settings or TableSettings(), seconds=seconds, limits=limits)
        self._controller, self.plans = controller, dict(plans)
        self.axes: dict[str, Axis] = {key: Axis(self, key) for key in plans}

    def _open(self, deadline: Deadline) -> None:
        self._controller.open(deadline)

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

    def read_now(self) -> dict[str, Any]:
        """A reading of how all axes stand now."""
        self._take()
        return self.read()

    def _test(self, deadline: Deadline) -> dict[str, str]:
        found = {}
        for key in self.plans:
            state = self.state(key, deadline.left_or_minimum)
            found[key] = "; ".join(
                (
                    f"{state.position:g} {self.plans[key].unit}" if state.homed else "not homed",
                    *state.faults,
                )
            )
        return found

    def state(self, axis: str, seconds: float | None = None) -> AxisState:
        """How an axis stands.

        Raises
        ------
        SettingError
            When there is no such axis.
        InstrumentError
            When it does not say.
        """
        plan = self._plan(axis)
        with self._exchange(f"state of {axis}", seconds) as deadline:
            return self._controller.state(plan, deadline)

    def home(self, axis: str, seconds: float | None = None) -> AxisState:
        """Find the reference of an axis; nothing moves anywhere before.

        Raises
        ------
        StateError
            When it stalled, met a limit, or was stopped.
        DeadlineError
            When it was not done in time; the axis has been told to stop.
        """
        command, plan = f"home {axis}", self._plan(axis)
        self._stopping.clear()
        deadline = Deadline(self.MOVE_S if seconds is None else seconds)
        with self._exchange(command, deadline.left) as time:
            self._controller.begin_home(plan, time)
        state = self._wait_until_stopped(axis, plan, deadline, command)
        if not state.homed:
            raise StateError("did not find its reference", where=self.name, command=command)
        with self._exchange(command, max(_POLL_S, deadline.at_most(self._seconds))) as time:
            # Some controllers take a speed only then.
            self._controller.set_speed(plan, self.settings.speed, time)
        return state

    def move(self, axis: str, position: float, seconds: float | None = None) -> AxisState:
        """Move an axis there, from below, and wait until it stands.

        Raises
        ------
        SettingError
            When the position is beyond the soft limits; nothing moved.
        StateError
            When it is not homed, stalled, met a limit, was stopped, or stands elsewhere in the end.
        DeadlineError
            When it was not done in time; the axis has been told to stop.
        """
        command, plan = f"move {axis} to {position:g} {self._plan(axis).unit}", self._plan(axis)
        plan.require_reachable(f"{axis} of {self.name}", position)
        self._stopping.clear()
        deadline = Deadline(self.MOVE_S if seconds is None else seconds)
        state = self.state(axis, deadline.at_most(self._seconds))
        if not state.homed:
            raise StateError("is not homed", where=self.name, command=command, do=f"home {axis} first")
        before = (
            [position - plan.backlash] if plan.backlash and state.position > position - plan.backlash else []
        )
        for target in (*before, position):
            with self._exchange(command, deadline.at_most(self._seconds)) as time:
                self._controller.begin_move(plan, target, time)
            state = self._wait_until_stopped(axis, plan, deadline, command)
        if not state.homed:
            raise StateError("lost its reference", where=self.name, command=command, do=f"home {axis} again")
        if abs(state.position - position) > plan.tolerance:
            raise StateError(f"stands at {state.position:g} {plan.unit}", where=self.name, command=command)
        return state

    def _wait_until_stopped(self, axis: str, plan: AxisPlan, deadline: Deadline, command: str) -> AxisState:
        """Wait until an axis stands; one that did not make it is told to stop."""
        try:
            state = self._wait_until(
                self._retrying(lambda: self.state(axis, max(0.05, deadline.at_most(self._seconds)))),
                lambda state: not state.moving or bool(state.faults),
                deadline,
                _POLL_S,
                command,
            )
        except DeadlineError:
            # An axis that goes on is worth the time beyond.
            with self._exchange(command, min(_HALT_S, self._seconds)) as time:
                self._controller.halt(plan, time)
            raise
        if state.faults:
            raise StateError("; ".join(state.faults), where=self.name, command=command)
        return state

    def _retrying(self, ask: Callable[[], AxisState]) -> Callable[[], AxisState]:
        """The same question, asked again after an answer that was lost or damaged."""

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
                f"has no axis {axis!r}", where=self.name, do=f"there are {', '.join(self.plans)}"
            )
        return self.plans[axis]
