"""Users, tokens and logins of the service, in a database of their own.

Passwords are kept as argon2id, tokens and cookies as SHA-256: both are random numbers of 256 bits, which need
no slow hash. One-time passwords are those of RFC 6238; each is accepted once, and they are required when the
first one was right. What a login may do is its scope: `read`, `operate` (move, acquire, upload) or
`administer` (decide on calibrations, users, tokens). A token belongs to a user, may do at most what the user
may, and ends with the user.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import secrets
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Literal, Self
from urllib.parse import quote

import sqlalchemy as sa

from ..archive.records import utc, utc_now
from ..core.errors import ArchiveError, UsageError
from ..core.optional import optional
from .attempts import RefusedLogin, attempts_table, count_attempt, forget_attempt

Scope = Literal["read", "operate", "administer"]
SCOPES: tuple[Scope, ...] = ("read", "operate", "administer")
"""Scopes in ascending order; each includes those before it."""

LOCAL = "local"
"""The user of the service on its machine, who has its files and needs no password."""
_LEAST_PASSWORD = 12
_LOGIN, _IDLE, _KNOWN = timedelta(hours=12), timedelta(hours=2), timedelta(days=365)
_PERIOD_S, _DIGITS, _DRIFT = 30, 6, 1
_SKEW = timedelta(minutes=1)

_metadata = sa.MetaData()
_about = sa.Table(
    "about", _metadata, sa.Column("key", sa.Text, primary_key=True), sa.Column("value", sa.Text)
)
_users = sa.Table(
    "users",
    _metadata,
    sa.Column("name", sa.Text, primary_key=True),
    sa.Column("password", sa.Text, nullable=False),
    sa.Column("scope", sa.Text, nullable=False),
    sa.Column("secret", sa.Text),
    sa.Column("pending", sa.Text),
    sa.Column("last_step", sa.BigInteger),
    sa.Column("created", sa.DateTime(timezone=True), nullable=False),
)
_tokens = sa.Table(
    "tokens",
    _metadata,
    sa.Column("name", sa.Text, primary_key=True),
    sa.Column("hash", sa.String(64), nullable=False, unique=True),
    sa.Column("scope", sa.Text, nullable=False),
    sa.Column("user", sa.Text, nullable=False),
    sa.Column("created", sa.DateTime(timezone=True), nullable=False),
    sa.Column("expires", sa.DateTime(timezone=True), nullable=False),
    sa.Column("revoked", sa.DateTime(timezone=True)),
)
_logins = sa.Table(
    "logins",
    _metadata,
    sa.Column("hash", sa.String(64), primary_key=True),
    sa.Column("user", sa.Text, nullable=False),
    sa.Column("scope", sa.Text, nullable=False),
    sa.Column("created", sa.DateTime(timezone=True), nullable=False),
    sa.Column("seen", sa.DateTime(timezone=True), nullable=False),
)
_devices = sa.Table(
    "devices",
    _metadata,
    sa.Column("hash", sa.String(64), primary_key=True),
    sa.Column("user", sa.Text, nullable=False),
    sa.Column("created", sa.DateTime(timezone=True), nullable=False),
)
attempts_table(_metadata)

_VERSION = 3
_UPGRADES: dict[int, tuple[str, ...]] = {
    1: ("ALTER TABLE users ADD COLUMN last_step BIGINT",),
    2: (
        "ALTER TABLE users ADD COLUMN pending TEXT",
        'ALTER TABLE tokens RENAME COLUMN made_by TO "user"',
        f"UPDATE tokens SET \"user\" = '{LOCAL}' WHERE \"user\" = 'console'",
        "DROP TABLE failures",
    ),
}
"""Statements that lead from a version of the schema to the next one."""


@dataclass(frozen=True)
class Principal:
    """Who makes a request, and what they may do.

    Parameters
    ----------
    name : str
        The user; of a token the one to whom it belongs.
    scope : {"read", "operate", "administer"}
        What they may do.
    via : {"login", "token", "local"}
        How they are known.
    token : str
        Name of the token.

    Examples
    --------
    >>> Principal("Ada", "operate", "login").may("read"), Principal("Ada", "read", "token").may("operate")
    (True, False)
    """

    name: str
    scope: Scope
    via: Literal["login", "token", "local"]
    token: str = field(default="", repr=False)

    @property
    def known_by(self) -> str:
        """How they are known, with the name of the token."""
        return f"{self.via} {self.token}".strip()

    def may(self, scope: Scope) -> bool:
        """Whether the scope includes another one."""
        return SCOPES.index(self.scope) >= SCOPES.index(scope)


@dataclass(frozen=True)
class User:
    """A user, without secrets.

    Examples
    --------
    >>> User("Ada", "read", False, datetime(2026, 3, 2)).one_time
    False
    """

    name: str
    scope: Scope
    one_time: bool
    created: datetime


@dataclass(frozen=True)
class Token:
    """A token, without its secret.

    Examples
    --------
    >>> Token.__dataclass_fields__["expires"].name
    'expires'
    """

    name: str
    scope: Scope
    user: str
    created: datetime
    expires: datetime
    revoked: datetime | None


def one_time_code(secret: str, step: int) -> str:
    """Return the one-time password of a time step (RFC 6238 with SHA-1, 30 s, six digits).

    Parameters
    ----------
    secret : str
        Base32, as authenticators take it.
    step : int
        Seconds since 1970, divided by 30.

    Examples
    --------
    The last six digits of the first test vector of RFC 6238:

    >>> one_time_code(base64.b32encode(b"12345678901234567890").decode(), 59 // 30)
    '287082'
    """
    digest = hmac.digest(base64.b32decode(secret), struct.pack(">Q", step), "sha1")
    start = digest[-1] & 15
    number = struct.unpack(">I", digest[start : start + 4])[0] & 0x7FFFFFFF
    return f"{number % 10**_DIGITS:0{_DIGITS}d}"


class Accounts:
    """Users, tokens and logins.

    Parameters
    ----------
    place : str or Path
        File of SQLite, or URL of a database.
    clock : callable
        Returns the present time, UTC.
    upgrade : bool
        Whether a database of an earlier version is changed to the present one.

    Raises
    ------
    ArchiveError
        If it cannot be used, or is of another version.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Accounts(f"{folder}/accounts.sqlite") as accounts:
    ...     accounts.add_user("Ada", "correct horse battery", "operate")
    ...     cookie = accounts.log_in("Ada", "correct horse battery")
    ...     accounts.of_cookie(cookie)
    Principal(name='Ada', scope='operate', via='login')
    """

    def __init__(
        self, place: str | Path, clock: Callable[[], datetime] = utc_now, *, upgrade: bool = False
    ) -> None:
        with optional():
            from argon2 import PasswordHasher
        self.place, self._clock = str(place), clock
        url = self.place if "://" in self.place else f"sqlite:///{self.place}"
        try:
            self._engine = sa.create_engine(
                url, connect_args={"timeout": 30} if url.startswith("sqlite") else {}
            )
        except (sa.exc.SQLAlchemyError, ImportError) as error:
            raise ArchiveError(f"cannot be used ({error})", where="accounts") from None
        self._hasher = PasswordHasher()
        # Checked in place of an unknown user's, so that the time does not tell that there is none.
        self._nobody = self._hasher.hash(secrets.token_hex(8))
        with self._connected() as connection:
            tables = sa.inspect(connection)
            known = None
            if tables.has_table("about"):
                known = connection.scalar(sa.select(_about.c.value).where(_about.c.key == "version"))
            version = int(known) if known else (1 if tables.has_table("users") else _VERSION)
            if version > _VERSION:
                raise ArchiveError(f"is of a later version ({version})", where="accounts", do="update reseau")
            if version < _VERSION and not upgrade:
                raise ArchiveError(
                    f"is of version {version}", where="accounts", do="run `reseau service upgrade`"
                )
            for each in range(version, _VERSION):
                for statement in _UPGRADES[each]:
                    connection.execute(sa.text(statement))
            _metadata.create_all(connection)
            if not known or version < _VERSION:
                connection.execute(_about.delete().where(_about.c.key == "version"))
                connection.execute(_about.insert().values(key="version", value=str(_VERSION)))
        self.upgraded_from = version if version < _VERSION else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the database."""
        self._engine.dispose()

    @contextmanager
    def _connected(self) -> Iterator[sa.Connection]:
        try:
            with self._engine.begin() as connection:
                yield connection
        except sa.exc.DBAPIError as error:
            raise ArchiveError(f"cannot be used ({error.orig})", where="accounts") from None

    # Users.

    def users(self) -> list[User]:
        """Return all users."""
        u = _users.c
        with self._connected() as connection:
            rows = connection.execute(sa.select(u.name, u.scope, u.secret, u.created).order_by(u.name)).all()
        return [User(name, scope, secret is not None, utc(at)) for name, scope, secret, at in rows]

    def add_user(self, name: str, password: str, scope: Scope) -> None:
        """Add a user.

        Raises
        ------
        UsageError
            If there is one of this name, or the password is too short.
        """
        _named(name)
        _scoped(scope)
        if name in {each.name for each in self.users()}:
            raise UsageError("is a user already", where=name)
        row = {"name": name, "password": self._hashed(password), "scope": scope, "created": self._clock()}
        with self._connected() as connection:
            connection.execute(_users.insert().values(row))

    def set_password(self, name: str, password: str) -> None:
        """Change the password of a user, and end their logins."""
        self._change(name, password=self._hashed(password))

    def set_scope(self, name: str, scope: Scope) -> None:
        """Change what a user may do, and end their logins."""
        _scoped(scope)
        self._change(name, scope=scope)

    def require_code(self, name: str) -> str:
        """Prepare a one-time password; return the address for an authenticator.

        It is required from when on :meth:`confirm_code` was given a code of the authenticator.
        """
        secret = base64.b32encode(secrets.token_bytes(20)).decode()
        self._change(name, ends=False, pending=secret)
        return f"otpauth://totp/reseau:{quote(name)}?secret={secret}&issuer=reseau"

    def confirm_code(self, name: str, code: str) -> None:
        """Require one-time passwords from now on, of the authenticator that shows this one.

        Raises
        ------
        UsageError
            If the code is not that of the authenticator, or none was prepared.
        """
        with self._connected() as connection:
            pending = connection.scalar(sa.select(_users.c.pending).where(_users.c.name == name))
        step = None if pending is None else _step_of(pending, None, code, self._clock())
        if step is None:
            do = "use the address that was shown last, and the present code"
            raise UsageError("is not the code of the authenticator", where=name, do=do)
        self._change(name, secret=pending, pending=None, last_step=step)

    def waive_code(self, name: str) -> None:
        """Require no one-time password any more."""
        self._change(name, secret=None, pending=None, last_step=None)

    def remove_user(self, name: str) -> None:
        """Remove a user with their logins; their tokens are revoked."""
        self._change(name, scope="read")
        t, now = _tokens.c, self._clock()
        with self._connected() as connection:
            connection.execute(
                _tokens.update().where(t.user == name, t.revoked.is_(None)).values(revoked=now)
            )
            connection.execute(_devices.delete().where(_devices.c.user == name))
            connection.execute(_users.delete().where(_users.c.name == name))

    def _change(self, name: str, *, ends: bool = True, **values: Any) -> None:
        """Change a user; by default their logins end."""
        with self._connected() as connection:
            done = connection.execute(_users.update().where(_users.c.name == name).values(values))
            if ends:
                connection.execute(_logins.delete().where(_logins.c.user == name))
        if not done.rowcount:
            raise UsageError("is no user", where=name)

    def _hashed(self, password: str) -> str:
        if len(password) < _LEAST_PASSWORD:
            raise UsageError(f"has fewer than {_LEAST_PASSWORD} characters", where="password")
        return self._hasher.hash(password)

    # Logins.

    def log_in(self, name: str, password: str, code: str = "", address: str = "", device: str = "") -> str:
        """Check a password and a code, and return the value of a cookie; see :meth:`check`.

        Raises
        ------
        RefusedLogin
            If it is wrong, or there were too many attempts.
        """
        return self.begin_login(name, self.check(name, password, code, address, device))

    def check(self, name: str, password: str, code: str = "", address: str = "", device: str = "") -> Scope:
        """Check a password, and the code of a user who needs one; return what the user may do.

        Parameters
        ----------
        name, password, code
            As the user gave them.
        address : str
            From where.
        device : str
            Value of the cookie of a browser that is known; see :meth:`remember`.

        Raises
        ------
        RefusedLogin
            If it is wrong, or there were too many attempts.
        """
        from argon2.exceptions import Argon2Error, InvalidHashError

        now, known = self._clock(), _hash(device) if self.remembers(name, device) else ""
        with self._connected() as connection:  # rolled back where it is refused
            counted = count_attempt(connection, name, address, known, now)
        u = _users.c
        with self._connected() as connection:
            row = connection.execute(
                sa.select(u.password, u.scope, u.secret, u.last_step).where(u.name == name)
            ).one_or_none()
        try:
            good = bool(self._hasher.verify(self._nobody if row is None else row.password, password))
        except (Argon2Error, InvalidHashError):
            good = False
        if not good or row is None or not self._code_fits(name, row.secret, row.last_step, code, now):
            raise RefusedLogin
        with self._connected() as connection:
            forget_attempt(connection, counted)
        scope: Scope = row.scope
        return scope

    def remember(self, name: str) -> str:
        """Return the value of a cookie by which the browser of a user is known when they log in again.

        It lets nobody in: others who try the name of the user do not keep out who has it.
        """
        now, device = self._clock(), secrets.token_urlsafe(32)
        with self._connected() as connection:
            connection.execute(_devices.delete().where(_devices.c.created < now - _KNOWN))
            connection.execute(_devices.insert().values(hash=_hash(device), user=name, created=now))
        return device

    def remembers(self, name: str, device: str) -> bool:
        """Whether a user has logged in before in a browser."""
        d = _devices.c
        query = sa.select(d.hash).where(d.hash == _hash(device), d.user == name)
        with self._connected() as connection:
            return bool(device) and connection.scalar(query) is not None

    def begin_login(self, name: str, scope: Scope) -> str:
        """Begin a login of somebody who is known already, and return the value of a cookie."""
        now, cookie = self._clock(), secrets.token_urlsafe(32)
        with self._connected() as connection:
            connection.execute(_logins.delete().where(_logins.c.created < now - _LOGIN))
            row = {"hash": _hash(cookie), "user": name, "scope": scope, "created": now, "seen": now}
            connection.execute(_logins.insert().values(row))
        return cookie

    def of_cookie(self, cookie: str) -> Principal | None:
        """Return whose login a cookie is; None if it has ended.

        A login ends after twelve hours, after two hours without a request, and when the clock is set back to
        before it began.
        """
        now = self._clock()
        with self._connected() as connection:
            row = connection.execute(sa.select(_logins).where(_logins.c.hash == _hash(cookie))).one_or_none()
            if row is None:
                return None
            created, seen = utc(row.created), utc(row.seen)
            if not created - _SKEW <= now < created + _LOGIN or now >= seen + _IDLE:
                connection.execute(_logins.delete().where(_logins.c.hash == row.hash))
                return None
            if abs(now - seen) > _SKEW:
                connection.execute(_logins.update().where(_logins.c.hash == row.hash).values(seen=now))
        return Principal(row.user, row.scope, "local" if row.user == LOCAL else "login")

    def log_out(self, cookie: str) -> None:
        """End a login."""
        with self._connected() as connection:
            connection.execute(_logins.delete().where(_logins.c.hash == _hash(cookie)))

    def _code_fits(self, name: str, secret: str | None, last: int | None, code: str, now: datetime) -> bool:
        """Whether a one-time password is right, and was not used before."""
        if secret is None:
            return True
        step = _step_of(secret, last, code, now)
        if step is None:
            return False
        unused = (_users.c.last_step.is_(None)) | (_users.c.last_step < step)
        with self._connected() as connection:
            done = connection.execute(
                _users.update().where(_users.c.name == name, unused).values(last_step=step)
            )
        return bool(done.rowcount)

    # Tokens.

    def tokens(self) -> list[Token]:
        """Return all tokens, also those that have ended."""
        t = _tokens.c
        query = sa.select(t.name, t.scope, t.user, t.created, t.expires, t.revoked).order_by(t.created)
        with self._connected() as connection:
            rows = connection.execute(query).all()
        return [
            Token(name, scope, by, utc(made), utc(ends), None if gone is None else utc(gone))
            for name, scope, by, made, ends, gone in rows
        ]

    def create_token(self, name: str, scope: Scope, lasts: timedelta, user: str = LOCAL) -> str:
        """Create a token of a user, and return its secret, which is shown this once.

        Raises
        ------
        UsageError
            If there is or was one of this name, it would last longer than two years, or there is no such
            user, or one who may do less.
        """
        _named(name)
        _scoped(scope)
        if not timedelta(0) < lasts <= timedelta(days=731):
            raise UsageError("does not last from 1 to 731 days", where=f"token {name}")
        if name in {each.name for each in self.tokens()}:
            raise UsageError("is a token already", where=name, do="use another name")
        allowed = self._scope_of(user)
        if allowed is None:
            raise UsageError("is no user", where=user)
        if SCOPES.index(scope) > SCOPES.index(allowed):
            raise UsageError(f"may {allowed} and have no token to {scope}", where=user)
        secret, now = f"reseau_{secrets.token_urlsafe(32)}", self._clock()
        row = {
            "name": name, "hash": _hash(secret), "scope": scope, "user": user, "created": now,
            "expires": now + lasts,
        }  # fmt: skip
        with self._connected() as connection:
            connection.execute(_tokens.insert().values(row))
        return secret

    def revoke_token(self, name: str) -> None:
        """Revoke a token.

        Raises
        ------
        UsageError
            If there is none.
        """
        with self._connected() as connection:
            done = connection.execute(
                _tokens.update().where(_tokens.c.name == name).values(revoked=self._clock())
            )
        if not done.rowcount:
            raise UsageError("is no token", where=name)

    def of_token(self, secret: str) -> Principal | None:
        """Return who a token is; None if there is none, or it has expired or was revoked."""
        now = self._clock()
        with self._connected() as connection:
            row = connection.execute(sa.select(_tokens).where(_tokens.c.hash == _hash(secret))).one_or_none()
        if row is None or row.revoked is not None:
            return None
        if not utc(row.created) - _SKEW <= now < utc(row.expires):
            return None
        allowed = self._scope_of(row.user)
        if allowed is None:
            return None
        return Principal(row.user, min(row.scope, allowed, key=SCOPES.index), "token", row.name)

    def _scope_of(self, user: str) -> Scope | None:
        """What a user may do now; None if there is no such user."""
        if user == LOCAL:
            return "administer"
        with self._connected() as connection:
            found: Scope | None = connection.scalar(sa.select(_users.c.scope).where(_users.c.name == user))
        return found


def _step_of(secret: str, last: int | None, code: str, now: datetime) -> int | None:
    """The time step whose one-time password a code is, after the last one used; None if it is none."""
    step = int(now.timestamp()) // _PERIOD_S
    for each in range(step - _DRIFT, step + _DRIFT + 1):
        right = one_time_code(secret, each).encode()
        if (last is None or each > last) and hmac.compare_digest(right, code.strip().encode()):
            return each
    return None


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode("utf-8")).hexdigest()


def _named(name: str) -> None:
    if not name.strip() or len(name) > 80 or not name.isprintable() or name == LOCAL:
        raise UsageError("is no name", where=repr(name), do="use up to 80 printable characters")


def _scoped(scope: str) -> None:
    if scope not in SCOPES:
        raise UsageError(f"{scope!r} is no scope", where="scope", do=f"use {', '.join(SCOPES)}")
