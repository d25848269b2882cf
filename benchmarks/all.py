"""All comparisons with peers, and all measurements on images of independent origin: `make bench`.

    python benchmarks/all.py [NAME …] [--out build/bench] [--again] [--list] [--write]

Each entry is a command that runs ours and its peers in turn, in one process or after each other. What it
prints goes to a file of its own, `NAME.txt`, and its figures to `NAME.json` (see `figures`); one that has
ended well for this code is not run again, so that an interrupted run continues where it ended. `report.md`
has all that was printed, with the versions of the peers that are installed, the times that the entries took,
and what is missing: peers, and files of $RESEAU_DATA.

With `--write` the figures go to `benchmarks/figures.json`, and from there the tables to the pages
docs/benchmarks/peers*.md and the pictures to docs/images. Entries that were skipped or have failed keep there
what was recorded before. With `--list` nothing is run.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from shutil import which
from typing import Any

from figures import BOUND, ORIGIN, RECORDED, Figure, markdown, read, recorded

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("RESEAU_DATA", ROOT.parent / "shared" / "data"))
PAGES = ROOT / "docs" / "benchmarks"
CODE = ("src", "sims", "drivers", "benchmarks", *(f":!benchmarks/{each}" for each in (
    "figures.json", "history.jsonl", "explained.toml")))  # fmt: skip
"""What the figures depend on: when only something else changes, entries are not run again."""
LIMIT_S = 900
PEERS = {
    "Ceres": "libceres-dev",
    "COLMAP": "pycolmap",
    "SciPy": "scipy",
    "OpenCV": "opencv-python-headless",
    "mrcal": "python3-mrcal",
    "mrgingham": "mrgingham",
    "AprilTag": "pupil-apriltags",
    "aprilgrid": "aprilgrid",
    "photutils": "photutils",
    "trackpy": "trackpy",
    "scikit-image": "scikit-image",
    "batoid": "batoid",
    "optiland": "optiland",
    "AquaCal": "aquacal",
    "Aravis": "aravis-tools",
    "lxi": "lxi-tools",
    "pyvisa-py": "pyvisa-py",
}
"""Packages of the peers, of PyPI or of Debian."""


@dataclass(frozen=True)
class Entry:
    """A comparison.

    `peers` are keys of `PEERS`; without them their rows are missing. `data` is the folder of $RESEAU_DATA
    without which there is nothing to measure.
    """

    name: str
    title: str
    command: str
    peers: tuple[str, ...] = ()
    data: str = ""


ENTRIES = (
    Entry("bundle", "Bundle adjustment", "bundle.py --part peers", ("Ceres", "COLMAP", "SciPy"), "networks"),
    Entry("cameras", "Camera models", "cameras.py --part projections", ("OpenCV", "mrcal", "COLMAP")),
    Entry("calibrations", "Calibrations of the same corners", "cameras.py --part calibrations",
          ("OpenCV", "mrcal", "COLMAP"), "chessboard_stereo"),
    Entry("degenerate", "Networks of a camera that only turned, or nearly", "degenerate.py --count 200"),
    Entry("critical", "Networks with several solutions, or nearly", "critical.py --count 100"),
    Entry("causes", "Causes of misfit that are named", "causes.py --sound 100"),
    Entry("intervals", "Intervals with errors that images have in common",
          "intervals.py --seeds 40 --images 6 20"),
    Entry("halves", "Halves of sets of photographs that others took", "halves.py", ("OpenCV", "mrcal")),
    Entry("model-choice", "Camera models that are chosen", "model_choice.py", ("OpenCV",)),
    Entry("next-photograph", "The photograph that a calibration proposes, beside the best by brute force",
          "next_photograph.py --first 40 --seeds 8", ("OpenCV",)),
    Entry("stereo", "Photographs of a chessboard", "stereo_chessboard.py", ("OpenCV", "mrgingham"),
          "chessboard_stereo"),
    Entry("disks", "Disks", "testfield_peers.py", ("OpenCV", "photutils", "trackpy", "scikit-image")),
    Entry("testfield", "Coded testfield in the simulator's images", "testfield.py"),
    Entry("boards", "Testfield and sheet in images of independent origin", "boards.py", (),
          "independent/boards"),
    Entry("other-boards", "Chessboards, ChArUco, circles in images of independent origin", "other_boards.py",
          ("OpenCV",), "independent/boards"),
    Entry("drawn-boards", "Boards of other programs, drawn", "drawn_boards.py --count 1",
          ("OpenCV", "aprilgrid", "AprilTag", "mrgingham")),
    Entry("reseau-simulated", "Reseaus in the simulator's images",
          'reseau_formed.py --least 400 --only "dark, 40 dB"'),
    Entry("reseau", "Reseaus in images of independent origin", "reseau_independent.py --part data", (),
          "independent/marks"),
    Entry("vidicon", "Vidicon frames, beside NASA's programs", "reseau_frames.py", (), "reseau"),
    Entry("hough", "Film frames of the simulator, beside a Hough method (Cruz et al.)",
          "frames.py --frames 4 --only sharp tilt focus perforations"),
    Entry("film", "Film frames of independent origin", "film_independent.py", (), "independent/film"),
    Entry("fiducials", "Fiducial marks of any shape, drawn by another renderer; three in ten are negatives",
          "fiducials.py --kind shapes --count 4"),
    Entry("fiducials-learnt", "Fiducial marks learnt from one scan, and measured in another one",
          "fiducials.py --learn --count 1"),
    Entry("oscilloscope-simulated", "Oscilloscopes of the simulator",
          "oscilloscope.py --frames 6 --polynomial 0 --draws 0 --jobs 2"),
    Entry("oscilloscope", "Oscilloscopes of independent origin", "oscilloscope.py --part independent", (),
          "independent/oscilloscope"),
    Entry("pins", "Wires in B-mode frames, beside PLUS", "pins.py", (), "ultrasound_nwire"),
    Entry("edges", "Slanted edges, beside ISO 12233", "edge.py --edges 10"),
    Entry("blurred", "Blurred targets, drawn with batoid's rays", "blurred.py --count 2", ("batoid",)),
    Entry("moving", "Blurred targets that moved during the exposure", "moving.py --count 7", ("batoid",)),
    Entry("rays", "Ray tracing", "raytrace.py", ("batoid", "optiland")),
    Entry("refraction", "Refraction", "multimedia.py --part cavity", (), "multimedia_cavity"),
    Entry("water", "Cameras above water", "water_rigs.py --scenario minimal --seeds 6 --jobs 2",
          ("AquaCal",)),
    Entry("nist", "Certified problems of NIST", "nist.py", (), "nist_strd"),
    Entry("archive", "Archive, beside writing files", "archive.py --frames 2000 --objects 100"),
    Entry("gige", "GigE Vision", "gige.py --frames 100 --rounds 3", ("Aravis",)),
    Entry("transfer", "Pictures of an oscilloscope's screen", "transfer.py", ("lxi", "pyvisa-py")),
)  # fmt: skip

SUBJECTS = {
    "peers-cameras": ("Cameras and networks, beside peers", (
        "bundle", "cameras", "calibrations", "degenerate", "critical", "causes", "intervals", "halves",
        "model-choice", "next-photograph", "stereo", "refraction", "water", "nist")),
    "peers-targets": ("Targets and boards, beside peers", (
        "disks", "testfield", "boards", "other-boards", "drawn-boards", "reseau-simulated", "reseau",
        "edges", "blurred", "moving", "rays")),
    "peers-pictures": ("Film, screens and frames of instruments, beside peers", (
        "vidicon", "hough", "film", "fiducials", "fiducials-learnt", "oscilloscope-simulated",
        "oscilloscope", "pins")),
    "peers-instruments": ("Instruments and archive, beside peers", ("archive", "gige", "transfer")),
}  # fmt: skip
"""Pages of the entries: title, and names of the entries."""


def found(peer: str) -> str:
    """The version of a peer; nothing if it is missing."""
    package = PEERS[peer]
    try:
        return version(package)
    except PackageNotFoundError:
        pass
    if which("dpkg-query") is None:
        return ""
    command = ["dpkg-query", "-W", "-f", "${db:Status-Status} ${Version}", package]
    status, _, debian = subprocess.run(command, capture_output=True, text=True).stdout.partition(" ")
    at = re.match(r"(?:\d+:)?(\d[\d.]*\d|\d)", debian)
    return at[1] if status == "installed" and at else ""


def commit() -> str:
    """The last commit that changed the code, marked if files differ from it."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", *words, "--", *CODE], capture_output=True, text=True, cwd=ROOT)
        return done.stdout.strip()

    at = git("log", "-1", "--format=%h") or "unknown"
    return at + ("-dirty" if git("status", "--porcelain") else "")


