"""The index of an archive filled as after years, without the files of its frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from itertools import islice
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from reseau.archive import Archive, schema

__all__ = ["FIRST", "fill_index"]

FIRST = datetime(2026, 3, 2, tzinfo=UTC)
"""When the first session began."""
_AT_ONCE = 5000


def fill_index(
    archive: Archive,
    sessions: int,
    frames: int,
    results: Mapping[str, str],
    *,
    apart: timedelta = timedelta(hours=1),
    session: Mapping[str, Any],
    frame: Mapping[str, Any],
) -> None:
    """Add sessions that are done, their frames with verdicts, and their results.

    Parameters
    ----------
    archive : Archive
        An empty archive.
    sessions, frames : int
        Number of sessions, `session 0` and so on, and of the frames of each.
    results : mapping of str to str
        Name and hash of each result; an empty hash stands for one that no other session has.
    apart : timedelta
        From the beginning of a session to that of the next.
    session, frame : mapping
        Other columns of all sessions and frames.
    """
    numbers = range(1, sessions + 1)
    rows: dict[sa.Table, Iterator[dict[str, object]]] = {
        schema.sessions: (
            {"name": f"session {k - 1}", "begun": FIRST + k * apart, "software": "reseau", **session}
            for k in numbers
        ),
        schema.ends: ({"session_id": k, "status": "done", "why": "", "at": FIRST} for k in numbers),
        schema.frames: (
            {
                "session_id": k, "step": f"{n:05}", "kind": "frame", "take": 0, "suffix": ".tif",
                "sha256": f"{k * 1000 + n:064x}", "stored": FIRST, **frame,
            }
            for k in numbers for n in range(frames)
        ),
        schema.verdicts: (
            {"frame_id": k, "ok": True, "why": "", "facts": {"points": 380}}
            for k in range(1, sessions * frames + 1)
        ),
        schema.results: (
            {
                "session_id": k, "name": name, "suffix": Path(name).suffix, "sha256": sha256 or f"{k:064x}",
                "parameters": {}, "software": "reseau", "size": 60000, "stored": FIRST,
            }
            for k in numbers for name, sha256 in results.items()
        ),
    }  # fmt: skip
    with archive._engine.begin() as connection:
        for table, each in rows.items():
            while part := list(islice(each, _AT_ONCE)):
                connection.execute(sa.insert(table), part)
