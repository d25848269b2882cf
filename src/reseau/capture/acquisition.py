"""An acquisition: a session on a bench. Every picture is in the archive before the next action starts.

Plans are bluesky plans: generators of messages. Some messages are defined here, `expose`, `series`, `picture`
and `ask` among them. Each picture is stored under the name of its step, and a step that already has its
picture does not take it again. A message that is replayed after a pause, or a plan that starts again after a
crash, therefore finds the pictures that exist.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from bluesky import Msg
from bluesky import plan_stubs as bps

from ..archive import Session
from ..archive.records import ArchivedFrame
from ..core.data import Frame
from ..core.errors import (
    ConnectionLost,
    DeadlineError,
    InstrumentError,
    ProtocolError,
    ReseauError,
    StateError,
    UsageError,
)
from ..core.numbers import or_null
from ..instruments import (
    Camera,
    CameraRig,
    EnvironmentSensor,
    Exposure,
    Oscilloscope,
    Turntable,
    UltrasonicScanner,
)
from . import by_hand
from .bench import ROLES, Bench
from .checks import Limits, Readiness, readiness
from .judging import Judge, Procedure, Watch
from .steps import Step

T = TypeVar("T")
_TRIES = 4
"""Attempts on an instrument before its failure ends the session."""
_STILL = 0.02
"""Largest movement of an axis during an exposure, in the unit of the axis."""

Plan = Generator[Msg, Any, Any]
"""A plan: a generator of bluesky messages. Its return value is that of :func:`reseau.capture.carry_out`."""


def message(command: str, *args: Any, **kwargs: Any) -> Msg:
    """Return a message of a plan."""
    return Msg(command, *args, **kwargs)  # type: ignore[no-untyped-call]


class Acquisition:
    """A session on a bench, with the messages that plans use.

    Parameters
    ----------
    bench : Bench
        Connected or not.
    session : Session
        The session of the archive that stores the pictures.
    procedure : Procedure, optional
        Measures the frames. Without one, frames are only checked for saturation and motion.
    camera, table, oscilloscope, scanner : str, optional
        Names of instruments on the bench. Default: the only instrument of that kind. The camera may be a
        rig: what its cameras expose at once is stored at once, each frame under ``camera/step``.
    retakes : int
        Number of additional attempts after a bad frame.
    limits : Limits, optional
        Limits for exposure, focus and vibration.
    watch : callable, optional
        Called with each event: its kind and its values.
    operator : callable, optional
        Called with a request that no instrument can carry out; returns when it is done.

    Notes
    -----
    The first group of methods returns plans (generators of messages). The second group does the work behind
    each message, in a thread of the engine: an operation that fails for a passing reason is repeated, and its
    outcome is stored before it returns.

    Examples
    --------
    A bench without instruments; a plan that asks the operator and then ends:

    >>> import tempfile
    >>> from reseau.archive import Archive
    >>> from reseau.capture import Bench, BenchFile, Step, carry_out
    >>> bench, asked = Bench(BenchFile(name="empty", instruments={})), []
    >>> def plan(run):
    ...     yield from run.ask("switch the light on", Step("first"))
    ...     return "ready"
    >>> with tempfile.TemporaryDirectory() as folder, Archive.open(folder, create=True) as archive:
    ...     run = Acquisition(bench, archive.begin("monday", "own", {}), operator=asked.append)
    ...     carry_out(run, plan(run)), asked
    ('ready', ['switch the light on'])
    """

    name = "acquisition"
    parent = None

    def __init__(
        self,
        bench: Bench,
        session: Session,
        procedure: Procedure | None = None,
        *,
        camera: str | None = None,
        table: str | None = None,
        oscilloscope: str | None = None,
        scanner: str | None = None,
        retakes: int = 2,
        limits: Limits | None = None,
        watch: Watch = lambda kind, facts: None,
        operator: Callable[[str], None] | None = None,
    ) -> None:
        self.bench, self.session, self.procedure = bench, session, procedure
        names = {"camera": camera, "table": table, "oscilloscope": oscilloscope, "scanner": scanner}
        self._chosen: dict[type, str | None] = {ROLES[role]: name for role, name in names.items()}
        self.retakes, self.limits, self.watch, self._operator = retakes, limits or Limits(), watch, operator
        self._busy = threading.Lock()
        self._judge = Judge(session, procedure, self.limits, watch)
        self._last: ArchivedFrame | None = None
        self._at_rest = False
        self.doing = ""
        """What is under way, in words."""
        self._silent: frozenset[str] = frozenset()
        self._original_us: float | None = None

    def one(self, kind: type) -> Any:
        """Return the instrument of a kind: the named one, or the only one. See :meth:`Bench.one`."""
        found = self.bench.one(kind, self._chosen.get(kind))
        self._silent -= {found.name}  # a plan that uses it tries again
        return found

    def has(self, kind: type) -> bool:
        """Return whether the bench has an instrument of a kind."""
        return self.bench.has(kind)

    def reached(self, parameter: str) -> float | None:
        """Return the standard deviation reached for a parameter; None while there is none."""
        return self._judge.progress().get(f"sigma_{parameter}")

    def scatter(self) -> float:
        """Return the ratio of the standard deviations to the formal ones; 1 if not known."""
        return self._judge.progress().get("scatter", 1.0)

    def done(self, step: Step) -> bool:
        """Return whether a step has a good frame, or as many bad ones as are allowed."""
        rig = self._rig
        names = [step.name] if rig is None else [f"{camera}/{step.name}" for camera in rig.cameras]
        frames = [frame for name in names for frame in self.session.frames(name, "frame")]
        return any(_good(each) for each in frames) or len(frames) > self.retakes * len(names)

    # Messages for plans.

    def at(self, step: Step, average: int = 1) -> Plan:
        """Go to a pose and take its frame, again if it is bad. Do nothing if the step is done.

        Returns
        -------
        ArchivedFrame
            The last frame taken at the pose, with its verdict.
        """
        yield from bps.checkpoint()
        if not self.done(step):
            yield from self.move(step.position)
        frame = yield message("expose", self, step, average=average)
        yield from self._record()
        return frame

    def series(self, steps: Sequence[Step]) -> Plan:
        """Take frames of one scene at the rate of the camera, one for each step; skip existing ones."""
        yield from bps.checkpoint()
        yield message("series", self, steps)
        yield from self._record()

    def _record(self) -> Plan:
        """Have the engine emit an event for the last frame."""
        yield from bps.create("primary")
        yield from bps.read(self)
        yield from bps.save()

    def restore_exposure(self) -> Plan:
        """Set the camera back to the exposure that it had before any step changed it."""
        yield message("set_back", self)

    def move(self, position: Mapping[str, float]) -> Plan:
        """Move axes of the table, all at the same time."""
        if position:
            for axis in position:
                by_hand.axis_of(self.one(Turntable), axis)
            yield message("move", self, dict(position))

    def home(self) -> Plan:
        """Find the reference of each axis of the table that has none. The controller chooses the path."""
        yield message("home", self)

    def pictures(self, step: Step, kind: str) -> Plan:
        """Take and store a picture that is not measured.

        Parameters
        ----------
        step : Step
            The step that the picture belongs to.
        kind : {"scan", "screen", "probe"}
            A section of the scanner, the screenshot of the oscilloscope, or a frame of the camera.

        Returns
        -------
        ArchivedFrame or None
            None for a screenshot if the bench has no oscilloscope.
        """
        if kind != "screen" or self.has(Oscilloscope):
            return (yield message("picture", self, step, kind))
        return None

    def ask(self, request: str, step: Step) -> Plan:
        """Ask the operator to do something before a step, unless the step is done."""
        if not self.done(step):
            yield message("ask", self, request)

    def check(self, count: int = 5) -> Plan:
        """Take frames of the static scene and check exposure, focus, vibration and drift.

        Returns
        -------
        Readiness
            Falsy, with the reasons, if a limit is exceeded.
        """
        return (yield message("check", self, count))

    def choose(self, candidates: Sequence[Step], wanted: str) -> Plan:
        """Ask the procedure for the pose that lowers a standard deviation most.

        Returns
        -------
        (Step, float) or None
            The pose and its predicted standard deviation.
        """
        return (yield message("choose", self, candidates, wanted))

    def predict(self, step: Step) -> Plan:
        """Report the standard deviation expected after the next pose, if it can be predicted."""
        if self.procedure is not None and not self.done(step):
            yield message("outlook", self, step)

    @property
    def commands(self) -> dict[str, Callable[[Msg], Any]]:
        """The messages above, for ``RunEngine.register_command``."""
        work: dict[str, Callable[..., Any]] = {
            "expose": self.expose,
            "series": self.expose_series,
            "set_back": self.reset_exposure,
            "move": self.move_axes,
            "home": self.home_axes,
            "picture": self.take_picture,
            "ask": self.ask_operator,
            "check": self.check_scene,
            "choose": self.choose_pose,
            "outlook": self.report_prediction,
        }

        def registered(do: Callable[..., Any]) -> Callable[[Msg], Any]:
            async def command(msg: Msg) -> Any:
                return await asyncio.get_running_loop().run_in_executor(
                    None, lambda: do(*msg.args, **msg.kwargs)
                )

            return command

        return {name: registered(do) for name, do in work.items()}

    # Interface of a bluesky object that is read and paused.

    def read(self) -> dict[str, Any]:
        """Return the last frame: step, take, SHA-256 and verdict."""
        last = self._last
        if last is None or last.verdict is None:
            raise StateError("no frame has been taken", where=self.name)
        verdict = last.verdict
        values = {
            "step": last.step,
            "take": last.take,
            "frame": last.sha256,
            "ok": verdict.ok,
            "why": verdict.why,
        }
        return {name: {"value": value, "timestamp": 0.0} for name, value in values.items()}

    def describe(self) -> dict[str, Any]:
        """Return the data types of a reading."""
        kinds = {"step": "string", "take": "integer", "frame": "string", "ok": "boolean", "why": "string"}
        return {name: {"source": self.name, "dtype": kind, "shape": []} for name, kind in kinds.items()}

    def read_configuration(self) -> dict[str, Any]:
        """Return nothing: instruments record their own configuration."""
        return {}

    def describe_configuration(self) -> dict[str, Any]:
        """Return nothing."""
        return {}

    def pause(self) -> None:
        """Stop the bench; the engine calls this before it pauses."""
        self.rest()

    def resume(self) -> None:
        """Make the bench ready again; the engine calls this before it resumes."""
        self.ready()

    # State of the bench.

    def ready(self) -> None:
        """Connect all instruments and allow motion and transmission again.

        Raises
        ------
        InstrumentError
            If one cannot be connected that the bench requires.
        """
        self._at_rest = False
        for name, instrument in self.bench.instruments.items():
            if name in self.bench.required:
                self._persist(instrument.stage)
                continue
            try:
                instrument.stage()
            except InstrumentError as error:
                self._silent |= {name}
                self.watch("without", {"instrument": name, "why": str(error)})

    def rest(self, *, over: bool = False) -> None:
        """Stop all motion and transmission. Never raises, never moves an axis.

        Nothing moves then until the bench is made ready again; if the run is `over`, instruments can be used
        by hand.
        """
        self._at_rest = True
        bench = self.bench.without(self._silent)
        try:
            (bench.unstage if over else bench.stop)()
        except InstrumentError as error:
            self.watch("rest", {"failed": str(error)})

    def retreat(self, position: Mapping[str, float]) -> None:
        """Move the table away after it has stopped; if that fails, report it and leave the table there."""
        try:
            self.ready()
            self.move_axes(position)
        except ReseauError as error:
            self.watch("rest", {"failed": str(error)})
        finally:
            self.rest(over=True)

    def settle(self) -> None:
        """Wait until an interrupted message has finished; its picture is stored and checked."""
        with self._busy:
            pass

    # The work behind each message, in a thread of the engine.

    def expose(self, step: Step, average: int = 1) -> ArchivedFrame:
        """Take the frame of a step, again while it is bad; return the existing one if there is one.

        Raises
        ------
        InstrumentError
            If the camera or the table fails repeatedly.
        ArchiveError
            If the frame cannot be stored.
        """
        # An engine that was paused during this call replays the message while the thread still works:
        # it waits here and then finds the frame.
        with self._busy:
            return self._exposed(step, average)

    def expose_series(self, steps: Sequence[Step]) -> list[ArchivedFrame]:
        """Take frames of one scene as the camera delivers them, one for each step. See :meth:`expose`."""
        source = _stream(self.one(Camera), len(steps))
        with self._busy:
            return [self._exposed(step, 1, source) for step in steps]

    @property
    def _rig(self) -> CameraRig | None:
        """The rig, if the camera of the session is one."""
        name = self._chosen[Camera]
        found = None if name is None else self.bench[name]
        return found if isinstance(found, CameraRig) else None

    def _exposed(
        self, step: Step, average: int, source: Callable[[], Exposure] | None = None
    ) -> ArchivedFrame:
        self.doing = f"the frame of {step.name}"
        rig = self._rig
        if rig is not None:
            return self._exposed_at_once(rig, step, average)
        for take in range(self.retakes + 1):
            there = self.session.find(step.name, "frame", take)
            frame = self._judge.judge(there or self._taken(step, take, average, source), step)
            self._last = frame
            if _good(frame):
                break
        return frame

    def _exposed_at_once(self, rig: CameraRig, step: Step, average: int) -> ArchivedFrame:
        """Take frames with all cameras, again while none is good; return the first good one, or the last."""
        if step.exposure_us is not None:
            raise UsageError("has exposures of its own: use one camera", where=step.name)
        for take in range(self.retakes + 1):
            there = [self.session.find(f"{camera}/{step.name}", "frame", take) for camera in rig.cameras]
            frames = [frame for frame in there if frame is not None] or self._taken_at_once(
                rig, step, take, average
            )
            new = any(frame.verdict is None for frame in frames)
            frames = [self._judge.judge(frame, Step(frame.step, step.position)) for frame in frames]
            good = [frame for frame in frames if _good(frame)]
            self._last = good[0] if good else frames[-1]
            if good and new:
                self._judge.report_precision(step)
            if good:
                return good[0]
        return frames[-1]

    def _taken_at_once(self, rig: CameraRig, step: Step, take: int, average: int) -> list[ArchivedFrame]:
        if self._at_rest:
            raise StateError("the bench was stopped", where=step.name)
        before = self._position()
        sets = [self._persist(rig.expose_all) for _ in range(average)]
        moved = self._moved(before)
        skews = [each.skew for each in sets]
        late = [skew - within > rig.largest_skew_s for skew, within in skews]
        around = self._environment()
        frames, facts, clock = {}, {}, {}
        for camera in rig.cameras:
            exposures = [each.exposures[camera] for each in sets]
            frames[camera] = _mean_frame([each.frame for each in exposures], f"{camera}/{step.name}")
            facts[camera] = _facts(camera, exposures, before, moved) | {"late": any(late)} | around
            clock[camera] = _clock(exposures) | {
                "skew_s": [skew for skew, _ in skews], "skew_within_s": [within for _, within in skews]
            }  # fmt: skip
        return self.session.store_set(step.name, frames, take=take, facts=facts, clock=clock)

    def _moved(self, before: Mapping[str, float]) -> bool:
        """Whether the table has moved since its axes had these positions."""
        moved = {axis: abs(value - before[axis]) for axis, value in self._position().items()}
        return max(moved.values(), default=0.0) > _STILL

    def move_axes(self, position: Mapping[str, float]) -> None:
        """Move axes of the table, all at the same time, and wait.

        Raises
        ------
        InstrumentError
            If an axis does not arrive.
        """
        table: Turntable = self.one(Turntable)
        self.doing = f"the move to {' '.join(f'{axis} {value:g}' for axis, value in position.items())}"
        self._persist(lambda: by_hand.move(table, position))

    def home_axes(self) -> None:
        """Find the reference of each axis that has none, one axis after the other."""
        table: Turntable = self.one(Turntable)
        for axis in table.axes:
            if not self._persist(lambda axis=axis: table.state(axis)).homed:  # type: ignore[misc]
                self.doing = f"the reference of {axis}"
                self.watch("home", {"axis": axis})
                self._persist(lambda axis=axis: table.home(axis))  # type: ignore[misc]

    def _persist(self, work: Callable[[], T]) -> T:
        """Return the outcome of a repeatable operation; repeat it after a passing failure and report that."""
        for attempt in range(_TRIES):
            try:
                return work()
            except (ConnectionLost, DeadlineError, ProtocolError) as error:
                if attempt == _TRIES - 1 or self._at_rest:
                    raise
                self.watch("again", {"why": str(error)})
        raise AssertionError

    def _taken(
        self, step: Step, take: int, average: int, source: Callable[[], Exposure] | None = None
    ) -> ArchivedFrame:
        camera = self._prepared(step)
        before = self._position()
        exposures = [self._persist(source or camera.expose) for _ in range(average)]
        moved = self._moved(before)
        frame = _mean_frame([each.frame for each in exposures], step.name)
        facts = _facts(camera.name, exposures, before, moved)
        facts["fresh"] = source is not None or facts["fresh"]
        if step.exposure_us is not None:
            facts["set_exposure_us"] = step.exposure_us
        facts |= self._environment()
        return self.session.store(step.name, frame, take=take, facts=facts, clock=_clock(exposures))

    def _prepared(self, step: Step) -> Camera:
        """The camera, set to the exposure of a step if it has one."""
        if self._at_rest:
            raise StateError("the bench was stopped", where=step.name)
        camera: Camera = self.one(Camera)
        wanted, before = step.exposure_us, camera.settings.to_dict().get("exposure_us")
        if wanted is not None and before != wanted:
            if self._original_us is None and before is not None:
                self._original_us = float(before)
            self._persist(lambda: camera.configure(exposure_us=wanted))
        return camera

    def reset_exposure(self) -> None:
        """Set the camera to the exposure that it had before any step; report a failure."""
        with self._busy:
            try:
                if self._original_us is not None:
                    self.one(Camera).configure(exposure_us=self._original_us)
            except InstrumentError as error:
                self.watch("rest", {"failed": str(error)})

    def _position(self) -> dict[str, float]:
        """Positions of the axes of the table; without a table that answers, none."""
        if not self.has(Turntable):
            return {}
        table: Turntable = self.bench.one(Turntable, self._chosen[Turntable])
        if table.name in self._silent:
            return {}
        return self._persist(lambda: {axis: round(table.state(axis).position, 6) for axis in table.axes})

    def _environment(self) -> dict[str, Any]:
        """Facts of a picture: what the sensors of the environment measure, by their names, or why not.

        A sensor that fails does not end the session: its pictures say so.
        """
        found: dict[str, dict[str, Any]] = {}
        for name, sensor in self.bench.instruments.items():
            if not isinstance(sensor, EnvironmentSensor):
                continue
            try:
                # One that has failed is asked once for each frame: it may return.
                measured = sensor.environment() if name in self._silent else self._persist(sensor.environment)
            except InstrumentError as error:
                if name not in self._silent:
                    self._silent |= {name}
                    self.watch("without", {"instrument": name, "why": str(error)})
                found[name] = {"error": str(error)}
            else:
                self._silent -= {name}
                found[name] = {key: each.to_dict() for key, each in measured.conditions.items()}
        return {"environment": found} if found else {}

    def take_picture(self, step: Step, kind: str) -> ArchivedFrame:
        """Take and store a picture that is not measured. See :meth:`pictures`.

        Raises
        ------
        UsageError
            For another kind of picture.
        """
        with self._busy:
            self.doing = f"the {kind} of {step.name}"
            stored = self.session.find(step.name, kind)
            picture = self._pictured(step, kind) if stored is None else stored
            self.watch("picture", {"step": step.name, "kind": kind, "there": stored is not None})
            return picture

    def _pictured(self, step: Step, kind: str) -> ArchivedFrame:
        if kind == "screen":
            screen = self._persist(self.one(Oscilloscope).screen)
            clock, around = {"taken": screen.taken.isoformat()}, self._environment()
            return self.session.store(
                step.name, screen.data, kind=kind, suffix=screen.suffix, facts=around, clock=clock
            )
        if kind == "scan":
            scan = self._persist(self.one(UltrasonicScanner).scan)
            facts: dict[str, Any] = {
                "mm_per_px": None if scan.mm_per_px is None else list(scan.mm_per_px),
                "origin_px": list(scan.origin_px),
                "speed_m_s": or_null(scan.speed_m_s),
                "frequency_khz": or_null(scan.frequency_khz),
                "gain": or_null(scan.gain),
                **self._environment(),
            }
            clock = {"taken": scan.taken.isoformat()}
            return self.session.store(step.name, scan.frame(step.name), kind=kind, facts=facts, clock=clock)
        if kind == "probe":
            camera = self._prepared(step)
            exposure = self._persist(camera.expose)
            frame = _mean_frame([exposure.frame], step.name)
            facts = {"identity": str(camera.connect()), "set_exposure_us": step.exposure_us}
            facts |= self._environment()
            return self.session.store(step.name, frame, kind=kind, facts=facts, clock=_clock([exposure]))
        raise UsageError("unknown kind of picture", where=kind, do="use screen, scan or probe")

    def ask_operator(self, request: str) -> None:
        """Ask the operator to do something.

        Raises
        ------
        UsageError
            If there is no operator.
        """
        if self._operator is None:
            raise UsageError("needs an operator", where=request, do="pass `operator` to the acquisition")
        self._operator(request)

    def choose_pose(self, candidates: Sequence[Step], wanted: str) -> tuple[Step, float | None] | None:
        """Return the pose that the procedure chooses; in a resumed session the pose that it had chosen."""
        with self._busy:
            self.doing = "the choice of the next pose"
            return self._judge.choose(candidates, wanted, lambda: self._at_rest)

    def report_prediction(self, step: Step) -> None:
        """Report what a pose would bring for the first parameter, if the procedure can predict it."""
        with self._busy:
            self.doing = f"the prediction for {step.name}"
            self._judge.report_prediction(step)

    def check_scene(self, count: int) -> Readiness:
        """Take frames of the static scene, store them, and return what they show."""
        rig = self._rig
        if rig is not None:
            with self._busy:
                return self._checked_rig(rig, count)
        with self._busy:
            camera: Camera = self.one(Camera)
            start = len(self.session.frames(kind="check"))
            frames = []
            for k in range(start, start + count):
                exposure = self._persist(camera.expose)
                frame = _mean_frame([exposure.frame], f"check {k}")
                self.session.store(f"check {k}", frame, kind="check", clock=_clock([exposure]))
                frames.append(frame)
            found = readiness(frames, self.limits)
            self.session.note(f"check {start}", "check", found.to_dict())
            self.watch("check", found.to_dict())
            return found

    def _checked_rig(self, rig: CameraRig, count: int) -> Readiness:
        """Check the frames of each camera; return what the first one shows that is not ready, or any one."""
        start = len(self.session.frames(kind="check"))
        seen: dict[str, list[Frame]] = {camera: [] for camera in rig.cameras}
        for k in range(start, start + count):
            exposures = self._persist(rig.expose_all).exposures
            frames = {
                name: _mean_frame([each.frame], f"{name}/check {k}") for name, each in exposures.items()
            }
            clocks = {name: _clock([each]) for name, each in exposures.items()}
            self.session.store_set(f"check {k}", frames, kind="check", clock=clocks)
            for name, frame in frames.items():
                seen[name].append(frame)
        found = {name: readiness(frames, self.limits) for name, frames in seen.items()}
        for name, each in found.items():
            faults = [f"{name}: {fault}" for fault in each.faults]
            self.session.note(f"check {start} {name}", "check", each.to_dict() | {"camera": name})
            self.watch("check", each.to_dict() | {"camera": name, "faults": faults})
            found[name] = replace(each, faults=tuple(faults))
        return next((each for each in found.values() if not each), next(iter(found.values())))


def _good(frame: ArchivedFrame) -> bool:
    """Whether a frame has a verdict that it is usable."""
    return frame.verdict is not None and frame.verdict.ok


def _stream(camera: Camera, count: int) -> Callable[[], Exposure]:
    """A function that returns a fresh exposure, then those that follow it; it restarts after a failure."""
    stream: Iterator[Exposure] = iter(())

    def next_exposure() -> Exposure:
        nonlocal stream
        # An iterator that has raised is exhausted.
        if (exposure := next(stream, None)) is None:
            exposure, stream = camera.expose(), camera.frames(count)
        return exposure

    return next_exposure


def _mean_frame(frames: list[Frame], name: str) -> Frame:
    """The mean of frames of one scene, under the name of its step."""
    first = frames[0]
    if len(frames) == 1:
        return Frame(first.pixels, first.full_scale, name)
    total = np.zeros(first.pixels.shape, dtype=np.float64)
    for frame in frames:
        total += frame.pixels
    return Frame((total / len(frames)).astype(np.float32), first.full_scale, name)


def _facts(camera: str, exposures: list[Exposure], before: dict[str, float], moved: bool) -> dict[str, Any]:
    """How frames of a camera were taken."""
    first = exposures[0]
    return {
        "camera": camera,
        "exposure_us": or_null(first.exposure_us),
        "gain": or_null(first.gain),
        "pattern": first.pattern,
        "position": before,
        "averaged": len(exposures),
        "moved": moved,
        "fresh": all(each.fresh for each in exposures),
    }


def _clock(exposures: list[Exposure]) -> dict[str, Any]:
    """Times and counters of a camera."""
    return {
        "taken": [each.taken.isoformat() for each in exposures],
        "taken_within_s": [each.taken_within_s for each in exposures],
        "sequence": [each.sequence for each in exposures],
        "dropped": exposures[-1].dropped,
    }
