"""What the main jobs call is listed, and is compiled ahead in several processes."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from reseau.core import ahead
from reseau.core.ahead import Loop, by_module, compile_ahead, main_loops
from reseau.core.compiled import Compiled, types_of
from reseau.core.errors import InputError
from reseau.core.executors import Here

RESEAU = "from reseau.cli import main; main()"


@pytest.mark.parametrize("loop", main_loops(), ids=lambda loop: loop.function.rpartition(":")[2])
def test_every_loop_of_the_list_is_a_compiled_function_of_as_many_arguments(loop: Loop) -> None:
    function = loop.compiled()
    assert isinstance(function, Compiled)
    assert len(types_of(loop.arguments)) == function.function.__code__.co_argcount


@pytest.mark.slow
def test_loops_are_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    one = next(loop for loop in main_loops() if loop.function.endswith("compiled:responses"))
    command = [
        sys.executable,
        "-c",
        "from reseau.core.ahead import *; from reseau.core.executors import Here\n"
        f"print(compile_ahead(Here(), {{'responses': [main_loops()[{main_loops().index(one)}]]}}))",
    ]
    said = [subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(2)]
    assert "compiled=1, found=0" in said[0]
    assert "compiled=0, found=1" in said[1]
    assert len(list((tmp_path / "reseau").glob("*.nbc"))) == 1


@pytest.mark.slow
def test_what_is_missing_is_compiled_before_a_job_and_is_then_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    one = replace(next(loop for loop in main_loops() if loop.function.endswith(":responses")), jobs=("one",))
    monkeypatch.setattr(ahead, "main_loops", lambda: (one,))
    assert ahead.missing_loops("other") == []
    assert ahead.missing_loops("one") == [one]
    compile_ahead(Here(), by_module([one]))
    assert ahead.missing_loops("one") == []


def test_a_list_that_is_older_than_the_code_is_named_with_what_to_do() -> None:
    older = Loop("reseau.optics.compiled:responses", {}, ["float64"])
    with pytest.raises(InputError, match=r"responses cannot be compiled as it says.*loops\.py"):
        compile_ahead(Here(), {"responses": [older]})


def test_modules_have_all_loops() -> None:
    assert sum(map(len, by_module(main_loops()).values())) == len(main_loops())
    assert ahead.LOOPS.is_file()


@pytest.mark.slow
def test_what_was_compiled_ahead_is_all_that_a_calibration_of_a_board_calls(tmp_path: Path) -> None:
    data = Path(os.environ.get("RESEAU_DATA", "../shared/data")) / "chessboard_stereo"
    photographs = sorted(data.glob("left*.jpg"))
    if not photographs:
        pytest.skip(f"no photographs in {data}")
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "compiled")}

    def run(*words: str | Path, status: int = 0) -> int:
        command = [sys.executable, "-c", RESEAU, *map(str, words)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert done.returncode == status, done.stderr
        return len(list((tmp_path / "compiled" / "reseau").glob("*.nbc")))

    run("design", "board", "--kind", "chess", "--columns", "10", "--rows", "7", "--pitch", "25",
        "--out", tmp_path / "board.json")  # fmt: skip
    before = run("compile")
    assert before >= len(main_loops())
    after = run(
        "calibrate", *photographs, "--design", tmp_path / "board.json", "-o", tmp_path / "camera.json",
        status=3,  # not usable for measurement
    )  # fmt: skip
    assert after == before
