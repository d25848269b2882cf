"""The archive: frames and results with their provenance; written once, checked by hash, never changed."""

from .archive import Archive
from .export import describe, export
from .journal import Entry, Journal
from .objects import LocalObjects, Objects, RemoteObjects, objects_at
from .picture import frame_of, tiff_of
from .records import ArchivedFrame, ArchivedResult, SessionSummary, Verdict
from .session import Session
from .verify import Verified, verify

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
