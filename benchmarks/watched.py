"""Run another program, watch its memory, and end it where it takes too much memory or time."""

from __future__ import annotations

import re
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

__all__ = ["Ended", "forget_peak", "peak_mb", "run_watched"]

_EACH_S = 0.02
_LEFT_MB = 1000.0
"""Memory that the rest of the machine keeps."""


def peak_mb(process: int | str = "self") -> float:
    """The peak of the memory of a process; nothing once it has ended.

    Not that of `getrusage`: the kernel counts that of a child from the size of its parent on.
    """
    seen = re.search(r"VmHWM:\s+(\d+) kB", Path(f"/proc/{process}/status").read_text())
    return int(seen[1]) / 2**10 if seen else 0.0


def forget_peak() -> float:
    """Begin the peak of this process anew, at its present size, which is returned."""
    Path("/proc/self/clear_refs").write_text("5")
    return peak_mb()


@dataclass(frozen=True)
class Ended:
    """What a program printed, the peak of its memory, and why it did not end by itself and well, if so."""

    out: str
    peak_mb: float
    seconds: float
    why: str


def run_watched(command: Sequence[str | Path], longest_s: float) -> Ended:
    """Run a program for at most some time (s), in the memory that is available now."""
    most_mb = psutil.virtual_memory().available / 2**20 - _LEFT_MB
    peak, why, begun = 0.0, "", time.monotonic()
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        process = subprocess.Popen([str(word) for word in command], stdout=out, stderr=err)
        while process.poll() is None:
            peak = max(peak, peak_mb(process.pid))
            if peak > most_mb:
                why = f"more than the {most_mb:.0f} MB that are available"
            elif time.monotonic() - begun > longest_s:
                why = f"not ended after {longest_s:.0f} s"
            if why:
                process.kill()
                process.wait()
            else:
                time.sleep(_EACH_S)
        seconds = time.monotonic() - begun
        out.seek(0)
        err.seek(0)
        said = err.read().decode(errors="replace").strip().splitlines()[-1:]
        if process.returncode < 0 and not why:
            why = f"ended by signal {-process.returncode}" + "".join(f": {each}" for each in said)
        elif process.returncode and not why:
            why = said[0] if said else f"ended with {process.returncode}"
        return Ended(out.read().decode(), peak, seconds, why)
