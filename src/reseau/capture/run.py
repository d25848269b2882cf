"""The engine that carries a plan out: pause, resume, abort with clean-up, and the documents as the record."""

from __future__ import annotations

import contextlib
import json
import logging
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal

from bluesky import RunEngine
from bluesky import plan_stubs as bps
from bluesky import preprocessors as bpp
from bluesky.utils import FailedStatus, RunEngineInterrupted

from ..archive import Session
from ..core.errors import InstrumentError, ReseauError
from ..core.threads import one_thread
from .acquisition import Acquisition, Plan

__all__ = ["Decision", "carry_out"]

# What goes wrong is told once, by the error that is raised; the engine would print it as well.
logging.getLogger("bluesky").addHandler(logging.NullHandler())

Decision = Literal["resume", "stop", "abort"]
"""What is to become of a paused acquisition; stopping keeps it for `--resume`, and so does aborting."""


def carry_out(
    run: Acquisition,
    plan: Plan,
    *,
    park: Mapping[str, float] | None = None,
    retreat: Mapping[str, float] | None = None,
    paused: Callable[[], Decision] = lambda: "stop",
) -> Any:
    """Carry out a plan, and then whatever the procedure makes of the frames.

    Parameters
    ----------
    run : Acquisition
        Bench, session and procedure.
    plan : generator
        Messages.
    park : mapping, optional
        Where the table is moved when all is done; without it, it stands where the last frame was taken.
    retreat : mapping, optional
        Where it is moved when it was ended before, or failed; without it, it stands where it stopped.
    paused : callable
        Asked when the plan was interrupted, by Ctrl-C or by :meth:`RunEngine.request_pause`.

    Returns
    -------
    object
        What the plan returned; None when it was ended before.

    Raises
    ------
    ReseauError
        When an instrument, the archive or the procedure failed. The bench is at rest, and what was taken is
        in the archive.

    Notes
    -----
    To be called in the main thread, where the engine minds Ctrl-C: once, and it pauses after the pose; twice,
    and it pauses at once. SIGTERM, and SIGHUP of a terminal that is closed, end it as `stop` does.
    """
    in_main = threading.current_thread() is threading.main_thread()
    engine, ended = _engine(run, in_main), threading.Event()
    status = "failed"
    try:
        run.ready()
        with one_thread():  # the same sums however many processors there are
            with contextlib.redirect_stdout(sys.stderr), _terminated(engine, ended, in_main):
                outcome = _engaged(engine, _whole(run, plan, park or {}), paused, ended)
            run.settle()
            status = "stopped" if outcome is None else "done"
            if outcome is not None:
                _keep_results(run)
        run.kept.end(status)
        found = None if outcome is None else outcome.plan_result
        run.watch("end", {"status": status, "why": found if isinstance(found, str) else ""})
        return found
    except Exception as error:
        known = _known(error)
        with contextlib.suppress(ReseauError):  # an archive that is full cannot be told that it is
            run.kept.end("failed", str(known or error))
        run.watch("end", {"status": "failed", "why": str(known or error)})
        if known is not None:
            raise known from None
        raise
    finally:
        run.rest()
        run.settle()
        if retreat and status != "done":
            run.retreat(retreat)


def _engine(run: Acquisition, in_main: bool) -> Any:
    """The engine, which knows the messages of an acquisition and keeps its documents."""
    # Off the main thread there are no signals to be minded.
    engine: Any = RunEngine({}, call_returns_result=True, context_managers=None if in_main else [])
    for name, command in run.commands.items():
        engine.register_command(name, command)
    engine.subscribe(_Recorder(run.kept))
    return engine


def _whole(run: Acquisition, plan: Plan, park: Mapping[str, float]) -> Plan:
    """The plan as one run; what becomes of the bench at its end is not the plan's business."""

    def inner() -> Plan:
        yield from bps.open_run({"session": run.kept.name, "plan": run.kept.plan})
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
    ended: threading.Event,
) -> Any:
    """What the engine returns; None when the plan was ended before its end."""
    todo: Callable[[], Any] = lambda: engine(plan)  # noqa: E731
    while True:
        try:
            return todo()
        except RunEngineInterrupted:
            decision: Decision = "stop"
            with contextlib.suppress(KeyboardInterrupt):  # that is an answer, too
                decision = "stop" if ended.is_set() else paused()
            if decision == "resume":
                todo = engine.resume
                continue
            with contextlib.suppress(RunEngineInterrupted):
                (engine.abort if decision == "abort" else engine.stop)()
            return None


@contextlib.contextmanager
def _terminated(engine: Any, ended: threading.Event, in_main: bool) -> Iterator[None]:
    """Have SIGTERM and SIGHUP end the run as Ctrl-C twice and `stop` would."""
    if not in_main:
        yield
        return

    def end(*_: object) -> None:
        ended.set()
        with contextlib.suppress(Exception):  # there may be nothing to pause any more
            engine.request_pause(False)

    before = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _keep_results(run: Acquisition) -> None:
    """Keep what the procedure makes of the frames, unless it is there already, to the byte."""
    if run.procedure is None:
        return
    frames = run.kept.frames(kind="frame")
    inputs = {name: given.sha256 for name, given in run.kept.given().items()}
    inputs |= {f.name: f.sha256 for f in frames if f.verdict is not None and f.verdict.ok}
    there = {result.name: run.kept.content(result) for result in run.kept.results()}
    for name, content in run.procedure.finish().items():
        if there.get(name) != content.encode("utf-8"):
            run.kept.keep(name, content, run.kept.parameters, inputs)
        run.watch("result", {"name": name})


def _known(error: BaseException) -> ReseauError | None:
    """The error of ours behind one of the engine."""
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
    """Documents of the engine, into the archive; an event that is emitted again after a pause is the same."""

    def __init__(self, kept: Session) -> None:
        self._kept = kept
        self._run_of: dict[str, str] = {}

    def __call__(self, kind: str, document: Mapping[str, Any]) -> None:
        plain = json.loads(json.dumps(document, default=_plain))
        if kind == "descriptor":
            self._run_of[plain["uid"]] = plain["run_start"]
        key = plain["uid"]
        if kind == "event":
            key = f"{self._run_of[plain['descriptor']]}/{plain['seq_num']}"
        self._kept.note(f"{kind} {key}", kind, plain)


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)
