"""What an acquisition does with instruments and archive: tried again, and stored before the next thing.

It knows no engine: each is the work behind a message of :class:`~reseau.capture.Acquisition`, in a thread.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from ..archive import ArchivedFrame, Session, Verdict
from ..core.data import Frame
from ..core.errors import (
    ConnectionLost,
    DeadlineError,
    EstimationError,
    ImageError,
    InstrumentError,
    ProtocolError,
    ReseauError,
    StateError,
    UsageError,
)
from ..instruments import Camera, Exposure, Oscilloscope, Turntable, UltrasonicScanner
from .bench import Bench
from .checks import Limits, Readiness, exposure_fault, readiness
from .procedure import Candidates, Procedure, Watch
from .shots import clock_of, following, mean_frame, told
from .step import Step, as_taken

__all__ = ["Work"]

T = TypeVar("T")
_TRIES = 4
"""How often an instrument is asked before its failure ends the session."""
_STILL = 0.02
"""By how much an axis may move while a frame is exposed, in its unit."""


class Work:
    """Bench, session and procedure, and what is done with them.

    Parameters
    ----------
    bench : Bench
        Connected or not.
    kept : Session
        Of the archive.
    procedure : Procedure, optional
        What measures the frames; without one they are only looked at for saturation and motion.
    camera, table, oscilloscope, scanner : str, optional
        Names on the bench; by default the only instrument of the kind.
    retakes : int
        How often a bad frame is taken again.
    limits : Limits, optional
        Of exposure, focus, vibration.
    watch : callable, optional
        Told what happens.
    operator : callable, optional
        Asked to do what no instrument can; returns when it is done.
    """

    def __init__(
        self,
        bench: Bench,
        kept: Session,
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
        self.bench, self.kept, self.procedure = bench, kept, procedure
        self._chosen: dict[type, str | None] = {
            Camera: camera,
            Turntable: table,
            Oscilloscope: oscilloscope,
            UltrasonicScanner: scanner,
        }
        self.retakes, self.limits, self.watch, self._operator = retakes, limits or Limits(), watch, operator
        self._busy = threading.Lock()
        self._known: dict[int, Verdict] = {}
        self._last: ArchivedFrame | None = None
        self._resting = False
        self._own_us: float | None = None

    def one(self, kind: type) -> Any:
        """The instrument of a kind: that which was named, or the only one; as :meth:`Bench.one`."""
        return self.bench.one(kind, self._chosen.get(kind))

    def has(self, kind: type) -> bool:
        """Whether the bench has an instrument of a kind."""
        return self.bench.has(kind)

    def reached(self, parameter: str) -> float | None:
        """The standard deviation of a parameter that the procedure has reached; None while there is none."""
        return None if self.procedure is None else self.procedure.progress().get(f"sigma_{parameter}")

    def rest(self) -> None:
        """Stop the table where it stands, and whatever sends; never raises, never drives anywhere."""
        self._resting = True
        try:
            self.bench.stop()
        except InstrumentError as error:
            self.watch("rest", {"failed": str(error)})

    def retreat(self, position: Mapping[str, float]) -> None:
        """Move the table away after all has come to rest; where it cannot, that is told, and it stands."""
        try:
            self.ready()
            self.move_to(position)
        except ReseauError as error:
            self.watch("rest", {"failed": str(error)})
        finally:
            self.rest()

    def settle(self) -> None:
        """Wait for what an interrupted message still does: what it brings is stored, and judged."""
        with self._busy:
            pass

    def ready(self) -> None:
        """Connect all instruments, and let them move and send again.

        Raises
        ------
        BenchError
            When one cannot be connected.
        """
        self._resting = False
        for instrument in self.bench.instruments.values():
            self._persist(instrument.stage)

    def verdict(self, found: ArchivedFrame) -> Verdict:
        """What was found of a frame that was taken or looked at in this process."""
        return self._known[found.id]

    def done(self, step: Step) -> bool:
        """Whether a step has its frame: a good one, or as many bad ones as are tried."""
        frames = self.kept.frames(step.name, "frame")
        return any(f.verdict is not None and f.verdict.ok for f in frames) or len(frames) > self.retakes

    def expose(self, step: Step, average: int = 1) -> ArchivedFrame:
        """The frame of a step, taken again while it is bad; the one that is there, where one is.

        Raises
        ------
        InstrumentError
            When the camera or the table fails again and again.
        ArchiveError
            When it cannot be kept.
        """
        # An engine that was paused in the middle of this replays the message while the thread still works:
        # it waits here, and then finds the frame.
        with self._busy:
            return self._exposed(step, average)

    def expose_series(self, steps: Sequence[Step]) -> list[ArchivedFrame]:
        """Frames of one scene, a step for each, as the camera delivers them; otherwise as :meth:`expose`."""
        source = following(self.one(Camera), len(steps))
        with self._busy:
            return [self._exposed(step, 1, source) for step in steps]

    def _exposed(
        self, step: Step, average: int, source: Callable[[], Exposure] | None = None
    ) -> ArchivedFrame:
        for take in range(self.retakes + 1):
            found = self.kept.find(step.name, "frame", take) or self._taken(step, take, average, source)
            verdict = self._judged(found, step)
            self._last = found
            if verdict.ok:
                break
        return found

    def move_to(self, position: Mapping[str, float]) -> None:
        """Move axes of the table, all at once, and wait.

        Raises
        ------
        InstrumentError
            When one does not come there.
        """
        axes = self.one(Turntable).axes

        def there() -> None:
            statuses = [axes[axis].set(value) for axis, value in position.items()]
            failures = [status.exception(None) for status in statuses]
            for failure in failures:
                if failure is not None:
                    raise failure

        self._persist(there)

    def home_axes(self) -> None:
        """Have the axes without a reference find it, one after the other."""
        table: Turntable = self.one(Turntable)
        for axis in table.axes:
            if not self._persist(lambda axis=axis: table.state(axis)).homed:  # type: ignore[misc]
                self.watch("home", {"axis": axis})
                self._persist(lambda axis=axis: table.home(axis))  # type: ignore[misc]

    def _persist(self, work: Callable[[], T]) -> T:
        """The outcome of a work that may be begun anew; what passes is tried again, and told."""
        for tried in range(_TRIES):
            try:
                return work()
            except (ConnectionLost, DeadlineError, ProtocolError) as error:
                if tried == _TRIES - 1 or self._resting:
                    raise
                self.watch("again", {"why": str(error)})
        raise AssertionError

    def _taken(
        self, step: Step, take: int, average: int, source: Callable[[], Exposure] | None = None
    ) -> ArchivedFrame:
        camera = self._set_up(step)
        before = self._position()
        exposures = [self._persist(source or camera.expose) for _ in range(average)]
        moved = {axis: abs(value - before[axis]) for axis, value in self._position().items()}
        frame = mean_frame([each.frame for each in exposures], step.name)
        first = exposures[0]
        facts = {
            "camera": camera.name,
            "exposure_us": told(first.exposure_us),
            "gain": told(first.gain),
            "pattern": first.pattern,
            "position": before,
            "averaged": average,
            "moved": max(moved.values(), default=0.0) > _STILL,
            "fresh": source is not None or all(each.fresh for each in exposures),
        }
        if step.exposure_us is not None:
            facts["set_exposure_us"] = step.exposure_us
        return self.kept.store(step.name, frame, take=take, facts=facts, clock=clock_of(exposures))

    def _set_up(self, step: Step) -> Camera:
        """The camera, set to the exposure of a step where it has one."""
        if self._resting:
            raise StateError("the bench was brought to rest", where=step.name)
        camera: Camera = self.one(Camera)
        wanted, before = step.exposure_us, camera.settings.to_dict().get("exposure_us")
        if wanted is not None and before != wanted:
            if self._own_us is None and before is not None:
                self._own_us = float(before)
            self._persist(lambda: camera.configure(exposure_us=wanted))
        return camera

    def restore_exposure(self) -> None:
        """Set the camera to the exposure that it had before any step; where it fails that is told."""
        with self._busy:
            try:
                if self._own_us is not None:
                    self.one(Camera).configure(exposure_us=self._own_us)
            except InstrumentError as error:
                self.watch("rest", {"failed": str(error)})

    def _position(self) -> dict[str, float]:
        """Where the axes of the table stand."""
        if not self.has(Turntable):
            return {}
        table: Turntable = self.one(Turntable)
        return self._persist(lambda: {axis: round(table.state(axis).position, 6) for axis in table.axes})

    def _judged(self, found: ArchivedFrame, step: Step) -> Verdict:
        """The verdict on a frame; the procedure sees each once, also those of before a resumption."""
        if found.id in self._known:
            return self._known[found.id]
        verdict = self._looked_at(self.kept.picture(found), found, step)
        if found.verdict is None:
            self.kept.judge(found, verdict)
        self._known[found.id] = verdict
        told = {"step": step.name, "take": found.take, "ok": verdict.ok, "why": verdict.why}
        # Of before a resumption, it took no time to take.
        self.watch("frame", told | {"there": found.verdict is not None} | verdict.facts)
        if self.procedure is not None and verdict.ok and found.verdict is None:
            reached = dict(self.procedure.progress())
            if reached:
                self.watch("precision", {"step": step.name} | reached)
        return verdict

    def _looked_at(self, frame: Frame, found: ArchivedFrame, step: Step) -> Verdict:
        if found.facts.get("moved"):
            return Verdict(False, "the table moved during the exposure")
        if not found.facts.get("fresh", True):
            return Verdict(False, "its exposure may have begun before it was asked for")
        fault = exposure_fault(frame, self.limits)
        if fault:
            return Verdict(False, fault)
        if self.procedure is None:
            return Verdict(True)
        try:
            return self.procedure.on_frame(frame, as_taken(step, found.facts))
        except ImageError as error:
            return Verdict(False, error.what)

    def take_picture(self, step: Step, kind: str) -> ArchivedFrame:
        """The section of the scanner (`scan`), the oscilloscope's own screen (`screen`), or a frame of the
        camera that nothing is measured in (`probe`), of a step.

        Raises
        ------
        UsageError
            For another kind of picture.
        """
        with self._busy:
            there = self.kept.find(step.name, kind)
            found = self._pictured(step, kind) if there is None else there
            self.watch("picture", {"step": step.name, "kind": kind, "there": there is not None})
            return found

    def _pictured(self, step: Step, kind: str) -> ArchivedFrame:
        if kind == "screen":
            screen = self._persist(self.one(Oscilloscope).screen)
            clock = {"taken": screen.taken.isoformat()}
            return self.kept.store(step.name, screen.data, kind=kind, suffix=screen.suffix, clock=clock)
        if kind == "scan":
            scan = self._persist(self.one(UltrasonicScanner).scan)
            facts: dict[str, Any] = {
                "mm_per_px": None if scan.mm_per_px is None else list(scan.mm_per_px),
                "origin_px": list(scan.origin_px),
                "speed_m_s": told(scan.speed_m_s),
                "frequency_khz": told(scan.frequency_khz),
                "gain": told(scan.gain),
            }
            clock = {"taken": scan.taken.isoformat()}
            return self.kept.store(step.name, scan.frame(step.name), kind=kind, facts=facts, clock=clock)
        if kind == "probe":
            camera = self._set_up(step)
            exposure = self._persist(camera.expose)
            frame = mean_frame([exposure.frame], step.name)
            facts = {"identity": str(camera.connect()), "set_exposure_us": step.exposure_us}
            return self.kept.store(step.name, frame, kind=kind, facts=facts, clock=clock_of([exposure]))
        raise UsageError("is no kind of picture", where=kind, do="there are screen, scan and probe")

    def have_done(self, what: str) -> None:
        """Have the operator do something.

        Raises
        ------
        UsageError
            When there is none.
        """
        if self._operator is None:
            raise UsageError("needs an operator", where=what)
        self._operator(what)

    def choose_pose(self, candidates: Sequence[Step], wanted: str) -> tuple[Step, float | None] | None:
        """The pose that the procedure chooses; in a session that is resumed, that which it had chosen."""
        with self._busy:
            key = f"choice among {len(candidates)}"
            names = {step.name: step for step in candidates}
            for made in (note for _, note in self.kept.notes("choice") if note["key"] == key):
                # A session that is resumed goes where it had gone.
                return None if made["step"] is None else (names[made["step"]], made["predicted"])
            found = None
            if self.procedure is not None:
                found = self.procedure.next_pose(Candidates(lambda: self._resting, candidates), wanted)
            step, predicted = (None, None) if found is None else (found[0].name, found[1])
            self.kept.note(key, "choice", {"key": key, "step": step, "predicted": predicted})
            self.watch("next", {"step": step, f"sigma_{wanted}": predicted})
            return found

    def foretell(self, step: Step) -> None:
        """Tell what a pose would bring to the first parameter, where the procedure can predict it."""
        assert self.procedure is not None
        with self._busy:
            reached = next(iter(self.procedure.progress()), "")
            parameter = reached.removeprefix("sigma_")
            if not reached or reached == "sigma0":
                return
            try:
                found = self.procedure.next_pose([step], parameter)
            except EstimationError as error:
                self.watch("outlook", {"step": step.name, "why": error.what})
                return
            if found is not None and found[1] is not None:
                self.watch("outlook", {"step": step.name, f"sigma_{parameter}": found[1]})

    def look_first(self, count: int) -> Readiness:
        """Take some frames of the unmoved scene, keep them, and tell what they show."""
        with self._busy:
            camera: Camera = self.one(Camera)
            begun = len(self.kept.frames(kind="check"))
            frames = []
            for k in range(begun, begun + count):
                exposure = self._persist(camera.expose)
                frame = mean_frame([exposure.frame], f"check {k}")
                self.kept.store(f"check {k}", frame, kind="check", clock=clock_of([exposure]))
                frames.append(frame)
            found = readiness(frames, self.limits)
            self.kept.note(f"check {begun}", "check", found.to_dict())
            self.watch("check", found.to_dict())
            return found
