"""Shared by the tests: reference data, not part of the project, archives, kept pictures, no time limits."""

from __future__ import annotations

import gc
import os
import uuid
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest
import scipy.linalg  # noqa: F401  # loads a library of its own beside that of NumPy
import sqlalchemy as sa
from hypothesis import settings

from reseau.archive import Archive
from reseau.core.memory import keep_loaded
from reseau.core.threads import always_one_thread

from . import kept
from .lighter import few_poses, few_results

# A loaded machine, or code that is compiled at its first call, is not an error.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

_AROUND = {"cameras", "capture", "cli", "exchange", "http", "service", "sessions", "tests"}
"""Folders of tests of what is done with calibrations."""
_BEFORE = {"procedures", "report"}
"""Folders of tests of what comes before, which is measured and drawn."""
collect_ignore = ["capture/loaded.py"]
_BESIDE = Path(__file__).resolve().parents[2] / "shared" / "data"


# Workers share the processors: so do the commands that tests start.
always_one_thread()
os.environ |= {name: os.environ.get(name, "1") for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}


# What is imported and collected stays.
gc.disable()


def pytest_collection_finish() -> None:
    """Look through what tests make, and not through all modules again."""
    keep_loaded()
    gc.enable()


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


@pytest.fixture
def postgres() -> Iterator[str]:
    """URL of an empty schema of the PostgreSQL server that RESEAU_POSTGRES names (`.ci/with_postgres`)."""
    url = os.environ.get("RESEAU_POSTGRES", "")
    if not url:
        pytest.skip("RESEAU_POSTGRES names no server")
    name = f"test_{uuid.uuid4().hex}"
    server = sa.create_engine(url)
    with server.begin() as connection:
        connection.execute(sa.text(f"CREATE SCHEMA {name}"))
    yield f"{url}?options=-csearch_path%3D{name}"
    with server.begin() as connection:
        connection.execute(sa.text(f"DROP SCHEMA {name} CASCADE"))
    server.dispose()


@pytest.fixture(params=["SQLite", "PostgreSQL"])
def opened(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[], Archive]:
    """Opens the same archive, with either index, as often as it is called."""
    if request.param == "SQLite":
        return lambda: Archive.open(tmp_path / "archive", create=True)
    url = request.getfixturevalue("postgres")
    return lambda: Archive.open(url, tmp_path / "objects", create=True)


@pytest.fixture(autouse=True, scope="session")
def assets(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep images of readings out of the project."""
    os.environ["RESEAU_ASSETS"] = str(tmp_path_factory.mktemp("assets"))


@pytest.fixture(autouse=True, scope="module")
def _lighter(request: pytest.FixtureRequest) -> Iterator[None]:
    """Where what follows is tested, long parts are shorter."""
    around = request.path.parent.name
    shorter = few_results if around in _AROUND else few_poses if around in _BEFORE else nullcontext
    with shorter():
        yield


@pytest.fixture(autouse=True, scope="session")
def pictures(request: pytest.FixtureRequest) -> None:
    """Keep drawn pictures in pytest's cache."""
    cache: pytest.Cache | None = getattr(request.config, "cache", None)
    if cache is not None:
        kept.FOLDER = cache.mkdir("pictures")
        kept.clear_unused(kept.FOLDER)
