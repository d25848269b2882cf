"""The audit log: what is changed, left out, cut off, forged or reordered in it is found."""

from __future__ import annotations

import json
import sqlite3
import threading
from pathlib import Path
from typing import Any

import pytest

from reseau.archive import Archive
from reseau.cli import run
from reseau.core.errors import ArchiveError
from reseau.service.audit import Audit
from reseau.service.state import StateFolder


@pytest.fixture
def place(tmp_path: Path) -> Path:
    with Archive.open(tmp_path / "archive", create=True) as archive:
        audit = Audit(archive, StateFolder.beside(str(tmp_path / "archive")))
        for k in range(4):
            audit.record("Ada", "login", "jog", "bench cellar", {"axis": "tilt", "by": 0.1 * k})
    return tmp_path


def faults(place: Path, heads: Any = ()) -> list[str]:
    with Archive.open(place / "archive") as archive:
        return Audit(archive, StateFolder.beside(str(place / "archive"))).verify(heads)


def tampered(place: Path, *statements: str) -> None:
    """Change the database as somebody with its file can."""
    raw = sqlite3.connect(place / "archive" / "index.sqlite")
    for verb in ("update", "delete"):
        raw.execute(f"DROP TRIGGER IF EXISTS entries_no_{verb}")
    for each in statements:
        raw.execute(each)
    raw.commit()
    raw.close()


def test_a_whole_log_is_whole(place: Path) -> None:
    assert faults(place) == []


def test_what_was_whole_is_verified_again_only_when_asked(place: Path) -> None:
    state = StateFolder.beside(str(place / "archive"))
    with Archive.open(place / "archive") as archive:
        audit = Audit(archive, state)
        assert audit.verify(again=False) == []
        tampered(place, "UPDATE entries SET document = replace(document, 'tilt', 'roll') WHERE key = '2'")
        audit.record("Ada", "login", "home", "bench cellar")
        assert audit.verify(again=False) == []
        assert audit.verify()[0] == "entry 2 was changed"
        tampered(place, "DELETE FROM entries WHERE key = '5'")
        assert audit.verify(again=False)[-1] == "entries after 4 are missing: a head names entry 5"


def test_the_database_refuses_a_change(place: Path) -> None:
    raw = sqlite3.connect(place / "archive" / "index.sqlite")
    for each in ("UPDATE entries SET document = '{}'", "DELETE FROM entries"):
        with pytest.raises(sqlite3.IntegrityError, match="append only"):
            raw.execute(each)
    raw.close()


@pytest.mark.parametrize(
    ("statement", "found"),
    [
        (
            "UPDATE entries SET document = replace(document, 'tilt', 'roll') WHERE key = '2'",
            "entry 2 was changed",
        ),
        ("DELETE FROM entries WHERE key = '2'", "entry 2 is missing"),
        ("DELETE FROM entries WHERE key = '4'", "entries after 3 are missing"),
        ("DELETE FROM entries", "entries after 0 are missing"),
        ("UPDATE entries SET document = replace(document, '\"number\": 2', '\"number\": 3') WHERE key = '2'",
         "entry 2 is missing"),
    ],
)  # fmt: skip
def test_a_change_of_the_database_is_found(place: Path, statement: str, found: str) -> None:
    tampered(place, statement)
    assert any(found in each for each in faults(place)), faults(place)


def test_an_entry_that_was_forged_with_its_hashes_has_no_signature(place: Path) -> None:
    from reseau.service.audit import _digest

    with Archive.open(place / "archive") as archive:
        last = archive.journal("audit").entries()[-1].document
        document = {k: v for k, v in last.items() if k not in ("hash", "signature")}
        document |= {"number": 5, "previous": last["hash"], "by": "Eve"}
        forged = document | {"hash": _digest(document), "signature": last["signature"]}
        archive.journal("audit").append("5", "audit", forged)
    assert faults(place) == ["entry 5 is not signed with this key"]


def test_a_head_that_was_kept_elsewhere_shows_a_log_turned_back_with_its_key(place: Path) -> None:
    state = StateFolder.beside(str(place / "archive"))
    before = state.path("audit-head.json").read_bytes()
    with Archive.open(place / "archive") as archive:
        audit = Audit(archive, state)
        audit.record("Ada", "login", "home", "bench cellar")
        kept = audit.head()
    tampered(place, "DELETE FROM entries WHERE key = '5'")
    state.path("audit-head.json").write_bytes(before)
    assert faults(place) == []
    assert faults(place, [kept]) == ["entries after 4 are missing: a head names entry 5"]


def test_a_missing_head_is_found(place: Path) -> None:
    StateFolder.beside(str(place / "archive")).path("audit-head.json").unlink()
    assert faults(place) == ["there is no head beside the key: the end may have been cut off"]


def test_several_writers_make_one_chain(place: Path) -> None:
    def write() -> None:
        with Archive.open(place / "archive") as archive:
            audit = Audit(archive, StateFolder.beside(str(place / "archive")))
            for _ in range(5):
                audit.record("Bob", "token", "jog", "bench cellar")

    threads = [threading.Thread(target=write) for _ in range(3)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert [each for each in faults(place) if "head" not in each] == []
    with Archive.open(place / "archive") as archive:
        assert len(archive.journal("audit").entries()) == 19


def test_the_commands_verify_and_print_the_head(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place)
    assert run(["audit", "head"]) == 0
    head = capsys.readouterr().out.strip()
    assert run(["audit", "verify", "--head", head, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["entries"] == 4
    assert run(["audit", "verify", "--public-key", "archive-service/audit-public.pem", "--head", head]) == 0
    tampered(place, "DELETE FROM entries WHERE key = '4'")
    assert run(["audit", "verify", "--head", head]) == 1
    assert "entries after 3 are missing" in capsys.readouterr().out


def test_what_cannot_be_recorded_is_an_error(place: Path) -> None:
    with Archive.open(place / "archive") as archive:
        audit = Audit(archive, StateFolder.beside(str(place / "archive")))
        raw = sqlite3.connect(place / "archive" / "index.sqlite")
        raw.execute(
            "CREATE TRIGGER full BEFORE INSERT ON entries BEGIN SELECT RAISE(ABORT, 'disk full'); END"
        )
        raw.commit()
        raw.close()
        with pytest.raises(ArchiveError, match="disk full"):
            audit.record("Ada", "login", "jog", "bench cellar")
