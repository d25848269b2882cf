"""Shared by the tests: the reference data, which is not part of the project, and no limits of time."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

# A loaded machine, or code that is compiled at its first call, is not an error.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

_BESIDE = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def reference_data() -> Callable[[str], Path]:
    """A file or folder of the reference data by name; without it the test is skipped with a message."""
    root = Path(os.environ.get("RESEAU_DATA", _BESIDE))

    def find(name: str) -> Path:
        path = root / name
        if not path.exists():
            pytest.skip(f"no reference data {name!r} in {root}; set RESEAU_DATA")
        return path

    return find
