"""The archive stores its content in a folder, in an object store, and with PostgreSQL as index."""

import json
import os
import subprocess
import sys
import textwrap
import threading
import time
import uuid
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from reseau.archive import Archive, Verdict, schema, tiff_of
from reseau.archive.exporting import describe, export
from reseau.archive.objects import LocalObjects, RemoteObjects
from reseau.archive.picture import frame_of
from reseau.archive.verification import verify
from reseau.core.data import Frame
from reseau.core.errors import ArchiveError, UsageError


def frame(seed: int = 0, dtype: type = np.uint8) -> Frame:
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 200, (12, 16)).astype(dtype)
    return Frame(pixels, 255.0 if dtype == np.uint8 else 65535.0, f"frame {seed}")


@pytest.fixture(params=["folder", "object store", "PostgreSQL"])
def opened(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[], Archive]:
    """Opens the same archive as often as it is called."""
    if request.param == "PostgreSQL":
        url = request.getfixturevalue("postgres")
        return lambda: Archive.open(url, tmp_path / "objects", create=True)
    store = f"memory://{uuid.uuid4().hex}" if request.param == "object store" else None
    return lambda: Archive.open(tmp_path / "archive", store, create=True)


def test_stored_content_is_present_after_reopening(opened: Callable[[], Archive]) -> None:
    with opened() as archive:
        session = archive.begin("first", "frames", {"count": 2}, "schema = 'reseau-bench/1'")
        kept = session.store("0", frame(1), facts={"gain": 2.5}, clock={"taken": "2026-01-01T00:00:00Z"})
        session.judge(kept, Verdict(False, "blurred", {"targets": 3}))
        session.judge(kept, Verdict(True))
        session.keep("result.json", "{}\n", {"a": 1}, {"frame": kept.sha256})
        session.note("0", "start", {"x": [1, 2]})
        session.end("done")
    with opened() as archive:
        (summary,) = archive.sessions()
        assert (summary.name, summary.plan, summary.frames, summary.results, summary.status) == (
            "first",
            "frames",
            1,
            1,
            "done",
        )
        assert summary.begun.tzinfo is not None
        session = archive.session("first")
        (found,) = session.frames()
        assert found.facts == {"gain": 2.5}
        assert found.clock == {"taken": "2026-01-01T00:00:00Z"}
        assert found.verdict == Verdict(True)
        picture = session.picture(found)
        np.testing.assert_array_equal(picture.pixels, frame(1).pixels)
        assert (picture.full_scale, picture.name, picture.sha256) == (255.0, "frame 1", found.sha256)
        (result,) = session.results()
        assert session.content(result) == b"{}\n"
        assert (result.parameters, result.inputs) == ({"a": 1}, {"frame": found.sha256})
        assert result.software.startswith("reseau ")
        assert list(session.notes()) == [("start", {"x": [1, 2]})]


def test_a_frame_stored_twice_is_stored_once(opened: Callable[[], Archive]) -> None:
    with opened() as archive:
        session = archive.begin("s", "frames", {})
        first = session.store("7", frame(1))
        again = session.store("7", frame(2))
        other = session.store("7", frame(2), take=1)
        assert again == first
        assert other.sha256 != first.sha256
        assert [f.take for f in session.frames("7")] == [0, 1]


def test_the_index_refuses_to_change_or_delete_anything(opened: Callable[[], Archive]) -> None:
    with opened() as archive:
        session = archive.begin("s", "frames", {})
        session.store("0", frame())
        for statement in ("UPDATE frames SET step = '1'", "DELETE FROM frames", "DELETE FROM sessions"):
            with (
                pytest.raises(sa.exc.DBAPIError, match="append only"),
                archive._engine.begin() as connection,
            ):
                connection.execute(sa.text(statement))


def test_a_name_is_unique_and_an_unknown_one_is_refused(opened: Callable[[], Archive]) -> None:
    with opened() as archive:
        archive.begin("s", "frames", {})
        with pytest.raises(ArchiveError, match="--resume"):
            archive.begin("s", "frames", {})
        with pytest.raises(ArchiveError, match="is not a session"):
            archive.session("t")
        for name in ("../s", "a\\b", "", " ", " a", ".a", "a\nb", "a\0b"):
            with pytest.raises(UsageError, match="is not a valid name"):
                archive.begin(name, "frames", {})


def test_a_session_contains_its_inputs_from_the_beginning(opened: Callable[[], Archive]) -> None:
    with opened() as archive:
        session = archive.begin("s", "testfield", {}, inputs={"design.json": "{}", "field.csv": "ä"})
        session.store("0", frame())
        assert {name: each.kind for name, each in session.inputs().items()} == {
            "design.json": "input",
            "field.csv": "input",
        }
        assert session.input("field.csv") == "ä"
        with pytest.raises(ArchiveError, match=r"s: has no input other\.json"):
            session.input("other.json")
        with pytest.raises(ArchiveError, match="--resume"):
            archive.begin("s", "testfield", {}, inputs={"more.json": "[]"})
        assert len(session.inputs()) == 2
        assert [each.frames for each in archive.sessions()] == [1]  # what was given is no frame
        assert verify(archive).files == 3


