"""A procedure in one module: how much does a lamp flicker from frame to frame?

Entry point: ``[project.entry-points."reseau.sessions"] flicker = "procedure:KIND"``. A session of this plan
takes frames, measures each one while the next is taken, and stores ``flicker.json``; ``reseau archive rerun``
computes it again from the archive, with the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np

from reseau.archive import Session, Verdict
from reseau.capture import Step, plans
from reseau.core.data import Frame
from reseau.sessions.kinds import SessionKind
from reseau.sessions.parameters import FramesParameters


class Flicker:
    """Mean grey value of each frame, and its scatter."""

    def __init__(self) -> None:
        self.levels: list[float] = []

    def on_frame(self, frame: Frame, step: Step) -> Verdict:
        """Measure a frame; one that is saturated is not usable."""
        if np.mean(frame.pixels >= frame.full_scale) > 0.01:
            return Verdict(False, "is overexposed; use a shorter exposure")
        self.levels.append(float(np.mean(frame.pixels, dtype=np.float64)))
        return Verdict(True)

    def progress(self) -> Mapping[str, float]:
        """Standard deviation of the result so far: of a scatter of n values it is s / √(2 (n − 1))."""
        count = len(self.levels)
        return {} if count < 3 else {"flicker": self._scatter() / np.sqrt(2 * (count - 1))}

    def next_pose(self, candidates: Sequence[Step], wanted: str) -> tuple[Step, float | None] | None:
        """No pose is better than another."""
        return None

    def finish(self) -> dict[str, str]:
        """The results: contents of files by their names."""
        if len(self.levels) < 3:
            return {}
        result = {"frames": len(self.levels), "flicker": self._scatter(), "sigma": self.progress()["flicker"]}
        return {"flicker.json": json.dumps(result, indent=1) + "\n"}

    def _scatter(self) -> float:
        """Relative standard deviation of the mean grey values."""
        return float(np.std(self.levels, ddof=1) / np.mean(self.levels))


def _procedure(session: Session, given: FramesParameters) -> Flicker:
    return Flicker()


KIND = SessionKind(
    FramesParameters,
    lambda run, given: plans.frames(run, given.count, given.average),
    procedure=_procedure,
)
