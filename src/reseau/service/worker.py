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
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ..archive import Archive
from ..capture import Bench, BenchFile, BenchLock, by_hand
from ..capture.checks import edge_sigma, exposure_fault, grey_counts
from ..core.errors import BenchError, ReseauError, StateError, UsageError
from ..core.memory import keep_loaded, share_freed_memory
from ..instruments import Camera, Turntable
from ..io import read_text
from ..sessions import conducting
from ..sessions.parameters import SessionParameters
from .orders import Orders, owner
from .performing import Performer, known_error
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
        self.name, self.text, self._archive = self.file.name, text, archive
        self._certificates, self._orders = certificates, Orders(archive, self.name)
        every = Bench(self.file)
        self._bench = every.part(every.instruments, required=())
        self._silent: dict[str, ReseauError] = {}
        self._lock, self._saying = threading.RLock(), threading.Lock()
        self._wires: set[Wire] = set()
        self._commands: queue.Queue[tuple[Wire, dict[str, Any]]] = queue.Queue()
        self._held: contextlib.ExitStack | None = None
        self._error = "not connected yet"
        self._wanted = True
        self._moving = ""
        self._places: dict[str, Any] = {}
        self._live: tuple[dict[str, Any], bytes] = ({}, b"")
        self._looked = 0.0
        self._stops = 0
        self.over = threading.Event()
        self._sessions = Performer(archive, self._orders, self, self._say, self.over)

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
                known = known_error(error, "bench")
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
                    elif self._sessions.control is None and name in self._silent:
                        instrument.stop()
                        instrument.stage()
                        self._answer([name])
                        self._say("bench")

    def _answer(self, names: Iterable[str]) -> None:
        """Note that instruments answer that were silent."""
        self._silent = {name: error for name, error in self._silent.items() if name not in set(names)}

    def _release(self) -> None:
        with self._lock:
            if self._sessions.control is not None:
                raise StateError("a session runs", where=self.name, do="abort it first")
            if self._held is not None:
                self._held.close()
                self._held, self._error = None, "released"

    def required(self) -> Bench:
        """Return the bench, if it is held."""
        if self._held is None:
            raise StateError(self._error or "is not connected", where=self.name)
        return self._bench

    @property
    def idle(self) -> bool:
        """Whether it is held, and nothing moves by command."""
        return self._held is not None and not self._moving

    # What is reported.

    def _wrong(self) -> str:
        """What is wrong with the bench: why it is not held, or which instruments are silent."""
        return self._error or "; ".join(str(each) for each in self._silent.values())

    def status(self) -> dict[str, Any]:
        """Return the state of the bench, without asking an instrument."""
        session = dict(self._sessions.facts)
        state = "ready" if self._held is not None else ("released" if not self._wanted else "down")
        if self._sessions.control is not None:
            state = session.get("state", "running")
        elif self._moving:
            state = "moving"
        if self._sessions.question is not None:
            state = "asking"
        return {
            "name": self.name, "state": state, "error": self._wrong(), "session": session or None,
            "question": self._sessions.question, "moving": self._moving, "pid": os.getpid(),
            "instruments": {name: entry.driver for name, entry in self.file.instruments.items()},
            "has_camera": self._bench.has(Camera), "has_table": self._bench.has(Turntable),
            "picture": self._live[0].get("number", 0),
        }  # fmt: skip

    def _say(self, kind: str, facts: dict[str, Any] | None = None) -> None:
        """Tell services what happened, and the state: no older one is sent after a newer one."""
        with self._saying:
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
        found: Turntable = self.required().one(Turntable)
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
        if self._sessions.control is not None:
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
        for name, each in self.required().instruments.items():
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
        self.required()[instrument].configure(**changes)
        found: dict[str, Any] = self._settings()[instrument]
        return found

    def _check(self, seconds: float = 20.0) -> list[dict[str, Any]]:
        self._free()
        return [
            {
                "name": c.name, "driver": c.driver, "found": c.found,
                "error": None if c.error is None else str(c.error),
            }
            for c in self.required().check(seconds)
        ]  # fmt: skip

    def _begin(
        self, name: str, plan: str, parameters: dict[str, Any], inputs: dict[str, str], by: str = ""
    ) -> dict[str, Any]:
        self._free()
        with self._lock:
            self._sessions.start(self._sessions.made(name, plan, parameters, inputs), by)
            return self.status()

    def _resume_session(self, name: str, by: str = "") -> dict[str, Any]:
        self._free()
        bench = self.required()
        session = self._archive.session(name)
        if session.status == "done":
            raise UsageError("is done", where=name)
        if session.bench != self.text:
            raise UsageError("was begun on another bench", where=name)
        given = conducting.parameters_of(session)
        given.check_bench(bench)
        with self._lock:
            self.prepare(given)
            session.recover()
            self._sessions.start(session, by)
            return self.status()

    def prepare(self, given: SessionParameters) -> None:
        """Check that the instruments of a session answer, and that its axes have their reference."""
        used = given.part_of(self.required())
        if used.instruments.keys() & self._silent.keys():
            used.connect()
            self._answer(used.instruments)
        if not given.home:
            given.check_homed(used)

    # What is carried out at once, in the thread that reads it.

    def _at_once(self, request: dict[str, Any]) -> tuple[bool, Any, bytes]:
        """Carry out what must not wait; return whether it was that."""
        what, control = request.get("do"), self._sessions.control
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
            return True, {"ms": round(1e3 * spent, 1)}, b""
        if what == "status":  # as an event among the others: none that is older follows it
            self._say("status")
            return True, {}, b""
        asked = {"bench": lambda: self.text, "settings": self._settings}.get(str(what))
        if asked is not None:
            return True, asked(), b""
        if what == "axes" and self._moving and self._places:
            return True, self._places, b""
        if what == "picture":
            self._looked = time.monotonic()
            return True, *self._live
        if what in ("pause", "continue", "abort", "answer"):
            self._sessions.tell(what)
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
                    known = known_error(error, do)
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
                with self._lock:
                    self._sessions.take_order()
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
                known = known_error(error, str(request.get("do")))
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
                if self._sessions.control is not None:
                    step = self._sessions.facts.get("step", "")
                    kept = (
                        self._archive.session(self._sessions.facts["name"])
                        if step and step != shown
                        else None
                    )
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
                self._live = {"number": number, "error": str(known_error(error, "live picture"))}, b""
                self.over.wait(1.0)

    def reconnect(self) -> None:
        """Connect again and again the instruments that were silent when the bench was taken."""
        while not self.over.wait(_RETRY_S):
            if self._held is not None and self._sessions.control is None:
                self._reconnect()

    def _points(self, frame: Any) -> list[list[float]] | None:
        """Targets found in a frame; None unless a session of this bench says which target there is."""
        measure = self._measurer()
        if measure is None:
            return None
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
            if session.bench == self.text and "design.json" in session.inputs():
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
            about = {"port": server.getsockname()[1], "pid": os.getpid(), "bench": self.text}
            if place is not None:
                private_file(place, json.dumps(about).encode())
            for each in (self.work, self.live, self.reconnect, self._sessions.schedule):
                threading.Thread(target=each, name=each.__name__, daemon=True).start()
            server.settimeout(0.3)
            heard = time.monotonic()
            while not self.over.is_set():
                try:
                    raw, _ = server.accept()
                except TimeoutError:
                    if self._wires or self._sessions.control is not None:
                        heard = time.monotonic()
                    if place is not None and not place.exists():
                        # A service that was about to start another worker has removed it.
                        private_file(place, json.dumps(about).encode())
                    if place is not None and time.monotonic() - heard > _ALONE_S:
                        self.over.set()  # started by a service, which would start another one
                    continue
                threading.Thread(target=self._welcome, args=(raw, context), daemon=True).start()
        self._sessions.join(60)
        with contextlib.suppress(ReseauError):
            self._answering.stop()
        if self._held is not None:
            self._held.close()
        if place is not None:
            place.unlink(missing_ok=True)

    def end(self) -> None:
        """End, and interrupt the session that runs."""
        if self._sessions.control is not None:
            self._sessions.control.decide("stop")
        self.over.set()

    def _welcome(self, raw: socket.socket, context: ssl.SSLContext) -> None:
        try:
            raw.settimeout(10)
            sock = context.wrap_socket(raw, server_side=True)
            checked_peer(sock, "service")
        except (OSError, ReseauError):
            raw.close()
            return
        self.read(Wire(sock))


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
            worker.end()

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