def header(entry: Entry, at: str, peers: Mapping[str, str]) -> str:
    """The first lines of an entry's file, which say what it is of."""
    lines = [f"commit {at}", f"python benchmarks/{entry.command}"]
    lines += [
        f"{peer} {number or 'is not installed: its rows are missing'}" for peer, number in peers.items()
    ]
    return "\n".join(lines) + "\n"


def run(entry: Entry, folder: Path, at: str) -> str:
    """Run an entry unless it has ended well for this code; return what became of it."""
    text, figures = folder / f"{entry.name}.txt", folder / f"{entry.name}.json"
    if figures.exists() and text.exists() and "dirty" not in at:
        before = json.loads(figures.read_text())
        if before["commit"] == at and before["command"] == entry.command:
            return f"{before['seconds']} s, earlier"
    figures.unlink(missing_ok=True)
    peers = {peer: found(peer) for peer in entry.peers}
    if entry.data and not (DATA / entry.data).exists():
        text.write_text(header(entry, at, peers) + f"\nskipped: {entry.data} is not in RESEAU_DATA\n")
        return f"skipped: {entry.data} is not in RESEAU_DATA"
    draft, rows, began = text.with_suffix(".part"), text.with_suffix(".rows"), time.monotonic()
    rows.unlink(missing_ok=True)
    command = [sys.executable, *shlex.split(f"benchmarks/{entry.command}")]
    environment = os.environ | {
        "RESEAU_DATA": str(DATA), "OPENBLAS_NUM_THREADS": "1", "RESEAU_FIGURES": str(rows.resolve())
    }  # fmt: skip
    with draft.open("w") as out:
        out.write(header(entry, at, peers) + "\n")
        out.flush()
        try:
            done = subprocess.run(
                command, stdout=out, stderr=subprocess.STDOUT, cwd=ROOT, env=environment, timeout=LIMIT_S,
                check=False,
            )  # fmt: skip
            code: int | str = done.returncode
        except subprocess.TimeoutExpired:
            code = "time limit"
        seconds = round(time.monotonic() - began)
        # Some end with 1 where a figure misses its limit: that is a result.
        whole = code in (0, 1) and "Traceback" not in draft.read_text()
        out.write(f"\nended after {seconds} s\n" if whole else f"\nfailed ({code}) after {seconds} s\n")
    draft.replace(text)
    if not whole:
        return f"failed ({code}) after {seconds} s"
    document = {"commit": at, "command": entry.command, "seconds": seconds, "peers": peers}
    document["figures"] = [asdict(each) for each in read(rows)]
    figures.write_text(json.dumps(document, ensure_ascii=False))
    rows.unlink(missing_ok=True)
    return f"{seconds} s"


