"""Work at scale: photographs on a cluster whose workers and client die, and networks of growing size.

    python benchmarks/scale.py --part cluster [--images 5000]
    python benchmarks/scale.py --part bundle [--sizes 50 160 500 1600 5000] [--memory GB]
    python benchmarks/scale.py --part costs [--frames 10000 100000 1000000] [--database URL]

`cluster` starts a Dask scheduler and two workers on this machine, and a client that measures images of a
testfield through a shared store. At a quarter of the images one worker is killed with -9, at a half the
client is, and is started again; one image ends every process that measures it. Printed are how often each
image was measured, whether the results are those of this process to the byte, what the cluster costs besides
measuring (processor time of client, scheduler and workers, from when all have started), and the memory of
client and scheduler over time. What the processes take while they wait is measured beforehand, and counted
for the time that measuring takes two workers: where the machine is busy with other things they wait longer.

`bundle` adjusts networks with the statistics of two collections of photographs, see `scale_bundle.py`.
`costs` measures what single things cost, see `scale_costs.py`.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil

from reseau.core.data import Frame
from reseau.core.failure import Failure
from reseau.core.provenance import sha256_of
from reseau.execution import Here, Outputs, executor_at
from reseau.io.images import write_image
from reseau.measure.points import Measured
from reseau.procedures.exposures import photograph_reader, photographs_of
from reseau.procedures.target_measurement import Measurer, measured_in_order, measurer_of
from reseau_sims import FieldBench, Station

ROOT = Path(__file__).resolve().parents[1]
POISON = "00777.png"
DISTINCT = 40
IDLE_S = 15.0
BENCH = FieldBench(seed=3, bend_mm=0.0).distorted(1.0)


def measured_and_logged(measure: Measurer, log: str, frame: Frame) -> Measured | Failure:
    """Measure a frame, and note its name and the processor time; one frame ends the process."""
    if frame.name == POISON:
        os._exit(1)
    began = time.process_time()
    found = measure(frame)
    line = f"{frame.name} {time.process_time() - began:.6f}\n"
    handle = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(handle, line.encode())
    os.close(handle)
    return found


def render(folder: Path, count: int) -> None:
    """Images of the testfield: some stations, each image with noise of its own."""
    stations = [Station(30.0 + 15.0 * (k % 2), 360.0 * k / DISTINCT, 90.0 * (k % 4)) for k in range(DISTINCT)]
    bases = [BENCH.record(station).pixels.astype(np.float64) for station in stations]
    for i in range(count):
        noise = np.random.default_rng(i).normal(0, 0.7, bases[0].shape)
        grey = np.clip(np.rint(bases[i % DISTINCT] + noise), 0, 255).astype(np.uint8)
        write_image(folder / f"{i:05d}.png", grey)


def client(address: str, folder: Path) -> None:
    """Measure the images of a folder; write the name and the hash of each result."""
    files = sorted((folder / "images").glob("*.png"))
    work = partial(measured_and_logged, measurer_of(BENCH.design), str(folder / "log"))
    outputs = Outputs(str(folder / "store"), {"compute": "points of a target", "design": "field"})
    _, photographs = photographs_of(
        [(path.name, path) for path in files], photograph_reader(), store=str(folder / "store")
    )
    executor = executor_at(cluster=address, store=str(folder / "store"))
    with executor, (folder / "results").open("w") as out:
        for each in measured_in_order(photographs, work, executor, outputs):
            out.write(f"{each.name} {digest(each.found)}\n")
            out.flush()


def digest(found: object) -> str:
    """The hash of image points, or the code of a failure."""
    if isinstance(found, Failure):
        return str(found.code)
    assert hasattr(found, "xy")
    return sha256_of(found.xy.tobytes() + found.cov.tobytes())  # type: ignore[attr-defined]


class Processes:
    """Scheduler, workers and client as processes, with the processor time of all that ever were."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.started = folder, list[subprocess.Popen[bytes]]()
        self.times: dict[tuple[int, float], float] = {}

    def start(self, *command: str) -> subprocess.Popen[bytes]:
        """Start a process of Python."""
        paths = [str(ROOT), *(str(ROOT / each) for each in ("src", "sims", "drivers"))]
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(paths),
            "DASK_LOGGING__DISTRIBUTED": "error",
            "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
            "DASK_DISTRIBUTED__WORKER__MEMORY__MONITOR_INTERVAL": "1s",
            "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
            "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "5s",
        }
        with (self.folder / "output").open("ab") as output:
            process = subprocess.Popen(
                [sys.executable, *command], cwd=self.folder, env=environment, stdout=output, stderr=output
            )
        self.started.append(process)
        return process

    def sample(self) -> None:
        """Note the processor time of all processes."""
        for process in self.started:
            with suppress(psutil.Error):
                top = psutil.Process(process.pid)
                for each in (top, *top.children(recursive=True)):
                    with suppress(psutil.Error):
                        used = each.cpu_times()
                        self.times[each.pid, each.create_time()] = used.user + used.system

    def idle(self) -> float:
        """Processor time (s) that all take in a second in which they do nothing."""
        time.sleep(IDLE_S)  # they may still be starting
        self.sample()
        before, began = sum(self.times.values()), time.monotonic()
        time.sleep(IDLE_S)
        self.sample()
        return (sum(self.times.values()) - before) / (time.monotonic() - began)

    def end(self) -> None:
        """End all processes."""
        for process in self.started:
            with suppress(psutil.Error):
                top = psutil.Process(process.pid)
                for each in (*top.children(recursive=True), top):
                    with suppress(psutil.Error):
                        each.kill()
            process.wait()


