"""Cost of an archive with many frames: storing compared with writing a file, opening, listing, finding.

    python benchmarks/archive.py [--frames 10000] [--pixels 1024] [--objects 400] [--folder FOLDER]

Frames contain 8-bit noise, which cannot be compressed. For comparison, the same TIFF is written with fsync
and a rename, which is the minimum for a write that survives a power failure. To save disk space, only
`--objects` frames are stored as separate files; all others have rows in the index and share one file.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from figures import record

from reseau.archive import Archive, Verdict, tiff_of
from reseau.core.data import Frame


def milliseconds(what: str, work: Callable[[], object], times: int = 15) -> tuple[str, float, float]:
    """What is done, median and worst."""
    taken = []
    for _ in range(times):
        began = time.perf_counter()
        work()
        taken.append(1e3 * (time.perf_counter() - began))
    record(what, "time", taken, "ms")
    return what, statistics.median(taken), max(taken)


def plain(path: Path, data: bytes) -> None:
    """Write a file that survives a power failure."""
    draft = path.with_suffix(".draft")
    with draft.open("wb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
    draft.replace(path)
    handle = os.open(path.parent, os.O_RDONLY)
    os.fsync(handle)
    os.close(handle)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--pixels", type=int, default=1024, help="width and height")
    parser.add_argument("--objects", type=int, default=400, help="number of frames with separate files")
    parser.add_argument("--folder", type=Path, help="folder to use; default: a temporary folder")
    given = parser.parse_args()
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory(dir=given.folder) as name:
        folder = Path(name)
        (folder / "plain").mkdir()
        kept_ms, written_ms = [], []
        with Archive.open(folder / "archive", create=True) as archive:
            for k in range(10):
                archive.begin(f"session {k}", "frames", {})
            sessions = [archive.session(f"session {k}") for k in range(10)]
            shared = b"the same for all"
            every = max(1, given.frames // given.objects)
            for k in range(given.frames):
                session, step = sessions[k % 10], f"{k:06d}"
                if k % every:
                    session.judge(session.store(step, shared, suffix=".bin"), Verdict(True))
                    continue
                pixels = rng.integers(0, 256, (given.pixels, given.pixels), dtype=np.uint8)
                frame = Frame(pixels, 255.0, step)
                began = time.perf_counter()
                session.store(step, frame, facts={"gain": 1.0}, clock={"taken": "2026-01-01"})
                between = time.perf_counter()
                plain(folder / "plain" / f"{k}.tif", tiff_of(frame, {}))
                kept_ms.append(1e3 * (between - began))
                written_ms.append(1e3 * (time.perf_counter() - between))
        overhead = [one - other for one, other in zip(kept_ms, written_ms, strict=True)]
        size = sum(path.stat().st_size for path in (folder / "archive").glob("index*")) / 1e6
        print(f"{given.frames} frames, index {size:.1f} MB; median and worst, ms")
        written = statistics.median(written_ms), max(written_ms)
        wrote = f"writing a file of {given.pixels} × {given.pixels} pixels that survives a power failure"
        record(wrote, "time", written_ms, "ms")
        record("storing the same frame", "time", kept_ms, "ms")
        record("storing, more than writing", "time", overhead, "ms")
        print(f"  writing one of {given.pixels}² px    {written[0]:7.1f} {written[1]:7.1f}")
        print(f"  storing one              {statistics.median(kept_ms):7.1f} {max(kept_ms):7.1f}")
        print(
            f"  overhead                 {statistics.median(overhead):7.1f} {max(overhead):7.1f}   limit 15"
        )
        row = "  {:<24} {:7.1f} {:7.1f}   asked < 50"
        print(row.format(*milliseconds("opening", lambda: Archive.open(folder / "archive").close())))
        with Archive.open(folder / "archive") as archive:
            print(row.format(*milliseconds("listing all sessions", archive.sessions)))
            session = archive.session("session 3")
            of_one = f"listing {len(session.frames())} frames"
            print(row.format(*milliseconds(of_one, session.frames)))
            step = f"{given.frames // 2 // every * every:06d}"
            found = archive.session(f"session {int(step) % 10}")

            def one() -> Frame:
                frame = found.find(step)
                assert frame is not None
                return found.picture(frame)

            print(row.format(*milliseconds("finding and reading one", one)))


if __name__ == "__main__":
    main()
