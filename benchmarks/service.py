"""The service under load: clients of events and requests while a session runs; and with many sessions.

    python benchmarks/service.py --part load [--minutes 10] [--clients 200] [--rate 50] [--frames 0]
    python benchmarks/service.py --part sessions [--sessions 10000]
    python benchmarks/service.py --part stop [--trials 50]
    python benchmarks/service.py --part scan [--minutes 10] [--tools testssl,wapiti,slowhttptest]

`load` starts `reseau serve` with a bench whose camera has a clock of its own: a frame each half second, and
whoever asks too late misses one. A session takes them all, while 200 clients read server-sent events and
requests arrive at a constant rate, whether earlier ones are answered or not. A frame is lost if its number is
missing in the archive, and late if it is stored after the next one is due. The camera counts what it dropped,
as transports do, and for how long its process waited for a processor before; how long a write to the disk
takes is measured all the time. A frame that would have been asked for in time without these waits is lost for
want of the machine, and counted apart; any other one, or one that the camera did not drop, is a fault. The
time of a request counts from the moment at which it was due. Clients check that no event is missing or
repeated. The memory of service and worker (what is resident, without pages of files) is flat if the straight
line through the second half of the run rises by less than 1 MB. With `--frames` the session has so many
frames already, as after hours.

`sessions` fills an archive as after years: sessions with frames and results, configurations with decisions,
an audit log. It takes the time and the processor time of pages and operations: at first at most 1 s each,
then 0.1 s.

`stop` moves an axis of the simulated bench, and stops it: by the API, and by a click in Chromium (Debian:
`chromium chromium-driver`). It takes the time from the request, or from the event of the click, until the
motor of the simulated controller stands: at most 100 ms. Another movement waits each time, and must not be
carried out.

`scan` starts the service with TLS and a user, and has others look for its weaknesses (Debian: `testssl.sh
bind9-dnsutils wapiti slowhttptest`): testssl.sh at the protocol, wapiti, logged in, at all pages and at the
operations of the API that read, slowhttptest at its patience. Nothing leaves this machine. What is found
above low is printed; what is missing is said.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import re
import shutil
import ssl
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx
import numpy as np
import psutil
import sqlalchemy as sa
from filled import FIRST, fill_index

from reseau.archive import Archive, schema
from reseau.service import AcceptanceRules, Configurations, Limits
from reseau.service.accounts import Accounts
from reseau.service.audit import Audit
from reseau.service.covariates import example_calibration
from reseau.service.state import StateFolder

try:
    from benchmarks import clocked
except ImportError:
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    from benchmarks import clocked

PASSWORD = "correct horse battery"
ROOT = Path(__file__).resolve().parents[1]
FLAT_MB = 1.0
"""What memory may grow by in the second half of a load."""
BENCH = """schema = "reseau-bench/1"
name = "cellar"
[instruments.camera]
driver = "clocked"
address = "clock"
"""
PATHS = (
    "/api/1/benches/cellar", "/api/1/benches", "/api/1/sessions?count=50", "/api/1/sessions/load",
    "/api/1/sessions/load/frames?count=50", "/api/1/configurations", "/api/1/alarms", "/api/1/me",
    "/api/1/benches/cellar/picture", "/api/1/health/ready", "/", "/benches/cellar", "/sessions",
    "/static/app.js",
)  # fmt: skip


@contextmanager
def serving(folder: Path, *arguments: str) -> Iterator[tuple[int, str, psutil.Process]]:
    """`reseau serve` in a process: port, token, and the process."""
    clocked.install(folder / "drivers")
    paths = [str(folder / "drivers"), str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "TMPDIR": str(folder)}
    with (folder / "serve.log").open("w") as log:
        command = [sys.executable, "-c", "from reseau.cli import main; main()", "serve", "--port", "0"]
        running = subprocess.Popen([*command, *arguments], cwd=folder, stderr=log, env=environment)
    try:
        while "reseau service link" not in (text := (folder / "serve.log").read_text()):
            if running.poll() is not None:
                raise SystemExit(text)
            time.sleep(0.05)
        line = next(each for each in text.splitlines() if each.endswith("(Ctrl-C ends)"))
        port = int(line.partition("/  (")[0].rpartition(":")[2])
        token = (folder / "archive-service" / "local-token").read_text().strip()
        yield port, token, psutil.Process(running.pid)
    finally:
        running.terminate()
        running.wait(30)


class Load:
    """Clients of a service, over connections that are kept."""

    def __init__(self, port: int, token: str) -> None:
        self.port = port
        self.head = f"Host: 127.0.0.1:{port}\r\nAuthorization: Bearer {token}\r\n"
        self.idle: list[tuple[asyncio.StreamReader, asyncio.StreamWriter, float]] = []
        self.seconds: dict[str, list[float]] = {}
        self.statuses: Counter[int] = Counter()
        self.missing = self.repeated = self.received = self.failed = 0
        self.flushes: list[tuple[float, float]] = []
        """When each write to the disk began and ended."""
        self.over = False

    async def request(self, path: str, due: float) -> None:
        """Make a request; its time counts from when it was due."""
        # The service closes connections that were idle for 15 s.
        while self.idle and time.monotonic() - self.idle[0][2] > 5.0:
            self.idle.pop(0)[1].close()
        if self.idle:
            reader, writer, _ = self.idle.pop()
        else:
            reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
        writer.write(f"GET {path} HTTP/1.1\r\n{self.head}\r\n".encode())
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").lower()
        length = int(head.partition("content-length: ")[2].partition("\r")[0])
        await reader.readexactly(length)
        self.seconds.setdefault(path.partition("?")[0], []).append(time.monotonic() - due)
        self.statuses[int(head.split()[1])] += 1
        self.idle.append((reader, writer, time.monotonic()))

    async def requests(self, rate: float, seconds: float) -> None:
        """Requests at a constant rate."""
        draw, begun, tasks = random.Random(1), time.monotonic(), list[asyncio.Task[None]]()
        for number in range(int(rate * seconds)):
            due = begun + number / rate
            await asyncio.sleep(max(0.0, due - time.monotonic()))
            task = asyncio.create_task(self.request(draw.choice(PATHS), due))
            tasks.append(task)
        self.failed = sum(
            isinstance(each, Exception) for each in await asyncio.gather(*tasks, return_exceptions=True)
        )

    async def events(self) -> None:
        """Read events, and check that their numbers follow one another."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port, limit=1 << 20)
        writer.write(f"GET /api/1/events HTTP/1.1\r\n{self.head}\r\n".encode())
        last = None
        with suppress(asyncio.CancelledError, asyncio.IncompleteReadError):
            while line := await reader.readline():
                if line.startswith(b"id: "):
                    number = int(line.rpartition(b"-")[2])
                    self.received += 1
                    if last is not None and number > last + 1:
                        self.missing += number - last - 1
                    elif last is not None and number <= last:
                        self.repeated += 1
                    last = number
        writer.close()

    async def memory(
        self, processes: dict[str, psutil.Process], found: dict[str, list[tuple[float, float]]]
    ) -> None:
        """Note time (s) and the memory of processes (MB), each ten seconds."""
        while True:
            for name, process in processes.items():
                used = process.memory_info()
                # Pages of files, such as libraries, come and go with what other processes need.
                now = time.monotonic(), (used.rss - getattr(used, "shared", 0)) / 1e6
                found.setdefault(name, []).append(now)
            await asyncio.sleep(10.0)

    async def disk(self, folder: Path) -> None:
        """Write to the disk of the archive four times a second, and again at once where it takes long."""

        def flush() -> None:
            with (folder / "probe").open("ab") as file:
                file.write(b".")
                file.flush()
                os.fsync(file.fileno())

        while True:
            begun = time.time()
            await asyncio.to_thread(flush)
            self.flushes.append((begun, time.time()))
            await asyncio.sleep(max(0.02, begun + 0.25 - time.time()))

    async def run(
        self, clients: int, rate: float, seconds: float, processes: dict[str, psutil.Process], folder: Path
    ) -> dict[str, list[tuple[float, float]]]:
        """Put the service under load; return the memory of the processes."""
        found: dict[str, list[tuple[float, float]]] = {}
        streams = [asyncio.create_task(self.events()) for _ in range(clients)]
        await asyncio.sleep(2.0)
        watches = [asyncio.create_task(each) for each in (self.memory(processes, found), self.disk(folder))]
        await self.requests(rate, seconds)
        for each in (*watches, *streams):
            each.cancel()
        await asyncio.gather(*watches, *streams, return_exceptions=True)
        return found


