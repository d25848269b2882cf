"""Recalibration: check the bench, acquire, measure, adjust, compare with the calibration in force, decide.

A recalibration repeats an archived session: its plan, parameters, input files and bench.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field

from ..archive import Archive, Session
from ..capture import Bench, BenchFile
from ..capture.judging import Watch
from ..core.errors import InstrumentError, UsageError
from ..core.optional import optional
from ..io import Document
from ..sessions import conducting
from ..sessions.parameters import present_keys
from .alarms import sender
from .decisions import Decision
from .inforce import Configurations
from .orders import asked, held_by_service
from .rules import AcceptanceRules
from .schedule import Run, Schedule

if TYPE_CHECKING:
    from .certificates import CertificateData

_PREFIX, _TEST_S = "recalibrations/", 20.0
Using = Callable[[Bench, Archive, str], AbstractContextManager[Any]]


def slept(seconds: float) -> bool:
    """Wait; never a reason to end waiting."""
    time.sleep(seconds)
    return False


@contextmanager
def locked(bench: Bench, archive: Archive, session: str) -> Iterator[None]:
    """Lock and connect a bench for a session."""
    with conducting.lock(bench, archive, session), bench:
        yield


class Recalibration(Document):
    """What is repeated, and how its result is judged, ``reseau-recalibration/1``.

    Parameters
    ----------
    name, configuration : str
        Name, and the configuration that it calibrates.
    plan, parameters, inputs, bench
        Those of the session that it repeats.
    rules : dict
        ``reseau-acceptance/1``.
    warm_up_minutes : float
        Time for which instruments warm up before the first frame (min).
    self_test : bool
        Test the instruments before it.
    certificate : dict, optional
        Data of the certificate of a calibration that is accepted, ``reseau-certificate/1``.
    notify : tuple of str
        Where the outcome is sent: URLs of apprise.
    inside : tuple of str
        Networks inside to which it may be sent, such as 192.168.1.0/24.

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
    warm_up_minutes: float = Field(default=0.0, ge=0, le=1440)
    self_test: bool = False
    certificate: dict[str, Any] | None = None
    notify: tuple[str, ...] = ()
    inside: tuple[str, ...] = ()


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
        self, name: str, session: Session, configuration: str, rules: AcceptanceRules, **steps: Any
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
        **steps
            `warm_up_minutes`, `self_test`, `certificate`, `notify` and `inside` of :class:`Recalibration`.

        Raises
        ------
        UsageError
            If the session has no calibration, or the configuration is unknown.
        """
        conducting.calibration_of(session)
        Configurations(self._archive).parts(configuration)
        if steps.get("certificate") is not None:  # what it needs is missed now, and not after the acquisition
            _certificate_of(steps["certificate"], name)
        made = Recalibration(
            name=name, configuration=configuration, plan=session.plan, parameters=session.parameters,
            inputs={each: session.input(each) for each in session.inputs()}, bench=session.bench,
            rules=rules.to_dict(), **steps,
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
        content["parameters"] = present_keys(content["parameters"])
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
        by: str = "",
        watch: Watch = lambda kind, facts: None,
        bench: Callable[[BenchFile], Bench] = Bench,
        using: Using = locked,
        capture: Callable[..., Any] = conducting.capture,
        wait: Callable[[float], Any] = time.sleep,
    ) -> Decision:
        """Carry out a recalibration, or continue it.

        Its steps: warm up, self-test, acquire, decide, certificate, notify; each is said to `watch`.

        Parameters
        ----------
        name : str
            The recalibration.
        session : str
            Name of its session; one that exists is resumed, and one that is done is only judged. Default:
            name and time.
        by : str
            Who asked for it.
        watch : callable
            Called with events of the acquisition.
        bench : callable
            Makes the bench of its file.
        using : callable
            Holds the instruments of a bench for a session, in a ``with`` block.
        capture : callable
            Carries out the session on the bench.
        wait : callable
            Waits for some seconds while the instruments warm up.

        Returns
        -------
        Decision
            On the new calibration.

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
            instruments = bench(BenchFile.parse_toml(made.bench, where=f"bench of {name}"))
            found = self._carried_out(made, title, there, instruments, using, partial(capture, watch=watch),
                                      lambda: _prepared(made, instruments, watch, wait))  # fmt: skip
        decision = Configurations(self._archive).decide(
            made.configuration, conducting.calibration_of(found), rules, since=found.begun, session=title,
            by=f"{by}, recalibration {name}" if by else f"recalibration {name}",
        )  # fmt: skip
        watch("step", {"text": f"decided: {decision.outcome} ({decision.key})"})
        if made.certificate is not None and decision.outcome.startswith("accepted"):
            self._certify(made, found, decision)
            watch("step", {"text": "certificate issued"})
        if made.notify:
            why = "; ".join(each.text for each in decision.judgement.findings if each.level != "ok")
            text = f"{made.configuration}: {title} {decision.outcome}{f' ({why})' if why else ''}"
            sent = sender(made.notify, made.inside)(f"reseau: {name} {decision.outcome}", text)
            watch("step", {"text": "notified" if sent else "could not be notified"})
        return decision

    def carry_out(self, schedule: Schedule, run: Run, **options: Any) -> str:
        """Carry out a run of a schedule, or continue it: its session has the name of the run.

        Parameters
        ----------
        schedule, run
            As given by :meth:`~reseau.service.Schedules.run_due`.
        **options
            As for :meth:`ask`.

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
        decision = self.ask(schedule.recalibration, name, f"schedule {schedule.name}", **options)
        return f"{decision.outcome}: {decision.key}"

    def ask(
        self, name: str, session: str = "", by: str = "",
        over: Callable[[float], bool] = slept, **options: Any,
    ) -> Decision:  # fmt: skip
        """Have a recalibration carried out by the service that holds its bench, or, without one, do it here.

        Parameters
        ----------
        name, session
            As for :meth:`run`.
        by : str
            Who asks.
        over : callable
            Waits for some seconds, and returns whether the waiting for the service should end.
        **options
            For :meth:`run`, where no service holds the bench.

        Raises
        ------
        ReseauError
            As :meth:`run`.
        """
        made = self.get(name)
        bench = BenchFile.parse_toml(made.bench, where=f"bench of {name}")
        if not held_by_service(bench):
            return self.run(name, session, by=by, **options)
        order = asked(self._archive, bench.name, "recalibration", {"name": name}, by, session, over)
        decided = Configurations(self._archive).history(made.configuration)
        return next(each for each in reversed(decided) if each.session == order.session)

    def _certify(self, made: Recalibration, session: Session, decision: Decision) -> None:
        """Issue the certificate of an accepted calibration, kept among the results of its session."""
        from .certificates import certify, html_of

        known = Configurations(self._archive)
        data, dcc_of = _certificate_of(made.certificate or {}, made.name)
        found = certify(
            known.calibration(made.configuration, decision.key), data,
            issued=self._archive.clock().date(), decision=decision, configuration=made.configuration,
            earlier=known.earlier(made.configuration, decision),
        )  # fmt: skip
        session.keep("certificate.html", html_of(found).encode(), {"certificate": found.identifier})
        session.keep("certificate.xml", dcc_of(found, ""), {"certificate": found.identifier})

    def _carried_out(
        self, made: Recalibration, title: str, there: bool, instruments: Bench, using: Using,
        capture: Callable[[Session, Bench], Any], prepare: Callable[[], None],
    ) -> Session:  # fmt: skip
        """Begin or resume the session, and carry it out to its end."""
        if not there:
            conducting.check(title, made.plan, made.parameters, made.inputs, instruments)
        with using(instruments, self._archive, title):
            prepare()
            if there:
                found = conducting.resume(self._archive, made.plan, title)
                found.recover()
            else:
                self._archive.journal(_PREFIX + made.name).append(title, "begun", {"session": title})
                found = conducting.begin(
                    self._archive, title, made.plan, made.parameters, made.inputs, bench=made.bench
                )
            capture(found, instruments)
        if found.status != "done":
            raise InstrumentError(
                f"is {found.status}", where=f"session {title}", do="continue it with --resume"
            )
        return found


def _certificate_of(content: Mapping[str, Any], name: str) -> tuple[CertificateData, Callable[..., bytes]]:
    """Data of a certificate, and what makes the document of it."""
    from .certificates import CertificateData

    with optional():
        from .certificates.dcc import dcc_of

    return CertificateData.from_content(dict(content), where=f"certificate of {name}"), dcc_of


def _prepared(made: Recalibration, bench: Bench, watch: Watch, wait: Callable[[float], Any]) -> None:
    """Warm up, and test the instruments."""
    if made.warm_up_minutes:
        watch("step", {"text": f"warms up for {made.warm_up_minutes:g} min"})
        wait(60 * made.warm_up_minutes)
    if made.self_test:
        failed = [f"{each.name}: {each.error}" for each in bench.check(_TEST_S) if each.error is not None]
        if failed:
            raise InstrumentError("; ".join(failed), where="self-test")
        watch("step", {"text": "self-test passed"})
