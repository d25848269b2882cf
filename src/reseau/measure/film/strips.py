"""Scans of several frames: the rest of a strip of which one frame is known, and the order of its frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from ...core.data import Array
from ...io.scans import Scan
from .search import FrameGuess, overlap_of, search_frames, size_of

if TYPE_CHECKING:
    from .orientation import FrameOptions, FrameResult


_FINE, _MOST = 1000, 4000
"""Longer side of the overview of a scan of one frame, and of any, pixels."""
_LANDSCAPE = 1.5
"""Ratio of the sides of a scan from which it is a strip."""
_PITCH = 38 / 36
"""From a frame to the next, in widths of a frame."""
_ROOM = 0.6
"""Share of a frame for which a scan must have room beside the known ones to show another."""
_TRIED, _TOLERANCE, _OVERLAPPING = 400, 0.02, 0.1
"""Combinations of lines that are tested, relative deviation of their proportions, and the largest common area
of two frames."""


def overview_of(scan: Scan, longest: int) -> int:
    """Longer side of an overview that is as fine for a strip as one of `longest` pixels for a frame."""
    ratio = max(scan.width, scan.height) / min(scan.width, scan.height)
    return min(round(longest * max(1.0, ratio / _LANDSCAPE)), _MOST)


def rest_of_strip(
    scan: Scan,
    known: Sequence[FrameResult],
    options: FrameOptions,
    oriented: Callable[[Scan, FrameGuess, float, FrameOptions], FrameResult],
) -> list[FrameResult]:
    """The frames of a scan with the others, which have the size and the direction of the oriented ones.

    Parameters
    ----------
    scan : Scan
        The scan.
    known : sequence of FrameResult
        Frames found without knowledge of others; those that were declined are sought again.
    options : FrameOptions
        Prior knowledge of the frames.
    oriented : callable
        Measures one guess in an overview with its reduction.
    """
    best = next((each for each in known if each.lines is not None and each), None)
    found = [each for each in known if each]
    places = [each.place for each in found if each.place is not None]
    if options.near is not None or best is None or best.lines is None or not _room(scan, places):
        return list(known)
    (w, h), corners = best.format_mm or (1.0, 1.0), best.lines.corners
    scale = float(np.mean(size_of(corners) / (w, h)))
    along = corners[1] - corners[0]
    overview, reduction = scan.overview(overview_of(scan, _FINE))
    alike = replace(options, dpi=25.4 * scale, formats=((w, h),))
    for missing in (False, True):
        for guess in search_frames(
            overview,
            [(w, h)],
            tolerance=_TOLERANCE,
            px_per_mm=scale / reduction,
            tried=_TRIED,
            missing=missing,
            along=float(np.arctan2(along[1], along[0])),
        ):
            place = (guess.corners + 0.5) * reduction - 0.5
            if guess.format_mm != (w, h) or any(overlap_of(place, other) > _OVERLAPPING for other in places):
                continue
            result = oriented(scan, guess, reduction, alike)
            # Three lines may be anything; four that look like a frame are one, measured or declined.
            if result or not missing:
                found.append(result)
                places.append(place)
    return found


def _room(scan: Scan, places: Sequence[Array]) -> bool:
    """Whether a scan shows more than the known frames."""
    corners = np.concatenate(list(places))
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = np.median([np.ptp(place, axis=0) for place in places], axis=0)
    beside = np.concatenate([low, np.array([scan.width, scan.height]) - high])
    covered = sum(float(np.prod(np.ptp(place, axis=0))) for place in places)
    gap = float(np.prod(high - low)) - covered
    return bool((beside > _ROOM * np.tile(size, 2)).any() or gap > _ROOM * float(np.prod(size)))


def in_reading_order(results: Sequence[FrameResult]) -> list[FrameResult]:
    """Number frames row by row, along the direction in which they lie."""
    placed = [each for each in results if each.place is not None]
    if len(placed) < 2:
        return list(results)
    corners = np.array([each.place for each in placed])
    along = (corners[:, 1] - corners[:, 0]).mean(axis=0)
    along /= np.hypot(*along)
    middle = corners.mean(axis=1)
    x, y = middle @ along, middle @ np.array([-along[1], along[0]])
    height = float(np.median([size_of(each)[1] for each in corners]))
    order = np.argsort(y, kind="stable")
    # A new row begins where the next frame lies lower by more than half of one.
    row = np.zeros(len(y), dtype=np.intp)
    row[order[1:]] = np.cumsum(np.diff(y[order]) > height / 2)
    every = sorted(range(len(y)), key=lambda k: (row[k], x[k]))
    # Where a frame was not found between two others its number is left out.
    width = _PITCH * float(np.median([size_of(each)[0] for each in corners]))
    away = [1 if row[a] != row[b] else max(1, round((x[b] - x[a]) / width)) for a, b in pairwise(every)]
    return [replace(placed[k], frame=int(i)) for k, i in zip(every, np.cumsum([1, *away]), strict=True)]
