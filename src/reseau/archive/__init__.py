"""The archive: frames and results with their provenance; written once, checked by hash, never changed.

Names are imported when they are first used: files of a store need no database.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.lazy import lazily

if TYPE_CHECKING:
    from .archive import Archive
    from .exporting import describe, export
    from .journal import Entry, Journal
    from .objects import LocalObjects, Objects, RemoteObjects, objects_at
    from .picture import frame_of, tiff_of
    from .records import ArchivedFrame, ArchivedResult, SessionSummary, Verdict
    from .session import Session
    from .verification import Verified, verify

__all__ = [
    "Archive",
    "ArchivedFrame",
    "ArchivedResult",
    "Entry",
    "Journal",
    "LocalObjects",
    "Objects",
    "RemoteObjects",
    "Session",
    "SessionSummary",
    "Verdict",
    "Verified",
    "describe",
    "export",
    "frame_of",
    "objects_at",
    "tiff_of",
    "verify",
]

__getattr__ = lazily(
    __name__,
    {
        "Archive": ".archive",
        "describe": ".exporting",
        "export": ".exporting",
        "Entry": ".journal",
        "Journal": ".journal",
        "LocalObjects": ".objects",
        "Objects": ".objects",
        "RemoteObjects": ".objects",
        "objects_at": ".objects",
        "frame_of": ".picture",
        "tiff_of": ".picture",
        "ArchivedFrame": ".records",
        "ArchivedResult": ".records",
        "SessionSummary": ".records",
        "Verdict": ".records",
        "Session": ".session",
        "Verified": ".verification",
        "verify": ".verification",
    },
)
