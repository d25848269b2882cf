"""What follows from the frames of a session: a verdict on each, what is reached, which pose is next.

A frame is measured once. What was measured is stored with the session, so that a session that is resumed
recalls it; the same holds for a pose that was chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from ..archive import Session, Verdict
from ..archive.records import ArchivedFrame
from ..core.data import Frame
from ..core.errors import EstimationError, ImageError, StateError
from ..core.version import __version__
from .checks import Limits, exposure_fault
from .steps import Step, as_taken

_MEASURED = "measured"
"""Kind of the notes about what was measured in frames."""

Watch = Callable[[str, dict[str, Any]], None]
"""Callback for events: the kind of the event, and its values."""


class Procedure(Protocol):
    """Interface of a procedure: what an acquisition does with its frames.

    Examples
    --------
    A procedure that counts frames:

    >>> import numpy as np
    >>> class Count:
    ...     frames = 0
    ...     def on_frame(self, frame, step):
    ...         self.frames += 1
    ...         return Verdict(True)
    ...     def progress(self):
    ...         return {}
    ...     def next_pose(self, candidates, wanted):
    ...         return None
    ...     def finish(self):
    ...         return {"count.txt": f"{self.frames}"}
    >>> procedure: Procedure = Count()
    >>> procedure.on_frame(Frame(np.zeros((2, 2), np.uint8), 255.0), Step("first")).ok
    True
    >>> procedure.finish()
    {'count.txt': '1'}
    """

    def on_frame(self, frame: Frame, step: Step) -> Verdict:
        """Measure a new frame and return whether it is usable."""

    def progress(self) -> Mapping[str, float]:
        """Return the standard deviations reached so far, by parameter name."""

    def next_pose(self, candidates: Sequence[Step], wanted: str) -> tuple[Step, float | None] | None:
        """Return the pose that lowers a standard deviation most, and its predicted value if known."""

    def finish(self) -> Mapping[str, str]:
        """Return the results: file contents by name. Same frames in same order give the same bytes."""


class _Candidates(list[Step]):
    """Candidate poses; iteration raises after a stop, because choosing may take minutes."""

    def __init__(self, stopped: Callable[[], bool], steps: Sequence[Step]) -> None:
        super().__init__(steps)
        self._stopped = stopped

    def __iter__(self) -> Iterator[Step]:
        for each in super().__iter__():
            if self._stopped():
                raise StateError("was stopped", where="next pose")
            yield each


class Judge:
    """The verdicts on the frames of a session, by the limits and by its procedure.

    Parameters
    ----------
    session : Session
        The session of the archive that has the frames.
    procedure : Procedure or None
        Measures the frames. Without one, frames are only checked for saturation and motion.
    limits : Limits
        Limits for exposure.
    watch : callable
        Called with each event: its kind and its values.
    """

    def __init__(self, session: Session, procedure: Procedure | None, limits: Limits, watch: Watch) -> None:
        self._session, self._procedure, self._limits, self._watch = session, procedure, limits, watch
        there = session.frames(last=1)
        self._before = there[0].id if there else 0
        """Number of the last frame that was there before."""
        self._earlier: dict[int, Verdict] = {}
        self._memories: dict[int, Mapping[str, Any]] | None = None

    def progress(self) -> Mapping[str, float]:
        """Return what the procedure has reached; empty without one."""
        return {} if self._procedure is None else self._procedure.progress()

    def judge(self, frame: ArchivedFrame, step: Step) -> ArchivedFrame:
        """Return a frame with its verdict; the procedure gets each once, also those of before a resumption.

        A session may have any number of frames: the verdicts on those that are taken from now on are in the
        archive, and only those on the earlier ones, which may be others than before, are kept.
        """
        if frame.id in self._earlier:
            return replace(frame, verdict=self._earlier[frame.id])
        if frame.verdict is not None and frame.id > self._before:
            return frame
        verdict = self._recalled(frame, step) or self._checked(self._session.picture(frame), frame, step)
        if frame.verdict is None:
            self._session.judge(frame, verdict)
            self._remember(frame, step, verdict)
        if frame.id <= self._before:
            self._earlier[frame.id] = verdict
        facts = {"step": step.name, "take": frame.take, "ok": verdict.ok, "why": verdict.why}
        # A frame from before a resumption took no time.
        self._watch("frame", facts | {"there": frame.verdict is not None} | verdict.facts)
        if verdict.ok and frame.verdict is None and "set" not in frame.facts:
            self.report_precision(step)
        return replace(frame, verdict=verdict)

    def report_precision(self, step: Step) -> None:
        """Report what the procedure has reached, if anything."""
        reached = dict(self.progress())
        if reached:
            self._watch("precision", {"step": step.name} | reached)

    def _remember(self, frame: ArchivedFrame, step: Step, verdict: Verdict) -> None:
        """Store what was measured, so that a session that is resumed need not measure it again."""
        recollection = getattr(self._procedure, "recollection", None)
        if recollection is not None and verdict.ok:
            self._session.note(
                f"measured {frame.id}", _MEASURED,
                {"frame": frame.id, "software": __version__, "measured": recollection(step)},
            )  # fmt: skip

    def _recalled(self, frame: ArchivedFrame, step: Step) -> Verdict | None:
        """The verdict on a frame from before a resumption, as this version of the software found it."""
        if frame.verdict is None:
            return None
        if not frame.verdict.ok:  # no procedure has it
            return frame.verdict
        recall = getattr(self._procedure, "recall", None)
        if recall is None:
            return None
        if self._memories is None:
            notes = (note for _, note in self._session.notes(_MEASURED))
            self._memories = {
                int(note["frame"]): note["measured"] for note in notes if note["software"] == __version__
            }
        measured = self._memories.get(frame.id)
        return None if measured is None else recall(as_taken(step, frame.facts), measured)

    def _checked(self, picture: Frame, frame: ArchivedFrame, step: Step) -> Verdict:
        if frame.facts.get("moved"):
            return Verdict(False, "the table moved during the exposure")
        if not frame.facts.get("fresh", True):
            return Verdict(False, "the exposure may have started before the request")
        if frame.facts.get("late"):
            skew = max(frame.clock.get("skew_s", [math.nan]))
            return Verdict(False, f"the cameras exposed {1e6 * skew:.3g} µs apart: more than the rig allows")
        fault = exposure_fault(picture, self._limits)
        if fault:
            return Verdict(False, fault)
        if self._procedure is None:
            return Verdict(True)
        try:
            return self._procedure.on_frame(picture, as_taken(step, frame.facts))
        except ImageError as error:
            return Verdict(False, error.what)

    def choose(
        self, candidates: Sequence[Step], wanted: str, stopped: Callable[[], bool]
    ) -> tuple[Step, float | None] | None:
        """Return the pose that the procedure chooses; in a resumed session the pose that it had chosen.

        Raises
        ------
        StateError
            If `stopped` says so meanwhile.
        """
        key = f"choice among {len(candidates)}"
        names = {step.name: step for step in candidates}
        for made in (note for _, note in self._session.notes("choice") if note["key"] == key):
            return None if made["step"] is None else (names[made["step"]], made["predicted"])
        found = None
        if self._procedure is not None:
            found = self._procedure.next_pose(_Candidates(stopped, candidates), wanted)
        step, predicted = (None, None) if found is None else (found[0].name, found[1])
        self._session.note(key, "choice", {"key": key, "step": step, "predicted": predicted})
        self._watch("next", {"step": step, f"sigma_{wanted}": predicted})
        return found

    def report_prediction(self, step: Step) -> None:
        """Report what a pose would bring for the first parameter, if the procedure can predict it."""
        assert self._procedure is not None
        reached = next(iter(self._procedure.progress()), "")
        parameter = reached.removeprefix("sigma_")
        if not reached or reached == "sigma0":
            return
        try:
            found = self._procedure.next_pose([step], parameter)
        except EstimationError as error:
            self._watch("outlook", {"step": step.name, "why": error.what})
            return
        if found is not None and found[1] is not None:
            self._watch("outlook", {"step": step.name, f"sigma_{parameter}": found[1]})