def test_verification_finds_changed_missing_and_unindexed_files(tmp_path: Path) -> None:
    with Archive.open(tmp_path, create=True) as archive:
        session = archive.begin("s", "frames", {})
        kept = [session.store(str(k), frame(k)) for k in range(3)]
        assert verify(archive)
        objects = archive.objects
        assert isinstance(objects, LocalObjects)
        changed = objects.path(kept[0].sha256, ".tif")
        data = bytearray(changed.read_bytes())
        data[-1] ^= 1
        changed.write_bytes(data)
        objects.path(kept[1].sha256, ".tif").unlink()
        objects.put(b"of a process that was killed", ".png")
        found = verify(archive)
        assert not found
        assert [line.split(":")[0] for line in found.damaged] == ["s/0/frame", "s/1/frame"]
        assert "SHA-256 differs" in found.damaged[0]
        assert len(found.unknown) == 1
        # One killed process has left a temporary file; another one is writing.
        folder = Path(objects.place) / "ab"
        folder.mkdir(exist_ok=True)
        for name, age_s in ((".left", 3600.0), (".writing", 0.0)):
            (folder / name).write_bytes(b"half")
            os.utime(folder / name, (time.time() - age_s,) * 2)
        assert verify(archive).temporary == (str(folder / ".left"),)
        with pytest.raises(ArchiveError, match="backup"):
            session.picture(kept[0])
        # Storing the same again mends it.
        objects.put(tiff_of(frame(1), {"session": "s", "step": "1", "kind": "frame", "take": 0}), ".tif")
        assert len(verify(archive).damaged) == 1


def test_parts_of_a_file_are_read_and_a_change_of_it_is_noticed(tmp_path: Path) -> None:
    objects = LocalObjects(tmp_path)
    sha256 = objects.put(bytes(range(200)), ".raw")
    for _ in range(2):
        with objects.open(sha256, ".raw") as stream:
            stream.seek(100)
            assert stream.read(3) == bytes((100, 101, 102))
    path = objects.path(sha256, ".raw")
    path.write_bytes(bytes(reversed(range(200))))
    os.utime(path, ns=(0, 0))
    with pytest.raises(ArchiveError, match="has been changed"):
        objects.open(sha256, ".raw")
    path.unlink()
    with pytest.raises(ArchiveError, match="cannot be read"):
        objects.open(sha256, ".raw")
    remote = RemoteObjects(f"memory://{tmp_path.name}")
    with remote.open(remote.put(b"pixels", ".raw"), ".raw") as stream:
        assert stream.read(3) == b"pix"


@pytest.mark.parametrize("left", [b"", b"pix", b"pixelz"])
def test_a_file_that_a_power_failure_left_partial_is_written_again(tmp_path: Path, left: bytes) -> None:
    objects = LocalObjects(tmp_path, durable=False)
    sha256 = objects.put(b"pixels", ".raw")
    objects.path(sha256, ".raw").write_bytes(left)
    with pytest.raises(ArchiveError, match="has been changed"):
        objects.get(sha256, ".raw")
    assert objects.put(b"pixels", ".raw") == sha256
    assert objects.get(sha256, ".raw") == b"pixels"


def test_a_frame_on_the_disk_but_not_in_the_index_is_recovered(opened: Callable[[], Archive]) -> None:
    with opened() as archive:
        session = archive.begin("s", "frames", {})
        archive.begin("t", "frames", {})
        session.store("0", frame(0))
        lost = {"gain": 1.0, "session": "s", "step": "1", "kind": "frame", "take": 0}
        sha256 = archive.objects.put(tiff_of(frame(1), lost), ".tif")
        archive.objects.put(tiff_of(frame(2), lost | {"session": "t"}), ".tif")
        archive.objects.put(b"no TIFF", ".tif")
        (found,) = session.recover()
        assert (found.step, found.sha256, found.facts) == ("1", sha256, {"gain": 1.0})
        assert session.recover() == []
        assert [f.step for f in session.frames()] == ["0", "1"]