def load(minutes: float, clients: int, rate: float, already: int) -> int:
    """Print what the load does to the service; return 1 if a bound is not kept."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "bench.toml").write_text(BENCH)
        with serving(folder, "--bench", "bench.toml") as (port, token, service):
            http = httpx.Client(
                base_url=f"http://127.0.0.1:{port}/api/1",
                headers={"Authorization": f"Bearer {token}"},
                timeout=60,
            )
            while http.get("/benches/cellar").json()["state"] != "ready":
                time.sleep(0.1)
            plan = {"name": "load", "plan": "frames", "parameters": {"count": 1_000_000, "checks": 0}}
            http.post("/benches/cellar/sessions", json=plan).raise_for_status()
            worker = psutil.Process(
                json.loads(next((folder / "archive-service" / "workers").glob("bench-*.json")).read_text())[
                    "pid"
                ]
            )
            filled(folder, already)
            time.sleep(5.0)
            first = frames_of(folder, 0)[2]
            (folder / clocked.MISSED).unlink(missing_ok=True)
            before = {each: sum(each.cpu_times()[:2]) for each in (service, worker)}
            made = Load(port, token)
            memory = asyncio.run(
                made.run(clients, rate, 60 * minutes, {"service": service, "worker": worker}, folder)
            )
            spent = [sum(each.cpu_times()[:2]) - before[each] for each in (service, worker)]
            http.post("/benches/cellar/abort").raise_for_status()
            while http.get("/benches/cellar").json()["state"] != "ready":
                time.sleep(0.1)
        (lost, late, frames, delays), wanting = frames_of(folder, first), machine_of(folder, made.flushes)
    every = sorted(each for times in made.seconds.values() for each in times)
    p50, p99 = (1e3 * every[int(q * (len(every) - 1))] for q in (0.5, 0.99))
    print(f"{minutes:g} min, {clients} clients of events, {rate:g} requests/s, {os.cpu_count()} cores")
    print(f"requests      {len(every)}: median {p50:.0f} ms, p99 {p99:.0f} ms, "
          f"longest {1e3 * every[-1]:.0f} ms; {made.failed} failed; {dict(made.statuses)}")  # fmt: skip
    for path, times in sorted(made.seconds.items(), key=lambda item: -statistics.median(item[1])):
        times.sort()
        print(f"  {path:38} median {1e3 * statistics.median(times):6.1f} ms, "
              f"p99 {1e3 * times[int(0.99 * (len(times) - 1))]:6.1f} ms")  # fmt: skip
    print(f"events        {made.received} received, {made.missing} missing, {made.repeated} repeated")
    faults = sum(number not in wanting for number in lost + late)
    print(f"frames        {frames}: {len(lost)} lost, {len(late)} late, of these {faults} by a fault and the "
          f"others for want of processor or disk; stored after "
          f"{1e3 * statistics.median(delays):.0f} ms (median), "
          f"{1e3 * max(delays):.0f} ms (longest)")  # fmt: skip
    print(f"processor     service {1e3 * spent[0] / len(every):.1f} ms per request with events, "
          f"{spent[0] / (60 * minutes):.2f} of a core; worker {spent[1] / (60 * minutes):.2f}")  # fmt: skip
    flat = True
    for each, values in memory.items():
        quarters = [f"{statistics.median(part[:, 1]):.1f}" for part in np.array_split(np.array(values), 4)]
        grown, sigma, seconds = growth(values)
        flat &= grown < FLAT_MB
        print(f"memory        {each}: {', '.join(quarters)} MB (medians of quarters); "
              f"{grown:+.2f} ± {sigma:.2f} MB in the last {seconds / 60:.0f} min")  # fmt: skip
    kept = (
        p99 < 200
        and not (made.failed or faults or made.missing or made.repeated)
        and set(made.statuses) == {200}
    )
    print("kept" if kept and flat else "NOT KEPT")
    return 0 if kept and flat else 1


def growth(values: list[tuple[float, float]]) -> tuple[float, float, float]:
    """Growth in the second half (MB) by a straight line, its standard deviation, and the time of it (s)."""
    times, used = np.array(values[len(values) // 2 :]).T
    seconds = float(times[-1] - times[0])
    if len(times) < 4:
        return float(used[-1] - used[0]), float("inf"), seconds
    (slope, _), covariance = np.polyfit(times - times[0], used, 1, cov=True)
    return float(slope * seconds), float(np.sqrt(covariance[0, 0]) * seconds), seconds


def filled(folder: Path, count: int) -> None:
    """Give the session frames as after a long time; all are one file."""
    with Archive.open(folder / "archive") as archive:
        session = archive.session("load")
        while not (there := session.frames(kind="frame", ok=True, last=1)):
            time.sleep(0.1)
        one = there[0]
        with archive._engine.begin() as connection:
            row = {"session_id": session._id, "kind": "earlier", "take": 0, "sha256": one.sha256,
                   "size": one.size, "suffix": one.suffix, "facts": one.facts, "clock": one.clock,
                   "stored": datetime.now(UTC)}  # fmt: skip
            rows = [{"step": f"earlier {k}", **row} for k in range(count)]
            if rows:
                connection.execute(sa.insert(schema.frames), rows)
                known = connection.scalars(
                    sa.select(schema.frames.c.id).where(schema.frames.c.kind == "earlier")
                )
                verdicts = [
                    {"frame_id": each, "ok": True, "why": "", "facts": {"points": 9}} for each in known
                ]
                connection.execute(sa.insert(schema.verdicts), verdicts)


def frames_of(folder: Path, after: int) -> tuple[list[int], list[int], int, list[float]]:
    """Frames after the first ones: lost and late ones, how many are there, and the times until stored."""
    with Archive.open(folder / "archive") as archive:
        found = archive.session("load").frames(kind="frame")[after:]
        with archive._engine.connect() as connection:
            stored = dict(connection.execute(sa.select(schema.frames.c.id, schema.frames.c.stored)).all())  # type: ignore[arg-type]
    numbers = [each.clock["sequence"][0] for each in found]
    delays = []
    for each in found:
        taken = datetime.fromtimestamp(each.clock["sequence"][0] * clocked.PERIOD_S, UTC)
        at = stored[each.id]
        delays.append(((at if at.tzinfo else at.replace(tzinfo=UTC)) - taken).total_seconds())
    lost = sorted(set(range(numbers[0], numbers[-1] + 1)) - set(numbers)) if numbers else []
    late = [number for number, each in zip(numbers, delays, strict=True) if each > clocked.PERIOD_S]
    return lost, late, len(found), delays


def machine_of(folder: Path, flushes: list[tuple[float, float]]) -> set[int]:
    """Numbers of frames that would have been in time, had the worker not waited for processor or disk."""
    missed, found = folder / clocked.MISSED, set[int]()
    for row in map(json.loads, missed.read_text().splitlines() if missed.is_file() else ()):
        begun = row["after"] * clocked.PERIOD_S
        end = begun + row["gap"]
        disk = sum(max(0.0, min(end, after) - max(begun, before)) for before, after in flushes)
        print(f"missed        {row['gap']:.2f} s after frame {row['after']}, waits for a processor "
              f"{row['processor']:.2f} s, for the disk {disk:.2f} s")  # fmt: skip
        if row["gap"] - row["processor"] - disk < clocked.PERIOD_S:
            found |= set(range(row["after"], int(end / clocked.PERIOD_S) + 1))
    return found


FRAMES, CONFIGURATIONS, DECISIONS, RECORDED = 20, 5, 52, 2000
"""Frames of each session; configurations of the archive, decisions on each, and audited actions."""


def accumulated(folder: Path, count: int, decisions: int = DECISIONS, recorded: int = RECORDED) -> None:
    """Fill an archive as after years: sessions with frames and results, decisions, an audit log."""
    with Archive.open(folder / "archive", create=True) as archive:
        kept = {
            "calibration.json": archive.objects.put(example_calibration().to_json().encode(), ".json"),
            "report.html": archive.objects.put(b"<!DOCTYPE html><title>Report</title>", ".html"),
        }
        fill_index(
            archive, count, FRAMES, kept, apart=timedelta(minutes=1),
            session={"plan": "frames", "parameters": {"count": FRAMES}, "bench": ""},
            frame={"size": 1, "facts": {}, "clock": {}},
        )  # fmt: skip
        known = Configurations(archive)
        rules = AcceptanceRules(version=1, image=Limits(warning=0.1, action=0.3))
        for number in range(CONFIGURATIONS):
            known.define(f"camera {number}", {"camera": f"DMK 33, {number}"})
            for k in range(decisions):
                made = example_calibration(8.0 + 1e-5 * ((7 * k + number) % 11) + 1e-9 * k)
                since = FIRST + timedelta(weeks=k)
                decision = known.decide(f"camera {number}", made, rules, since=since, by="Ada")
                if decision.outcome == "needs review":
                    known.review(f"camera {number}", decision.key, "accepted", by="Ada", comment="first")
        audit = Audit(archive, StateFolder.beside(str(folder / "archive")))
        for k in range(recorded):
            audit.record("Ada", "login", "move", "bench cellar", {"axis": "tilt", "position": 0.1 * k})


def sessions(count: int) -> int:
    """Print the times of pages and operations over an archive with many sessions."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        accumulated(folder, count)
        begun = time.monotonic()
        with serving(folder) as (port, token, service):
            ready, spent = time.monotonic() - begun, sum(service.cpu_times()[:2])
            print(f"{count} sessions: ready after {ready:.1f} s, processor {spent:.1f} s")
            http = httpx.Client(
                base_url=f"http://127.0.0.1:{port}", headers={"Authorization": f"Bearer {token}"}, timeout=60
            )
            kept = True
            middle = quote(f"session {count // 2}")
            paths = ["/", "/sessions", f"/sessions?before={middle}", "/sessions?like=7777",
                     f"/sessions/{middle}", "/calibrations", "/calibrations/camera 1", "/compare", "/history",
                     "/files", "/account", "/audit", "/api/1/sessions?count=50",
                     f"/api/1/sessions/{middle}", "/api/1/alarms"]  # fmt: skip
            for path in paths:
                taken, used = [], []
                for _ in range(11):
                    before, began = sum(service.cpu_times()[:2]), time.monotonic()
                    http.get(path).raise_for_status()
                    taken.append(1e3 * (time.monotonic() - began))
                    used.append(1e3 * (sum(service.cpu_times()[:2]) - before))
                first, rest = taken[0], statistics.median(taken[1:])
                kept &= first < 1000 and rest < 100
                print(
                    f"  {path:36} first {first:6.0f} ms, processor {used[0]:5.0f} ms; then {rest:5.0f} ms, "
                    f"processor {statistics.mean(used[1:]):5.0f} ms"
                )
        print("kept" if kept else "NOT KEPT")
    return 0 if kept else 1


