"""Calibrations in force: for each configuration of an instrument the calibration that applies at a time.

Everything is a journal of an archive: the configuration, decisions on calibrations, reviews, comments,
returns to earlier calibrations, and service events. Two times belong to each entry: from when on it holds
(`since`), and when it was entered. "Which calibration applied to this frame?" and "which did we believe to
apply, last May?" are both answered.
"""

from __future__ import annotations

import getpass
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Literal, cast

import numpy as np

from ..archive import Archive
from ..archive.journal import Entry, Journal
from ..calibration import Calibration, CameraMapping, calibration_difference
from ..calibration.conversion import in_model_of
from ..calibration.reader import parse_calibration
from ..core.data import Array
from ..core.errors import UsageError
from ..core.failure import Failure
from .charts import ChartOptions, monitor
from .covariates import (
    CalibrationFunction,
    CovariateTable,
    FunctionOptions,
    conditions_of,
    explain,
    fit_function,
    series_of,
)
from .decisions import Applied, Decision, Drift
from .rules import AcceptanceRules, Judgement, Outcome, PastRun, judge

_PREFIX = "calibrations/"
_KEY = re.compile(r"[0-9a-f]{12}")
"""The form of keys, which no name has."""
_ACCEPTED = ("accepted", "accepted with warning")