def test_a_session_is_exported_to_the_same_bytes_each_time(tmp_path: Path) -> None:
    with Archive.open(tmp_path / "a", create=True) as archive:
        session = archive.begin("s", "frames", {}, "bench")
        kept = session.store("phi 30/κ", frame(), clock={"taken": "now"})
        session.store("phi 30/κ", b"\x89PNG", kind="screen", suffix=".png")
        session.keep("camera.json", "{}", inputs={"0": kept.sha256})
        assert export(session, tmp_path / "one.zip") == export(session, tmp_path / "two.zip") == 5
        assert (tmp_path / "one.zip").read_bytes() == (tmp_path / "two.zip").read_bytes()
        with zipfile.ZipFile(tmp_path / "one.zip") as made:
            assert made.testzip() is None
            about = json.loads(made.read("session.json"))
            data = made.read(about["frames"][0]["file"])
        assert about == describe(session)
        np.testing.assert_array_equal(frame_of(data, "zip")[0].pixels, frame().pixels)
        assert list(about["times"]["frames"][0]) == ["taken"]
        assert "taken" not in json.dumps(about["frames"])
        with pytest.raises(ArchiveError, match="cannot be written"):
            export(session, tmp_path / "none" / "one.zip")


@given(
    pixels=hnp.arrays(
        st.sampled_from([np.uint8, np.uint16, np.float32]),
        st.tuples(st.integers(2, 9), st.integers(2, 9)),
        elements={"allow_nan": False, "allow_infinity": False},
    ),
    facts=st.dictionaries(st.text(max_size=9), st.floats(allow_nan=False, allow_infinity=False) | st.text()),
)
@settings(deadline=None, max_examples=40)
def test_pixels_and_metadata_survive_storage_as_tiff(pixels: np.ndarray, facts: dict[str, object]) -> None:
    data = tiff_of(Frame(pixels, 4095.0, "näme"), facts)
    assert data == tiff_of(Frame(pixels, 4095.0, "näme"), facts)
    found, about = frame_of(data, "here")
    np.testing.assert_array_equal(found.pixels, pixels)
    assert found.pixels.dtype == pixels.dtype
    assert (about, found.name, found.full_scale) == (facts, "näme", 4095.0)


@given(data=st.binary(max_size=300))
@settings(deadline=None, max_examples=60)
def test_bytes_that_are_not_a_frame_are_refused(data: bytes) -> None:
    with pytest.raises(ArchiveError, match="is not a frame"):
        frame_of(data, "here")


def test_a_file_too_large_for_the_disk_leaves_nothing_behind(tmp_path: Path) -> None:
    """A limit of the process simulates a full disk: a write fails in the middle of a file."""
    script = """
        import resource, sys
        from pathlib import Path
        from reseau.archive import Archive
        from reseau.core.data import Frame
        from reseau.core.errors import ArchiveError
        import numpy as np
        with Archive.open(sys.argv[1], create=True) as archive:
            session = archive.begin("s", "frames", {})
            session.store("0", Frame(np.zeros((8, 8), np.uint8), 255.0))
            limit = resource.getrlimit(resource.RLIMIT_FSIZE)
            resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limit[1]))
            try:
                session.store("1", Frame(np.zeros((800, 800), np.uint8), 255.0))
            except ArchiveError as error:
                print(error)
            resource.setrlimit(resource.RLIMIT_FSIZE, limit)
            session.store("1", Frame(np.zeros((800, 800), np.uint8), 255.0))
            print([f.step for f in session.frames()])
        """
    message = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script), str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    assert message == [
        f"{tmp_path / 'objects'}: cannot be stored (File too large); free disk space or name another archive",
        "['0', '1']",
    ]
    assert len([p for p in (tmp_path / "objects").rglob("*") if p.is_file()]) == 2


def test_unusable_locations_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(ArchiveError, match="is not an archive; create one with `reseau capture`"):
        Archive.open(tmp_path / "none")
    (tmp_path / "file").write_text("x")
    with pytest.raises(ArchiveError, match="cannot be created"):
        Archive.open(tmp_path / "file", create=True)
    (tmp_path / "index.sqlite").write_bytes(b"no database, but a text that is long enough" * 20)
    with pytest.raises(ArchiveError, match="not a database"):
        Archive.open(tmp_path)
    with pytest.raises(ArchiveError, match="--objects"):
        Archive.open("postgresql+psycopg://localhost/none")
    with pytest.raises(ArchiveError, match="cannot be used as an index"):
        Archive.open("nosuch://localhost/none", tmp_path)
    with pytest.raises(ArchiveError, match="object store"):
        RemoteObjects("nosuch://bucket")
    with pytest.raises(ArchiveError, match=r"localhost:1/none.*refused"):
        Archive.open("postgresql+psycopg://me:secret@localhost:1/none", tmp_path)


def test_a_password_is_never_shown(tmp_path: Path) -> None:
    with pytest.raises(ArchiveError) as raised:
        Archive.open("postgresql+psycopg://me:secret@localhost:1/none", tmp_path)
    assert "secret" not in str(raised.value)


