"""Counts attempts to log in, so that passwords and codes cannot be guessed and no owner is locked out.

An attempt is counted before the password is looked at, in one statement: of many at the same time no more are
considered than of as many one after the other. From a browser in which the user has logged in before,
attempts are counted apart: what others try, from wherever, does not keep the user of that browser out.
"""

from __future__ import annotations

from datetime import datetime, timedelta

import sqlalchemy as sa

from ..core.errors import ReseauError

_LIMITS: dict[str, tuple[int, timedelta]] = {
    "address": (30, timedelta(minutes=10)),
    "pair": (10, timedelta(minutes=15)),
    "user": (50, timedelta(days=1)),
}
"""Attempts that are considered, and in which time: of an address, of a user from one place, of a user from
all unknown places. 50 guesses a day of a one-time password, of which three fit, hit it once in 18 years."""
_SKEW_S = 60.0
"""Attempts at the same time are counted in any order; a begin still later: the clock was set back."""
_KEPT = max(window for _, window in _LIMITS.values())


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


def attempts_table(metadata: sa.MetaData) -> sa.Table:
    """The table of counts: who, how many, and since when (s since 1970)."""
    return sa.Table(
        "attempts",
        metadata,
        sa.Column("who", sa.Text, primary_key=True),
        sa.Column("number", sa.Integer, nullable=False),
        sa.Column("since", sa.Double, nullable=False),
    )


def count_attempt(
    connection: sa.Connection, user: str, address: str, device: str, now: datetime
) -> list[tuple[str, str]]:
    """Count an attempt in the transaction of a connection, which must be rolled back if this raises.

    Parameters
    ----------
    connection : sqlalchemy.Connection
        A transaction in which nothing was read before.
    user, address : str
        Who logs in, and from where.
    device : str
        Names a browser in which this user has logged in before; empty if it is none.
    now : datetime
        The present time.

    Returns
    -------
    list of (str, str)
        What was counted, for :func:`forget_attempt`.

    Raises
    ------
    RefusedLogin
        If there were too many.
    """
    if device:
        counted = [("pair", f"user {user} device {device}")]
    else:
        counted = [("pair", f"user {user} address {address}"), ("user", f"user {user}")]
        counted += [("address", f"address {address}")] if address else []
    at = now.timestamp()
    for kind, who in counted:
        most, window = _LIMITS[kind]
        given = {
            "who": who, "at": at, "begun": at - window.total_seconds(), "later": at + _SKEW_S,
        }  # fmt: skip
        # The row is locked from here to the end of the transaction, by SQLite the whole table.
        connection.execute(_INSERT, given)
        connection.execute(_COUNT, given)
        number, since = connection.execute(_READ, given).one()
        if number > most:
            raise RefusedLogin(max(1.0, since + window.total_seconds() - at))
    connection.execute(_FORGET_OLD, {"before": at - _KEPT.total_seconds()})
    return counted


def forget_attempt(connection: sa.Connection, counted: list[tuple[str, str]]) -> None:
    """Take back an attempt that succeeded; the failures before it, from the same place, are forgotten."""
    for kind, who in counted:
        connection.execute(_CLEAR if kind == "pair" else _TAKE_BACK, {"who": who})


_INSERT = sa.text(
    "INSERT INTO attempts (who, number, since) VALUES (:who, 0, :at) ON CONFLICT (who) DO NOTHING"
)
_COUNT = sa.text(
    "UPDATE attempts SET number = CASE WHEN since <= :begun OR since > :later THEN 1 ELSE number + 1 END,"
    " since = CASE WHEN since <= :begun OR since > :later THEN :at ELSE since END WHERE who = :who"
)
_READ = sa.text("SELECT number, since FROM attempts WHERE who = :who")
_FORGET_OLD = sa.text("DELETE FROM attempts WHERE since <= :before")
_CLEAR = sa.text("DELETE FROM attempts WHERE who = :who")
_TAKE_BACK = sa.text("UPDATE attempts SET number = number - 1 WHERE who = :who AND number > 0")