class Configurations:
    """Configurations of instruments and their calibrations, in an archive.

    Parameters
    ----------
    archive : Archive
        The archive.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.service import AcceptanceRules, Limits
    >>> from reseau.service.covariates import example_calibration
    >>> rules = AcceptanceRules(version=1, image=Limits(warning=0.1, action=0.3), coverage=0.0)
    >>> monday, tuesday = (datetime(2026, 3, day, tzinfo=UTC) for day in (2, 3))
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     known = Configurations(archive)
    ...     known.define("left", {"camera": "DMK 33", "lens": "8 mm"})
    ...     first = known.decide("left", example_calibration(), rules, since=monday)
    ...     _ = known.review("left", first.key, "accepted", by="Ada", comment="first calibration")
    ...     first.outcome, known.applied("left", tuesday).since == monday
    ('needs review', True)
    """

    def __init__(self, archive: Archive) -> None:
        self._archive = archive

    def names(self) -> list[str]:
        """Return the names of the configurations."""
        return self._archive.journals(_PREFIX)

    def define(self, name: str, parts: Mapping[str, str]) -> None:
        """Define a configuration by its parts, such as camera, lens, settings and firmware.

        Raises
        ------
        UsageError
            If it exists with other parts, or another one has the same parts.
        """
        given = {key: str(value) for key, value in parts.items()}
        if not name.strip() or not given:
            raise UsageError("needs a name and at least one part", where="configuration")
        for other in self.names():
            if other != name and self.parts(other) == given:
                raise UsageError(f"has the parts of {other}", where=name, do=f"use {other}")
        self._journal(name).append("configuration", "configuration", {"parts": given})
        if self.parts(name) != given:
            raise UsageError("exists with other parts", where=name, do="use another name")

    def parts(self, name: str) -> dict[str, str]:
        """Return the parts of a configuration.

        Raises
        ------
        UsageError
            If there is no such configuration.
        """
        return dict(self._entries(name)[0].document["parts"])

    def decide(
        self,
        name: str,
        calibration: Calibration,
        rules: AcceptanceRules,
        *,
        since: datetime | None = None,
        by: str = "",
        comment: str = "",
        session: str | None = None,
    ) -> Decision:
        """Judge a calibration by the rules, and put it in force if they accept it.

        Parameters
        ----------
        name : str
            Configuration.
        calibration : Calibration
            The calibration; the same one is judged again if the rules have another version.
        rules : AcceptanceRules
            The rules.
        since : datetime, optional
            From when on it applies; by default the time of its session, or now.
        by, comment : str
            By whom or what (default: the user), and a comment.
        session : str, optional
            Session from which the calibration is, which must have it among its results.

        Raises
        ------
        UsageError
            If the configuration is unknown, the session does not have the calibration, the rules changed
            without a new version, or the calibration is of another instrument than the one in force.
        """
        entries = self._entries(name)
        key = calibration.key
        made = [each for each in entries if key in (each.key, each.document.get("key")) and _judges(each)]
        if made and made[-1].document["judgement"]["rules"]["version"] == rules.version:
            return self.decision(name, key)
        _same_version(entries, rules, name)
        begun = calibration.times.get("begun")
        start = a_time(since or (datetime.fromisoformat(begun) if begun else self._archive.clock()))
        if made:
            start = _since(made[0])
        current = self._applied(name, [each for each in entries if each not in made], start)
        judged = judge(
            calibration, None if current is None else current.calibration, rules,
            () if current is None else self._runs(name, current, start, key), start,
        )  # fmt: skip
        said = {
            "by": by or _user(),
            "comment": comment,
            "judgement": judged.to_dict(),
            "compared_with": None if current is None else current.key,
        }
        if made:
            again = {"key": key, **said}
            self._journal(name).append(f"{key} again {len(made)}", "judged again", again)
            return self.decision(name, key)
        document = {
            "calibration": calibration.to_json(),
            "since": start.isoformat(),
            **said,
            "origin": None if session is None else self._origin(session, key),
        }
        self._journal(name).append(key, "decision", document)
        return self.decision(name, key)

    def reference(self, name: str) -> str | None:
        """Return the key of the reference since the last service event: one that was set, or the first."""
        start = self._begin(name)
        own = [each for each in self.history(name) if each.outcome in _ACCEPTED and each.since >= start]
        keys = {each.key for each in own}
        given = [e.document["key"] for e in self._entries(name, "reference") if e.document["key"] in keys]
        first = min(own, key=lambda each: (each.since, each.at), default=None)
        return given[-1] if given else None if first is None else first.key

    def set_reference(self, name: str, key: str, *, by: str = "", comment: str) -> None:
        """Let the drift of the later calibrations count from an accepted one on.

        Raises
        ------
        UsageError
            If it was not accepted, or no reason is given.
        """
        decision = self._accepted(name, key)
        if not comment.strip():
            raise UsageError("needs a reason", where=f"reference {key}", do="give a comment")
        document = {"key": decision.key, "by": by or _user(), "comment": comment}
        self._journal(name).add("reference", document)

    def _runs(self, name: str, current: Applied, until: datetime, but: str) -> list[PastRun]:
        """Calibrations from the reference to a time, with the one in force.

        Among them are those that the rules rejected as too different: others may say the same. Those that a
        person rejected, or that are incomplete, say nothing.
        """
        history = [each for each in self.history(name) if each.key != but]
        of, reference = {each.key: each for each in history}, self.reference(name)
        start = of[reference].since if reference in of else current.since
        rows = sorted(
            (each.since, each.key)
            for each in history
            if start <= each.since <= until and (each.says_something or each.key == current.key)
        )
        rows.sort(key=lambda each: each[1] != reference)
        if current.key not in {key for _, key in rows}:
            rows = [(current.since, current.key)]
        found = self._calibrations(name, [key for _, key in rows])
        return [
            (since, each, of[key].outcome == "rejected" and key != current.key)
            for (since, key), each in zip(rows, found, strict=True)
        ]

    def _origin(self, session: str, key: str) -> dict[str, str]:
        """The session from which a calibration is, and the SHA-256 of the result that is its proof."""
        from ..sessions.conducting import CALIBRATION

        of = self._archive.session(session)
        for each in of.results():
            if each.name == CALIBRATION:
                found = parse_calibration(of.content(each).decode("utf-8"), where=f"{session}: {each.name}")
                if found.key == key:
                    return {"session": session, "sha256": each.sha256}
        raise UsageError("does not have this calibration among its results", where=f"session {session}")

    def review(
        self, name: str, key: str, outcome: Literal["accepted", "rejected"], *, by: str = "", comment: str
    ) -> Decision:
        """Decide what the rules left to a person.

        Raises
        ------
        UsageError
            If the decision does not need a review, has one already, or no reason is given.
        """
        decision = self.decision(name, key)
        if outcome not in ("accepted", "rejected"):
            raise UsageError(
                f"{outcome!r} is no outcome of a review", where=key, do="use accepted or rejected"
            )
        if decision.outcome != "needs review":
            raise UsageError(f"is {decision.outcome} and needs no review", where=key)
        if not comment.strip():
            raise UsageError("needs a reason", where=f"review of {key}", do="give a comment")
        person = by or _user()
        if decision.judgement.rules.get("second_person") and person in (
            decision.by,
            decision.by.split(",")[0],
        ):
            raise UsageError(f"needs another person than {person}", where=f"review of {key}")
        document = {"key": decision.key, "outcome": outcome, "by": person, "comment": comment}
        again = f" {len(decision.earlier)}" if decision.earlier else ""
        if self._journal(name).append(f"review {decision.key}{again}", "review", document) is None:
            raise UsageError("has been reviewed", where=key)
        return self.decision(name, key)

    def comment(self, name: str, key: str, text: str, *, by: str = "") -> Decision:
        """Add a comment to a decision; its outcome stays as it is."""
        decision = self.decision(name, key)
        document = {"key": decision.key, "by": by or _user(), "comment": text}
        self._journal(name).add("comment", document)
        return self.decision(name, key)

    def rename(self, name: str, key: str, given: str, *, by: str = "") -> Decision:
        """Give a decision a name, by which it is called from now on.

        Raises
        ------
        UsageError
            If there is no name, or another decision of the configuration has it.
        """
        decision, given = self.decision(name, key), given.strip()
        if not given:
            raise UsageError("is empty", where="name of the calibration")
        if _KEY.fullmatch(given):
            do = "give a name that no key can be"
            raise UsageError("has the form of a key", where=f"name {given!r}", do=do)
        if any(each.name == given and each.key != decision.key for each in self.history(name)):
            raise UsageError("is another calibration", where=f"{name}: {given}", do="give another name")
        document = {"key": decision.key, "name": given, "by": by or _user()}
        self._journal(name).add("name", document)
        return self.decision(name, key)

    def roll_back(
        self, name: str, key: str, *, since: datetime | None = None, by: str = "", comment: str = ""
    ) -> Applied:
        """Return to an earlier calibration: it replaces all that apply from `since` (default: now) on.

        Raises
        ------
        UsageError
            If that calibration was not accepted.
        """
        decision = self._accepted(name, key)
        start = a_time(since or self._archive.clock())
        document = {"key": decision.key, "since": start.isoformat(), "by": by or _user(), "comment": comment}
        self._journal(name).add("return", document)
        found = self.applied(name, start)
        assert found is not None
        return found

    def event(self, name: str, what: str, *, at: datetime | None = None, by: str = "") -> None:
        """Note a service event (lens changed, camera dropped): from then on no calibration applies."""
        if not what.strip():
            raise UsageError("needs a description", where="service event")
        self._entries(name)  # refuses an unknown configuration
        time = a_time(at or self._archive.clock())
        self._journal(name).add("event", {"what": what, "since": time.isoformat(), "by": by or _user()})

    def events(self, name: str) -> list[tuple[datetime, str]]:
        """Return time and description of the service events, in time order."""
        found = [(_since(each), str(each.document["what"])) for each in self._entries(name, "event")]
        return sorted(found)

    def decision(self, name: str, key: str) -> Decision:
        """Return a decision by its key, by its name, or by the start of its key.

        Raises
        ------
        UsageError
            If there is none, or several.
        """
        history = self.history(name) if key else []
        found = [each for each in history if each.key == key]
        found = found or [each for each in history if key in (each.name, each.key[: len(key)])]
        if len(found) != 1:
            raise UsageError(f"names {len(found)} decisions", where=f"{name}: {key!r}", do="see its history")
        return found[0]

    def _accepted(self, name: str, key: str) -> Decision:
        """A decision, if it was accepted."""
        decision = self.decision(name, key)
        if decision.outcome not in _ACCEPTED:
            raise UsageError(f"was not accepted ({decision.outcome})", where=key)
        return decision

    def history(self, name: str) -> list[Decision]:
        """Return all decisions in the order in which they were made."""
        entries = self._entries(name)
        names = {each.document["key"]: each.document["name"] for each in entries if each.kind == "name"}
        found = []
        for each in entries:
            if each.kind != "decision":
                continue
            own = [o for o in entries if o is each or o.document.get("key") == each.key]
            judging = [o for o in own if _judges(o)]
            last = judging[-1].document
            # A review is of the judgement before it.
            review = next((o.document for o in own[own.index(judging[-1]) :] if o.kind == "review"), None)
            earlier = [(o.document["by"], o.at, _judgement(o)) for o in judging[:-1]]
            d, judged = each.document, _judgement(judging[-1])
            comments = [(o.document["by"], o.document["comment"]) for o in own if o.kind == "comment"]
            found.append(
                Decision(
                    each.key, judged.outcome if review is None else cast(Outcome, review["outcome"]),
                    _since(each), judging[-1].at, last["by"], last["comment"], judged, last["compared_with"],
                    "" if review is None else review["by"], "" if review is None else review["comment"],
                    tuple(comments), names.get(each.key, ""), (d.get("origin") or {}).get("session"),
                    tuple(earlier),
                )
            )  # fmt: skip
        return found

    def applied(self, name: str, at: datetime, known: datetime | None = None) -> Applied | None:
        """Return the calibration that applies to frames of a time.

        Parameters
        ----------
        name : str
            Configuration.
        at : datetime
            When the frame was taken.
        known : datetime, optional
            Use only what had been entered by this time.

        Returns
        -------
        Applied or None
            None before the first calibration, and after a service event until the next one.
        """
        time = a_time(at)
        last = None if known is None else a_time(known)
        return self._applied(
            name, [each for each in self._entries(name) if last is None or each.at <= last], time
        )

    def _applied(self, name: str, entries: Sequence[Entry], time: datetime) -> Applied | None:
        """The calibration that applies at a time, by some entries."""
        current = [each for each in _effects(entries) if each[0] <= time]
        if not current:
            return None
        since, _, key, why = max(current, key=lambda each: each[:2])
        if key is None or why is None:
            return None
        return Applied(self.calibration(name, key), key, since, why)

    def calibration(self, name: str, key: str) -> Calibration:
        """Return the calibration of a decision."""
        return self._calibrations(name, [key])[0]

    def _calibrations(self, name: str, keys: Sequence[str]) -> list[Calibration]:
        """Calibrations of several decisions; the archive is read once."""
        texts = {each.key: each.document["calibration"] for each in self._entries(name, "decision")}
        for key in keys:
            if key not in texts:
                raise UsageError("names no decision", where=f"{name}: {key!r}")
        return [parse_calibration(texts[key], where=f"calibration {key}") for key in keys]

    def earlier(self, name: str, decision: Decision) -> list[Calibration]:
        """Return the other accepted calibrations since the last service event: they show the reproducibility.

        None are returned for a decision from before that event.
        """
        start = self._begin(name)
        keys = [
            each.key
            for each in self.history(name)
            if each.outcome in _ACCEPTED and each.since >= start and each.key != decision.key
        ]
        return self._calibrations(name, keys) if decision.since >= start else []

    def drift(
        self, name: str, options: ChartOptions | None = None, covariates: CovariateTable | None = None
    ) -> Drift:
        """Chart the parameters of the calibrations since the last service event, rejected ones left out.

        Parameters
        ----------
        name : str
            Configuration.
        options : ChartOptions, optional
            Charts and their rate of false alarms.
        covariates : CovariateTable, optional
            Covariates of each calibration, which may explain signals.

        Raises
        ------
        UsageError
            If there are none, or they have no parameter in common.
        """
        keys, calibrations, error = self._since_event(name)
        names, values = series_of(calibrations)
        one_sided: tuple[int, ...] = ()
        if calibrations[0].kind == "camera":
            one_sided = (len(names),)
            names = (*names, "norm of the field")
            values = np.column_stack([values, _norms(calibrations)])
        charts = monitor(values, options, one_sided=one_sided)
        found = None
        if covariates is not None:
            z = np.array([list(covariates.of(key).values()) for key in keys])
            found = explain(values, z, options, one_sided=one_sided)
        return Drift(tuple(keys), names, values, charts, found, error)

    def function(
        self, name: str, covariates: CovariateTable, options: FunctionOptions | None = None
    ) -> CalibrationFunction | Failure:
        """Fit the calibrations since the last service event as a function of covariates.

        See :func:`~reseau.service.fit_function`.

        Raises
        ------
        UsageError
            If there are none, or one has no covariates.
        """
        keys, calibrations, _ = self._since_event(name)
        rows = [covariates.of(key) for key in keys]
        columns = {each: np.array([row[each] for row in rows]) for each in covariates.values}
        return fit_function(calibrations, columns, covariates.units, options)

    def conditions(self, name: str) -> dict[str, str]:
        """Conditions that sensors measured with every calibration since the last service event, with units.

        Raises
        ------
        UsageError
            If there are no calibrations.
        """
        return conditions_of(self._since_event(name)[1])

    def recorded(self, name: str, conditions: Sequence[str]) -> CovariateTable:
        """Covariates that sensors measured with the calibrations since the last service event.

        See :meth:`~reseau.service.CovariateTable.recorded`.

        Raises
        ------
        UsageError
            If there are no calibrations, or one has no such condition.
        """
        keys, calibrations, _ = self._since_event(name)
        return CovariateTable.recorded(keys, calibrations, conditions)

    def _since_event(self, name: str) -> tuple[list[str], list[Calibration], float]:
        """Keys and calibrations since the last service event in time order, rejected ones left out.

        Cameras of other models are converted to that of the last one; with the largest error of it, px.
        """
        start = self._begin(name)
        decisions = [d for d in self.history(name) if d.outcome != "rejected" and d.since >= start]
        decisions.sort(key=lambda d: (d.since, d.at))
        if not decisions:
            raise UsageError("has no calibrations since its last service event", where=name)
        keys = [d.key for d in decisions]
        *found, last = self._calibrations(name, keys)
        errors = [0.0]
        for k, each in enumerate(found):
            if each.kind == last.kind == "camera" and each.model != last.model:
                found[k], error = in_model_of(each, last)
                errors.append(error)
        return keys, [*found, last], max(errors)

    def _begin(self, name: str) -> datetime:
        """Time of the last service event, or before all times."""
        return max((time for time, _ in self.events(name)), default=datetime.min.replace(tzinfo=UTC))

    def _journal(self, name: str) -> Journal:
        return self._archive.journal(_PREFIX + name)

    def _entries(self, name: str, kind: str | None = None) -> list[Entry]:
        found = self._journal(name).entries()
        if not found:
            do = f"use {', '.join(self.names())}" if self.names() else "define it"
            raise UsageError("is not a configuration of this archive", where=name, do=do)
        return [each for each in found if kind is None or each.kind == kind]


