"""Computations on uploads and reruns, in a process of their own: `python -m reseau.service.computing`.

Its input is a session of the archive, and so is its output. A computation that was cut off is done again from
the start: what was stored is found, not stored twice.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from ..archive import Archive, Session, Verdict
from ..archive.records import ArchivedFrame
from ..capture.steps import Step, as_taken
from ..core.errors import ImageError, ReseauError
from ..core.threads import one_thread
from ..sessions import conducting
from .decoding import PHOTOGRAPH, Decoder


def finish(session: Session) -> str:
    """Decode, measure and adjust the photographs of a session, store the results, and end it.

    Parameters
    ----------
    session : Session
        A session with uploaded photographs.

    Returns
    -------
    str
        Status: ``done`` or ``failed``.

    Raises
    ------
    ReseauError
        If the archive fails.
    """
    try:
        procedure = conducting.procedure_of(session)
        assert procedure is not None
        with one_thread(), Decoder() as decoder:
            for original in session.frames(kind=PHOTOGRAPH):
                frame = session.find(original.step) or _decoded(session, original, decoder)
                if frame is None:
                    continue
                try:
                    step = as_taken(Step(frame.step), frame.facts)
                    verdict = procedure.on_frame(session.picture(frame), step)
                except ImageError as error:
                    verdict = Verdict(False, error.what)
                if frame.verdict is None:
                    session.judge(frame, verdict)
            inputs = {name: each.sha256 for name, each in session.inputs().items()}
            inputs |= {f.name: f.sha256 for f in session.frames(kind=PHOTOGRAPH)}
            for name, content in procedure.finish().items():
                session.keep(name, content, session.parameters, inputs)
            # What was found of a frame may depend on the others.
            verdicts = getattr(getattr(procedure, "procedure", procedure), "verdicts", dict)
            for step, verdict in verdicts().items():
                if (judged := session.find(step)) is not None:
                    session.judge(judged, verdict)
    except ReseauError as error:
        session.end("failed", str(error))
        return "failed"
    session.end("done")
    return "done"


def _decoded(session: Session, original: ArchivedFrame, decoder: Decoder) -> ArchivedFrame | None:
    """The frame of a photograph, stored; None, with a verdict on the photograph, if it cannot be decoded."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"photograph{original.suffix}"
        path.write_bytes(session.objects.get(original.sha256, original.suffix))
        try:
            colours = session.plan == "film"
            frame = (decoder.scan if colours else decoder.frame)(path, original.step)
        except ImageError as error:
            session.judge(original, Verdict(False, error.what))
            return None
    return session.store(original.step, frame, facts={"photograph": original.sha256})


def rerun(session: Session) -> dict[str, Any]:
    """Compute the results of a session again, and return which are the same to the byte.

    Raises
    ------
    ReseauError
        If they cannot be computed.
    """
    return {each.result.name: each.same for each in conducting.rerun(session)}


def _main() -> None:
    what, place, objects, name = sys.argv[1:5]
    os.nice(5)
    with Archive.open(place, objects or None) as archive:
        session = archive.session(name)
        try:
            found: Any = finish(session) if what == "finish" else rerun(session)
        except ReseauError as error:
            print(json.dumps({"error": str(error)}))
            return
    print(json.dumps({"found": found}))


if __name__ == "__main__":
    _main()
