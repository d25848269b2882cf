"""Service and worker are killed at random moments: the state is right, nothing moves, nothing is lost.

`RESEAU_KILLS` is the number of kills. Run with `python -m pytest -m slow tests/service/http/test_crashes.py`.
"""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import pytest

from reseau.archive import Archive
from reseau.archive.verification import verify
from reseau_sims.serving.bench import SimulatedBench

from ...capture.fieldrig import DESIGN
from .driver import bench_of, install
from .populated import PARAMETERS, STEPS
from .test_benches import ROOT, until
from .test_browser import Place

KILLS = int(os.environ.get("RESEAU_KILLS", "4"))
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900 + 60 * KILLS)]

AXES = ("tilt", "roll", "camera_roll")


@pytest.fixture
def killed(tmp_path: Path) -> Iterator[tuple[Place, SimulatedBench]]:
    install(tmp_path / "drivers")
    paths = [str(tmp_path / "drivers"), str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "TMPDIR": str(tmp_path)}
    with SimulatedBench(seed=3) as sim:
        (tmp_path / "bench.toml").write_text(bench_of(sim.toml))
        made = Place(tmp_path, environment)
        yield made, sim
        made.end()


class Bench:
    """The bench, asked over HTTP."""

    def __init__(self, place: Place) -> None:
        self.place = place
        token = (place.folder / "archive-service" / "local-token").read_text().strip()
        self.http = httpx.Client(headers={"Authorization": f"Bearer {token}"}, timeout=30)

    def ask(self, method: str, path: str, body: Any = None) -> Any:
        url = f"http://127.0.0.1:{self.place.port}/api/1/benches/cellar{path}"
        return self.http.request(method, url, json=body)

    def state(self) -> dict[str, Any]:
        with suppress(httpx.HTTPError):
            found: dict[str, Any] = self.ask("GET", "").json()
            return found
        return {"state": "no answer"}

    def until(self, *wanted: str) -> dict[str, Any]:
        found: dict[str, Any] = {}

        def there() -> bool:
            nonlocal found
            found = self.state()
            return found["state"] in wanted

        try:
            until(there, 120)
        except AssertionError:
            raise AssertionError(found) from None
        return found


def pid_of(place: Place) -> int:
    import json

    file = next((place.folder / "archive-service" / "workers").glob("bench-*.json"))
    return int(json.loads(file.read_text())["pid"])


def at_rest(sim: SimulatedBench) -> bool:
    before = [float(sim.laboratory.axes[axis]) for axis in AXES]
    time.sleep(0.4)
    after = [float(sim.laboratory.axes[axis]) for axis in AXES]
    return max(abs(a - b) for a, b in zip(before, after, strict=True)) < 0.02


def test_after_a_kill_the_state_is_right_nothing_moves_and_nothing_is_lost(
    killed: tuple[Place, SimulatedBench],
) -> None:
    place, sim = killed
    place.start()
    bench = Bench(place)
    with bench.http:
        begun = killed_at_random(place, sim, bench, KILLS)
    place.end()
    with Archive.open(place.folder / "archive") as archive:
        assert verify(archive)
        for name in begun:
            session = archive.session(name)
            assert session.status == "done", name
            frames = session.frames(kind="frame")
            good = [each.step for each in frames if each.verdict is not None and each.verdict.ok]
            assert sorted(good) == sorted(step for step, _ in STEPS), name  # each once
            assert {each.name for each in session.results()} == {
                "calibration.json",
                "report.html",
                "scene.json",
            }


def killed_at_random(place: Place, sim: SimulatedBench, bench: Bench, kills: int) -> list[str]:
    """Kill service, worker or both; return the sessions that were begun, which are resumed to their end."""
    bench.until("ready")
    for axis in AXES:
        assert bench.ask("POST", "/home", {"axis": axis}).status_code == 200
    begun, draw = list[str](), random.Random(24)
    for number in range(kills):
        found = bench.until("ready", "paused")
        if found["state"] == "paused":
            bench.ask("POST", "/resume")
        elif number % 2:  # something moves
            target = {"axis": draw.choice(AXES), "position": draw.choice((5.0, 80.0))}
            threading.Thread(target=lambda t=target: _lost(bench, "/move", t), daemon=True).start()
        elif found["interrupted"]:
            assert bench.ask("POST", "/sessions/resume", {"name": found["interrupted"][0]}).status_code == 200
        else:
            begun.append(f"session {number}")
            new = {"name": begun[-1], "plan": "testfield", "parameters": dict(PARAMETERS)}
            new["inputs"] = {"design.json": DESIGN.to_json()}
            assert bench.ask("POST", "/sessions", new).status_code == 201
        time.sleep(draw.uniform(0.0, 2.0))
        who = draw.choice(("service", "worker", "both"))
        if who != "service":
            with suppress(ProcessLookupError):
                os.kill(pid_of(place), signal.SIGKILL)
        if who != "worker":
            place.kill()
            place.start()
        time.sleep(1.0)  # until the end of the worker is noticed
        state = bench.until("ready", "running", "paused", "pausing", "ending", "moving")
        if state["state"] == "running":
            # A session goes on without the service only; it ends, or is paused.
            assert who == "service", (who, state)
            bench.until("ready", "paused")
        elif who != "service":
            bench.until("ready")
            assert at_rest(sim), (number, who, state)
        elif state["state"] == "moving":
            bench.until("ready")
    while bench.until("ready")["interrupted"]:
        name = bench.state()["interrupted"][0]
        assert bench.ask("POST", "/sessions/resume", {"name": name}).status_code == 200
        bench.until("ready")
    return begun


def _lost(bench: Bench, path: str, body: Any) -> None:
    with suppress(httpx.HTTPError):
        bench.ask("POST", path, body)
