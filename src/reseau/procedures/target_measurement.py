"""Measure a target in many photographs, in parallel processes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from ..core.data import Frame, ImagePoints
from ..core.errors import EstimationError, ImageError
from ..core.failure import Code, Failure
from ..core.processes import process_context
from ..core.threads import always_one_thread, one_thread
from ..io import BoardDesign, ReseauDesign, TestfieldDesign
from ..measure import (
    BoardOptions,
    TestfieldOptions,
    measure_board,
    measure_reseau,
    measure_testfield,
)
from ..measure.points import Measured

__all__ = ["Measurer", "Photograph", "drawing_overlays", "measured_in_order", "measurer_of"]

Measurer = Callable[[Frame], Measured | Failure]
"""A function that measures a target in a frame."""
Photograph = Frame | tuple[str, ImagePoints | Failure]
"""A frame, the points measured in it by its name, or why it cannot be read."""
# Frames queued for each process, so that none is idle.
_AHEAD = 2


def measurer_of(
    design: TestfieldDesign | ReseauDesign | BoardDesign, testfield: TestfieldOptions | None = None
) -> Measurer:
    """Return the function that measures a design in a frame.

    Parameters
    ----------
    design : TestfieldDesign, BoardDesign or ReseauDesign
        A coded testfield, a board, or any design of marks.
    testfield : TestfieldOptions, optional
        Options of the measurement of a testfield; jitter of rows and share of pixels hold for a board, too.

    Examples
    --------
    >>> from reseau.designs import coded_testfield
    >>> callable(measurer_of(coded_testfield()))
    True
    """
    if isinstance(design, TestfieldDesign):
        return partial(measure_testfield, design=design, options=testfield)
    if isinstance(design, BoardDesign):
        same = testfield or TestfieldOptions()
        options = BoardOptions(row_jitter_px=same.row_jitter_px, fill=same.fill)
        return partial(measure_board, design=design, options=options)
    return partial(measure_reseau, design=design)


def drawing_overlays(measure: Measurer, files: Mapping[str, Path]) -> Measurer:
    """Return a measurer that also draws what it found in a frame, and what it declined.

    Parameters
    ----------
    measure : callable
        Measures a frame.
    files : mapping
        PNG files by names of frames; other frames are not drawn.

    Examples
    --------
    >>> callable(drawing_overlays(lambda frame: Failure("no target"), {}))
    True
    """
    return partial(_drawn, measure, dict(files))


def _drawn(measure: Measurer, files: Mapping[str, Path], frame: Frame) -> Measured | Failure:
    found = measure(frame)
    if frame.name in files:
        found.overlay(frame, files[frame.name])
    return found


def measured_in_order(
    frames: Iterable[Photograph], measure: Measurer, workers: int = 1
) -> Iterator[tuple[str, ImagePoints | Failure]]:
    """Yield names of frames with their measured points, in the order of the frames.

    Parameters
    ----------
    frames : iterable of Frame, or of (name, ImagePoints) or (name, Failure)
        Read when needed; points that were measured before, and failures to read a frame, are passed on.
    measure : callable
        Measures a frame; must be picklable with several processes.
    workers : int
        Number of processes; with one, this process measures.

    Raises
    ------
    ReseauError
        Errors of reading and measuring; EstimationError if a process dies.

    Examples
    --------
    >>> list(measured_in_order([], measure=None))
    []
    """
    work = partial(_points, measure)
    if workers == 1:
        for frame in frames:
            yield (frame.name, work(frame)) if isinstance(frame, Frame) else frame
        return
    pool = ProcessPoolExecutor(workers, mp_context=process_context([__name__]), initializer=_one_thread)
    waiting: deque[tuple[str, ImagePoints | Failure | Future[ImagePoints | Failure]]] = deque()
    try:
        for frame in frames:
            waiting.append((frame.name, pool.submit(work, frame)) if isinstance(frame, Frame) else frame)
            if len(waiting) > _AHEAD * workers:
                yield _next(waiting)
        while waiting:
            yield _next(waiting)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _points(measure: Measurer, frame: Frame) -> ImagePoints | Failure:
    # Sums of one and of several threads differ in the last digits; results must not depend on `workers`.
    try:
        with one_thread():
            found = measure(frame)
    except ImageError as error:
        return Failure(error.what, Code.DECLINED, where=frame.name)
    except (np.linalg.LinAlgError, cv2.error) as error:
        # One photograph must not end the measurement of the others.
        reason = f"could not be measured ({type(error).__name__}); please report it with the image"
        return Failure(reason, Code.SINGULAR, where=frame.name)
    return found if isinstance(found, Failure) else found.points


def _next(
    waiting: deque[tuple[str, ImagePoints | Failure | Future[ImagePoints | Failure]]],
) -> tuple[str, ImagePoints | Failure]:
    name, found = waiting.popleft()
    if isinstance(found, ImagePoints | Failure):
        return name, found
    try:
        return name, found.result()
    except BrokenProcessPool:
        raise EstimationError(
            "a measuring process died", where=name, do="use fewer processes if memory is short"
        ) from None


def _one_thread() -> None:
    """Use one core in each process."""
    cv2.setNumThreads(1)
    always_one_thread()
