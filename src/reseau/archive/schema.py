"""The tables of the index, which are only ever added to, and the engine that holds them."""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from json import JSONDecodeError
from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.engine import Engine
from sqlalchemy.exc import DBAPIError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from ..core.errors import ArchiveError

__all__ = [
    "connected",
    "ends",
    "events",
    "faults",
    "frames",
    "inputs",
    "make",
    "metadata",
    "results",
    "sessions",
    "verdicts",
]

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
    # What makes a frame this frame: stored again, it is the one that is there.
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


def _run(target: sa.Table | sa.MetaData, when: str, dialect: str, statement: str) -> None:
    """Have a statement of one database run when tables are made."""
    ddl = sa.DDL(statement)  # type: ignore[no-untyped-call]
    sa.event.listen(target, when, ddl.execute_if(dialect=dialect))


def _append_only(table: sa.Table) -> None:
    """Have the database itself refuse to change or delete a row."""
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
    """The engine of an index, with its tables.

    Parameters
    ----------
    url : str
        As SQLAlchemy writes it: ``sqlite:////folder/index.sqlite``, ``postgresql+psycopg://host/name``.
    create : bool
        Whether tables that are not there are made.
    read_only : bool
        Whether nothing is ever written, for SQLite on a disk that allows nothing else.

    Raises
    ------
    ArchiveError
        When it cannot be opened, or is no index.
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
        if engine.dialect.name == "postgresql":  # one process makes the tables, others wait for it
            connection.execute(sa.select(sa.func.pg_advisory_xact_lock(zlib.crc32(b"reseau archive"))))
        there = set(sa.inspect(connection).get_table_names())
        if not create and not set(metadata.tables) <= there:
            raise ArchiveError("is no archive", where=_shown(url), do="`reseau capture` makes one")
        if not set(metadata.tables) <= there:
            metadata.create_all(connection)
    return engine


def _sqlite(path: Path, read_only: bool) -> Engine:
    # A write-ahead log lets readers look on while frames come in; FULL has every commit outlast a power cut.
    options = "uri=true"
    if read_only:
        # Where there is no log, none must be made; in one that is left over is what was written last.
        log = path.with_name(f"{path.name}-wal")
        options += "&mode=ro" if log.is_file() and log.stat().st_size else "&mode=ro&immutable=1"
    engine = sa.create_engine(f"sqlite:///file:{path}?{options}", connect_args={"timeout": 30})

    @sa.event.listens_for(engine, "connect")
    def _prepare(raw: sqlite3.Connection, _: object) -> None:
        raw.isolation_level = None  # transactions begin where SQLAlchemy says, also around CREATE TABLE
        if not read_only:
            raw.execute("PRAGMA journal_mode=WAL")
            raw.execute("PRAGMA synchronous=FULL")
        raw.execute("PRAGMA foreign_keys=ON")

    @sa.event.listens_for(engine, "begin")
    def _begin(connection: sa.Connection) -> None:
        # Whoever may write waits at the beginning; found out halfway, it could not wait any more.
        connection.exec_driver_sql("BEGIN" if read_only else "BEGIN IMMEDIATE")

    return engine


@contextmanager
def connected(engine: Engine) -> Iterator[sa.Connection]:
    """A transaction; what the database complains of becomes an error of the archive.

    Raises
    ------
    ArchiveError
        When the database cannot be reached, is damaged, full or may not be written to.
    """
    try:
        with engine.begin() as connection:
            yield connection
    except (DBAPIError, PoolTimeout, JSONDecodeError) as error:
        what = f"the index does not take it ({_brief(error)})"
        raise ArchiveError(what, where=_shown(engine.url)) from None


def faults(engine: Engine) -> list[str]:
    """What a database finds wrong with itself; PostgreSQL watches over its pages by checksums of its own."""
    if engine.dialect.name != "sqlite":
        return []
    try:
        with connected(engine) as connection:
            said = connection.exec_driver_sql("PRAGMA integrity_check(20)").scalars().all()
            astray = connection.exec_driver_sql("PRAGMA foreign_key_check").all()
    except ArchiveError as error:  # too much is damaged for it to look at all
        return [error.what]
    found = [line for text in said if text != "ok" for line in str(text).splitlines()]
    return found + [f"a row of {table} belongs to none of {parent}" for table, _, parent, _ in astray]


def _brief(error: Exception) -> str:
    """What happened, without the statement and the links that SQLAlchemy adds."""
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
