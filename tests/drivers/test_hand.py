"""A table that is moved by hand: asked again, read from a scale or a marker, stopped while it is asked."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from reseau.core.data import Frame
from reseau.core.errors import DeadlineError, InstrumentError, RefusedError, SettingError, StateError
from reseau.instruments import RemoteOperator, TerminalOperator, Turntable
from reseau_drivers.turntable import AxisPlan, ByHand, HandTable, Marker, hand
from reseau_drivers.turntable.hand import marker_position
from reseau_sims.serving import Fault, FaultScript, FaultyConnection, SimulatedHands, TcpServer


@contextmanager
def _table(script: FaultScript | None = None, **plan: Any) -> Iterator[tuple[HandTable, SimulatedHands]]:
    hands = SimulatedHands(["tilt"], error=0.02)
    with TcpServer(lambda: FaultyConnection(hands, script)) as server:
        axes = {"tilt": {"low": -45.0, "high": 45.0, "tolerance": 0.2} | plan}
        yield hand("table", server.address, axes=axes), hands


def test_an_axis_is_set_and_its_scale_is_its_position() -> None:
    with _table() as (table, hands):
        assert isinstance(table, Turntable)
        hands.places["tilt"] = 12.5
        assert table.state("tilt").position == 12.5  # asked for: nobody knows yet
        assert table.state("tilt").homed
        state = table.move("tilt", -30.0)
        assert state.position == pytest.approx(hands.position("tilt"), abs=0.01)
        assert state.position == pytest.approx(-30.0, abs=0.2)
        with pytest.raises(SettingError):
            table.move("tilt", 60.0)
    assert hands.violations == []


def test_who_sets_an_axis_wrongly_is_asked_again() -> None:
    script = FaultScript({1: Fault("wrong state")})  # applies to the request after it
    with _table(script) as (table, hands):
        table.home("tilt")
        table.move("tilt", 10.0)
        assert table.move("tilt", 20.0).position == pytest.approx(20.0, abs=0.2)
        assert hands.violations == []


def test_an_axis_that_cannot_be_set_is_an_error() -> None:
    with _table() as (table, hands):
        table.home("tilt")
        hands.inject_fault("stuck")
        with pytest.raises(RefusedError, match="stuck"):
            table.move("tilt", 10.0)
        hands._error = 300.0
        with pytest.raises(StateError, match="stopped at"):
            table.move("tilt", 10.0)


def _drawn(turn: float, at: tuple[float, float] = (200.0, 150.0), side: int = 80) -> np.ndarray:
    """A picture of marker 7 with its centre at a place, turned counter-clockwise by some degrees."""
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    marker = cv2.resize(cv2.aruco.generateImageMarker(known, 7, 6), None, fx=64, fy=64, interpolation=0)
    size, turned = marker.shape[0], np.deg2rad(turn)
    fine = 8  # drawn eight times as large, so that its edges are where they should be
    scale = fine * side / size
    # Of a pixel of the marker to the picture: turned about its centre; y is down.
    linear = scale * np.array([[np.cos(turned), np.sin(turned)], [-np.sin(turned), np.cos(turned)]])
    shift = fine * np.array(at) + (fine - 1) / 2 - linear @ np.full(2, (size - 1) / 2)
    matrix = np.column_stack([linear, shift])
    drawn = cv2.warpAffine(marker, matrix, (fine * 400, fine * 300), borderValue=255)
    return np.asarray(cv2.resize(drawn, (400, 300), interpolation=cv2.INTER_AREA))


@pytest.mark.parametrize("turn", [0.0, 17.3, 90.0, 179.0, 271.4, 359.0])
def test_the_direction_of_a_marker_is_the_angle_of_its_axis(turn: float) -> None:
    for sign, zero in ((1, 0.0), (1, 12.5), (-1, 5.0)):
        found = marker_position(_drawn(turn), Marker(7, zero=zero, sign=sign))
        apart = (found - sign * (turn - zero) + 180.0) % 360.0 - 180.0
        assert abs(apart) < 0.3


def test_the_shift_of_a_marker_is_the_way_of_its_axis() -> None:
    marker = Marker(7, "shift", side_mm=20.0, direction=90.0)
    before, after = (marker_position(_drawn(8.0, (200.0, y)), marker) for y in (150.0, 110.0))
    assert after - before == pytest.approx(40.0 * 20.0 / 80.0, abs=0.1)  # up is 90 degrees


def test_a_picture_without_the_marker_is_declined() -> None:
    with pytest.raises(StateError, match="does not see marker 3"):
        marker_position(_drawn(0.0), Marker(3))
    with pytest.raises(StateError, match="does not see"):
        marker_position(np.zeros((40, 60)), Marker(7))


def test_an_axis_with_a_marker_is_read_by_the_camera() -> None:
    turned = {"roll": 0.0}

    class Person:
        address = "here"

        def __call__(self, request: str) -> None:
            turned["roll"] = float(request.split(" to ")[1].split()[0]) + 0.1

        def read(self, request: str, unit: str, seconds: float | None = None) -> float:
            raise AssertionError("the marker is read")

    person = ByHand(Person(), {"roll": Marker(7)})
    table = HandTable("table", person, {"roll": AxisPlan(low=-90.0, high=180.0, tolerance=0.5)})
    person.camera = SimpleNamespace(  # type: ignore[assignment]
        expose=lambda seconds: SimpleNamespace(frame=Frame(_drawn(turned["roll"]), 255.0))
    )
    assert table.move("roll", 40.0).position == pytest.approx(40.1, abs=0.3)
    assert table.move("roll", -40.0).position == pytest.approx(-39.9, abs=0.3)
    turned["roll"] = 7.0
    assert table.state("roll").position == pytest.approx(7.0, abs=0.3)


def test_wrong_descriptions_are_refused() -> None:
    axes = {"roll": {"high": 90.0}}
    for wrong in (
        {"markers": {"tilt": {"id": 1}}, "camera": "eye"},
        {"markers": {"roll": {"id": 1, "reads": "shift"}}, "camera": "eye"},
        {"markers": {"roll": {"id": 1, "dictionary": "DICT_none"}}, "camera": "eye"},
        {"markers": {"roll": {"number": 1}}, "camera": "eye"},
        {"markers": {"roll": {"id": 1}}},
        {"camera": "eye"},
    ):
        with pytest.raises(SettingError):
            hand("table", "terminal", axes=axes, **wrong)  # type: ignore[arg-type]
    table = hand("table", "terminal", axes=axes, markers={"roll": {"id": 1}}, camera="eye")
    with pytest.raises(SettingError, match="no camera"):
        table.combine({})


@contextmanager
def _typed(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Standard input that this test types on."""
    out, into = os.pipe()
    with os.fdopen(out) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        try:
            yield into
        finally:
            os.close(into)


def test_a_person_at_the_terminal_types_the_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    with _typed(monkeypatch) as keyboard:
        table = hand("table", "terminal", axes={"tilt": {"high": 45.0, "tolerance": 0.2}})
        os.write(keyboard, b"about ten\n10,1\n30.05\n")
        assert table.state("tilt").position == 10.1
        assert table.move("tilt", 30.0).position == 30.05


def test_a_question_at_the_terminal_can_be_stopped_and_ends_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    with _typed(monkeypatch):
        person = TerminalOperator()
        with pytest.raises(DeadlineError):
            person.read("read the scale", "deg", 0.2)
        table = hand("table", "terminal", axes={"tilt": {"high": 45.0}})
        threading.Timer(0.3, table.stop).start()
        began = time.monotonic()
        with pytest.raises(InstrumentError):
            table.home("tilt")
        assert time.monotonic() - began < 60.0


def test_a_program_that_gives_no_number_is_reported() -> None:
    hands = SimulatedHands(["tilt"])
    with (
        TcpServer(lambda: FaultyConnection(hands)) as server,
        pytest.raises(RefusedError, match="cannot"),
    ):
        RemoteOperator(server.address, 5.0).read("make tea", "cup")