class Sample(NamedTuple):
    """Images measured at a time (s), processor time (s) besides measuring them, and memory (MB)."""

    done: int
    seconds: float
    besides: float
    client: float
    scheduler: float


@contextmanager
def cluster(folder: Path) -> Iterator[tuple[Processes, str]]:
    """A scheduler and two workers on this machine."""
    processes, file = Processes(folder), folder / "scheduler.json"
    try:
        processes.start(
            "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
            "--scheduler-file", str(file),
        )  # fmt: skip
        while not file.exists():
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        for _ in range(2):
            processes.start(
                "-m", "distributed.cli.dask_worker", address, "--host", "127.0.0.1", "--nthreads", "1",
                "--no-dashboard", "--local-directory", str(folder),
            )  # fmt: skip
        yield processes, address
    finally:
        processes.end()


def lines(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines()] if path.exists() else []


def worker_of(nanny: subprocess.Popen[bytes]) -> psutil.Process | None:
    """The process of a worker, below the one that watches it."""
    return max(psutil.Process(nanny.pid).children(), key=lambda each: each.memory_info().rss, default=None)


def part_cluster(count: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "images").mkdir()
        render(folder / "images", count)
        with cluster(folder) as (processes, address):
            scheduler, first = processes.started[0], processes.started[1]
            own = (str(Path(__file__)), "--part", "client", "--address", address, "--folder", str(folder))
            idle = processes.idle()
            running, began = processes.start(*own), time.monotonic()
            killed, restarted, done = False, 0.0, 0
            memory = list[Sample]()
            while running.poll() is None:
                time.sleep(0.5)
                processes.sample()
                logged = lines(folder / "log")
                done, seconds = len(logged), time.monotonic() - began
                besides = sum(processes.times.values()) - sum(float(each) for _, each in logged)
                with suppress(psutil.Error):
                    held = [psutil.Process(each.pid).memory_info().rss / 1e6 for each in (running, scheduler)]
                    # One that has ended since, and was not waited for, holds nothing.
                    if all(held):
                        memory.append(Sample(done, seconds, besides, held[0], held[1]))
                if not killed and done >= count // 4:
                    victim = worker_of(first)
                    if victim is not None:
                        victim.send_signal(signal.SIGKILL)
                        killed = True
                        print(f"worker killed after {done} images")
                if not restarted and done >= count // 2:
                    running.kill()
                    running.wait()
                    restarted = time.monotonic() - began
                    print(f"client killed after {done} images, {restarted:.0f} s; started again")
                    running = processes.start(*own)
            seconds = time.monotonic() - began
            if running.returncode:
                raise SystemExit((folder / "output").read_text()[-2000:])
        report(folder, count, seconds, idle, memory)