STOP_S = 0.1
"""Time from a click until the motor stands, at most."""


def stop(trials: int) -> int:
    """Print how long a stop takes until the motor stands; return 1 if it is too long, or not obeyed."""
    from tests.service.http.browser import chromium
    from tests.service.http.driver import bench_of, install

    from reseau_sims.serving.bench import SimulatedBench
    from reseau_sims.serving.motion import Motor

    stood = list[float]()
    halt = Motor.stop

    def noted(motor: Motor) -> None:
        moved = motor.moving
        halt(motor)
        if moved:
            stood.append(time.time())

    Motor.stop = noted  # type: ignore[method-assign]
    draw, obeyed = random.Random(1), True
    with tempfile.TemporaryDirectory() as name, SimulatedBench(seed=3) as sim:
        folder = Path(name)
        (folder / "bench.toml").write_text(bench_of(sim.toml))
        install(folder / "drivers")
        with serving(folder, "--bench", "bench.toml") as (port, token, _):
            base, mine = f"http://127.0.0.1:{port}", {"Authorization": f"Bearer {token}"}
            bench = f"{base}/api/1/benches/cellar"
            with httpx.Client(headers=mine, timeout=60) as http, ThreadPoolExecutor(2) as pool:
                while http.get(bench).json()["state"] != "ready":
                    time.sleep(0.1)
                for axis in ("tilt", "roll", "camera_roll"):
                    http.post(f"{bench}/home", json={"axis": axis}).raise_for_status()
                low, high = http.get(f"{bench}/axes").json()["tilt"]["limits"]
                middle = (low + high) / 2

                clients = [httpx.Client(headers=mine, timeout=60) for _ in range(2)]

                def move(position: float, number: int) -> int:
                    given = {"axis": "tilt", "position": position}
                    return clients[number].post(f"{bench}/move", json=given).status_code

                def taken(press: Callable[[], float]) -> float:
                    """Seconds from a press until the motor stands."""
                    nonlocal obeyed
                    begun = sim.laboratory.axes["tilt"]
                    moves = [pool.submit(move, high if begun < middle else low, 0)]
                    while sim.laboratory.axes["tilt"] == begun:
                        if moves[0].done():
                            raise SystemExit(f"the axis does not move: status {moves[0].result()}")
                        time.sleep(0.01)
                    moves.append(pool.submit(move, middle, 1))
                    time.sleep(draw.uniform(0.2, 0.7))
                    stood.clear()
                    pressed = press()
                    statuses = [each.result() for each in moves]
                    if statuses[0] == 200:  # it had arrived before
                        return taken(press)
                    time.sleep(0.5)  # a stop is answered when it is sent: the motor stands a little later
                    at = sim.laboratory.axes["tilt"]
                    time.sleep(0.3)
                    later = sim.laboratory.axes["tilt"]
                    good = statuses == [409, 409] and len(stood) == 1 and at == later
                    if not good:
                        print(f"statuses {statuses}, {len(stood)} stops, {at} then {later}")
                    obeyed &= good
                    return stood[0] - pressed if stood else float("inf")

                def asked() -> float:
                    now = time.time()
                    http.post(f"{bench}/stop").raise_for_status()
                    return now

                found = {"by the API": [taken(asked) for _ in range(trials)]}
                if shutil.which("chromium") and shutil.which("chromedriver"):
                    with chromium() as browser:
                        program = [sys.executable, "-c", "from reseau.cli import main; main()"]
                        link = [*program, "service", "link", "--port", str(port)]
                        browser.open(subprocess.check_output(link, cwd=folder, text=True).strip())
                        browser.open(f"{base}/benches/cellar")
                        browser.until("ready")
                        browser.run("addEventListener('click', () => { window.pressed = Date.now(); }, true)")

                        def clicked() -> float:
                            browser.click("button.stop")
                            return float(browser.run("return window.pressed")) / 1e3

                        found["by a click"] = [taken(clicked) for _ in range(trials)]
                else:
                    print("no click: needs chromium and chromedriver")
    Motor.stop = halt  # type: ignore[method-assign]
    for way, seconds in found.items():
        milliseconds = sorted(1e3 * each for each in seconds)
        print(f"{way:12} {trials} stops: median {statistics.median(milliseconds):.0f} ms, "
              f"longest {milliseconds[-1]:.0f} ms")  # fmt: skip
    kept = obeyed and max(max(each) for each in found.values()) < STOP_S
    print("kept" if kept else "NOT KEPT" if obeyed else "NOT KEPT: a movement was carried out after a stop")
    return 0 if kept else 1


