"""Time, memory and accuracy of the main jobs, commit by commit; a loss is a failed check.

    python benchmarks/history.py record      measure the checkout, append it to benchmarks/history.jsonl
    python benchmarks/history.py compare     measure it, compare it with the records (`make bench-compare`)
    python benchmarks/history.py run JOB     one job, as a process of its own

Each job is a process of its own: a first run that loads compiled code, then as many as fit into some seconds.
Recorded are the median of the processor times, their spread, the peak of the memory, and figures of accuracy
against the truth of the simulation, which do not depend on the machine. Machines differ: before and after
each job a fixed computation is timed, and times are given in its unit, `work`. The unit of jobs that start a
process is a start of Python itself, timed in turn with them: on a busy machine processes that read many files
and begin with empty caches take half as much again, and computations do not.

A time counts as a loss if it is 10 % above the median of the last records and the difference is three times
the spread of both; memory and accuracy if they are 10 % above. A loss that is wanted is explained in
benchmarks/explained.toml:

    [[explained]]
    job = "testfield"
    figure = "time"
    commit = "0123abc"        # the last record before
    reason = "why"

Once there is a record with the explained loss, figures are compared with that and later ones.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
HISTORY = Path(__file__).with_name("history.jsonl")
EXPLAINED = Path(__file__).with_name("explained.toml")
LOSS, SIGMAS, LAST = 0.10, 3.0, 5
SECONDS, LEAST, MOST = 6.0, 5, 40

Accuracy = dict[str, float]
Job = Callable[[], Callable[[], Accuracy]]
"""Prepares a job, and returns the function that is timed; it returns errors, in their units."""


def testfield() -> Callable[[], Accuracy]:
    """Measure the coded testfield in an image of 240 × 240 pixels."""
    from reseau.measure import measure_testfield
    from reseau_sims import FieldBench, Station

    bench = FieldBench(seed=3, bend_mm=0.0)
    station = Station(30.0, 45.0, 45.0)
    frame, truth = bench.record(station), bench.truth(station)

    def run() -> Accuracy:
        found = measure_testfield(frame, bench.design)
        assert found, found
        return {"rms_px": _rms(found.points, truth.names, truth.xy)}

    return run


def reseau() -> Callable[[], Accuracy]:
    """Measure 208 crosses in an image of 800 × 800 pixels."""
    formed = _formed()
    scene = formed.Scene(mark=formed.MARKS["cross"])
    frame = formed.form(scene, np.random.default_rng(0))

    def run() -> Accuracy:
        found = formed.measured(scene, frame)
        return {"missed": float(len(frame.design.points) - found.found)}

    return run


def film() -> Callable[[], Accuracy]:
    """Orient a scanned film frame by its edges."""
    from reseau.io.scans import scan_of
    from reseau.procedures.film_frame import FrameOptions, orient_frames
    from reseau_sims.filmframe import FilmFrame

    frame = FilmFrame(seed=4)
    pixels = frame.scan()
    options = FrameOptions(formats=(frame.format[:2],))

    def run() -> Accuracy:
        found = orient_frames(scan_of(pixels, dpi=frame.dpi), options)[0]
        assert found.lines is not None
        return {"rms_px": float(np.sqrt(np.mean((found.lines.corners - frame.truth.corners) ** 2)))}

    return run


def calibration() -> Callable[[], Accuracy]:
    """Calibrate a camera from measured points of 36 images."""
    from reseau.core.data import ImagePoints
    from reseau.procedures.calibration import calibrate_camera
    from reseau.procedures.calibration_options import CameraOptions
    from reseau.procedures.target_measurement import measurer_of
    from reseau_sims import FieldBench, paper_stations

    bench, rng = FieldBench(seed=3, bend_mm=0.0).distorted(1.0), np.random.default_rng(0)
    images = []
    for k, station in enumerate(paper_stations()):
        truth = bench.truth(station)
        rows = np.flatnonzero(bench.inside(truth, 8.0))
        names = [truth.names[j] for j in rows]
        xy = truth.xy[rows] + 0.005 * rng.normal(size=(len(rows), 2))
        images.append((f"{k:02d}", ImagePoints.with_sigma(names, xy, 0.005)))
    measure = measurer_of(bench.design)
    model = CameraOptions("brown", ("c", "x0", "y0", "K1"), (0.027, 0.027))
    true = dict(zip(bench.camera.names, bench.camera.values, strict=True))

    def run() -> Accuracy:
        found = calibrate_camera(images, bench.design, measure, (240, 240), model).required()
        names, _, values = found.result.camera_columns(0)
        at = dict(zip(names, values, strict=True))
        return {"c_mm": abs(float(at["c"] - true["c"]))}

    return run


def archive() -> Callable[[], Accuracy]:
    """Store thirty frames of a megapixel durably."""
    from reseau.archive import Archive
    from reseau.core.data import Frame

    rng, folder = np.random.default_rng(0), tempfile.mkdtemp()
    frames = [Frame(rng.integers(0, 255, (1024, 1024)).astype(np.uint8), 255.0, f"{k}") for k in range(30)]
    count = iter(range(10_000))

    def run() -> Accuracy:
        with Archive.open(Path(folder) / f"{next(count)}", create=True) as place:
            session = place.begin("s", "own", {})
            for frame in frames:
                session.store(frame.name, frame)
        return {}

    return run


def command() -> Callable[[], Accuracy]:
    """Start the command line, in a process of its own."""
    return lambda: _started("from reseau.cli import run; run(['--version'])")


def imports() -> Callable[[], Accuracy]:
    """Import what calibrates a camera, in a process of its own."""
    return lambda: _started("import reseau.procedures.calibration")


JOBS: dict[str, Job] = {
    each.__name__: each for each in (testfield, reseau, film, calibration, archive, command, imports)
}
STARTED = {"command", "imports"}
"""Jobs that start processes, whose unit is a start of Python."""


def _rms(points: Any, names: tuple[str, ...], xy: Any) -> float:
    row = {name: k for k, name in enumerate(names)}
    return float(np.sqrt(np.mean((points.xy - xy[[row[name] for name in points.names]]) ** 2)))


@cache
def _formed() -> Any:
    sys.path.insert(0, str(Path(__file__).parent))
    from shared import of_the_tests

    return of_the_tests("measure/formed.py")


def _started(code: str) -> Accuracy:
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    return {}


def _processor_s() -> float:
    """Processor time of this process and of those that it has started and seen end."""
    used = [resource.getrusage(each) for each in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def work_s() -> float:
    """Processor time of a fixed computation, partly in NumPy and partly in Python: the machine's unit."""
    rng = np.random.default_rng(0)
    a, times = rng.normal(size=(160, 160)), []
    for _ in range(7):
        began = time.process_time()
        for _ in range(12):
            np.linalg.solve(a @ a.T + np.eye(160), a)
        sum(k * k % 7 for k in range(150_000))
        times.append(time.process_time() - began)
    return min(times)


