"""The append-only tables of the index, and its database engine."""

from __future__ import annotations

import os
import sqlite3
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from json import JSONDecodeError
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import Engine
from sqlalchemy.exc import DBAPIError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from ..core.errors import ArchiveError

metadata = sa.MetaData()

_TEXT, _JSON, _TIME = sa.Text, sa.JSON, sa.DateTime(timezone=True)


def _key() -> sa.Column[int]:
    return sa.Column("id", sa.Integer, primary_key=True)


def _of(table: str, *, index: bool = True) -> sa.Column[int]:
    return sa.Column(f"{table}_id", sa.ForeignKey(f"{table}s.id"), nullable=False, index=index)


sessions = sa.Table(
    "sessions",
    metadata,
    _key(),
    sa.Column("name", _TEXT, nullable=False, unique=True),
    sa.Column("plan", _TEXT, nullable=False),
    sa.Column("parameters", _JSON, nullable=False),
    sa.Column("bench", _TEXT, nullable=False),
    sa.Column("software", _TEXT, nullable=False),
    sa.Column("begun", _TIME, nullable=False),
)
frames = sa.Table(
    "frames",
    metadata,
    _key(),
    _of("session", index=False),
    sa.Column("step", _TEXT, nullable=False),
    sa.Column("kind", _TEXT, nullable=False),
    sa.Column("take", sa.Integer, nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False, index=True),
    sa.Column("suffix", sa.String(8), nullable=False),
    sa.Column("size", sa.BigInteger, nullable=False),
    sa.Column("facts", _JSON, nullable=False),
    sa.Column("clock", _JSON, nullable=False),
    sa.Column("stored", _TIME, nullable=False),
    # The identity of a frame: storing it again returns the stored one.
    sa.UniqueConstraint("session_id", "step", "kind", "take"),
)
verdicts = sa.Table(
    "verdicts",
    metadata,
    _key(),
    _of("frame"),
    sa.Column("ok", sa.Boolean, nullable=False),
    sa.Column("why", _TEXT, nullable=False),
    sa.Column("facts", _JSON, nullable=False),
)
results = sa.Table(
    "results",
    metadata,
    _key(),
    _of("session"),
    sa.Column("name", _TEXT, nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False, index=True),
    sa.Column("suffix", sa.String(8), nullable=False),
    sa.Column("size", sa.BigInteger, nullable=False),
    sa.Column("parameters", _JSON, nullable=False),
    sa.Column("software", _TEXT, nullable=False),
    sa.Column("stored", _TIME, nullable=False),
)
inputs = sa.Table(
    "inputs",
    metadata,
    _key(),
    _of("result"),
    sa.Column("role", _TEXT, nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False),
)
events = sa.Table(
    "events",
    metadata,
    _key(),
    _of("session", index=False),
    sa.Column("key", _TEXT, nullable=False),
    sa.Column("kind", _TEXT, nullable=False),
    sa.Column("document", _JSON, nullable=False),
    sa.UniqueConstraint("session_id", "key"),
)
ends = sa.Table(
    "ends",
    metadata,
    _key(),
    _of("session"),
    sa.Column("status", _TEXT, nullable=False),
    sa.Column("why", _TEXT, nullable=False),
    sa.Column("at", _TIME, nullable=False),
)

# Added after the first archives were written: `extend` creates it there before its first entry.
entries = sa.Table(
    "entries",
    metadata,
    _key(),
    sa.Column("journal", _TEXT, nullable=False),
    sa.Column("key", _TEXT, nullable=False),
    sa.Column("kind", _TEXT, nullable=False),
    sa.Column("document", _JSON, nullable=False),
    sa.Column("at", _TIME, nullable=False),
    sa.UniqueConstraint("journal", "key"),
)
_FIRST = set(metadata.tables) - {entries.name}
"""Tables that every archive has."""


def _run(target: sa.Table | sa.MetaData, when: str, dialect: str, statement: str) -> None:
    """Run a statement of one database when tables are created."""
    ddl = sa.DDL(statement)  # type: ignore[no-untyped-call]
    sa.event.listen(target, when, ddl.execute_if(dialect=dialect))


