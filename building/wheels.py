"""Build wheels that carry machine code, so that nobody who installs one waits for a compiler.

This is the backend that ``pyproject.toml`` names: hatchling, and for wheels its hook below, which compiles
the loops of the main jobs for the usual processors of the platform (x86-64 with AVX2, arm64). Compiling needs
what the package needs; checkouts that are installed to be edited are not compiled here. Machine code belongs
to a version of Python and to one of Numba, so each has its own wheel.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling import build as hatchling
from hatchling.build import (
    build_editable,
    build_sdist,
    get_requires_for_build_editable,
    get_requires_for_build_sdist,
)
from hatchling.builders.hooks.plugin.interface import BuildHookInterface

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
]

ENABLED = {"HATCH_BUILD_HOOK_ENABLE_CUSTOM": "true"}


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    """What a wheel is built with."""
    os.environ.update(ENABLED)
    return list(hatchling.get_requires_for_build_wheel(config_settings))


def build_wheel(folder: str, config_settings: Any = None, metadata: str | None = None) -> str:
    """Build a wheel with machine code; return the name of its file."""
    os.environ.update(ENABLED)
    return str(hatchling.build_wheel(folder, config_settings, metadata))


class MachineCode(BuildHookInterface[Any]):
    """Compile the loops of the main jobs, and put what was compiled into the wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and name what the wheel is for."""
        self._made = tempfile.TemporaryDirectory()
        source = Path(self.root) / "src"
        name = usual(source)
        environment = beside(*(Path(self.root) / each for each in ("src", "drivers", "sims"))) | {
            "NUMBA_CACHE_DIR": self._made.name,
            "NUMBA_CPU_NAME": name,
            "NUMBA_CPU_FEATURES": "",
        }
        subprocess.run([sys.executable, "-m", "reseau", "compile"], env=environment, check=True)
        for path in (Path(self._made.name) / "reseau").glob("*.nbc"):
            build_data["force_include"][str(path)] = f"reseau/machine_code/{path.name}"
        build_data["pure_python"] = False
        build_data["tag"] = tag()

    def finalize(self, version: str, build_data: dict[str, Any], artifact: str) -> None:
        """Remove what was compiled."""
        self._made.cleanup()


def beside(*folders: Path) -> dict[str, str]:
    """The environment with packages of these folders, beside those that pip has installed for this build."""
    paths = [*map(str, folders), *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)}


def usual(source: Path) -> str:
    """The usual processor of this platform, as LLVM names it."""
    command = "from reseau.core.compiled import usual_processor; print(*(usual_processor() or ['']))"
    found = subprocess.run(
        [sys.executable, "-c", command], env=beside(source), capture_output=True, text=True
    )
    name = found.stdout.partition(" ")[0].strip()
    if not name:
        raise SystemExit(f"{platform.machine()} has no usual processor that this one is: {found.stderr}")
    return name


def tag() -> str:
    """The wheel's tag: this version of Python, this platform; machine code asks nothing of the C library."""
    python = f"cp{sys.version_info.major}{sys.version_info.minor}"
    of = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    return f"{python}-{python}-{of.replace('linux', 'manylinux_2_17')}"
