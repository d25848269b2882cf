"""The process that holds the hardware of a bench: `python -m reseau.service.worker`.

One thread carries out commands in their order, and begins what waits in the queue of the bench; one carries
out a session, one takes live pictures, one connects instruments that were silent, and one looks for scheduled
runs that are due. `stop` is none of these: the thread that reads it carries it out. The archive
has what happened; the status follows from it and from the instruments, so that a service that is started
again, or another browser, sees the same.
"""

from __future__ import annotations

import contextlib
import inspect
import json
import math
import os
import queue
import signal
import socket
import ssl
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from ..archive import Archive
from ..capture import Bench, BenchFile, BenchLock, by_hand
from ..capture.checks import edge_sigma, exposure_fault, grey_counts
from ..capture.engine import Control
from ..core.errors import BenchError, InstrumentError, ReseauError, StateError, UsageError
from ..core.memory import keep_loaded, share_freed_memory
from ..instruments import Camera, Turntable
from ..io import read_text
from ..sessions import conducting, kinds
from ..sessions.parameters import SessionParameters
from .orders import Order, Orders, owner
from .state import StateFolder, private_file
from .wire import Certificates, Wire, checked_peer, to_error

_LIVE_S, _RETRY_S, _WIDTH = 5.0, 3.0, 960
_STEADY_S = 0.1
"""Time between live pictures, at least."""
_FOLLOW_S = 0.25
"""Time between looks at axes that move."""
_INSIST_S = 2.0
"""For how long a stop is repeated while a movement that it ends has not ended."""
_ASIDE = frozenset({"status", "bench", "settings", "axes", "picture", "pause", "abort", "end", "release"})
"""Commands that set nothing into motion."""
_QUEUE_S, _SCHEDULE_S = 1.0, 5.0
"""Time between looks at the queue, and at the schedules."""
_ALONE_S = 600.0
"""Time after which the worker of a service ends that has gone, when no session runs."""


def address_file(state: StateFolder, name: str) -> Path:
    """Return the file in which the worker of a bench says where it listens.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     address_file(StateFolder(Path(folder) / "state"), "cellar/2").name
    'bench-63656c6c61722f32.json'
    """
    return state.subfolder("workers") / f"bench-{name.encode().hex()[:120]}.json"