def _append_only(table: sa.Table) -> None:
    """Make the database refuse to change or delete a row."""
    for verb in ("UPDATE", "DELETE"):
        name = f"{table.name}_no_{verb.lower()}"
        trigger = f"CREATE TRIGGER {name} BEFORE {verb} ON {table.name}"
        refused = "FOR EACH ROW EXECUTE FUNCTION reseau_append_only()"
        _run(table, "after_create", "sqlite", f"{trigger} BEGIN SELECT RAISE(ABORT, 'append only'); END")
        _run(table, "after_create", "postgresql", f"{trigger} {refused}")


_FUNCTION = (
    "CREATE OR REPLACE FUNCTION reseau_append_only() RETURNS trigger AS "
    "$$ BEGIN RAISE EXCEPTION 'append only'; END $$ LANGUAGE plpgsql"
)
_run(metadata, "before_create", "postgresql", _FUNCTION)
for _table in metadata.sorted_tables:
    _append_only(_table)


def make(url: str, *, create: bool, read_only: bool = False) -> Engine:
    """Return the engine of an index, with its tables.

    Parameters
    ----------
    url : str
        In the form of SQLAlchemy: ``sqlite:////folder/index.sqlite``, ``postgresql+psycopg://host/name``.
    create : bool
        Whether to create missing tables.
    read_only : bool
        Whether to open SQLite read-only, for a read-only disk.

    Raises
    ------
    ArchiveError
        If it cannot be opened, or is not an index.
    """
    try:
        made = sa.make_url(url)
        if made.get_backend_name() == "sqlite":
            engine = _sqlite(Path(made.database or ""), read_only)
        else:
            engine = sa.create_engine(made, pool_pre_ping=True)
    except (SQLAlchemyError, ImportError) as error:
        raise ArchiveError(f"cannot be used as an index ({_brief(error)})", where=_shown(url)) from None
    with connected(engine) as connection:
        there = set(sa.inspect(connection).get_table_names())
        if not create and not there >= _FIRST:
            raise ArchiveError("is not an archive", where=_shown(url), do="create one with `reseau capture`")
        if not there >= _FIRST:
            metadata.create_all(connection)
    return engine


def _one_at_a_time(connection: sa.Connection) -> None:
    """Let one transaction write while others wait, as SQLite does.

    Rows are then numbered in the order in which they become visible: whoever has read up to a number, such as
    a stream of documents, misses no smaller one that is committed later. A machine that stops answering in
    the middle of a transaction does not hold up the others for ever.
    """
    if connection.dialect.name == "postgresql":
        connection.exec_driver_sql(_PATIENCE)
        connection.execute(sa.select(sa.func.pg_advisory_xact_lock(zlib.crc32(b"reseau archive"))))


def extended(connection: sa.Connection) -> bool:
    """Return whether the archive has journals; archives of earlier versions do not."""
    return sa.inspect(connection).has_table(entries.name)


def extend(engine: Engine) -> None:
    """Add journals to the tables of an archive of an earlier version; its other tables stay as they are.

    Raises
    ------
    ArchiveError
        If the archive is read-only, or its user may not create tables.
    """
    with connected(engine) as connection:
        if not extended(connection):
            metadata.create_all(connection, tables=[entries])


def insert_new(connection: sa.Connection, table: sa.Table, unique: tuple[str, ...]) -> Any:
    """Return an insertion that does nothing where a row with these unique columns exists."""
    module = sqlite if connection.dialect.name == "sqlite" else postgresql
    return module.insert(table).on_conflict_do_nothing(index_elements=list(unique))


