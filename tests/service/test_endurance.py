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
from contextlib import ExitStack, closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from reseau.archive import Archive
from reseau.archive.verification import verify
from reseau.core.data import Frame
from reseau.core.errors import ArchiveError, InputError
from reseau.service.http.options import ServeOptions
from reseau.service.http.service import Service
from reseau.service.orders import Orders
from reseau.service.upkeep import backup, restore

from .http.proxy import Proxy
from .http.served import Served, served
from .http.test_benches import ROOT, until

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


def test_of_two_services_on_an_archive_one_has_the_bench_and_each_order_is_done_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from reseau_sims.serving.bench import SimulatedBench

    from .http.driver import bench_of, install

    install(tmp_path / "drivers")
    paths = [str(tmp_path / "drivers"), str(ROOT), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
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
    from reseau.capture import Bench, BenchFile

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
