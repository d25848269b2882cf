"""What single things cost, for estimates of more than can be run here: `docs/benchmarks.md`.

Run as ``python benchmarks/scale.py --part costs [--frames 10000 100000 1000000]``. Measured are an index
(SQLite) with that many frames, in sessions of 36 with a verdict for each frame and two results for each
session: its bytes, and milliseconds for its questions; files of a store: milliseconds to write one and to
list one; jobs of a cluster that do nothing: milliseconds of the processes of Dask, and bytes that scheduler
and client keep. Times are processor times, because the machine may be busy.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime, timedelta
from itertools import islice
from pathlib import Path
from statistics import median

import psutil
import sqlalchemy as sa
from benchmarks import scale

from reseau.archive import Archive, schema
from reseau.archive.objects import LocalObjects
from reseau.execution import executor_at

__all__ = ["part_costs"]

FRAMES_OF_A_SESSION = 36
FILES = 20_000
JOBS = 4000


def spent_ms(work: Callable[[], object], times: int = 5) -> float:
    """Median processor time."""
    taken = []
    for _ in range(times):
        began = time.process_time()
        work()
        taken.append(1e3 * (time.process_time() - began))
    return median(taken)


def filled(folder: Path, frames: int) -> None:
    """An archive with sessions as a bench stores them, without their files."""
    at, count = datetime(2026, 3, 2, tzinfo=UTC), frames // FRAMES_OF_A_SESSION
    numbers = range(1, count + 1)
    position = {"tilt": 45.0, "roll": 90.0, "camera_roll": 180.0}
    facts = {"exposure_us": 20000.0, "gain": 1.0, "width": 1024, "height": 1024, "position": position}
    clock = {"taken": "2026-03-02T10:00:00.123456+00:00", "sequence": [1, 2]}
    frame = {"kind": "frame", "take": 0, "suffix": ".tif", "size": 1048576, "facts": facts, "clock": clock}
    session = {"plan": "testfield", "parameters": {"count": 36}, "bench": "a bench", "software": "0.2.0"}
    result = {"parameters": {}, "software": "0.2.0", "size": 60000, "stored": at}
    rows: dict[sa.Table, Iterator[dict[str, object]]] = {
        schema.sessions: (
            {"name": f"session {k}", "begun": at + timedelta(hours=k), **session} for k in numbers
        ),
        schema.ends: ({"session_id": k, "status": "done", "why": "", "at": at} for k in numbers),
        schema.frames: (
            {"session_id": k, "step": f"{n:05}", "sha256": f"{k * 1000 + n:064x}", "stored": at, **frame}
            for k in numbers for n in range(FRAMES_OF_A_SESSION)
        ),
        schema.verdicts: (
            {"frame_id": k, "ok": True, "why": "", "facts": {"points": 380}}
            for k in range(1, count * FRAMES_OF_A_SESSION + 1)
        ),
        schema.results: (
            {"session_id": k, "name": name, "suffix": Path(name).suffix, "sha256": f"{k:064x}", **result}
            for k in numbers for name in ("calibration.json", "report.html")
        ),
    }  # fmt: skip
    with Archive.open(folder, create=True) as archive, archive._engine.begin() as connection:
        for table, each in rows.items():
            while part := list(islice(each, 5000)):
                connection.execute(sa.insert(table), part)


def index(frames: int) -> None:
    """Print size and times of an index."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "archive"
        filled(folder, frames)
        size = sum(path.stat().st_size for path in folder.glob("index*"))
        with Archive.open(folder) as archive:
            sessions = len(archive.sessions())
            wanted = f"session {sessions // 2}"
            found = archive.session(wanted)
            fresh = archive.begin("one more", "testfield", {})
            steps = iter(f"{k:05}" for k in range(100))
            rows = {
                "opening": lambda: Archive.open(folder).close(),
                "all sessions": archive.sessions,
                "one session": lambda: archive.session(wanted),
                "its frames": found.frames,
                "one of them": lambda: found.find("00020"),
                "storing one": lambda: fresh.store(next(steps), b"a", suffix=".bin"),
            }
            times = ", ".join(f"{what} {spent_ms(work):.1f} ms" for what, work in rows.items())
        print(f"index of {frames} frames in {sessions} sessions: {size / frames:.0f} bytes a frame; {times}")


def store() -> None:
    """Print the times of files in a store."""
    with tempfile.TemporaryDirectory() as name:
        objects = LocalObjects(Path(name), durable=False)
        began = time.process_time()
        for k in range(FILES):
            objects.put(b"%d" % k, ".json")
        put = time.process_time() - began
        listing = spent_ms(lambda: sum(1 for _ in objects.names()), 3)
        print(
            f"store of {FILES} small files: writing one {1e3 * put / FILES:.2f} ms, listing "
            f"{1e3 * listing / FILES:.1f} µs a file"
        )


def jobs() -> None:
    """Print what jobs cost that do nothing."""
    with tempfile.TemporaryDirectory() as name, scale.cluster(Path(name)) as (processes, address):
        idle = processes.idle()
        roles = ("scheduler", "worker", "worker")
        tops = [psutil.Process(each.pid) for each in processes.started]
        with executor_at(cluster=address, store=str(Path(name) / "store")) as executor:
            warm = dict(executor.outcomes(abs, ((f"warm {k}", k) for k in range(500))))
            assert len(warm) == 500
            processes.sample()
            before, own, clock = dict(processes.times), time.process_time(), time.monotonic()
            held = [each.memory_info().rss for each in (tops[0], psutil.Process(os.getpid()))]
            found = sum(1 for _ in executor.outcomes(abs, ((f"job {k}", k) for k in range(JOBS))))
            assert found == JOBS
            own, seconds = time.process_time() - own, time.monotonic() - clock
            processes.sample()
            more = [each.memory_info().rss for each in (tops[0], psutil.Process(os.getpid()))]
        used = dict.fromkeys(roles, 0.0)
        for (pid, started), after in processes.times.items():
            part = next((role for role, top in zip(roles, tops, strict=True) if pid == top.pid), "worker")
            used[part] += after - before.get((pid, started), 0.0)
        used["client"] = own
        text = ", ".join(f"{role} {1e3 * each / JOBS:.2f} ms" for role, each in used.items())
        grown = ", ".join(
            f"{role} {(b - a) / JOBS:.0f}"
            for role, a, b in zip(("scheduler", "client"), held, more, strict=True)
        )
        print(
            f"{JOBS} jobs that do nothing in {seconds:.1f} s: {text} a job ({1e3 * idle:.0f} ms a second "
            f"while waiting); bytes kept for a job: {grown}"
        )


def part_costs(frames: Sequence[int]) -> None:
    """Print the costs."""
    jobs()
    store()
    for count in frames:
        index(count)
