"""The project without the modules of POSIX: everything can be imported, and works on files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

IMPORT_ALL = """
import tests.portable.hidden
tests.portable.hidden.hide()
import gc, importlib, pkgutil
gc.disable()
for package in ("reseau", "reseau_drivers", "reseau_sims"):
    for found in pkgutil.walk_packages([importlib.import_module(package).__path__[0]], package + "."):
        if found.name.endswith("__main__") or "gige_process" in found.name:
            continue
        try:
            importlib.import_module(found.name)
        except ImportError as error:
            missing = str(getattr(error, "name", "") or "").partition(".")[0]
            if missing in tests.portable.hidden.MODULES or missing in ("", "reseau"):
                raise
            print(f"{found.name}: without {missing}")
from reseau.cli import run
print(run(["--help"]))
"""


@pytest.mark.slow
def test_every_module_is_imported_without_those_of_posix() -> None:
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL], capture_output=True, text=True, cwd=ROOT, timeout=900, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]


def test_the_hidden_modules_are_hidden() -> None:
    code = """
import tests.portable.hidden
tests.portable.hidden.hide()
exec(compile("import fcntl", "x", "exec"), {"__name__": "reseau.x"})
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert "No module named 'fcntl'" in done.stderr


def test_pseudo_terminals_and_video_devices_are_refused_in_one_line() -> None:
    code = """
import tests.portable.hidden
tests.portable.hidden.hide()
from reseau.core.errors import UsageError
from reseau_drivers.camera import KernelNode
from reseau_sims.serving import PtyServer
for make in (lambda: KernelNode("/dev/video0"), lambda: PtyServer(lambda: None)):
    try:
        make()
    except UsageError as error:
        print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert done.stdout.splitlines() == [
        "/dev/video0: cameras of Video4Linux need Linux",
        "pseudo-terminals: this system has none; use Linux or macOS",
    ], done.stderr[-2000:]


OFFLINE = (
    "tests/core", "tests/io/test_formats.py", "tests/io/test_images.py", "tests/archive/test_archive.py",
    "tests/archive/test_sets.py", "tests/capture/test_lock.py", "tests/cli/test_apply.py",
    "tests/cli/test_bundle.py", "tests/cli/test_calibrate.py", "tests/cli/test_orient.py",
    "tests/cli/test_pins.py", "tests/cli/test_refine.py", "tests/cli/test_schema.py"
)  # fmt: skip
"""Tests of what works on files."""


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("tests", OFFLINE)
def test_offline_commands_pass_their_tests_without_the_modules_of_posix(tests: str) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.portable.hidden", "-p", "no:xdist", tests]
    command += ["-k", "not another_user"]  # there each user has a folder of temporary files
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=3000, check=False)
    assert done.returncode == 0, done.stdout[-3000:]
    assert " passed" in done.stdout
