"""One session at a time on a bench; the error names the owner, and a killed owner holds nothing."""

import os
import signal
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path

import pytest

from reseau.capture import BenchLock
from reseau.core.errors import StateError

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
        ) as raised:
            lock.__enter__()
        assert "wait, or stop that process" in str(raised.value)
        with BenchLock(["TCPIP::here"], "session monday", tmp_path):
            pass  # what had been taken before the refusal is free again
        os.kill(other.pid, signal.SIGKILL)
        other.wait(10)
        with lock:
            pass


AS_ANOTHER = """
    import os, sys
    from pathlib import Path
    from reseau.capture import BenchLock
    from reseau.core.errors import StateError
    os.setuid(65534)
    for address in "ab":
        try:
            with BenchLock([address], "theirs", Path(sys.argv[1])):
                print("free")
        except StateError as error:
            print(error)
    """


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
def test_a_lock_of_another_user_is_reported_and_taken_when_it_is_free() -> None:
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        folder = Path(name) / "locks"
        with BenchLock(["b"], "mine", folder):
            pass
        with BenchLock(["a"], "mine", folder):
            command = [sys.executable, "-c", textwrap.dedent(AS_ANOTHER), str(folder)]
            message = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert message[0].startswith("a: is in use by mine (process")
    assert message[1:] == ["free"]


def test_two_names_of_one_device_are_one_instrument(tmp_path: Path) -> None:
    (tmp_path / "tty").write_text("")
    (tmp_path / "by-id").symlink_to("tty")
    with (
        BenchLock([str(tmp_path / "tty")], "one", tmp_path / "locks"),
        pytest.raises(StateError, match="by-id: is in use by one"),
    ):
        BenchLock([str(tmp_path / "by-id")], "two", tmp_path / "locks").__enter__()


def test_a_folder_of_locks_that_cannot_be_created_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StateError, match="cannot be locked"):
        BenchLock(["a"], "one", tmp_path / "file").__enter__()


def test_benches_without_a_common_instrument_do_not_exclude_each_other(tmp_path: Path) -> None:
    with BenchLock(["a"], "one", tmp_path), BenchLock(["b"], "two", tmp_path):
        pass
    with BenchLock(["a", "a"], "one", tmp_path):
        pass
