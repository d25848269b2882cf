"""What service, archive and instruments do when the machine fails them; see also `http/test_crashes.py`.

`python -m pytest -m slow tests/service/test_endurance.py`, with `.ci/with_postgres` for the database.
"""

from __future__ import annotations

import os
import resource
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from reseau.archive import Archive
from reseau.archive.verification import verify
from reseau.capture import Bench, BenchFile
from reseau.core.data import Frame
from reseau.core.errors import ArchiveError, InputError
from reseau.service.http.options import ServeOptions
from reseau.service.http.service import Service
from reseau.service.orders import Orders
from reseau.service.upkeep import backup, restore
from reseau_sims.serving import FaultyConnection, TcpServer
from reseau_sims.serving.bench import SimulatedBench

from ..capture.fieldrig import DESIGN
from .http.driver import bench_of, install
from .http.populated import PARAMETERS, STEPS
from .http.proxy import Proxy
from .http.served import Served, served
from .http.test_benches import BENCH, ROOT, state, until

pytestmark = pytest.mark.slow


def test_the_service_waits_for_a_database_that_is_gone_and_goes_on_when_it_is_back(
    postgres: str, tmp_path: Path
) -> None:
    server, connection = int(postgres.rpartition(":")[2].partition("/")[0]), ExitStack()
    proxy = connection.enter_context(Proxy(server))
    url = postgres.replace(f":{server}/", f":{proxy.port}/") + "&connect_timeout=2"
    options = ServeOptions(url, objects=str(tmp_path / "objects"), state=tmp_path / "state")
    with Archive.open(postgres, tmp_path / "objects", create=True) as archive:
        archive.begin("monday", "frames", {"count": 1}).end("done")
    with connection, Service(options) as service:
        client = Served(service).client()
        assert client.get("/api/1/sessions/monday").status_code == 200
        connection.close()
        answer = client.get("/api/1/sessions/monday")
        assert answer.status_code == 503, answer.text
        assert len(answer.json()["error"]["text"].splitlines()) == 1
        until(lambda: client.get("/api/1/health/ready").status_code == 503, 30)
        with Proxy(server, port=proxy.port):
            until(lambda: client.get("/api/1/health/ready").status_code == 200, 30)
            assert client.get("/api/1/sessions/monday").json()["status"] == "done"


def _damage(index: Path, page: int) -> None:
    """Overwrite what is written on a page of a database, as a failing disk does."""
    with index.open("r+b") as file:
        file.seek(4096 * page)
        content = file.read(4096)
        file.seek(4096 * page)
        file.write(bytes(255 - each if each else 0 for each in content))


def test_a_damaged_index_is_detected_and_restored_from_the_backup(tmp_path: Path) -> None:
    folder, state = tmp_path / "archive", tmp_path / "archive-service"
    with served(tmp_path) as one, Archive.open(folder) as archive:
        for number in range(40):
            session = archive.begin(f"session {number}", "frames", {"note": "x" * 200})
            session.store("0", Frame(np.full((8, 8), number, dtype=np.uint8), 255.0))
            session.end("done")
        assert len(one.client().get("/api/1/sessions").json()["sessions"]) == 40
    made = backup(folder, state, tmp_path / "copy")
    assert made.sessions == 40
    with closing(sqlite3.connect(folder / "index.sqlite")) as index:
        index.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        pages = index.execute("PRAGMA page_count").fetchone()[0]
    whole = (folder / "index.sqlite").read_bytes()
    detected = 0
    for page in range(1, pages):
        (folder / "index.sqlite").write_bytes(whole)
        _damage(folder / "index.sqlite", page)
        detected += not _is_whole(folder)
    print(f"{detected} of {pages - 1} damaged pages detected")
    assert detected == pages - 1
    with pytest.raises((ArchiveError, InputError)):
        backup(folder, state, tmp_path / "copy of the last")
    restore(tmp_path / "copy", tmp_path / "new", tmp_path / "new-service")
    with Archive.open(tmp_path / "new") as archive:
        assert verify(archive)
        assert len(archive.sessions()) == 40


def _is_whole(folder: Path) -> bool:
    """Whether an archive can be opened and verified; what is wrong is said in one line each."""
    try:
        with Archive.open(folder) as archive:
            found = verify(archive)
    except ArchiveError as error:
        return "\n" in str(error)
    return bool(found) or any("\n" in each for each in found.damaged)


