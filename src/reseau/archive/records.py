"""Records of the archive: frames with verdicts, results with inputs, summaries of sessions."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any


@dataclass(frozen=True)
class Verdict:
    """Verdict on a new frame.

    Parameters
    ----------
    ok : bool
        Whether the frame is usable.
    why : str
        The reason if it is not.
    facts : dict
        Measured values for the display: JSON values.

    Examples
    --------
    >>> Verdict(False, "5 points are too few").ok
    False
    """

    ok: bool
    why: str = ""
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ArchivedFrame:
    """A frame, or another file, of a session.

    Parameters
    ----------
    id : int
        Key in the index.
    step, kind, take : str, str, int
        Pose or photograph, kind of picture, and attempt number, from 0.
    sha256, suffix, size
        SHA-256, suffix and size (bytes) of the file.
    facts : dict
        Settings and pose.
    clock : dict
        Times and counters of the instrument.
    verdict : Verdict, optional
        The last verdict.

    Examples
    --------
    >>> ArchivedFrame(1, "tilt 30", "frame", 1, "ab12", ".tif", 100, {}, {}).name
    'tilt 30/frame take 1'
    """

    id: int
    step: str
    kind: str
    take: int
    sha256: str
    suffix: str
    size: int
    facts: dict[str, Any]
    clock: dict[str, Any]
    verdict: Verdict | None = None

    @property
    def name(self) -> str:
        """Name of the picture, unique in its session."""
        return f"{self.step}/{self.kind}" + (f" take {self.take}" if self.take else "")


@dataclass(frozen=True)
class ArchivedResult:
    """A result of a session with its provenance.

    Parameters
    ----------
    id : int
        Key in the index.
    name : str
        Name of the file.
    sha256, suffix, size
        SHA-256, suffix and size (bytes) of the file.
    parameters : dict
        Parameters of the computation.
    inputs : dict
        SHA-256 of its inputs, by role.
    software : str
        Version of the software.

    Examples
    --------
    >>> ArchivedResult(1, "true.csv", "ab12", ".csv", 80, {}, {"PHOTO I/frame": "cd34"}, "reseau 0.1").name
    'true.csv'
    """

    id: int
    name: str
    sha256: str
    suffix: str
    size: int
    parameters: dict[str, Any]
    inputs: dict[str, str]
    software: str


@dataclass(frozen=True)
class Note:
    """What a session noted, such as a document of bluesky.

    Parameters
    ----------
    number : int
        Increases from note to note of an archive.
    session, kind : str
        Session, and kind.
    document : dict
        Content, JSON values.

    Examples
    --------
    >>> Note(1, "monday", "start", {"uid": "4f2a"}).kind
    'start'
    """

    number: int
    session: str
    kind: str
    document: dict[str, Any]


@dataclass(frozen=True)
class SessionSummary:
    """Summary of a session, a line of `reseau archive list`.

    Parameters
    ----------
    name, plan : str
        Name and plan.
    begun : datetime
        Time of the start (UTC).
    frames, results : int
        Number of pictures, without inputs, and of results.
    status : str
        Last status.

    Examples
    --------
    >>> SessionSummary("monday", "frames", datetime(2026, 1, 5, tzinfo=UTC), 5, 0, "done").status
    'done'
    """

    name: str
    plan: str
    begun: datetime
    frames: int
    results: int
    status: str


def utc(time: datetime) -> datetime:
    """Return a time of the index with its zone; SQLite does not store it."""
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


def utc_now() -> datetime:
    """Time of this computer, UTC.

    Examples
    --------
    >>> utc_now().tzinfo == UTC
    True
    """
    return datetime.now(UTC)
