"""Carry out a plan with bluesky's engine (pause, resume, abort, documents), and rerun a session's results."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from bluesky import RunEngine
from bluesky import plan_stubs as bps
from bluesky import preprocessors as bpp
from bluesky.utils import DuringTask, FailedStatus, RunEngineInterrupted

from ..archive import Session
from ..archive.records import ArchivedResult
from ..core.errors import InstrumentError, ReseauError
from ..core.threads import one_thread
from .acquisition import Acquisition, Plan
from .judging import Procedure
from .steps import Step, as_taken

# An error is reported once, by the exception that is raised; the engine would print it as well.
logging.getLogger("bluesky").addHandler(logging.NullHandler())

Decision = Literal["resume", "stop", "abort"]
"""Answer to a pause. After `stop` and after `abort` the session can be resumed later."""


def carry_out(
    run: Acquisition,
    plan: Plan,
    *,
    park: Mapping[str, float] | None = None,
    retreat: Mapping[str, float] | None = None,
    paused: Callable[[], Decision] = lambda: "stop",
    control: Control | None = None,
) -> Any:
    """Carry out a plan, then store the results of the procedure.

    Parameters
    ----------
    run : Acquisition
        Bench, session and procedure.
    plan : generator
        Messages.
    park : mapping, optional
        Position of the table after a complete plan. Default: it stays at the last pose.
    retreat : mapping, optional
        Position of the table after a stop or a failure. Default: it stays where it stopped.
    paused : callable
        Called when the plan was interrupted, by Ctrl-C or by :meth:`RunEngine.request_pause`.
    control : Control, optional
        Pauses it from another thread; in place of `paused`.

    Returns
    -------
    object
        The return value of the plan; None if it was ended early.

    Raises
    ------
    ReseauError
        If an instrument, the archive or the procedure failed. The bench is stopped, and the frames taken so
        far are in the archive.

    Notes
    -----
    Call it in the main thread, where the engine handles Ctrl-C: pressed once, it pauses after the pose;
    pressed twice, it pauses at once. SIGTERM, and SIGHUP of a closed terminal, act like `stop`.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.archive import Archive
    >>> from reseau.capture import Bench, BenchFile
    >>> def plan(run):
    ...     yield from run.move({})
    ...     return "nothing to do"
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     session = archive.begin("monday", "own", {})
    ...     run = Acquisition(Bench(BenchFile(name="empty", instruments={})), session)
    ...     carry_out(run, plan(run)), session.status
    ('nothing to do', 'done')
    """
    in_main = threading.current_thread() is threading.main_thread()
    engine = _engine(run, in_main)
    ended = _Asked() if control is None else control.attach(engine)
    paused = paused if control is None else control.wait
    status = "failed"
    try:
        run.ready()
        with one_thread():  # the same sums for any number of processors
            with contextlib.redirect_stdout(_Prints()), _ended_by_signals(engine, ended, in_main):
                outcome = _engaged(engine, _whole(run, ended.interruptible(plan), park or {}), paused, ended)
            run.settle()
            status = "stopped" if outcome is None else "done"
            if outcome is not None:
                _store_results(run)
        run.session.end(status)
        found = None if outcome is None else outcome.plan_result
        run.watch("end", {"status": status, "why": found if isinstance(found, str) else ""})
        return found
    except Exception as error:
        known = _known(error)
        with contextlib.suppress(ReseauError):  # a full archive cannot store this either
            run.session.end("failed", str(known or error))
        run.watch("end", {"status": "failed", "why": str(known or error)})
        if known is not None:
            raise known from None
        raise
    finally:
        run.rest(over=True)
        run.settle()
        if retreat and status != "done":
            run.retreat(retreat)


@dataclass(frozen=True)
class Rerun:
    """One result, computed again.

    Parameters
    ----------
    result : ArchivedResult
        The result in the archive.
    content : str or None
        The new content; None if the procedure no longer makes a result of this name.
    same : bool
        Whether both are identical to the byte.

    Examples
    --------
    >>> from reseau.archive.records import ArchivedResult
    >>> kept = ArchivedResult(1, "true.csv", "ab12", ".csv", 4, {}, {}, "reseau 0.1")
    >>> Rerun(kept, None, same=False).same
    False
    """

    result: ArchivedResult
    content: str | None
    same: bool


def rerun(session: Session, procedure: Procedure) -> list[Rerun]:
    """Compute the results of a session again, from its frames in the order in which they were taken.

    Parameters
    ----------
    session : Session
        A session of the archive.
    procedure : Procedure
        A new procedure, made with the parameters of the session; see
        :func:`reseau.sessions.conducting.procedure_of`.

    Examples
    --------
    >>> import tempfile
    >>> from reseau.archive import Archive
    >>> class Fixed:
    ...     def finish(self):
    ...         return {"answer.txt": "42"}
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     session = archive.begin("monday", "own", {})
    ...     kept = session.keep("answer.txt", "42")
    ...     [each.same for each in rerun(session, Fixed())]
    [True]
    """
    with one_thread():  # the same sums for any number of processors
        for frame in session.frames(kind="frame"):
            # The procedure never got frames that were saturated or blurred by motion.
            if frame.verdict is not None and frame.verdict.ok:
                step = as_taken(Step(frame.step, frame.facts.get("position", {})), frame.facts)
                procedure.on_frame(session.picture(frame), step)
        contents = procedure.finish()
    latest = {result.name: result for result in session.results()}
    return [
        Rerun(result, contents.get(name), contents.get(name, "").encode("utf-8") == session.content(result))
        for name, result in latest.items()
    ]


def _engine(run: Acquisition, in_main: bool) -> Any:
    """The engine, with the messages of an acquisition, storing its documents."""
    # Signals are handled in the main thread only.
    engine: Any = RunEngine(
        {},
        call_returns_result=True,
        context_managers=[lambda engine: _Interrupts(engine, run)] if in_main else [],
        during_task=_Awake(),  # type: ignore[no-untyped-call]
    )
    for name, command in run.commands.items():
        engine.register_command(name, command)
    engine.subscribe(_Recorder(run.session))
    return engine


class _Prints(io.TextIOBase):
    """Passes on what a plan prints, to standard error, but not what the engine prints about itself."""

    _ENGINE = ("Pausing...", "Deferred pause", "Stopping: running", "Aborting: running", "Halting: skipping")

    def __init__(self) -> None:
        self._line = ""

    def write(self, text: str) -> int:
        *lines, self._line = (self._line + text).split("\n")
        for line in lines:
            if not line.startswith(self._ENGINE):
                sys.stderr.write(line + "\n")
        return len(text)


class _Interrupts:
    """Ctrl-C pauses after the present pose, pressed again at once; the fifth time it interrupts Python."""

    def __init__(self, engine: Any, run: Acquisition) -> None:
        self._engine, self._run = engine, run
        self._pressed, self._last = 0, 0.0
        self._before: Any = None

    def __enter__(self) -> None:
        self._before = signal.signal(signal.SIGINT, self._on_press)

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _on_press(self, *_: object) -> None:
        now = time.monotonic()
        if now - self._last < 0.1:  # a terminal may send it to the whole group of processes, twice
            return
        self._pressed, self._last = self._pressed + 1, now
        if self._pressed > 4:
            raise KeyboardInterrupt
        soft = self._pressed == 1
        self._run.watch("interrupt", {"at_once": not soft, "waits_for": self._run.doing})
        with contextlib.suppress(Exception):  # it may have paused or ended already
            self._engine.request_pause(defer=soft)


class _Awake(DuringTask):
    """Waits for the engine, and runs handlers of signals meanwhile.

    The system may deliver a signal to any thread; its handler runs in the main thread, once that wakes.
    """

    def block(self, blocking_event: threading.Event) -> None:
        """Wait for the event."""
        while not blocking_event.wait(0.1):
            pass


def _whole(run: Acquisition, plan: Plan, park: Mapping[str, float]) -> Plan:
    """The plan as one run that ends with the bench stopped."""

    def inner() -> Plan:
        yield from bps.open_run({"session": run.session.name, "plan": run.session.plan})
        found = yield from plan
        yield from bps.close_run()
        yield from run.move(park)
        return found

    return (yield from bpp.finalize_wrapper(inner(), _to_rest(run)))  # type: ignore[no-untyped-call]


def _to_rest(run: Acquisition) -> Plan:
    run.rest()
    yield from bps.null()


def _engaged(
    engine: Any,
    plan: Plan,
    paused: Callable[[], Decision],
    ended: _Asked,
) -> Any:
    """The return value of the engine; None if the plan was ended early."""
    todo: Callable[[], Any] = lambda: engine(plan)  # noqa: E731
    while True:
        try:
            return todo()
        except RunEngineInterrupted:
            decision: Decision = "stop"
            with contextlib.suppress(KeyboardInterrupt):  # Ctrl-C at the question means stop
                decision = "stop" if ended.noticed() else paused()
            if decision == "resume":
                ended.go_on()
                todo = engine.resume
                continue
            with contextlib.suppress(RunEngineInterrupted):
                (engine.abort if decision == "abort" else engine.stop)()
            return None


class _Asked:
    """Whether a pause or the end of the run was asked for, and whether that has interrupted the engine."""

    def __init__(self) -> None:
        self._asked, self._over, self._interrupted = threading.Event(), threading.Event(), threading.Event()
        self._inserted = False

    def pause(self) -> None:
        """Note that a pause is asked for."""
        self._asked.set()

    def end(self) -> None:
        """Note that the end is asked for."""
        self._over.set()
        self._asked.set()

    def noticed(self) -> bool:
        """Note that the engine was interrupted; return whether the end was asked for."""
        if self._asked.is_set():
            self._interrupted.set()
        return self._over.is_set()

    def go_on(self) -> None:
        """Note that the run goes on: the next pause is another one."""
        if not self._over.is_set():
            self._asked.clear()
            self._interrupted.clear()
            self._inserted = False

    def interruptible(self, plan: Plan) -> Plan:
        """The plan, which pauses before its next message where the engine has lost the request to pause.

        On a busy machine a pause that is requested while the engine waits for an instrument can be lost.
        """
        # bluesky's `plan_mutator` would keep every message of the plan, and sessions have any number of them.
        todo = partial(next, plan)
        while True:
            try:
                message = todo()
            except StopIteration as end:
                return end.value
            try:
                if self._asked.is_set() and not (self._inserted or self._interrupted.is_set()):
                    self._inserted = True
                    yield from bps.pause()
                todo = partial(plan.send, (yield message))
            except GeneratorExit:
                plan.close()
                raise
            except Exception as error:
                todo = partial(plan.throw, error)


class Control:
    """Pauses a plan, and lets it go on or ends it, from another thread.

    Parameters
    ----------
    paused : callable
        Called in the thread of the plan when it has paused.

    Examples
    --------
    >>> control = Control()
    >>> control.pause()  # nothing runs yet
    False
    """

    def __init__(self, paused: Callable[[], None] = lambda: None) -> None:
        self._paused, self._engine, self._asked = paused, None, _Asked()
        self._decisions: queue.SimpleQueue[Decision] = queue.SimpleQueue()

    def attach(self, engine: Any) -> _Asked:
        """Control this engine from now on."""
        self._engine = engine
        return self._asked

    def pause(self, *, at_once: bool = False) -> bool:
        """Pause after the present pose, or at once: what moves is stopped then.

        Returns
        -------
        bool
            Whether there is a plan that runs.
        """
        engine: Any = self._engine
        if engine is None:
            return False
        if at_once:
            self._asked.pause()
        try:
            engine.request_pause(defer=not at_once)
        except Exception:  # it has just paused or ended
            return False
        return True

    def decide(self, decision: Decision) -> None:
        """Say how a plan goes on; one that runs is paused at once for `stop` and `abort`."""
        self._decisions.put(decision)
        if decision != "resume":
            self.pause(at_once=True)

    def wait(self) -> Decision:
        """Return the next decision; for the parameter `paused` of :func:`carry_out`."""
        if self._decisions.empty():
            self._paused()
        return self._decisions.get()


@contextlib.contextmanager
def _ended_by_signals(engine: Any, ended: _Asked, in_main: bool) -> Iterator[None]:
    """Make SIGTERM and SIGHUP end the run, like Ctrl-C twice and `stop`."""
    if not in_main:
        yield
        return

    def end(*_: object) -> None:
        ended.end()
        with contextlib.suppress(Exception):  # the run may have ended already
            engine.request_pause(False)

    # Windows has no SIGHUP.
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.signal(number, end) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _store_results(run: Acquisition) -> None:
    """Store the results of the procedure, unless they are stored already, identical to the byte."""
    if run.procedure is None:
        return
    frames = run.session.frames(kind="frame")
    inputs = {name: given.sha256 for name, given in run.session.inputs().items()}
    inputs |= {f.name: f.sha256 for f in frames if f.verdict is not None and f.verdict.ok}
    stored = {result.name: run.session.content(result) for result in run.session.results()}
    for name, content in run.procedure.finish().items():
        if stored.get(name) != content.encode("utf-8"):
            run.session.keep(name, content, run.session.parameters, inputs)
        run.watch("result", {"name": name})


def _known(error: BaseException) -> ReseauError | None:
    """The ReseauError behind an error of the engine."""
    at: BaseException | None = error
    while at is not None:
        if isinstance(at, ReseauError):
            return at
        if isinstance(at, FailedStatus) and at.args and hasattr(at.args[0], "exception"):
            behind = at.args[0].exception()
            if isinstance(behind, ReseauError):
                return behind
        at = at.__cause__ or at.__context__
    return InstrumentError(str(error)) if isinstance(error, FailedStatus) else None


class _Recorder:
    """Stores the engine's documents in the archive; an event emitted again after a pause is stored once."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._run_of: dict[str, str] = {}

    def __call__(self, kind: str, document: Mapping[str, Any]) -> None:
        plain = json.loads(json.dumps(document, default=_plain))
        if kind == "descriptor":
            self._run_of[plain["uid"]] = plain["run_start"]
        key = plain["uid"]
        if kind == "event":
            key = f"{self._run_of[plain['descriptor']]}/{plain['seq_num']}"
        self._session.note(f"{kind} {key}", kind, plain)


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)
