"""A bench behind the service: its worker process, its table on the real protocol, sessions, crashes."""

from __future__ import annotations

import json
import os
import signal
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from reseau.archive import Archive
from reseau.capture import Bench, BenchFile
from reseau.core.errors import StateError
from reseau.service import worker
from reseau.service.benches import BenchLink
from reseau.service.state import StateFolder
from reseau.service.wire import Certificates, Wire
from reseau_sims.serving.bench import SimulatedBench

from ...capture.fieldrig import DESIGN, FieldRig
from .driver import CRASH_US, DEFECT_US, bench_of, install
from .populated import PARAMETERS, STEPS
from .served import Served, TestClient, served

BENCH = "/api/1/benches/cellar"
ROOT = Path(__file__).resolve().parents[3]
EMPTY = 'schema = "reseau-bench/1"\nname = "cellar"\n[instruments]\n'


class Rig:
    """A simulated bench, and the service on it, which can be started again."""

    def __init__(self, folder: Path, sim: SimulatedBench) -> None:
        self.folder, self.sim = folder, sim
        (folder / "bench.toml").write_text(bench_of(sim.toml))

    def serve(self) -> Any:
        return served(self.folder, benches=(self.folder / "bench.toml",))

    def position(self, axis: str = "tilt") -> float:
        return float(self.sim.laboratory.axes[axis])


def until(what: Callable[[], Any], seconds: float = 180.0) -> Any:
    end = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < end
        time.sleep(0.03)
    return found


def state(client: TestClient, *wanted: str, seconds: float = 180.0) -> dict[str, Any]:
    last: dict[str, Any] = {}

    def there() -> bool:
        nonlocal last
        last = client.get(BENCH).json()
        return last["state"] in wanted

    try:
        until(there, seconds)
    except AssertionError:
        raise AssertionError(last) from None
    return last


