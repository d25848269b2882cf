"""Passwords are hashed cheaply in these tests; one archive serves many of them."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import argon2
import pytest

from reseau.core.exclusive import lock_file

from ..lighter import few_results


@pytest.fixture(scope="session", autouse=True)
def _cheap_passwords() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        cheap = partial(argon2.PasswordHasher, time_cost=1, memory_cost=64, parallelism=1)
        monkeypatch.setattr(argon2, "PasswordHasher", cheap)
        yield


@pytest.fixture(scope="session")
def archived(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an archive that has a session, a calibration, and a history; one worker makes it."""
    from .http.populated import populate

    own = tmp_path_factory.mktemp("archived")
    if "PYTEST_XDIST_WORKER" not in os.environ:
        with few_results():
            populate(own)
        return own
    made = tmp_path_factory.getbasetemp().parent / "archived"
    with made.with_suffix(".lock").open("ab") as lock:
        while not lock_file(lock):
            time.sleep(0.1)
        if not made.exists():
            unfinished = made.with_suffix(f".{os.getpid()}")
            unfinished.mkdir()
            with few_results():
                populate(unfinished)
            unfinished.rename(made)
    shutil.copytree(made, own, dirs_exist_ok=True)
    return own
