"""Results recomputed from the frames of the archive, by the same calls that made them."""

from __future__ import annotations

from dataclasses import dataclass

from ..archive import ArchivedResult, Session
from ..core.threads import one_thread
from .procedure import Procedure
from .step import Step, as_taken

__all__ = ["Rerun", "rerun"]


@dataclass(frozen=True)
class Rerun:
    """One result, computed again.

    Parameters
    ----------
    result : ArchivedResult
        What is in the archive.
    content : str or None
        What came out now; None when nothing of that name did.
    same : bool
        Whether it is the same to the byte.
    """

    result: ArchivedResult
    content: str | None
    same: bool


def rerun(kept: Session, procedure: Procedure) -> list[Rerun]:
    """Compute the results of a session again, from its frames in the order in which they were taken.

    Parameters
    ----------
    kept : Session
        Of the archive.
    procedure : Procedure
        Made of the session's parameters, as the acquisition made it.
    """
    with one_thread():  # the same sums however many processors there are
        for frame in kept.frames(kind="frame"):
            # What saturation or motion had spoilt, the procedure never saw.
            if frame.verdict is not None and frame.verdict.ok:
                step = as_taken(Step(frame.step, frame.facts.get("position", {})), frame.facts)
                procedure.on_frame(kept.picture(frame), step)
        contents = procedure.finish()
    latest = {result.name: result for result in kept.results()}
    return [
        Rerun(result, contents.get(name), contents.get(name, "").encode("utf-8") == kept.content(result))
        for name, result in latest.items()
    ]
