"""Begin, carry out, resume and rerun sessions of an archive."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

from ..archive import Archive, Session
from ..calibration.document import Calibration
from ..capture import Acquisition, Bench, BenchLock, RemoteOperator, carry_out, plans
from ..capture.engine import Control, Decision, Rerun
from ..capture.engine import rerun as rerun_with
from ..capture.judging import Procedure, Watch
from ..core.errors import ReseauError, UsageError
from ..core.failure import Code, Failure
from ..execution import Executor
from .kinds import GENERATOR, Reported, SessionKind, kind_of, own_plan
from .parameters import OwnParameters, SessionParameters, present_keys

CALIBRATION = "calibration.json"


def _where(name: str, plan: str) -> str:
    return f"{name}: parameters of plan `{plan}`"


def check(
    name: str,
    plan: str,
    parameters: Mapping[str, Any] | SessionParameters,
    inputs: Mapping[str, str] | None = None,
    bench: Bench | None = None,
) -> SessionParameters:
    """Check parameters, inputs and bench of a new session, and return the parameters.

    Parameters
    ----------
    name : str
        Name of the session, for messages.
    plan : str
        Plan; a key of :data:`reseau.sessions.kinds.KINDS`.
    parameters : mapping or SessionParameters
        Parameters of the plan.
    inputs : mapping of str to str, optional
        Contents of the input files, by name.
    bench : Bench, optional
        The bench that is to carry out the plan.

    Raises
    ------
    FormatError
        If the parameters or a design do not keep to their schema.
    UsageError
        If an input is missing, or the bench cannot carry out the plan.

    Examples
    --------
    >>> check("monday", "frames", {"count": 3}).expected
    3
    """
    kind, given = kind_of(plan), dict(inputs or {})
    values = parameters.to_archive() if isinstance(parameters, SessionParameters) else parameters
    found = kind.parameters.from_archive(values, where=_where(name, plan))
    for each in kind.inputs:
        if each not in given:
            raise UsageError("missing input", where=f"{name}: {each}", do="pass its content in `inputs`")
        kind.read(given[each], each, each)
    if isinstance(found, OwnParameters):
        own_plan(given[GENERATOR], GENERATOR, found.set)
    if bench is not None:
        found.check_bench(bench)
    return found


def begin(
    archive: Archive,
    name: str,
    plan: str,
    parameters: Mapping[str, Any] | SessionParameters,
    inputs: Mapping[str, str] | None = None,
    *,
    bench: str = "",
) -> Session:
    """Check parameters and inputs, and begin a session in an archive.

    Parameters
    ----------
    archive : Archive
        The archive.
    name : str
        Name of the session, unique in the archive.
    plan, parameters, inputs
        As for :func:`check`. The archive stores the parameters as given, without defaults.
    bench : str
        Content of ``bench.toml``.

    Raises
    ------
    FormatError, UsageError
        As :func:`check`.
    ArchiveError
        If there is a session of this name, or the archive cannot store it.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     begin(archive, "monday", "frames", {"count": 3}).parameters
    {'count': 3}
    """
    check(name, plan, parameters, inputs)
    values = parameters.to_archive() if isinstance(parameters, SessionParameters) else parameters
    return archive.begin(name, plan, values, bench, inputs)


def resume(archive: Archive, plan: str, name: str = "") -> Session:
    """Return the session to resume: the named one, or the only one of its plan that is not done.

    Call :meth:`~reseau.archive.Session.recover` on it once its bench is locked.

    Raises
    ------
    UsageError
        If no session or several sessions can be resumed, or the named one is of another plan.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     _ = begin(archive, "monday", "frames", {})
    ...     resume(archive, "frames").name
    'monday'
    """
    if not name:
        names = [each.name for each in archive.sessions() if each.plan == plan and each.status != "done"]
        if not names:
            raise UsageError("no session can be resumed", where=plan)
        if len(names) > 1:
            raise UsageError(f"{', '.join(names)} can be resumed", where=plan, do="name one")
        name = names[0]
    session = archive.session(name)
    if session.plan != plan:
        raise UsageError(f"its plan is `{session.plan}`", where=name, do="resume it with that plan")
    return session


def lock(bench: Bench, archive: Archive, name: str) -> BenchLock:
    """Return the lock of a session: its instruments, and the session itself.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.capture import BenchFile
    >>> bench = Bench(BenchFile(name="empty", instruments={}))
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     with lock(bench, archive, "monday"):
    ...         print("locked")
    locked
    """
    return bench.lock(f"session {name}", f"{archive.place}: {name}")


def parameters_of(session: Session) -> SessionParameters:
    """Return the parameters of a session.

    Raises
    ------
    FormatError
        If they do not keep to the schema of the plan.
    UsageError
        If the plan is unknown.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     parameters_of(begin(archive, "monday", "scan", {})).expected
    1
    """
    return kind_of(session.plan).parameters.from_archive(
        present_keys(session.parameters), where=_where(session.name, session.plan)
    )


def procedure_of(session: Session) -> Procedure | None:
    """Return a new procedure for the frames of a session; None if its frames are only stored.

    Live and offline, it is made of what the archive holds, so that both give the same results.

    Raises
    ------
    FormatError
        If parameters or inputs do not keep to their schema.
    UsageError
        If the plan is unknown.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     session = begin(archive, "monday", "sensor", {"region": None})
    ...     hasattr(procedure_of(session), "on_frame")
    True
    """
    return _procedure(session, kind_of(session.plan), parameters_of(session))


def _procedure(session: Session, kind: SessionKind, given: SessionParameters) -> Procedure | None:
    if kind.procedure is None:
        return None
    procedure, results = kind.procedure(session, given), kind.results
    return procedure if results is None else Reported(procedure, lambda: results(procedure, session))


def capture(
    session: Session,
    bench: Bench,
    *,
    watch: Watch = lambda kind, facts: None,
    operator: Callable[[str], None] | None = None,
    paused: Callable[[], Decision] = lambda: "stop",
    control: Control | None = None,
    home: bool = False,
) -> Any:
    """Carry out a session, new or resumed, with the plan and the procedure of its kind.

    Only the instruments that the plan uses are connected, stopped and recorded.

    Parameters
    ----------
    session : Session
        The session.
    bench : Bench
        Connected or not.
    watch, operator
        As for :class:`reseau.capture.Acquisition`; the operator that the bench file names takes precedence.
    paused, control
        As for :func:`reseau.capture.carry_out`.
    home : bool
        Whether axes without a reference are homed first, also if the parameters do not say so.

    Returns
    -------
    object
        The return value of the plan: a text if a goal was not reached.

    Raises
    ------
    ReseauError
        As :func:`reseau.capture.carry_out`.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.capture import BenchFile
    >>> plan = "def plan(run):\\n    yield from run.move({})\\n    return 'ready'"
    >>> bench = Bench(BenchFile(name="empty", instruments={}))
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     capture(begin(archive, "monday", "own", {}, {"generator.py": plan}), bench)
    'ready'
    """
    kind, given = kind_of(session.plan), parameters_of(session)
    if home:
        given = given.model_copy(update={"home": True})
    if bench.file.operator:
        remote = RemoteOperator(bench.file.operator)

        def operator(request: str) -> None:
            watch("asked", {"request": request, "operator": remote.address})
            remote(request)

    procedure = _procedure(session, kind, given)
    run = Acquisition(
        given.part_of(bench), session, procedure, camera=given.camera, table=given.table,
        oscilloscope=given.oscilloscope, scanner=given.scanner, retakes=given.retakes, limits=kind.limits,
        watch=watch, operator=operator,
    )  # fmt: skip
    plan = kind.acquire(run, given)
    found = carry_out(
        run, plans.homed(run, plan) if given.home else plan, park=given.park, retreat=given.retreat,
        paused=paused, control=control,
    )  # fmt: skip
    if kind.verdict is not None and session.status == "done":
        watch("verdict", kind.verdict(procedure.procedure if isinstance(procedure, Reported) else procedure))
    return found


def rerun(session: Session) -> list[Rerun]:
    """Compute the results of a session again, and compare them with those of the archive.

    Raises
    ------
    UsageError
        If the plan computes nothing, or the session has no results.
    FormatError
        If its parameters do not keep to their schema.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     rerun(archive.begin("mine", "sensor", {}))
    Traceback (most recent call last):
        ...
    reseau.core.errors.FormatError: mine: parameters of plan `sensor`: missing key `region`
    """
    procedure = procedure_of(session)
    if procedure is None:
        raise UsageError(f"plan `{session.plan}` computes nothing", where=session.name)
    if not session.results():
        raise UsageError(f"has no results (status: {session.status})", where=session.name)
    return rerun_with(session, procedure)


def rerun_all(
    place: str, objects: str | None, names: Sequence[str], executor: Executor
) -> Iterator[tuple[str, list[Rerun] | Failure]]:
    """Compute the results of several sessions of an archive again, each independently of the others.

    Parameters
    ----------
    place, objects : str
        The archive, as for :meth:`~reseau.archive.Archive.open`; workers open it, too.
    names : sequence of str
        Names of the sessions.
    executor : Executor
        What does the work.

    Returns
    -------
    iterator of (str, list of Rerun or Failure)
        Names with what :func:`rerun` returned, or why a session cannot be computed again.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.execution import Here
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     _ = archive.begin("mine", "frames", {})
    ...     for name, found in rerun_all(folder, None, ["mine"], Here()):
    ...         print(found)
    mine: plan `frames` computes nothing
    """
    yield from executor.outcomes(partial(_rerun, place, objects), ((name, name) for name in names))


def _rerun(place: str, objects: str | None, name: str) -> list[Rerun] | Failure:
    try:
        with Archive.open(place, objects) as archive:
            return rerun(archive.session(name))
    except ReseauError as error:
        return Failure(error.what, Code.DECLINED, where=str(error.where or name))


def calibration_of(session: Session) -> Calibration:
    """Return the latest calibration of a session, with the time at which the session began.

    Raises
    ------
    UsageError
        If the session has none.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     calibration_of(begin(archive, "monday", "frames", {}))
    Traceback (most recent call last):
        ...
    reseau.core.errors.UsageError: monday: has no calibration (status: not ended)
    """
    found = [result for result in session.results() if result.name == CALIBRATION]
    if not found:
        raise UsageError(f"has no calibration (status: {session.status})", where=session.name)
    text = session.content(found[-1]).decode("utf-8")
    times = {"begun": session.begun.isoformat(timespec="seconds")}
    return Calibration.parse(text, where=CALIBRATION).model_copy(update={"times": times})
