"""All comparisons with peers, and all measurements on images of independent origin: `make bench`.

    python benchmarks/all.py [NAME …] [--out build/bench] [--again] [--list]

Each entry is a command that runs ours and its peers in turn, in one process or after each other. What it
prints goes to a file of its own; one that has ended well for this commit is not run again, so that an
interrupted run continues where it ended. `report.md` has all of them, with the versions of the peers that are
installed, the times that the entries took, and what is missing: peers, and files of $RESEAU_DATA.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from shutil import which

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("RESEAU_DATA", ROOT.parent / "shared" / "data"))
LIMIT_S = 900


@dataclass(frozen=True)
class Entry:
    """A comparison.

    `peers` are distributions of Python or programs; without them their rows are missing. `data` is the
    folder of $RESEAU_DATA without which there is nothing to measure.
    """

    name: str
    title: str
    command: str
    peers: tuple[str, ...] = ()
    data: str = ""


ENTRIES = (
    Entry("bundle", "Bundle adjustment", "bundle.py --part peers", ("pycolmap", "g++"), "networks"),
    Entry("cameras", "Camera models", "cameras.py --part projections", ("pycolmap", "mrcal-to-cahvor")),
    Entry("calibrations", "Calibrations of the same corners", "cameras.py --part calibrations",
          ("pycolmap", "mrcal-to-cahvor"), "chessboard_stereo"),
    Entry("stereo", "Photographs of a chessboard", "stereo_chessboard.py", ("mrgingham",),
          "chessboard_stereo"),
    Entry("disks", "Disks", "testfield_peers.py", ("photutils", "trackpy", "scikit-image")),
    Entry("boards", "Testfield and sheet in images of independent origin", "boards.py", (),
          "independent/boards"),
    Entry("other-boards", "Chessboards, ChArUco, circles in images of independent origin", "other_boards.py",
          ("opencv-python-headless",), "independent/boards"),
    Entry("drawn-boards", "Boards of other programs, drawn", "drawn_boards.py --count 1", ("aprilgrid",)),
    Entry("reseau", "Reseaus in images of independent origin", "reseau_independent.py --part data", (),
          "independent/marks"),
    Entry("vidicon", "Vidicon frames, beside NASA's programs", "reseau_frames.py", (), "reseau"),
    Entry("film", "Film frames of independent origin", "film_independent.py", (), "independent/film"),
    Entry("hough", "Film frames, beside Cruz et al.", "frames.py --frames 4 --only sharp tilted"),
    Entry("oscilloscope", "Oscilloscopes of independent origin", "oscilloscope.py --part independent", (),
          "independent/oscilloscope"),
    Entry("pins", "Wires in B-mode frames, beside PLUS", "pins.py", (), "ultrasound_nwire"),
    Entry("edges", "Slanted edges, beside ISO 12233", "edge.py --edges 10"),
    Entry("blurred", "Blurred targets, drawn with batoid's rays", "blurred.py --count 2", ("batoid",)),
    Entry("rays", "Ray tracing", "raytrace.py", ("batoid", "optiland")),
    Entry("refraction", "Refraction", "multimedia.py --part cavity", (), "multimedia_cavity"),
    Entry("nist", "Certified problems of NIST", "nist.py", (), "nist_strd"),
    Entry("archive", "Archive, beside writing files", "archive.py --frames 2000 --objects 100"),
    Entry("gige", "GigE Vision", "gige.py --frames 100 --rounds 3", ("arv-tool-0.8",)),
)  # fmt: skip


def found(peer: str) -> str:
    """The version of a peer, where it is a program; nothing if it is missing."""
    try:
        return version(peer)
    except PackageNotFoundError:
        return which(peer) or ""


def commit() -> str:
    """The commit of the checkout, marked if files differ from it."""
    done = subprocess.run(
        ["git", "describe", "--always", "--dirty"], capture_output=True, text=True, cwd=ROOT, check=False
    )
    return done.stdout.strip() or "unknown"


def header(entry: Entry, at: str) -> str:
    """The first lines of an entry's file, which say what it is of."""
    lines = [f"commit {at}", f"python benchmarks/{entry.command}"]
    for peer in entry.peers:
        lines.append(f"{peer} {found(peer) or 'is not installed: its rows are missing'}")
    return "\n".join(lines) + "\n"


def run(entry: Entry, file: Path, at: str) -> str:
    """Run an entry unless it has ended well for this commit; return what became of it."""
    ended = "\nended after "
    if file.exists():
        text = file.read_text()
        if text.startswith(f"commit {at}\n") and ended in text and "dirty" not in at:
            return text.rpartition(ended)[2].strip() + ", earlier"
    if entry.data and not (DATA / entry.data).exists():
        file.write_text(header(entry, at) + f"\nskipped: {entry.data} is not in RESEAU_DATA\n")
        return f"skipped: {entry.data} is not in RESEAU_DATA"
    draft, began = file.with_suffix(".part"), time.monotonic()
    command = [sys.executable, *f"benchmarks/{entry.command}".split()]
    environment = os.environ | {"RESEAU_DATA": str(DATA), "OPENBLAS_NUM_THREADS": "1"}
    with draft.open("w") as out:
        out.write(header(entry, at) + "\n")
        out.flush()
        try:
            done = subprocess.run(
                command, stdout=out, stderr=subprocess.STDOUT, cwd=ROOT, env=environment, timeout=LIMIT_S,
                check=False,
            )  # fmt: skip
            code: int | str = done.returncode
        except subprocess.TimeoutExpired:
            code = "time limit"
        seconds = f"{time.monotonic() - began:.0f} s"
        # Some end with 1 where a figure misses its limit: that is a result.
        whole = code in (0, 1) and "Traceback" not in draft.read_text()
        out.write(f"{ended}{seconds}\n" if whole else f"\nfailed ({code}) after {seconds}\n")
    draft.replace(file)
    return seconds if whole else f"failed ({code}) after {seconds}"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench")
    parser.add_argument("--again", action="store_true", help="also what has ended well for this commit")
    parser.add_argument("--list", action="store_true")
    given = parser.parse_args()
    known = {entry.name: entry for entry in ENTRIES}
    if unknown := [name for name in given.names if name not in known]:
        parser.error(f"{unknown[0]} is not one of {', '.join(known)}")
    if given.list:
        for entry in ENTRIES:
            missing = [peer for peer in entry.peers if not found(peer)]
            print(f"{entry.name:14} {entry.title}" + (f" (without {', '.join(missing)})" if missing else ""))
        return 0
    given.out.mkdir(parents=True, exist_ok=True)
    at, failed, rows = commit(), 0, list[str]()
    for name in given.names or known:
        entry, file = known[name], given.out / f"{name}.txt"
        if given.again:
            file.unlink(missing_ok=True)
        became = run(entry, file, at)
        failed += became.startswith("failed")
        print(f"{name:14} {became}", flush=True)
        rows.append(f"## {entry.title}\n\n```\n{file.read_text().strip()}\n```\n")
    (given.out / "report.md").write_text(f"# Benchmarks of {at}\n\n" + "\n".join(rows))
    print(given.out / "report.md")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