def keep(folder: Path, path: Path = RECORDED) -> None:
    """Put the figures of all entries that have ended well beside those that were recorded before."""
    before: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    entries = {}
    for entry in ENTRIES:
        file = folder / f"{entry.name}.json"
        if file.exists():
            entries[entry.name] = json.loads(file.read_text())
        elif entry.name in before:
            entries[entry.name] = before[entry.name]
    lines = []
    for name, document in entries.items():
        rest = {key: value for key, value in document.items() if key != "figures"}
        rows = ",\n".join(f"  {json.dumps(each, ensure_ascii=False)}" for each in document["figures"])
        opened = json.dumps(rest, ensure_ascii=False)[:-1]
        lines.append(f'{json.dumps(name)}: {opened}, "figures": [\n{rows}\n]}}')
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def overview(path: Path = RECORDED) -> str:
    """The first page of what was recorded: what is missing, and the figures that all have in common."""
    entries: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    minutes = sum(each["seconds"] for each in entries.values()) / 60
    known = [each for each in ENTRIES if each.name in entries]
    lines = [
        f"{len(known)} entries in {minutes:.0f} minutes. A cell is a figure, or the median of several with "
        "the least and the greatest in brackets; a dash says that a program has none.",
        "",
    ]
    absent = [f"{each.title}: not recorded" for each in ENTRIES if each.name not in entries]
    for entry in known:
        for peer, number in entries[entry.name]["peers"].items():
            if not number:
                absent.append(f"{peer} in “{entry.title}”: {PEERS[peer]} was not installed")
    if absent:
        lines += ["Missing:", "", *(f"- {each}" for each in absent), ""]
    lines += ["## Errors of clean targets beside the bound", "", _beside_the_bound(path)]
    lines += [_TARGETS, "", "## Images of independent origin beside the simulator's", "", _ORIGINS, ""]
    origins = sorted(recorded(ORIGIN, path), key=lambda each: each.column.startswith("independent"))
    lines += [markdown(origins, "what"), _PICTURE, ""]
    return "\n".join(lines).rstrip() + "\n"


