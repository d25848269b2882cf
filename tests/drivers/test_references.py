"""A reference is evidence: what was not seen to home, or has been voided since, does not move."""

from __future__ import annotations

import struct

import pytest
from zaber_motion.ascii import WarningFlags

from reseau.core.errors import StateError
from reseau_drivers.profiles import known
from reseau_drivers.turntable import AxisPlan, Grbl, Kinesis, References, Table, Zaber

from .fakes import GrblBoard, TCube, Wire, ZaberStage

ZABER = known("zaber")
FAULTS, UNREFERENCED, UNRELIABLE = ZABER["flags"], ZABER["unreferenced"], set(ZABER["unreliable"])

HAL = "GrblHAL 1.1f ['$' or '$HELP' for help]"
HAL_VERSION = "[VER:1.1f.20231015:]\r\n[OPT:VNMSL,100,1024,3,0]\r\n[FIRMWARE:grblHAL]"
FLUID = "Grbl 3.7 [FluidNC v3.7.10 (esp32-wifi) '$' for help]"
FLUID_VERSION = "[VER:3.7 FluidNC v3.7.10 (esp32-wifi):]\r\n[OPT:PHSW]"


def table_of(board: GrblBoard) -> Table:
    plan = AxisPlan(low=-90.0, high=90.0)
    return Table("table", Grbl(Wire(board), 0.2), {"tilt": plan})


@pytest.mark.parametrize(
    "board",
    [
        GrblBoard(locks=False),
        GrblBoard(HAL, HAL_VERSION, locks=False, tells=True),
        GrblBoard(FLUID, FLUID_VERSION, "$10=1\r\n$13=0\r\n$32=0", locks=False),
    ],
    ids=["GRBL without lock", "grblHAL", "FluidNC"],
)
def test_idle_after_a_start_is_no_reference(board: GrblBoard) -> None:
    with table_of(board) as table:
        assert not table.state("tilt").homed
        with pytest.raises(StateError, match="home tilt first"):
            table.move("tilt", -30.0)
        assert board.moves == []
        table.home("tilt")
        assert table.move("tilt", -30.0).position == -30.0
        assert "in this connection" in table.state("tilt").reference


def test_an_unlocked_grbl_has_no_reference() -> None:
    board = GrblBoard()
    with table_of(board) as table:
        board.receive(b"$X\n")  # another program
        assert not table.state("tilt").homed


@pytest.mark.parametrize(
    ("board", "kept"),
    [
        (GrblBoard(), True),
        (GrblBoard(HAL, HAL_VERSION, tells=True), True),
        (GrblBoard(FLUID, FLUID_VERSION, locks=False), False),
    ],
    ids=["GRBL: its mark", "grblHAL: field H", "FluidNC: does not tell"],
)
def test_another_program_knows_a_reference_that_the_controller_tells(board: GrblBoard, kept: bool) -> None:
    with table_of(board) as table:
        table.home("tilt")
    with table_of(board) as table:
        assert table.state("tilt").homed is kept
        board.start()
    with table_of(board) as table:
        assert not table.state("tilt").homed


@pytest.mark.parametrize("heard", [True, False], ids=["banner heard", "banner lost"])
def test_a_start_during_a_movement_voids_the_reference(heard: bool) -> None:
    board = GrblBoard(locks=False)

    def start() -> bytes:
        said = board.start()
        board.place = board._target = 0.0
        return said if heard else b""

    with table_of(board) as table:
        table.home("tilt")
        table.move("tilt", 10.0)
        board.ends = start
        with pytest.raises(StateError, match="has started anew; home tilt again"):
            table.move("tilt", 0.0)
        with pytest.raises(StateError, match=r"home tilt (first|again)"):
            table.move("tilt", 10.0)
        assert len(board.moves) == 2
        table.home("tilt")
        assert table.move("tilt", 10.0).position == 10.0


@pytest.mark.parametrize("after_ok", [True, False])
def test_an_alarm_is_named_and_voids_the_reference(after_ok: bool) -> None:
    board = GrblBoard()

    def alarm() -> bytes:
        board.state, board._left = "Alarm", 0
        return b"ALARM:1\r\n"

    with table_of(board) as table:
        table.home("tilt")
        if after_ok:
            board.ends = alarm
        else:
            board.answers["G21 G90 G53 G1 X10.0000 F600.000"] = b"ALARM:1\r\n"
        with pytest.raises(StateError, match="a limit switch was reached"):
            table.move("tilt", 10.0)
        board.state = "Idle"
        with pytest.raises(StateError, match="a limit switch was reached; home tilt first"):
            table.move("tilt", 5.0)


