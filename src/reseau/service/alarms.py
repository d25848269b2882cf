"""Alarms: what somebody should look at, sent once and repeated until it is acknowledged.

Alarms are not raised by the code in which something happens. They are collected from what the archive says:
runs that were missed or failed, calibrations that were rejected or need a review, charts that signal. Each
has a key; what was sent and what was acknowledged are entries of a journal. Of several processes that send
alarms of one archive, the database lets one claim each sending.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from ..archive import Archive
from ..archive.journal import Entry
from ..core.errors import InputError, UsageError
from ..core.optional import optional
from .delivering import AlarmDelivery, networks_of
from .inforce import Configurations, a_time
from .schedule import Schedules

_JOURNAL, _LONGEST_S = "alarms", 120.0
_CLAIM = timedelta(seconds=2 * _LONGEST_S)
"""For how long others leave alarms to a sender that may have ended: longer than a message takes."""


@dataclass(frozen=True)
class Alarm:
    """An alarm.

    Parameters
    ----------
    key : str
        Name of the event; the same event has the same key.
    text : str
        One line: what happened.
    sent : tuple of datetime
        When it was sent.
    acknowledged : str
        By whom it was acknowledged; empty if it was not.

    Examples
    --------
    >>> Alarm("weekly 20260302T070000Z missed", "weekly: the run of 2026-03-02 07:00Z was missed").sent
    ()
    """

    key: str
    text: str
    sent: tuple[datetime, ...] = ()
    acknowledged: str = ""


class Alarms:
    """Alarms of an archive.

    Parameters
    ----------
    archive : Archive
        The archive.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     Alarms(archive).open()
    []
    """

    def __init__(self, archive: Archive) -> None:
        self._archive, self._journal = archive, archive.journal(_JOURNAL)

    def all(self, now: datetime | None = None) -> list[Alarm]:
        """Return all alarms with what was sent and acknowledged."""
        return self._all(self._journal.entries(), now)

    def _all(self, entries: Sequence[Entry], now: datetime | None) -> list[Alarm]:
        sent = [(each.document["alarm"], each.at) for each in entries if each.kind == "sent"]
        seen = {
            each.document["alarm"]: each.document["by"] for each in entries if each.kind == "acknowledged"
        }
        return [
            Alarm(key, text, tuple(at for other, at in sent if other == key), seen.get(key, ""))
            for key, text in {**self._runs(now), **self._calibrations()}.items()
        ]

    def open(self, now: datetime | None = None) -> list[Alarm]:
        """Return the alarms that nobody acknowledged."""
        return [each for each in self.all(now) if not each.acknowledged]

    def acknowledge(self, key: str, by: str) -> None:
        """Acknowledge an alarm: it is not repeated.

        Raises
        ------
        UsageError
            If there is no such alarm, or nobody is named.
        """
        if not by.strip():
            raise UsageError("needs a name", where="acknowledgement")
        if key not in {each.key for each in self.all()}:
            raise UsageError("is no alarm", where=repr(key), do="see `reseau alarms list`")
        self._journal.append(f"acknowledged {key}", "acknowledged", {"alarm": key, "by": by})

    @property
    def delivery(self) -> AlarmDelivery:
        """Where a service sends them."""
        content = [dict(each.document) for each in self._journal.entries("delivery")]
        return AlarmDelivery.from_content(content[-1], where="alarms") if content else AlarmDelivery()

    def deliver_to(self, delivery: AlarmDelivery) -> None:
        """Set where a service sends them.

        Raises
        ------
        UsageError
            If one is not a URL of apprise or a network.
        """
        sender(delivery.notify, delivery.inside)
        self._journal.add("delivery", delivery.to_dict())

    def send_as_set(self) -> list[Alarm]:
        """Send what is due where it is set; raises as :meth:`send`."""
        to = self.delivery
        if not to.notify:
            return []
        return self.send(sender(to.notify, to.inside), timedelta(hours=to.repeat_hours))

    def send(
        self, deliver: Callable[[str, str], bool], repeat: timedelta, now: datetime | None = None
    ) -> list[Alarm]:
        """Send the open alarms that were not sent in the last time, in one message.

        Parameters
        ----------
        deliver : callable
            Takes title and text, and returns whether they were delivered; see :func:`sender`.
        repeat : timedelta
            Time after which an alarm that was not acknowledged is sent again.
        now : datetime, optional
            The present time.

        Returns
        -------
        list of Alarm
            What was sent; nothing is sent if there is nothing to say.

        Raises
        ------
        InputError
            If they could not be delivered; they are sent with the next call.
        """
        time, entries = a_time(now or self._archive.clock()), self._journal.entries()
        due = [
            each
            for each in self._all(entries, time)
            if not each.acknowledged
            and (not each.sent or each.sent[-1] + repeat <= time)
            and self._claimed(each, entries, time)
        ]
        if not due:
            return []
        plural = "s" if len(due) > 1 else ""
        lines = [each.text + (" (repeated)" if each.sent else "") for each in due]
        kind = "unsent"
        try:
            if not deliver(f"reseau: {len(due)} alarm{plural}", "\n".join(lines)):
                raise InputError("could not be delivered", where="alarms", do="check the addresses")
            kind = "sent"
        finally:
            for each in due:
                self._journal.add(kind, {"alarm": each.key}, time)
        return due

    def _claimed(self, alarm: Alarm, entries: Sequence[Entry], time: datetime) -> bool:
        """Whether this process sends an alarm, by what was known when it was found due.

        The claims of an alarm are numbered: of two processes that know the same ones, one makes the next.
        """
        own = [each for each in entries if each.document.get("alarm") == alarm.key]
        claims = [each for each in own if each.kind == "claimed"]
        if claims and own[-1].kind == "claimed" and claims[-1].at + _CLAIM > time:
            return False
        key = f"claimed {len(claims) + 1} {alarm.key}"
        return self._journal.append(key, "claimed", {"alarm": alarm.key}, time) is not None

    def _runs(self, now: datetime | None) -> dict[str, str]:
        """Alarms about runs, by key; an overdue run that is then missed is one event."""
        found, schedules = {}, Schedules(self._archive)
        for name in schedules.names():
            for run in schedules.runs(name, now, ahead=0):
                if run.state in ("overdue", "missed", "failed"):
                    what = "failed" if run.state == "failed" else "was not carried out"
                    why = f" ({run.why})" if run.why else ""
                    found[f"run {name} {run.key}"] = (
                        f"{name}: the run of {run.time:%Y-%m-%d %H:%M}Z {what}{why}"
                    )
        return found

    def _calibrations(self) -> dict[str, str]:
        """Alarms about calibrations, by key."""
        found, known = {}, Configurations(self._archive)
        for name in known.names():
            history = known.history(name)
            for each in history:
                if each.outcome == "needs review" or (each.outcome == "rejected" and not each.reviewed_by):
                    said = "was rejected" if each.outcome == "rejected" else "needs a review"
                    which = f"{each.since:%Y-%m-%d %H:%M}Z ({each.name or each.key})"
                    found[f"calibration {name} {each.key}"] = f"{name}: the calibration of {which} {said}"
            trend = [f for f in history[-1].judgement.findings if f.rule == "trend"] if history else []
            if trend:
                found[f"trend {name} {known.reference(name)}"] = f"{name}: {trend[0].text}"
            events = known.events(name)
            since = events[-1][0] if events else None
            if not [d for d in history if d.outcome != "rejected" and (since is None or d.since >= since)]:
                continue
            try:
                drift = known.drift(name)
            except UsageError as error:  # such as calibrations without a parameter in common
                found[f"charts {name}"] = f"{name}: its drift is not monitored ({error})"
                continue
            for signal in drift.signals:
                first = next(d for d in history if d.key == signal["since"])
                what = f"{signal['parameter']} {signal['direction']}s, probably since the calibration"
                key = f"drift {name} {signal['parameter']} {signal['calibration']}"
                found[key] = f"{name}: {what} {first.name or f'of {first.since:%Y-%m-%d %H:%M}Z'}"
        return found


def sender(addresses: Sequence[str], inside: Sequence[str] = ()) -> Callable[[str, str], bool]:
    """Return a function that sends by apprise: mail, webhooks, chat.

    A message is sent by a process of its own, which connects to public addresses only: neither a name that
    resolves to an address of this machine or its network, nor a redirect leads inside.

    Parameters
    ----------
    addresses : sequence of str
        URLs of apprise, such as ``mailto://user:password@example.org``.
    inside : sequence of str
        Networks to which messages may be sent besides, such as ``192.168.1.0/24``.

    Raises
    ------
    UsageError
        If one is not a URL of apprise or a network, or apprise is not installed. The function raises it when
        an address leads inside.

    Examples
    --------
    >>> deliver = sender(["json://127.0.0.1:8080/alarms"], ["127.0.0.1"])  # doctest: +SKIP
    """
    with optional():
        import apprise

    try:
        networks_of(inside)
    except ValueError as error:
        raise UsageError(f"is no network ({error})", where="--inside", do="use 192.168.1.0/24") from None
    service = apprise.Apprise()
    for number, each in enumerate(addresses, start=1):
        if not service.add(each):
            # The address itself may contain a password.
            raise UsageError("cannot be used", where=f"address {number}", do="see the URLs of apprise")

    def deliver(title: str, body: str) -> bool:
        given = {"addresses": list(addresses), "inside": list(inside), "title": title, "body": body}
        command = [sys.executable, "-m", "reseau.service.delivering"]
        try:
            done = subprocess.run(
                command,
                input=json.dumps(given),
                capture_output=True,
                text=True,
                timeout=_LONGEST_S,
                check=False,
            )
            found = json.loads(done.stdout.splitlines()[-1])
        except (subprocess.TimeoutExpired, ValueError, IndexError):
            return False
        if found["refused"]:
            where = ", ".join(found["refused"])
            raise UsageError("is inside, where no alarm is sent", where=where, do="allow it with --inside")
        return bool(found["delivered"])

    return deliver