STREAMS = ("/api/1/events", "/api/1/documents")
MODULES = (
    "backup,blindsql,cookieflags,crlf,csp,csrf,exec,file,htaccess,http_headers,methods,permanentxss,redirect,"
    "shellshock,sql,xss"
)
"""Of wapiti: all but those that guess names of files or passwords, and those that need a server elsewhere."""


def scan(minutes: float, tools: list[str]) -> int:
    """Print what scanners find above low; return 1 if there is something, or a scanner is missing."""
    found = list[str]()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        accumulated(folder, 20, 3, 20)
        subprocess.run(
            ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes",
             "-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1,DNS:localhost",
             "-keyout", folder / "tls.key", "-out", folder / "tls.pem"],
            check=True, capture_output=True,
        )  # fmt: skip
        with Accounts(folder / "archive-service" / "accounts.sqlite") as accounts:
            accounts.add_user("Ada", PASSWORD, "administer")
        with serving(folder, "--certificate", "tls.pem", "--key", "tls.key") as (port, _, _):
            base = f"https://localhost:{port}"
            trusted = ssl.create_default_context(cafile=folder / "tls.pem")
            with httpx.Client(base_url=base, verify=trusted, timeout=120) as http:
                given = {"name": "Ada", "password": PASSWORD}
                http.post("/api/1/login", json=given, headers={"Origin": base}).raise_for_status()
                cookie = "; ".join(f"{key}={value}" for key, value in http.cookies.items())
                api = http.get("/api/1/openapi.json").json()["paths"]
            works = {"testssl": protocol, "wapiti": pages, "slowhttptest": patience}
            for tool in tools:
                found += works[tool](folder, base, cookie, api, minutes)
    print("\n".join(found) if found else "nothing above low")
    return 1 if found else 0


