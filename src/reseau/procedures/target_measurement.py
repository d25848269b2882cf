"""Measure a target in many photographs."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from ..core.data import Frame, ImagePoints
from ..core.errors import ImageError
from ..core.failure import Code, Failure
from ..execution import Executor, Here, Outputs
from ..io import BoardDesign, PhotographPoints, ReseauDesign, TestfieldDesign
from ..measure import measure_board, measure_reseau, measure_testfield
from ..measure.boards.measure import BoardOptions
from ..measure.points import Measured
from ..measure.testfield.measure import TestfieldOptions

_COUNTS = re.compile(r"(?<![\w.×-])\d+(?![\w.×-])")
"""Numbers in a reason, but those in names of files and in sizes of images."""
Measurer = Callable[[Frame], Measured | Failure]
"""A function that measures a target in a frame."""


@dataclass(frozen=True)
class Unread:
    """A photograph that is read by the process that measures it.

    Parameters
    ----------
    name : str
        Name of the photograph.
    read : callable
        Returns its frame; picklable.
    inputs : mapping of str to str
        SHA-256 of all files that the frame depends on, by their roles; required to keep what is measured.

    Examples
    --------
    >>> Unread("photo.png", partial(print, "read")).name
    'photo.png'
    """

    name: str
    read: Callable[[], Frame]
    inputs: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class MeasuredPhotograph:
    """What was measured in a photograph.

    Parameters
    ----------
    name : str
        Name of the photograph.
    found : ImagePoints or Failure
        The image points, or why there are none.
    size : (int, int), optional
        Width and height in pixels, if a frame was measured.
    notes : tuple of str
        How the file was read.
    certain : bool
        Whether the names of the points are; otherwise all of them may be shifted by rows or columns.
    """

    name: str
    found: ImagePoints | Failure
    size: tuple[int, int] | None = None
    notes: tuple[str, ...] = ()
    certain: bool = True


Photograph = Frame | Unread | MeasuredPhotograph | tuple[str, ImagePoints | Failure]
"""A frame, one to be read, what was measured in it, or by its name the points or why it cannot be read."""


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


def measurer_with(measure: Measurer, design: BoardDesign) -> Measurer | None:
    """Return a measurer of :func:`measurer_of` or :func:`drawing_overlays` for another board; none of others.

    Examples
    --------
    >>> from reseau.designs import board
    >>> other = measurer_with(measurer_of(board("chess", 9, 6, 25.0)), board("chess", 10, 7, 25.0))
    >>> other.keywords["design"].columns
    10
    """
    if not isinstance(measure, partial):
        return None
    if measure.func is _drawn:
        inner = measurer_with(measure.args[0], design)
        return None if inner is None else partial(_drawn, inner, *measure.args[1:])
    return partial(measure.func, **{**measure.keywords, "design": design})


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
    photographs: Iterable[Photograph],
    measure: Measurer,
    executor: Executor | None = None,
    outputs: Outputs | None = None,
) -> Iterator[MeasuredPhotograph]:
    """Yield what was measured in each photograph, in their order.

    Parameters
    ----------
    photographs : iterable of Frame or Unread, or of (name, ImagePoints) or (name, Failure)
        Asked for when needed; points that were measured before, and failures to read a photograph, are passed
        on.
    measure : callable
        Measures a frame; picklable, unless this process measures.
    executor : Executor, optional
        What measures; by default this process.
    outputs : Outputs, optional
        Where measurements of unread photographs are kept; those that exist are not repeated.

    Raises
    ------
    ReseauError
        Errors of reading and measuring.

    Examples
    --------
    >>> list(measured_in_order([], measure=None))
    []
    """
    work = partial(_measured, measure, outputs)
    named = ((each[0] if isinstance(each, tuple) else each.name, each) for each in photographs)
    for name, found in (executor or Here()).outcomes(work, named):
        if isinstance(found, str):
            assert outputs is not None
            yield _of_document(name, outputs.read(found))
        else:
            yield MeasuredPhotograph(name, found) if isinstance(found, Failure) else found


def _measured(measure: Measurer, outputs: Outputs | None, photograph: Photograph) -> MeasuredPhotograph | str:
    """What was measured in a photograph, or the SHA-256 of the output that says it."""
    if isinstance(photograph, MeasuredPhotograph):
        return photograph
    if isinstance(photograph, tuple):
        return MeasuredPhotograph(*photograph)
    if outputs is None or not isinstance(photograph, Unread):
        return _points(measure, photograph)
    return outputs.made(photograph.inputs, lambda: _document(_points(measure, photograph)))


def _points(measure: Measurer, photograph: Frame | Unread) -> MeasuredPhotograph:
    name = photograph.name
    try:
        frame = photograph.read() if isinstance(photograph, Unread) else photograph
    except ImageError as error:
        return MeasuredPhotograph(name, Failure(error.reason, Code.DECLINED, where=name))
    size = frame.width, frame.height
    try:
        found = measure(frame)
    except (np.linalg.LinAlgError, cv2.error) as error:
        # One photograph must not end the measurement of the others.
        reason = f"could not be measured ({type(error).__name__}); please report it with the image"
        return MeasuredPhotograph(name, Failure(reason, Code.SINGULAR, where=name), size, frame.notes)
    if isinstance(found, Failure):
        return MeasuredPhotograph(name, found, size, frame.notes)
    points = found.candidates
    return MeasuredPhotograph(name, points, size, frame.notes, len(points) == found.found)


def _document(photograph: MeasuredPhotograph) -> bytes:
    document = PhotographPoints.of(photograph.found, photograph.size, photograph.notes, photograph.certain)
    return document.to_json().encode()


def _of_document(name: str, data: bytes) -> MeasuredPhotograph:
    document = PhotographPoints.parse(data.decode(), where=name)
    found = document.image_points(name)
    return MeasuredPhotograph(name, found, document.size, document.notes, document.certain)


def by_reason(declined: Mapping[str, str]) -> dict[str, list[str]]:
    """Each reason once, as the first photograph has it, with all to which it applies; counts may differ.

    Examples
    --------
    >>> by_reason({"a.png": "4 points are too few", "b.png": "5 points are too few"})
    {'4 points are too few': ['a.png', 'b.png']}
    """
    found: dict[str, tuple[str, list[str]]] = {}
    for image, reason in declined.items():
        found.setdefault(_COUNTS.sub("#", reason), (reason, []))[1].append(image)
    return dict(found.values())


def few_of(names: Sequence[str], most: int = 1) -> str:
    """Names, of many the first, or as many as wanted, and the number of the others.

    Examples
    --------
    >>> few_of(["a", "b"]), few_of(["a", "b", "c", "d"])
    ('a, b', 'a and 3 others')
    """
    if len(names) <= most + 2:
        return ", ".join(names)
    return f"{', '.join(names[:most])} and {len(names) - most} others"
