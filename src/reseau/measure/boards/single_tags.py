"""Tags that are scattered in a scene, each measured on its own: the points of a network, not of a board."""

from __future__ import annotations

from collections import Counter
from dataclasses import fields, replace
from typing import Any

import numpy as np

from ...core.data import Array, Frame
from ...core.failure import Code, Failure
from ...designs.boards import board
from ...io.board import BoardDesign
from ..points import Reason
from .markers import find_markers
from .measure import BoardOptions, BoardResult, measure_board

_AROUND = 0.3
"""Paper around a tag that is looked at, in sides of the tag; and at least so many pixels."""
_LEAST_PX = 12.0
_FEWEST = 3
"""Least number of corners of a tag that is no accident."""


def measure_tags(
    frame: Frame,
    dictionary: str = "DICT_APRILTAG_36h11",
    border_bits: int = 1,
    options: BoardOptions | None = None,
) -> BoardResult | Failure:
    """Measure the corners of ArUco markers or AprilTags that lie anywhere in a scene.

    Only tags without a wrong bit are taken. A tag of which fewer than three corners can be measured is
    declined, and so is one whose number is seen twice.

    Parameters
    ----------
    frame : Frame
        A photograph.
    dictionary : str
        Words of the tags, as OpenCV names them.
    border_bits : int
        Width of their black borders in bits.
    options : BoardOptions, optional
        Options of the measurement.

    Returns
    -------
    BoardResult or Failure
        Over the corners ``tag.0`` … ``tag.3`` of the tags seen, clockwise from the upper left. A failure if
        no tag is seen.

    Raises
    ------
    UsageError
        When OpenCV has no such dictionary.

    Examples
    --------
    >>> import cv2
    >>> words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    >>> tag = np.kron(cv2.aruco.generateImageMarker(words, 3, 6) / 255 * 170 + 30, np.ones((10, 10)))
    >>> scene = cv2.GaussianBlur(np.pad(tag, 30, constant_values=200), (0, 0), 0.8)
    >>> scene += np.random.default_rng(0).normal(0, 1, scene.shape)
    >>> found = measure_tags(Frame(scene, 255.0), "DICT_4X4_50")
    >>> found.ids, found.xy[0].round(1).tolist()
    (('3.0', '3.1', '3.2', '3.3'), [29.5, 29.5])
    """
    single = board("markers", 1, 1, 1.25, size=1.0, dictionary=dictionary, border_bits=border_bits)
    corners, numbers = find_markers(frame, single, whole=True)
    if not len(numbers):
        return Failure(f"no tag of {dictionary} was read", Code.NOT_FOUND, where=frame.name)
    times, parts = Counter(numbers.tolist()), list[BoardResult]()
    order = np.lexsort([corners[:, 0, 0], numbers])
    for quad, number in zip(corners[order], numbers[order].tolist(), strict=True):
        if times[number] > 1:
            why = Reason(f"tag {number} is seen {times[number]} times", Code.AMBIGUOUS)
            parts.append(_declined(frame, number, quad, why))
            continue
        parts.append(_measured(frame, single.model_copy(update={"first_id": number}), quad, options))
    first = parts[0]
    columns: dict[str, Any] = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(first)
        if isinstance(getattr(first, field.name), np.ndarray)
    }
    ids = tuple(name for part in parts for name in part.ids)
    reasons = tuple(reason for part in parts for reason in part.why)
    notes = tuple(dict.fromkeys(note for part in parts for note in part.notes))
    return replace(first, ids=ids, why=reasons, notes=notes, **columns)


def _measured(frame: Frame, design: BoardDesign, quad: Array, options: BoardOptions | None) -> BoardResult:
    """The corners of one tag, measured in the part of the frame around it."""
    around = max(_LEAST_PX, _AROUND * float(np.ptp(quad, axis=0).max()))
    size = np.array([frame.width, frame.height])
    low = np.maximum(np.floor(quad.min(axis=0) - around).astype(int), 0)
    high = np.minimum(np.ceil(quad.max(axis=0) + around).astype(int) + 1, size)
    pixels = np.ascontiguousarray(frame.pixels[low[1] : high[1], low[0] : high[0]])
    found = measure_board(replace(frame, pixels=pixels), design, options)
    if isinstance(found, Failure):
        return _declined(frame, design.first_id, quad, Reason(found.reason, found.code))
    if found.found < _FEWEST:
        missing = next(why for why, ok in zip(found.why, found.ok, strict=True) if not ok)
        code = missing.code if isinstance(missing, Reason) else Code.DECLINED
        return _declined(frame, design.first_id, quad, Reason(f"a corner of the tag is {missing}", code))
    return replace(
        found, image=frame.name, sha256=frame.sha256, xy=found.xy + low, predicted=found.predicted + low
    )


def _declined(frame: Frame, number: int, quad: Array, why: Reason) -> BoardResult:
    """The four corners of a tag that is not measured."""
    none, nowhere = np.full(4, np.nan), np.full((4, 2), np.nan)
    return BoardResult(
        image=frame.name, sha256=frame.sha256, ids=tuple(f"{number}.{k}" for k in range(4)), xy=nowhere,
        cov=np.full((4, 2, 2), np.nan), ok=np.zeros(4, dtype=bool), why=4 * (why,), predicted=quad,
        deviation=nowhere, contrast=none, t=none, noise=none, psf_px=none, notes=(),
    )  # fmt: skip
