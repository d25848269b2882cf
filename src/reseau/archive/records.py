"""What the archive hands out: frames with their verdicts, results with what they were made of, summaries."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

__all__ = ["ArchivedFrame", "ArchivedResult", "SessionSummary", "Verdict", "utc"]


@dataclass(frozen=True)
class Verdict:
    """What was found of a frame when it came.

    Parameters
    ----------
    ok : bool
        Whether it can be used.
    why : str
        If not.
    facts : dict
        What was measured in it, for those who watch: JSON values.
    """

    ok: bool
    why: str = ""
    facts: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ArchivedFrame:
    """One frame, or another picture, of a session.

    Parameters
    ----------
    id : int
        In the index.
    step, kind, take : str, str, int
        Of what pose or photograph, which of its pictures, and the how-manieth attempt at it, from 0.
    sha256, suffix, size
        Of the file.
    facts : dict
        Settings and pose.
    clock : dict
        Times, and counters of the instrument.
    verdict : Verdict, optional
        Where one was given.
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
        """Within its session."""
        return f"{self.step}/{self.kind}" + (f" take {self.take}" if self.take else "")


@dataclass(frozen=True)
class ArchivedResult:
    """One result of a session, and how it came about.

    Parameters
    ----------
    id : int
        In the index.
    name : str
        Of its file.
    sha256, suffix, size
        Of the file.
    parameters : dict
        It was computed with.
    inputs : dict
        SHA-256 of what it was computed from, by role.
    software : str
        That computed it.
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
class SessionSummary:
    """A line of `reseau archive list`."""

    name: str
    plan: str
    begun: datetime
    frames: int
    results: int
    status: str


def utc(time: datetime) -> datetime:
    """A time of an index; SQLite forgets its zone."""
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)
