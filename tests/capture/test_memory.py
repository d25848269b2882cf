"""A session may have any number of frames: what a process holds of it does not grow with them."""

from __future__ import annotations

import gc
import itertools
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reseau.archive import Archive
from reseau.capture import Acquisition, Bench, BenchFile, InstrumentEntry, carry_out, plans
from reseau.core.data import Frame

from .simple import CameraSettings, Simple, Taken

ROOT = Path(__file__).resolve().parents[2]
FRAMES, FIRST, LAST = 260, 60, 240
MOST = 500
"""Bytes that may be left of a frame; the messages of its plan alone would take 1700."""


class Counting(Simple):
    """A camera that numbers its frames."""

    def __init__(self, name: str) -> None:
        super().__init__(name, CameraSettings())
        self._numbers = itertools.count()

    def expose(self, seconds: float | None = None) -> Taken:
        number = next(self._numbers)
        pixels = np.full((4, 4), 100 + number % 9, np.uint8)
        return Taken(Frame(pixels, 255.0), number, datetime.now(UTC), self.settings.exposure_us)

    def frames(self, count: int, seconds: float | None = None) -> Iterator[Taken]:
        return (self.expose(seconds) for _ in range(count))


def growth(folder: Path) -> int:
    """Bytes that are left of the frames between two of a session."""
    held: dict[str, int] = {}

    def watch(kind: str, facts: dict[str, Any]) -> None:
        if kind == "frame" and facts["step"] in (f"{FIRST:05d}", f"{LAST:05d}"):
            gc.collect()
            held[facts["step"]] = tracemalloc.get_traced_memory()[0]

    entry = InstrumentEntry(driver="sim", address="sim-camera")
    bench = Bench(BenchFile(name="b", instruments={"camera": entry}), lambda name, entry: Counting(name))
    with Archive.open(folder / "archive", create=True) as archive:
        session = archive.begin("monday", "frames", {"count": FRAMES})
        run = Acquisition(bench, session, watch=watch)
        tracemalloc.start()
        try:
            carry_out(run, plans.frames(run, FRAMES))
        finally:
            tracemalloc.stop()
        assert session.counts() == (FRAMES, FRAMES)
    first, last = held.values()
    return last - first


@pytest.mark.slow
def test_frames_of_a_session_are_in_the_archive_and_not_in_memory(tmp_path: Path) -> None:
    # In a process of its own: what other tests have left there fills caches meanwhile.
    code = f"from pathlib import Path; from {__name__} import growth; print(growth(Path({str(tmp_path)!r})))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert int(done.stdout) < MOST * (LAST - FIRST)