def ran(folder: Path, *command: str) -> str:
    """What a scanner says; its absence is a finding."""
    print(f"$ {' '.join(command)[:150]}", flush=True)
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)
    return done.stdout + done.stderr


def protocol(folder: Path, base: str, cookie: str, api: dict[str, Any], minutes: float) -> list[str]:
    """Findings of testssl.sh; the certificate is that of the test."""
    if shutil.which("testssl") is None:
        return ["testssl is missing (apt-get install testssl.sh bind9-dnsutils)"]
    ran(folder, "testssl", "--quiet", "--jsonfile", "tls.json", "-p", "-s", "-f", "-P", "-h", "-U",
        "--ip", "127.0.0.1", base)  # fmt: skip
    rows = json.loads((folder / "tls.json").read_text())
    print(f"  {len(rows)} checks: {dict(Counter(each['severity'] for each in rows))}")
    grave = ("MEDIUM", "HIGH", "CRITICAL", "FATAL")  # WARN is about the scanner
    return [f"testssl: {each['id']}: {each['finding']}" for each in rows if each["severity"] in grave]


def pages(folder: Path, base: str, cookie: str, api: dict[str, Any], minutes: float) -> list[str]:
    """Findings of wapiti, logged in."""
    if shutil.which("wapiti") is None:
        return ["wapiti is missing (apt-get install wapiti)"]
    values = {"session": "session 1", "name": "camera 1", "number": "1", "bench": "none", "key": "first"}
    starts = []
    for path, operations in api.items():
        if "get" in operations and path not in STREAMS:
            required = [each for each in operations["get"].get("parameters", []) if each["in"] == "query"]
            query = "&".join(f"{each['name']}=1" for each in required)
            filled = re.sub(r"{(\w+)}", lambda each: quote(values.get(each[1], "1")), path)
            starts += ["-s", f"{base}{filled}{'?' if query else ''}{query}"]
    said = ran(
        folder, "wapiti", "-u", f"{base}/", *starts, "-H", f"Cookie: {cookie}", "--verify-ssl", "0",
        "-d", "6", "-m", MODULES, "--scope", "domain", "--store-session", str(folder / "wapiti"),
        "--no-bugreport", "--max-scan-time", str(int(60 * minutes)), "--max-attack-time",
        str(int(12 * minutes)), "-t", "30", "-f", "json", "-o", "wapiti.json",
    )  # fmt: skip
    if not (folder / "wapiti.json").is_file():
        return [f"wapiti: no report: {said[-300:]}"]
    report = json.loads((folder / "wapiti.json").read_text())
    print(f"  {report['infos'].get('crawled_pages', 'unknown')} pages; "
          f"{len(re.findall('Launching module', said))} modules")  # fmt: skip
    kinds = [*report["vulnerabilities"].items(), *report["anomalies"].items()]
    for kind, rows in kinds:
        for each in rows:
            print(f"  level {each['level']} {kind}: {each['method']} {each['path']}: {each['info']}")
    return [
        f"wapiti: {kind}: {each['method']} {each['path']}: {each['info']}"
        for kind, rows in kinds
        for each in rows
        if each["level"] > 1
    ]


