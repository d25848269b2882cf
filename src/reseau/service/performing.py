"""Sessions on the instruments that a worker holds, one at a time: by command, or from the bench's queue."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

from ..archive import Archive
from ..capture import Bench, BenchFile
from ..capture.engine import Control
from ..core.errors import InstrumentError, ReseauError, StateError, UsageError
from ..sessions import conducting, kinds
from ..sessions.parameters import SessionParameters
from .orders import Order, Orders

_SCHEDULE_S = 5.0
"""Time between looks at the schedules."""
Watch = Callable[[str, dict[str, Any]], None]


class Holder(Protocol):
    """Who holds the instruments."""

    name: str
    text: str
    """Content of the bench file."""

    @property
    def idle(self) -> bool:
        """Whether the instruments are held, and none moves by command."""

    def required(self) -> Bench:
        """Return the bench; raises StateError if it is not held."""

    def prepare(self, given: SessionParameters) -> None:
        """Check that the instruments of a session answer, and that its axes have their reference."""


def known_error(error: Exception, where: str) -> ReseauError:
    """Return an error as one of ours: a defect of a driver is an answer, too, and ends no thread.

    Examples
    --------
    >>> str(known_error(KeyError("x"), "scope"))
    "scope: KeyError: 'x'"
    """
    if isinstance(error, ReseauError):
        return error
    return InstrumentError(f"{type(error).__name__}: {error}", where=where)


class Performer:
    """What carries out sessions.

    Parameters
    ----------
    archive : Archive
        Where sessions are stored.
    orders : Orders
        The queue of the bench.
    holder : Holder
        Who holds the instruments.
    say : callable
        Tells those who look what happens.
    over : Event
        Set when the worker ends.

    Attributes
    ----------
    control : Control or None
        Of the session that runs.
    facts : dict
        The last session, as pages show it.
    question : str or None
        What a person at the bench is asked.
    """

    def __init__(
        self, archive: Archive, orders: Orders, holder: Holder, say: Watch, over: threading.Event
    ) -> None:
        self._archive, self._orders, self._holder, self._say, self._over = archive, orders, holder, say, over
        self.control: Control | None = None
        self.facts: dict[str, Any] = {}
        self.question: str | None = None
        self._answered = threading.Event()
        self._thread: threading.Thread | None = None

    def made(self, name: str, plan: str, parameters: dict[str, Any], inputs: dict[str, str]) -> Any:
        """Check a session and the instruments that it needs, and begin it in the archive."""
        if plan == "own":
            raise UsageError("is a program of the user, which the service does not run", where="plan own")
        bench = self._holder.required()
        parameters = kinds.kind_of(plan).parameters.defaults(bench) | parameters
        given = conducting.check(name, plan, parameters, inputs, bench)
        self._holder.prepare(given)
        return conducting.begin(self._archive, name, plan, given, inputs, bench=self._holder.text)

    def start(self, session: Any, by: str) -> None:
        """Carry out a session in a thread of its own."""
        self._describe(session, by)
        self._begin(session.name, partial(self._locked, session), lambda error: None, lambda: session.status)

    def take_order(self) -> None:
        """Begin the order whose turn it is."""
        with contextlib.suppress(ReseauError):
            if self.control is not None or not self._holder.idle:
                return
            order = self._orders.next()
            order = None if order is None else self._orders.begin(order)
            if order is not None:
                self._show(order.session, order.given.get("plan", order.what), order.by, None, {})
                self._begin(
                    order.session, partial(self._fulfil, order), partial(self._orders.fail, order),
                    lambda: "failed" if self.facts.get("why") else "done",
                )  # fmt: skip

    def _begin(
        self,
        name: str,
        work: Callable[[Control], object],
        failed: Callable[[ReseauError], object],
        became: Callable[[], str],
    ) -> None:
        """Do work in a thread; what fails in it, also by a defect, is said, and the worker goes on."""
        control = self.control = Control(lambda: self.set("paused"))

        def whole() -> None:
            try:
                work(control)
            except Exception as error:
                known = known_error(error, name)
                if self.facts["state"] == "ending":
                    known = UsageError("was aborted", where=name)
                self.facts["why"] = str(known)
                with contextlib.suppress(ReseauError):
                    failed(known)
            finally:
                self.question = self.control = None
                self.set(became())

        self._thread = threading.Thread(target=whole, name="session")
        self._thread.start()
        self._say("begin", {"session": name})

    def _locked(self, session: Any, control: Control) -> None:
        """Capture a session, which no other process may."""
        with self._lock(session.name):
            self._capture(session, control, self._watched)

    def _capture(self, session: Any, control: Control, watch: Watch) -> None:
        bench = self._holder.required()
        conducting.capture(session, bench, watch=watch, operator=self._ask, control=control)

    def _lock(self, name: str) -> Any:
        """The lock of the session itself; the instruments are locked already."""
        return Bench(BenchFile(name="none", instruments={})).lock(
            f"session {name}", f"{self._archive.place}: {name}"
        )

    def _fulfil(self, order: Order, control: Control) -> None:
        """Carry out an order, and note what became of it."""
        work = self._recalibrated if order.what == "recalibration" else self._acquired
        self._orders.end(order, work(order, control))

    def _recalibrated(self, order: Order, control: Control) -> str:
        """Carry out a recalibration; return the outcome."""
        from .recalibration import Recalibrations

        def watch(kind: str, facts: dict[str, Any]) -> None:
            if kind == "step":
                self._orders.note(order, facts["text"])
            self._watched(kind, facts)

        def capture(session: Any, bench: Bench, watch: Any) -> None:
            self._holder.prepare(conducting.parameters_of(session))
            self._describe(session, order.by)
            self._capture(session, control, watch)

        found = Recalibrations(self._archive).run(
            order.given["name"], order.session, by=order.by, watch=watch,
            bench=lambda file: self._holder.required(),
            using=lambda bench, archive, session: self._lock(session), capture=capture, wait=self._wait,
        )  # fmt: skip
        return f"{found.outcome}: {found.key}"

    def _acquired(self, order: Order, control: Control) -> str:
        """Carry out a session, or continue it; return its status."""
        given = order.given
        if any(each.name == order.session for each in self._archive.sessions()):
            session = self._archive.session(order.session)
            if session.status == "done" or ("inputs" in given and order.attempts == 1):
                raise UsageError(f"exists ({session.status})", where=f"session {order.session}")
            session.recover()
        else:
            session = self.made(order.session, given["plan"], given["parameters"], given["inputs"])
        self._describe(session, order.by)
        self._locked(session, control)
        if session.status != "done":
            raise StateError(f"is {session.status}", where=f"session {session.name}", do="resume it")
        return "done"

    def _wait(self, seconds: float) -> None:
        """Wait, unless the order is aborted, or the worker ends."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if self._over.wait(0.2) or self.facts["state"] == "ending":
                raise StateError("was interrupted", where="warming up")

    def _describe(self, session: Any, by: str) -> None:
        made = conducting.parameters_of(session)
        self._show(session.name, session.plan, by, made.expected, dict(made.units))

    def _show(self, name: str, plan: str, by: str, expected: int | None, units: dict[str, str]) -> None:
        """Describe the session that begins, as pages show it."""
        self.facts = {
            "name": name, "plan": plan, "by": by, "state": "running", "good": 0, "expected": expected,
            "reached": {}, "predicted": {}, "step": "", "rejected": [], "units": units,
        }  # fmt: skip

    def schedule(self) -> None:
        """Put scheduled runs that are due into the queue, and note their outcome, until the end."""
        from .recalibration import Recalibrations
        from .schedule import Schedules

        known = Recalibrations(self._archive)
        while not self._over.wait(_SCHEDULE_S):
            with contextlib.suppress(ReseauError):
                self._holder.required()
                Schedules(self._archive).run_due(
                    partial(known.carry_out, over=self._over.wait),
                    only=lambda each: known.get(each.recalibration).bench == self._holder.text,
                )

    def set(self, state: str) -> None:
        """Note and say the state of the session."""
        self.facts["state"] = state
        self._say("session", {"state": state})

    def tell(self, what: str) -> None:
        """Pause, continue or abort the session that runs, or answer its question.

        Raises
        ------
        StateError
            If none runs, or it is not paused.
        """
        if (control := self.control) is None:
            raise StateError("no session runs", where=self._holder.name)
        if what == "pause":
            if self.facts.get("state") == "running":
                self.facts["state"] = "pausing"
                control.pause()
                self._say("session", {"state": "pausing"})
        elif what == "continue":
            if self.facts.get("state") != "paused":
                raise StateError("is not paused", where=str(self.facts.get("name")))
            self.set("running")
            control.decide("resume")
        elif what == "abort":
            self.facts["state"] = "ending"
            self._answered.set()
            control.decide("abort")
        else:
            self._answered.set()

    def join(self, seconds: float) -> None:
        """Wait for the end of the session that runs."""
        if self._thread is not None:
            self._thread.join(seconds)

    def _watched(self, kind: str, facts: dict[str, Any]) -> None:
        mine = self.facts
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
        self.question = request
        self._say("asking", {"question": request})
        while not self._answered.wait(0.2):
            if self.control is None or self._over.is_set():
                raise StateError("was not answered", where=request)
        self.question = None
        self._say("answered", {})