def test_a_bench_whose_first_worker_has_not_answered_yet_is_starting(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text(EMPTY)
    link = BenchLink(tmp_path / "bench.toml", "archive", None, StateFolder(tmp_path / "s"), lambda *_: None)
    assert (link.status["state"], link.status["error"]) == ("starting", "")
    link.restarts = 0  # its process has begun
    assert (link.status["state"], link.status["error"]) == ("starting", "")
    link.restarts = 1
    assert (link.status["state"], link.status["error"]) == ("down", "its worker does not answer")


def test_the_state_that_a_worker_says_last_is_the_one_that_counts(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text(EMPTY)
    state, made = StateFolder(tmp_path / "s"), []
    certificates = Certificates(state)

    def answer(server: socket.socket) -> None:
        for _ in range(20):
            sock = certificates.context("worker").wrap_socket(server.accept()[0], server_side=True)
            wire = Wire(sock)
            number = wire.receive()[0]["id"]
            down = {"state": "down", "error": "not connected yet"}
            wire.send({"event": "status", "status": down})
            wire.send({"id": number, "value": down})
            wire.send({"event": "bench", "status": {"state": "ready"}})
            made.append(wire)

    with socket.create_server(("127.0.0.1", 0)) as server:
        about = {"port": server.getsockname()[1], "pid": os.getpid(), "bench": EMPTY}
        worker.address_file(state, "cellar").write_text(json.dumps(about))
        threading.Thread(target=answer, args=(server,), daemon=True).start()
        for number in range(1, 21):
            link = BenchLink(tmp_path / "bench.toml", "archive", None, state, lambda *_: None)
            link.start()
            until(lambda: len(made) == number)  # noqa: B023
            until(lambda: link.status["state"] == "ready", 2)  # noqa: B023
            time.sleep(0.02)
            assert link.status["state"] == "ready"
            link._over.set()
            made[-1].close()


def test_a_worker_says_no_state_after_a_newer_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Archive.open(tmp_path / "archive", create=True) as archive:
        made = worker.Worker(EMPTY, archive, Certificates(StateFolder(tmp_path / "s")))
        here, there = socket.socketpair()
        with here, there:
            made._wires.add(Wire(here))
            told, slow = Wire(there), threading.Event()
            first = made.status()

            def status() -> dict[str, Any]:
                if slow.is_set():
                    return first | {"state": "ready"}
                slow.set()
                time.sleep(0.2)
                return first

            monkeypatch.setattr(made, "status", status)
            asking = threading.Thread(target=made._say, args=("status",))
            asking.start()
            slow.wait()
            made._say("bench")
            asking.join()
            assert [told.receive()[0]["status"]["state"] for _ in range(2)] == ["down", "ready"]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    folder = tmp_path_factory.mktemp("bench")
    install(folder / "drivers")
    with pytest.MonkeyPatch.context() as monkeypatch, SimulatedBench(seed=3) as sim:
        paths = [str(folder / "drivers"), str(ROOT), os.environ.get("PYTHONPATH", "")]
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
        monkeypatch.setenv("TMPDIR", str(folder))
        monkeypatch.setattr("tempfile.tempdir", str(folder))  # where the locks are
        yield Rig(folder, sim)


@pytest.fixture(scope="module")
def one(rig: Rig) -> Iterator[Served]:
    with rig.serve() as found:
        client = found.client()
        state(client, "ready")
        for axis in ("tilt", "roll", "camera_roll"):
            axes = client.get(f"{BENCH}/axes")
            assert axes.status_code == 200, axes.text
            if not axes.json()[axis]["homed"]:
                assert client.post(f"{BENCH}/home", json={"axis": axis}).status_code == 200
        yield found


@pytest.mark.slow
def test_an_axis_is_moved_within_its_limits_and_recorded(one: Served, rig: Rig) -> None:
    client = one.client("operate")
    moved = client.post(f"{BENCH}/move", json={"axis": "tilt", "position": 3.0})
    assert moved.status_code == 200, moved.text
    assert moved.json()["tilt"]["position"] == pytest.approx(3.0, abs=0.01)
    assert rig.position() == pytest.approx(3.0, abs=0.01)
    jogged = client.post(f"{BENCH}/move", json={"axis": "tilt", "position": -1.0, "relative": True})
    assert jogged.json()["tilt"]["position"] == pytest.approx(2.0, abs=0.01)
    far = client.post(f"{BENCH}/move", json={"axis": "tilt", "position": 400.0})
    assert (far.status_code, far.json()["error"]["code"]) == (422, "usage")
    assert client.post(f"{BENCH}/move", json={"axis": "none", "position": 1.0}).status_code == 422
    actions = [each["action"] for each in one.client().get("/api/1/audit").json()]
    assert actions[:4] == ["move failed", "move", "move failed", "move"]
    assert one.client("read").post(f"{BENCH}/move", json={"axis": "tilt", "position": 1.0}).status_code == 403


def test_a_stop_acts_at_once_and_is_not_queued(
    one: Served, rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, answers, asked, record = one.client("operate"), [], list[str](), one.service.audit.record
    client.post(f"{BENCH}/move", json={"axis": "tilt", "position": 0.0})

    def noted(by: str, via: str, action: str, *more: Any) -> Any:
        asked.append(action)
        return record(by, via, action, *more)

    monkeypatch.setattr(one.service.audit, "record", noted)

    def move(position: float) -> None:
        answers.append(
            one.client("operate").post(f"{BENCH}/move", json={"axis": "tilt", "position": position})
        )

    # The second one waits for the first, and must not be carried out after the stop.
    threads = [threading.Thread(target=move, args=(position,)) for position in (60.0, 70.0)]
    threads[0].start()
    until(lambda: rig.position() > 1.0)
    threads[1].start()
    until(lambda: asked.count("move") == 2)
    stopped = client.post(f"{BENCH}/stop")
    assert stopped.status_code == 200, stopped.text
    assert stopped.json()["ms"] < 1000  # on a loaded machine; on an idle one below 100
    for each in threads:
        each.join(30)
    assert sorted(each.status_code for each in answers) == [409, 409]
    at = rig.position()
    time.sleep(0.3)
    assert rig.position() == pytest.approx(at, abs=0.02)
    assert at < 55
    assert client.post(f"{BENCH}/move", json={"axis": "tilt", "position": 0.0}).status_code == 200


def test_what_was_asked_for_before_a_stop_is_not_done_after_it(
    one: Served, rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, stopped, record = threading.Event(), threading.Event(), one.service.audit.record

    def slow(by: str, via: str, action: str, *more: Any) -> Any:
        if action == "move":  # a stop does not wait for records, and overtakes the movement here
            asked.set()
            stopped.wait(60)
        return record(by, via, action, *more)

    answers = []
    at = rig.position()

    def move() -> None:
        given = {"axis": "tilt", "position": at + 3.0}
        answers.append(one.client("operate").post(f"{BENCH}/move", json=given))

    monkeypatch.setattr(one.service.audit, "record", slow)
    thread = threading.Thread(target=move)
    thread.start()
    assert asked.wait(60)
    assert one.client("operate").post(f"{BENCH}/stop").status_code == 200
    stopped.set()
    thread.join(60)
    assert answers[0].status_code == 409
    assert answers[0].json()["error"]["text"].endswith("was stopped")
    assert rig.position() == at
    moved = one.client("operate").post(f"{BENCH}/move", json={"axis": "tilt", "position": at + 1.0})
    assert moved.status_code == 200, moved.text


def test_settings_have_units_and_limits_of_the_bench(one: Served) -> None:
    client = one.client("operate")
    rows = client.get(f"{BENCH}/settings").json()["camera"]
    assert rows["exposure_us"] == {"value": 1000.0, "unit": "µs", "limits": [10.0, 5000.0], "options": None}
    changes = {"instrument": "camera", "changes": {"exposure_us": 900.0}}
    assert client.patch(f"{BENCH}/settings", json=changes).json()["exposure_us"]["value"] == 900.0
    changes["changes"] = {"exposure_us": 9000.0}
    assert client.patch(f"{BENCH}/settings", json=changes).status_code == 422
    tested = client.post(f"{BENCH}/check").json()
    assert {each["name"]: each["error"] for each in tested} == {"table": None, "camera": None}
    assert client.patch(
        f"{BENCH}/settings", json={"instrument": "camera", "changes": {"exposure_us": 1000.0}}
    ).is_success


def test_the_live_picture_says_how_it_is_exposed_and_focused(one: Served) -> None:
    client = one.client("read")
    facts = until(lambda: (f := client.get(f"{BENCH}/picture").json())["number"] and f)
    assert facts["exposure"] == "good"
    assert 0 < facts["edge_px"] < 10
    assert client.get(f"{BENCH}/picture.jpg").content[:2] == b"\xff\xd8"


def begin(client: TestClient, name: str) -> Any:
    given = {
        "name": name,
        "plan": "testfield",
        "parameters": dict(PARAMETERS),
        "inputs": {"design.json": DESIGN.to_json()},
    }
    return client.post(f"{BENCH}/sessions", json=given)


@pytest.mark.slow
def test_a_session_is_begun_paused_continued_and_calibrated(one: Served) -> None:
    client = one.client("operate")
    assert begin(client, "paused").status_code == 201
    again = begin(client, "another")
    assert (again.status_code, again.json()["error"]["code"]) == (409, "instrument")
    until(lambda: client.get(BENCH).json()["session"]["good"] >= 1)
    assert client.post(f"{BENCH}/pause").status_code == 200
    paused = state(client, "paused")
    assert 1 <= paused["session"]["good"] < len(STEPS)
    frames = len(client.get("/api/1/sessions/paused/frames").json())
    time.sleep(0.3)
    assert len(client.get("/api/1/sessions/paused/frames").json()) == frames
    assert client.post(f"{BENCH}/resume").status_code == 200
    done = state(client, "ready")
    assert (done["session"]["state"], done["session"]["good"]) == ("done", len(STEPS)), done
    assert done["session"]["reached"]["sigma_c"] > 0
    found = client.get("/api/1/sessions/paused").json()
    assert (found["status"], len(found["results"])) == ("done", 3)


@pytest.mark.slow
def test_a_session_that_was_aborted_is_resumed_without_repeating_poses(one: Served) -> None:
    client = one.client("operate")
    assert begin(client, "aborted").status_code == 201
    until(lambda: client.get(BENCH).json()["session"]["good"] >= 1)
    assert client.post(f"{BENCH}/abort").status_code == 200
    found = state(client, "ready")
    assert found["session"]["state"] == "stopped"
    assert "aborted" in found["interrupted"]
    kept = {each["sha256"] for each in client.get("/api/1/sessions/aborted/frames").json()}
    assert client.post(f"{BENCH}/sessions/resume", json={"name": "aborted"}).status_code == 200
    state(client, "ready")
    assert client.get("/api/1/sessions/aborted").json()["status"] == "done"
    rows = client.get("/api/1/sessions/aborted/frames").json()
    assert kept <= {each["sha256"] for each in rows}
    assert len({(each["step"], each["take"]) for each in rows}) == len(rows)


def test_a_form_of_declared_options_begins_a_session(one: Served) -> None:
    client = one.client("operate")
    page = client.get(BENCH.replace("/api/1", ""), headers={"Accept": "text/html"}).text
    assert page.count("<fieldset data-for=") == 6
    for name in ("count", "until", "region", "levels", "psf_px", "body", "retakes", "park"):
        assert f'"texts.{name}"' in page
    assert '<input type="file" data-input="object.json" required>' in page
    given = {"name": "by form", "plan": "frames", "texts": {"count": "2", "park": "tilt=0", "average": ""}}
    assert client.post(f"{BENCH}/sessions", json=given).status_code == 201
    state(client, "ready")
    stored = client.get("/api/1/sessions/by form").json()["parameters"]
    assert (stored["count"], stored["park"], "average" in stored) == (2, {"tilt": 0.0}, False)
    for texts, said in ({"count": "two"}, "cannot interpret 'two'"), ({"colour": "red"}, "unknown key"):
        wrong = client.post(f"{BENCH}/sessions", json=given | {"name": "wrong", "texts": texts})
        assert (wrong.status_code, said in wrong.json()["error"]["what"]) == (422, True)


def test_a_plan_of_the_user_is_not_run_and_a_wrong_one_refused(one: Served) -> None:
    client = one.client("operate")
    own = {"name": "own", "plan": "own", "parameters": {}, "inputs": {"generator.py": "import os"}}
    assert client.post(f"{BENCH}/sessions", json=own).status_code == 422
    twice = client.post(f"{BENCH}/sessions", json={"name": "by form", "plan": "frames"})
    assert (twice.status_code, twice.json()["error"]["what"]) == (422, "is the name of another session")
    wrong = {"name": "wrong", "plan": "frames", "parameters": {"count": -1}}
    assert client.post(f"{BENCH}/sessions", json=wrong).status_code == 422
    assert client.get("/api/1/sessions/wrong").status_code == 404


def test_a_released_bench_is_free_for_others_and_taken_again(one: Served, rig: Rig) -> None:
    client = one.client("operate")
    toml = BenchFile.read(rig.folder / "bench.toml")
    others = Bench(toml, lambda name, entry: FieldRig().table)
    with pytest.raises(StateError, match="reseau serve, bench cellar"), others.lock("another program"):
        pass
    assert client.post(f"{BENCH}/release").json()["state"] == "released"
    assert client.post(f"{BENCH}/move", json={"axis": "tilt", "position": 1.0}).status_code == 409
    with others.lock("another program"):
        assert client.post(f"{BENCH}/take").status_code == 409
    assert client.post(f"{BENCH}/take").json()["state"] == "ready"


@pytest.mark.slow  # the worker has to be back before the axis arrives, which a loaded machine does not grant
def test_a_killed_worker_is_shown_restarted_and_leaves_nothing_moving(one: Served, rig: Rig) -> None:
    client = one.client("operate")
    client.post(f"{BENCH}/move", json={"axis": "roll", "position": 0.0})
    answers: list[Any] = []
    mover = threading.Thread(
        target=lambda: answers.append(client.post(f"{BENCH}/move", json={"axis": "roll", "position": 350.0}))
    )
    mover.start()
    until(lambda: rig.position("roll") > 1.0)
    os.kill(one.service.benches["cellar"].status["pid"], signal.SIGKILL)
    mover.join(60)
    assert answers[0].status_code == 409
    assert one.client().get("/api/1/sessions").status_code == 200
    found = state(one.client(), "ready")
    assert found["restarts"] == 1
    at = rig.position("roll")
    assert at < 345
    time.sleep(0.3)
    assert rig.position("roll") == pytest.approx(at, abs=0.02)


@pytest.mark.slow
def test_a_bench_on_another_machine_is_reached_with_its_own_certificate_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    bench = tmp_path / "attic.toml"
    bench.write_text('schema = "reseau-bench/1"\nname = "attic"\n[instruments]\n')
    Archive.open(tmp_path / "archive", create=True).close()
    state = StateFolder.beside(str(tmp_path / "archive"))
    own, other = tmp_path / "own", tmp_path / "other"
    Certificates(state).export("127.0.0.2", own)
    Certificates(state).export("127.0.0.3", other)
    with socket.create_server(("127.0.0.2", 0)) as free:
        port = free.getsockname()[1]
    for folder, expected in ((other, "certificate"), (own, "ready")):
        command = [sys.executable, "-c", "from reseau.cli import main; main()", "service", "worker"]
        command += [str(bench), "--listen", f"127.0.0.2:{port}", "--certificates", str(folder)]
        running = subprocess.Popen([*command, "--archive", str(tmp_path / "archive")], cwd=tmp_path)
        try:
            with served(tmp_path, benches=(bench,), workers={bench: ("127.0.0.2", port)}) as found:
                client = found.client()
                end = time.monotonic() + 60
                while expected not in str(client.get("/api/1/benches/attic").json()):
                    assert time.monotonic() < end
                    time.sleep(0.1)
                if folder is own:
                    assert client.post("/api/1/benches/attic/check").json() == []
            assert running.poll() is None  # the service ended, and left it
        finally:
            running.terminate()
            assert running.wait(20) == 0


def test_the_worker_answers_only_with_certificates(tmp_path: Path) -> None:
    own, other = (Certificates(StateFolder(tmp_path / name)) for name in ("own", "other"))
    for context, role in ((other.context("service"), "foreign"), (own.context("service"), "own")):
        here, there = socket.socketpair()
        outcome: list[str] = []

        def serve(sock: socket.socket = there, outcome: list[str] = outcome) -> None:
            try:
                with own.context("worker").wrap_socket(sock, server_side=True) as made:
                    outcome.append(str(made.recv(5)))
            except (ssl.SSLError, OSError) as error:
                outcome.append(type(error).__name__)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            with context.wrap_socket(here) as made:
                made.send(b"hello")
        except (ssl.SSLError, OSError):
            here.close()
        thread.join(10)
        there.close()
        assert ("hello" in outcome[0]) == (role == "own")


@pytest.mark.slow
def test_an_instrument_that_does_not_answer_is_named_and_does_not_take_the_others_with_it(
    rig: Rig, tmp_path: Path
) -> None:
    with SimulatedBench(seed=4) as sim:
        another = Rig(tmp_path, sim)
        path = tmp_path / "bench.toml"
        path.write_text(
            path.read_text().replace('"field"', '"another field"')
            + '\n[instruments.sonar]\ndriver = "ping360"\naddress = "tcp://127.0.0.1:1"\n'
        )
        with another.serve() as found:
            client = found.client("operate")
            bench = state(client, "ready")
            assert "sonar" in bench["error"]
            homed = client.post(f"{BENCH}/home", json={"axis": "tilt"})
            assert homed.status_code == 200, homed.text
            given = {"name": "deaf", "plan": "scan", "parameters": {}, "inputs": {}}
            answer = client.post(f"{BENCH}/sessions", json=given)
            assert answer.status_code == 409
            assert "sonar" in answer.json()["error"]["text"]
            assert client.get("/api/1/sessions/deaf").status_code == 404


@pytest.mark.slow
def test_an_instrument_that_was_silent_is_connected_when_it_answers(rig: Rig, tmp_path: Path) -> None:
    with SimulatedBench(seed=5) as sim:
        another, plugged = Rig(tmp_path, sim), tmp_path / "tty"
        real = BenchFile.parse_toml(sim.toml, where="").instruments["scanner"].address
        path = tmp_path / "bench.toml"
        path.write_text(
            path.read_text().replace('"field"', '"a third field"')
            + f'\n[instruments.sonar]\ndriver = "ping360"\naddress = "{plugged}"\n'
        )
        with another.serve() as found:
            client = found.client("operate")
            assert "sonar" in state(client, "ready")["error"]
            plugged.symlink_to(real)
            until(lambda: client.get(BENCH).json()["error"] == "")
            check = {each["name"]: each["error"] for each in client.post(f"{BENCH}/check").json()}
            assert check["sonar"] is None


@pytest.mark.slow
def test_a_defect_of_a_driver_is_an_answer_and_a_crash_restarts_the_worker(one: Served, rig: Rig) -> None:
    client = one.client("operate")
    pid = one.service.benches["cellar"].status["pid"]
    given = {"instrument": "camera", "changes": {"exposure_us": DEFECT_US}}
    assert client.patch(f"{BENCH}/settings", json=given).status_code == 200
    assert begin(client, "defect").status_code == 201
    found = state(client, "ready")
    assert (found["session"]["state"], "a defect of the driver" in found["session"]["why"]) == (
        "failed",
        True,
    )
    until(lambda: "a defect of the driver" in client.get(f"{BENCH}/picture").json()["error"])
    assert one.service.benches["cellar"].status["pid"] == pid
    given["changes"] = {"exposure_us": CRASH_US}
    restarts = found["restarts"]
    assert client.patch(f"{BENCH}/settings", json=given).status_code == 200
    client.get(f"{BENCH}/picture")  # somebody looks: a picture is taken
    until(lambda: client.get(BENCH).json()["restarts"] == restarts + 1)
    assert client.get("/api/1/sessions/defect").json()["status"] == "failed"
    # The new worker has the settings of the file of the bench.
    assert state(client, "ready")["interrupted"].count("defect") == 1
    assert client.post(f"{BENCH}/sessions/resume", json={"name": "defect"}).status_code == 200
    state(client, "ready")
    assert client.get("/api/1/sessions/defect").json()["status"] == "done"


@pytest.mark.slow
def test_positions_are_reported_while_an_axis_moves_and_who_moves_it(one: Served, rig: Rig) -> None:
    client = one.client("operate")
    client.post(f"{BENCH}/move", json={"axis": "roll", "position": 0.0})
    mover = threading.Thread(
        target=lambda: client.post(f"{BENCH}/move", json={"axis": "roll", "position": 100.0})
    )
    mover.start()
    other, seen = one.client(), set[float]()
    until(lambda: other.get(BENCH).json()["moving"])
    while (told := other.get(BENCH).json()["moving"]) and mover.is_alive():
        assert told.startswith("roll to 100 deg, by local")
        seen.add(other.get(f"{BENCH}/axes").json()["roll"]["position"])
        time.sleep(0.1)
    mover.join(60)
    assert len([each for each in seen if 0.0 < each < 100.0]) >= 2
    client.post(f"{BENCH}/move", json={"axis": "roll", "position": 0.0})


@pytest.mark.slow  # the last that asks `one`, whose connection it ends
def test_a_service_that_ends_leaves_the_session_running_and_finds_it_again(rig: Rig, one: Served) -> None:
    client = one.client("operate")
    client.post(f"{BENCH}/move", json={"axis": "tilt", "position": 0.0})
    assert begin(client, "alone").status_code == 201
    pid = one.service.benches["cellar"].status["pid"]
    until(lambda: client.get(BENCH).json()["session"]["good"] >= 1)
    link = one.service.benches["cellar"]
    # The connection breaks as when the service is killed.
    link._over.set()
    link._wire.close()  # type: ignore[union-attr]
    link._thread.join(5)
    with rig.serve() as second:
        other = second.client()
        found = state(other, "running", "ready")
        assert second.service.benches["cellar"].restarts == -1
        assert second.service.benches["cellar"].status["pid"] == pid
        assert found["session"]["name"] == "alone"
        state(other, "ready")
        assert other.get("/api/1/sessions/alone").json()["status"] == "done"


@pytest.mark.slow
def test_a_worker_whose_service_has_gone_ends_by_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker, "_ALONE_S", 0.1)
    text, told = 'schema = "reseau-bench/1"\nname = "empty"\ninstruments = {}\n', tmp_path / "told.json"
    with Archive.open(tmp_path / "archive", create=True) as archive:
        alone = worker.Worker(text, archive, Certificates(StateFolder(tmp_path / "state")))
        alone.serve(place=told)
    assert alone.over.is_set()
    assert not told.exists()
