"""Journals: what happened to something over time, one entry after the other, never changed.

Decisions on calibrations, runs of a schedule and alarms are journals. An entry has a key that is unique in
its journal; of two processes that append the same key at once, the database lets one succeed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Engine

from . import schema
from .records import utc, utc_now


@dataclass(frozen=True)
class Entry:
    """An entry of a journal.

    Parameters
    ----------
    number : int
        Increases from entry to entry.
    key, kind : str
        Key, unique in the journal, and kind.
    document : dict
        Content, JSON values.
    at : datetime
        When it was appended, UTC, by the clock of the computer that appended it.

    Examples
    --------
    >>> Entry(1, "a", "note", {"text": "warm"}, datetime(2026, 3, 1, tzinfo=UTC)).kind
    'note'
    """

    number: int
    key: str
    kind: str
    document: dict[str, Any]
    at: datetime


class Journal:
    """A journal of an archive; see :meth:`reseau.archive.Archive.journal`.

    Parameters
    ----------
    engine : Engine
        Database engine of the index.
    name : str
        Name of the journal.
    clock : callable
        Returns the present time, UTC.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.archive import Archive
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     journal = archive.journal("lens")
    ...     first, again = (journal.append("1", "note", {"text": t}) for t in ("warm", "cold"))
    ...     first.document, again, len(journal.entries())
    ({'text': 'warm'}, None, 1)
    """

    def __init__(self, engine: Engine, name: str, clock: Callable[[], datetime] = utc_now) -> None:
        self._engine, self.name, self._clock = engine, name, clock

    def append(
        self, key: str, kind: str, document: Mapping[str, Any], at: datetime | None = None
    ) -> Entry | None:
        """Append an entry.

        Parameters
        ----------
        key, kind, document
            See :class:`Entry`.
        at : datetime, optional
            Its time; now by default.

        Returns
        -------
        Entry or None
            None if the journal has this key, also if another process was faster.

        Raises
        ------
        ArchiveError
            If the archive cannot store it.
        """
        e = schema.entries
        content = dict(document)
        time = self._clock() if at is None else at.astimezone(UTC)
        row = {"journal": self.name, "key": key, "kind": kind, "document": content, "at": time}
        schema.extend(self._engine)
        with schema.connected(self._engine) as connection:
            insert = schema.insert_new(connection, e, ("journal", "key")).values(row).returning(e.c.id)
            number = connection.scalar(insert)
        return None if number is None else Entry(number, key, kind, content, time)

    def add(self, kind: str, document: Mapping[str, Any], at: datetime | None = None) -> Entry:
        """Append an entry whose key is its kind and the next free number.

        Parameters
        ----------
        kind, document, at
            As for :meth:`append`.

        Raises
        ------
        ArchiveError
            If the archive cannot store it.
        """
        number = len(self.entries())
        while (made := self.append(f"{kind} {number}", kind, document, at)) is None:
            number += 1
        return made

    def entries(
        self,
        kind: str | None = None,
        *,
        after: int = 0,
        before: str | None = None,
        first: int | None = None,
        last: int | None = None,
    ) -> list[Entry]:
        """Return the entries in the order in which they were appended.

        Parameters
        ----------
        kind : str, optional
            Only those of a kind.
        after : int
            Only those with larger numbers.
        before : str, optional
            Only those before the entry with this key.
        first, last : int, optional
            Only so many, from the beginning or from the end.
        """
        e = schema.entries.c
        query = sa.select(e.id, e.key, e.kind, e.document, e.at).where(e.journal == self.name, e.id > after)
        if kind is not None:
            query = query.where(e.kind == kind)
        if before is not None:
            one = sa.select(e.id).where(e.journal == self.name, e.key == before).scalar_subquery()
            query = query.where(e.id < one)
        query = query.order_by(e.id).limit(first) if last is None else query.order_by(e.id.desc()).limit(last)
        with schema.connected(self._engine, reading=True) as connection:
            if not schema.extended(connection):
                return []
            rows = list(connection.execute(query).all())
        if last is not None:
            rows.reverse()
        return [Entry(*row[:4], at=utc(row[4])) for row in rows]

    def last(self) -> Entry | None:
        """Return the last entry, or None."""
        found = self.entries(last=1)
        return found[0] if found else None


def journals(engine: Engine, prefix: str) -> list[str]:
    """Names of the journals that start with `prefix`, without it, in the order of their first entries."""
    e = schema.entries.c
    query = sa.select(e.journal).where(e.journal.startswith(prefix, autoescape=True)).group_by(e.journal)
    with schema.connected(engine, reading=True) as connection:
        if not schema.extended(connection):
            return []
        found = connection.scalars(query.order_by(sa.func.min(e.id)))
        return [name.removeprefix(prefix) for name in found]
