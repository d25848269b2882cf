"""What is safe on a table: homed first, within limits, from below, stopped from any thread."""

from __future__ import annotations

import re
import threading
import time
from typing import Any

import pytest

from reseau.core.errors import (
    ConnectionLost,
    DeadlineError,
    ProtocolError,
    RefusedError,
    SettingError,
    StateError,
    UsageError,
)
from reseau.instruments import AxisState, Deadline, Movable, Turntable
from reseau_drivers.link import link_to
from reseau_drivers.turntable import (
    AxisPlan,
    ByHand,
    HandTable,
    Table,
    Zaber,
    grbl,
    kinesis,
    marlin,
    smc100,
    zaber,
)
from reseau_drivers.turntable.zones import KeepOut
from reseau_sims.serving import (
    Fault,
    FaultScript,
    FaultyConnection,
    GrblController,
    InProcess,
    KinesisController,
    MarlinController,
    Smc100Line,
    ZaberChain,
)

Board = KinesisController | GrblController | MarlinController


def tables() -> list[tuple[Table, ZaberChain | Smc100Line | Board]]:
    chain, line = ZaberChain([1], high=100_000.0), Smc100Line(1, low=-10.0, high=100.0)
    axis = {"high": 100.0, "backlash": 0.5}
    return [
        (
            zaber(
                "table",
                InProcess(lambda: FaultyConnection(chain)),
                axes={"tilt": axis | {"per_unit": 1000.0}},
            ),
            chain,
        ),
        (
            smc100("table", InProcess(lambda: FaultyConnection(line)), axes={"tilt": axis}),
            line,
        ),
        *boards(axis),
    ]


def boards(axis: dict[str, Any]) -> list[tuple[Table, Board]]:
    cube = KinesisController()
    mill, printer = (
        kind(1, low=-10.0, high=100.0, speed=900.0) for kind in (GrblController, MarlinController)
    )
    return [
        (kinesis("table", _in_process(cube), axes={"tilt": axis | {"per_unit": 1920.0}}), cube),
        (grbl("table", _in_process(mill), axes={"tilt": axis}), mill),
        (marlin("table", _in_process(printer), axes={"tilt": axis}), printer),
    ]


def _in_process(machine: Board, script: FaultScript | None = None) -> InProcess:
    return InProcess(lambda: FaultyConnection(machine, script))


