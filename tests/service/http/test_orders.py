"""The queue of a bench: recalibrations asked for by pages, schedules and the command line have one owner."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from reseau.archive import Archive
from reseau.cli import run
from reseau.core.errors import StateError, UsageError
from reseau.service import Configurations, Recalibrations, Schedule, Schedules
from reseau.service.orders import Orders

from .populated import FIELD_RULES
from .served import Served, TestClient
from .test_benches import BENCH, DESIGN, PARAMETERS, Rig, one, rig, state, until  # noqa: F401

ORDERS = f"{BENCH}/orders"


@pytest.fixture(scope="module")
def defined(one: Served) -> Served:  # noqa: F811
    """A bench with a recalibration that repeats a session on it."""
    client = one.client("operate")
    new = {"name": "first", "plan": "testfield", "parameters": dict(PARAMETERS)}
    answer = client.post(f"{BENCH}/sessions", json=new | {"inputs": {"design.json": DESIGN.to_json()}})
    assert answer.status_code == 201, answer.text
    state(client, "ready")
    archive = one.service.archive
    known = Configurations(archive)
    known.define("left", {"camera": "vidicon"})
    from reseau.sessions.conducting import calibration_of

    decision = known.decide("left", calibration_of(archive.session("first")), FIELD_RULES)
    known.review("left", decision.key, "accepted", comment="first")
    Recalibrations(archive).define("left", archive.session("first"), "left", FIELD_RULES, self_test=True)
    return one


def ended(client: TestClient, number: int) -> dict[str, Any]:
    def over() -> Any:
        rows = client.get(ORDERS).json()["others"]
        return next((each for each in rows if each["number"] == number and each["state"] in
                     ("done", "failed", "withdrawn")), None)  # fmt: skip

    found: dict[str, Any] = until(over)
    return found


@pytest.mark.slow
def test_recalibrate_now_runs_on_the_bench_of_the_service_with_its_log(defined: Served) -> None:
    client = defined.client("operate")
    assert client.get(ORDERS).json()["recalibrations"] == ["left"]
    asked = client.post(f"{ORDERS}/recalibrations", json={"name": "left"})
    assert asked.status_code == 201, asked.text
    found = ended(client, asked.json()["number"])
    assert (found["state"], found["why"].split(":")[0]) == ("done", "accepted"), found
    text = " | ".join(each["text"] for each in found["log"])
    assert "asked for by" in text
    assert "self-test passed" in text
    assert "decided: accepted" in text
    decision = Configurations(defined.service.archive).history("left")[-1]
    assert decision.session == found["session"]
    assert state(client, "ready")["session"]["by"] == found["by"]


@pytest.mark.slow
def test_the_command_line_and_a_schedule_ask_the_service_that_holds_the_bench(
    defined: Served,
    rig: Rig,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(rig.folder)
    assert run(["recalibrate", "left", "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["judgement"]["outcome"] == "accepted"
    start = datetime.now(UTC) - timedelta(minutes=1)
    weekly = Schedule(name="weekly", recalibration="left", rule="FREQ=WEEKLY;COUNT=52",
                      start=f"{start:%Y-%m-%dT%H:%M:%S}", zone="UTC")  # fmt: skip
    archive = defined.service.archive
    Schedules(archive).add(weekly, start - timedelta(hours=1))
    first = until(
        lambda: next((r for r in Schedules(archive).runs("weekly") if r.state in ("done", "failed")), None)
    )
    assert (first.state, first.why.split(":")[0]) == ("done", "accepted"), first
    assert Orders(archive, "cellar").all()[-1].by == "schedule weekly"


@pytest.mark.slow
def test_a_capture_of_the_command_line_is_carried_out_by_the_service_that_holds_the_bench(
    defined: Served,
    rig: Rig,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(rig.folder)
    monkeypatch.syspath_prepend(rig.folder / "drivers")
    words = ["capture", "frames", "--count", "2", "--name", "by hand"]
    assert run(words) == 0
    printed = capsys.readouterr()
    assert "holds bench cellar" in printed.err
    assert "by hand: done, 2 frames" in printed.out
    assert run(words) == 2
    assert capsys.readouterr().err.count("reseau:") == 1


@pytest.mark.slow
def test_a_paused_queue_is_put_in_order_and_withdrawn(defined: Served) -> None:
    client, reader = defined.client("operate"), defined.client("read")
    assert reader.post(f"{ORDERS}/pause").status_code == 403
    assert client.post(f"{ORDERS}/pause").status_code == 200
    numbers = [
        client.post(f"{ORDERS}/recalibrations", json={"name": "left"}).json()["number"] for _ in range(2)
    ]
    assert client.post(f"{ORDERS}/{numbers[1]}/first").status_code == 200
    found = client.get(ORDERS).json()
    assert [each["number"] for each in found["waiting"]] == numbers[::-1]
    assert found["paused_by"]
    for number in numbers:
        assert client.post(f"{ORDERS}/{number}/withdraw").status_code == 200
    assert client.post(f"{ORDERS}/{numbers[0]}/withdraw").status_code == 409
    assert client.post(f"{ORDERS}/resume").status_code == 200
    assert client.get(ORDERS).json()["waiting"] == []
    assert client.post(f"{ORDERS}/recalibrations", json={"name": "right"}).status_code == 422


class Clock:
    def __init__(self) -> None:
        self.now = datetime(2026, 3, 2, 8, tzinfo=UTC)

    def __call__(self) -> datetime:
        return self.now


def test_an_order_that_finds_an_instrument_not_ready_is_tried_again_each_time_later(tmp_path: Path) -> None:
    clock, waits = Clock(), list[float]()
    with Archive.open(tmp_path / "archive", create=True, clock=clock) as archive:
        orders = Orders(archive, "cellar")
        number = orders.add("recalibration", {"name": "left"}, "Ada").number
        while (order := orders.get(number)).state != "failed":
            begun = clock.now
            while (following := orders.next()) is None:
                clock.now += timedelta(seconds=1)
            waits.append((clock.now - begun).total_seconds())
            again = orders.begin(following)
            assert again is not None
            assert orders.begin(following) is None  # nobody else begins the same attempt
            orders.fail(again, StateError("is off", where="camera"))
        assert waits == [0.0, 30.0, 60.0, 120.0, 240.0, 480.0]
        assert order.why == "camera: is off"
        number = orders.add("recalibration", {"name": "left"}, "Ada").number
        begun_one = orders.begin(orders.get(number))
        assert begun_one is not None
        orders.fail(begun_one, UsageError("is no plan"))  # no instrument caused it
        assert orders.get(number).state == "failed"


def test_an_order_whose_worker_ended_is_continued_by_the_next(tmp_path: Path) -> None:
    with Archive.open(tmp_path / "archive", create=True) as archive:
        orders = Orders(archive, "cellar")
        order = orders.add("recalibration", {"name": "left"}, "Ada")
        assert orders.begin(order) is not None
        orders.interrupted()
        found = orders.get(order.number)
        assert (found.state, found.session) == ("blocked", order.session)
