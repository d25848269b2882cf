"""A service over a copy of the archive, for the tests of a module."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from .served import Served, served


@pytest.fixture(scope="module")
def one(archived: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("served")
    shutil.copytree(archived, folder, dirs_exist_ok=True)
    with served(folder) as found:
        yield found