@pytest.mark.parametrize("call", ["home", "move", "check"])
def test_a_part_of_a_call_that_has_no_time_left_is_a_time_out_of_the_instrument(
    call: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a loaded machine the time of the whole call may be used up before its next part begins."""
    table, _ = boards({"high": 100.0})[1]
    with table:
        table.home("tilt")
        calls = {
            "home": lambda: table.home("tilt", 0.5),
            "move": lambda: table.move("tilt", 20.0, 0.5),
            "check": lambda: table.check(0.5),
        }
        whole = Deadline.__init__

        def late(self: Deadline, seconds: float) -> None:
            whole(self, seconds)
            self._at -= 0.5

        with monkeypatch.context() as loaded:
            loaded.setattr(Deadline, "__init__", late)
            with pytest.raises(DeadlineError, match=r"table \(.*\): did not finish within 0.5 s"):
                calls[call]()
        assert table.move("tilt", 20.0).position == pytest.approx(20.0, abs=2e-3)


@pytest.mark.parametrize("which", range(3))
def test_a_reference_is_known_on_the_next_connection_and_lost_with_the_power(which: int) -> None:
    table, machine = boards({"high": 100.0})[which]
    with table:
        table.configure(speed=500.0)
        assert not table.state("tilt").homed
        table.home("tilt")
        table.move("tilt", 20.0)
    again = Table("table", table._controller, table.plans)
    with again:
        assert again.state("tilt").homed
        assert again.state("tilt").position == pytest.approx(20.0, abs=2e-3)
        machine.inject_fault("power-cycled")
    with again:
        assert not again.state("tilt").homed
        with pytest.raises(StateError, match="home tilt first"):
            again.move("tilt", 30.0)


@pytest.mark.parametrize(
    ("which", "kind", "message"),
    [
        (0, "stuck", "stalled"), (0, "out of range", "limit switch"), (0, "wrong state", "switched off"),
        (1, "stuck", "feed hold"), (1, "out of range", "limit switch"), (1, "wrong state", "door"),
        (2, "stuck", "stands at"), (2, "out of range", "endstop"), (2, "wrong state", "lost its reference"),
    ],
)  # fmt: skip
def test_a_movement_that_ends_short_is_an_error(which: int, kind: str, message: str) -> None:
    table, machine = boards({"high": 100.0})[which]
    with table:
        table.configure(speed=30.0)
        table.home("tilt")
        status = table.axes["tilt"].set(90.0)
        time.sleep(0.3)
        with machine.lock:
            machine.inject_fault(kind)  # type: ignore[arg-type]
        failed = status.exception(30.0)
        assert isinstance(failed, StateError)
        assert message in str(failed)
        table.home("tilt")
        table.configure(speed=500.0)
        assert table.move("tilt", 40.0).position == pytest.approx(40.0, abs=2e-3)


def test_a_grbl_that_is_set_otherwise_is_declined() -> None:
    board = GrblController(1, settings={"$13": "1"})
    with pytest.raises(StateError, match=r"\$13 is 1"):
        grbl("table", _in_process(board), axes={"tilt": {}}).connect()
    board = GrblController(1, settings={"$22": "0"})
    with pytest.raises(RefusedError, match=r"homing is not enabled \(\$22\)"):
        grbl("table", _in_process(board), axes={"tilt": {}}).home("tilt")
    board = GrblController(1, settings={"$10": "0"})
    with pytest.raises(ProtocolError, match=r"set \$10=1"):
        grbl("table", _in_process(board), axes={"tilt": {}}).state("tilt")


def test_a_target_that_marlin_shortens_is_an_error() -> None:
    printer = MarlinController(1, low=0.0, high=50.0, speed=900.0)
    with marlin("table", _in_process(printer), axes={"tilt": {"high": 100.0}}) as table:
        table.configure(speed=500.0)
        table.home("tilt")
        with pytest.raises(StateError, match="stopped at 50"):
            table.move("tilt", 60.0)


def test_marlin_keeps_a_reference_for_each_axis_and_none_after_an_abrupt_stop() -> None:
    """G-code reference, M410: without deceleration, steppers are expected to be out of position."""
    printer = MarlinController(2, high=100.0, speed=900.0)
    axes = {"tilt": {"high": 100.0}, "roll": {"axis": 2, "high": 100.0}}
    with marlin("table", _in_process(printer), axes=axes) as table:
        table.configure(speed=100.0)
        table.home("roll")
        assert [table.state(axis).homed for axis in axes] == [False, True]
        with pytest.raises(StateError, match="home tilt first"):
            table.move("tilt", 10.0)
        table.home("tilt")
        table.stop()
        assert [table.state(axis).homed for axis in axes] == [True, True]
        table.configure(speed=20.0)
        moving = table.axes["tilt"].set(90.0)
        time.sleep(0.3)
        table.stop()
        assert isinstance(moving.exception(5.0), StateError)
        assert not any(table.state(axis).homed for axis in axes)
    with marlin("table", _in_process(printer), axes=axes) as table:
        assert not table.state("tilt").homed
    assert printer.violations == []


def test_search_for_the_reference_can_be_stopped() -> None:
    for table, machine in boards({"high": 100.0}):
        with table:
            machine.motors[1]._stand(80.0 * table.plans["tilt"].per_unit)
            table.configure(speed=2.0)
            if not isinstance(machine, KinesisController):
                machine._largest = 2.0
            with pytest.raises(DeadlineError, match="home tilt"):
                table.home("tilt", 0.6)
            state = table.state("tilt")
            assert not state.moving
            assert not state.homed


@pytest.mark.parametrize("which", range(5))
def test_a_table_is_homed_before_it_moves_and_keeps_to_its_limits(which: int) -> None:
    table, machine = tables()[which]
    assert isinstance(table, Turntable)
    assert isinstance(table.axes["tilt"], Movable)
    assert (table.axes["tilt"].unit, table.axes["tilt"].limits) == ("deg", (0.5, 100.0))
    with table:
        with pytest.raises(StateError, match="home tilt first"):
            table.move("tilt", 5.0)
        table.configure(speed=500.0)
        table.home("tilt")
        for beyond in (-1.0, 0.2, 100.1, float("nan")):
            with pytest.raises(SettingError):
                table.move("tilt", beyond)
        with pytest.raises(SettingError, match="no axis"):
            table.move("roll", 1.0)
        assert table.move("tilt", 30.0).position == pytest.approx(30.0, abs=2e-3)
        assert table.check()["tilt"] == "30 deg"
    assert machine.violations == []


@pytest.mark.parametrize("which", range(5))
def test_every_position_is_reached_from_below(which: int) -> None:
    table, machine = tables()[which]
    motor = next(iter(machine.motors.values()))
    targets: list[float] = []
    go = motor.go

    def recorded(target: float) -> None:
        targets.append(target / table.plans["tilt"].per_unit)
        go(target)

    motor.go = recorded  # type: ignore[method-assign]
    with table:
        table.configure(speed=900.0)
        table.home("tilt")
        targets.clear()
        table.move("tilt", 50.0)
        table.move("tilt", 20.0)
        table.move("tilt", 20.2)
        table.move("tilt", 40.0)
    assert targets == pytest.approx([50.0, 19.5, 20.0, 19.7, 20.2, 40.0])


@pytest.mark.parametrize("which", range(5))
def test_stop_works_from_any_thread(which: int) -> None:
    table, machine = tables()[which]
    with table:
        table.home("tilt")
        status = table.axes["tilt"].set(90.0)
        time.sleep(0.15)
        began = time.monotonic()
        stopper = threading.Thread(target=table.stop)
        stopper.start()
        stopper.join()
        assert isinstance(status.exception(2.0), StateError)
        assert time.monotonic() - began < 1.0
        state = table.state("tilt")
        assert not state.moving
        assert state.position < 80.0
        assert table.state("tilt").position == state.position
    assert machine.violations == []


def test_in_a_run_nothing_moves_after_a_stop_until_it_is_resumed() -> None:
    table, machine = tables()[0]
    with table:
        table.home("tilt")
        table.stage()
        table.stop()
        with pytest.raises(StateError, match="was stopped"):
            table.move("tilt", 10.0)
        with pytest.raises(StateError, match="was stopped"):
            table.home("tilt")
        assert table.state("tilt").position == pytest.approx(0.0, abs=1e-3)
        table.resume()
        assert table.move("tilt", 10.0).position == pytest.approx(10.0, abs=0.01)
        table.stop()
        table.stage()
        assert table.move("tilt", 12.0).position == pytest.approx(12.0, abs=0.01)
    assert machine.violations == []


def test_by_hand_a_stop_does_not_count_for_the_next_movement() -> None:
    """Outside of a run: before one, and after its end."""
    table, machine = tables()[0]
    with table:
        table.home("tilt")
        table.stop()
        assert table.move("tilt", 10.0).position == pytest.approx(10.0, abs=0.01)
        table.stage()
        table.unstage()
        assert table.move("tilt", 12.0).position == pytest.approx(12.0, abs=0.01)
    assert machine.violations == []


@pytest.mark.parametrize("which", range(5))
def test_after_a_stop_between_two_queries_the_second_part_of_a_movement_does_not_begin(
    which: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    table, _ = tables()[which]
    with table:
        table.home("tilt")
        table.configure(speed=90.0)
        table.move("tilt", 90.0)
        table.configure(speed=20.0)
        ask, asked = table.state, list[str]()

        def stopped_before(axis: str, seconds: float | None = None) -> AxisState:
            asked.append(axis)
            if len(asked) == 3:  # it moves down to where its backlash is, and would then move up
                table.stop()
            return ask(axis, seconds)

        monkeypatch.setattr(table, "state", stopped_before)
        with pytest.raises(StateError, match="was stopped"):
            table.move("tilt", 10.0)
        here = ask("tilt")
        assert not here.moving
        assert here.position > 20.0
        time.sleep(0.2)
        assert ask("tilt").position == here.position


@pytest.mark.parametrize("which", range(5))
def test_a_move_that_takes_too_long_is_stopped(which: int) -> None:
    table, _ = tables()[which]
    with table:
        table.home("tilt")
        table.configure(speed=1.0)
        with pytest.raises(DeadlineError, match="move tilt to 90 deg"):
            table.move("tilt", 90.0, 0.3)
        assert not table.state("tilt").moving


@pytest.mark.parametrize(
    ("kind", "message"),
    [("stuck", "stalled"), ("out of range", "limit switch"), ("wrong state", "driver is off")],
)
def test_flags_of_a_movement_raise(kind: str, message: str) -> None:
    chain, script = ZaberChain([1]), FaultScript()
    link = InProcess(lambda: FaultyConnection(chain, script))
    with Table("table", Zaber(link), {"tilt": AxisPlan(per_unit=1000.0)}) as table:
        table.home("tilt")
        script.fault_at(script.count + 6, Fault(kind))  # type: ignore[arg-type]
        with pytest.raises(StateError, match=message):
            table.move("tilt", 200.0)


def test_a_table_after_power_loss_raises_and_regains_its_speed() -> None:
    chain, script = ZaberChain([1]), FaultScript()
    with Table(
        "table",
        Zaber(InProcess(lambda: FaultyConnection(chain, script))),
        {"tilt": AxisPlan(per_unit=1000.0)},
    ) as table:
        table.configure(speed=100.0)
        table.home("tilt")
        script.fault_at(script.count + 6, Fault("power-cycled"))
        with pytest.raises(StateError, match="home tilt again"):
            table.move("tilt", 200.0)
        chain.motors[1, 1].speed = 1.0
        script.fault_at(script.count, Fault("disconnected"))
        with pytest.raises(ConnectionLost):
            table.state("tilt")
        table.home("tilt")
        assert chain.motors[1, 1].speed == pytest.approx(100_000.0, rel=1e-4)


def test_wrong_plans_and_addresses_are_refused() -> None:
    for axes in ({}, {"tilt": {"hight": 3}}, {"tilt": {"low": 5.0, "high": 1.0}}):
        with pytest.raises(SettingError):
            zaber("table", "/dev/null", axes=axes)
    for address in (
        "tcp://",
        "udp://host",
        "ftp://host:1",
        "tcp://host",
        "tcp://host:99999999",
        "",
        "/dev/ttyS0@fast",
    ):
        with pytest.raises(UsageError):
            link_to(address)
    with pytest.raises(ConnectionLost, match="cannot be opened"):
        zaber("table", "/dev/no-such-port", axes={"tilt": {}}).connect()
    with pytest.raises(ConnectionLost, match="cannot be reached"):
        zaber("table", "tcp://127.0.0.1:1", axes={"tilt": {}}).connect()


def _guarded(**more: Any) -> Table:
    chain = ZaberChain([2], high=100_000.0)
    axes = {"tilt": {"per_unit": 1000.0, "high": 90.0}, "roll": {"axis": 2, "per_unit": 1000.0, "high": 90.0}}
    zone = {"tilt": [40.0, 60.0], "roll": [50.0, 90.0]}
    link = InProcess(lambda: FaultyConnection(chain))
    return zaber("table", link, axes=axes, settings={"speed": 500.0}, **{"keep_out": [zone], **more})


def test_axes_are_never_together_in_a_zone_to_be_kept_out_of() -> None:
    with _guarded() as table:
        table.home("tilt")
        with pytest.raises(StateError, match="where roll is, is not known; home roll first"):
            table.move("tilt", 70.0)
        table.home("roll")
        table.move("tilt", 70.0)  # through the zone of tilt, while roll is outside of its own
        table.move("roll", 80.0)
        for target in (50.0, 20.0):  # into the zone, and through it
            with pytest.raises(SettingError, match=r"tilt 40…60, roll 50…90\); move roll out of 50…90 first"):
                table.move("tilt", target)
        with pytest.raises(SettingError, match="would enter the zone"):
            table.home("tilt")
        assert table.state("tilt").position == 70.0


def test_a_movement_under_way_counts_as_everywhere_on_its_way() -> None:
    with _guarded() as table:
        table.home("tilt")
        table.home("roll")
        table.configure(speed=40.0)
        under_way = table.axes["tilt"].set(80.0)
        time.sleep(0.2)
        with pytest.raises(SettingError, match="move tilt out of 40…60 first"):
            table.move("roll", 70.0)
        assert under_way.exception(10.0) is None
        table.move("roll", 70.0)


def test_zones_of_a_bench_hold_for_axes_of_several_tables() -> None:
    """The plate of one table under the lift of another: none enters while the other is there."""
    machines = [ZaberChain([1], high=300_000.0), GrblController(1, low=-10.0, high=200.0, speed=9000.0)]
    wires = [InProcess(lambda: FaultyConnection(machines[0])), _in_process(machines[1])]  # type: ignore[arg-type]
    speed = {"settings": {"speed": 500.0}}
    zone = {"tilt": [40.0, 60.0], "lift.z": [0.0, 50.0]}
    table = zaber(
        "plate", wires[0], axes={"tilt": {"per_unit": 1000.0, "high": 90.0}}, keep_out=[zone], **speed
    )
    lift = grbl("lift", wires[1], axes={"z": {"unit": "mm", "high": 150.0}}, **speed)
    with table:
        table.home("tilt")
        with pytest.raises(StateError, match=r"where lift.z is, is not known"):
            table.move("tilt", 50.0)  # alone it does not know of the lift
    for each in (table, lift):
        each.combine({"plate": table, "lift": lift})
    assert (table.uses, lift.uses) == (("lift",), ("plate",))
    with table, lift:
        table.home("tilt")
        with pytest.raises(StateError, match=r"where lift.z is, is not known; home lift.z first"):
            table.move("tilt", 50.0)
        lift.home("z")
        with pytest.raises(SettingError, match=r"plate.tilt: would enter .*; move lift.z out of 0…50 first"):
            table.move("tilt", 50.0)
        lift.move("z", 100.0)
        table.move("tilt", 50.0)
        with pytest.raises(SettingError, match=r"lift.z: would enter .*; move plate.tilt out of 40…60 first"):
            lift.move("z", 10.0)
        table.move("tilt", 70.0)
        assert lift.move("z", 10.0).position == pytest.approx(10.0, abs=0.01)
    with pytest.raises(SettingError, match="keep_out"):
        table.combine({"plate": table})


@pytest.mark.parametrize("which", range(6), ids=["zaber", "smc100", "kinesis", "grbl", "marlin", "hand"])
def test_no_driver_begins_to_move_beyond_a_limit_or_into_a_zone(
    which: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = [each for each, _ in tables()][which] if which < 5 else by_hand()
    with table:
        table.configure(speed=900.0)
        table.home("tilt")
        assert table.move("tilt", 20.0).position == pytest.approx(20.0, abs=0.01)
        begun = list[float]()
        whole = table._controller.begin_move
        monkeypatch.setattr(
            table._controller,
            "begin_move",
            lambda plan, position, deadline: (begun.append(position), whole(plan, position, deadline))[1],
        )
        table._zones = KeepOut([{"tilt": (40.0, 60.0)}], table.plans)
        for target, message in ((-0.1, "outside"), (100.1, "outside"), (50.0, "zone"), (80.0, "zone")):
            with pytest.raises(SettingError, match=message):
                table.move("tilt", target)
            with pytest.raises(SettingError, match=message):
                table.axes["tilt"].set(target).wait(5.0)
        assert begun == []
        assert table.move("tilt", 30.0).position == pytest.approx(30.0, abs=0.01)
        assert begun


def by_hand() -> Table:
    """A person who sets and reads what is asked."""

    class Person:
        address = "here"

        def __call__(self, request: str) -> None:
            self.there = float(found[-1]) if (found := re.findall(r"-?[\d.]+(?= deg)", request)) else 0.0

        def read(self, request: str, unit: str, seconds: float | None = None) -> float:
            self(request)
            return self.there

    return HandTable("table", ByHand(Person(), {}), {"tilt": AxisPlan(high=100.0)})


def test_a_zone_names_axes_of_the_table() -> None:
    for zone in ({}, {"pan": [0, 1]}, {"tilt": [2, 1]}, {"tilt": [1]}):
        with pytest.raises(SettingError, match="keep_out"):
            _guarded(keep_out=[zone])