FLAGS = {value for name, value in vars(WarningFlags).items() if name.isupper()}
"""From the maker's package, which lists them with the firmware's own names."""


def test_all_flags_of_faults_and_warnings_are_known() -> None:
    told = {flag for flag in FLAGS if flag[0] in "FW"}
    assert len(told) == 26
    assert told == set(FAULTS) | set(UNREFERENCED)
    assert set(FAULTS) >= UNRELIABLE


@pytest.mark.parametrize("flag", [*sorted(FAULTS), "FX", "NI"])
def test_a_flag_after_a_movement_stops_work_and_unreliable_positions_need_homing(flag: str) -> None:
    stage = ZaberStage()
    with Table("table", Zaber(Wire(stage), 0.2), {"tilt": AxisPlan(per_unit=1000.0)}) as table:
        table.home("tilt")
        stage.then = [flag]
        if flag == "NI":  # notes do not concern the position
            assert table.move("tilt", 10.0).position == 10.0
            return
        with pytest.raises(StateError, match=FAULTS.get(flag, "FX, which is not known")):
            table.move("tilt", 10.0)
        if flag in UNRELIABLE or flag == "FX":
            with pytest.raises(StateError, match="home tilt first"):
                table.move("tilt", 20.0)
            table.home("tilt")
        assert table.move("tilt", 20.0).position == 20.0


@pytest.mark.parametrize("flag", UNREFERENCED)
def test_a_stage_without_reference_is_homed_again(flag: str) -> None:
    stage = ZaberStage()
    with Table("table", Zaber(Wire(stage), 0.2), {"tilt": AxisPlan(per_unit=1000.0)}) as table:
        table.home("tilt")
        stage.then = [flag]
        with pytest.raises(StateError, match="lost its reference: the controller reports none"):
            table.move("tilt", 10.0)


def test_a_cube_that_gives_no_address_is_understood() -> None:
    cube = TCube()
    with Table("table", Kinesis([Wire(cube)], answer_s=0.2), {"tilt": AxisPlan(per_unit=1919.64)}) as table:
        assert table.connect().model == "TDC001"
        with pytest.raises(StateError, match="home tilt first"):
            table.move("tilt", 10.0)
        table.home("tilt")
        assert table.move("tilt", 10.0).position == pytest.approx(10.0, abs=1e-3)


def test_messages_between_answers_are_no_answers() -> None:
    """A cube tells its firmware's troubles (HW_RICHRESPONSE) and ends of movements when it likes."""
    trouble = struct.pack("<HHBB", 0x0081, 68, 0x81, 0x50) + bytes(68)
    cube, moved = TCube(), bytes.fromhex("64 04 01 00 01 50")
    whole = cube.receive
    cube.receive = lambda data: trouble + moved + whole(data) + trouble  # type: ignore[method-assign]
    with Table("table", Kinesis([Wire(cube)], answer_s=0.2), {"tilt": AxisPlan(per_unit=1919.64)}) as table:
        table.home("tilt")
        assert table.move("tilt", 10.0).position == pytest.approx(10.0, abs=1e-3)
        assert cube.place == round(10.0 * 1919.64)


def test_noise_at_the_start_of_a_board_is_no_answer() -> None:
    """The boot loader of an ESP32 speaks at another speed than GRBL."""
    board = GrblBoard()
    noise = b"ets Jul 29 2019\xc0\x80\xff\r\nrst:0x1 (POWERON_RESET)\x1c\x86\n<\xfe"
    table = Table(
        "table", Grbl(Wire(board, lambda: noise + board.start()), 0.2), {"tilt": AxisPlan(low=-90.0)}
    )
    with table:
        table.home("tilt")
        assert table.move("tilt", -10.0).position == -10.0


def test_what_befalls_one_axis_does_not_void_the_others() -> None:
    known = References()
    known.connected()
    for axis in ("tilt", "roll"):
        known.searching(axis)
        known.found(axis)
    known.void("stalled", "tilt")
    assert known.judged("tilt", True) == (False, "stalled")
    assert known.judged("roll", None)[0]
    known.connected()
    assert known.judged("roll", None)[0] is False
    assert known.judged("roll", True)[0]
