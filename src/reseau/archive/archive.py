"""The archive: sessions with their frames and results; only ever added to."""

from __future__ import annotations

import os
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import sqlalchemy as sa
from sqlalchemy.engine import Engine

from ..core.errors import ArchiveError
from ..core.version import __version__
from . import schema
from .objects import LocalObjects, Objects, objects_at
from .records import SessionSummary, utc
from .session import INPUT, Session

__all__ = ["Archive"]

_INDEX, _OBJECTS = "index.sqlite", "objects"


class Archive:
    """What was captured and computed, and how it came about; only ever added to.

    Parameters
    ----------
    engine : Engine
        Of the index.
    objects : Objects
        The files.
    place : str
        Where it is, for messages.
    """

    def __init__(self, engine: Engine, objects: Objects, place: str) -> None:
        self._engine, self.objects, self.place = engine, objects, place

    @classmethod
    def open(cls, place: str | Path, objects: str | Path | None = None, *, create: bool = False) -> Self:
        """Open an archive.

        Parameters
        ----------
        place : str or path
            A folder, which holds index and files; or the URL of a database.
        objects : str or path, optional
            Where files are: a folder or a URL; needed with the URL of a database.
        create : bool
            Whether it is made when it is not there.

        Raises
        ------
        ArchiveError
            When there is none, or it cannot be used.
        """
        if "://" in str(place):
            if objects is None:
                raise ArchiveError("needs a place for the files", where=place, do="name one with --objects")
            return cls(schema.make(str(place), create=create), objects_at(objects), str(place))
        folder = Path(place).absolute()
        index = folder / _INDEX
        if create:
            try:
                folder.mkdir(parents=True, exist_ok=True)
                (folder / _OBJECTS).mkdir(exist_ok=True)
            except OSError as error:
                raise ArchiveError(f"cannot be made ({error.strerror})", where=folder) from None
        elif not index.is_file():
            raise ArchiveError("is no archive", where=folder, do="`reseau capture` makes one")
        read_only = not all(os.access(path, os.W_OK) for path in (folder, index) if path.exists())
        if create and read_only:
            raise ArchiveError("may only be read", where=folder, do="name another archive")
        engine = schema.make(f"sqlite:///{index}", create=create, read_only=read_only)
        kept = LocalObjects(folder / _OBJECTS) if objects is None else objects_at(objects)
        return cls(engine, kept, str(folder))

    def close(self) -> None:
        """Let go of the index."""
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
        """Begin a session, with all that it is given, or not at all.

        Parameters
        ----------
        name : str
            Unique in the archive.
        plan : str
            What is done.
        parameters : mapping
            Of the plan, JSON values.
        bench : str
            The text of ``bench.toml``.
        inputs : mapping, optional
            The text of files that it works with, designs, by name.

        Raises
        ------
        ArchiveError
            When there is one of this name, or it cannot be kept.
        """
        if not name or any(c in name for c in "/\\\0") or name.startswith("."):
            raise ArchiveError("is no name of a session", where=repr(name), do="leave out slashes")
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
            "begun": datetime.now(UTC),
        }
        with schema.connected(self._engine) as connection:
            if connection.scalar(sa.select(schema.sessions.c.id).where(schema.sessions.c.name == name)):
                raise ArchiveError(
                    "is the name of a session in this archive", where=name, do="use --resume, or another name"
                )
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
        """A session by its name.

        Raises
        ------
        ArchiveError
            When there is none.
        """
        with schema.connected(self._engine) as connection:
            row = connection.execute(
                sa.select(schema.sessions).where(schema.sessions.c.name == name)
            ).one_or_none()
        if row is None:
            raise ArchiveError(
                "is no session of this archive", where=name, do="`reseau archive list` shows them"
            )
        return Session(self._engine, self.objects, row._asdict())

    def sessions(self) -> list[SessionSummary]:
        """All sessions in the order in which they were begun, with how many frames and results they have."""
        s = schema.sessions.c

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
        query = sa.select(s.name, s.plan, s.begun, taken, count(schema.results), ended).order_by(s.id)
        with schema.connected(self._engine) as connection:
            rows = connection.execute(query).all()
        return [
            SessionSummary(name, plan, utc(begun), frames, results, status or "not ended")
            for name, plan, begun, frames, results, status in rows
        ]

    def faults(self) -> list[str]:
        """What is wrong with the index itself, as far as its database can tell."""
        return schema.faults(self._engine)

    def files(self) -> list[tuple[str, str, int, str]]:
        """Hash, suffix, size and name of every file that the index names."""
        found = []
        with schema.connected(self._engine) as connection:
            for table, label in (
                (schema.frames, schema.frames.c.step + "/" + schema.frames.c.kind),
                (schema.results, schema.results.c.name),
            ):
                query = sa.select(
                    table.c.sha256, table.c.suffix, table.c.size, schema.sessions.c.name + "/" + label
                ).join(schema.sessions)
                found += [tuple(row) for row in connection.execute(query.order_by(table.c.id))]
        return found
