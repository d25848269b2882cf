"""Loops are compiled once, found again, and compiled anew when anything that they are made of has changed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from reseau.core import compiled as module
from reseau.core.compiled import compiled, kernel, listed, named, types_of

LOOPS = """
import numpy as np
from reseau.core.compiled import compiled, kernel
FACTOR = {factor}
TABLE = np.array([1.0, {entry}])

@kernel
def part(x):
    return {part}

@kernel
def other(x):
    return -x

@compiled
def total(values):
    found = 0.0
    for i in range(len(values)):
        found += FACTOR * part(values[i]) * TABLE[1]
    return found
"""

RUN = """
import gc, sys
gc.disable()
sys.path.insert(0, sys.argv[1])
import numpy as np
from numba.core import event
compiles = []
class Listener(event.Listener):
    def on_start(self, event): compiles.append(event.data["dispatcher"].py_func.__name__)
    def on_end(self, event): pass
event.register("numba:compile", Listener())
import loops
from reseau.core.compiled import compiled
total = compiled(loops.total, part=loops.other) if "slot" in sys.argv else loops.total
print(total(np.arange(3.0)), "total" in compiles)
"""


def run(
    folder: Path, cache: Path, *words: str, factor: float = 1.0, entry: float = 1.0, part: str = "x"
) -> str:
    """The sum and whether it was compiled, of a new process."""
    folder.mkdir(exist_ok=True)
    (folder / "loops.py").write_text(LOOPS.format(factor=factor, entry=entry, part=part))
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(folder), *words],
        capture_output=True, text=True, env=environment, check=True,
    )  # fmt: skip
    return done.stdout.strip()


@pytest.mark.slow
def test_a_loop_is_compiled_once_also_for_a_copy_of_its_file_and_anew_what_was_changed(
    tmp_path: Path,
) -> None:
    folder, cache = tmp_path / "here", tmp_path / "cache"
    assert run(folder, cache) == "3.0 True"
    assert run(tmp_path / "there", cache) == "3.0 False"
    (kept,) = cache.glob("reseau/*.nbc")
    kept.write_bytes(kept.read_bytes()[:200])
    assert run(folder, cache) == "3.0 True"
    assert run(folder, cache, factor=2.0) == "6.0 True"
    assert run(folder, cache, entry=3.0) == "9.0 True"
    assert run(folder, cache, part="x * x") == "5.0 True"
    assert run(folder, cache, "slot") == "-3.0 True"
    assert run(folder, cache) == "3.0 False"


@pytest.mark.slow
def test_processes_that_start_together_compile_a_loop_once(tmp_path: Path) -> None:
    folder, cache = tmp_path / "here", tmp_path / "cache"
    folder.mkdir()
    (folder / "loops.py").write_text(LOOPS.format(factor=1.0, entry=1.0, part="x"))
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", RUN, str(folder)], stdout=subprocess.PIPE, text=True, env=environment
        )
        for _ in range(3)
    ]
    found = [each.communicate()[0].strip() for each in started]
    assert sorted(found) == ["3.0 False", "3.0 False", "3.0 True"]
    assert not list(cache.glob("reseau/.*"))


def test_a_package_that_cannot_be_written_to_is_read_and_the_users_folder_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("reseau.core.compiled.sys.platform", "linux")
    monkeypatch.setattr("reseau.core.compiled.os.access", lambda *_: False)
    package = Path(module.__file__).parents[1]
    assert module.folders() == [
        package / "__pycache__" / "compiled",
        tmp_path / "reseau" / "compiled",
    ]
    monkeypatch.setattr("reseau.core.compiled.os.access", lambda *_: True)
    assert module.folders() == [package / "__pycache__" / "compiled"]


@pytest.mark.slow
def test_machine_code_for_the_usual_processor_is_run_by_this_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = module.usual_processor()
    if usual is None:
        pytest.skip("this processor is not the usual one of its platform")
    folder, cache = tmp_path / "here", tmp_path / "cache"
    with monkeypatch.context() as elsewhere:
        elsewhere.setenv("NUMBA_CPU_NAME", usual[0])
        elsewhere.setenv("NUMBA_CPU_FEATURES", usual[1])
        assert run(folder, cache) == "3.0 True"
    assert run(folder, cache) == "3.0 False"


@pytest.mark.slow
def test_where_nothing_can_be_kept_it_is_compiled_all_the_same(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert run(tmp_path / "here", tmp_path / "file") == "3.0 True"


def test_what_is_kept_tells_how_it_is_compiled_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    loop = named("reseau.optics.compiled:responses")
    found = np.zeros((2, 3, 1, 1, 4), np.float32)
    given = np.ones((1, 1), np.float32), np.zeros(1, np.float32), np.ones(1, np.float32)
    loop(*given, found[0])
    (entry,) = listed(tmp_path / "reseau")
    assert entry["function"] == "reseau.optics.compiled:responses"
    again = named(entry["function"], entry["slots"])
    again.dispatcher.compile(types_of(entry["arguments"]))
    assert len(listed(tmp_path / "reseau")) == 1
    again(*given, found[1])
    np.testing.assert_array_equal(found[1], found[0])


def test_a_kernel_is_plain_python() -> None:
    @kernel
    def twice(x: float) -> float:
        return 2 * x

    assert twice(1.5) == 3.0
    assert compiled(twice)(1.5) == 3.0
