"""Frames that several cameras exposed at once: all are in the archive, or none is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from reseau.archive import Archive, Session
from reseau.core.data import Frame


def frames(shade: int) -> dict[str, Frame]:
    return {
        name: Frame(np.full((4, 6), shade + k, np.uint8), 255.0, name)
        for k, name in enumerate(("left", "right"))
    }


@pytest.fixture
def session(tmp_path: Path) -> Session:
    with Archive.open(tmp_path / "archive", create=True) as archive:
        return archive.begin("monday", "frames", {})


def test_a_set_is_stored_once_under_its_cameras(session: Session) -> None:
    facts = {"left": {"gain": 1.0}, "right": {"gain": 2.0}}
    stored = session.store_set("tilt 0", frames(7), facts=facts, clock={"left": {"skew_s": [1e-3]}})
    assert [each.step for each in stored] == ["left/tilt 0", "right/tilt 0"]
    left, right = session.frames(kind="frame")
    assert (left.facts["gain"], right.facts["gain"]) == (1.0, 2.0)
    assert left.facts["set"] == right.facts["set"]
    assert (left.facts["camera"], left.facts["exposure"]) == ("left", "tilt 0")
    assert left.clock == {"skew_s": [1e-3]}
    again = session.store_set("tilt 0", frames(9))
    assert [each.id for each in again] == [left.id, right.id]
    # The same pixels and facts give the same file, whenever they were taken.
    other = session.store_set("tilt 0", frames(7), take=1, facts=facts)
    assert other[0].facts["set"] == left.facts["set"]


def killed_while_writing(session: Session, monkeypatch: pytest.MonkeyPatch, shade: int, files: int) -> None:
    """A process that ends when so many files are written, before anything is in the index."""
    put, written = session.objects.put, 0

    def writing(data: bytes, suffix: str) -> str:
        nonlocal written
        if written == files:
            raise KeyboardInterrupt
        written += 1
        return put(data, suffix)

    def entering(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(session.objects, "put", writing)
        patched.setattr(session, "_enter", entering)
        with pytest.raises(KeyboardInterrupt):
            session.store_set("tilt 0", frames(shade))


def test_a_complete_set_is_recovered_and_a_partial_one_is_not(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed_while_writing(session, monkeypatch, 7, files=1)
    assert session.recover() == []
    killed_while_writing(session, monkeypatch, 20, files=2)
    found = session.recover()
    assert [each.step for each in found] == ["left/tilt 0", "right/tilt 0"]
    # Of the first exposure only the left frame was written: it is not joined with the right one of the other.
    assert [int(session.picture(each).pixels[0, 0]) for each in found] == [20, 21]
    assert session.recover() == []
    assert len(session.frames(kind="frame")) == 2
