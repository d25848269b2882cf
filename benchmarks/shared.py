"""Load helper modules of the tests by their path."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

__all__ = ["of_the_tests"]


def of_the_tests(path: str) -> ModuleType:
    """Load a module of ``tests``, such as ``measure/frames.py``."""
    file = Path(__file__).resolve().parents[1] / "tests" / path
    spec = importlib.util.spec_from_file_location(f"of_the_tests_{file.stem}", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
