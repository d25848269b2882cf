"""Export a session to a zip: frames and results as files with readable names, and a table of contents."""

from __future__ import annotations

import os
import re
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..core.errors import ArchiveError
from ..core.provenance import canonical_json
from .records import ArchivedFrame
from .session import Session

_SCHEMA = "reseau-session/1"


def describe(session: Session) -> dict[str, Any]:
    """Return the whole index entry of a session as JSON values, with all times in one block.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.archive import Archive
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     describe(archive.begin("monday", "frames", {"count": 2}))["parameters"]
    {'count': 2}
    """
    frames, results = session.frames(), session.results()
    return {
        "schema": _SCHEMA,
        "name": session.name,
        "plan": session.plan,
        "parameters": session.parameters,
        "software": session.software,
        "status": session.status,
        "frames": [
            {
                "step": f.step,
                "kind": f.kind,
                "take": f.take,
                "file": _file(k, f),
                "sha256": f.sha256,
                "facts": f.facts,
            }
            | ({} if f.verdict is None else {"ok": f.verdict.ok, "why": f.verdict.why})
            for k, f in enumerate(frames)
        ],
        "results": [
            {"name": r.name, "sha256": r.sha256, "parameters": r.parameters, "inputs": r.inputs}
            | {"software": r.software}
            for r in results
        ],
        "times": {"begun": session.begun.isoformat(), "frames": [f.clock for f in frames]},
    }


def _file(number: int, frame: ArchivedFrame) -> str:
    """Name of a frame in the zip; the number keeps the order and makes it unique."""
    plain = re.sub(r"[^\w.+-]+", "_", f"{frame.step}_{frame.kind}")
    take = f"_take{frame.take}" if frame.take else ""
    return f"frames/{number:04d}_{plain}{take}{frame.suffix}"


def export(session: Session, path: Path) -> int:
    """Write a session to a zip file, atomically; the same session gives the same bytes.

    Returns
    -------
    int
        Number of files in the zip.

    Raises
    ------
    ArchiveError
        If a file of the session is lost or damaged, or the zip cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.archive import Archive
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     export(archive.begin("monday", "frames", {"count": 2}), Path(folder) / "monday.zip")
    1
    """
    about = describe(session)
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with zipfile.ZipFile(draft, "w", zipfile.ZIP_STORED) as target:
            _add(target, "session.json", canonical_json(about).encode())
            if session.bench:
                _add(target, "bench.toml", session.bench.encode())
            for row, frame in zip(about["frames"], session.frames(), strict=True):
                _add(target, row["file"], session.objects.get(frame.sha256, frame.suffix))
            for number, result in enumerate(session.results()):
                _add(target, f"results/{number:03d}_{result.name}", session.content(result))
            count = len(target.namelist())
        draft.replace(path)
    except OSError as error:
        raise ArchiveError(f"cannot be written ({error.strerror})", where=path) from None
    finally:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
    return count


def _add(target: zipfile.ZipFile, name: str, data: bytes) -> None:
    # A fixed time, for reproducible bytes.
    target.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), data)