def test_an_archive_on_a_read_only_disk_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Archive.open(tmp_path, create=True) as archive:
        archive.begin("s", "frames", {}).store("0", frame())
    # Permissions do not bind root, who runs tests in containers: the answer to the question is given here.
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)
    with Archive.open(tmp_path) as archive:
        session = archive.session("s")
        assert session.picture(session.frames()[0]).pixels.shape == (12, 16)
        assert verify(archive)
        with pytest.raises(ArchiveError, match="readonly"):
            session.end("done")


def test_entries_in_the_log_of_a_killed_process_are_read_on_a_read_only_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = """
        import os, sys
        import numpy as np
        from reseau.archive import Archive
        from reseau.core.data import Frame
        archive = Archive.open(sys.argv[1], create=True)
        session = archive.begin("s", "frames", {})
        for k in range(3):
            session.store(str(k), Frame(np.full((8, 8), k, np.uint8), 255.0))
        os._exit(9)
        """
    subprocess.run([sys.executable, "-c", textwrap.dedent(script), str(tmp_path)], check=False)
    assert (tmp_path / "index.sqlite-wal").stat().st_size > 0
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)
    with Archive.open(tmp_path) as archive:
        assert [f.step for f in archive.session("s").frames()] == ["0", "1", "2"]
        with pytest.raises(ArchiveError, match="readonly"):
            archive.session("s").end("done")
    with pytest.raises(ArchiveError, match="is read-only; name another archive"):
        Archive.open(tmp_path, create=True)


def test_a_damaged_index_is_reported(tmp_path: Path) -> None:
    with Archive.open(tmp_path, create=True) as archive:
        session = archive.begin("s", "frames", {})
        for k in range(50):
            session.store(str(k), frame(k), facts={"gain": 2.5})
        assert verify(archive)
    index = tmp_path / "index.sqlite"
    sound = index.read_bytes()
    index.write_bytes(sound.replace(b'{"gain": ', b'{"gain"# '))
    with Archive.open(tmp_path) as archive, pytest.raises(ArchiveError, match=r"Expecting ':'"):
        archive.session("s").frames()
    # A page of one of the indices: what is asked for below does not go there.
    with sa.create_engine(f"sqlite:///{index}").connect() as connection:
        root = connection.scalar(
            sa.text("SELECT rootpage FROM sqlite_master WHERE name = 'ix_frames_sha256'")
        )
    page = int.from_bytes(sound[16:18], "big")
    index.write_bytes(sound[: (root - 1) * page] + bytes(page) + sound[root * page :])
    with Archive.open(tmp_path) as archive:
        found = verify(archive)
        assert not found
        assert len(found.damaged) >= 1
        assert all(line.startswith("index: ") for line in found.damaged)


@pytest.mark.slow
def test_two_processes_can_write_to_one_archive(tmp_path: Path) -> None:
    script = """
        import sys
        import numpy as np
        from reseau.archive import Archive
        from reseau.core.data import Frame
        with Archive.open(sys.argv[1], create=True) as archive:
            session = archive.begin(sys.argv[2], "frames", {})
            for k in range(20):
                session.store(str(k), Frame(np.full((8, 8), k, np.uint8), 255.0))
        """
    command = [sys.executable, "-c", textwrap.dedent(script), str(tmp_path)]
    started = [subprocess.Popen([*command, name]) for name in "ab"]
    assert [process.wait(60) for process in started] == [0, 0]
    with Archive.open(tmp_path) as archive:
        assert [(s.name, s.frames) for s in sorted(archive.sessions(), key=lambda s: s.name)] == [
            ("a", 20),
            ("b", 20),
        ]
        assert verify(archive).files == 40


def test_who_reads_up_to_a_number_misses_no_smaller_one(opened: Callable[[], Archive]) -> None:
    # Two benches write at once; what the first one writes is committed last.
    with opened() as first, opened() as second:
        one, two = (archive.begin(name, "frames", {}) for archive, name in ((first, "a"), (second, "b")))
        other = threading.Thread(target=two.note, args=("0", "event", {}))
        with schema.connected(first._engine) as connection:
            row = {"session_id": one._id, "key": "0", "kind": "event", "document": {}}
            connection.execute(schema.events.insert().values(row))
            other.start()
            other.join(1.0)  # long enough to be committed, if it could be
            seen = second.notes()
        other.join(60.0)
        seen += second.notes(after=max((each.number for each in seen), default=0))
        assert sorted(each.session for each in seen) == ["a", "b"]


def test_files_are_in_folders_of_the_first_two_letters_of_their_hash(tmp_path: Path) -> None:
    name = LocalObjects(tmp_path).put(b"pixels", ".raw")
    assert (tmp_path / name[:2] / f"{name}.raw").read_bytes() == b"pixels"
