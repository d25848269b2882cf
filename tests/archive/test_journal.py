"""Journals: unique keys, order, and archives of earlier versions."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

import pytest
import sqlalchemy as sa

from reseau.archive import Archive


def test_entries_are_read_back_in_order_with_their_times(opened: Callable[[], Archive]) -> None:
    at = datetime(2026, 3, 29, 1, 30, tzinfo=UTC)
    with opened() as archive:
        archive.journal("lens").append("b", "note", {"x": [1, 2.5, None]}, at)
        archive.journal("lens").append("a", "event", {})
        archive.journal("other").append("a", "note", {})
    with opened() as archive:
        journal = archive.journal("lens")
        assert [each.key for each in journal.entries()] == ["b", "a"]
        (found,) = journal.entries("note")
        assert (found.document, found.at) == ({"x": [1, 2.5, None]}, at)
        assert archive.journals("le") == ["ns"]
        assert archive.journals() == ["lens", "other"]


def test_of_processes_that_append_the_same_key_one_succeeds(opened: Callable[[], Archive]) -> None:
    def append(who: int) -> bool:
        with opened() as archive:
            return all(archive.journal("lens").append(f"{k}-{who}", "note", {}) for k in range(3)) and (
                archive.journal("lens").append("claim", "note", {"who": who}) is not None
            )

    with opened() as archive:
        archive.journal("lens").append("start", "note", {})
    with ThreadPoolExecutor(4) as pool:
        assert sum(pool.map(append, range(8))) == 1


def test_entries_are_never_changed(opened: Callable[[], Archive]) -> None:
    with opened() as archive:
        archive.journal("lens").append("a", "note", {})
        for statement in ("UPDATE entries SET kind = 'x'", "DELETE FROM entries"):
            with pytest.raises(sa.exc.DBAPIError, match="append only"), archive._engine.begin() as connection:
                connection.execute(sa.text(statement))


def test_an_archive_of_an_earlier_version_gets_journals_when_the_first_entry_is_appended(
    opened: Callable[[], Archive],
) -> None:
    with opened() as archive:
        archive.begin("monday", "frames", {})
        with archive._engine.begin() as connection:
            connection.execute(sa.text("DROP TABLE entries"))
    with opened() as archive:
        assert archive.journals() == archive.journal("lens").entries() == []
        assert not sa.inspect(archive._engine).has_table("entries")
        assert archive.journal("lens").append("a", "note", {})
        assert [each.name for each in archive.sessions()] == ["monday"]
        with pytest.raises(sa.exc.DBAPIError, match="append only"), archive._engine.begin() as connection:
            connection.execute(sa.text("DELETE FROM entries"))


def test_a_read_only_archive_of_an_earlier_version_is_read_and_refuses_entries(tmp_path: Path) -> None:
    place = tmp_path / "archive"
    with Archive.open(place, create=True) as archive:
        archive.begin("monday", "frames", {})
        with archive._engine.begin() as connection:
            connection.execute(sa.text("DROP TABLE entries"))
    code = f"""
        import os
        from reseau.archive import Archive
        if os.getuid() == 0:
            os.setuid(65534)
        with Archive.open({str(place)!r}) as archive:
            print(archive.journal("lens").entries())
            try:
                archive.journal("lens").append("a", "note", {{}})
            except Exception as error:
                print(type(error).__name__)
    """
    for path in (place, *place.rglob("*")):
        path.chmod(0o555 if path.is_dir() else 0o444)
    for path in tmp_path.parents:
        if path.stat().st_uid == os.getuid() and path.is_relative_to("/tmp") and path != Path("/tmp"):
            path.chmod(path.stat().st_mode | 0o055)
    tmp_path.chmod(0o755)
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == ["[]", "ArchiveError"], done.stderr
