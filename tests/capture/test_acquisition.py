"""Acquisitions: nothing is taken twice or lost, and the bench always stops safely."""

import json
import os
import signal
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bluesky import RunEngine

from reseau.archive import Archive, Session, Verdict
from reseau.capture import Goal, Step, carry_out, paper_steps, plans
from reseau.capture.acquisition import Plan
from reseau.capture.engine import rerun
from reseau.capture.steps import at_heights
from reseau.core.data import Frame
from reseau.core.errors import ArchiveError, EstimationError, StateError, UsageError
from reseau.core.failure import Failure
from reseau.procedures.testfield import TestfieldProcedure

from .fieldrig import FieldRig

EVERY = paper_steps()
FEW = (EVERY[0], EVERY[4], EVERY[9], EVERY[14], EVERY[19])
"""The board at right angles, and tilted by 30° from four sides, each with another turn of the camera."""


@pytest.fixture
def rig() -> FieldRig:
    return FieldRig()


@pytest.fixture
def session(tmp_path: Path) -> Session:
    return Archive.open(tmp_path / "archive", create=True).begin("monday", "testfield", {"design": "field"})


def test_the_plan_of_the_paper_has_36_named_recordings() -> None:
    assert len(EVERY) == len({step.name for step in EVERY}) == 36
    lifted = at_heights(EVERY, (0.0, 100.0))
    assert len({step.name for step in lifted}) == 72
    assert [step.position for step in lifted[:2]] == [{**EVERY[0].position, "z": z} for z in (0.0, 100.0)]
    assert at_heights(EVERY, ()) == EVERY
    assert [step.position for step in paper_steps(axes=("tilt",))] == [{"tilt": t} for t in (0.0, 30.0, 45.0)]


@pytest.mark.slow
def test_a_plan_stores_frames_verdicts_documents_and_results_that_are_the_same_offline(
    rig: FieldRig, session: Session
) -> None:
    run = rig.acquisition(session, rig.procedure())
    carry_out(run, plans.poses(run, FEW, checks=2))
    frames = session.frames(kind="frame")
    assert [f.step for f in frames] == [step.name for step in FEW]
    assert all(f.verdict is not None and f.verdict.ok and f.verdict.facts["points"] > 200 for f in frames)
    assert [f.facts["position"] for f in frames] == [step.position for step in FEW]
    assert len(session.frames(kind="check")) == 2
    kinds = [kind for kind, _ in session.notes()]
    assert [kinds.count(kind) for kind in ("start", "descriptor", "event", "stop", "check")] == [
        1,
        1,
        5,
        1,
        1,
    ]
    events = [note["data"] for kind, note in session.notes("event")]
    assert [event["frame"] for event in events] == [f.sha256 for f in frames]
    (result,) = session.results()
    calibration = json.loads(session.content(result))
    c = calibration["parameters"]["c"]
    assert abs(c["value"] - 57.5) < 4 * c["sigma"] < 1.0
    assert calibration["times"] == {}
    assert result.inputs == {f.name: f.sha256 for f in frames}
    assert calibration["provenance"]["inputs"] == {f.step: f.sha256 for f in frames}
    assert session.status == "done"
    assert rig.table.stops > 0
    (again,) = rerun(session, rig.procedure())
    assert again.same
    other = rig.procedure()
    other.name = "another"
    assert not rerun(session, other)[0].same


def cofactors_of(made: TestfieldProcedure) -> dict[float, float]:
    """Cofactors of c (standard deviations for a sigma0 of 1), by the standard deviations that are reported.

    These are cofactors times sigma0, and enlarged by what images have in common, which nobody can predict.
    """
    progress, found = made.progress, dict[float, float]()

    def noted() -> dict[str, float]:
        reached = progress()
        if reached:
            calibrated = made.calibrated()
            assert not isinstance(calibrated, Failure)
            variance = calibrated.result.formal_camera_covariance(0)[0, 0]
            found[reached["sigma_c"]] = float(np.sqrt(variance) / calibrated.result.sigma0)
        return reached

    made.progress = noted  # type: ignore[method-assign]
    return found