def start_s() -> float:
    """Processor time of a start of Python with some of its own modules."""
    began = _processor_s()
    _started("import argparse, asyncio, dataclasses, email.message, inspect, json, typing, unittest, xml.dom")
    return _processor_s() - began


def run(name: str) -> None:
    """Do a job until some seconds are over; print its figures as JSON."""
    before, job = work_s(), JOBS[name]()
    job()
    taken, units, accuracy, end = list[float](), list[float](), Accuracy(), time.monotonic() + SECONDS
    while len(taken) < LEAST or (time.monotonic() < end and len(taken) < MOST):
        began = _processor_s()
        accuracy = job()
        taken.append(_processor_s() - began)
        if name in STARTED:
            units.append(start_s())
    units = units or [min(before, work_s())] * len(taken)
    ratios = [each / unit for each, unit in zip(taken, units, strict=True)]
    middle = statistics.median(ratios)
    spread = 1.4826 * statistics.median(abs(each - middle) for each in ratios) / len(taken) ** 0.5
    used = [resource.getrusage(each) for each in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    peak = max(each.ru_maxrss for each in used)
    print(
        json.dumps(
            {
                "time": round(middle, 4), "spread": round(1.25 * spread, 4),
                "seconds": round(statistics.median(taken), 4), "memory": round(peak / 1024, 1), **accuracy,
            }
        )
    )  # fmt: skip


@dataclass(frozen=True)
class Loss:
    """A figure that is larger than it was."""

    job: str
    figure: str
    before: float
    now: float
    commit: str

    def __str__(self) -> str:
        return f"{self.job}: {self.figure} {self.before:.4g} -> {self.now:.4g} (since {self.commit})"


def measured(jobs: list[str]) -> dict[str, dict[str, float]]:
    """The figures of jobs, each measured in a process of its own."""
    found = {}
    for name in jobs:
        command = [sys.executable, str(Path(__file__)), "run", name]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        if done.returncode:
            raise SystemExit(f"{name}: {done.stderr.strip().splitlines()[-1]}")
        found[name] = json.loads(done.stdout)
        print(f"{name:12} {_row(found[name])}", flush=True)
    return found


def _row(figures: dict[str, float]) -> str:
    rest = {key: each for key, each in figures.items() if key not in ("time", "spread", "seconds", "memory")}
    text = f"{figures['time']:8.2f} ± {figures['spread']:.2f} work  {1000 * figures['seconds']:8.1f} ms  "
    return text + f"{figures['memory']:6.0f} MB  " + "  ".join(f"{k} {v:.4g}" for k, v in rest.items())


def records() -> list[dict[str, Any]]:
    """What was recorded, the oldest first."""
    return [json.loads(line) for line in HISTORY.read_text().splitlines()] if HISTORY.exists() else []


def losses(
    before: list[dict[str, Any]], now: dict[str, dict[str, float]], reasons: dict[tuple[str, str, str], str]
) -> list[Loss]:
    """Figures that are worse than in the last records, beyond the noise.

    Records up to a loss that was explained no longer count once there are later ones.
    """
    found = []
    for job, figures in now.items():
        for key, value in figures.items():
            if key in ("spread", "seconds"):
                continue
            known = [each for each in before if key in each["jobs"].get(job, {})]
            begin = max(
                (k + 1 for k, each in enumerate(known) if (job, key, each["commit"]) in reasons), default=0
            )
            earlier = [each["jobs"][job] for each in (known[begin:] or known)[-LAST:]]
            values = [each[key] for each in earlier]
            if not values:
                continue
            usual, noise = statistics.median(values), 0.0
            if key == "time":
                # Between records of one code: other processes, other versions of libraries. A record with a
                # loss is no scatter: by the median, it does not hide itself or the next one.
                scatter = 1.4826 * statistics.median(abs(each - usual) for each in values)
                noise = float(np.hypot(figures["spread"], max(scatter, earlier[-1]["spread"])))
            if value > (1 + LOSS) * usual and value - usual > SIGMAS * noise + 1e-9:
                found.append(Loss(job, key, usual, value, known[-1]["commit"]))
    return found


def explanations() -> dict[tuple[str, str, str], str]:
    """The reasons that were given for losses, by job, figure and the last commit before.

    Raises
    ------
    SystemExit
        When an entry is incomplete: it would explain nothing, or everything.
    """
    if not EXPLAINED.exists():
        return {}
    found = {}
    for number, each in enumerate(tomllib.loads(EXPLAINED.read_text()).get("explained", []), 1):
        missing = [key for key in ("job", "figure", "commit", "reason") if not each.get(key)]
        if missing or each["job"] not in JOBS:
            why = f"has no {missing[0]}" if missing else f"names no job: {each['job']}"
            raise SystemExit(f"{EXPLAINED}: entry {number} {why}")
        found[each["job"], each["figure"], each["commit"]] = str(each["reason"])
    return found


def compare(jobs: list[str]) -> int:
    """Compare jobs with the records; return 1 where there is a loss that is not explained."""
    before, reasons = records(), explanations()
    if not before:
        print("nothing was recorded yet: python benchmarks/history.py record")
        return 1
    now = measured(jobs)
    # A loss on a machine that does something else at the time: what seems worse is measured once more.
    doubtful = sorted({each.job for each in losses(before, now, reasons)})
    if doubtful:
        print("measured again:")
        again = measured(doubtful)
        now |= {job: min(now[job], again[job], key=lambda each: each["time"]) for job in doubtful}
    failed = 0
    for loss in losses(before, now, reasons):
        reason = reasons.get((loss.job, loss.figure, loss.commit), "")
        failed += not reason
        print(f"{'explained' if reason else 'LOSS'}: {loss}" + (f": {reason}" if reason else ""))
    print(f"{failed} losses that are not explained")
    return 1 if failed else 0


def commit() -> str:
    """The commit of the checkout."""
    done = subprocess.run(["git", "rev-parse", "--short=7", "HEAD"], capture_output=True, text=True, cwd=ROOT)
    return done.stdout.strip() or "unknown"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("record", "compare", "run"))
    parser.add_argument("jobs", nargs="*", help=f"jobs, by default all: {', '.join(JOBS)}")
    given = parser.parse_args()
    if unknown := [each for each in given.jobs if each not in JOBS]:
        parser.error(f"{unknown[0]} is not one of {', '.join(JOBS)}")
    if given.what == "run":
        run(given.jobs[0])
        return 0
    jobs = given.jobs or list(JOBS)
    if given.what == "compare":
        return compare(jobs)
    entry: dict[str, Any] = {"commit": commit(), "python": sys.version.split()[0], "numpy": np.__version__}
    entry["jobs"] = measured(jobs)
    with HISTORY.open("a") as stream:
        stream.write(json.dumps(entry) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