class Worker:
    """The worker of a bench.

    Parameters
    ----------
    text : str
        Content of ``bench.toml``.
    archive : Archive
        Where sessions are stored.
    certificates : Certificates
        By which the service and it know each other.
    """

    def __init__(self, text: str, archive: Archive, certificates: Certificates) -> None:
        self.file = BenchFile.parse_toml(text, where="bench")
        self.name, self._text, self._archive = self.file.name, text, archive
        self._certificates, self._orders = certificates, Orders(archive, self.name)
        every = Bench(self.file)
        self._bench = every.part(every.instruments, required=())
        self._silent: dict[str, ReseauError] = {}
        self._lock = threading.RLock()
        self._wires: set[Wire] = set()
        self._commands: queue.Queue[tuple[Wire, dict[str, Any]]] = queue.Queue()
        self._held: contextlib.ExitStack | None = None
        self._error = "not connected yet"
        self._wanted = True
        self._control: Control | None = None
        self._session: dict[str, Any] = {}
        self._thread: threading.Thread | None = None
        self._question: str | None = None
        self._answered = threading.Event()
        self._moving = ""
        self._places: dict[str, Any] = {}
        self._live: tuple[dict[str, Any], bytes] = ({}, b"")
        self._looked = 0.0
        self._stops = 0
        self.over = threading.Event()

    # What is held.

    def _take(self) -> None:
        """Lock and connect the instruments, and stop whatever moves; some may be silent, but not all."""
        with self._lock:
            if self._held is not None:
                return
            stack = contextlib.ExitStack()
            try:
                stack.enter_context(self._bench.lock(owner(self.name)))
                stack.enter_context(self._bench)
                self._silent = dict(self._bench.silent)
                if self._silent and len(self._silent) == len(self._bench.instruments):
                    raise BenchError(list(self._silent.values()))
                # An earlier worker may have ended while something moved.
                self._answering.stop()
                for each in self._answering.instruments.values():
                    each.stage()
            except Exception as error:
                stack.close()
                known = _known(error, "bench")
                self._error = str(known)
                raise known from None
            self._held, self._error = stack, ""
            self._orders.interrupted()

    @property
    def _answering(self) -> Bench:
        """The bench without the instruments that are silent."""
        return self._bench.without(self._silent)

    def _reconnect(self) -> None:
        """Connect the instruments that were silent, where they answer now and no session runs."""
        for name in self._silent:
            instrument = self._bench[name]
            with contextlib.suppress(Exception):
                instrument.connect()  # it may take long, and nobody waits for it
                with self._lock:
                    if self._held is None:  # released meanwhile
                        instrument.close()
                    elif self._control is None and name in self._silent:
                        instrument.stop()
                        instrument.stage()
                        self._answer([name])
                        self._say("bench")

    def _answer(self, names: Iterable[str]) -> None:
        """Note that instruments answer that were silent."""
        self._silent = {name: error for name, error in self._silent.items() if name not in set(names)}

    def _release(self) -> None:
        with self._lock:
            if self._control is not None:
                raise StateError("a session runs", where=self.name, do="abort it first")
            if self._held is not None:
                self._held.close()
                self._held, self._error = None, "released"

    def _required(self) -> Bench:
        if self._held is None:
            raise StateError(self._error or "is not connected", where=self.name)
        return self._bench

    # What is reported.

    def _wrong(self) -> str:
        """What is wrong with the bench: why it is not held, or which instruments are silent."""
        return self._error or "; ".join(str(each) for each in self._silent.values())

    def status(self) -> dict[str, Any]:
        """Return the state of the bench, without asking an instrument."""
        session = dict(self._session)
        state = "ready" if self._held is not None else ("released" if not self._wanted else "down")
        if self._control is not None:
            state = session.get("state", "running")
        elif self._moving:
            state = "moving"
        if self._question is not None:
            state = "asking"
        return {
            "name": self.name, "state": state, "error": self._wrong(), "session": session or None,
            "question": self._question, "moving": self._moving, "pid": os.getpid(),
            "instruments": {name: entry.driver for name, entry in self.file.instruments.items()},
            "has_camera": self._bench.has(Camera), "has_table": self._bench.has(Turntable),
            "picture": self._live[0].get("number", 0),
        }  # fmt: skip

    def _say(self, kind: str, facts: dict[str, Any] | None = None) -> None:
        message = {"event": kind, "facts": facts or {}, "status": self.status()}
        for wire in list(self._wires):
            try:
                wire.send(message)
            except ReseauError:
                self._wires.discard(wire)

    # Commands.

    def _do(self, request: dict[str, Any]) -> tuple[Any, bytes]:
        """Carry out a command in its turn."""
        what, given = request.get("do"), request.get("given") or {}
        work: dict[Any, Callable[..., Any]] = {
            "take": self._taken, "release": self._released, "axes": self._axes, "move": self._move,
            "home": self._home, "configure": self._configure, "check": self._check, "begin": self._begin,
            "resume_session": self._resume_session,
        }  # fmt: skip
        if what not in work:
            raise UsageError("is no command", where=str(what))
        try:
            inspect.signature(work[what]).bind(**given)
        except TypeError as error:
            raise UsageError(f"has other arguments ({error})", where=str(what)) from None
        return work[what](**given), b""

    def _taken(self) -> dict[str, Any]:
        self._wanted = True
        self._take()
        self._say("bench")
        return self.status()

    def _released(self) -> dict[str, Any]:
        self._release()
        self._wanted = False
        self._say("bench")
        return self.status()

    def _table(self) -> Turntable:
        found: Turntable = self._required().one(Turntable)
        return found

    def _axes(self) -> dict[str, Any]:
        self._places = {
            name: {
                "position": axis.position, "unit": axis.unit, "limits": list(axis.limits),
                "homed": axis.homed, "moving": axis.moving,
            }
            for name, axis in by_hand.axes_of(self._table()).items()
        }  # fmt: skip
        return self._places

    def _free(self) -> None:
        if self._control is not None:
            raise StateError("a session runs", where=self.name, do="pause or abort it first")

    def _move(self, axis: str, position: float, relative: bool = False, by: str = "") -> dict[str, Any]:
        self._free()
        table = self._table()
        target = by_hand.targets(table, {axis: position}, relative=relative)[axis]
        words = f"{axis} to {target:g} {table.axes[axis].unit}"
        return self._moved(words, by, lambda: table.move(axis, target))

    def _home(self, axis: str, by: str = "") -> dict[str, Any]:
        self._free()
        table = self._table()
        by_hand.axis_of(table, axis)
        return self._moved(f"{axis} to its reference", by, lambda: table.home(axis))

    def _moved(self, words: str, by: str, work: Callable[[], Any]) -> dict[str, Any]:
        stops, self._moving = self._stops, f"{words}, by {by}" if by else words
        self._say("moving", {"what": self._moving})
        arrived = threading.Event()
        threading.Thread(target=self._follow, args=(arrived,), name="axes", daemon=True).start()
        try:
            for each in self._answering.instruments.values():
                each.stage()  # allows motion again after a stop
            if stops != self._stops:
                raise StateError("was stopped", where=words)
            work()
        finally:
            arrived.set()
            self._moving = ""
            self._say("rest")
        return self._axes()

    def _follow(self, arrived: threading.Event) -> None:
        """Tell where the axes are while they move."""
        with contextlib.suppress(Exception):  # whoever moves them gets the error
            while not arrived.wait(_FOLLOW_S):
                self._axes()
                self._say("axes")

    def _settings(self) -> dict[str, Any]:
        found = {}
        for name, each in self._required().instruments.items():
            settings, narrower = each.settings, self.file.instruments[name].limits
            rows = {}
            for key, value in settings.to_dict().items():
                limits = narrower.get(key, settings.limits.get(key))
                options = type(settings).__dataclass_fields__[key].metadata.get("options")
                rows[key] = {
                    "value": value, "unit": settings.units.get(key),
                    "limits": None if limits is None else list(limits),
                    "options": None if options is None else list(options),
                }  # fmt: skip
            found[name] = rows
        return found

    def _configure(self, instrument: str, changes: dict[str, Any]) -> dict[str, Any]:
        self._free()
        self._required()[instrument].configure(**changes)
        found: dict[str, Any] = self._settings()[instrument]
        return found

    def _check(self, seconds: float = 20.0) -> list[dict[str, Any]]:
        self._free()
        return [
            {
                "name": c.name, "driver": c.driver, "found": c.found,
                "error": None if c.error is None else str(c.error),
            }
            for c in self._required().check(seconds)
        ]  # fmt: skip

    def _begin(
        self, name: str, plan: str, parameters: dict[str, Any], inputs: dict[str, str], by: str = ""
    ) -> dict[str, Any]:
        self._free()
        given = self._checked(name, plan, parameters, inputs)
        with self._lock:
            self._prepare(given)
            session = conducting.begin(self._archive, name, plan, given, inputs, bench=self._text)
            return self._run(session, by)

    def _checked(self, name: str, plan: str, parameters: dict[str, Any], inputs: dict[str, str]) -> Any:
        """Parameters of a session on this bench, checked."""
        if plan == "own":
            raise UsageError("is a program of the user, which the service does not run", where="plan own")
        bench = self._required()
        parameters = kinds.kind_of(plan).parameters.defaults(bench) | parameters
        return conducting.check(name, plan, parameters, inputs, bench)

    def _resume_session(self, name: str, by: str = "") -> dict[str, Any]:
        self._free()
        bench = self._required()
        session = self._archive.session(name)
        if session.status == "done":
            raise UsageError("is done", where=name)
        if session.bench != self._text:
            raise UsageError("was begun on another bench", where=name)
        given = conducting.parameters_of(session)
        given.check_bench(bench)
        with self._lock:
            self._prepare(given)
            session.recover()
            return self._run(session, by)

    def _prepare(self, given: SessionParameters) -> None:
        """Check that the instruments of a session answer, and that its axes have their reference."""
        used = given.part_of(self._required())
        if used.instruments.keys() & self._silent.keys():
            used.connect()
            self._answer(used.instruments)
        if not given.home:
            given.check_homed(used)

    def _run(self, session: Any, by: str) -> dict[str, Any]:
        given = conducting.parameters_of(session)
        self._describe(session.name, session.plan, by, given.expected, dict(given.units))
        control = self._control = Control(lambda: self._set("paused"))
        self._thread = threading.Thread(target=self._carry_out, args=(session, control), name="session")
        self._thread.start()
        self._say("begin", {"session": session.name})
        return self.status()

    def _set(self, state: str) -> None:
        self._session["state"] = state
        self._say("session", {"state": state})

    def _carry_out(self, session: Any, control: Control) -> None:
        """Carry out a session in a thread of its own."""
        with self._reported(), self._archive_lock(session.name):
            conducting.capture(session, self._bench, watch=self._watched, operator=self._ask, control=control)
        self._control = None
        self._set(session.status)

    @contextlib.contextmanager
    def _reported(self) -> Iterator[None]:
        """Have what fails in the session, also by a defect, said, and the worker go on."""
        try:
            yield
        except Exception as error:
            self._session["why"] = str(_known(error, "session"))
        finally:
            self._question = None

    # The queue of the bench.

    def _take_order(self) -> None:
        """Begin the order whose turn it is, in a thread of its own."""
        with self._lock, contextlib.suppress(ReseauError):
            if self._held is None or self._control is not None or self._moving:
                return
            order = self._orders.next()
            order = None if order is None else self._orders.begin(order)
            if order is None:
                return
            self._control = Control(lambda: self._set("paused"))
            self._describe(order.session, order.given.get("plan", order.what), order.by, None, {})
            self._thread = threading.Thread(target=self._fulfil, args=(order, self._control), name="session")
            self._thread.start()

    def _fulfil(self, order: Order, control: Control) -> None:
        """Carry out an order, and note what became of it."""
        self._say("begin", {"session": order.session})
        try:
            outcome = (self._recalibrated if order.what == "recalibration" else self._acquired)(
                order, control
            )
            self._orders.end(order, outcome)
        except Exception as error:
            known = _known(error, order.session)
            if self._session["state"] == "ending":
                known = UsageError("was aborted", where=order.session)
            self._session["why"] = str(known)
            with contextlib.suppress(ReseauError):
                self._orders.fail(order, known)
        finally:
            self._question = self._control = None
            self._set("done" if not self._session.get("why") else "failed")

    def _recalibrated(self, order: Order, control: Control) -> str:
        """Carry out a recalibration; return the outcome."""
        from .recalibration import Recalibrations

        def watch(kind: str, facts: dict[str, Any]) -> None:
            if kind == "step":
                self._orders.note(order, facts["text"])
            self._watched(kind, facts)

        def capture(session: Any, bench: Bench, watch: Any) -> None:
            given = conducting.parameters_of(session)
            self._prepare(given)
            self._describe(session.name, session.plan, order.by, given.expected, dict(given.units))
            conducting.capture(session, bench, watch=watch, operator=self._ask, control=control)

        found = Recalibrations(self._archive).run(
            order.given["name"], order.session, by=order.by, watch=watch, bench=lambda file: self._bench,
            using=lambda bench, archive, session: self._archive_lock(session), capture=capture,
            wait=self._wait,
        )  # fmt: skip
        return f"{found.decision.outcome}: {found.decision.key}"

    def _wait(self, seconds: float) -> None:
        """Wait, unless the order is aborted, or the worker ends."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if self.over.wait(0.2) or self._session["state"] == "ending":
                raise StateError("was interrupted", where="warming up")

    def _acquired(self, order: Order, control: Control) -> str:
        """Carry out a session, or continue it; return its status."""
        given = order.given
        if any(each.name == order.session for each in self._archive.sessions()):
            session = self._archive.session(order.session)
            if session.status == "done" or ("inputs" in given and order.attempts == 1):
                raise UsageError(f"exists ({session.status})", where=f"session {order.session}")
            session.recover()
        else:
            checked = self._checked(order.session, given["plan"], given["parameters"], given["inputs"])
            self._prepare(checked)
            session = conducting.begin(
                self._archive, order.session, given["plan"], checked, given["inputs"], bench=self._text
            )
        made = conducting.parameters_of(session)
        self._describe(session.name, session.plan, order.by, made.expected, dict(made.units))
        with self._archive_lock(session.name):
            conducting.capture(session, self._bench, watch=self._watched, operator=self._ask, control=control)
        if session.status != "done":
            raise StateError(f"is {session.status}", where=f"session {session.name}", do="resume it")
        return session.status

    def _describe(self, name: str, plan: str, by: str, expected: int | None, units: dict[str, str]) -> None:
        """Describe the session that begins, as pages show it."""
        self._session = {
            "name": name, "plan": plan, "by": by, "state": "running", "good": 0, "expected": expected,
            "reached": {}, "predicted": {}, "step": "", "rejected": [], "units": units,
        }  # fmt: skip

    def schedule(self) -> None:
        """Put scheduled runs that are due into the queue, and note their outcome."""
        from .recalibration import Recalibrations
        from .schedule import Schedules

        known = Recalibrations(self._archive)
        while not self.over.wait(_SCHEDULE_S):
            if self._held is None:
                continue
            with contextlib.suppress(ReseauError):
                Schedules(self._archive).run_due(
                    partial(known.carry_out, over=self.over.wait),
                    only=lambda each: known.get(each.recalibration).bench == self._text,
                )

    def _archive_lock(self, name: str) -> Any:
        """The lock of the session itself; the instruments are locked already."""
        return Bench(BenchFile(name="none", instruments={})).lock(
            f"session {name}", f"{self._archive.place}: {name}"
        )

    def _watched(self, kind: str, facts: dict[str, Any]) -> None:
        mine = self._session
        if kind == "frame":
            mine["step"] = facts["step"]
            if facts["ok"]:
                mine["good"] += 1
            else:
                mine["rejected"] = [*mine["rejected"][-19:], f"{facts['step']}: {facts['why']}"]
        elif kind == "precision":
            mine["reached"] = {k: v for k, v in facts.items() if k != "step"}
        elif kind in ("outlook", "next"):
            mine["predicted"] = facts
        self._say(kind, {k: v for k, v in facts.items() if isinstance(v, str | int | float | bool | None)})

    def _ask(self, request: str) -> None:
        """Ask the person at the bench, and wait for the answer, or for the end."""
        self._answered.clear()
        self._question = request
        self._say("asking", {"question": request})
        while not self._answered.wait(0.2):
            if self._control is None or self.over.is_set():
                raise StateError("was not answered", where=request)
        self._question = None
        self._say("answered")

    # What is carried out at once, in the thread that reads it.

    def _at_once(self, request: dict[str, Any]) -> tuple[bool, Any, bytes]:
        """Carry out what must not wait; return whether it was that."""
        what, control = request.get("do"), self._control
        if what == "stop":
            self._stops += 1
            begun = time.perf_counter()
            while not self._commands.empty():  # what was to come is not done any more
                with contextlib.suppress(queue.Empty):
                    wire, waiting = self._commands.get_nowait()
                    error = to_error(StateError("was stopped", where=str(waiting.get("do"))))
                    wire.send({"id": waiting.get("id"), "error": error})
            if control is not None:
                threading.Thread(target=control.pause, kwargs={"at_once": True}, daemon=True).start()
            self._answering.stop()
            spent = time.perf_counter() - begun
            if self._moving:
                threading.Thread(target=self._insist, args=(self._stops,), daemon=True).start()
            self._say("stopped", {"ms": round(1e3 * spent, 1)})
            return True, {"ms": round(1e3 * spent, 1), **self.status()}, b""
        if what == "status":
            return True, self.status(), b""
        if what == "bench":
            return True, self._text, b""
        if what == "settings":
            return True, self._settings(), b""
        if what == "axes" and self._moving and self._places:
            return True, self._places, b""
        if what == "picture":
            self._looked = time.monotonic()
            return True, *self._live
        if what in ("pause", "continue", "abort", "answer"):
            if control is None:
                raise StateError("no session runs", where=self.name)
            if what == "pause":
                if self._session.get("state") == "running":
                    self._session["state"] = "pausing"
                    control.pause()
                    self._say("session", {"state": "pausing"})
            elif what == "continue":
                if self._session.get("state") != "paused":
                    raise StateError("is not paused", where=str(self._session.get("name")))
                self._set("running")
                control.decide("resume")
            elif what == "abort":
                self._session["state"] = "ending"
                self._answered.set()
                control.decide("abort")
            else:
                self._answered.set()
            return True, self.status(), b""
        if what == "end":
            if control is not None:
                raise StateError("a session runs", where=self.name)
            self.over.set()
            return True, {}, b""
        return False, None, b""

    # Threads.

    def _insist(self, stops: int) -> None:
        """Stop again until the movement under way has ended: it may have been about to begin."""
        end = time.monotonic() + _INSIST_S
        while self._moving and self._stops == stops and time.monotonic() < end:
            time.sleep(_INSIST_S / 100)
            with contextlib.suppress(ReseauError):
                self._answering.stop()

    def read(self, wire: Wire) -> None:
        """Serve one connection until it ends.

        What was asked for before a stop, and arrives after it, is not done.
        """
        self._wires.add(wire)
        stopped = -math.inf
        try:
            while True:
                request, _ = wire.receive()
                do, at = str(request.get("do")), request.get("at")
                try:
                    if do == "stop":
                        stopped = stopped if at is None else max(stopped, float(at))
                    elif at is not None and at < stopped and do not in _ASIDE:
                        raise StateError("was stopped", where=do)
                    done, value, body = self._at_once(request)
                    if done:
                        wire.send({"id": request.get("id"), "value": value}, body)
                    else:
                        self._commands.put((wire, request))
                except Exception as error:
                    known = _known(error, do)
                    wire.send({"id": request.get("id"), "error": to_error(known)})
        except ReseauError:
            pass
        finally:
            self._wires.discard(wire)
            wire.close()

    def work(self) -> None:
        """Carry out commands in their order, and keep the bench connected."""
        retry = looked = 0.0
        while not self.over.is_set():
            if time.monotonic() >= looked + _QUEUE_S:
                looked = time.monotonic()
                self._take_order()
            if self._held is None and self._wanted and time.monotonic() >= retry:
                retry = time.monotonic() + _RETRY_S
                with contextlib.suppress(ReseauError):
                    self._take()
                self._say("bench")
            try:
                wire, request = self._commands.get(timeout=0.2)
            except queue.Empty:
                continue
            try:
                value, body = self._do(request)
                message = {"id": request.get("id"), "value": value}
            except Exception as error:
                known = _known(error, str(request.get("do")))
                message, body = {"id": request.get("id"), "error": to_error(known)}, b""
            with contextlib.suppress(ReseauError):
                wire.send(message, body)

    def live(self) -> None:
        """Take pictures while somebody looks, and no session runs; in a session show its frames."""
        import cv2

        from ..report.overlay import preview

        number, shown, stops = 0, "", self._stops
        while not self.over.wait(_STEADY_S):
            if (
                time.monotonic() - self._looked > _LIVE_S
                or self._held is None
                or not self._answering.has(Camera)
            ):
                continue
            try:
                if self._control is not None:
                    step = self._session.get("step", "")
                    kept = self._archive.session(self._session["name"]) if step and step != shown else None
                    found = kept.frames(step, last=1) if kept is not None else []
                    if kept is None or not found:
                        continue
                    frame, shown = kept.picture(found[-1]), step
                else:
                    camera = self._bench.one(Camera)
                    if stops != self._stops:
                        stops = self._stops
                        camera.stage()  # a stop does not end the live picture: nothing moves
                    frame = camera.expose().frame
                edge = edge_sigma(frame)
                number += 1
                facts = {
                    "number": number, "width": frame.width, "height": frame.height,
                    "edge_px": None if edge == float("inf") else round(edge, 2),
                    "exposure": exposure_fault(frame, _limits()) or "good", "histogram": grey_counts(frame),
                    "at": datetime.now(UTC).isoformat(timespec="milliseconds"),
                    "points": self._points(frame),
                }  # fmt: skip
                _, coded = cv2.imencode(".jpg", preview(frame, _WIDTH), [cv2.IMWRITE_JPEG_QUALITY, 80])
                self._live = facts, coded.tobytes()
            except Exception as error:
                self._live = {"number": number, "error": str(_known(error, "live picture"))}, b""
                self.over.wait(1.0)

    def reconnect(self) -> None:
        """Connect again and again the instruments that were silent when the bench was taken."""
        while not self.over.wait(_RETRY_S):
            if self._held is not None and self._control is None:
                self._reconnect()

    def _points(self, frame: Any) -> list[list[float]]:
        """Targets found in a frame, where a session of this bench says which target there is."""
        measure = self._measurer()
        if measure is None:
            return []
        try:
            found = measure(frame)
        except ReseauError:
            return []
        points = getattr(found, "points", None)
        return [] if points is None else [[round(float(x), 1), round(float(y), 1)] for x, y in points.xy]

    def _measurer(self) -> Any:
        """What measures the target of the last session of this bench, or None."""
        from ..io import parse_design
        from ..procedures.target_measurement import measurer_of

        for each in reversed(self._archive.sessions(last=20)):
            session = self._archive.session(each.name)
            if session.bench == self._text and "design.json" in session.inputs():
                if getattr(self, "_design", None) != session.inputs()["design.json"].sha256:
                    self._design = session.inputs()["design.json"].sha256
                    self._measures = measurer_of(parse_design(session.input("design.json"), "design.json"))
                return self._measures
        return None

    def serve(self, address: tuple[str, int] = ("127.0.0.1", 0), place: Path | None = None) -> None:
        """Listen until the end; says in a file where, if one is given.

        Raises
        ------
        UsageError
            If the address cannot be used.
        """
        context = self._certificates.context("worker")
        family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        try:
            server = socket.create_server(address, family=family)
        except OSError as error:
            where = f"{address[0]}:{address[1]}"
            raise UsageError(f"cannot be used ({error.strerror})", where=where) from None
        with server:
            about = {"port": server.getsockname()[1], "pid": os.getpid(), "bench": self._text}
            if place is not None:
                private_file(place, json.dumps(about).encode())
            for each in (self.work, self.live, self.reconnect, self.schedule):
                threading.Thread(target=each, name=each.__name__, daemon=True).start()
            server.settimeout(0.3)
            heard = time.monotonic()
            while not self.over.is_set():
                try:
                    raw, _ = server.accept()
                except TimeoutError:
                    if self._wires or self._control is not None:
                        heard = time.monotonic()
                    if place is not None and not place.exists():
                        # A service that was about to start another worker has removed it.
                        private_file(place, json.dumps(about).encode())
                    if place is not None and time.monotonic() - heard > _ALONE_S:
                        self.over.set()  # started by a service, which would start another one
                    continue
                threading.Thread(target=self._welcome, args=(raw, context), daemon=True).start()
        if self._thread is not None:
            self._thread.join(60)
        with contextlib.suppress(ReseauError):
            self._answering.stop()
        if self._held is not None:
            self._held.close()
        if place is not None:
            place.unlink(missing_ok=True)

    def _welcome(self, raw: socket.socket, context: ssl.SSLContext) -> None:
        try:
            raw.settimeout(10)
            sock = context.wrap_socket(raw, server_side=True)
            checked_peer(sock, "service")
        except (OSError, ReseauError):
            raw.close()
            return
        self.read(Wire(sock))


def _known(error: Exception, where: str) -> ReseauError:
    """An error as one of ours: a defect of a driver is an answer, too, and ends no thread."""
    if isinstance(error, ReseauError):
        return error
    return InstrumentError(f"{type(error).__name__}: {error}", where=where)


def _limits() -> Any:
    from ..capture.checks import Limits

    return Limits()


def run(
    bench: Path, place: str, objects: str | None, folder: Path, address: tuple[str, int] | None = None
) -> None:
    """Hold the instruments of a bench until a signal, or the service, ends it.

    Parameters
    ----------
    bench : Path
        Bench file.
    place, objects : str
        The archive.
    folder : Path
        State folder of the service; with an address the folder with the certificates.
    address : (str, int), optional
        Where to listen for a service on another machine.

    Raises
    ------
    ReseauError
        If bench, archive, certificates or address cannot be used.
    """
    share_freed_memory()
    state = None if address is not None else StateFolder(folder)
    certificates = Certificates.in_folder(folder) if state is None else Certificates(state)
    text = read_text(bench)
    with contextlib.ExitStack() as stack:
        if state is not None:
            # A service that was killed may have started one that has not said so yet: that one stays.
            where = address_file(state, BenchFile.parse_toml(text, where=bench).name)
            stack.enter_context(BenchLock([str(where)], f"worker of {bench}"))
        archive = stack.enter_context(Archive.open(place, objects or None, create=True))
        worker = Worker(text, archive, certificates)
        keep_loaded()

        def end(*_: object) -> None:
            if worker._control is not None:
                worker._control.decide("stop")
            worker.over.set()

        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, end)
        if state is None:
            worker.serve(address or ("127.0.0.1", 0))
        else:
            worker.serve(place=address_file(state, worker.name))


def _main() -> None:
    bench, place, objects, state = sys.argv[1:5]
    try:
        run(Path(bench), place, objects or None, Path(state))
    except StateError as error:
        sys.exit(f"reseau: {error}")


if __name__ == "__main__":
    _main()