def a_time(given: datetime) -> datetime:
    """The time in UTC.

    Raises
    ------
    UsageError
        If it has no time zone.

    Examples
    --------
    >>> a_time(datetime.fromisoformat("2026-03-29T03:00:00+02:00")).isoformat()
    '2026-03-29T01:00:00+00:00'
    """
    if given.tzinfo is None:
        raise UsageError("has no time zone", where=given.isoformat(), do="add one, such as Z or +01:00")
    return given.astimezone(UTC)


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user without a name, as in a container
        return "unknown"


def _judges(entry: Entry) -> bool:
    return entry.kind in ("decision", "judged again")


def _judgement(entry: Entry) -> Judgement:
    return Judgement.from_content(dict(entry.document["judgement"]), where=f"decision {entry.key}")


def _since(entry: Entry) -> datetime:
    return datetime.fromisoformat(entry.document["since"])


_Effect = tuple[datetime, int, str | None, Literal["decision", "review", "return"] | None]


def _effects(entries: Sequence[Entry]) -> list[_Effect]:
    """What each entry put in force: since when, number of the entry, key of the calibration, and why."""
    found: list[_Effect] = []
    since_of = {each.key: _since(each) for each in entries if each.kind == "decision"}
    for each in entries:
        d, n = each.document, each.number
        if _judges(each):
            key = d.get("key", each.key)
            found = [effect for effect in found if effect[2] != key or effect[3] == "return"]
            if key in since_of and d["judgement"]["outcome"] in _ACCEPTED:
                found.append((since_of[key], n, key, "decision"))
        elif each.kind == "review" and d["outcome"] in _ACCEPTED and d["key"] in since_of:
            found.append((since_of[d["key"]], n, d["key"], "review"))
        elif each.kind == "return":
            found = [effect for effect in found if effect[0] < _since(each)]
            found.append((_since(each), n, d["key"], "return"))
        elif each.kind == "event":
            found.append((_since(each), n, None, None))
    return found


def _same_version(entries: Sequence[Entry], rules: AcceptanceRules, name: str) -> None:
    """Refuse rules that changed but kept their version."""
    for each in entries:
        if _judges(each):
            used = each.document["judgement"]["rules"]
            same = used["version"] == rules.version
            if same and AcceptanceRules.from_content(dict(used), where="rules") != rules:
                raise UsageError(
                    f"differ from those of version {rules.version} used before", where=f"{name}: rules",
                    do="increase `version`",
                )  # fmt: skip


def _norms(calibrations: Sequence[Calibration]) -> Array:
    """Power 2/3 of the rms differences from the first camera (n,); NaN for the first."""
    first = CameraMapping.from_calibration(calibrations[0])
    found = [np.nan]
    for each in calibrations[1:]:
        field = calibration_difference(first, CameraMapping.from_calibration(each), 15).difference
        found.append(float(np.cbrt(np.nanmean(np.square(field).sum(axis=-1)))))
    return np.array(found)
