"""What single things cost, for estimates of more than can be run here: `docs/scale.md`.

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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import psutil
import sqlalchemy as sa
from benchmarks import scale
from filled import fill_index

from reseau.archive import Archive
from reseau.archive.objects import LocalObjects
from reseau.execution import Outputs, executor_at
from reseau.io import PhotographPoints
from reseau.procedures.exposures import photograph_reader, photographs_of
from reseau.procedures.target_measurement import measured_in_order, measurer_of

__all__ = ["part_costs"]

FRAMES_OF_A_SESSION = 36
FILES = 20_000
JOBS = 4000
PHOTOGRAPHS = 40


@dataclass(frozen=True)
class Place:
    """An archive in a folder, with its index there or in a database."""

    folder: Path
    url: str = ""

    def opened(self, *, create: bool = False) -> Archive:
        if self.url:
            return Archive.open(self.url, objects=str(self.folder), create=create)
        return Archive.open(self.folder, create=create)

    def bytes_of_index(self) -> int:
        """Size of the index, with up-to-date statistics of its tables."""
        if not self.url:
            return sum(path.stat().st_size for path in self.folder.glob("index*"))
        with sa.create_engine(self.url, isolation_level="AUTOCOMMIT").connect() as connection:
            connection.execute(sa.text("ANALYZE"))
            sizes = "SELECT sum(pg_total_relation_size(relid)) FROM pg_stat_user_tables"
            return int(connection.execute(sa.text(sizes)).scalar_one())


def spent_ms(work: Callable[[], object], times: int = 5) -> float:
    """Median processor time."""
    taken = []
    for _ in range(times):
        began = time.process_time()
        work()
        taken.append(1e3 * (time.process_time() - began))
    return median(taken)


def filled(place: Place, frames: int) -> None:
    """Fill an archive with sessions as a bench stores them."""
    position = {"tilt": 45.0, "roll": 90.0, "camera_roll": 180.0}
    facts = {"exposure_us": 20000.0, "gain": 1.0, "width": 1024, "height": 1024, "position": position}
    clock = {"taken": "2026-03-02T10:00:00.123456+00:00", "sequence": [1, 2]}
    with place.opened(create=True) as archive:
        fill_index(
            archive, frames // FRAMES_OF_A_SESSION, FRAMES_OF_A_SESSION,
            {"calibration.json": "", "report.html": ""},
            session={"plan": "testfield", "parameters": {"count": 36}, "bench": "a bench"},
            frame={"size": 1048576, "facts": facts, "clock": clock},
        )  # fmt: skip


def index(frames: int, url: str = "") -> None:
    """Print size and times of an index."""
    with tempfile.TemporaryDirectory() as name:
        place = Place(Path(name) / "archive", url)
        filled(place, frames)
        size = place.bytes_of_index()
        with place.opened() as archive:
            sessions = len(archive.sessions())
            wanted = f"session {sessions // 2}"
            found = archive.session(wanted)
            fresh = archive.begin("one more", "testfield", {})
            steps = iter(f"{k:05}" for k in range(100))
            rows: dict[str, Callable[[], object]] = {
                "opening": lambda: place.opened().close(),
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


def photographs() -> None:
    """Print what a photograph costs on its way through the store, besides measuring it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "images").mkdir()
        scale.render(folder / "images", PHOTOGRAPHS)
        files = [(path.name, path) for path in sorted((folder / "images").glob("*.png"))]
        place, spent = str(folder / "store"), list[float]()
        outputs = Outputs(place, {"compute": "points of a target"})

        def timed(each: Callable[[], list[Any]]) -> list[Any]:
            began = time.process_time()
            found = each()
            spent.append(1e3 * (time.process_time() - began) / PHOTOGRAPHS)
            return found

        sent = timed(lambda: list(photographs_of(files, photograph_reader(), store=place)[1]))
        measure = measurer_of(scale.BENCH.design)
        found = [each.found for each in measured_in_order(sent, measure)]
        texts = timed(lambda: [PhotographPoints.of(each).to_json().encode() for each in found])
        pairs = list(zip(sent, texts, strict=True))
        keys = timed(lambda: [outputs.made(each.inputs, partial(bytes, text)) for each, text in pairs])
        back = timed(lambda: [PhotographPoints.parse(outputs.read(key).decode(), where="") for key in keys])
        assert len(back) == PHOTOGRAPHS
        print(
            "a photograph of {:.0f} kB, points of {:.0f} kB: copied to the store {:.2f} ms (client), "
            "points as text {:.2f} ms and kept {:.2f} ms (worker), read {:.2f} ms (client)".format(
                files[0][1].stat().st_size / 1e3, len(texts[0]) / 1e3, *spent
            )
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


def part_costs(frames: Sequence[int], url: str = "") -> None:
    """Print the costs; with the URL of an empty database, those of an index there only."""
    if url:
        index(frames[0], url)
        return
    jobs()
    photographs()
    store()
    for count in frames:
        index(count)
