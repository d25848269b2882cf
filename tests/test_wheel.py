"""The wheel has every file of the packages, and machine code: in a clean environment nothing is compiled."""

from __future__ import annotations

import os
import re
import subprocess
import venv
import zipfile
from pathlib import Path

import pytest

from reseau.core.compiled import usual_processor

ROOT = Path(__file__).resolve().parents[1]
SOURCES = {"reseau": ROOT / "src", "reseau_drivers": ROOT / "drivers", "reseau_sims": ROOT / "sims"}
UNREACHABLE = re.compile(r"No matching distribution|Connection|Max retries|Temporary failure|timed out")


def pip(python: Path | str, *arguments: object) -> None:
    """Run pip; skip the test, and say so, where no registry can be reached."""
    command = [str(python), "-m", "pip", "--disable-pip-version-check", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    if done.returncode and UNREACHABLE.search(done.stderr):
        pytest.skip(f"no package registry: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    # Isolated, as `pip install .` builds it: with what pip installs for the build. Not by this Python, whose
    # site names the sources: pip hides what a site has.
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    pip(python, "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, ".")
    (path,) = folder.glob("reseau-*.whl")
    return path


@pytest.mark.slow
def test_the_wheel_contains_every_file_of_the_packages(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        stored = set(archive.namelist())
    expected = {
        path.relative_to(folder).as_posix()
        for package, folder in SOURCES.items()
        for path in (folder / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert any(name.endswith(".rules") for name in expected)
    assert any(name.endswith(".html.j2") for name in expected)
    assert expected <= stored


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_wheel_runs_the_demo_in_a_clean_environment_and_compiles_nothing(
    wheel: Path, tmp_path: Path
) -> None:
    venv.create(tmp_path / "venv", with_pip=True)
    scripts = tmp_path / "venv" / ("Scripts" if os.name == "nt" else "bin")
    pip(scripts / "python", "install", "--quiet", "-c", "constraints.txt", f"{wheel}[bench]")
    command = [scripts / "reseau", "demo", "--out", tmp_path / "out"]
    system = {name: os.environ[name] for name in ("SYSTEMROOT", "PATH") if name in os.environ}
    environment = system | {"HOME": str(tmp_path), "LOCALAPPDATA": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out/report.html").stat().st_size > 10_000
    assert list((tmp_path / "venv").rglob("machine_code/*.nbc"))
    compiled = list(tmp_path.rglob("compiled/*.nbc"))
    assert usual_processor() is None or not compiled, compiled