_WRITER = """
import sys, numpy as np
from reseau.archive import Archive
from reseau.core.data import Frame
from reseau.core.errors import ReseauError
with Archive.open(sys.argv[1], create=True) as archive:
    session = archive.begin("monday", "frames", {})
    try:
        for number in range(400):
            rng = np.random.default_rng(number)
            session.store(str(number), Frame(rng.integers(0, 255, (256, 256), dtype=np.uint8), 255.0))
    except ReseauError as error:
        print(error)
        sys.exit(9)
"""


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 8 MB; needs the right to mount one."""
    place = tmp_path / "disk"
    place.mkdir()
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "none", place], capture_output=True)
    if made.returncode != 0:
        pytest.skip("no right to mount a small disk")
    yield place
    subprocess.run(["umount", place], check=True)


def test_a_full_disk_is_one_line_and_what_was_stored_stays_whole(small_disk: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _WRITER, small_disk / "archive"], capture_output=True, text=True
    )
    assert done.returncode == 9, done.stderr
    assert len(done.stdout.splitlines()) == 1
    with Archive.open(small_disk / "archive") as archive:
        found = verify(archive)
        assert found
        stored = len(archive.session("monday").frames())
        assert 0 < stored == found.files
    print(f"{stored} frames stored before: {done.stdout.strip()}")


def _configured(client: Any, name: str) -> tuple[int, str]:
    """Status and text of the error where a configuration is defined."""
    answer = client.post("/api/1/configurations", json={"name": name, "parts": {"camera": name}})
    return answer.status_code, answer.json().get("error", {}).get("text", "")


def test_a_service_whose_disk_is_full_says_so_reads_on_and_goes_on_when_there_is_room(
    small_disk: Path,
) -> None:
    with Archive.open(small_disk / "archive", create=True) as archive:
        archive.begin("monday", "frames", {"count": 1}).end("done")
    with served(small_disk) as one:
        client = one.client()
        assert _configured(client, "left") == (201, "")
        for size in (1 << 16, 1 << 12):  # to the last page
            with suppress(OSError), (small_disk / "filler").open("ab", buffering=0) as filler:
                while True:
                    filler.write(bytes(size))
        status, text = _configured(client, "right")
        assert status == 503
        assert "full" in text
        assert len(text.splitlines()) == 1
        assert client.get("/api/1/sessions/monday").json()["status"] == "done"
        assert client.get("/").status_code == 200
        (small_disk / "filler").unlink()
        assert _configured(client, "right") == (201, "")
        assert [each["name"] for each in client.get("/api/1/configurations").json()] == ["left", "right"]
    with Archive.open(small_disk / "archive") as archive:
        assert verify(archive)


@contextmanager
def _read_only(folder: Path) -> Iterator[None]:
    """Have nothing in a folder opened for writing, as on a disk that the system made read-only."""
    subprocess.run(["mount", "--bind", folder, folder], check=True)
    try:
        subprocess.run(["mount", "-o", "remount,bind,ro", folder], check=True)
        yield
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def test_a_service_whose_disk_becomes_read_only_says_so_reads_on_and_goes_on_afterwards(
    small_disk: Path,
) -> None:
    with served(small_disk) as one:
        client = one.client()

        def upload(name: str) -> Any:
            picture = np.full((64, 64), 128, dtype=np.uint8)
            photograph = ("photographs", ("a.png", cv2.imencode(".png", picture)[1].tobytes()))
            design = ("design", ("design.json", DESIGN.to_json().encode(), "application/json"))
            return client.post("/api/1/uploads", data={"name": name}, files=[photograph, design])

        with _read_only(small_disk / "archive"):
            answer = upload("while read-only")
            assert answer.status_code == 503, answer.text
            text = answer.json()["error"]["text"]
            assert "ead-only" in text
            assert len(text.splitlines()) == 1
            assert client.get("/").status_code == 200
            # Each opens the index.
            with ThreadPoolExecutor(8) as pool:
                read = list(pool.map(client.get, ["/api/1/sessions"] * 8))
            assert {answer.status_code for answer in read} == {200}
        assert upload("afterwards").status_code == 202
    with Archive.open(small_disk / "archive") as archive:
        assert verify(archive)


def test_a_limit_of_files_acts_as_a_full_disk(tmp_path: Path) -> None:
    def small() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, 150_000))

    done = subprocess.run(
        [sys.executable, "-c", _WRITER, tmp_path / "archive"],
        capture_output=True,
        text=True,
        preexec_fn=small,
    )
    assert done.returncode in (1, 9), done.stderr
    assert "Traceback" not in done.stderr
    with Archive.open(tmp_path / "archive") as archive:
        assert verify(archive)


@pytest.fixture
def workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Worker processes find the camera of the tests, and keep their locks apart from those of others."""
    install(tmp_path / "drivers")
    paths = [str(tmp_path / "drivers"), str(ROOT), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


def test_of_two_services_on_an_archive_one_has_the_bench_and_each_order_is_done_once(
    tmp_path: Path, workers: None
) -> None:
    with SimulatedBench(seed=3) as sim:
        bench = tmp_path / "bench.toml"
        bench.write_text(bench_of(sim.toml))
        other = {"state": tmp_path / "other", "port": 8481}
        with served(tmp_path, benches=(bench,)) as one:
            first = one.client()
            until(lambda: first.get("/api/1/benches/cellar").json()["state"] == "ready")
            with served(tmp_path, benches=(bench,), **other) as two:
                found = until(lambda: (b := two.service.benches["cellar"].status)["error"] and b)
                assert "in use by reseau serve, bench cellar" in found["error"], found
                orders = Orders(two.service.archive, "cellar")
                for number in range(3):
                    given = {"name": f"s{number}", "plan": "frames", "parameters": {"count": 1}, "inputs": {}}
                    orders.add("session", given, "Ada")
                until(lambda: all(each.state == "done" for each in orders.all()))
                assert [each.attempts for each in orders.all()] == [1, 1, 1]
                sessions = [each.name for each in two.service.archive.sessions()]
                assert sorted(sessions) == ["s0", "s1", "s2"]
        # The first has gone: its instruments are free, and the next one carries out what is asked for.
        with served(tmp_path, benches=(bench,), **other) as two:
            orders = Orders(two.service.archive, "cellar")
            orders.add(
                "session", {"name": "s3", "plan": "frames", "parameters": {"count": 1}, "inputs": {}}, "A"
            )
            until(lambda: orders.all()[-1].state == "done")


class Jumping:
    """A clock that is set."""

    def __init__(self) -> None:
        self.now = datetime(2026, 3, 2, 8, tzinfo=UTC)

    def __call__(self) -> datetime:
        return self.now


@pytest.mark.parametrize("hours", [-48, -1, 1, 48, 24 * 400])
def test_a_clock_that_jumps_loses_and_repeats_no_order(tmp_path: Path, hours: int) -> None:
    clock = Jumping()
    with Archive.open(tmp_path / "archive", create=True, clock=clock) as archive:
        orders = Orders(archive, "cellar")
        begun = orders.add("recalibration", {"name": "left"}, "Ada")
        assert orders.begin(begun) is not None
        clock.now += timedelta(hours=hours)
        waits = orders.add("recalibration", {"name": "left"}, "Ada")
        assert [each.number for each in orders.all()] == [begun.number, waits.number]
        orders.end(orders.get(begun.number), "accepted: 4f2a")
        assert orders.get(begun.number).state == "done"
        following = orders.next()
        assert following is not None
        assert following.number == waits.number


def test_instruments_that_stand_still_are_named_within_their_deadline_and_answer_again(
    tmp_path: Path,
) -> None:
    code = (
        "import sys, time\nfrom reseau_sims.serving.bench import SimulatedBench\n"
        "with SimulatedBench(seed=3) as sim:\n    print(sim.toml, flush=True)\n    print('END', flush=True)\n"
        "    time.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = list(iter(process.stdout.readline, "END\n"))
        bench = Bench(BenchFile.parse_toml("".join(lines), where="bench"))
        with bench:
            assert all(each.error is None for each in bench.check(20))
            os.kill(process.pid, signal.SIGSTOP)
            begun = time.monotonic()
            found = bench.check(5)
            spent = time.monotonic() - begun
            os.kill(process.pid, signal.SIGCONT)
            assert all(each.error is not None for each in found), found
            assert all(each.name in str(each.error) for each in found), found
            assert spent < 30, spent
            until(lambda: all(each.error is None for each in bench.check(20)), 90)
        process.kill()


def test_each_instrument_that_stands_still_or_is_unplugged_is_named_while_the_others_work() -> None:
    with ExitStack() as stack:
        sim = stack.enter_context(SimulatedBench(seed=3, scanner="all", environment="scpi"))
        file = BenchFile.parse_toml(sim.toml, where="bench")
        ports, plugs, entries = dict[str, int](), dict[str, Proxy](), dict(file.instruments)
        for name, machine in sim.machines.items():
            if entries[name].address == "in this process":
                continue
            if name == "oscilloscope":
                ports[name] = int(entries[name].address.split(",")[1].split(":")[0])
            else:
                server = TcpServer(partial(FaultyConnection, machine, sim.scripts[name]))
                ports[name] = int(stack.enter_context(server).address.rpartition(":")[2])
            plugs[name] = Proxy(ports[name])
            stack.callback(lambda name=name: plugs[name].__exit__(None, None, None))
            there = f"tcp://127.0.0.1:{plugs[name].port}"
            if name == "oscilloscope":
                there = f"TCPIP::127.0.0.1,{plugs[name].port}::inst0::INSTR"
            entries[name] = entries[name].model_copy(update={"address": there})
        bench = stack.enter_context(Bench(file.model_copy(update={"instruments": entries})))

        def wrong() -> dict[str, str]:
            return {each.name: str(each.error) for each in bench.check(5) if each.error is not None}

        until(lambda: not wrong(), 90)
        for name in plugs:
            for how in ("stands still", "unplugged"):
                if how == "stands still":
                    plugs[name].hold()
                else:
                    plugs[name].__exit__(None, None, None)
                begun = time.monotonic()
                found = wrong()
                spent = time.monotonic() - begun
                print(f"{name} {how}: {found} in {spent:.1f} s")
                assert name in found, (name, how)
                assert name in found[name]
                assert len(found[name].splitlines()) == 1
                assert spent < 30
                # What consists of other instruments fails with them; the others work.
                until(lambda name=name: name in (now := wrong()) and set(now) <= {name, "pulser"}, 60)
                if how == "stands still":
                    plugs[name].release()
                else:
                    plugs[name] = Proxy(ports[name], port=plugs[name].port)
                until(lambda: not wrong(), 90)


def test_a_session_whose_table_is_unplugged_is_resumed_to_its_end(tmp_path: Path, workers: None) -> None:
    with SimulatedBench(seed=3) as sim, ExitStack() as stack:
        server = TcpServer(partial(FaultyConnection, sim.machines["table"], sim.scripts["table"]))
        port = int(stack.enter_context(server).address.rpartition(":")[2])
        plug = Proxy(port)
        address = BenchFile.parse_toml(sim.toml, where="bench").instruments["table"].address
        bench = tmp_path / "bench.toml"
        bench.write_text(bench_of(sim.toml).replace(address, f"tcp://127.0.0.1:{plug.port}"))
        with served(tmp_path, benches=(bench,)) as one:
            client = one.client("operate")
            state(client, "ready")
            for axis in ("tilt", "roll", "camera_roll"):
                assert client.post(f"{BENCH}/home", json={"axis": axis}).status_code == 200
            new = {"name": "monday", "plan": "testfield", "parameters": dict(PARAMETERS)}
            new["inputs"] = {"design.json": DESIGN.to_json()}
            assert client.post(f"{BENCH}/sessions", json=new).status_code == 201
            until(lambda: client.get(BENCH).json()["session"]["good"] >= 1)
            plug.__exit__(None, None, None)
            found = state(client, "ready")
            assert found["interrupted"] == ["monday"]
            assert "table" in found["session"]["why"]
            with Proxy(port, port=plug.port):
                again = until(
                    lambda: (
                        (a := client.post(f"{BENCH}/sessions/resume", json={"name": "monday"})).status_code
                        == 200
                        and a
                    )
                )
                assert again.json()["session"]["name"] == "monday"
                state(client, "ready")
                session = one.service.archive.session("monday")
                assert session.status == "done"
                good = [
                    f.step for f in session.frames(kind="frame") if f.verdict is not None and f.verdict.ok
                ]
                assert sorted(good) == sorted(step for step, _ in STEPS)
