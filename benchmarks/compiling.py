"""What a new user waits for: compiling and importing, in units of a plain Python loop.

    python benchmarks/compiling.py [--checkout FOLDER] [--times 3] [--only calibrate demo import]
        [--seed 1] [--draw FOLDER] [--table]

The unit is the processor time of 20 million additions by a loop in a Python function, timed between the
other figures of the same run. `calibrate` is ``reseau calibrate`` of 13 photographs of a ChArUco board,
whose design is looked for; `demo` is ``reseau demo``. Each runs once with an empty store of machine
code and then as many times as asked with what is there: the difference is compiling, all processes
counted, and `bytes` is what the store then holds. Every command is a process of its own, of this
checkout or of another one. `import` is the time of importing ``reseau.calibrate`` and these four over
that of NumPy, OpenCV, Numba and ``scipy.linalg`` alone; the same for all modules that are there when
``reseau.calibrate(photographs)`` has returned, so that what is only put off counts; and the time with
one trivial function compiled.

With ``--table``, every compiled function of the jobs is listed with the seconds that its compilation takes
where the functions above it are compiled, and with those of the kernels in it. ``--draw`` writes the
photographs into a folder, and nothing else.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from waiting import RESEAU, ROOT, draw, environment, spent

ALONE = "import numpy, cv2, numba, scipy.linalg"
OWN = ALONE + "; import reseau; reseau.calibrate"
LOADED = "import reseau, sys; reseau.calibrate(sys.argv[1]); print(*sys.modules)"
ALL = """
import sys
from importlib import import_module
for name in open(sys.argv[1]).read().split():
    own = {"__main__", "__mp_main__"}
    if name.partition(".")[0] not in sys.stdlib_module_names | own: import_module(name)
"""
TRIVIAL = ALONE + "\nnumba.njit(lambda x: x + 1)(1)"
TABLE = """
import json, sys, time
from numba.core import event
from reseau.core.compiled import named, types_of
spent, stack = {}, []
class Listener(event.Listener):
    def on_start(self, event): stack.append([time.process_time(), 0.0])
    def on_end(self, event):
        begun, within = stack.pop()
        whole = time.process_time() - begun
        if stack: stack[-1][1] += whole
        name = event.data["dispatcher"].py_func
        row = spent.setdefault(f"{name.__module__}:{name.__name__}", [0, 0.0, 0.0])
        row[0] += 1; row[1] += whole; row[2] += whole - within
event.register("numba:compile", Listener())
for loop in json.load(open(sys.argv[1])):
    named(loop["function"], loop["slots"]).compile(types_of(loop["arguments"]))
print(json.dumps(spent))
"""


def counted() -> int:
    """Add twenty million numbers; the unit of time."""
    total = 0
    for i in range(20_000_000):
        total += i
    return total


def unit() -> float:
    """Processor time (s) of the plain loop."""
    begun = time.process_time()
    counted()
    return time.process_time() - begun


def stored(cache: Path) -> list[Path]:
    """Files of machine code in a store."""
    return sorted((cache / "reseau").glob("*.nbc"))


def table(files: Sequence[Path], checkout: Path, folder: Path) -> None:
    """Print the seconds of each function of a store, compiled once more."""
    loops = folder / "loops.json"
    loops.write_text(json.dumps([json.loads(path.open("rb").readline()) for path in files]))
    done = subprocess.run(
        [sys.executable, "-c", TABLE, str(loops)],
        capture_output=True, text=True, check=True, env=environment(checkout, folder / "again"),
    )  # fmt: skip
    rows = json.loads(done.stdout)
    print(f"{'function':64} times  whole s  own s")
    for name, (times, whole, own) in sorted(rows.items(), key=lambda row: -row[1][2]):
        print(f"{name:64} {times:5} {whole:8.2f} {own:6.2f}")
    print(f"{'all':64} {sum(r[0] for r in rows.values()):5} {'':8} {sum(r[2] for r in rows.values()):6.2f}")


def imports(checkout: Path, photographs: Path, folder: Path, times: int) -> None:
    """Print the time of imports."""
    done = subprocess.run(
        [sys.executable, "-c", LOADED, str(photographs)],
        capture_output=True, text=True, check=True, env=environment(checkout, folder / "imports"),
    )  # fmt: skip
    names = folder / "modules.txt"
    names.write_text(done.stdout)
    codes = {ALONE: [], OWN: [], ALL: [names], TRIVIAL: []}
    each = [
        [spent(code, words, checkout, folder)[0] for code, words in codes.items()] for _ in range(times + 1)
    ]
    alone, own, whole, trivial = map(median, zip(*each[1:], strict=True))
    print(
        f"import     {own / alone:.2f} × {alone:.2f} s of NumPy, OpenCV, Numba, scipy.linalg; all that a "
        f"calibration loads {whole / alone:.2f} ×; one trivial function compiled {trivial / alone:.2f} ×",
        flush=True,
    )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--checkout", type=Path, default=ROOT, help="of which the commands are")
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--only", nargs="+", default=["import", "calibrate", "demo"])
    parser.add_argument("--seed", type=int, default=1, help="of the photographs")
    parser.add_argument("--draw", type=Path, help="folder of the photographs, and nothing else")
    parser.add_argument("--table", action="store_true", help="with the seconds of each compiled function")
    given = parser.parse_args()
    if given.draw:
        draw(given.draw, given.seed)
        return 0
    units = [unit()]

    def cost(code: str, words: Sequence[str | Path], cache: Path) -> float:
        units.append(unit())
        return spent(code, words, given.checkout, cache)[0]

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        photographs = folder / "photographs"
        draw(photographs, given.seed)
        if "import" in given.only:
            imports(given.checkout, photographs, folder, given.times)
        commands = {
            "calibrate": ["calibrate", photographs, "-o", folder / "camera"],
            "demo": ["demo", "--out", folder / "demo"],
        }
        for job, words in commands.items():
            if job not in given.only:
                continue
            cache = folder / job
            first = cost(RESEAU, words, cache)
            files, warm = stored(cache), [cost(RESEAU, words, cache) for _ in range(given.times)]
            own, size = median(units), sum(path.stat().st_size for path in files)
            print(
                f"{job:10} compiling {(first - median(warm)) / own:5.1f} (first {first:.1f} s, then "
                f"{median(warm):.2f} s = {median(warm) / own:.1f}), {len(files)} functions, {size} bytes",
                flush=True,
            )
            if given.table:
                table(files, given.checkout, folder / job)
    print(f"unit       {median(units):6.2f} s ({min(units):.2f} to {max(units):.2f})")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
