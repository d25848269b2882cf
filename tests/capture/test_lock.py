"""One session at a time on a bench; who has it is told, and a killed owner holds nothing."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from reseau.capture import BenchLock
from reseau.errors import StateError

HOLDS = """
    import sys, time
    from pathlib import Path
    from reseau.capture import BenchLock
    with BenchLock(["/dev/ttyUSB0"], "session tuesday", Path(sys.argv[1])):
        print("locked", flush=True)
        time.sleep(60)
    """


def holder(folder: Path) -> "subprocess.Popen[str]":
    command = [sys.executable, "-c", textwrap.dedent(HOLDS), str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "locked\n"
    return process


def test_a_bench_in_use_names_its_owner_and_is_free_when_that_is_killed(tmp_path: Path) -> None:
    with holder(tmp_path) as other:
        lock = BenchLock(["/dev/ttyUSB0", "TCPIP::here"], "session monday", tmp_path)
        with pytest.raises(
            StateError, match=rf"session tuesday \(process {other.pid} of .* since 20"
        ) as told:
            lock.__enter__()
        assert "wait, or stop that one" in str(told.value)
        with BenchLock(["TCPIP::here"], "session monday", tmp_path):
            pass  # what had been taken before the refusal is free again
        os.kill(other.pid, signal.SIGKILL)
        other.wait(10)
        with lock:
            pass


def test_benches_without_a_common_instrument_do_not_mind_each_other(tmp_path: Path) -> None:
    with BenchLock(["a"], "one", tmp_path), BenchLock(["b"], "two", tmp_path):
        pass
    with BenchLock(["a", "a"], "one", tmp_path):
        pass