def page(names: Collection[str], path: Path = RECORDED) -> str:
    """The tables of entries, with the versions of their peers."""
    entries: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    lines: list[str] = []
    for entry in (each for each in ENTRIES if each.name in entries and each.name in names):
        document = entries[entry.name]
        peers = ", ".join(f"{peer} {number}" for peer, number in document["peers"].items() if number)
        lines += [f"## {entry.title}", ""]
        lines += [
            f"`python benchmarks/{entry.command}`, {document['seconds']} s" + f"; {peers}" * bool(peers),
            "",
        ]
        tables: dict[str, list[Figure]] = {}
        for each in (Figure(**figure) for figure in document["figures"]):
            if each.table not in (BOUND, ORIGIN):
                tables.setdefault(each.table, []).append(each)
        for title, figures in tables.items():
            lines += [markdown(figures, title)]
    return "\n".join(lines).rstrip() + "\n"


def pages(path: Path = RECORDED) -> dict[str, str]:
    """All pages of what was recorded, by the names of their files."""
    found = {"peers.md": f"# Beside peers, and on images of independent origin\n\n{overview(path)}"}
    for name, (title, names) in SUBJECTS.items():
        found[f"{name}.md"] = f"# {title}\n\n{page(names, path)}"
    return {name: f"<!-- written by benchmarks/all.py -->\n\n{text}" for name, text in found.items()}


_TARGETS = (
    "![Errors of image coordinates of several targets on a logarithmic scale: reseau beside the bound, other "
    "programs mostly some times above](../images/targets-beside-others.png)"
)
_ORIGINS = (
    "Found, and errors ÷ sigmas, with images of the project's own simulators and with images of another "
    "origin; in brackets the least and the greatest of conditions, kinds or images."
)
_PICTURE = (
    "![Errors over sigmas of the simulator's images and of independent ones for each kind of target]"
    "(../images/independent-beside-simulator.png)"
)


def _beside_the_bound(path: Path) -> str:
    """Rms errors of a coordinate, px: ours, the bound, and each other program with its own."""
    rows: dict[str, dict[str, Figure]] = {}
    for each in recorded(BOUND, path):
        rows.setdefault(each.row, {})[each.column] = each
    lines = [
        "| rms error, px | reseau | Cramér–Rao bound | other program | its error |",
        "|---|---|---|---|---|",
    ]
    for row, cells in rows.items():
        own, bound = (str(cells[key]) if key in cells else "–" for key in ("reseau", "bound"))
        others = {key: str(each) for key, each in cells.items() if key not in ("reseau", "bound")}
        for name, error in others.items():
            lines.append(f"| {row} | {own} | {bound} | {name} | {error.replace('–', 'not found')} |")
    return "\n".join(lines) + "\n"


def write() -> None:
    """Write the pages, and draw the pictures from the same figures."""
    for name, text in pages().items():
        (PAGES / name).write_text(text)
    subprocess.run([sys.executable, str(ROOT / "docs" / "benchmark_figures.py")], check=True, cwd=ROOT)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench")
    parser.add_argument("--again", action="store_true", help="also what has ended well for this code")
    parser.add_argument("--write", action="store_true", help="write the page and draw the pictures")
    parser.add_argument("--list", action="store_true")
    given = parser.parse_args()
    known = {entry.name: entry for entry in ENTRIES}
    if unknown := [name for name in given.names if name not in known]:
        parser.error(f"{unknown[0]} is not one of {', '.join(known)}")
    if given.list:
        for entry in ENTRIES:
            missing = [peer for peer in entry.peers if not found(peer)]
            print(f"{entry.name:22} {entry.title}" + (f" (without {', '.join(missing)})" if missing else ""))
    else:
        given.out.mkdir(parents=True, exist_ok=True)
    at, failed, rows = commit(), 0, list[str]()
    for name in [] if given.list else given.names or known:
        entry, file = known[name], given.out / f"{name}.txt"
        if given.again:
            file.unlink(missing_ok=True)
        became = run(entry, given.out, at)
        failed += became.startswith("failed")
        print(f"{name:22} {became}", flush=True)
        rows.append(f"## {entry.title}\n\n```\n{file.read_text().strip()}\n```\n")
    if rows:
        (given.out / "report.md").write_text(f"# Benchmarks of {at}\n\n" + "\n".join(rows))
        print(given.out / "report.md")
    if given.write:
        keep(given.out)
        write()
        print(PAGES / "peers.md")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
