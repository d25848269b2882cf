"""Passwords are hashed cheaply in these tests."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import argon2
import pytest


@pytest.fixture(scope="session", autouse=True)
def _cheap_passwords() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        cheap = partial(argon2.PasswordHasher, time_cost=1, memory_cost=64, parallelism=1)
        monkeypatch.setattr(argon2, "PasswordHasher", cheap)
        yield


@pytest.fixture(scope="session")
def archived(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an archive that has a session, a calibration, and a history."""
    from .http.populated import populate

    folder = tmp_path_factory.mktemp("archived")
    populate(folder)
    return folder
