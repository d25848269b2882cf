"""What users wait for: the first call after installation, imports, the demo, photographs, a roll of film.

    python benchmarks/waiting.py [DATA] [--checkout FOLDER] [--times 3] [--only import demo …]

Every command is a process of its own, of this checkout or of another one, and finds its compiled code
unless it is the first call. The photographs are those of DATA/testfield_camcal (see `camcal.py`), and for
`board` the left ones of DATA/chessboard_stereo; those of `auto` are drawn, of a ChArUco board that is not
told; DATA is by default $RESEAU_DATA or ../shared/data. The roll is five simulated scans of 300 dpi.
Printed are medians of the processor time, and the least wall time; photographs and scans are measured by
the process of the command, whose time would not contain that of others.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from statistics import median

from shared import of_the_tests
from worlds import prints
from worlds.sheets import View, pose

from reseau.designs import board
from reseau.io.images import write_image
from reseau_sims.filmframe import FilmFrame

ROOT = Path(__file__).resolve().parents[1]
RESEAU = "from reseau.cli import main; main()"


def environment(checkout: Path, cache: Path) -> dict[str, str]:
    """Variables of a command of a checkout, which keeps compiled code in a folder."""
    paths = [str(checkout / each) for each in ("src", "sims", "drivers")]
    own = {"PYTHONPATH": os.pathsep.join(paths), "NUMBA_CACHE_DIR": str(cache), "PYTHONDONTWRITEBYTECODE": ""}
    return os.environ | own


def spent(code: str, words: Sequence[str | Path], checkout: Path, cache: Path) -> tuple[float, float]:
    """Processor time and wall time (s) of a command of a checkout, with all processes that it starts."""
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, words)],
        capture_output=True, text=True, env=environment(checkout, cache),
    )  # fmt: skip
    wall = time.perf_counter() - begun
    with suppress(ChildProcessError):
        while True:  # those that outlived it; see `adopt`
            os.wait()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 3):  # 3: the result contradicts itself, and is written
        raise SystemExit(f"{' '.join(map(str, words))}: {done.stderr.strip()[-500:]}")
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall


def adopt() -> None:
    """Become the parent of processes that outlive theirs, such as the server that forks workers (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER


adopt()


def draw(folder: Path, seed: int = 1, count: int = 13) -> None:
    """Write photographs of a ChArUco board."""
    folder.mkdir(parents=True, exist_ok=True)
    sheet = prints.charuco(9, 6, 30.0, 22.0, "DICT_4X4_100")
    for k in range(count):
        view = View(sheet, *pose(100 * seed + k, sheet, nearer=1.15), seed=7777 * seed + k)
        write_image(folder / f"{k + 1:02}.png", view.picture())


def commands(data: Path, folder: Path) -> dict[str, tuple[str, list[str | Path]]]:
    """Code and words of each command, whose files are made in a folder."""
    draw(folder / "charuco")
    found: dict[str, tuple[str, list[str | Path]]] = {
        "version": (RESEAU, ["--version"]),
        "import": ("import reseau.procedures.calibration, reseau.procedures.film_frame", []),
        "demo": (RESEAU, ["demo", "--out", folder / "demo"]),
        "auto": (RESEAU, ["calibrate", folder / "charuco", "-o", folder / "charuco-camera"]),
    }
    photographs = data / "testfield_camcal"
    if photographs.is_dir():
        camcal = of_the_tests("measure/camcal.py")
        camcal.design(photographs).write(folder / "design.json")
        words = ["--pitch-mm", "0.0031911032863849768", "--channel", "green", "--jobs", "1"]
        words += ["-o", folder / "camera.json"]
        found["calibrate"] = (
            RESEAU,
            ["calibrate", *camcal.photographs(photographs), "--design", folder / "design.json", *words],
        )
    else:
        print(f"without `calibrate`: no photographs in {photographs}")
    chessboard = sorted((data / "chessboard_stereo").glob("left*.jpg"))
    if chessboard:
        board("chess", 10, 7, 25.0).write(folder / "chessboard.json")
        words = ["--jobs", "1", "-o", folder / "chessboard-camera.json"]
        found["board"] = (RESEAU, ["calibrate", *chessboard, "--design", folder / "chessboard.json", *words])
    else:
        print(f"without `board`: no photographs in {data / 'chessboard_stereo'}")
    (folder / "roll").mkdir()
    scans = [folder / "roll" / f"{number + 1:02}.png" for number in range(5)]
    for number, scan in enumerate(scans):
        write_image(scan, FilmFrame(seed=number, dpi=300).scan())
    found["orient"] = (
        RESEAU,
        ["orient", *scans, "--format-mm", "36x24", "--dpi", "300", "--jobs", "1", "--out",
         folder / "oriented"],
    )  # fmt: skip
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", nargs="?", default=os.environ.get("RESEAU_DATA", "../shared/data"), type=Path)
    parser.add_argument("--checkout", type=Path, default=ROOT, help="of which the commands are")
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--only", nargs="+", help="some of version import demo auto calibrate board orient")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for what, (code, words) in commands(given.data, folder).items():
            if given.only and what not in given.only:
                continue
            cache = folder / f"compiled for {what}"
            first, wall = spent(code, words, given.checkout, cache)
            print(f"{what:10} first call {first:6.2f} s of processor time ({wall:.2f} s)", end="", flush=True)
            each = [spent(code, words, given.checkout, cache) for _ in range(given.times)]
            then, walls = zip(*each, strict=True)
            print(f", then {median(then):6.2f} s ({min(walls):.2f} s)", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