def reached_over_predicted(rig: FieldRig, kind: str, cofactors: dict[float, float]) -> list[float]:
    """Ratios of the cofactors of c that were reached to those that events of a kind predicted."""
    found, predicted, enlarged = list[float](), None, np.nan
    for what, facts in rig.events:
        if what == kind and facts["sigma_c"] is not None:
            predicted = facts["sigma_c"] / enlarged
        elif what == "precision":
            cofactor = cofactors[facts["sigma_c"]]
            if predicted is not None:
                found.append(cofactor / predicted)
            predicted, enlarged = None, facts["sigma_c"] / cofactor
    return found


@pytest.mark.slow
def test_the_precision_after_the_next_pose_is_predicted(rig: FieldRig, session: Session) -> None:
    made = rig.procedure()
    cofactors = cofactors_of(made)
    run = rig.acquisition(session, made)
    carry_out(run, plans.poses(run, FEW))
    # From two frames on there is a calibration, from which little can be predicted; the last is from most.
    assert abs(reached_over_predicted(rig, "outlook", cofactors)[-1] - 1) < 0.1


def test_a_full_disk_stops_the_session_which_can_be_resumed(
    rig: FieldRig, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    put, count = session.objects.put, []

    def full(data: bytes, suffix: str) -> str:
        count.append(suffix)
        if len(count) == 3:
            raise ArchiveError("cannot be kept (No space left on device)", where="archive", do="make room")
        return put(data, suffix)

    monkeypatch.setattr(session.objects, "put", full)
    run = rig.acquisition(session)
    with pytest.raises(ArchiveError, match="No space left on device"):
        carry_out(run, plans.poses(run, FEW))
    assert session.status == "failed"
    assert rig.table.stops > 0
    again = rig.acquisition(session)
    carry_out(again, plans.poses(again, FEW))
    assert [f.step for f in session.frames()] == [step.name for step in FEW]


@pytest.mark.slow
def test_a_clock_that_jumps_changes_neither_order_nor_result(
    rig: FieldRig, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Jumping(datetime):
        """An hour back with every question."""

        asked = 0

        @classmethod
        def now(cls, tz: Any = None) -> datetime:
            cls.asked += 1
            return datetime(2026, 3, 29, 12, tzinfo=UTC) - timedelta(hours=cls.asked)

    monkeypatch.setattr("reseau.archive.session.datetime", Jumping)
    run = rig.acquisition(session, rig.procedure())
    carry_out(run, plans.poses(run, FEW))
    assert [f.step for f in session.frames(kind="frame")] == [step.name for step in FEW]
    assert session.status == "done"
    assert rerun(session, rig.procedure())[0].same


@pytest.mark.slow
def test_a_bad_frame_is_taken_again_and_both_are_kept(rig: FieldRig, session: Session) -> None:
    rig.camera.spoil = lambda number, pixels: np.full_like(pixels, 255) if number == 2 else pixels
    run = rig.acquisition(session, rig.procedure())
    carry_out(run, plans.poses(run, FEW))
    takes = session.frames(FEW[1].name)
    assert [(f.take, f.verdict.ok) for f in takes if f.verdict] == [(0, False), (1, True)]
    assert takes[0].verdict is not None
    assert "saturated: expose less" in takes[0].verdict.why
    assert rig.camera.exposures == 6


@pytest.mark.slow
def test_retakes_are_limited_and_the_session_continues(rig: FieldRig, session: Session) -> None:
    grey = np.full((240, 240), 120, np.uint8)
    rig.camera.spoil = lambda number, pixels: grey if rig.table.stands["roll"] == 90 else pixels
    run = rig.acquisition(session, rig.procedure(), retakes=1)
    carry_out(run, plans.poses(run, FEW))
    assert [len(session.frames(step.name)) for step in FEW] == [1, 1, 2, 1, 1]
    assert session.status == "done"
    declined = [f.verdict.why for f in session.frames() if f.verdict and not f.verdict.ok]
    assert len(declined) == 2
    assert declined[0]


def test_a_frame_exposed_while_the_table_moves_is_rejected(rig: FieldRig, session: Session) -> None:
    def push(number: int) -> None:
        if number == 1:
            rig.table.stands["tilt"] += 0.5

    rig.camera.during = push
    run = rig.acquisition(session)
    carry_out(run, plans.poses(run, FEW[:1]))
    assert [f.verdict.why for f in session.frames() if f.verdict] == [
        "the table moved during the exposure",
        "",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("when", [pytest.param("moving", marks=pytest.mark.slow), "exposing"])
def test_after_a_pause_nothing_is_exposed_or_stored_twice(rig: FieldRig, session: Session, when: str) -> None:
    """The engine replays all messages since the checkpoint, the exposure among them."""
    pid, asked = os.getpid(), []

    def interrupt(*_: object) -> None:
        if not asked:
            asked.append(time.monotonic())
            os.kill(pid, signal.SIGINT)
            time.sleep(0.02)
            os.kill(pid, signal.SIGINT)
            time.sleep(0.2)

    if when == "exposing":
        rig.camera.during = lambda number: interrupt() if number == 3 else None
    else:
        rig.table.before = lambda axis, position: interrupt() if position == 180 else None
    run = rig.acquisition(session, rig.procedure())
    stops: list[int] = []

    def paused() -> Any:
        stops.append(rig.table.stops)
        return "resume"

    carry_out(run, plans.poses(run, FEW), paused=paused)
    assert len(stops) == 1
    assert stops[0] > 0  # the table stood before anyone was asked
    assert rig.camera.exposures == len(FEW)
    assert [f.step for f in session.frames()] == [step.name for step in FEW]
    assert [kind for kind, _ in session.notes()].count("event") == len(FEW)
    assert session.status == "done"


def _end_by_signal(rig: FieldRig, number: signal.Signals) -> None:
    """Send the signal, and expose no further before the run has taken it: it then stops the table.

    Here the signal reaches the thread that exposes, as it may: a system chooses among the threads.
    """
    signal.pthread_kill(threading.get_ident(), number)
    until = time.monotonic() + 10
    while not rig.table.stops and time.monotonic() < until:
        time.sleep(0.01)


@pytest.mark.slow
def test_a_stopped_session_is_resumed_with_the_same_result(
    rig: FieldRig, session: Session, tmp_path: Path
) -> None:
    rig.camera.during = lambda number: _end_by_signal(rig, signal.SIGTERM) if number == 3 else None
    run = rig.acquisition(session, rig.procedure())
    carry_out(run, plans.poses(run, FEW))
    assert session.status == "stopped"
    assert len(session.frames()) < len(FEW)
    assert not session.results()
    rig.camera.during = lambda number: None
    moves = len(rig.table.moves)
    again = rig.acquisition(session, rig.procedure())
    carry_out(again, plans.poses(again, FEW))
    assert session.status == "done"
    assert [f.step for f in session.frames()] == [step.name for step in FEW]
    assert rig.camera.exposures == len(FEW)
    assert len(rig.table.moves) - moves <= 3 * 3  # poses that were done are not gone to again
    other = FieldRig()
    undisturbed = Archive.open(tmp_path / "other", create=True).begin(
        "monday", "testfield", {"design": "field"}
    )
    straight = other.acquisition(undisturbed, other.procedure())
    carry_out(straight, plans.poses(straight, FEW))
    assert session.content(session.results()[-1]) == undisturbed.content(undisturbed.results()[-1])


def test_ctrl_c_at_the_prompt_stops_the_session(rig: FieldRig, session: Session) -> None:
    def interrupt(count: int) -> None:
        if count == 2:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.02)
            os.kill(os.getpid(), signal.SIGINT)

    def paused() -> Any:
        raise KeyboardInterrupt

    rig.camera.during = interrupt
    run = rig.acquisition(session)
    carry_out(run, plans.poses(run, FEW), paused=paused)
    assert session.status == "stopped"
    assert [document["exit_status"] for _, document in session.notes("stop")] == ["success"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_closing_the_terminal_stops_the_session_and_the_instruments(
    rig: FieldRig, session: Session, number: int
) -> None:
    rig.camera.during = lambda count: _end_by_signal(rig, number) if count == 2 else None
    run = rig.acquisition(session)
    carry_out(run, plans.poses(run, FEW))
    assert session.status == "stopped"
    assert rig.table.stops > 0
    assert len(session.frames()) < len(FEW)
    assert rig.events[-1] == ("end", {"status": "stopped", "why": ""})


def test_a_signal_ends_the_session_although_the_engine_has_lost_the_request_to_pause(
    rig: FieldRig, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a busy machine this has happened while the engine waited for the camera."""
    monkeypatch.setattr(RunEngine, "request_pause", lambda engine, defer=False: None)
    rig.camera.during = lambda count: os.kill(os.getpid(), signal.SIGTERM) if count == 1 else None
    run = rig.acquisition(session)
    carry_out(run, plans.poses(run, FEW))
    assert session.status == "stopped"
    assert rig.table.stops > 0
    assert len(session.frames()) < len(FEW)


@pytest.mark.slow
def test_a_failing_instrument_ends_the_session_without_losses_and_stops_the_others(
    rig: FieldRig, session: Session
) -> None:
    def stall(axis: str, position: float) -> None:
        if position == 180:
            raise StateError("stalled", where="table", command="move", do="free the axis")

    rig.table.before = stall
    run = rig.acquisition(session, rig.procedure())
    with pytest.raises(StateError, match="stalled; free the axis"):
        carry_out(run, plans.poses(run, FEW))
    assert session.status == "failed"
    assert len(session.frames()) == 3
    assert rig.table.stops > 0
    assert rig.table.stands["tilt"] != 0  # it stays where it stopped


def test_the_table_parks_only_if_requested_and_only_after_completion(rig: FieldRig, session: Session) -> None:
    run = rig.acquisition(session)
    carry_out(run, plans.poses(run, FEW[:2]))
    assert rig.table.stands["tilt"] == 30
    again = rig.acquisition(session)
    carry_out(again, plans.poses(again, FEW[:2]), park={"tilt": 5.0})
    assert rig.table.stands["tilt"] == 5
    assert rig.camera.exposures == 2


def test_the_table_retreats_only_if_requested_and_only_after_an_early_end(
    rig: FieldRig, session: Session
) -> None:
    def stall(axis: str, position: float) -> None:
        if position == 90:
            raise StateError("stalled", where="table", command="move")

    rig.table.before = stall
    run = rig.acquisition(session)
    with pytest.raises(StateError, match="stalled"):
        carry_out(run, plans.poses(run, FEW[:3]), retreat={"tilt": 7.0})
    assert rig.table.stands["tilt"] == 7
    stops = rig.table.stops
    with pytest.raises(
        StateError, match="stalled"
    ):  # a failed retreat is reported, and the first error is raised
        carry_out(run, plans.poses(run, FEW[:3]), retreat={"roll": 90.0})
    assert ("rest", {"failed": "table (move): stalled"}) in rig.events
    assert rig.table.stops > stops
    rig.table.before = lambda axis, position: None
    carry_out(run, plans.poses(run, FEW[:3]), retreat={"tilt": 7.0})
    assert rig.table.stands["tilt"] == 30


def test_a_user_plan_is_a_generator(rig: FieldRig, session: Session) -> None:
    run = rig.acquisition(session)

    def twice_from_both_sides() -> Plan:
        for tilt in (10.0, 350.0):
            found = yield from run.at(Step(f"from {tilt:g}", {"tilt": tilt}), average=2)
            assert found.facts["averaged"] == 2
        return "seen"

    assert carry_out(run, twice_from_both_sides()) == "seen"
    picture = session.picture(session.frames()[0])
    assert picture.pixels.dtype == np.float32
    assert rig.camera.exposures == 4


def test_wrong_use_is_refused_before_anything_moves(rig: FieldRig, session: Session) -> None:
    run = rig.acquisition(session)
    with pytest.raises(UsageError, match=r"has no axis height; use tilt, roll, camera_roll"):
        carry_out(run, plans.poses(run, [Step("a", {"height": 1.0})]))
    with pytest.raises(UsageError, match="has no scanner; add one"):
        carry_out(run, plans.scan(run))
    with pytest.raises(UsageError, match="needs an operator"):
        carry_out(run, plans.oscilloscope(run))
    wrong = rig.acquisition(session, camera="table")
    with pytest.raises(UsageError, match="is no camera"):
        carry_out(wrong, plans.frames(wrong, 1))


def test_failed_checks_stop_the_acquisition(rig: FieldRig, session: Session) -> None:
    rig.camera.spoil = lambda number, pixels: pixels // 20
    run = rig.acquisition(session)
    with pytest.raises(StateError, match=r"of full scale: expose more.*--checks 0"):
        carry_out(run, plans.poses(run, FEW, checks=3))
    assert len(session.frames(kind="check")) == 3
    assert not session.frames(kind="frame")


@pytest.mark.slow
def test_the_closed_loop_chooses_poses_until_the_goal_is_met(rig: FieldRig, session: Session) -> None:
    """The precision predicted from the design matrix is reached."""
    made = rig.procedure()
    cofactors = cofactors_of(made)
    run = rig.acquisition(session, made)
    goal = Goal("c", 0.007, "mm")
    first = (EVERY[0], EVERY[4], EVERY[9])
    candidates = [step for step in EVERY if step.position["camera_roll"] == 0]
    assert carry_out(run, plans.until(run, goal, first, candidates)) == ""
    reached = run.reached("c")
    assert reached is not None
    assert reached < goal.limit
    # Which targets will be hidden, and how sharp they will be, is not known before.
    ratios = reached_over_predicted(rig, "next", cofactors)
    assert ratios
    np.testing.assert_allclose(ratios, 1, atol=0.1)
    # It begins anew: every choice is remembered.
    again = rig.acquisition(session, rig.procedure())
    exposures = rig.camera.exposures
    assert carry_out(again, plans.until(again, goal, first, candidates)) == ""
    assert rig.camera.exposures == exposures


def test_the_search_for_the_next_pose_can_be_stopped(rig: FieldRig, session: Session) -> None:
    looked: list[str] = []

    class Slow:
        """A procedure that needs long for each candidate."""

        def on_frame(self, frame: Any, step: Step) -> Verdict:
            return Verdict(True)

        def progress(self) -> dict[str, float]:
            return {"sigma_c": 1.0}

        def next_pose(self, candidates: Any, wanted: str) -> tuple[Step, float | None] | None:
            for candidate in candidates:
                looked.append(candidate.name)
                if len(looked) == 2:
                    os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(0.2)
            return None

        def finish(self) -> dict[str, str]:
            return {}

    run = rig.acquisition(session, Slow())  # type: ignore[arg-type]
    carry_out(run, plans.until(run, Goal("c", 0.1, "mm"), FEW[:1], EVERY))
    assert session.status == "stopped"
    assert len(looked) < 6


@pytest.mark.slow
def test_the_closed_loop_reports_when_no_pose_is_left(rig: FieldRig, session: Session) -> None:
    run = rig.acquisition(session, rig.procedure())
    why = carry_out(run, plans.until(run, Goal("c", 1e-9, "mm"), FEW[:3], FEW[3:]))
    assert "no pose is left" in why


@pytest.mark.slow
def test_a_goal_for_a_parameter_that_is_not_estimated_is_refused(rig: FieldRig, session: Session) -> None:
    run = rig.acquisition(session, rig.procedure())
    with pytest.raises(EstimationError, match="is not estimated; use c, x0, y0, K1"):
        carry_out(run, plans.until(run, Goal("fx", 1.0, ""), FEW, EVERY[-1:]))


@pytest.mark.slow
def test_frames_from_before_a_resumption_are_not_measured_again(rig: FieldRig, session: Session) -> None:
    run = rig.acquisition(session, rig.procedure())
    carry_out(run, plans.poses(run, FEW))
    (first,) = session.results()
    made, number = rig.procedure(), 0
    measure = made._measure

    def counted(frame: Frame) -> Any:
        nonlocal number
        number += 1
        return measure(frame)

    made._measure = counted
    again = rig.acquisition(session, made)
    carry_out(again, plans.poses(again, FEW))
    assert number == 0
    assert session.results()[-1].id == first.id  # the same to the byte, so that it is not stored again
    assert made.finish()["calibration.json"].encode() == session.content(first)
