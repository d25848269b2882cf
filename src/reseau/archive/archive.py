"""The archive: an append-only store of sessions with their frames and results."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Self

import sqlalchemy as sa
from sqlalchemy.engine import Engine

from ..core.errors import ArchiveError, UsageError
from ..core.version import __version__
from . import schema
from .journal import Journal, journals
from .objects import LocalObjects, Objects, objects_at
from .records import Note, SessionSummary, utc, utc_now
from .session import INPUT, Session

_INDEX, _OBJECTS = "index.sqlite", "objects"


class Archive:
    """An append-only store of sessions with their frames and results.

    Parameters
    ----------
    engine : Engine
        Database engine of the index.
    objects : Objects
        Store of the files.
    place : str
        Name of the place, for messages.
    clock : callable
        Returns the present time, UTC: that of what is stored, and of what is due.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     session = archive.begin("monday", "frames", {"count": 2})
    ...     [each.name for each in archive.sessions()]
    ['monday']
    """

    def __init__(
        self, engine: Engine, objects: Objects, place: str, clock: Callable[[], datetime] = utc_now
    ) -> None:
        self._engine, self.objects, self.place, self.clock = engine, objects, place, clock

    @classmethod
    def open(
        cls,
        place: str | Path,
        objects: str | Path | None = None,
        *,
        create: bool = False,
        clock: Callable[[], datetime] = utc_now,
    ) -> Self:
        """Open an archive.

        Parameters
        ----------
        place : str or path
            A folder with index and files, or the URL of a database.
        objects : str or path, optional
            Folder or URL of the files; required with the URL of a database.
        create : bool
            Whether to create it if it does not exist.
        clock : callable
            Returns the present time, UTC; by default that of this computer.

        Raises
        ------
        ArchiveError
            If there is none, or it cannot be used.
        """
        if "://" in str(place):
            if objects is None:
                raise ArchiveError("needs a store for the files", where=place, do="name one with --objects")
            return cls(schema.make(str(place), create=create), objects_at(objects), str(place), clock)
        folder = Path(place).absolute()
        index = folder / _INDEX
        if create:
            try:
                folder.mkdir(parents=True, exist_ok=True)
                (folder / _OBJECTS).mkdir(exist_ok=True)
            except OSError as error:
                raise ArchiveError(f"cannot be created ({error.strerror})", where=folder) from None
        elif not index.is_file():
            raise ArchiveError("is not an archive", where=folder, do="create one with `reseau capture`")
        read_only = not all(os.access(path, os.W_OK) for path in (folder, index) if path.exists())
        if create and read_only:
            raise ArchiveError("is read-only", where=folder, do="name another archive")
        engine = schema.make(f"sqlite:///{index}", create=create, read_only=read_only)
        kept = LocalObjects(folder / _OBJECTS) if objects is None else objects_at(objects)
        return cls(engine, kept, str(folder), clock)

    def close(self) -> None:
        """Close the index."""
        self._engine.dispose()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def begin(
        self,
        name: str,
        plan: str,
        parameters: Mapping[str, Any],
        bench: str = "",
        inputs: Mapping[str, str] | None = None,
    ) -> Session:
        """Begin a session with its input files, in one transaction.

        This method stores any parameters. :func:`reseau.sessions.conducting.begin` also checks them.

        Parameters
        ----------
        name : str
            Unique in the archive.
        plan : str
            Name of the plan.
        parameters : mapping
            Parameters of the plan, JSON values.
        bench : str
            Content of ``bench.toml``.
        inputs : mapping, optional
            Contents of the input files, such as designs, by name.

        Raises
        ------
        UsageError
            If the name cannot be one.
        ArchiveError
            If there is a session of this name, or it cannot be stored.
        """
        if not name.isprintable() or name != name.strip() or name[:1] in ("", ".") or set(name) & set("/\\"):
            do = "use printable characters without slashes, not a space or a dot first"
            raise UsageError("is not a valid name of a session", where=repr(name), do=do)
        files = {}
        for role, text in (inputs or {}).items():
            data, suffix = text.encode("utf-8"), Path(role).suffix
            files[role] = data, suffix, self.objects.put(data, suffix)
        row = {
            "name": name,
            "plan": plan,
            "parameters": dict(parameters),
            "bench": bench,
            "software": f"reseau {__version__}",
            "begun": self.clock(),
        }
        with schema.connected(self._engine) as connection:
            if connection.scalar(sa.select(schema.sessions.c.id).where(schema.sessions.c.name == name)):
                raise ArchiveError("exists in this archive", where=name, do="use --resume, or another name")
            made = connection.execute(schema.sessions.insert().values(row)).inserted_primary_key
            assert made is not None
            for role, (data, suffix, sha256) in files.items():
                connection.execute(
                    schema.frames.insert().values(
                        session_id=made[0], step=role, kind=INPUT, take=0, sha256=sha256, suffix=suffix,
                        size=len(data), facts={}, clock={}, stored=row["begun"],
                    )
                )  # fmt: skip
        return self.session(name)

    def session(self, name: str) -> Session:
        """Return a session by its name.

        Raises
        ------
        ArchiveError
            If there is none.
        """
        with schema.connected(self._engine, reading=True) as connection:
            row = connection.execute(
                sa.select(schema.sessions).where(schema.sessions.c.name == name)
            ).one_or_none()
        if row is None:
            raise ArchiveError("is not a session of this archive", where=name, do="see `reseau archive list`")
        return Session(self._engine, self.objects, row._asdict(), self.clock)

    def sessions(
        self, *, last: int | None = None, before: str | None = None, like: str = "", result: str = ""
    ) -> list[SessionSummary]:
        """Return a summary of each session, in the order in which they were begun.

        Parameters
        ----------
        last : int, optional
            Only this many, the latest ones.
        before : str, optional
            Only those that were begun before the session of this name.
        like : str
            Only those whose names or plans contain this text.
        result : str
            Only those with a result of this name.
        """
        s, r = schema.sessions.c, schema.results.c

        def count(table: sa.Table, *where: sa.ColumnElement[bool]) -> sa.ScalarSelect[int]:
            return sa.select(sa.func.count()).where(table.c.session_id == s.id, *where).scalar_subquery()

        ended = (
            sa.select(schema.ends.c.status)
            .where(schema.ends.c.session_id == s.id)
            .order_by(schema.ends.c.id.desc())
            .limit(1)
            .scalar_subquery()
        )
        taken = count(schema.frames, schema.frames.c.kind != INPUT)
        query = sa.select(s.name, s.plan, s.begun, taken, count(schema.results), ended)
        if before is not None:
            query = query.where(s.id < sa.select(s.id).where(s.name == before).scalar_subquery())
        if like:
            query = query.where(
                s.name.contains(like, autoescape=True) | s.plan.contains(like, autoescape=True)
            )
        if result:
            query = query.where(sa.exists().where(r.session_id == s.id, r.name == result))
        query = query.order_by(s.id) if last is None else query.order_by(s.id.desc()).limit(last)
        with schema.connected(self._engine, reading=True) as connection:
            rows = list(connection.execute(query).all())
        if last is not None:
            rows.reverse()
        return [
            SessionSummary(name, plan, utc(begun), frames, results, status or "not ended")
            for name, plan, begun, frames, results, status in rows
        ]

    def notes(self, after: int = 0, first: int | None = None) -> list[Note]:
        """Return what sessions noted, such as the documents of bluesky, in its order.

        Parameters
        ----------
        after : int
            Only what has a larger number.
        first : int, optional
            Only so many, from the beginning.
        """
        e = schema.events.c
        query = sa.select(e.id, schema.sessions.c.name, e.kind, e.document).join(schema.sessions)
        with schema.connected(self._engine, reading=True) as connection:
            rows = connection.execute(query.where(e.id > after).order_by(e.id).limit(first)).all()
        return [Note(*row) for row in rows]

    def journal(self, name: str) -> Journal:
        """Return the journal of this name, which may be empty yet."""
        return Journal(self._engine, name, self.clock)

    def journals(self, prefix: str = "") -> list[str]:
        """Return the names of the journals that start with `prefix`, without it, oldest first."""
        return journals(self._engine, prefix)

    def heads(self) -> dict[str, int]:
        """Return the number of the last row of each table: something was stored if one has changed."""
        with schema.connected(self._engine, reading=True) as connection:
            tables = [t for t in schema.metadata.sorted_tables if t is not schema.entries]
            if schema.extended(connection):
                tables.append(schema.entries)
            return {str(t.name): connection.scalar(sa.select(sa.func.max(t.c.id))) or 0 for t in tables}

    def extend(self) -> bool:
        """Add the tables that archives of earlier versions lack; return whether any was missing."""
        with schema.connected(self._engine, reading=True) as connection:
            there = schema.extended(connection)
        if not there:
            schema.extend(self._engine)
        return not there

    def faults(self) -> list[str]:
        """Return the faults that the database finds in the index."""
        return schema.faults(self._engine)

    def files(self) -> list[tuple[str, str, int, str]]:
        """Return SHA-256, suffix, size and name of every file in the index."""
        found = []
        with schema.connected(self._engine, reading=True) as connection:
            for table, label in (
                (schema.frames, schema.frames.c.step + "/" + schema.frames.c.kind),
                (schema.results, schema.results.c.name),
            ):
                query = sa.select(
                    table.c.sha256, table.c.suffix, table.c.size, schema.sessions.c.name + "/" + label
                ).join(schema.sessions)
                found += [tuple(row) for row in connection.execute(query.order_by(table.c.id))]
        return found
