"""Users, tokens and logins of the service, in a database of their own.

Passwords are kept as argon2id, tokens and cookies as SHA-256: both are random numbers of 256 bits, which need
no slow hash. One-time passwords are those of RFC 6238; each is accepted once. What a login may do is its
scope: `read`, `operate` (move, acquire, upload) or `administer` (decide on calibrations, users, tokens).
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import secrets
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Literal, Self
from urllib.parse import quote

import sqlalchemy as sa

from ..archive.records import utc, utc_now
from ..core.errors import ArchiveError, ReseauError, UsageError
from ..core.optional import optional

__all__ = ["SCOPES", "Accounts", "Principal", "RefusedLogin", "Scope", "Token", "User", "one_time_code"]

Scope = Literal["read", "operate", "administer"]
SCOPES: tuple[Scope, ...] = ("read", "operate", "administer")
"""Scopes in ascending order; each includes those before it."""

_LEAST_PASSWORD = 12
_FREE, _FIRST_S, _LONGEST_S = 5, 30.0, 3600.0
"""Failures without a wait, the first wait, and the longest one, which doubles from failure to failure."""
_BY_ADDRESS, _WINDOW = 30, timedelta(minutes=10)
_LOGIN, _IDLE = timedelta(hours=12), timedelta(hours=2)
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
    sa.Column("last_step", sa.BigInteger),
    sa.Column("created", sa.DateTime(timezone=True), nullable=False),
)
_tokens = sa.Table(
    "tokens",
    _metadata,
    sa.Column("name", sa.Text, primary_key=True),
    sa.Column("hash", sa.String(64), nullable=False, unique=True),
    sa.Column("scope", sa.Text, nullable=False),
    sa.Column("made_by", sa.Text, nullable=False),
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
_failures = sa.Table(
    "failures",
    _metadata,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("who", sa.Text, nullable=False, index=True),
    sa.Column("at", sa.DateTime(timezone=True), nullable=False),
)

_VERSION = 2
_UPGRADES: dict[int, tuple[str, ...]] = {
    1: ("ALTER TABLE users ADD COLUMN last_step BIGINT",),
}
"""Statements that lead from a version of the schema to the next one."""


class RefusedLogin(ReseauError):
    """A login that was refused; the message does not say what was wrong.

    Parameters
    ----------
    wait_s : float
        Time after which the next attempt is considered (s).
    """

    def __init__(self, wait_s: float = 0.0) -> None:
        self.wait_s = wait_s
        what = "name, password or code is wrong" if not wait_s else f"too many attempts: wait {wait_s:.0f} s"
        super().__init__(what, where="login")


@dataclass(frozen=True)
class Principal:
    """Who makes a request, and what they may do.

    Parameters
    ----------
    name : str
        User, or name of the token.
    scope : {"read", "operate", "administer"}
        What they may do.
    via : {"login", "token", "local"}
        How they are known.

    Examples
    --------
    >>> Principal("Ada", "operate", "login").may("read"), Principal("Ada", "read", "token").may("operate")
    (True, False)
    """

    name: str
    scope: Scope
    via: Literal["login", "token", "local"]

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
    made_by: str
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
            there = sa.inspect(connection).has_table("users")
            _metadata.create_all(connection)
            known = connection.scalar(sa.select(_about.c.value).where(_about.c.key == "version"))
            version = int(known) if known else (1 if there else _VERSION)
            if version > _VERSION:
                raise ArchiveError(f"is of a later version ({version})", where="accounts", do="update reseau")
            if version < _VERSION and not upgrade:
                raise ArchiveError(
                    f"is of version {version}", where="accounts", do="run `reseau service upgrade`"
                )
            for each in range(version, _VERSION):
                for statement in _UPGRADES[each]:
                    connection.execute(sa.text(statement))
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
        """Require a one-time password from now on; return the address for an authenticator."""
        secret = base64.b32encode(secrets.token_bytes(20)).decode()
        self._change(name, secret=secret, last_step=None)
        return f"otpauth://totp/reseau:{quote(name)}?secret={secret}&issuer=reseau"

    def waive_code(self, name: str) -> None:
        """Require no one-time password any more."""
        self._change(name, secret=None, last_step=None)

    def remove_user(self, name: str) -> None:
        """Remove a user with their logins."""
        self._change(name, scope="read")
        with self._connected() as connection:
            connection.execute(_users.delete().where(_users.c.name == name))

    def _change(self, name: str, **values: Any) -> None:
        with self._connected() as connection:
            done = connection.execute(_users.update().where(_users.c.name == name).values(values))
            connection.execute(_logins.delete().where(_logins.c.user == name))
        if not done.rowcount:
            raise UsageError("is no user", where=name)

    def _hashed(self, password: str) -> str:
        if len(password) < _LEAST_PASSWORD:
            raise UsageError(f"has fewer than {_LEAST_PASSWORD} characters", where="password")
        return self._hasher.hash(password)

    # Logins.

    def log_in(self, name: str, password: str, code: str = "", address: str = "") -> str:
        """Check a password, and return the value of a cookie.

        Raises
        ------
        RefusedLogin
            If it is wrong, or there were too many attempts.
        """
        from argon2.exceptions import Argon2Error, InvalidHashError

        now = self._clock()
        wait = max(self._wait(f"user {name}", now), self._wait_address(address, now))
        if wait > 0:
            raise RefusedLogin(wait)
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
            with self._connected() as connection:
                for who in {f"user {name}", f"address {address}"}:
                    connection.execute(_failures.insert().values(who=who, at=now))
            raise RefusedLogin
        with self._connected() as connection:
            connection.execute(_failures.delete().where(_failures.c.who == f"user {name}"))
        return self.begin_login(name, row.scope)

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
        return Principal(row.user, row.scope, "local" if row.user == "local" else "login")

    def log_out(self, cookie: str) -> None:
        """End a login."""
        with self._connected() as connection:
            connection.execute(_logins.delete().where(_logins.c.hash == _hash(cookie)))

    def _wait(self, who: str, now: datetime) -> float:
        """Seconds until the next attempt of a user is considered."""
        count, last = self._failed(who)
        if last is None or count < _FREE:
            return 0.0
        wait = min(_FIRST_S * 2.0 ** (count - _FREE), _LONGEST_S)
        # A failure in the future: the clock was set back.
        return max(0.0, wait - max(0.0, (now - last).total_seconds()))

    def _wait_address(self, address: str, now: datetime) -> float:
        """Seconds until the next attempt from an address is considered."""
        f = _failures.c
        with self._connected() as connection:
            connection.execute(_failures.delete().where(f.at < now - timedelta(days=1)))
            count = connection.scalar(
                sa.select(sa.func.count()).where(f.who == f"address {address}", f.at > now - _WINDOW)
            )
        return _WINDOW.total_seconds() if address and (count or 0) >= _BY_ADDRESS else 0.0

    def _failed(self, who: str) -> tuple[int, datetime | None]:
        f = _failures.c
        with self._connected() as connection:
            count, last = connection.execute(
                sa.select(sa.func.count(), sa.func.max(f.at)).where(f.who == who)
            ).one()
        return count, None if last is None else utc(last)

    def _code_fits(self, name: str, secret: str | None, last: int | None, code: str, now: datetime) -> bool:
        """Whether a one-time password is right, and was not used before."""
        if secret is None:
            return True
        step = int(now.timestamp()) // _PERIOD_S
        for each in range(step - _DRIFT, step + _DRIFT + 1):
            if (last is None or each > last) and hmac.compare_digest(
                one_time_code(secret, each), code.strip()
            ):
                unused = (_users.c.last_step.is_(None)) | (_users.c.last_step < each)
                with self._connected() as connection:
                    done = connection.execute(
                        _users.update().where(_users.c.name == name, unused).values(last_step=each)
                    )
                return bool(done.rowcount)
        return False

    # Tokens.

    def tokens(self) -> list[Token]:
        """Return all tokens, also those that have ended."""
        t = _tokens.c
        query = sa.select(t.name, t.scope, t.made_by, t.created, t.expires, t.revoked).order_by(t.created)
        with self._connected() as connection:
            rows = connection.execute(query).all()
        return [
            Token(name, scope, by, utc(made), utc(ends), None if gone is None else utc(gone))
            for name, scope, by, made, ends, gone in rows
        ]

    def create_token(self, name: str, scope: Scope, lasts: timedelta, by: str) -> str:
        """Create a token, and return its secret, which is shown this once.

        Raises
        ------
        UsageError
            If there is or was one of this name, or it would last longer than two years.
        """
        _named(name)
        _scoped(scope)
        if not timedelta(0) < lasts <= timedelta(days=731):
            raise UsageError("does not last from 1 to 731 days", where=f"token {name}")
        if name in {each.name for each in self.tokens()}:
            raise UsageError("is a token already", where=name, do="use another name")
        secret, now = f"reseau_{secrets.token_urlsafe(32)}", self._clock()
        row = {
            "name": name, "hash": _hash(secret), "scope": scope, "made_by": by, "created": now,
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
        return Principal(row.name, row.scope, "token")


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode("utf-8")).hexdigest()


def _named(name: str) -> None:
    if not name.strip() or len(name) > 80 or not name.isprintable() or name == "local":
        raise UsageError("is no name", where=repr(name), do="use up to 80 printable characters")


def _scoped(scope: str) -> None:
    if scope not in SCOPES:
        raise UsageError(f"{scope!r} is no scope", where="scope", do=f"use {', '.join(SCOPES)}")
