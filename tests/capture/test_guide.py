"""The commands of `docs/bench.md`, run as they are printed there, on simulated instruments."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from reseau_sims.serving import aravis_is_installed

PAGE = Path(__file__).parents[2] / "docs" / "bench.md"
RESEAU = [sys.executable, "-c", "import sys; from reseau.cli import run; sys.exit(run(sys.argv[1:]))"]


def commands() -> list[list[list[str]]]:
    """The commands of the page, in parts that each begin with a simulated bench."""
    text = PAGE.read_text(encoding="utf-8")
    lines = [
        line.removeprefix("$ ")
        for block in re.findall(r"```console\n(.*?)```", text, re.DOTALL)
        for line in block.splitlines()
    ]
    parts: list[list[list[str]]] = []
    for line in lines:
        words = shlex.split(line)
        assert words[0] == "reseau"
        if words[-1] == "&":
            parts.append([])
        parts[-1].append(words)
    return parts


def python_of(name: str) -> str:
    """The Python file of the page."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    return f'"""{name}"""\n{code}'


@contextmanager
def simulated(words: list[str], folder: Path) -> Iterator[None]:
    """A simulated bench that runs in the background, once it has written its bench file."""
    (folder / "bench.toml").unlink(missing_ok=True)
    with subprocess.Popen([*RESEAU, *words[1:-1]], cwd=folder, stderr=subprocess.PIPE, text=True) as bench:
        try:
            assert bench.stderr is not None
            assert "serving" in bench.stderr.readline()
            yield
        finally:
            bench.terminate()


@pytest.mark.slow
@pytest.mark.skipif(not aravis_is_installed(), reason="needs Aravis: one process serves the camera to others")
def test_every_command_of_the_guide_works_as_printed(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(python_of("own.py"), encoding="utf-8")
    parts = commands()
    assert len(parts) == 5
    for first, *others in parts:
        with simulated(first, tmp_path):
            for words in others:
                began = time.monotonic()
                done = subprocess.run(
                    [*RESEAU, *words[1:]], cwd=tmp_path, capture_output=True, text=True, timeout=600
                )
                said = f"{shlex.join(words)} ({time.monotonic() - began:.1f} s)\n{done.stdout}\n{done.stderr}"
                print(said)
                assert done.returncode == 0, said
    assert {"one.png", "monday.zip", "sensor.json"} <= {path.name for path in tmp_path.iterdir()}
    assert (tmp_path / "results" / "report.html").exists()
