"""Settings are checked before anything is sent; deadlines are total; a status is over once."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from reseau.core.errors import DeadlineError, SettingError, UsageError
from reseau.instruments import Deadline, Settings, Status, choice, quantity, text


@dataclass(frozen=True)
class Pulser(Settings):
    voltage: float = quantity(300.0, "V", 40.0, 300.0)
    averages: int = quantity(1, "", 1, 64)
    mode: str = choice("echo", "echo", "through")
    note: str = text("")


@pytest.mark.parametrize(
    "wrong",
    [
        {"voltage": 39.9},
        {"voltage": math.nan},
        {"voltage": math.inf},
        {"voltage": "300"},
        {"voltage": True},
        {"voltage": None},
        {"averages": 1.5},
        {"averages": 65},
        {"mode": "other"},
        {"note": 3},
        {"colour": 3},
    ],
)
def test_invalid_settings_raise_with_their_name(wrong: dict[str, Any]) -> None:
    with pytest.raises(SettingError, match=next(iter(wrong))):
        Pulser().changed(wrong)


def test_a_bench_narrows_limits() -> None:
    assert Pulser().changed({"voltage": 100}, {"voltage": (40.0, 200.0)}).voltage == 100.0
    with pytest.raises(SettingError, match="40…200 V"):
        Pulser().changed({"voltage": 250.0}, {"voltage": (40.0, 200.0)})
    with pytest.raises(SettingError, match="is not a setting"):
        Pulser().changed({}, {"colour": (0.0, 1.0)})


@given(st.floats(40, 300))
def test_values_within_the_limits_are_accepted(voltage: float) -> None:
    assert Pulser(voltage).to_dict() == {"voltage": voltage, "averages": 1, "mode": "echo", "note": ""}


def test_a_deadline_expires_and_its_parts_not_later() -> None:
    deadline = Deadline(0.02)
    part = deadline.part(10.0)
    assert part.left <= deadline.seconds
    time.sleep(0.03)
    assert deadline.expired
    assert part.expired
    for seconds in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(UsageError):
            Deadline(seconds)


def test_a_status_reports_its_outcome_and_calls_back_once() -> None:
    gate, called = threading.Event(), []
    status = Status(gate.wait, "gate")
    status.add_callback(lambda s: called.append(s.success))
    assert not status.done
    with pytest.raises(DeadlineError):
        status.exception(0.01)
    gate.set()
    status.wait(5.0)
    status.add_callback(lambda s: called.append(s.success))
    assert called == [True, True]

    def fail() -> None:
        raise SettingError("is wrong")

    with pytest.raises(SettingError):
        Status(fail, "fails").wait(5.0)
