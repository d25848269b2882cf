"""What an acquisition knows of those around it: what becomes of the frames, and who is told what happens."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

from ..archive import Verdict
from ..core.data import Frame
from ..core.errors import StateError
from .step import Step

__all__ = ["Candidates", "Procedure", "Watch"]

Watch = Callable[[str, dict[str, Any]], None]
"""Told what happens: the kind of an event, and what there is to say about it."""


class Procedure(Protocol):
    """What becomes of the frames; all that an acquisition knows of it."""

    def on_frame(self, frame: Frame, step: Step) -> Verdict:
        """Measure a frame as it comes, and say whether it can be used."""

    def progress(self) -> Mapping[str, float]:
        """What has been reached so far: standard deviations by the name of the parameter."""

    def next_pose(self, candidates: Sequence[Step], wanted: str) -> tuple[Step, float | None] | None:
        """The pose that lowers a standard deviation most, and to what, where that is known."""

    def finish(self) -> Mapping[str, str]:
        """Results: the text of files by name; the same frames in the same order give the same bytes."""


class Candidates(list[Step]):
    """Poses to choose from, of which no more is handed out once it is stopped: choosing may take minutes.

    Parameters
    ----------
    stopped : callable
        Whether somebody wants to stop.
    those : sequence of Step
        The poses.
    """

    def __init__(self, stopped: Callable[[], bool], those: Sequence[Step]) -> None:
        super().__init__(those)
        self._stopped = stopped

    def __iter__(self) -> Iterator[Step]:
        for each in super().__iter__():
            if self._stopped():
                raise StateError("was stopped", where="next pose")
            yield each
