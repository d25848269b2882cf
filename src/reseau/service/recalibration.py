"""Recalibration: check the bench, acquire, measure, adjust, compare with the calibration in force, decide.

A recalibration repeats an archived session: its plan, parameters, input files and bench.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

from pydantic import Field

from .. import sessions
from ..archive import Archive, Session
from ..calibration import Calibration
from ..capture import Bench, BenchFile
from ..capture.judging import Watch
from ..core.errors import InstrumentError, UsageError
from ..io import Document
from .decisions import Decision
from .inforce import Configurations
from .rules import AcceptanceRules
from .schedule import Run, Schedule

_PREFIX = "recalibrations/"


class Recalibration(Document):
    """What is repeated, and how its result is judged, ``reseau-recalibration/1``.

    Examples
    --------
    >>> rules = {"schema": "reseau-acceptance/1", "version": 1, "image": {"warning": 0.1, "action": 0.3}}
    >>> Recalibration(name="left", configuration="left", plan="testfield", parameters={}, inputs={}, bench="",
    ...               rules=rules).plan
    'testfield'
    """

    SCHEMA: ClassVar[str] = "reseau-recalibration/1"

    name: str = Field(min_length=1, pattern=r"^[^/\\\x00.][^/\\\x00]*$")
    configuration: str
    plan: str
    parameters: dict[str, Any]
    inputs: dict[str, str]
    bench: str
    rules: dict[str, Any]


@dataclass(frozen=True)
class Recalibrated:
    """A recalibration that was carried out.

    Parameters
    ----------
    session : str
        Name of its session.
    calibration : Calibration
        The new calibration.
    decision : Decision
        The decision on it.

    Examples
    --------
    >>> list(Recalibrated.__dataclass_fields__)
    ['session', 'calibration', 'decision']
    """

    session: str
    calibration: Calibration
    decision: Decision


class Recalibrations:
    """Recalibrations of an archive.

    Parameters
    ----------
    archive : Archive
        The archive.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     Recalibrations(archive).names()
    []
    """

    def __init__(self, archive: Archive) -> None:
        self._archive = archive

    def names(self) -> list[str]:
        """Return the names of the recalibrations."""
        return self._archive.journals(_PREFIX)

    def define(
        self, name: str, session: Session, configuration: str, rules: AcceptanceRules
    ) -> Recalibration:
        """Define a recalibration that repeats a session, or change one.

        Parameters
        ----------
        name : str
            Name of the recalibration.
        session : Session
            A complete session with a calibration.
        configuration : str
            Configuration whose calibration it is.
        rules : AcceptanceRules
            Rules by which new calibrations are judged.

        Raises
        ------
        UsageError
            If the session has no calibration, or the configuration is unknown.
        """
        sessions.calibration_of(session)
        Configurations(self._archive).parts(configuration)
        made = Recalibration(
            name=name, configuration=configuration, plan=session.plan, parameters=session.parameters,
            inputs={each: session.input(each) for each in session.inputs()}, bench=session.bench,
            rules=rules.to_dict(),
        )  # fmt: skip
        self._archive.journal(_PREFIX + name).add("definition", made.to_dict())
        return made

    def get(self, name: str) -> Recalibration:
        """Return a recalibration.

        Raises
        ------
        UsageError
            If there is none.
        """
        entries = self._archive.journal(_PREFIX + name).entries("definition")
        if not entries:
            raise UsageError(
                "is not a recalibration of this archive", where=name, do="define it with --repeats"
            )
        content = dict(entries[-1].document)
        content["parameters"] = sessions.present_keys(content["parameters"])
        return Recalibration.from_content(content, where=name)

    def unfinished(self, name: str) -> str | None:
        """Return the last session of a recalibration that was begun and is not done, or None."""
        plan = self.get(name).plan
        mine = [e.document["session"] for e in self._archive.journal(_PREFIX + name).entries("begun")]
        found = [
            each.name
            for each in self._archive.sessions()
            if each.name in mine and each.plan == plan and each.status != "done"
        ]
        return found[-1] if found else None

    def run(
        self,
        name: str,
        session: str = "",
        *,
        watch: Watch = lambda kind, facts: None,
        bench: Callable[[BenchFile], Bench] = Bench,
        capture: Callable[..., Any] = sessions.capture,
    ) -> Recalibrated:
        """Carry out a recalibration, or continue it.

        Parameters
        ----------
        name : str
            The recalibration.
        session : str
            Name of its session; one that exists is resumed, and one that is done is only judged. Default:
            name and time.
        watch : callable
            Called with events of the acquisition.
        bench : callable
            Makes the bench of its file.
        capture : callable
            Carries out the session on the bench.

        Raises
        ------
        InstrumentError
            If the bench is in use or not ready, or an instrument fails; the session can be continued.
        ReseauError
            If the acquisition or its evaluation fails.
        """
        made = self.get(name)
        rules = AcceptanceRules.from_content(dict(made.rules), where=f"rules of {name}")
        title = session or f"{name}-{self._archive.clock():%Y%m%dT%H%M%SZ}"
        there = any(each.name == title for each in self._archive.sessions())
        if there and self._archive.session(title).status == "done":
            found = self._archive.session(title)
        else:
            found = self._carried_out(made, title, there, bench, partial(capture, watch=watch))
        calibration = sessions.calibration_of(found)
        decision = Configurations(self._archive).decide(
            made.configuration, calibration, rules, since=found.begun, by=f"recalibration {name}",
            session=title,
        )  # fmt: skip
        return Recalibrated(title, calibration, decision)

    def carry_out(self, schedule: Schedule, run: Run, **options: Any) -> str:
        """Carry out a run of a schedule, or continue it: its session has the name of the run.

        Parameters
        ----------
        schedule, run
            As given by :meth:`~reseau.service.Schedules.run_due`.
        **options
            `watch`, `bench` and `capture`, as for :meth:`run`.

        Returns
        -------
        str
            Outcome and name of the decision.

        Raises
        ------
        ReseauError
            As :meth:`run`.
        """
        name = f"{schedule.name}-{run.key.replace(' ', '-')}"
        decision = self.run(schedule.recalibration, name, **options).decision
        return f"{decision.outcome}: {decision.key}"

    def _carried_out(
        self,
        made: Recalibration,
        title: str,
        there: bool,
        bench: Callable[[BenchFile], Bench],
        capture: Callable[[Session, Bench], Any],
    ) -> Session:
        """Begin or resume the session, and carry it out to its end."""
        instruments = bench(BenchFile.parse_toml(made.bench, where=f"bench of {made.name}"))
        if not there:
            sessions.check(title, made.plan, made.parameters, made.inputs, instruments)
        with sessions.lock(instruments, self._archive, title), instruments:
            if there:
                found = sessions.resume(self._archive, made.plan, title)
                found.recover()
            else:
                self._archive.journal(_PREFIX + made.name).append(title, "begun", {"session": title})
                found = sessions.begin(
                    self._archive, title, made.plan, made.parameters, made.inputs, bench=made.bench
                )
            capture(found, instruments)
        if found.status != "done":
            raise InstrumentError(
                f"is {found.status}", where=f"session {title}", do="continue it with --resume"
            )
        return found