def patience(folder: Path, base: str, cookie: str, api: dict[str, Any], minutes: float) -> list[str]:
    """Whether slowhttptest keeps others from being served."""
    if shutil.which("slowhttptest") is None:
        return ["slowhttptest is missing (apt-get install slowhttptest)"]
    found = []
    ways = {
        "slow heads": ("-H", "-i", "5", "-x", "24"),
        "slow bodies": ("-B", "-i", "5", "-s", "8192", "-x", "24"),
        "slow readers": ("-X", "-w", "512", "-y", "1024", "-n", "5", "-z", "32", "-k", "3"),
        "ranges": ("-R",),
    }
    for way, given in ways.items():
        said = ran(folder, "slowhttptest", *given, "-c", "1000", "-r", "200", "-l", "40", "-p", "10",
                   "-u", f"{base}/login")  # fmt: skip
        plain = re.sub(r"\x1b\[[0-9;]*m", "", said)
        states = re.findall(r"service available:\s*(YES|NO)", plain)
        print(f"  {way}: available {states.count('YES')} of {len(states)} times")
        if not states or "NO" in states:
            found.append(f"slowhttptest: {way} keep others from being served")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", choices=("load", "sessions", "stop", "scan"), required=True)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--clients", type=int, default=200)
    parser.add_argument("--rate", type=float, default=50.0)
    parser.add_argument("--frames", type=int, default=0)
    parser.add_argument("--sessions", type=int, default=10_000)
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--tools", default="testssl,wapiti,slowhttptest")
    given = parser.parse_args()
    if given.part == "load":
        raise SystemExit(load(given.minutes, given.clients, given.rate, given.frames))
    if given.part == "stop":
        raise SystemExit(stop(given.trials))
    if given.part == "scan":
        raise SystemExit(scan(given.minutes, given.tools.split(",")))
    raise SystemExit(sessions(given.sessions))


if __name__ == "__main__":
    main()