def report(folder: Path, count: int, seconds: float, idle: float, memory: Sequence[Sample]) -> None:
    """Print what the runs came to."""
    measured = Counter(name for name, _ in lines(folder / "log"))
    spent = sum(float(each) for _, each in lines(folder / "log"))
    results = dict(lines(folder / "results"))
    print(f"{count} images in {seconds:.0f} s; results {len(results)}")
    again = sum(each - 1 for each in measured.values())
    print(f"measured at least once: {len(measured)}; measured again after a kill: {again}")
    print(f"failed: {[f'{name}: {each}' for name, each in results.items() if len(each) < 64]}")
    some = sorted((folder / "images").glob("*.png"))[:: max(1, count // 100)]
    work = partial(measured_and_logged, measurer_of(BENCH.design), str(folder / "log of this process"))
    _, photographs = photographs_of([(path.name, path) for path in some], photograph_reader())
    began = time.process_time()
    here = {each.name: digest(each.found) for each in measured_in_order(photographs, work, Here())}
    alone = (
        time.process_time() - began - sum(float(each) for _, each in lines(folder / "log of this process"))
    )
    same = sum(results[name] == each for name, each in here.items())
    print(f"identical to those of this process: {same} of {len(here)}")
    # From the last start of the client on, when its imports are done.
    late = [each for each in memory if each.done > 0.6 * count]
    done = late[-1].done - late[0].done
    slope = (late[-1].besides - late[0].besides - idle * (late[-1].seconds - late[0].seconds)) / done
    measuring, reading = spent / sum(measured.values()), alone / len(here)
    waiting = idle * measuring / 2
    print(
        f"processor time an image: measuring {1000 * measuring:.1f} ms, reading {1000 * reading:.1f} ms, all "
        f"else {1000 * (slope - reading + waiting):.1f} ms, of which {1000 * waiting:.1f} ms while waiting"
    )
    for which in ("client", "scheduler"):
        at = [float(getattr(each, which)) for each in memory if each.done > 0]
        quarters = [at[min(len(at) - 1, len(at) * k // 4)] for k in range(1, 5)]
        print(f"memory of {which} at each quarter: " + ", ".join(f"{each:.0f}" for each in quarters) + " MB")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", choices=("cluster", "client", "bundle", "costs"), required=True)
    parser.add_argument("--images", type=int, default=5000)
    parser.add_argument("--frames", nargs="+", type=int, default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--database", default="", help="URL of an empty database for the index")
    parser.add_argument("--kinds", nargs="+", choices=("ladybug", "venice"), default=["ladybug", "venice"])
    parser.add_argument("--sizes", nargs="+", type=int, default=[50, 160, 500, 1600, 5000])
    parser.add_argument("--memory", type=float, help="GB that normal equations may take")
    parser.add_argument("--no-peer", action="store_true", help="without Ceres and COLMAP")
    parser.add_argument("--longest", type=float, default=3600.0, help="seconds for each network and program")
    parser.add_argument("--address", default="", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, default=Path(), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.part == "client":
        # By its importable name: the workers look the function up there.
        from benchmarks import scale

        scale.client(given.address, given.folder)
    elif given.part == "bundle":
        from scale_bundle import part_bundle

        peers, longest = not given.no_peer, given.longest
        part_bundle(given.kinds, given.sizes, given.memory, peers=peers, longest_s=longest)
    elif given.part == "costs":
        from scale_costs import part_costs

        part_costs(given.frames, given.database)
    else:
        part_cluster(given.images)


if __name__ == "__main__":
    main()