def _sqlite(path: Path, read_only: bool) -> Engine:
    # The write-ahead log permits reading during an acquisition; with FULL, commits survive a power failure.
    options = "uri=true"
    if read_only:
        # Without a log none must be created; a log that was left behind has the last changes.
        log = path.with_name(f"{path.name}-wal")
        options += "&mode=ro" if log.is_file() and log.stat().st_size else "&mode=ro&immutable=1"
    engine = sa.create_engine(f"sqlite:///file:{path}?{options}", connect_args={"timeout": _WAIT_S})

    @sa.event.listens_for(engine, "connect")
    def _prepare(raw: sqlite3.Connection, record: sa.pool.ConnectionPoolEntry) -> None:
        record.info[_HELD] = path.exists() and not os.access(path, os.W_OK)
        raw.isolation_level = None  # SQLAlchemy begins transactions, also around CREATE TABLE
        if not read_only:
            raw.execute("PRAGMA journal_mode=WAL")
            raw.execute("PRAGMA synchronous=FULL")
        # Each connection has a cache of its own, of 2 MB by default: a service would grow with its archive
        # up to that for each. The system has these pages, too.
        raw.execute(f"PRAGMA cache_size=-{_CACHE_KB}")
        raw.execute("PRAGMA foreign_keys=ON")

    @sa.event.listens_for(engine, "checkout")
    def _renew(_: object, record: sa.pool.ConnectionPoolEntry, __: object) -> None:
        # SQLite never writes by a connection that it opened while the disk was read-only.
        if record.info[_HELD] and os.access(path, os.W_OK):
            raise sa.exc.DisconnectionError

    @sa.event.listens_for(engine, "begin")
    def _begin(connection: sa.Connection) -> None:
        # A writer waits for the lock at the start; in the middle of a transaction it cannot wait. Readers
        # take no lock: a service that reads does not hold up an acquisition.
        reading = read_only or connection.get_execution_options().get(_READING, False)
        connection.exec_driver_sql("BEGIN" if reading else "BEGIN IMMEDIATE")

    return engine


_READING = "reseau_reading"
_HELD = "reseau_read_only"
_WAIT_S = 30
"""How long a transaction waits for the others that write, and how long one may do nothing."""
_CACHE_KB = 256
_PATIENCE = (
    f"SET LOCAL lock_timeout = '{_WAIT_S}s'; SET LOCAL idle_in_transaction_session_timeout = '{_WAIT_S}s'"
)


@contextmanager
def connected(engine: Engine, *, reading: bool = False) -> Iterator[sa.Connection]:
    """Run a transaction; errors of the database become errors of the archive.

    Transactions that write follow one another: numbers of rows increase in the order of commits.

    Parameters
    ----------
    engine : Engine
        The index.
    reading : bool
        Whether it only reads.

    Raises
    ------
    ArchiveError
        If the database cannot be reached, or is damaged, full or read-only.
    """
    try:
        with engine.execution_options(**{_READING: reading}).begin() as connection:
            if not reading:
                _one_at_a_time(connection)
            yield connection
    except (DBAPIError, PoolTimeout, JSONDecodeError) as error:
        what = f"error of the index ({_brief(error)})"
        raise ArchiveError(what, where=_shown(engine.url)) from None


def faults(engine: Engine) -> list[str]:
    """Return the faults that SQLite finds in its file; PostgreSQL checks its pages by checksums."""
    if engine.dialect.name != "sqlite":
        return []
    try:
        with connected(engine) as connection:
            said = connection.exec_driver_sql("PRAGMA integrity_check(20)").scalars().all()
            astray = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
    except ArchiveError as error:  # too damaged to be checked
        return [error.what]
    found = [line for text in said if text != "ok" for line in str(text).splitlines()]
    return found + [f"a row of {table} has no row in {parent}" for table, _, parent, _ in astray]


def _brief(error: Exception) -> str:
    """The message without the statement and links that SQLAlchemy adds."""
    said = str(error.orig) if isinstance(error, DBAPIError) else str(error)
    return said.strip().splitlines()[0] if said.strip() else type(error).__name__


def _shown(url: sa.URL | str) -> str:
    """A place for messages: a file's path, or a URL without its password."""
    try:
        url = sa.make_url(url)
    except SQLAlchemyError:
        return str(url)
    if url.get_backend_name() == "sqlite":
        return str(url.database).removeprefix("file:").partition("?")[0]
    return url.render_as_string(hide_password=True)
