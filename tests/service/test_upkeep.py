"""Backup, restore and upgrade; what the service prints for systemd; what it refuses to start with."""

from __future__ import annotations

import io
import sqlite3
from pathlib import Path

import pytest

from reseau.archive import Archive
from reseau.cli import run
from reseau.service.state import StateFolder
from reseau.service.wire import Certificates

PASSWORD = "correct horse battery"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    with Archive.open("archive", create=True) as archive:
        session = archive.begin("monday", "frames", {"count": 1}, inputs={"note.txt": "warm-up 1 h"})
        session.keep("result.txt", "42")
    monkeypatch.setattr("sys.stdin", io.StringIO(f"{PASSWORD}\n"))
    assert run(["service", "user", "add", "Ada", "--scope", "operate"]) == 0
    return tmp_path


def test_a_backup_is_restored_with_accounts_and_keys(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    certificates = Certificates(StateFolder.beside("archive"))
    certificates.export("192.0.2.5", folder / "attic")
    assert run(["service", "backup", "copy"]) == 0
    assert run(["service", "restore", "copy", "--archive", "again"]) == 0
    assert "1 sessions, 2 files" in capsys.readouterr().out
    # A worker on another machine goes on with the certificate that it has.
    Certificates(StateFolder.beside("again")).export("192.0.2.5", folder / "again-attic")
    authorities = [(folder / name / "authority.pem").read_bytes() for name in ("attic", "again-attic")]
    assert authorities[0] == authorities[1]
    with Archive.open("again") as archive:
        session = archive.session("monday")
        assert session.content(session.results()[0]) == b"42"
    assert run(["service", "user", "list", "--archive", "again"]) == 0
    assert "Ada: operate" in capsys.readouterr().out
    assert (folder / "again-service").stat().st_mode & 0o77 == 0


def test_a_damaged_backup_is_not_restored_silently(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["service", "backup", "copy"]) == 0
    victim = next(path for path in (folder / "copy/archive/objects").rglob("*.txt") if path.is_file())
    victim.chmod(0o600)
    victim.write_text("43")
    assert run(["service", "restore", "copy", "--archive", "again"]) == 1
    assert "is not whole" in capsys.readouterr().err


def test_nothing_is_overwritten(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["service", "backup", "copy"]) == 0
    assert run(["service", "backup", "copy"]) == 2
    assert run(["service", "restore", "copy"]) == 2
    assert "is there already" in capsys.readouterr().err


def test_an_archive_without_journals_is_upgraded(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    raw = sqlite3.connect("archive/index.sqlite")
    raw.execute("DROP TABLE entries")
    raw.commit()
    raw.close()
    assert run(["service", "upgrade"]) == 0
    assert "upgraded: journals" in capsys.readouterr().out
    assert run(["service", "upgrade"]) == 0
    assert "present version" in capsys.readouterr().out


def test_the_unit_of_systemd_names_program_archive_and_benches(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["service", "unit", "--bench", "bench.toml"]) == 0
    text = capsys.readouterr().out
    assert f"--archive {folder}/archive --state /var/lib/reseau --bench {folder}/bench.toml" in text
    assert run(["service", "unit", "--archive", "a b"]) == 2


def test_wrong_starts_are_refused_in_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (
        ["--host", "0.0.0.0"],
        ["--host", "example.org"],
        ["--certificate", "none.pem"],
        ["--proxy", "http://bench.example.org"],
        ["--host-name", "bench.example.org"],
    ):
        assert run(["serve", *arguments]) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_short_password_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("short\n"))
    assert run(["service", "user", "add", "Bob"]) == 2
